"""EtherCAT slaves, byte by byte: registers, EEPROM, states, sync managers, FMMUs, mailbox.

Written from the public description of the slave controller and of CANopen over EtherCAT; nothing of `hal` and
nothing of a master is used.
"""

from __future__ import annotations

import struct
import time

INIT, PREOP, SAFEOP, OP, ERROR = 1, 2, 4, 8, 16
AL_CONTROL, AL_STATUS, AL_CODE, STATION, EEPROM = 0x120, 0x130, 0x134, 0x10, 0x502
FMMU, SM, WATCHDOG_DIVIDER, WATCHDOG_TIME, WATCHDOG_STATUS = 0x600, 0x800, 0x400, 0x420, 0x440
READS, WRITES = (1, 4, 7, 10, 3, 6, 9, 12), (2, 5, 8, 11, 3, 6, 9, 12)
BROADCAST, AUTO, FIXED, LOGICAL = (7, 8, 9), (1, 2, 3), (4, 5, 6), (10, 11, 12)
MAILBOX_OUT, MAILBOX_IN, MAILBOX_SIZE, OUTPUTS, INPUTS = 0x1000, 0x1080, 0x80, 0x1100, 0x1400
ABORT_MISSING, ABORT_READ_ONLY = 0x06020000, 0x06010002
INVALID_MAILBOX, INVALID_CHANGE, INVALID_OUTPUTS, INVALID_INPUTS, WATCHDOG = 0x16, 0x11, 0x1D, 0x1E, 0x1B
Entry = tuple[int, int, int]  # index, sub-index, bits


class Slave:
    """One slave: registers, EEPROM, states, mailbox, and an application that gives its inputs.

    `rx` and `tx`: entries of the PDOs 0x1600 and 0x1A00, ... as they are at power-on. `fixed`: they cannot be
    written. `watched`: the sync manager of the outputs triggers a watchdog."""

    def __init__(
        self,
        name: str,
        vendor: int,
        product: int,
        tx: list[list[Entry]],
        rx: list[list[Entry]] | None = None,
        objects: dict[tuple[int, int], tuple[str, int]] | None = None,
        fixed: bool = True,
        watched: bool = True,
        coe: bool = True,
    ) -> None:
        self.name, self.vendor, self.product, self.coe = name, vendor, product, coe
        self.tx, self.rx, self.fixed, self.watched = tx, rx or [], fixed, watched
        self.own_objects = objects or {}
        self.present, self.stuck, self.mute, self.deaf, self.refused = True, 0, False, False, 0
        self.written: list[tuple[int, int, int]] = []
        self.eeprom = self._eeprom()
        self.power_on()

    def power_on(self) -> None:
        """Forget everything but the EEPROM."""
        self.memory = bytearray(0x2000)
        self.memory[0:2] = b"\x11\x00"  # type of the controller
        self.memory[4:8] = bytes((8, 8, 8, 0x0F))  # FMMUs, sync managers, memory, ports
        self.memory[0x110:0x112] = b"\x01\x56"  # both ports open: a slave inside the line
        self._put(WATCHDOG_DIVIDER, "H", 2498)
        self._put(0x410, "H", 1000)
        self._put(WATCHDOG_TIME, "H", 1000)
        self._put(EEPROM, "H", 0x40)  # reads of 8 bytes
        self._set_state(INIT)
        self.objects = dict(self.own_objects)
        for first, assign, pdos in ((0x1600, 0x1C12, self.rx), (0x1A00, 0x1C13, self.tx)):
            self.objects[assign, 0] = "B", len(pdos)
            for k, entries in enumerate(pdos):
                self.objects[assign, k + 1] = "H", first + k
                self.objects[first + k, 0] = "B", len(entries)
                for n, (index, sub, bits) in enumerate(entries, 1):
                    self.objects[first + k, n] = "I", index << 16 | sub << 8 | bits
        self.objects |= {(0x1C00, 0): ("B", 4)} | {(0x1C00, k): ("B", k) for k in (1, 2, 3, 4)}
        self._fed_s = time.monotonic()
        self.answers: list[bytes] = []

    def inputs(self) -> bytes:
        """The application: the bytes of the inputs."""
        return bytes(self.size(0x1C13))

    def take(self, outputs: bytes) -> None:
        """The application: take the outputs of a cycle in the state OP."""

    def stop(self) -> None:
        """The application: the state OP was left."""

    # EEPROM

    def _eeprom(self) -> bytes:
        head = bytearray(128)
        struct.pack_into("<IIII", head, 0x10, self.vendor, self.product, 0x00120000, 1)
        if self.coe:
            struct.pack_into("<HHHHH", head, 0x30, MAILBOX_OUT, MAILBOX_SIZE, MAILBOX_IN, MAILBOX_SIZE, 4)
        text = self.name.encode()
        strings = bytes((1, len(text))) + text
        general = bytes((0, 0, 1, 1, 0, 0x0F if self.coe else 0)).ljust(32, b"\0")
        managers = [(MAILBOX_OUT, MAILBOX_SIZE, 0x26, 1, 1), (MAILBOX_IN, MAILBOX_SIZE, 0x22, 1, 2)]
        if not self.coe:
            managers = [(0, 0, 0, 0, 0), (0, 0, 0, 0, 0)]
        managers += [(OUTPUTS, 0, 0x64 if self.watched else 0x24, 1, 3), (INPUTS, 0, 0x20, 1, 4)]
        sync = b"".join(
            struct.pack("<HHBBBB", a, n, control, 0, on, kind) for a, n, control, on, kind in managers
        )
        parts = [(10, strings), (30, general), (40, bytes((1, 2))), (41, sync)]
        if not self.coe:
            parts += [(50, self._pdos(0x1A00, self.tx, 3)), (51, self._pdos(0x1600, self.rx, 2))]
        for kind, data in parts:
            data += bytes(len(data) % 2)
            head += struct.pack("<HH", kind, len(data) // 2) + data
        return bytes(head + b"\xff\xff").ljust(2048, b"\xff")

    @staticmethod
    def _pdos(first: int, pdos: list[list[Entry]], manager: int) -> bytes:
        data = b""
        for k, entries in enumerate(pdos):
            data += struct.pack("<HBBBBH", first + k, len(entries), manager, 0, 0, 0)
            data += b"".join(struct.pack("<HBBBBH", i, s, 0, 0, bits, 0) for i, s, bits in entries)
        return data

    # registers

    def _put(self, at: int, letter: str, value: int) -> None:
        struct.pack_into("<" + letter, self.memory, at, value)

    def _get(self, at: int, letter: str = "H") -> int:
        return int(struct.unpack_from("<" + letter, self.memory, at)[0])

    @property
    def state(self) -> int:
        return self.memory[AL_STATUS]

    def station(self) -> int:
        return self._get(STATION)

    def read(self, at: int, size: int) -> bytes:
        """Physical memory, with the effect of reading."""
        if self.coe and at <= MAILBOX_IN < at + size:
            if not self.answers:
                return b""
            answer = self.answers.pop(0)
            self.memory[MAILBOX_IN : MAILBOX_IN + MAILBOX_SIZE] = answer.ljust(MAILBOX_SIZE, b"\0")
        self.memory[SM + 8 + 5] = 8 if self.answers else 0
        return bytes(self.memory[at : at + size])

    def write(self, at: int, data: bytes) -> None:
        """Physical memory, with the effect of writing."""
        if at in (AL_STATUS, AL_CODE):
            return
        self.memory[at : at + len(data)] = data
        if at <= AL_CONTROL < at + len(data):
            self._request(self.memory[AL_CONTROL])
        elif at <= EEPROM < at + len(data) and data[EEPROM - at + 1] & 0x07:
            self._read_eeprom(data[EEPROM - at + 1])
        elif self.coe and at <= MAILBOX_OUT + MAILBOX_SIZE - 1 < at + len(data) and self.state != INIT:
            self._mail(bytes(self.memory[MAILBOX_OUT : MAILBOX_OUT + MAILBOX_SIZE]))

    def _read_eeprom(self, command: int) -> None:
        if command & 1:
            at = 2 * self._get(EEPROM + 2, "I") % len(self.eeprom)
            self.memory[0x508:0x510] = self.eeprom[at : at + 8].ljust(8, b"\xff")
        self._put(EEPROM, "H", 0x40)

    def _set_state(self, state: int, code: int = 0) -> None:
        left = self.memory[AL_STATUS] == OP and state != OP
        self.memory[AL_STATUS] = state
        self._put(AL_CODE, "H", code)
        if left:
            self.stop()

    def fail(self, state: int, code: int) -> None:
        """Leave for `state` with an error and its code."""
        self._set_state(state | ERROR, code)

    def _request(self, control: int) -> None:
        wanted, now = control & 0x0F, self.state & 0x0F
        if self.state & ERROR and not control & ERROR and wanted > INIT:
            return
        if self.stuck and wanted > self.stuck:
            return
        code = 0
        if wanted > now and wanted != 2 * now:
            code = INVALID_CHANGE
        elif wanted == PREOP and now == INIT and self.coe and self._get(SM + 2) != MAILBOX_SIZE:
            code = INVALID_MAILBOX
        elif wanted == SAFEOP and now == PREOP and self._get(SM + 18) != self.size(0x1C12):
            code = INVALID_OUTPUTS
        elif wanted == SAFEOP and now == PREOP and self._get(SM + 26) != self.size(0x1C13):
            code = INVALID_INPUTS
        if code:
            self.fail(now, code)
        else:
            self._fed_s = time.monotonic()
            self._set_state(wanted)

    def watch(self) -> None:
        """The watchdog of the outputs: without them for too long the state OP is left."""
        limit_s = self._get(WATCHDOG_TIME) * (self._get(WATCHDOG_DIVIDER) + 2) * 40e-9
        is_on = self.memory[SM + 16 + 4] & 0x40 and limit_s > 0 and self.size(0x1C12)
        if self.state == OP and is_on and time.monotonic() - self._fed_s > limit_s:
            self.fail(SAFEOP, WATCHDOG)

    # process data

    def size(self, assign: int) -> int:
        """Bytes of the PDOs that are assigned."""
        bits = 0
        for k in range(1, self.objects[assign, 0][1] + 1):
            pdo = self.objects[assign, k][1]
            bits += sum(self.objects[pdo, n][1] & 0xFF for n in range(1, self.objects[pdo, 0][1] + 1))
        return (bits + 7) // 8

    def logical(self, start: int, data: bytearray, reads: bool, writes: bool) -> int:
        """Exchange the part of a logical datagram that the FMMUs map; return what it adds to the counter."""
        if self.state & 0x0F not in (SAFEOP, OP) or self.deaf:
            return 0
        counter = 0
        source = bytes(data)
        for k in range(4):
            first, size, _, _, place, _, kind, active = struct.unpack_from(
                "<IHBBHBBB", self.memory, FMMU + 16 * k
            )
            begin, end = max(first, start), min(first + size, start + len(data))
            if not active & 1 or begin >= end:
                continue
            if kind & 2 and writes:
                self.memory[place + begin - first : place + end - first] = source[begin - start : end - start]
                self._fed_s = time.monotonic()
                if self.state == OP:
                    self.take(bytes(self.memory[OUTPUTS : OUTPUTS + self.size(0x1C12)]))
                counter += 2 if reads else 1
            if kind & 1 and reads:
                image = self.inputs()
                self.memory[INPUTS : INPUTS + len(image)] = image
                data[begin - start : end - start] = self.memory[place + begin - first : place + end - first]
                counter += 1
        return counter

    # mailbox

    def _mail(self, mail: bytes) -> None:
        length, _, _, kind = struct.unpack_from("<HHBB", mail)
        service = struct.unpack_from("<H", mail, 6)[0] >> 12
        if kind & 0x0F != 3 or service != 2 or self.mute:
            return
        body = self._sdo(mail[8 : 6 + length])
        service = 2 if body[0] == 0x80 else 3  # an abort is a request, too
        head = struct.pack("<HHBBH", len(body) + 2, 0, 0, 3 | kind & 0x70, service << 12)
        self.answers.append(head + body)
        self.memory[SM + 8 + 5] = 8

    def _sdo(self, request: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", request)
        complete = bool(command & 0x10)
        is_mapping = index & 0xFE00 in (0x1600, 0x1A00) or index in (0x1C12, 0x1C13)
        if command >> 5 == 2 and not complete and (index, sub) in self.objects and index != self.refused:
            letter, value = self.objects[index, sub]
            data = struct.pack("<" + letter, value)
            return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")
        known = (index, sub) in self.objects or is_mapping
        if (
            command >> 5 == 1
            and not complete
            and known
            and index != self.refused
            and not (is_mapping and self.fixed)
        ):
            size = 4 - (command >> 2 & 3) if command & 2 else struct.unpack_from("<I", request, 4)[0]
            data = request[4 : 4 + size] if command & 2 else request[8 : 8 + size]
            value = int.from_bytes(data, "little")
            letter = self.objects.get((index, sub), ("I" if index < 0x1C00 else "H", 0))[0]
            self.objects[index, sub] = letter, value
            self.written.append((index, sub, value))
            return struct.pack("<BHBI", 0x60, index, sub, 0)
        code = ABORT_READ_ONLY if is_mapping or index == self.refused else ABORT_MISSING
        return struct.pack("<BHBI", 0x80, index, sub, code)


def answer(frame: bytes, slaves: list[Slave]) -> bytes:
    """Send a frame through the slaves in their order; return it as the last one gives it back."""
    out = bytearray(frame)
    out[6] |= 2  # the first slave marks the sender's address
    at, more = 16, True
    while more:
        command, _, address, place, length, _ = struct.unpack_from("<BBHHHH", out, at)
        more, size = bool(length & 0x8000), length & 0x7FF
        data = out[at + 10 : at + 10 + size]
        counter = struct.unpack_from("<H", out, at + 10 + size)[0]
        for slave in slaves:
            if command in LOGICAL:
                counter += slave.logical(address | place << 16, data, command in READS, command in WRITES)
            elif (
                command in BROADCAST
                or (command in AUTO and address == 0)
                or (command in FIXED and address == slave.station())
            ):
                counter += _physical(slave, command, place, data)
            if command in (*AUTO, *BROADCAST):
                address = address + 1 & 0xFFFF
        out[at + 10 : at + 10 + size] = data
        struct.pack_into("<H", out, at + 2, address)
        struct.pack_into("<H", out, at + 10 + size, counter & 0xFFFF)
        at += 12 + size
    return bytes(out)


def _physical(slave: Slave, command: int, place: int, data: bytearray) -> int:
    counter, sent = 0, bytes(data)
    if command in READS:
        found = slave.read(place, len(data))
        if found:
            old = bytes(data) if command in BROADCAST else bytes(len(data))
            data[:] = bytes(a | b for a, b in zip(found, old, strict=True))
            counter += 1
    if command in WRITES:
        slave.write(place, sent)
        counter += 1 if command not in READS else 2
    return counter
