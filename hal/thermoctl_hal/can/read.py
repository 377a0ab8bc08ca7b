"""Read the parts of a profile about CAN devices: DBC files and CiA-402 drives."""

from __future__ import annotations

import re
from pathlib import Path

from thermoctl.yamlfile import Node, Section, integer_of, kind_of, number_of
from thermoctl_hal.base.key import named, take
from thermoctl_hal.base.profile import (
    ERROR_CODE,
    FIELD_TYPES,
    STATUS_WORD,
    BusSpec,
    Cia402,
    Condition,
    Dbc,
    DbcSource,
    Object,
    object_name,
    typed,
)
from thermoctl_hal.can.keys import CAN

MAX_SUB_INDEX = 255
OBJECT_TYPES = {t: c for t, c in FIELD_TYPES.items() if t[-2:] != "64" and not t.startswith("float")}


def read_dbc(top: Section, folder: Path) -> Dbc:
    """Read the DBC file of a can-dbc device."""
    import cantools  # takes a second; only DBC profiles need it

    k = take(top, CAN["can-dbc"])
    path = folder / str(k["dbc"])
    node = top.get("dbc")
    try:
        database = cantools.database.load_file(str(path), database_format="dbc")
    except OSError as e:
        raise node.error(f"dbc: {path} cannot be read: {e.strerror}") from None
    except Exception as e:  # cantools raises parse errors of several libraries
        reason = (str(e).splitlines() or [type(e).__name__])[0]
        raise node.error(f"dbc: {path} is not a DBC file: {reason}") from None
    shift = -1 if k["node_shift"] is None else k["node_shift"]
    return Dbc(path, typed(database, cantools.database.can.Database), shift)


def read_signal(s: Section, spec: BusSpec) -> DbcSource:
    """Read the place of a channel of a can-dbc device: message and signal."""
    database = typed(spec, Dbc).database
    k = take(s, CAN["channel of can-dbc"])
    message = named(s, "message", [m.name for m in database.messages])
    signals = [x.name for x in database.get_message_by_name(message).signals]
    invalid = None
    if k["invalid"] is not None:
        i = take(k["invalid"], CAN["invalid of can-dbc"])
        invalid = Condition(named(k["invalid"], "signal", signals), i["mask"] or -1, i["good"])
        k["invalid"].end()
    sentinels = tuple(number_of(n, "sentinels") for n in k["sentinels"] or ())
    return DbcSource(message, named(s, "signal", signals), invalid, sentinels)


def read_cia402(top: Section, folder: Path) -> Cia402:
    """Read `cia402`, the description of a drive."""
    s = top.section("cia402")
    k = take(s, CAN["cia402"])
    eds = folder / k["eds"] if k["eds"] else None
    if eds is not None and not eds.is_file():
        raise s.get("eds").error(f"eds: {eds} cannot be read: no such file")
    transmit = tuple(read_object_name(n, "transmit") for n in k["transmit"])
    if not transmit or transmit[0] != STATUS_WORD:
        raise s.get("transmit").error("transmit: the objects of TPDO 1, the status word '0x6041' first")
    start_up = []
    for node in k["start_up"] or ():
        w = Section(node, "start_up")
        v = take(w, CAN["start_up"])
        start_up.append((v["index"], v["sub"], v["value"]))
        w.end()
    objects = {}
    if k["objects"] is not None:
        for name, node in k["objects"].node.value.items():
            item = read_object_name(Node(name, node.file, node.line, node.column), "objects")
            objects[item] = k["objects"].text(name, choices=OBJECT_TYPES)
    spec = Cia402(
        eds,
        k["node_id"],
        k["mode"],
        read_object_name(k["command"], "command"),
        transmit,
        k["master_id"],
        k["heartbeat_s"],
        k["watchdog_s"],
        tuple(start_up),
        k["sdo_timeout_s"],
        objects,
    )
    if spec.watchdog_s < 2 * spec.heartbeat_s:
        raise s.node.error(
            f"watchdog_s: {spec.watchdog_s:g} s is below two heartbeats of {spec.heartbeat_s:g} s: "
            "the drive would stop by itself"
        )
    s.end()
    return spec


def read_object_name(node: Node, key: str) -> Object:
    """Return an object: 0x6041, or 0x30D1:1 with the sub-index (decimal, or 0x.. in hexadecimal)."""
    if isinstance(node.value, int) and not isinstance(node.value, bool):
        return Object(integer_of(node, key, 0x1000, 0xFFFF))
    found = re.fullmatch(r"(0x[1-9A-Fa-f][0-9A-Fa-f]{3})(?::(0x[0-9A-Fa-f]{1,2}|\d{1,3}))?", str(node.value))
    sub = found[2] or "0" if found else "0"
    item = Object(int(found[1] if found else "0", 16), int(sub, 16 if "x" in sub else 10))
    if found is None or item.sub > MAX_SUB_INDEX:
        raise node.error(
            f"{key}: an object as 0x6041, or 0x30D1:1 with its sub-index, was expected, found {kind_of(node)}"
        )
    return item


def read_object(s: Section, spec: BusSpec) -> Object:
    """Read the place of a channel of a drive: an object that it sends."""
    item = read_object_name(take(s, CAN["channel of can-cia402"])["object"], "object")
    if item not in typed(spec, Cia402).transmit and item != ERROR_CODE:
        raise s.get("object").error(
            f"object: {object_name(item)} is not sent by the drive; add it to 'transmit'"
        )
    return item
