"""Hold a device profile: vendor, model, bus and channels.

A device is described, not programmed. A profile (`format: thermoctl-device/1`) describes the product; a
binding (hal.binding) says where the device is on this rig. Every channel has

    reading = raw * scale + offset      in `unit`; outside `range`: error; older than `stale_after_s`: stale

and the place of its raw number on the bus. Buses: serial-binary (framed bytes), serial-lines (text), can-dbc
(any DBC file), can-cia402 (a drive with an EDS file), modbus (register map). hal.read_profile reads the
files.
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
"""Types of numbers in frames and registers, and their letters in `struct`."""
CRCS = ("ccitt-false", "xmodem", "modbus", "none")
WORD_BYTES = 2  # of a Modbus register


class Object(NamedTuple):
    """An object of CANopen: index and sub-index; a profile writes 0x6041 or 0x30D1:1."""

    number: int  # the index: `index` is a method of every tuple
    sub: int = 0


STATUS_WORD, ERROR_CODE = Object(0x6041), Object(0x603F)


def object_name(item: Object) -> str:
    """Return an object as a profile writes it: 0x6041, 0x30D1:1."""
    return f"0x{item[0]:04X}" + (f":{item[1]}" if item[1] else "")


@dataclass(frozen=True)
class Amplifier:
    """The command that a device takes: counts = drive / scale, the drive clipped to `limits` (in `unit`)."""

    unit: str
    scale: float
    limits: tuple[float, float]


@dataclass(frozen=True)
class LineSettings:
    """A serial line. `latency_timer_ms` is for adapters that have one (FTDI); 0 leaves it as it is."""

    baud: int = 115200
    parity: str = "N"
    stop_bits: int = 1
    latency_timer_ms: int = 1


@dataclass(frozen=True)
class BinaryFrame:
    """sync | payload length (uint8, where has_length) | payload of typed fields | CRC-16 of all after sync.

    `crc` "none": the frame has no CRC. `sequence` names a counter field; its gaps are counted as lost frames.
    `invalid` = (field, mask): a set bit of the mask makes every reading of the frame an error."""

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
        """Return the layout of the fields in the payload."""
        return struct.Struct(self.endian + "".join(FIELD_TYPES[t] for _, t in self.fields))


@dataclass(frozen=True)
class TextLine:
    """Lines of text: the named groups of `pattern` are the readings.

    `request` is sent `request_hz` times a second. `decimal` is the decimal sign of the numbers, '.' or
    ','."""

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
    database: Database = field(compare=False)


@dataclass(frozen=True)
class DbcSource:
    """A signal of a message of the DBC file."""

    message: str
    signal: str


@dataclass(frozen=True)
class Cia402:
    """A CiA-402 drive: EDS file, command object, contents of the PDOs, heartbeats."""

    eds: Path
    node_id: int
    mode: int  # 0x6060 mode of operation: 4 profile torque, 10 cyclic torque, < 0 vendor's
    command: Object  # takes the command
    transmit: tuple[Object, ...]  # contents of TPDO 1; the first is the status word 0x6041
    master_id: int = 0  # our own node id, whose heartbeat the drive watches; 0: 127 - the drive's node id
    heartbeat_s: float = 0.02  # period of our heartbeat, and of the one that the drive is asked for
    watchdog_s: float = 0.1  # the drive stops when our heartbeat is missing for this long
    start_up: tuple[tuple[int, int, int], ...] = ()  # further (index, sub-index, value) written at set-up
    sdo_timeout_s: float = 0.3  # longest time that the drive may take for an answer at set-up


@dataclass(frozen=True)
class Modbus:
    """A register device that answers within `timeout_s`.

    One request reads registers up to `max_gap` apart, and at most `max_block` of them."""

    unit_id: int
    timeout_s: float = 0.3
    max_gap: int = 8
    max_block: int = 100


@dataclass(frozen=True)
class Register:
    """A value in Modbus registers; `sentinels` are raw numbers for 'no reading' (an open thermocouple)."""

    kind: str
    address: int
    type: str
    word_order: str
    sentinels: tuple[float, ...]

    @property
    def words(self) -> int:
        """Count the registers of 16 bits that hold the value."""
        return struct.calcsize(FIELD_TYPES[self.type]) // WORD_BYTES


BusSpec = BinaryFrame | TextLine | Dbc | Cia402 | Modbus
Source = str | TextField | DbcSource | Object | Register


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


def typed(value: object, kind: type[T]) -> T:
    """Return `value`, the part of a profile that a driver reads, as the class that its bus has.

    Raises TypeError when a driver was made for a profile of another bus."""
    if not isinstance(value, kind):
        raise TypeError(f"{kind.__name__} was expected, found {type(value).__name__}")
    return value
