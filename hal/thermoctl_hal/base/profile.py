"""Hold a device profile: vendor, model, bus and channels.

A device is described, not programmed. A profile (`format: thermoctl-device/1`) describes the product; a
binding (thermoctl_hal.base.binding) says where the device is on this rig. Every channel has

    reading = raw * scale + offset      in `unit`; outside `range`: error; older than `stale_after_s`: stale

and the place of its raw number on the bus. profiles/buses.py lists the
buses; profiles/read.py reads the files.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Database

T = TypeVar("T")
_TYPES = "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64"
FIELD_TYPES = dict(zip(_TYPES.split(), "bBhHiIqQfd", strict=True))
"""Types of numbers in frames and registers, and their letters in `struct`."""
FRAME_TYPES: dict[str, tuple[str, int]] = {
    **{f"int{8 * n}": ("int", n) for n in range(1, 9)},
    **{f"uint{8 * n}": ("uint", n) for n in range(1, 9)},
    "float32": ("float", 4),
    "float64": ("float", 8),
    **{f"bcd{8 * n}": ("bcd", n) for n in range(1, 9)},
    **{f"hex{n}": ("hex", n) for n in range(1, 17)},
    **{f"digits{n}": ("digits", n) for n in range(1, 17)},
    **{f"skip{n}": ("skip", n) for n in range(1, 65)},
}
"""Types of fields of a binary frame: kind and bytes."""
WORD_BYTES = 2  # size of a Modbus register
NULL_ADDRESS = 0xFE  # source address of J1939 that no sender has


class Object(NamedTuple):
    """An object of CANopen: index and sub-index; a profile writes 0x6041 or 0x30D1:1."""

    number: int  # the index: `index` is a method of every tuple
    sub: int = 0


STATUS_WORD, ERROR_CODE = Object(0x6041), Object(0x603F)
ACTUAL_POSITION = Object(0x6064)
POSITION_MODES = (8,)  # cyclic position, of 0x6060


def object_name(item: Object) -> str:
    """Return an object as a profile writes it: 0x6041, 0x30D1:1."""
    return f"0x{item[0]:04X}" + (f":{item[1]}" if item[1] else "")


@dataclass(frozen=True)
class LineSettings:
    """A serial line. `latency_timer_ms` is for adapters that have one (FTDI); 0 leaves it as it is."""

    baud: int = 115200
    parity: str = "N"
    stop_bits: int = 1
    latency_timer_ms: int = 1
    data_bits: int = 8


@dataclass(frozen=True)
class Bits:
    """A field that is `count` bits of another field, from bit `low` (0: the lowest)."""

    name: str
    of: str
    low: int
    count: int
    signed: bool = False


@dataclass(frozen=True)
class Condition:
    """A condition on a field or register: its bits under `mask` have the value `value`."""

    field: str
    mask: int
    value: int


class BusSpec:
    """The bus's part of a profile; each bus has a class of its own."""

    @property
    def address(self) -> int:
        """Return the address on the bus where a binding gives none."""
        return 0


@dataclass(frozen=True)
class BinaryFrame(BusSpec):
    """sync | payload length (uint8, where has_length) | payload of typed fields | checksum | tail.

    `crc` names the checksum (checksum.py), over the bytes that `crc_over` says. `bits` are fields inside
    fields. `sequence` names a counter field; its gaps are counted as lost frames. `invalid`: a frame is an
    error unless the test holds. `signs`: field -> test for minus. `constants`: field -> its number; other
    frames are ignored. `other_endian`: fields whose byte order is the other one. `request` is sent
    `request_hz` times a second; `answer_s` is the longest time for its answer on a shared line."""

    sync: bytes
    fields: tuple[tuple[str, str], ...]
    endian: str = "<"
    has_length: bool = True
    crc: str = "ccitt-false"
    crc_endian: str = "<"
    crc_over: str = "after-sync"
    tail: bytes = b""
    sequence: str = ""
    invalid: Condition | None = None
    bits: tuple[Bits, ...] = ()
    signs: Mapping[str, Condition] = field(default_factory=dict)
    constants: Mapping[str, int] = field(default_factory=dict)
    other_endian: frozenset[str] = frozenset()
    request: bytes = b""
    request_hz: float = 0.0
    answer_s: float = 0.1

    @property
    def payload_size(self) -> int:
        """Count the bytes of the fields."""
        return sum(FRAME_TYPES[t][1] for _, t in self.fields)

    @property
    def names(self) -> list[str]:
        """Return the names of the fields, then those of the bit fields."""
        return [n for n, _ in self.fields] + [b.name for b in self.bits]


@dataclass(frozen=True)
class TextLine(BusSpec):
    """Lines of text: the named groups of `pattern` are the readings.

    `request` is sent `request_hz` times a second. `decimal` is the decimal sign of the numbers, '.' or ','.
    `end`: bytes that end a line; empty: CR or LF. `checksum`: its name, and the pattern of a line with the
    groups `data` and `sum`."""

    pattern: re.Pattern[str]
    request: bytes = b""
    request_hz: float = 0.0
    decimal: str = "."
    answer_s: float = 0.1
    end: bytes = b""
    checksum: tuple[str, re.Pattern[str]] | None = None


@dataclass(frozen=True)
class TextField:
    """A named group of a text pattern, and the base of the number in it.

    `sign`: the group with the sign. `unit_field`: the group with the unit, of which `unit_factors` gives the
    factor to the channel's unit."""

    group: str
    base: int
    sign: str = ""
    unit_field: str = ""
    unit_factors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Dbc(BusSpec):
    """A CAN device that a DBC file describes."""

    file: Path
    database: Database = field(compare=False)
    # Number of bits by which the device's address is shifted in each identifier; -1: it is no part of it.
    node_shift: int = -1
    faults: Mapping[str, str] = field(default_factory=dict)  # MESSAGE or MESSAGE.SIGNAL -> why it is unusable
    warning: str = ""  # file, line and message of what was read in spite of a fault

    @property
    def address(self) -> int:
        """Return the address where a binding gives none; -1: of any source address."""
        return min(self.node_shift, 0)

    def can_id(self, message: str, address: int) -> int:
        """Return the identifier of a message, with bit 31 for 29 bits."""
        definition = self.database.get_message_by_name(message)
        node = address << self.node_shift if self.node_shift >= 0 else 0
        return definition.frame_id + node | (0x8000_0000 if definition.is_extended_frame else 0)

    def is_j1939(self, message: str, address: int = -1) -> bool:
        """Return whether a message is received by its parameter group.

        This applies to messages of the DBC format J1939PG, and to those of source address 254, which no
        sender has. If the binding gives an `address`, it applies to all messages with identifiers of 29
        bits."""
        definition = self.database.get_message_by_name(message)
        if self.node_shift >= 0 or not definition.is_extended_frame:
            return False
        return definition.protocol == "j1939" or definition.frame_id & 0xFF == NULL_ADDRESS or address >= 0


@dataclass(frozen=True)
class DbcSource:
    """A signal of a message of the DBC file.

    `invalid`: test of another signal of the message that a good reading passes. `sentinels`: raw numbers that
    mean 'no reading'; `absent`: those by which J1939 says 'not available' or 'error'."""

    message: str
    signal: str
    invalid: Condition | None = None
    sentinels: tuple[float, ...] = ()
    absent: range = range(0)


@dataclass(frozen=True)
class Cia402(BusSpec):
    """A CiA-402 drive: EDS file, command object, contents of the PDOs, heartbeats."""

    eds: Path | None  # None: standard objects, and those of `objects`
    node_id: int
    mode: int  # 0x6060 mode of operation: 4 profile torque, 10 cyclic torque, < 0 vendor's
    command: Object  # takes the command
    transmit: tuple[Object, ...]  # contents of TPDO 1; the first is the status word 0x6041
    master_id: int = 0  # our own node id, whose heartbeat the drive watches; 0: 127 - the drive's node id
    heartbeat_s: float = 0.02  # period of our heartbeat, and of the one that the drive is asked for
    watchdog_s: float = 0.1  # the drive stops when our heartbeat is missing for this long
    start_up: tuple[tuple[int, int, int], ...] = ()  # further (index, sub-index, value) written at set-up
    sdo_timeout_s: float = 0.3  # longest time that the drive may take for an answer at set-up
    objects: Mapping[Object, str] = field(default_factory=dict)  # types of objects where there is no EDS file

    @property
    def address(self) -> int:
        """Return the node id."""
        return self.node_id


@dataclass(frozen=True)
class Modbus(BusSpec):
    """A register device that answers within `timeout_s`.

    One request reads registers up to `max_gap` apart, and at most `max_block` of them."""

    unit_id: int
    timeout_s: float = 0.3
    max_gap: int = 8
    max_block: int = 100

    @property
    def address(self) -> int:
        """Return the unit."""
        return self.unit_id


REGISTER_TYPES = {
    **{t: c for t, c in FIELD_TYPES.items() if struct.calcsize(c) >= WORD_BYTES},
    "bcd16": "H",
    "bcd32": "I",
    "bit": "?",
}
"""Types of values in Modbus registers; bit: of coils and discrete inputs."""
BIT_KINDS = ("coil", "discrete")


@dataclass(frozen=True)
class Register:
    """A value in Modbus registers; `sentinels` are raw numbers for 'no reading' (an open thermocouple).

    bits: (lowest, count) of the bits that hold the value, count 0 for all; `signed`: they are a two's
    complement. `invalid`: the register and the test that a good reading passes. `exponent`: the register of a
    whole number n, of a value that counts 10**n (SunSpec)."""

    kind: str
    address: int
    type: str = "int16"
    word_order: str = "big"
    sentinels: tuple[float, ...] = ()
    byte_order: str = "big"
    bits: tuple[int, int] = (0, 0)
    signed: bool = False
    invalid: tuple[Register, Condition] | None = None
    exponent: Register | None = None

    @property
    def words(self) -> int:
        """Count the registers of 16 bits (or the bits) that hold the value."""
        return max(1, struct.calcsize(REGISTER_TYPES[self.type]) // WORD_BYTES)


@dataclass(frozen=True)
class StateOf:
    """How a channel's raw numbers give the amplifier's state; every other number is a fault."""

    channel: str
    enabled: tuple[float, ...]
    disabled: tuple[float, ...]
    quick_stop: tuple[float, ...] = ()


@dataclass(frozen=True)
class CanMessage:
    """A message of the DBC file; a value None is the command, all other signals are 0."""

    name: str
    values: Mapping[str, float | None]


@dataclass(frozen=True)
class RegisterMessage:
    """A Modbus register or coil to write; value None is the command. `function`: 5, 6 or 16."""

    register: Register
    value: float | None
    function: int


@dataclass(frozen=True)
class TextMessage:
    """Bytes with `{command}` and `{address}`, each with an optional format as `{command:+.3f}`."""

    template: bytes


@dataclass(frozen=True)
class FrameMessage:
    """A binary frame; a value None is the command, "address" the device's address."""

    frame: BinaryFrame
    values: tuple[float | str | None, ...]


Message = CanMessage | RegisterMessage | TextMessage | FrameMessage


@dataclass(frozen=True)
class Amplifier:
    """The command that a device takes: counts = drive / scale, the drive clipped to `limits` (in `unit`).

    slew_per_s: largest rate of the command, for drives in a position mode. watchdog_s: the time after which
    the device stops by itself when our messages stop; None: it does not. The rest is for amplifiers that
    messages command. `state` None: the device reports none, and the commanded state is assumed. `fault` names
    a channel that is 0 without a fault."""

    unit: str
    scale: float
    limits: tuple[float, float]
    slew_per_s: float = 0.0
    command: Message | None = None
    command_hz: float = 100.0
    set_up: tuple[Message, ...] = ()
    enable: tuple[Message, ...] = ()
    disable: tuple[Message, ...] = ()
    reset: tuple[Message, ...] = ()
    state: StateOf | None = None
    fault: str = ""
    watchdog_s: float | None = None

    @property
    def counts(self) -> tuple[float, float]:
        """Return `limits` as counts."""
        return self.limits[0] / self.scale, self.limits[1] / self.scale


@dataclass(frozen=True)
class Assumed:
    """The state of an amplifier that cannot report it: the one that was commanded last."""


Source = object
"""Place of a channel's value on its bus, of a type that the bus's driver knows."""


@dataclass(frozen=True)
class Channel:
    """One reading of a device.

    `source` is its place on the bus: frame field, text group, DBC signal, object, register."""

    name: str
    unit: str
    scale: float
    offset: float
    range: tuple[float, float]
    rate_hz: float
    stale_after_s: float
    source: Source
    place: str


@dataclass(frozen=True)
class Profile:
    """A checked device description."""

    vendor: str
    model: str
    bus: str
    channels: Mapping[str, Channel]
    bus_spec: BusSpec
    line: LineSettings
    amplifier: Amplifier | None
    file: str
    manual: str = ""
    edition: str = ""
    place: str = ""

    @property
    def source(self) -> str:
        """Return manual, edition and place as one line; '' where no manual is named."""
        return ", ".join(part for part in (self.manual, self.edition, self.place) if part)

    @property
    def is_cited(self) -> bool:
        """Return whether manual, edition and place are all named."""
        return bool(self.manual and self.edition and self.place)


def typed(value: object, kind: type[T]) -> T:
    """Return `value`, the part of a profile that a driver reads, as the class that its bus has.

    Raises TypeError when a driver was made for a profile of another bus."""
    if not isinstance(value, kind):
        raise TypeError(f"{kind.__name__} was expected, found {type(value).__name__}")
    return value
