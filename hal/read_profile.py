"""Read and check a device profile: `load_profile`, and two readers for each bus."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable
from pathlib import Path

from hal.profile import (
    CRCS,
    ERROR_CODE,
    FIELD_TYPES,
    STATUS_WORD,
    WORD_BYTES,
    Amplifier,
    BinaryFrame,
    BusSpec,
    Channel,
    Cia402,
    Dbc,
    DbcSource,
    LineSettings,
    Modbus,
    Object,
    Profile,
    Register,
    Source,
    TextField,
    TextLine,
    object_name,
    typed,
)
from hal.text_number import BASES, DECIMALS, takes_letters
from hal.units import dbc_unit, is_convertible
from thermoctl import yamlfile
from thermoctl.yamlfile import Node, Section, integer_of, kind_of, number_of, suggest

FORMAT = "thermoctl-device/1"
# limits of wire.Framer: sync bytes, fields, payload bytes (a uint8 length)
MAX_SYNC, MAX_FIELDS, MAX_PAYLOAD = 8, 64, 255
REGISTERS = 65536  # addresses of a Modbus unit
MAX_SUB_INDEX = 255


def load_profile(path: str | Path) -> Profile:
    """Read and check a profile. Raises InputError with file, line and what was expected."""
    top = Section(yamlfile.load(path), "device profile")
    if (found := top.text("format")) != FORMAT:
        raise top.get("format").error(f"format: '{FORMAT}' was expected, found '{found}'")
    bus = top.text("bus", choices=_BUSES)
    read_spec, read_source = _BUSES[bus]
    spec = read_spec(top, Path(path).parent)
    channels = {name: _channel(name, s, spec, read_source) for name, s in top.sections("channels").items()}
    if not channels:
        raise top.get("channels").error("channels: at least one was expected")
    amplifier, line = _amplifier(top, bus), _line(top)
    profile = Profile(top.text("vendor"), top.text("model"), bus, channels, spec, line, amplifier, str(path))
    top.text("about", "")
    top.end()
    return profile


def _amplifier(top: Section, bus: str) -> Amplifier | None:
    s = top.section("drive", False)
    if s is None:
        return None
    if bus != "can-cia402":
        raise s.node.error(f"drive: a {bus} device cannot take the command; a can-cia402 profile can")
    if s.get("limits", False) is None:
        raise s.node.error("drive: 'limits' is missing: [low, high], the largest commands ever sent")
    low, high = s.interval("limits")
    if not low <= 0.0 <= high:
        raise s.node.error(f"limits: [{low:g}, {high:g}] must contain 0, the safe command")
    amplifier = Amplifier(s.text("unit"), s.number("scale", low=1e-12), (low, high))
    s.end()
    return amplifier


def _line(top: Section) -> LineSettings:
    s = top.section("line", False)
    if s is None:
        return LineSettings()
    line = LineSettings(
        s.integer("baud", 115200, 50, 20_000_000),
        s.text("parity", "N", "NEO"),
        s.integer("stop_bits", 1, 1, 2),
        s.integer("latency_timer_ms", 1, 0, 255),
    )
    s.end()
    return line


def _channel(name: str, s: Section, spec: BusSpec, read_source: _ReadSource) -> Channel:
    rate = s.number("rate_hz", low=1e-3, high=1e5)
    stale = s.number("stale_after_s", low=1e-4, high=3600)
    if stale < 1.0 / rate:
        raise s.get("stale_after_s").error(
            f"stale_after_s: {stale:g} s is shorter than the period of rate_hz "
            f"({1 / rate:g} s): every reading would be stale"
        )
    scale = s.number("scale", 1.0)
    if scale == 0.0:
        raise s.get("scale").error("scale: 0 makes every reading the same")
    channel = Channel(
        name,
        s.text("unit"),
        scale,
        s.number("offset", 0.0),
        s.interval("range"),
        rate,
        stale,
        read_source(s, spec),
        s.node.place,
    )
    if isinstance(spec, Dbc):
        _check_dbc_unit(s, spec, channel)
    s.end()
    return channel


def _check_dbc_unit(s: Section, spec: Dbc, channel: Channel) -> None:
    """Raise where the DBC file's unit is not the profile's and no scale converts between them."""
    source = typed(channel.source, DbcSource)
    signal = spec.database.get_message_by_name(source.message).get_signal_by_name(source.signal)
    theirs = dbc_unit(signal.unit)
    if theirs != channel.unit and abs(channel.scale) == 1.0 and is_convertible(theirs):
        raise s.get("unit").error(
            f"unit: the DBC file gives {signal.name} in {signal.unit}, the profile says {channel.unit} "
            f"with scale 1; say unit: {theirs}, or the scale from {signal.unit} to {channel.unit}"
        )


def _named(s: Section, key: str, names: Iterable[str]) -> str:
    names = list(names)
    value = s.text(key)
    if value not in names:
        raise s.get(key).error(f"{key}: '{value}' is not one of {', '.join(names)}{suggest(value, names)}")
    return value


def _binary_frame(top: Section, folder: Path) -> BinaryFrame:
    s = top.section("frame")
    sync = bytes(integer_of(n, "sync", 0, 255) for n in s.list("sync"))
    if not 1 <= len(sync) <= MAX_SYNC:
        raise s.get("sync").error(f"sync: 1 to {MAX_SYNC} bytes were expected, found {len(sync)}")
    fields: list[tuple[str, str]] = []
    for node in s.list("fields"):
        f = Section(node, "field")
        fields.append((f.text("name"), f.text("type", choices=FIELD_TYPES)))
        f.end()
    names = [n for n, _ in fields]
    if len(set(names)) != len(names) or not 1 <= len(names) <= MAX_FIELDS:
        raise s.get("fields").error(f"fields: 1 to {MAX_FIELDS} fields of different names were expected")
    invalid = None
    if (i := s.section("invalid", False)) is not None:
        invalid = (_named(i, "field", names), i.integer("mask", low=1))
        i.end()
    sequence = _named(s, "sequence", names) if s.get("sequence", False) else ""
    order = {"little": "<", "big": ">"}
    if s.get("crc", False) is None:
        raise s.node.error(f"frame: 'crc' is missing: one of {', '.join(CRCS)} ('none': frames have no CRC)")
    frame = BinaryFrame(
        sync,
        tuple(fields),
        order[s.text("endian", "little", order)],
        s.flag("length", True),
        s.text("crc", choices=CRCS),
        order[s.text("crc_endian", "little", order)],
        sequence,
        invalid,
    )
    if frame.payload.size > MAX_PAYLOAD:
        raise s.get("fields").error(
            f"fields: {frame.payload.size} bytes; at most {MAX_PAYLOAD} fit the length byte"
        )
    s.end()
    return frame


def _frame_field(s: Section, spec: BusSpec) -> str:
    return _named(s, "field", [n for n, _ in typed(spec, BinaryFrame).fields])


def _text_line(top: Section, folder: Path) -> TextLine:
    s = top.section("text")
    node = s.get("pattern")
    try:
        pattern = re.compile(s.text("pattern"), re.ASCII)
    except re.error as e:
        raise node.error(f"pattern: not a regular expression: {e}") from None
    if not pattern.groupindex:
        raise node.error("pattern: named groups (?P<name>...) were expected, one for each reading")
    request = s.text("request", "").encode("ascii", "replace").decode("unicode_escape").encode("latin-1")
    spec = TextLine(
        pattern, request, s.number("request_hz", 0.0, 0, 1000), s.text("decimal", ".", choices=DECIMALS)
    )
    if bool(spec.request) != (spec.request_hz > 0):
        raise s.node.error("text: 'request' and 'request_hz' belong together")
    s.end()
    return spec


def _text_field(s: Section, spec: BusSpec) -> TextField:
    pattern = typed(spec, TextLine).pattern
    group = _named(s, "field", pattern.groupindex)
    base = s.integer("base", 10)
    if base not in BASES:
        raise s.get("base").error(f"base: {base} is not one of {', '.join(map(str, BASES))}")
    if s.get("base", False) is None and takes_letters(pattern, group):
        raise s.node.error(
            f"{s.what}: group '{group}' of the pattern also takes the letters A to F: "
            "say base: 16, or base: 10"
        )
    return TextField(group, base)


def _dbc(top: Section, folder: Path) -> Dbc:
    import cantools  # takes a second; only DBC profiles need it

    path = folder / top.text("dbc")
    node = top.get("dbc")
    try:
        database = cantools.database.load_file(str(path), database_format="dbc")
    except OSError as e:
        raise node.error(f"dbc: {path} cannot be read: {e.strerror}") from None
    except Exception as e:  # cantools raises parse errors of several libraries
        reason = (str(e).splitlines() or [type(e).__name__])[0]
        raise node.error(f"dbc: {path} is not a DBC file: {reason}") from None
    return Dbc(path, typed(database, cantools.database.can.Database))


def _dbc_source(s: Section, spec: BusSpec) -> DbcSource:
    database = typed(spec, Dbc).database
    message = _named(s, "message", [m.name for m in database.messages])
    signals = database.get_message_by_name(message).signals
    return DbcSource(message, _named(s, "signal", [x.name for x in signals]))


def _cia402(top: Section, folder: Path) -> Cia402:
    s = top.section("cia402")
    eds = folder / s.text("eds")
    if not eds.is_file():
        raise s.get("eds").error(f"eds: {eds} cannot be read: no such file")
    transmit = tuple(_object(n, "transmit") for n in s.list("transmit"))
    if not transmit or transmit[0] != STATUS_WORD:
        raise s.get("transmit").error("transmit: the objects of TPDO 1, the status word '0x6041' first")
    start_up = []
    for node in s.list("start_up", False):
        w = Section(node, "start_up")
        index, sub = w.integer("index", low=0x1000, high=0xFFFF), w.integer("sub", 0, 0, MAX_SUB_INDEX)
        start_up.append((index, sub, w.integer("value", low=-(2**31))))
        w.end()
    spec = Cia402(
        eds,
        s.integer("node_id", 1, 1, 126),
        s.integer("mode", low=-128, high=127),
        _object(s.get("command"), "command"),
        transmit,
        s.integer("master_id", 0, 1, 127),
        s.number("heartbeat_s", 0.02, 1e-3, 1),
        s.number("watchdog_s", 0.1, 2e-3, 10),
        tuple(start_up),
        s.number("sdo_timeout_s", 0.3, 0.01, 10),
    )
    if spec.watchdog_s < 2 * spec.heartbeat_s:
        raise s.node.error(
            f"watchdog_s: {spec.watchdog_s:g} s is below two heartbeats of {spec.heartbeat_s:g} s: "
            "the drive would stop by itself"
        )
    s.end()
    return spec


def _object(node: Node, key: str) -> Object:
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


def _cia402_source(s: Section, spec: BusSpec) -> Object:
    item = _object(s.get("object"), "object")
    if item not in typed(spec, Cia402).transmit and item != ERROR_CODE:
        raise s.get("object").error(
            f"object: {object_name(item)} is not sent by the drive; add it to 'transmit'"
        )
    return item


def _modbus(top: Section, folder: Path) -> Modbus:
    s = top.section("modbus")
    spec = Modbus(
        s.integer("unit_id", 1, 0, 247),
        s.number("timeout_s", 0.3, 0.01, 10),
        s.integer("max_gap", 8, 0, 100),
        s.integer("max_block", 100, 1, 125),
    )
    s.end()
    return spec


def _register(s: Section, spec: BusSpec) -> Register:
    types = [t for t, c in FIELD_TYPES.items() if struct.calcsize(c) >= WORD_BYTES]
    source = Register(
        s.text("kind", "input", ("input", "holding")),
        s.integer("register", high=REGISTERS - 1),
        s.text("type", "int16", types),
        s.text("word_order", "big", ("big", "little")),
        tuple(number_of(n, "sentinels") for n in s.list("sentinels", False)),
    )
    if source.address + source.words > REGISTERS or source.words > typed(spec, Modbus).max_block:
        raise s.node.error(f"register: {source.words} registers from {source.address} do not fit")
    return source


_ReadSource = Callable[[Section, BusSpec], Source]
_BUSES: dict[str, tuple[Callable[[Section, Path], BusSpec], _ReadSource]] = {
    "serial-binary": (_binary_frame, _frame_field),
    "serial-lines": (_text_line, _text_field),
    "can-dbc": (_dbc, _dbc_source),
    "can-cia402": (_cia402, _cia402_source),
    "modbus": (_modbus, _register),
}
"""Bus -> (reader of its section of a profile, reader of the keys that locate a channel's value)."""
