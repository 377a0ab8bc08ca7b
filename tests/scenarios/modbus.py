"""Modbus register devices, TCP and RTU: a thermocouple module and a power meter. Bytes and the time in, bytes out.

What breaks them are plain attributes of `Registers`: how the next answers come, or do not.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from tests.scenarios.lines import modbus_crc

BUSY, ILLEGAL_ADDRESS, ILLEGAL_FUNCTION = 6, 2, 1


class Registers:
    """What a register device answers. `read(address)`: the register's 16 bits or None where there is none.

    delays_s: how late the answers come, one after the other and again from the first; jitter_s: as much more, evenly
    drawn, at most; lose: so many answers do not come
    (-1: none does); loss: share of answers that do not come; busy: so many answers are 'device busy'; corrupt: so many
    have a wrong checksum or, on TCP, a wrong transaction; shape: 'good', 'garbage', 'truncated', 'foreign' (another
    unit's answer)."""

    def __init__(self, unit: int, function: int, read: Callable[[int], int | None], seed: int) -> None:
        self.unit, self.function, self.read, self.random = unit, function, read, random.Random(seed)
        self.mend()

    def mend(self) -> None:
        """As the maker built it."""
        self.delays_s: tuple[float, ...]
        self.delays_s, self.jitter_s, self.loss = (0.0,), 0.0, 0.0
        self.lose = self.busy = self.corrupt = 0
        self.shape = "good"
        self.asked, self.lost = getattr(self, "asked", 0), getattr(self, "lost", 0)

    def answer(self, request: bytes) -> bytes | None:
        """The PDU that answers a request's PDU, or None."""
        self.asked += 1
        if self.lose or (self.loss and self.random.random() < self.loss):
            self.lose -= self.lose > 0
            self.lost += 1
            return None
        if self.busy:
            self.busy -= 1
            return bytes((request[0] | 0x80, BUSY))
        if request[0] != self.function or len(request) != 5:
            return bytes((request[0] | 0x80, ILLEGAL_FUNCTION))
        first, count = struct.unpack(">HH", request[1:])
        words = [self.read(k) for k in range(first, first + count)]
        if not words or None in words:
            return bytes((request[0] | 0x80, ILLEGAL_ADDRESS))
        return bytes((request[0], 2 * count)) + struct.pack(f">{count}H", *words)

    def latency_s(self) -> float:
        """How long this answer takes inside the device."""
        delays = self.delays_s
        return delays[self.asked % len(delays)] + self.jitter_s * self.random.random()

    def spoilt(self, frame: bytes) -> bytes:
        """The frame as `shape` wants it."""
        if self.shape == "garbage":
            return bytes(self.random.randrange(256) for _ in frame)
        return frame[: len(frame) // 2] if self.shape == "truncated" else frame


class Server:
    """Registers behind a line: `take` bytes, `due` gives the answers whose time has come. One request at a time."""

    def __init__(self, registers: Registers, turn_s: float = 0.0) -> None:
        self.registers, self.turn_s, self.rest = registers, turn_s, b""
        self.waiting: list[tuple[float, bytes]] = []

    def due(self, now_s: float) -> bytes:
        """Answers to be sent now."""
        ready = b"".join(data for at, data in self.waiting if at <= now_s)
        self.waiting = [w for w in self.waiting if w[0] > now_s]
        return ready

    def clear(self) -> None:
        """The connection is gone."""
        self.rest, self.waiting = b"", []

    def _answer(self, at_s: float, frame: bytes) -> None:
        self.waiting.append((at_s + self.turn_s + self.registers.latency_s(), self.registers.spoilt(frame)))


class TcpServer(Server):
    """Modbus TCP: transaction, protocol 0, length, unit, PDU."""

    def take(self, data: bytes, now_s: float) -> None:
        """Bytes of the client."""
        self.rest += data
        while len(self.rest) >= 8:
            transaction, _, length, unit = struct.unpack_from(">HHHB", self.rest)
            if len(self.rest) < 6 + length:
                return
            request, self.rest = self.rest[7 : 6 + length], self.rest[6 + length :]
            pdu = self.registers.answer(request)
            if pdu is None:
                continue
            if self.registers.corrupt:
                self.registers.corrupt -= 1
                transaction ^= 0x5555
            unit = unit + 1 if self.registers.shape == "foreign" else unit
            self._answer(now_s, struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu)


class RtuServer(Server):
    """Modbus RTU on a line of `baud`: unit, PDU, CRC; a frame takes 11 bits a byte."""

    def __init__(self, registers: Registers, baud: int, turn_s: float) -> None:
        super().__init__(registers, turn_s)
        self.byte_s = 11.0 / baud

    def take(self, data: bytes, now_s: float) -> None:
        """Bytes of the line; what is no request of eight bytes with a right CRC is passed over."""
        self.rest = (self.rest + data)[-256:]
        while len(self.rest) >= 8:
            if modbus_crc(self.rest[:6]) != self.rest[6:8]:
                self.rest = self.rest[1:]
                continue
            frame, self.rest = self.rest[:8], self.rest[8:]
            if frame[0] != self.registers.unit:
                continue
            pdu = self.registers.answer(frame[1:6])
            if pdu is None:
                continue
            unit = frame[0] + 1 if self.registers.shape == "foreign" else frame[0]
            body = bytes((unit,)) + pdu
            crc = modbus_crc(body)
            if self.registers.corrupt:
                self.registers.corrupt -= 1
                crc = bytes((crc[0] ^ 0x10, crc[1]))
            self._answer(now_s + self.byte_s * (8 + len(body) + 2), body + crc)
