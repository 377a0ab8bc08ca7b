"""Set-up of a CiA-402 drive: its objects as the EDS file has them, and how they are written over SDO.

Expedited SDO transfers of CiA 301 (a number of up to 4 bytes in one frame) are all that a set-up needs:

    request to 0x600 + node     0x40 read, 0x2F 0x2B 0x23 write 1, 2, 4 bytes | index, sub-index | data
    answer from 0x580 + node    0x43 .. 0x4F, 0x60 done, 0x80 abort with a code of 32 bits

PDO mappings are written as plain numbers, so that it does not matter whether the EDS calls them ARRAY or
RECORD.
"""

from __future__ import annotations

import contextlib
import struct
import time

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.cia402 import CONTROL_WORD, STANDARD_TYPES
from thermoctl_hal.base.profile import ERROR_CODE, FIELD_TYPES, STATUS_WORD, Cia402, Object, object_name
from thermoctl_hal.base.wire import CanPort
from thermoctl_hal.can.eds import Entry, read_eds

SYNC_ID, NMT_ID = 0x080, 0x000
NMT_START, NMT_PRE_OPERATIONAL, NMT_RESET_COMMUNICATION = 0x01, 0x80, 0x82
HEARTBEAT_LOST = 0x8130  # CiA 301 error code of a missing heartbeat
PDO_INVALID, PDO_NO_RTR = 0x8000_0000, 0x4000_0000  # bits of a PDO's COB-ID
DRIVE_PROFILE = 402  # lower half of object 0x1000: CiA 402
PDO_BYTES = 8
LISTEN_S, LISTEN_BEATS = 0.1, 5
"""Time to listen for a foreign heartbeat before anything is sent: at least LISTEN_S, and LISTEN_BEATS
periods."""
DOUBLE_ANSWERS = 3  # number of double answers to requests that prove that two devices share the node id
_FORMATS = {0x01: "B", 0x02: "b", 0x03: "h", 0x04: "i", 0x05: "B", 0x06: "H", 0x07: "I"}
"""Data types of CiA 301 (BOOLEAN, INTEGER8 .. 32, UNSIGNED8 .. 32) and their letters in `struct`."""


class Objects:
    """The types of the objects that a profile names, from its EDS file or the standard.

    Raises InputError with the object."""

    def __init__(self, spec: Cia402, place: str, node: int) -> None:
        self._known = {Object(index): t for index, t in STANDARD_TYPES.items()} | dict(spec.objects)
        if spec.eds is None:
            self.place, self.eds = place, None
            return
        self.place, self.eds = place, spec.eds
        try:
            self._file = read_eds(spec.eds)
        except OSError as e:
            raise InputError(f"{place}: {spec.eds}: cannot be read: {e.strerror}") from None
        except ValueError as e:
            raise InputError(f"{place}: {spec.eds}: no EDS file: {e}") from None

    def format(self, item: Object, key: str) -> str:
        """Return the struct letter of an object; `key` is the profile's key that names it."""
        index, sub = item
        if self.eds is None:
            if item not in self._known:
                raise InputError(
                    f"{self.place}: {key}: the type of object {object_name(item)} is not known: give the drive's "
                    f"'eds' file, or say objects: {{'{object_name(item)}': int32}}"
                )
            return FIELD_TYPES[self._known[item]]
        if not self._file.has(index):
            raise self._error(item, key, "is not in it")
        subs = self._file.subs(index)
        if subs and sub == 0:
            names = ", ".join(object_name(Object(index, k)) for k in subs[:4])
            raise self._error(item, key, f"has sub-indices; say which, as {names}")
        if sub and not subs:
            raise self._error(item, key, "has no sub-indices")
        if sub and sub not in subs:
            raise self._error(item, key, f"has no sub-index {sub}; it has {', '.join(map(str, subs))}")
        entry = self._file.entries[item]
        if entry.again is not None and entry.again.data_type != entry.data_type:
            raise self._error(
                item,
                key,
                f"stands twice with different types (lines {entry.line}, {entry.again.line}): keep one",
            )
        if entry.data_type is None:
            given = entry.keys.get("datatype")
            what = (
                f"DataType={given}, which is no number: correct it in" if given else "no DataType: add it to"
            )
            raise self._error(
                item, key, f"(line {entry.line}) has {what} the file, as DataType=0x0004 for int32"
            )
        self._check_access(item, key, entry)
        letter = _FORMATS.get(entry.data_type)
        if letter is None:
            raise self._error(item, key, f"(line {entry.line}) is no whole number of up to 4 bytes")
        return letter

    def _check_access(self, item: Object, key: str, entry: Entry) -> None:
        """Raise InputError for an object that is read, written or mapped but cannot be."""
        sent = key == "transmit"
        if entry.access in (("wo",) if sent else ("ro", "const")):
            what = f"({entry.name}, line {entry.line}) has AccessType={entry.access}: it cannot be "
            raise self._error(item, key, what + ("sent" if sent else "written"))
        if key in ("transmit", "command") and not entry.in_pdo:
            raise self._error(item, key, f"(line {entry.line}) has PDOMapping=0: no PDO can hold it")

    def within(self, item: Object, key: str, low: float, high: float) -> None:
        """Raise InputError where values from low to high are outside the limits of the object's EDS file."""
        if self.eds is None or item not in self._file.entries:
            return
        try:
            least, most = self._file.entries[item].limits
        except ValueError as e:
            raise self._error(item, key, f"has {e}") from None
        if low < least or high > most:
            given = f"{low:g}" if low == high else f"{low:g} .. {high:g}"
            what = f"takes {least:.12g} .. {most:.12g} (LowLimit, HighLimit), {given} is outside"
            raise self._error(item, key, what)

    def _error(self, item: Object, key: str, what: str) -> InputError:
        return InputError(f"{self.place}: {key}: {self.eds}: object {object_name(item)} {what}")


class Sdo:
    """Reads and writes objects of one node, one at a time; remembers the heartbeats that arrive meanwhile."""

    def __init__(self, port: CanPort, node: int, timeout_s: float) -> None:
        self.port, self.node, self.timeout_s = port, node, timeout_s
        self.heartbeats: set[int] = set()
        self.double = 0
        self._last = b""

    def read(self, item: Object) -> int:
        """Return the object as an unsigned number. Raises HardwareError with the object."""
        answer = self._ask(item, b"\x40", bytes(4))
        size = 4 - (answer[0] >> 2 & 3) if answer[0] & 1 else 4
        return int.from_bytes(answer[4 : 4 + size], "little")

    def write(self, item: Object, letter: str, value: int) -> None:
        """Write a number of this struct letter. Raises HardwareError with the drive's reason."""
        data = struct.pack("<" + letter, value)
        command = bytes((0x23 | 4 - len(data) << 2,))
        self._ask(item, command, data.ljust(4, b"\0"), f"{value} (0x{value & 0xFFFFFFFF:X}) to ")

    def listen(self, seconds: float) -> None:
        """Listen without sending, and remember the heartbeats of the bus."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for can_id, data in self.port.receive():
                self._hear(can_id, data)
            time.sleep(0.001)

    def _hear(self, can_id: int, data: bytes) -> None:
        if 0x700 < can_id < 0x780:
            self.heartbeats.add(can_id)
        elif can_id == 0x580 + self.node and data[1:4] == self._last:
            self.double += 1

    def _ask(self, item: Object, command: bytes, data: bytes, what: str = "") -> bytes:
        target = struct.pack("<HB", *item)
        self.port.send((0x600 + self.node, command + target + data))
        end = time.monotonic() + self.timeout_s
        while True:
            answer = b""
            for can_id, body in self.port.receive():
                if not answer and can_id == 0x580 + self.node and len(body) == 8 and body[1:4] == target:
                    answer, self._last = body, target
                else:
                    self._hear(can_id, body)
            if answer:
                return self._checked(answer, item, what)
            if time.monotonic() > end:
                raise HardwareError(
                    f"no answer to object {object_name(item)} within {self.timeout_s:g} s: {self._others()}"
                )
            time.sleep(0.0005)

    def _checked(self, answer: bytes, item: Object, what: str) -> bytes:
        if answer[0] == 0x80:
            import canopen  # Objects has already loaded it

            code = int.from_bytes(answer[4:], "little")
            text = canopen.SdoAbortedError.CODES.get(code, "the manual of the drive says what it means")
            raise HardwareError(
                f"the drive refuses {what or 'to read '}object {object_name(item)}: abort 0x{code:08X}, {text}: "
                "check the profile's objects and values against the drive's manual"
            )
        if answer[0] & 0xE0 != 0x60 and answer[0] & 0xE2 != 0x42:
            raise HardwareError(
                f"object {object_name(item)} was answered by 0x{answer[0]:02X}, no transfer of up to 4 bytes: "
                "check the profile"
            )
        return answer

    def _others(self) -> str:
        others = sorted(i - 0x700 for i in self.heartbeats if i != 0x700 + self.node)
        if not others:
            return "check power, node id, bitrate and termination; a slow drive needs a longer sdo_timeout_s in its profile"
        nodes = ", ".join(map(str, others))
        return f"heartbeats of nodes {nodes} are heard: check the node id ('address') and its power"


def foreign_heartbeat(master: int, where: str) -> HardwareError:
    """Return the error for another producer of our own heartbeat on the bus."""
    return HardwareError(
        f"another device on {where} sends the heartbeat 0x{0x700 + master:X} (node id {master}), which the drive is "
        "to watch as ours: it would keep the drive driving when we are gone. Give one of the two another id: "
        "'master_id' beside 'address' in hal.devices"
    )


def set_up(sdo: Sdo, spec: Cia402, formats: dict[Object, str], where: str) -> int:
    """Configure heartbeats, mode and PDOs of a drive and start its node; return its error code.

    The drive stays disabled. formats: struct letters of the objects of both PDOs and of start_up. Raises
    HardwareError."""
    node, port = sdo.node, sdo.port
    sdo.listen(max(LISTEN_S, LISTEN_BEATS * spec.heartbeat_s))
    if 0x700 + spec.master_id in sdo.heartbeats:
        raise foreign_heartbeat(spec.master_id, where)
    port.send((NMT_ID, bytes((NMT_PRE_OPERATIONAL, node))))  # PDOs rest while they are mapped
    profile = sdo.read(Object(0x1000)) & 0xFFFF
    if profile != DRIVE_PROFILE:
        raise HardwareError(
            f"node {node} has device profile {profile}, 402 (drive) was expected: is the node id right?"
        )
    sdo.write(CONTROL_WORD, "H", 0)
    sdo.write(Object(0x1016, 1), "I", spec.master_id << 16 | round(spec.watchdog_s * 1000))
    sdo.write(Object(0x1017), "H", round(spec.heartbeat_s * 1000))
    sdo.write(Object(0x6060), "b", spec.mode)
    for index, sub, value in spec.start_up:
        sdo.write(Object(index, sub), formats[Object(index, sub)], value)
    _map_pdo(sdo, 0x1800, 0x180 + node | PDO_NO_RTR, [(o, formats[o]) for o in spec.transmit])
    _map_pdo(sdo, 0x1400, 0x200 + node, [(CONTROL_WORD, "H"), (spec.command, formats[spec.command])])
    fault_code = sdo.read(ERROR_CODE)
    if fault_code == HEARTBEAT_LOST:  # expected after a restart of ours
        sdo.write(CONTROL_WORD, "H", 0x80)
        sdo.write(CONTROL_WORD, "H", 0)
        fault_code = sdo.read(ERROR_CODE)
    if sdo.double >= DOUBLE_ANSWERS:
        raise HardwareError(
            f"two devices answer as node {node}: give one of them another node id; both would be driven"
        )
    if 0x700 + spec.master_id in sdo.heartbeats:
        raise foreign_heartbeat(spec.master_id, where)
    port.send((NMT_ID, bytes((NMT_START, node))))
    return fault_code


def _map_pdo(sdo: Sdo, communication: int, cob_id: int, objects: list[tuple[Object, str]]) -> None:
    """Map a PDO to these objects, at every SYNC; drop PDO_NO_RTR when the drive refuses it."""
    mapping = communication + 0x200
    try:
        sdo.write(Object(communication, 1), "I", cob_id | PDO_INVALID)
    except HardwareError:
        if not cob_id & PDO_NO_RTR:
            raise
        cob_id &= ~PDO_NO_RTR
        sdo.write(Object(communication, 1), "I", cob_id | PDO_INVALID)
    sdo.write(Object(communication, 2), "B", 1)
    sdo.write(Object(mapping), "B", 0)
    for k, ((index, sub), letter) in enumerate(objects, 1):
        sdo.write(Object(mapping, k), "I", index << 16 | sub << 8 | 8 * struct.calcsize(letter))
    sdo.write(Object(mapping), "B", len(objects))
    sdo.write(Object(communication, 1), "I", cob_id)


def switch_off(sdo: Sdo, receive_size: int) -> None:
    """Disable the drive without set-up: control word 0 by PDO and SDO, then reset communication.

    Raises HardwareError when the drive does not confirm."""
    node, port = sdo.node, sdo.port
    port.send((0x200 + node, bytes(receive_size)), (SYNC_ID, b""))
    try:
        sdo.write(CONTROL_WORD, "H", 0)
    finally:
        with contextlib.suppress(OSError):
            port.send((NMT_ID, bytes((NMT_RESET_COMMUNICATION, node))))


def check_objects(objects: Objects, spec: Cia402) -> dict[Object, str]:
    """Look up the struct letters of the profile's objects in the EDS file. Raises InputError."""
    formats: dict[Object, str] = {item: objects.format(item, "transmit") for item in spec.transmit}
    formats[spec.command] = objects.format(spec.command, "command")
    if not formats[spec.command].islower():
        raise InputError(
            f"{objects.place}: command: {spec.eds}: object {object_name(spec.command)} has no sign"
        )
    for index, sub, value in spec.start_up:
        item = Object(index, sub)
        letter = formats[item] = objects.format(item, "start_up")
        try:
            struct.pack("<" + letter, value)
        except struct.error:
            size = 8 * struct.calcsize(letter)
            raise InputError(
                f"{objects.place}: start_up: {value} does not fit object {object_name(item)} ({size} bits, "
                f"{'with' if letter.islower() else 'without'} sign)"
            ) from None
        objects.within(item, "start_up", value, value)
    size = sum(struct.calcsize(formats[item]) for item in spec.transmit)
    if size > PDO_BYTES:
        raise InputError(f"{objects.place}: transmit: a PDO has {PDO_BYTES} bytes, these objects take {size}")
    if formats[STATUS_WORD] != "H":
        raise InputError(f"{objects.place}: transmit: {spec.eds}: the status word 0x6041 is no uint16")
    return formats
