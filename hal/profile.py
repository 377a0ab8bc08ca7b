"""A device is described, not programmed: the profile (what the vendor made) and the binding (where it is on this rig).

A profile, `format: thermoctl-device/1`, names vendor, model, bus and channels. Every channel has

    reading = raw * scale + offset      in `unit`; outside `range`: error; older than `stale_after_s`: stale

and says where on its bus the raw number is found. Buses: serial-binary (framed bytes), serial-lines (text), can-dbc
(any DBC file), can-cia402 (a drive with an EDS file), modbus (register map). A binding, one item of `hal.devices`, is
profile, port and which channel plays which role of `hal.backend.ROLES`.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hal.backend import ROLES
from hal.text_number import BASES, DECIMALS, takes_letters
from thermoctl import yamlfile
from thermoctl.yamlfile import InputError, Node, Section, integer_of, kind_of, number_of, suggest

FORMAT = "thermoctl-device/1"
BUSES = ("serial-binary", "serial-lines", "can-dbc", "can-cia402", "modbus")
FIELD_TYPES = {
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
CRCS = ("ccitt-false", "xmodem", "modbus", "none")

# A channel's unit must be convertible to its role's: role suffix -> {unit: (factor, offset)}.
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "um": {"um": (1, 0), "nm": (1e-3, 0), "mm": (1e3, 0), "m": (1e6, 0)},
    "v": {"V": (1, 0), "mV": (1e-3, 0)},
    "a": {"A": (1, 0), "mA": (1e-3, 0)},
    "c": {"degC": (1, 0), "K": (1, -273.15)},
    "": {"1": (1, 0)},
}
# How DBC files write the units above, where they write them otherwise.
_DBC_UNITS = {"°C": "degC", "C": "degC", "deg C": "degC", "Celsius": "degC", "µm": "um", "μm": "um"}
EXCLUSIVE = ("slcan:", "rtu:", "/")
"""What the ports begin with that one program can open once."""


def _must(node: Node | None) -> Node:
    assert node is not None
    return node


@dataclass(frozen=True)
class Channel:
    """One reading of a device. `source` is where its bus has it: field, DBC signal, drive object, register."""

    name: str
    unit: str
    scale: float
    offset: float
    range: tuple[float, float]
    rate_hz: float
    stale_after_s: float
    source: Any
    place: str


@dataclass(frozen=True)
class Drive:
    """The command that a device takes: counts = drive / scale, drive clipped to `limits` (in `unit`)."""

    unit: str
    scale: float
    limits: tuple[float, float]


@dataclass(frozen=True)
class LineSettings:
    """A serial line. `latency_timer_ms` is set where the adapter (FTDI) has one; 0 leaves it."""

    baud: int = 115200
    parity: str = "N"
    stop_bits: int = 1
    latency_timer_ms: int = 1


@dataclass(frozen=True)
class BinaryFrame:
    """sync | payload length (uint8, where has_length) | payload of typed fields | CRC-16 (of what follows sync; crc "none":
    no check at all).

    `sequence` names a counter field (lost frames are counted); `invalid` = (field, mask): any of those bits set marks
    the readings of the frame as errors."""

    sync: bytes
    fields: tuple[tuple[str, str], ...]
    endian: str = "<"
    has_length: bool = True
    crc: str = "ccitt-false"
    crc_endian: str = "<"
    sequence: str = ""
    invalid: tuple[str, int] | None = None

    @property
    def payload(self) -> struct.Struct:
        """How the fields lie in the bytes."""
        return struct.Struct(self.endian + "".join(FIELD_TYPES[t] for _, t in self.fields))


@dataclass(frozen=True)
class TextLine:
    """A line that matches `pattern` gives its named groups as readings; `request` is sent every 1/request_hz. `decimal` is
    the sign between a number's whole part and its decimals."""

    pattern: re.Pattern[str]
    request: bytes = b""
    request_hz: float = 0.0
    decimal: str = "."


@dataclass(frozen=True)
class TextField:
    """A named group of a text pattern, and the base of the number in it."""

    group: str
    base: int


@dataclass(frozen=True)
class Dbc:
    """A CAN device that a DBC file describes."""

    file: Path
    database: Any = field(compare=False)


@dataclass(frozen=True)
class DbcSource:
    """A signal of a message of the DBC file."""

    message: str
    signal: str


Object = tuple[int, int]
"""Index and sub-index in a CANopen object dictionary; a profile writes 0x6041, or 0x30D1:1 for sub-index 1."""
STATUS_WORD, ERROR_CODE = (0x6041, 0), (0x603F, 0)


@dataclass(frozen=True)
class Cia402:
    """A CiA-402 drive: EDS, the object that takes the command, the two PDOs, and the times of both heartbeats."""

    eds: Path
    node_id: int
    mode: int  # 0x6060 mode of operation: 4 profile torque, 10 cyclic torque, < 0 vendor's
    command: Object  # takes the drive
    transmit: tuple[Object, ...]  # of TPDO 1, the first is the status word 0x6041
    master_id: int = 0  # our own node id, whose heartbeat the drive watches; 0: 127 - the drive's node id
    heartbeat_s: float = 0.02  # we send ours and ask the drive for its own this often
    watchdog_s: float = 0.1  # the drive stops when ours is missing for so long
    start_up: tuple[tuple[int, int, int], ...] = ()  # further (index, subindex, value) written at set-up
    sdo_timeout_s: float = 0.3  # how long the drive may take for an answer at set-up


@dataclass(frozen=True)
class Modbus:
    """A register device: answers within `timeout_s`; neighbours are read in one block over gaps <= max_gap."""

    unit_id: int
    timeout_s: float = 0.3
    max_gap: int = 8
    max_block: int = 100


@dataclass(frozen=True)
class Register:
    """A value in Modbus registers. `sentinels` are raw numbers that mean 'no reading' (an open thermocouple)."""

    kind: str
    address: int
    type: str
    word_order: str
    sentinels: tuple[float, ...]

    @property
    def words(self) -> int:
        """Registers of 16 bits that the value takes."""
        return struct.calcsize(FIELD_TYPES[self.type]) // 2


@dataclass(frozen=True)
class Profile:
    """A checked device description; `bus_spec` is one of BinaryFrame, TextLine, Dbc, Cia402, Modbus."""

    vendor: str
    model: str
    bus: str
    channels: Mapping[str, Channel]
    bus_spec: Any
    line: LineSettings
    drive: Drive | None
    file: str


@dataclass(frozen=True)
class Bound:
    """A channel in a role: role value = raw * scale + offset, in the role's unit, allowed inside [low, high]."""

    role: str
    channel: Channel
    scale: float
    offset: float
    low: float
    high: float


@dataclass(frozen=True)
class Binding:
    """One device of this rig: profile + port (+ address where several share a bus) + roles."""

    name: str
    profile: Profile
    port: str
    address: int  # node id or Modbus unit; the profile's where the binding names none
    bounds: tuple[Bound, ...]
    place: str


def load_profile(path: str | Path) -> Profile:
    """Read and check a profile. Raises InputError with file, line and what was expected."""
    top = Section(yamlfile.load(path), "device profile")
    if (found := top.text("format")) != FORMAT:
        raise _must(top.get("format")).error(f"format: '{FORMAT}' was expected, found '{found}'")
    bus = top.text("bus", choices=BUSES)
    folder = Path(path).parent
    spec = _BUS_SPECS[bus](top, folder)
    channels = {name: _channel(name, s, bus, spec) for name, s in top.sections("channels").items()}
    if not channels:
        raise _must(top.get("channels")).error("channels: at least one was expected")
    drive = None
    if (d := top.section("drive", False)) is not None:
        if bus != "can-cia402":
            raise d.node.error(f"drive: a {bus} device cannot take the command; a can-cia402 profile can")
        low, high = d.interval("limits", (math.nan, math.nan))
        if math.isnan(low):
            raise d.node.error("drive: 'limits' is missing: [low, high] that the amplifier may ever be told")
        if not low <= 0.0 <= high:
            raise d.node.error(f"limits: [{low:g}, {high:g}] must contain 0, the safe command")
        drive = Drive(d.text("unit"), d.number("scale", low=1e-12), (low, high))
        d.end()
    line = _line(top)
    profile = Profile(top.text("vendor"), top.text("model"), bus, channels, spec, line, drive, str(path))
    top.text("about", "")
    top.end()
    return profile


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


def _channel(name: str, s: Section, bus: str, spec: Any) -> Channel:
    rate = s.number("rate_hz", low=1e-3, high=1e5)
    stale = s.number("stale_after_s", low=1e-4, high=3600)
    if stale < 1.0 / rate:
        raise _must(s.get("stale_after_s")).error(
            f"stale_after_s: {stale:g} s is shorter than the period of rate_hz "
            f"({1 / rate:g} s): every reading would be stale"
        )
    scale = s.number("scale", 1.0)
    if scale == 0.0:
        raise _must(s.get("scale")).error("scale: 0 makes every reading the same")
    unit = s.text("unit")
    channel = Channel(
        name,
        unit,
        scale,
        s.number("offset", 0.0),
        s.interval("range"),
        rate,
        stale,
        _SOURCES[bus](s, spec),
        s.node.place,
    )
    if isinstance(spec, Dbc):
        _check_dbc_unit(s, spec, channel)
    s.end()
    return channel


def _check_dbc_unit(s: Section, spec: Dbc, channel: Channel) -> None:
    """Raise where the DBC file's unit is not the profile's and no scale converts between them."""
    signal = spec.database.get_message_by_name(channel.source.message).get_signal_by_name(
        channel.source.signal
    )
    theirs = _DBC_UNITS.get(signal.unit or "", signal.unit or "")
    if theirs == channel.unit or abs(channel.scale) != 1.0:
        return
    for units in _UNITS.values():
        if theirs in units and theirs != "1":
            raise _must(s.get("unit")).error(
                f"unit: the DBC file gives {signal.name} in {signal.unit}, the profile says {channel.unit} with scale 1; "
                f"say unit: {theirs}, or the scale from {signal.unit} to {channel.unit}"
            )


def _named(s: Section, key: str, names: Iterable[str]) -> str:
    names = list(names)
    value = s.text(key)
    if value not in names:
        raise _must(s.get(key)).error(
            f"{key}: '{value}' is not one of {', '.join(names)}{suggest(value, names)}"
        )
    return value


def _binary_frame(top: Section, folder: Path) -> BinaryFrame:
    s = top.section("frame")
    assert s is not None
    sync = bytes(integer_of(n, "sync", 0, 255) for n in s.list("sync"))
    if not 1 <= len(sync) <= 8:
        raise _must(s.get("sync")).error(f"sync: 1 to 8 bytes were expected, found {len(sync)}")
    fields: list[tuple[str, str]] = []
    for node in s.list("fields"):
        f = Section(node, "field")
        fields.append((f.text("name"), f.text("type", choices=FIELD_TYPES)))
        f.end()
    names = [n for n, _ in fields]
    if len(set(names)) != len(names) or not 1 <= len(names) <= 64:
        raise _must(s.get("fields")).error("fields: 1 to 64 fields of different names were expected")
    invalid = None
    if (i := s.section("invalid", False)) is not None:
        invalid = (_named(i, "field", names), i.integer("mask", low=1))
        i.end()
    sequence = _named(s, "sequence", names) if s.get("sequence", False) else ""
    order = {"little": "<", "big": ">"}
    if s.get("crc", False) is None:
        raise s.node.error(
            f"frame: 'crc' is missing: one of {', '.join(CRCS)} ('none': frames are not checked)"
        )
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
    if frame.payload.size > 255:
        raise _must(s.get("fields")).error(
            f"fields: {frame.payload.size} bytes; at most 255 fit the length byte"
        )
    s.end()
    return frame


def _text_line(top: Section, folder: Path) -> TextLine:
    s = top.section("text")
    assert s is not None
    node = _must(s.get("pattern"))
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


def _dbc(top: Section, folder: Path) -> Dbc:
    import cantools

    path = folder / top.text("dbc")
    node = _must(top.get("dbc"))
    try:
        return Dbc(path, cantools.database.load_file(str(path), database_format="dbc"))
    except OSError as e:
        raise node.error(f"dbc: {path} cannot be read: {e.strerror}") from None
    except Exception as e:  # cantools raises parse errors of several libraries
        raise node.error(
            f"dbc: {path} is not a DBC file: {(str(e).splitlines() or [type(e).__name__])[0]}"
        ) from None


def _cia402(top: Section, folder: Path) -> Cia402:
    s = top.section("cia402")
    assert s is not None
    eds = folder / s.text("eds")
    if not eds.is_file():
        raise _must(s.get("eds")).error(f"eds: {eds} cannot be read: no such file")
    transmit = tuple(_object(n, "transmit") for n in s.list("transmit"))
    if not transmit or transmit[0] != STATUS_WORD:
        raise _must(s.get("transmit")).error(
            "transmit: the objects of TPDO 1, the status word '0x6041' first"
        )
    start_up = []
    for node in s.list("start_up", False):
        w = Section(node, "start_up")
        start_up.append(
            (
                w.integer("index", low=0x1000, high=0xFFFF),
                w.integer("sub", 0, 0, 255),
                w.integer("value", low=-(2**31)),
            )
        )
        w.end()
    spec = Cia402(
        eds,
        s.integer("node_id", 1, 1, 126),
        s.integer("mode", low=-128, high=127),
        _object(_must(s.get("command")), "command"),
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


def _modbus(top: Section, folder: Path) -> Modbus:
    s = top.section("modbus")
    assert s is not None
    spec = Modbus(
        s.integer("unit_id", 1, 0, 247),
        s.number("timeout_s", 0.3, 0.01, 10),
        s.integer("max_gap", 8, 0, 100),
        s.integer("max_block", 100, 1, 125),
    )
    s.end()
    return spec


def _dbc_source(s: Section, spec: Dbc) -> DbcSource:
    message = _named(s, "message", [m.name for m in spec.database.messages])
    return DbcSource(
        message, _named(s, "signal", [x.name for x in spec.database.get_message_by_name(message).signals])
    )


def _object(node: Node, key: str) -> Object:
    """An object: 0x6041, or 0x30D1:1 with the sub-index (decimal, or 0x.. in hexadecimal)."""
    found = re.fullmatch(r"(0x[0-9A-Fa-f]{4})(?::(0x[0-9A-Fa-f]{1,2}|\d{1,3}))?", str(node.value))
    if found is None and isinstance(node.value, int) and not isinstance(node.value, bool):
        return integer_of(node, key, 0x1000, 0xFFFF), 0
    index, sub = (
        (int(found[1], 16), int(found[2] or "0", 0 if "x" in (found[2] or "") else 10)) if found else (0, 0)
    )
    if not 0x1000 <= index <= 0xFFFF or sub > 255:
        raise node.error(
            f"{key}: an object as 0x6041, or 0x30D1:1 with its sub-index, was expected, found {kind_of(node)}"
        )
    return index, sub


def object_name(item: Object) -> str:
    """An object as a profile writes it: 0x6041, 0x30D1:1."""
    return f"0x{item[0]:04X}" + (f":{item[1]}" if item[1] else "")


def _cia402_source(s: Section, spec: Cia402) -> Object:
    item = _object(_must(s.get("object")), "object")
    if item not in spec.transmit and item != ERROR_CODE:
        raise _must(s.get("object")).error(
            f"object: {object_name(item)} is not sent by the drive; add it to 'transmit'"
        )
    return item


def _text_field(s: Section, spec: TextLine) -> TextField:
    group = _named(s, "field", spec.pattern.groupindex)
    base = s.integer("base", 10)
    if base not in BASES:
        raise _must(s.get("base")).error(f"base: {base} is not one of {', '.join(map(str, BASES))}")
    if s.get("base", False) is None and takes_letters(spec.pattern, group):
        raise s.node.error(
            f"{s.what}: group '{group}' of the pattern also takes the letters A to F: say base: 16, or base: 10"
        )
    return TextField(group, base)


def _register(s: Section, spec: Modbus) -> Register:
    types = [t for t, c in FIELD_TYPES.items() if struct.calcsize(c) >= 2]
    source = Register(
        s.text("kind", "input", ("input", "holding")),
        s.integer("register", high=65535),
        s.text("type", "int16", types),
        s.text("word_order", "big", ("big", "little")),
        tuple(number_of(n, "sentinels") for n in s.list("sentinels", False)),
    )
    if source.address + source.words > 65536 or source.words > spec.max_block:
        raise s.node.error(f"register: {source.words} registers from {source.address} do not fit")
    return source


_BUS_SPECS: dict[str, Any] = {
    "serial-binary": _binary_frame,
    "serial-lines": _text_line,
    "can-dbc": _dbc,
    "can-cia402": _cia402,
    "modbus": _modbus,
}
_SOURCES: dict[str, Any] = {
    "serial-binary": lambda s, spec: _named(s, "field", [n for n, _ in spec.fields]),
    "serial-lines": _text_field,
    "can-dbc": _dbc_source,
    "can-cia402": _cia402_source,
    "modbus": _register,
}


def resolve_port(port: str, folder: Path) -> str:
    """A port whose path is relative ('../run/encoder', 'slcan:./can') with that path taken from `folder`."""
    match = re.fullmatch(r"((?:slcan:|rtu:)?)(\.\.?/.*)", port)
    if match is None:
        return port
    path = Path(match[2])  # the last part may be a link: it is the link that is meant
    return f"{match[1]}{(folder / path.parent).resolve() / path.name}"


def bind(node: Node, folder: Path) -> Binding:
    """One item of `hal.devices`: {profile, port, roles: {channel: role}, name?, address?, stale_after_s?, watchdog_s?,
    master_id?}; `profile` is relative to `folder`. stale_after_s and watchdog_s replace the profile's on a machine that
    cannot keep them, master_id where another device of the bus has that id. Raises InputError: unknown channel, unknown
    role, unit that does not fit the role."""
    s = Section(node, "device")
    profile_node = _must(s.get("profile"))
    path = folder / s.text("profile")
    if not path.is_file():
        raise profile_node.error(f"profile: {path} cannot be read: no such file")
    profile = load_profile(path)
    if (stale := s.number("stale_after_s", 0.0, 1e-4, 3600.0)) > 0.0:
        profile = replace(
            profile, channels={n: replace(c, stale_after_s=stale) for n, c in profile.channels.items()}
        )
    if (watchdog := s.get("watchdog_s", False)) is not None:
        if profile.bus != "can-cia402":
            raise watchdog.error(f"watchdog_s: a {profile.bus} device has none")
        profile = replace(
            profile,
            bus_spec=replace(
                profile.bus_spec,
                watchdog_s=s.number("watchdog_s", 0.0, 2 * profile.bus_spec.heartbeat_s, 10.0),
            ),
        )
    bounds = []
    for name, role in Section(_must(s.get("roles")), "roles").node.value.items():
        if name not in profile.channels:
            raise role.error(
                f"roles: {profile.model} has no channel '{name}'{suggest(name, profile.channels)}; "
                f"it has {', '.join(profile.channels)}"
            )
        if role.value not in ROLES:
            raise role.error(
                f"roles: '{role.value}' is no role{suggest(role.value, ROLES)}; roles: {', '.join(ROLES)}"
            )
        bounds.append(_bound(role, profile.channels[name]))
    default = getattr(profile.bus_spec, "node_id", getattr(profile.bus_spec, "unit_id", 0))
    low, high = (1, 126) if profile.bus == "can-cia402" else (0, 247)
    address = s.integer("address", default, low, high)
    if profile.bus == "can-cia402":
        profile = replace(profile, bus_spec=_with_master(s, profile.bus_spec, address))
    elif (master := s.get("master_id", False)) is not None:
        raise master.error(f"master_id: a {profile.bus} device has none")
    binding = Binding(
        s.text("name", profile.model),
        profile,
        resolve_port(s.text("port"), folder),
        address,
        tuple(bounds),
        node.place,
    )
    s.end()
    return binding


def _with_master(s: Section, spec: Cia402, node: int) -> Cia402:
    """The drive's description with our own node id: the binding's, else the profile's, else 127 - the drive's."""
    master = s.integer("master_id", spec.master_id or 127 - node, 1, 127)
    if master == node:
        raise s.node.error(
            f"master_id: {master} is the drive's own node id; the drive would watch itself: choose one that is free on the bus"
        )
    return replace(spec, master_id=master)


def role_units(role: str) -> dict[str, tuple[float, float]]:
    """Units that convert to a role's own: unit -> (factor, offset)."""
    return _UNITS.get(role.rsplit("_", 1)[-1], _UNITS[""])


def _bound(role: Node, channel: Channel) -> Bound:
    units = role_units(role.value)
    if channel.unit not in units:
        raise role.error(
            f"roles: channel '{channel.name}' is in {channel.unit}, the role {role.value} takes "
            f"{' or '.join(units)}"
        )
    factor, shift = units[channel.unit]
    return Bound(
        role.value,
        channel,
        channel.scale * factor,
        channel.offset * factor + shift,
        channel.range[0] * factor + shift,
        channel.range[1] * factor + shift,
    )


def check_rig(bindings: Iterable[Binding]) -> None:
    """Raise InputError where two devices claim one role, two would drive, or two open a port that only one can."""
    claimed: dict[str, Binding] = {}
    opened: dict[str, Binding] = {}
    for b in bindings:
        if (first := opened.setdefault(_exclusive_port(b), b)) is not b and b.port.startswith(EXCLUSIVE):
            raise InputError(
                f"{b.place}: {b.name} and {first.name} ({first.place}) both open {b.port}, which one device can open once; "
                "give each an adapter of its own, or read both as channels of one profile"
            )
        for role in [x.role for x in b.bounds] + (["drive"] if b.profile.drive else []):
            if role in claimed:
                raise InputError(
                    f"{b.place}: '{role}' is given by {b.name} and by {claimed[role].name} "
                    f"({claimed[role].place}); keep one of them"
                )
            claimed[role] = b


def _exclusive_port(b: Binding) -> str:
    """The port without interface and bitrate, links followed: what two devices may not share."""
    if not b.port.startswith(EXCLUSIVE):
        return b.port
    return os.path.realpath(re.sub(r"^(slcan|rtu):|@\d+$", "", b.port))


def rig_notes(bindings: Iterable[Binding]) -> list[str]:
    """What is allowed and yet probably meant otherwise, a line each (for `thermoctl check`)."""
    notes = []
    bindings = list(bindings)
    if not any(b.profile.drive for b in bindings):
        notes.append(
            "no device takes the command (a can-cia402 profile with 'drive'): this rig measures, it cannot be driven"
        )
    for b in bindings:
        for x in b.bounds:
            if isinstance(x.channel.source, Register) and (hint := register_hint(x.channel.source.address)):
                notes.append(f"{x.channel.place}: register {x.channel.source.address}: {hint}")
    return notes


def register_hint(address: int) -> str:
    """What a manual means by such a register number, where it counts from 30001 or 40001; '' elsewhere."""
    for base, kind in ((30001, "input"), (40001, "holding")):
        if base <= address < base + 9999:
            return f"addresses count from 0; where the manual calls it {address}, it is kind: {kind}, register: {address - base}"
    return ""
