"""A CAN bus with Lawicel adapters and CiA-402 drives. Pure: frames and the time in, frames and the coil's current out.

A drive has an object dictionary, an expedited SDO server, an NMT slave, heartbeats both ways, PDOs on SYNC, emergencies and
the CiA-402 state machine. Its stage is driven in `operation enabled` only. What breaks it are plain attributes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

Frame = tuple[int, bool, bytes]  # identifier, extended, data

NOT_READY, SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = range(7)
STATUS = {  # bits 6, 5, 3..0 of the status word; bit 5 is 'no quick stop'
    NOT_READY: 0x00,
    SWITCH_ON_DISABLED: 0x40,
    READY: 0x21,
    SWITCHED_ON: 0x23,
    ENABLED: 0x27,
    QUICK_STOP: 0x07,
    FAULT: 0x08,
}
INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
UNDERVOLTAGE, HEARTBEAT, SHORT_CIRCUIT, WARM = 0x3220, 0x8130, 0x2310, 0x4210
UNDERVOLTAGE_V = 9.0
RATED_A = 1.0

# index, sub: (name, struct letter, start value, access). Names are ours; numbers are those of CiA 301 and 402.
OBJECTS: dict[tuple[int, int], tuple[str, str, int, str]] = {
    (0x1000, 0): ("Device type", "I", 0x00020192, "ro"),
    (0x1001, 0): ("Error register", "B", 0, "ro"),
    (0x1016, 0): ("Heartbeats consumed", "B", 1, "ro"),
    (0x1016, 1): ("Heartbeat consumed 1", "I", 0, "rw"),
    (0x1017, 0): ("Heartbeat period", "H", 0, "rw"),
    (0x1018, 0): ("Identity", "B", 4, "ro"),
    (0x1018, 1): ("Vendor", "I", 0x7FF, "ro"),
    (0x1018, 2): ("Product", "I", 1, "ro"),
    (0x1018, 3): ("Revision", "I", 1, "ro"),
    (0x1018, 4): ("Serial number", "I", 1, "ro"),
    (0x1400, 0): ("Received PDO 1", "B", 2, "ro"),
    (0x1400, 1): ("Received PDO 1 identifier", "I", 0x80000200, "rw"),
    (0x1400, 2): ("Received PDO 1 type", "B", 255, "rw"),
    (0x1600, 0): ("Received PDO 1 objects", "B", 0, "rw"),
    **{(0x1600, k): (f"Received PDO 1 object {k}", "I", 0, "rw") for k in range(1, 5)},
    (0x1800, 0): ("Sent PDO 1", "B", 2, "ro"),
    (0x1800, 1): ("Sent PDO 1 identifier", "I", 0x80000180, "rw"),
    (0x1800, 2): ("Sent PDO 1 type", "B", 255, "rw"),
    (0x1A00, 0): ("Sent PDO 1 objects", "B", 0, "rw"),
    **{(0x1A00, k): (f"Sent PDO 1 object {k}", "I", 0, "rw") for k in range(1, 5)},
    (0x603F, 0): ("Error code", "H", 0, "ro"),
    (0x6040, 0): ("Control word", "H", 0, "rw"),
    (0x6041, 0): ("Status word", "H", 0x40, "ro"),
    (0x6060, 0): ("Mode", "b", 0, "rw"),
    (0x6061, 0): ("Mode shown", "b", 0, "ro"),
    (0x6071, 0): ("Target torque", "h", 0, "rw"),
    (0x6077, 0): ("Torque", "h", 0, "ro"),
    (0x6079, 0): ("Link voltage", "I", 24000, "ro"),
}
_DATA_TYPE = {"b": 2, "h": 3, "i": 4, "B": 5, "H": 6, "I": 7}


def eds() -> str:
    """The drive's EDS, made from OBJECTS."""
    lines = ["[FileInfo]", "FileName=drive.eds", "FileVersion=1", "EDSVersion=4.0"]
    lines += ["[DeviceInfo]", "VendorName=emulator", "ProductName=drive", "NrOfRXPDO=1", "NrOfTXPDO=1"]
    kinds = {"MandatoryObjects": (0x1000, 0x1001, 0x1018), "OptionalObjects": ()}
    indices = sorted({index for index, _ in OBJECTS})
    kinds["OptionalObjects"] = tuple(i for i in indices if i not in kinds["MandatoryObjects"])
    for kind, members in kinds.items():
        lines += [f"[{kind}]", f"SupportedObjects={len(members)}"]
        lines += [f"{k}=0x{index:04X}" for k, index in enumerate(members, 1)]
    for index in indices:
        subs = [sub for i, sub in OBJECTS if i == index]
        if len(subs) > 1:
            name = OBJECTS[index, 0][0]
            lines += [
                f"[{index:04X}]",
                f"ParameterName={name}",
                "ObjectType=0x9",
                f"SubNumber=0x{len(subs):X}",
            ]
        for sub in subs:
            name, letter, value, access = OBJECTS[index, sub]
            lines += [f"[{index:04X}{f'sub{sub:X}' if len(subs) > 1 else ''}]", f"ParameterName={name}"]
            lines += ["ObjectType=0x7", f"DataType=0x{_DATA_TYPE[letter]:04X}", f"AccessType={access}"]
            lines += [f"DefaultValue=0x{value:X}", f"PDOMapping={int(index >= 0x6000)}"]
    return "\n".join(lines) + "\n"


class Drive:
    """A drive. Attributes that break it: `power`, `heartbeat`, `tpdo` ('sent', 'missing', 'frozen'), `quick_stop` (its stop
    input), `gain` (of the current), `supply_v`, `coil_open`. `node` is its address."""

    def __init__(self, node: int, send: Callable[[Frame], None]) -> None:
        self.node, self.send = node, send
        self.mend()
        self.restart()

    def mend(self) -> None:
        """As the maker built it; a drive that was without power starts."""
        had_power = getattr(self, "power", True)
        self.power = self.heartbeat = True
        self.tpdo, self.quick_stop, self.gain, self.supply_v, self.coil_open = "sent", False, 1.0, 24.0, False
        if not had_power:
            self.restart()

    def restart(self) -> None:
        """Power-on: start values, boot-up message, pre-operational."""
        self.value = {key: start for key, (_, _, start, _) in OBJECTS.items()}
        self.value[0x1400, 1] += self.node
        self.value[0x1800, 1] += self.node
        self.state, self.nmt = SWITCH_ON_DISABLED, PRE_OPERATIONAL
        self.control, self.master_s, self.beat_s, self.frozen = 0, None, 0.0, b""
        self._send(0x700 + self.node, bytes((INITIALISING,)))

    def _send(self, can_id: int, data: bytes) -> None:
        if self.power:
            self.send((can_id, False, data))

    @property
    def stage_on(self) -> bool:
        """Whether the output stage drives the coil."""
        return self.power and self.state == ENABLED

    @property
    def target_a(self) -> float:
        """The current that the output stage makes, A; 0 while it is off."""
        if not self.stage_on or self.nmt != OPERATIONAL:
            return 0.0
        return self.gain * self.value[0x6071, 0] * RATED_A / 1000

    def fault(self, code: int) -> None:
        """Fault reaction: the stage off, emergency sent, the fault state kept until it is reset."""
        self.state = FAULT
        self.value[0x603F, 0], self.value[0x1001, 0] = code, 1
        self.emergency(code, 1)

    def emergency(self, code: int, register: int = 0) -> None:
        """Send an emergency; alone, without `fault`, it is a warning."""
        self._send(0x080 + self.node, struct.pack("<HB5x", code, register))

    def step(self, now_s: float) -> None:
        """What happens by itself: inputs, supply, heartbeats."""
        if not self.power:
            self.state = SWITCH_ON_DISABLED
            return
        if self.quick_stop and self.state == ENABLED:
            self.state = QUICK_STOP
        if self.supply_v < UNDERVOLTAGE_V and self.state == ENABLED:
            self.fault(UNDERVOLTAGE)
        limit_s = (self.value[0x1016, 1] & 0xFFFF) / 1000
        if limit_s and self.master_s is not None and now_s - self.master_s > limit_s:
            self.master_s, self.nmt = None, PRE_OPERATIONAL
            self.fault(HEARTBEAT)
        period_s = self.value[0x1017, 0] / 1000
        if period_s and self.heartbeat and now_s - self.beat_s >= period_s:
            self.beat_s = now_s
            self._send(0x700 + self.node, bytes((self.nmt,)))

    def take(self, frame: Frame, now_s: float) -> None:
        """A frame of the bus; a drive of CANopen knows 11-bit identifiers only."""
        can_id, extended, data = frame
        if not self.power or extended:
            return
        if can_id == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._manage(data[0])
        elif can_id == 0x080 and self.nmt == OPERATIONAL:
            self._answer_sync()
        elif can_id == 0x200 + self.node and self.nmt == OPERATIONAL and len(data) >= 4:
            if self.value[0x1400, 1] >> 31 == 0:
                self._receive(data)
        elif can_id == 0x600 + self.node and len(data) == 8 and self.nmt != STOPPED:
            self._send(0x580 + self.node, self._sdo(data))
        elif can_id == 0x700 + (self.value[0x1016, 1] >> 16 & 0x7F) and len(data) == 1:
            self.master_s = now_s

    def _manage(self, command: int) -> None:
        if command in (0x81, 0x82):
            self.restart()
        elif command in (0x01, 0x02, 0x80):
            self.nmt = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}[command]
            if self.nmt != OPERATIONAL and self.state in (READY, SWITCHED_ON, ENABLED):
                self.state = SWITCH_ON_DISABLED

    def _mapped(self, pdo: int) -> list[tuple[int, int]]:
        entries = [self.value[pdo, k] for k in range(1, self.value[pdo, 0] + 1)]
        return [(e >> 16, e >> 8 & 0xFF) for e in entries]

    def _receive(self, data: bytes) -> None:
        at = 0
        for key in self._mapped(0x1600):
            letter = OBJECTS[key][1]
            (self.value[key],) = struct.unpack_from("<" + letter, data, at)
            at += struct.calcsize(letter)
        self._control(self.value[0x6040, 0])

    def _control(self, word: int) -> None:
        """The transitions of CiA 402 by the control word."""
        rising, self.control = word & ~self.control, word
        if self.state == FAULT:
            if rising & 0x80:
                self.state = SWITCH_ON_DISABLED
                self.value[0x603F, 0] = self.value[0x1001, 0] = 0
                self.emergency(0)
            return
        if not word & 0x02:  # no voltage
            self.state = SWITCH_ON_DISABLED
        elif not word & 0x04:  # quick stop by the master
            self.state = QUICK_STOP if self.state in (ENABLED, QUICK_STOP) else SWITCH_ON_DISABLED
        elif self.state == QUICK_STOP:
            pass  # only 'no voltage' leaves it here
        elif word & 0x07 == 0x06:
            self.state = READY
        elif word & 0x0F == 0x07:
            self.state = SWITCHED_ON if self.state >= READY else self.state
        elif word & 0x0F == 0x0F and self.state in (SWITCHED_ON, ENABLED):
            self.state = QUICK_STOP if self.quick_stop else ENABLED

    def status_word(self) -> int:
        """Object 0x6041."""
        return STATUS[self.state] | 0x0200 | (0x10 if self.supply_v > UNDERVOLTAGE_V else 0)

    def _answer_sync(self) -> None:
        if self.tpdo == "missing" or self.value[0x1800, 1] >> 31:
            return
        self.value[0x6041, 0] = self.status_word()
        keys = self._mapped(0x1A00)
        letters = "<" + "".join(OBJECTS[key][1] for key in keys)
        data = struct.pack(letters, *(self.value[key] for key in keys))
        if self.tpdo == "frozen":
            data = self.frozen = self.frozen or data
        else:
            self.frozen = b""
        self._send(0x180 + self.node, data)

    def _sdo(self, data: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", data)
        key = index, sub
        head = struct.pack("<HB", index, sub)
        if key not in OBJECTS:
            return b"\x80" + head + struct.pack("<I", 0x06090011 if (index, 0) in OBJECTS else 0x06020000)
        letter, access = OBJECTS[key][1], OBJECTS[key][3]
        size = struct.calcsize(letter)
        if command == 0x40:
            self.value[0x6041, 0] = self.status_word()
            raw = struct.pack("<" + letter, self.value[key]).ljust(4, b"\0")
            return bytes((0x43 | (4 - size) << 2,)) + head + raw
        if command & 0xF3 != 0x23:
            return b"\x80" + head + struct.pack("<I", 0x05040001)
        if access != "rw" or 4 - (command >> 2 & 3) != size:
            return b"\x80" + head + struct.pack("<I", 0x06010002 if access != "rw" else 0x06070010)
        (self.value[key],) = struct.unpack_from("<" + letter, data, 4)
        if key == (0x6040, 0):
            self._control(self.value[key])
        if key == (0x6060, 0):
            self.value[0x6061, 0] = self.value[key]
        if key == (0x1016, 1):
            self.master_s = None
        return b"\x60" + head + bytes(4)


class Adapter:
    """A Lawicel adapter on a serial line. `bus_off`: its controller left the bus, it takes and gives no frame."""

    def __init__(self) -> None:
        self.rest, self.open, self.bus_off = b"", False, False

    def feed(self, data: bytes) -> tuple[bytes, list[Frame]]:
        """Bytes of the host in; (answers to it, frames for the bus)."""
        *commands, self.rest = (self.rest + data).split(b"\r")
        answer, frames = [], []
        for c in commands:
            kind = c[:1]
            if kind in b"tT" and kind:
                digits = 3 if kind == b"t" else 8
                try:
                    frame = (int(c[1 : 1 + digits], 16), digits == 8, bytes.fromhex(c[2 + digits :].decode()))
                except ValueError:
                    frame = None
                if frame is None or not self.open or self.bus_off or len(frame[2]) != c[1 + digits] - 48:
                    answer.append(b"\a")
                else:
                    frames.append(frame)
                    answer.append(b"z\r" if digits == 3 else b"Z\r")
            elif kind in (b"O", b"C", b"S", b""):
                self.open = {b"O": True, b"C": False}.get(kind, self.open)
                answer.append(b"\r")
            elif kind == b"F":
                answer.append(b"F80\r" if self.bus_off else b"F00\r")
            else:
                answer.append(b"\a")
        return b"".join(answer), frames

    def encode(self, frame: Frame) -> bytes:
        """A frame of the bus for the host; nothing while the channel is closed or off the bus."""
        if not self.open or self.bus_off:
            return b""
        can_id, extended, data = frame
        head = b"T%08X" % can_id if extended else b"t%03X" % can_id
        return head + b"%d" % len(data) + data.hex().upper().encode() + b"\r"
