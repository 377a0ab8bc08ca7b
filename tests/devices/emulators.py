"""Devices at byte level for the tests: a Modbus line with several units, a CAN bus behind a Lawicel adapter.

Written from the public protocol descriptions with framing of their own; nothing of `hal` is used.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
import tty
from collections.abc import Callable
from pathlib import Path

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
Frame = tuple[int, bool, bytes]  # CAN id, 29 bits, data


def modbus_crc(data: bytes) -> bytes:
    """CRC-16 of Modbus, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return struct.pack("<H", crc)


def free_port() -> int:
    """Return a TCP port of this machine that nobody listens on."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def words(value: float | int, form: str, little: bool = False) -> list[int]:
    """Registers of a number; form: a letter of struct."""
    data = struct.pack(">" + form, value)
    found = list(struct.unpack(f">{len(data) // 2}H", data))
    return found[::-1] if little else found


class Port:
    """A wire that can be unplugged: a pseudo-terminal at `path`, or a TCP port. A thread serves `take`."""

    def __init__(self, take: Callable[[bytes], bytes], path: Path | None = None) -> None:
        self.take, self.path = take, path
        self.fds: list[int] = []
        self.listener: socket.socket | None = None
        self.number = 0
        self._connections: dict[int, socket.socket] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.plug()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def plug(self) -> None:
        with self._lock:
            if self.path is not None:
                master, self._slave = os.openpty()
                tty.setraw(self._slave)
                os.set_blocking(master, False)
                self.path.unlink(missing_ok=True)
                self.path.symlink_to(os.ttyname(self._slave))
                self.fds = [master]
            else:
                self.listener = socket.socket()
                self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self.listener.bind(("127.0.0.1", self.number))
                self.number = self.listener.getsockname()[1]
                self.listener.listen()

    def unplug(self) -> None:
        with self._lock:
            if self.path is not None and self.fds:
                self.path.unlink(missing_ok=True)
                os.close(self._slave)
                for fd in self.fds:
                    os.close(fd)
            elif self.listener is not None:
                self.listener.shutdown(socket.SHUT_RDWR)  # the serving thread may still wait for it
                self.listener.close()
                self.listener = None
                for connection in self._connections.values():
                    connection.close()
                self._connections.clear()
            self.fds = []

    def send(self, data: bytes) -> None:
        with self._lock:
            for fd in self.fds:
                try:
                    os.write(fd, data)
                except OSError:
                    continue

    def _serve(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                watched = [*self.fds, *([self.listener.fileno()] if self.listener else [])]
            if not watched:
                self._stop.wait(0.005)
                continue
            try:
                ready = select.select(watched, [], [], 0.02)[0]
            except (OSError, ValueError):
                continue
            for fd in ready:
                self._ready(fd)

    def _ready(self, fd: int) -> None:
        with self._lock:
            if self.listener is not None and fd == self.listener.fileno():
                connection, _ = self.listener.accept()
                self._connections[connection.fileno()] = connection
                self.fds.append(connection.fileno())
                return
            if fd not in self.fds:
                return
            try:
                data = os.read(fd, 4096)
            except BlockingIOError:  # the number was of the wire before this one, and was waited for still
                return
            except OSError:
                data = b""
            if not data:
                if self.path is not None:
                    return
                self.fds.remove(fd)
                self._connections.pop(fd).close()
                return
        answer = self.take(data)
        if answer:
            self.send(answer)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)
        self.unplug()


class Unit:
    """Registers of a Modbus unit: table[function][address] = word or bit. `mute`: no answer.

    `strict`: a request that touches an address that is not there is refused. `written`: (function, address,
    values) of every write."""

    def __init__(
        self, tables: dict[int, dict[int, int]], strict: bool = True, on_write: object = None
    ) -> None:
        self.tables, self.strict, self.mute, self.exception = tables, strict, False, 0
        self.written: list[tuple[int, int, tuple[int, ...]]] = []

    def set(self, function: int, address: int, values: list[int]) -> None:
        self.tables.setdefault(function, {}).update({address + k: v & 0xFFFF for k, v in enumerate(values)})

    def pdu(self, request: bytes) -> bytes:
        function = request[0]
        if self.exception:
            return bytes((function | 0x80, self.exception))
        if function in (5, 6):
            address, value = struct.unpack(">HH", request[1:5])
            self._write(function, address, (value,))
            return request[:5]
        if function in (15, 16):
            address, count, _ = struct.unpack(">HHB", request[1:6])
            if function == 16:
                values = struct.unpack(f">{count}H", request[6 : 6 + 2 * count])
            else:
                values = tuple(request[6 + k // 8] >> k % 8 & 1 for k in range(count))
            self._write(function, address, values)
            return request[:5]
        table = self.tables.get(function)
        if table is None:
            return bytes((function | 0x80, ILLEGAL_FUNCTION))
        address, count = struct.unpack(">HH", request[1:5])
        if self.strict and any(a not in table for a in range(address, address + count)):
            return bytes((function | 0x80, ILLEGAL_ADDRESS))
        values = [table.get(a, 0) for a in range(address, address + count)]
        if function > 2:
            return struct.pack(f">BB{count}H", function, 2 * count, *values)
        packed = bytearray((count + 7) // 8)
        for k, bit in enumerate(values):
            packed[k // 8] |= (bit & 1) << k % 8
        return bytes((function, len(packed))) + bytes(packed)

    def _write(self, function: int, address: int, values: tuple[int, ...]) -> None:
        self.written.append((function, address, values))
        table = self.tables.setdefault(1 if function in (5, 15) else 3, {})
        for k, value in enumerate(values):
            table[address + k] = int(value != 0) if function == 5 else value


class ModbusLine:
    """Several units behind one wire. Bytes in, bytes out; RTU or TCP framing."""

    def __init__(self, units: dict[int, Unit], rtu: bool) -> None:
        self.units, self.rtu, self.rest, self.bad = units, rtu, b"", 0
        self.asked: list[int] = []

    def take(self, data: bytes) -> bytes:
        self.rest += data
        return self._rtu() if self.rtu else self._tcp()

    def _answer(self, unit: int, pdu: bytes) -> bytes:
        self.asked.append(unit)
        found = self.units.get(unit)
        return b"" if found is None or found.mute else found.pdu(pdu)

    def _rtu(self) -> bytes:
        out = b""
        while len(self.rest) >= 8:
            size = 9 + self.rest[6] if self.rest[1] in (15, 16) else 8
            if len(self.rest) < size:
                break
            frame, self.rest = self.rest[:size], self.rest[size:]
            if modbus_crc(frame[:-2]) != frame[-2:]:
                self.rest, self.bad = b"", self.bad + 1
                break
            pdu = self._answer(frame[0], frame[1:-2])
            if pdu:
                out += frame[:1] + pdu + modbus_crc(frame[:1] + pdu)
        return out

    def _tcp(self) -> bytes:
        out = b""
        while len(self.rest) >= 8:
            transaction, _, length, unit = struct.unpack_from(">HHHB", self.rest)
            if len(self.rest) < 6 + length:
                break
            request, self.rest = self.rest[7 : 6 + length], self.rest[6 + length :]
            pdu = self._answer(unit, request)
            if pdu:
                out += struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu
        return out


class SlcanAdapter:
    """A Lawicel adapter with nodes: `nodes` take a frame and return frames. `commands`: what it was told."""

    def __init__(self, *nodes: Callable[[Frame], list[Frame]]) -> None:
        self.nodes, self.rest, self.commands = nodes, b"", list[bytes]()
        self.sent: list[Frame] = []

    def take(self, data: bytes) -> bytes:
        *lines, self.rest = (self.rest + data).split(b"\r")
        out = b""
        for line in lines:
            if line[:1] in (b"t", b"T"):
                digits = 3 if line[:1] == b"t" else 8
                body = bytes.fromhex(line[2 + digits :].decode())
                frame = (int(line[1 : 1 + digits], 16), digits == 8, body)
                self.sent.append(frame)
                out += b"".join(encode(f) for node in self.nodes for f in node(frame))
            elif line:
                self.commands.append(line)
        return out


def encode(frame: Frame) -> bytes:
    """A frame in Lawicel's ASCII."""
    can_id, extended, data = frame
    head = f"T{can_id:08X}" if extended else f"t{can_id:03X}"
    return (head + str(len(data)) + data.hex().upper()).encode() + b"\r"
