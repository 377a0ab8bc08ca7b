"""Read the parts of a profile about CAN devices: DBC files and CiA-402 drives."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermoctl.files.yamlfile import Node, Section, number_of
from thermoctl_hal.base.cia402 import OBJECT_TYPES, START_UP, read_object_name
from thermoctl_hal.base.key import named, sentinel_of, take, whole_range
from thermoctl_hal.base.profile import (
    ERROR_CODE,
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
from thermoctl_hal.base.units import dbc_unit, is_convertible
from thermoctl_hal.can.dbc_file import load_dbc
from thermoctl_hal.can.keys import CAN

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Signal

# Words of a file's value table that name a raw number without a reading.
# A signal with a unit has further ones; of a state an error is a reading.
_NO_VALUE = re.compile(
    r"(?i)(SNA|(signal|value)?[ _]?(not[ _]?available|invalid)|no[ _](value|data|signal))[ _]*"
)
_NO_QUANTITY = re.compile(
    r"(?i)(?<![^\W_])(SNA|n/?a(?![^\W_])|n\.a\.|(un|not[ _]?)avail|(in|not[ _]?)valid|init|undefined|unknown"
    r"|(?<!no[ _])(err|fault|fail|defect|short[ _]?(circuit|to)|open[ _]?(circuit|wire|load)|broken|time[ _]?out|missing|lost"
    r"|disconnect|out[ _]of[ _]range|(over|under)([ _]?flow|[ _]?range)|kurzschluss|bruch)|(im|un|not[ _]?)plausib"
    r"|(un|in)g(ü|ue)ltig|fehler|nicht[ _](verf|vorh)|ersatzwert|substitut|(no|kein)[ _](value|data|signal|sensor|wert))"
)
# A value belongs to a raw number if it is this close to the number's value, in steps of the signal.
NEAR_RAW = 0.01


def read_dbc(top: Section, folder: Path) -> Dbc:
    """Read the DBC file of a can-dbc device."""
    k = take(top, CAN["can-dbc"])
    path = folder / str(k["dbc"])
    node = top.get("dbc")
    try:
        file = load_dbc(path)
    except OSError as e:
        raise node.error(f"dbc: {path} cannot be read: {e.strerror}") from None
    except ValueError as e:
        raise node.error(f"dbc: {path} is not a DBC file: {e}") from None
    shift = -1 if k["node_shift"] is None else k["node_shift"]
    return Dbc(path, file.database, shift, file.faults, file.warning)


def read_signal(s: Section, spec: BusSpec) -> DbcSource:
    """Read the place of a channel of a can-dbc device: message and signal."""
    dbc = typed(spec, Dbc)
    k = take(s, CAN["channel of can-dbc"])
    message = message_of(s, dbc)
    invalid = None
    if k["invalid"] is not None:
        i = take(k["invalid"], CAN["invalid of can-dbc"])
        test = _signal_of(k["invalid"], dbc, message)
        if test.is_float:
            raise (
                k["invalid"].get("signal").error(f"signal: {test.name} is a float, which has no bits to test")
            )
        invalid = Condition(test.name, i["mask"] or -1, i["good"])
        k["invalid"].end()
    signal = _signal_of(s, dbc, message)
    sentinels = tuple(_raw_sentinel(n, signal) for n in k["sentinels"] or ())
    choices: Mapping[Any, object] = {} if signal.is_float else signal.choices or {}
    named_so = _NO_QUANTITY.search if signal.unit else _NO_VALUE.fullmatch
    none = [int(raw) % (1 << signal.length) for raw, word in choices.items() if named_so(str(word))]
    high = whole_range(signal.length, signal.is_signed)[1]  # a file may state the bits of a negative number
    sentinels += tuple(float(raw if raw <= high else raw - (1 << signal.length)) for raw in none)
    bits = 0 if signal.is_float or signal.is_signed or not dbc.is_j1939(message) else signal.length
    absent = range(0xFE << bits - 8, 1 << bits) if bits in (8, 16, 24, 32) else range(0)  # SAE J1939-71
    return DbcSource(message, signal.name, invalid, sentinels, absent)


def message_of(s: Section, spec: Dbc) -> str:
    """Return the message that `message` names. Raises InputError where the DBC file has no such sound one."""
    name = s.text("message")
    if name in spec.faults:
        raise s.get("message").error(f"message: {spec.file}: {spec.faults[name]}")
    return named(s, "message", [m.name for m in spec.database.messages])


def _signal_of(s: Section, spec: Dbc, message: str) -> Signal:
    """Return the signal that `signal` names. Raises InputError where the message has no such sound one."""
    fault = spec.faults.get(f"{message}.{s.text('signal')}")
    if fault is not None:
        raise s.get("signal").error(f"signal: {spec.file}: {fault}")
    definition = spec.database.get_message_by_name(message)
    signal = definition.get_signal_by_name(named(s, "signal", [x.name for x in definition.signals]))
    if not signal.scale:
        raise s.get("signal").error(f"signal: {spec.file}: {signal.name} has the factor 0")
    return signal


def check_unit(
    s: Section, spec: Dbc, message: str, name: str, unit: str, scale: float, offset: float = 0.0
) -> None:
    """Raise where `unit` and `scale` of a channel or command contradict the DBC file's unit and factor."""
    signal = spec.database.get_message_by_name(message).get_signal_by_name(name)
    theirs = dbc_unit(signal.unit)
    if theirs == unit and scale == signal.scale != 1.0:
        raise s.get("scale").error(
            f"scale: the DBC file gives {name} in {signal.unit} with its factor {signal.scale:g}, which would "
            "count twice; say scale: 1"
        )
    kelvin = {theirs, unit} == {"degC", "K"} and abs(offset) > 0.0
    if theirs != unit and abs(scale) == 1.0 and is_convertible(theirs) and not kelvin:
        raise s.get("unit").error(
            f"unit: the DBC file gives {name} in {signal.unit}, the profile says {unit} "
            f"with scale 1; say unit: {theirs}, or the scale from {signal.unit} to {unit}"
        )


def _raw_sentinel(node: Node, signal: Signal) -> float:
    """Return the raw number of a sentinel: a value of the signal, or a raw number that is no such value.

    Raises InputError where the signal can hold neither."""
    value = number_of(node, "sentinels")
    if isinstance(node.value, str):  # hexadecimal: the bits of the raw number
        letter = {16: "e", 32: "f", 64: "d"}[signal.length] if signal.is_float else ""
        return sentinel_of(node, signal.length, signal.is_signed, letter)
    if signal.is_float:
        return float((value - signal.offset) / signal.scale)
    bits = signal.length
    low, high = whole_range(bits, signal.is_signed)
    exact = (value - signal.offset) / signal.scale
    for raw in (exact, value):
        nearest = round(raw)
        if low <= nearest <= high and abs(raw - nearest) < NEAR_RAW:
            return float(nearest)
    first, last = sorted(x * signal.scale + signal.offset for x in (low, high))
    raise node.error(
        f"sentinels: {value:g} cannot come: {signal.name} has {bits} bits, values {first:g} .. {last:g} in steps "
        f"of {abs(signal.scale):g}, raw numbers {low} .. {high}"
    )


def read_cia402(top: Section, folder: Path) -> Cia402:
    """Read `cia402`, the description of a drive."""
    s = top.section("cia402")
    k = take(s, CAN["cia402"])
    eds = folder / k["eds"] if k["eds"] else None
    if eds is not None and not eds.is_file():
        raise s.get("eds").error(f"eds: {eds} cannot be read: no such file")
    if eds is not None and k["objects"] is not None:
        raise s.get("objects").error(
            "objects: the 'eds' file gives the types: correct it there, or leave it out"
        )
    transmit = tuple(read_object_name(n, "transmit") for n in k["transmit"])
    if not transmit or transmit[0] != STATUS_WORD:
        raise s.get("transmit").error("transmit: the objects of TPDO 1, the status word '0x6041' first")
    start_up = []
    for node in k["start_up"] or ():
        w = Section(node, "start_up")
        v = take(w, START_UP)
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


def read_object(s: Section, spec: BusSpec) -> Object:
    """Read the place of a channel of a drive: an object that it sends."""
    item = read_object_name(take(s, CAN["channel of can-cia402"])["object"], "object")
    if item not in typed(spec, Cia402).transmit and item != ERROR_CODE:
        raise s.get("object").error(
            f"object: {object_name(item)} is not sent by the drive; add it to 'transmit'"
        )
    return item
