"""Serial devices: framed bytes with a CRC, and lines of text.

A binary frame on the wire:   sync (1..8 bytes) | length (uint8, optional) | payload | CRC-16 over all that follows sync

pyserial opens and configures the line (exclusive, so that a second program is refused); the tick then reads and writes
the bare descriptor without waiting. Framing resynchronises after garbage: a frame whose length or CRC is wrong costs
its first byte, and the search goes on from the next one, so a true frame behind a false sync is never lost.
"""
from __future__ import annotations

import binascii
import contextlib
import errno
import os
import struct
import termios
from collections.abc import Callable
from pathlib import Path

import serial

from hal.backend import HardwareError, Sample
from hal.devices import Device
from hal.profile import BinaryFrame, Binding, LineSettings

MAX_LINE = 1024             # a text line longer than this is garbage
MAX_READ = 4096
MAX_BUFFER = 8192


def _reflected_table(polynomial: int) -> tuple[int, ...]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ polynomial if byte & 1 else byte >> 1
        table.append(byte)
    return tuple(table)


_MODBUS = _reflected_table(0xA001)


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0x8005 reflected, start 0xFFFF. Check value of b'123456789': 0x4B37."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _MODBUS[(crc ^ byte) & 0xFF]
    return crc


CRC16: dict[str, Callable[[bytes], int]] = {
    "ccitt-false": lambda data: binascii.crc_hqx(data, 0xFFFF),      # polynomial 0x1021, check value 0x29B1
    "xmodem": lambda data: binascii.crc_hqx(data, 0),                # check value 0x31C3
    "modbus": crc16_modbus}


class Framer:
    """Bytes in, frames out. `newest` is the payload tuple of the last good frame; counters tell the rest."""

    def __init__(self, spec: BinaryFrame) -> None:
        self.spec, self._payload, self._crc = spec, spec.payload, CRC16[spec.crc]
        self._crc_order = "little" if spec.crc_endian == "<" else "big"
        self._head = len(spec.sync) + spec.has_length
        self._size = self._head + self._payload.size + 2
        self._buffer = bytearray()
        names = [n for n, _ in spec.fields]
        self._sequence = names.index(spec.sequence) if spec.sequence else -1
        self.modulus = 256 ** struct.calcsize(self._payload.format[1 + self._sequence]) if spec.sequence else 0
        self.newest: tuple = ()
        self.frames = self.bad = self.skipped = self.lost = 0

    def encode(self, *values: float) -> bytes:
        """A frame with these field values."""
        body = (bytes([self._payload.size]) if self.spec.has_length else b"") + self._payload.pack(*values)
        return self.spec.sync + body + self._crc(body).to_bytes(2, self._crc_order)     # type: ignore[arg-type]

    def feed(self, data: bytes) -> int:
        """Take bytes; returns how many good frames they completed. `bad` counts wrong lengths and CRCs, `skipped` bytes
        outside frames, `lost` gaps of the sequence counter."""
        buffer, sync, size, good = self._buffer, self.spec.sync, self._size, 0
        buffer += data
        at = 0
        while at < len(buffer):
            start = buffer.find(sync, at)
            if start < 0:
                keep = max(at, len(buffer) - len(sync) + 1)       # the tail may be the beginning of a sync
                self.skipped += keep - at
                at = keep
                break
            self.skipped += start - at
            at = start
            if self.spec.has_length and len(buffer) > at + len(sync) and buffer[at + len(sync)] != self._payload.size:
                self.bad += 1
                self.skipped += 1
                at += 1
                continue
            if len(buffer) - at < size:
                break
            end = at + size
            if self._crc(bytes(buffer[at + len(sync):end - 2])) != int.from_bytes(
                    buffer[end - 2:end], self._crc_order):                              # type: ignore[arg-type]
                self.bad += 1
                self.skipped += 1
                at += 1
                continue
            values = self._payload.unpack_from(buffer, at + self._head)
            if self._sequence >= 0 and self.newest:
                self.lost += (values[self._sequence] - self.newest[self._sequence] - 1) % self.modulus
            self.newest = values
            good += 1
            at = end
        del buffer[:at]
        self.frames += good
        return good

    def reset(self) -> None:
        """Forget half a frame and the sequence (after a reconnection)."""
        self._buffer.clear()
        self.newest = ()


class LineReader:
    """Bytes in, lines out; a line that is too long is dropped up to its end."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._dropping = False
        self.bad = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Complete lines (without their CR, LF), in order."""
        self._buffer += data
        *lines, rest = bytes(self._buffer).replace(b"\r", b"\n").split(b"\n")
        if lines and self._dropping:
            lines, self._dropping = lines[1:], False
        if len(rest) > MAX_LINE:
            self.bad += not self._dropping
            rest, self._dropping = b"", True
        self._buffer[:] = rest
        return [line for line in lines if 0 < len(line) <= MAX_LINE]

    def reset(self) -> None:
        """Forget half a line."""
        self._buffer.clear()
        self._dropping = False


def open_port(path: str, line: LineSettings, what: str) -> serial.Serial:
    """Open and configure a serial port exclusively, non-blocking. Raises HardwareError with what to do."""
    try:
        port = serial.Serial(path, line.baud, parity=line.parity, stopbits=line.stop_bits, timeout=0, write_timeout=0,
                             exclusive=True)
    except (OSError, ValueError, termios.error) as e:
        code = getattr(e, "errno", None)
        hint = {errno.ENOENT: "no such device: is it plugged in? prefer a name of /dev/serial/by-id",
                errno.EACCES: "permission denied: add the user to the group of the device (dialout)",
                errno.EAGAIN: "in use by another program: stop it first",
                errno.EBUSY: "in use by another program: stop it first",
                errno.EINVAL:
                f"cannot do {line.baud} baud, parity {line.parity}: see the profile's 'line'"}.get(code or 0, str(e))
        raise HardwareError(f"{what}: {path}: {hint}") from None
    if line.latency_timer_ms:
        set_latency_timer(path, line.latency_timer_ms)
    settings = termios.tcgetattr(port.fileno())
    settings[6][termios.VMIN] = 1           # so that 'nothing yet' (EAGAIN) differs from 'gone' (no bytes)
    termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)
    os.set_blocking(port.fileno(), False)
    return port


def set_latency_timer(path: str, ms: int, sys_root: str = "/sys") -> bool:
    """Set an FTDI adapter's latency timer (it holds bytes back for up to 16 ms by default). False where the port has
    none or the system refuses."""
    timer = Path(sys_root, "bus/usb-serial/devices", os.path.basename(os.path.realpath(path)), "latency_timer")
    try:
        timer.write_text(str(ms))
        return True
    except OSError:
        return False


def latency_timer_ms(path: str, sys_root: str = "/sys") -> int | None:
    """The FTDI latency timer in ms, or None where the port has none (for doctor)."""
    timer = Path(sys_root, "bus/usb-serial/devices", os.path.basename(os.path.realpath(path)), "latency_timer")
    try:
        return int(timer.read_text())
    except (OSError, ValueError):
        return None


def read_available(fd: int) -> bytes:
    """What has arrived, without waiting; b'' when nothing has. Raises OSError when the other end is gone."""
    try:
        data = os.read(fd, MAX_READ)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError(errno.EIO, "the port was closed at the other end")
    return data


class SerialDevice(Device):
    """A device that streams (or answers requests with) binary frames or text lines."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        self._port: serial.Serial | None = None
        self._fd = -1
        spec = binding.profile.bus_spec
        self._framer = Framer(spec) if isinstance(spec, BinaryFrame) else None
        self._lines = LineReader()
        self._due_s = 0.0
        if self._framer:
            names = [n for n, _ in spec.fields]
            self._index = [names.index(b.channel.source) for b in binding.bounds]
            self._invalid = (names.index(spec.invalid[0]), spec.invalid[1]) if spec.invalid else (-1, 0)

    def connect(self) -> None:
        """Open the port; frames in its buffer are dropped."""
        self._port = open_port(self.binding.port, self.binding.profile.line, self.name)
        self._fd = self._port.fileno()
        termios.tcflush(self._fd, termios.TCIOFLUSH)
        self._lines.reset()
        if self._framer:
            self._framer.reset()

    def disconnect(self) -> None:
        """Close the port."""
        port, self._port, self._fd = self._port, None, -1
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Newest frame or line into `sample`."""
        data = read_available(self._fd)
        if self._framer:
            if data:
                self._take_frames(sample, data, now_s)
        else:
            self._take_lines(sample, data, now_s)

    def _take_frames(self, sample: Sample, data: bytes, now_s: float) -> None:
        framer = self._framer
        assert framer is not None
        if framer.feed(data):
            values = framer.newest
            field, mask = self._invalid
            if field >= 0 and values[field] & mask:
                self.fail_all(sample, f"reports an error (status 0x{values[field] & mask:X}): check the sensor")
            else:
                for i, index in enumerate(self._index):
                    self.put(sample, i, values[index], now_s)
        counts = self.counts
        counts["frames"], counts["errors"], counts["lost"] = framer.frames, framer.bad, framer.lost

    def _take_lines(self, sample: Sample, data: bytes, now_s: float) -> None:
        spec = self.binding.profile.bus_spec
        if spec.request and now_s >= self._due_s:
            self._due_s = now_s + 1.0 / spec.request_hz
            os.write(self._fd, spec.request)
        for line in self._lines.feed(data) if data else ():
            match = spec.pattern.match(line.decode("ascii", "replace"))
            if match is None:
                self.counts["errors"] += 1
                continue
            self.counts["frames"] += 1
            for i, bound in enumerate(self.binding.bounds):
                try:
                    self.put(sample, i, float(match[bound.channel.source]), now_s)
                except (ValueError, TypeError):
                    self.counts["errors"] += 1
