"""Simulate a CiA-402 drive and a Lawicel adapter at byte level. Pure: frames and time in, frames out.

The drive has its own object dictionary, an expedited SDO server, an NMT slave, a heartbeat producer and
consumer, and the CiA-402 state machine. SYNC triggers its PDOs, whose mapping the master writes. When the
master's heartbeat (0x1016) is missing it stops by itself: error 0x8130, fault state, pre-operational.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field

from thermoctl_hal.base.wire import EXTENDED, encode_slcan

NOT_READY, DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x08
BOOT, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
HEARTBEAT_LOST = 0x8130
ABORT_NO_OBJECT, ABORT_NO_SUB, ABORT_READ_ONLY = 0x06020000, 0x06090011, 0x06010002
ABORT_LENGTH, ABORT_COMMAND, ABORT_VALUE = 0x06070010, 0x05040001, 0x06090030
Frame = tuple[int, bytes]


@dataclass
class Entry:
    """An object: struct letter, value, and whether the master may write it."""

    type: str
    value: int = 0
    writable: bool = False


def _dictionary(node: int) -> dict[tuple[int, int], Entry]:
    od = {
        (0x1000, 0): Entry("I", 0x00020192),
        (0x1001, 0): Entry("B"),
        (0x1016, 0): Entry("B", 1),
        (0x1016, 1): Entry("I", 0, True),
        (0x1017, 0): Entry("H", 0, True),
        (0x1018, 0): Entry("B", 4),
        (0x1018, 1): Entry("I", 0),
        (0x1018, 2): Entry("I", 0x74),
        (0x1018, 3): Entry("I", 1),
        (0x1018, 4): Entry("I", 1),
        (0x603F, 0): Entry("H"),
        (0x6040, 0): Entry("H", 0, True),
        (0x6041, 0): Entry("H", DISABLED),
        (0x6060, 0): Entry("b", 0, True),
        (0x6061, 0): Entry("b", 0),
        (0x6071, 0): Entry("h", 0, True),
        (0x6075, 0): Entry("I", 2000, True),
        (0x6077, 0): Entry("h"),
        (0x6078, 0): Entry("h"),
        (0x6079, 0): Entry("I", 24000),
        (0x6064, 0): Entry("i"),
        (0x607A, 0): Entry("i", 0, True),
        (0x2071, 0): Entry("i", 0, True),
        (0x2078, 0): Entry("i"),
    }
    for communication, mapping, cob in ((0x1400, 0x1600, 0x200), (0x1800, 0x1A00, 0x180)):
        od |= {
            (communication, 0): Entry("B", 2),
            (communication, 1): Entry("I", 0x8000_0000 | cob + node, True),
            (communication, 2): Entry("B", 1, True),
            (mapping, 0): Entry("B", 0, True),
        }
        od |= {(mapping, i): Entry("I", 0, True) for i in range(1, 9)}
    return od


@dataclass
class Cia402Drive:
    """The drive. The rig sets readings in `od[index, 0].value` and takes `command` (counts of the target).

    `command_object` is the target object (0x2071, 0x6071 or 0x607A). With `alive` False the drive has no
    power and is mute. With `heartbeat` False it sends no heartbeat. Its stop input is active until
    `stop_until_s`."""

    node: int
    command_object: int = 0x2071
    alive: bool = True
    heartbeat: bool = True
    stop_until_s: float = -math.inf
    od: dict[tuple[int, int], Entry] = field(init=False)
    state: int = DISABLED
    nmt: int = PRE_OPERATIONAL
    _control: int = 0
    _stopping: bool = False
    _master_seen_s: float | None = None
    _beat_s: float = -math.inf
    _out: list[Frame] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.od = _dictionary(self.node)
        self.power_up()

    def power_up(self) -> None:
        """Start as after power-on: default objects, boot-up message, pre-operational."""
        readings = {k: self.od[k, 0].value for k in (0x6064, 0x6078, 0x6079, 0x2078)}
        self.od = _dictionary(self.node)
        for k, value in readings.items():
            self.od[k, 0].value = value
        self.state, self.nmt, self._control, self._master_seen_s = DISABLED, PRE_OPERATIONAL, 0, None
        self._out.append((0x700 + self.node, b"\x00"))

    @property
    def command(self) -> int:
        """Counts of the target object while the drive is enabled, else 0."""
        return self.od[self.command_object, 0].value if self.state == ENABLED else 0

    def fault(self, code: int) -> None:
        """Enter the fault state with this error code (0x603F) and send the emergency."""
        self.state = FAULT
        self.od[0x603F, 0].value, self.od[0x1001, 0].value = code, 1
        self._emergency(code)

    def _emergency(self, code: int) -> None:
        self._out.append((0x080 + self.node, struct.pack("<HB5x", code, self.od[0x1001, 0].value)))

    def take(self, frame: Frame, now_s: float) -> None:
        """Take one frame from the bus."""
        can_id, data = frame
        if not self.alive:
            return
        self._watch_stop(now_s)
        if can_id == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._command_nmt(data[0])
        elif can_id == 0x080:
            if self.nmt == OPERATIONAL:
                self._transmit()
        elif can_id == 0x600 + self.node and len(data) == 8 and self.nmt != STOPPED:
            self._out.append((0x580 + self.node, self._sdo(data)))
        elif can_id == 0x200 + self.node and self.nmt == OPERATIONAL:
            self._receive(data)
        elif 0x700 < can_id < 0x780 and can_id - 0x700 == self.od[0x1016, 1].value >> 16 & 0x7F:
            self._master_seen_s = now_s

    def tick(self, now_s: float) -> list[Frame]:
        """Watch the master's heartbeat; return the messages of the drive since the last call."""
        if not self.alive:
            self._out.clear()
            return []
        self._watch_stop(now_s)
        limit_s = (self.od[0x1016, 1].value & 0xFFFF) / 1000
        if limit_s and self._master_seen_s is not None and now_s - self._master_seen_s > limit_s:
            self._master_seen_s = None
            self.nmt = PRE_OPERATIONAL
            self.fault(HEARTBEAT_LOST)
        period_s = self.od[0x1017, 0].value / 1000
        if period_s and self.heartbeat and now_s - self._beat_s >= period_s:
            self._beat_s = now_s
            self._out.append((0x700 + self.node, bytes([self.nmt])))
        out, self._out = self._out, []
        return out

    def _watch_stop(self, now_s: float) -> None:
        """Obey the stop input: it causes a quick stop, and prevents 'operation enabled' while active."""
        self._stopping = now_s < self.stop_until_s
        if self._stopping and self.state == ENABLED:
            self.state = QUICK_STOP

    def _command_nmt(self, command: int) -> None:
        if command in (0x81, 0x82):
            self.power_up()
        elif command in (0x01, 0x02, 0x80):
            self.nmt = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}[command]
            if self.nmt != OPERATIONAL and self.state in (SWITCHED_ON, ENABLED, READY):
                self.state = DISABLED

    def _step_state(self, word: int) -> None:
        """Take the transition of the CiA-402 table for a control word."""
        rising, self._control = word & ~self._control, word
        if self.state == FAULT:
            if rising & 0x80:
                self.state = DISABLED
                self.od[0x603F, 0].value = self.od[0x1001, 0].value = 0
                self._emergency(0)
        elif not word & 0x02:  # disable voltage
            self.state = DISABLED
        elif not word & 0x04:  # quick stop
            self.state = QUICK_STOP if self.state == ENABLED else DISABLED
        elif word & 0x07 == 0x06:  # shutdown
            if self.state in (DISABLED, READY, SWITCHED_ON, ENABLED):
                self.state = READY
        elif word & 0x0F == 0x07:  # switch on / disable operation
            if self.state in (READY, ENABLED, SWITCHED_ON):
                self.state = SWITCHED_ON
        elif word & 0x0F == 0x0F and self.state in (SWITCHED_ON, ENABLED) and not self._stopping:
            self.state = ENABLED

    def _mapped(self, mapping: int) -> list[tuple[int, int]]:
        count = self.od[mapping, 0].value
        entries = [self.od[mapping, i].value for i in range(1, count + 1)]
        return [(e >> 16, e >> 8 & 0xFF) for e in entries]

    def _receive(self, data: bytes) -> None:
        if self.od[0x1400, 1].value & 0x8000_0000:
            return
        keys = self._mapped(0x1600)
        layout = struct.Struct("<" + "".join(self.od[k].type for k in keys))
        if layout.size > len(data):
            self._emergency(0x8210)  # PDO not processed: length
            return
        for key, value in zip(keys, layout.unpack_from(data), strict=True):
            self.od[key].value = value
        if (0x6040, 0) in keys:
            self._step_state(self.od[0x6040, 0].value)

    def _transmit(self) -> None:
        if self.od[0x1800, 1].value & 0x8000_0000:
            return
        self.od[0x6041, 0].value = self._status_word()
        keys = self._mapped(0x1A00)
        data = struct.pack("<" + "".join(self.od[k].type for k in keys), *(self.od[k].value for k in keys))
        self._out.append((0x180 + self.node, data))

    def _status_word(self) -> int:
        quick = 0x20 if self.state in (READY, SWITCHED_ON, ENABLED) else 0
        voltage = 0x10 if self.od[0x6079, 0].value > 0 else 0
        return self.state | quick | voltage | 0x200  # remote

    def _sdo(self, data: bytes) -> bytes:
        """Answer an SDO request."""
        command, index, sub = struct.unpack_from("<BHB", data)
        entry = self.od.get((index, sub))
        if entry is None:
            code = ABORT_NO_SUB if (index, 0) in self.od else ABORT_NO_OBJECT
        elif command == 0x40:
            if index == 0x6041:
                entry.value = self._status_word()
            head = 0x43 | (4 - struct.calcsize(entry.type)) << 2
            answer = struct.pack("<BHB", head, index, sub) + struct.pack("<" + entry.type, entry.value)
            return answer.ljust(8, b"\0")
        elif command & 0xE0 == 0x20 and command & 0x02:
            code = self._download((index, sub), entry, data)
            if not code:
                return struct.pack("<BHB4x", 0x60, index, sub)
        else:
            code = ABORT_COMMAND
        return struct.pack("<BHBI", 0x80, index, sub, code)

    def _download(self, item: tuple[int, int], entry: Entry, data: bytes) -> int:
        """Write an object (expedited download); return 0, or the code of the abort."""
        index, sub = item
        size = struct.calcsize(entry.type)
        given = 4 - (data[0] >> 2 & 3) if data[0] & 1 else size
        if not entry.writable:
            return ABORT_READ_ONLY
        if given != size:
            return ABORT_LENGTH
        value = struct.unpack_from("<" + entry.type, data, 4)[0]
        if sub and index in (0x1600, 0x1A00) and (value >> 16, value >> 8 & 0xFF) not in self.od:
            return ABORT_VALUE
        entry.value = value
        if item == (0x6060, 0):
            self.od[0x6061, 0].value = value
        if item == (0x6040, 0):
            self._step_state(value)
        return 0


class SlcanAdapter:
    """The device side of the Lawicel protocol: bytes from the host in, answers and frames out."""

    def __init__(self) -> None:
        self.open = False
        self.bitrate = -1
        self._rest = b""

    def feed(self, data: bytes) -> tuple[bytes, list[Frame]]:
        """Return (answer to the host, frames for the bus); the answer to an unknown command is BEL."""
        *commands, self._rest = (self._rest + data).split(b"\r")
        self._rest = self._rest[-64:]
        answer, frames = bytearray(), []
        for c in commands:
            kind = c[:1]
            if kind in (b"t", b"T"):
                frame = self._frame(c) if self.open else None
                if frame is None:
                    answer += b"\a"
                else:
                    frames.append(frame)
                    answer += b"z\r" if kind == b"t" else b"Z\r"
            elif c == b"O" and self.bitrate >= 0:
                self.open = True
                answer += b"\r"
            elif c == b"C" or c == b"":
                self.open = self.open and c == b""
                answer += b"\r"
            elif (
                kind == b"S"
                and c[1:] in (b"0", b"1", b"2", b"3", b"4", b"5", b"6", b"7", b"8")
                and not self.open
            ):
                self.bitrate = int(c[1:])
                answer += b"\r"
            elif c == b"V":
                answer += b"V1013\r"
            elif c == b"F" and self.open:
                answer += b"F00\r"
            else:
                answer += b"\a"
        return bytes(answer), frames

    @staticmethod
    def _frame(c: bytes) -> Frame | None:
        digits = 3 if c[:1] == b"t" else 8
        try:
            size = int(c[1 + digits : 2 + digits])
            data = bytes.fromhex(c[2 + digits :].decode("ascii"))
            can_id = int(c[1 : 1 + digits], 16) | (EXTENDED if digits == 8 else 0)
            return (can_id, data) if len(data) == size <= 8 else None
        except ValueError:
            return None

    def encode(self, frames: list[Frame]) -> bytes:
        """Encode frames from the bus for the host; none while the channel is closed."""
        return b"".join(encode_slcan(*frame) for frame in frames) if self.open else b""
