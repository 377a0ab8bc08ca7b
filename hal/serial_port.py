# cython: annotation_typing=False, cdivision=True
"""Serial devices: framed bytes with a CRC, and lines of text.

pyserial opens and configures the line, exclusively, so that a second program is refused. The tick then reads
and writes the bare descriptor without waiting. hal.wire.Framer finds the frames in the bytes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import termios
from array import array
from pathlib import Path

import serial

from hal.backend import HardwareError, Sample
from hal.binding import Binding
from hal.device import Device
from hal.profile import BinaryFrame, LineSettings, TextField, TextLine, typed
from hal.text_number import cut_short, number, shown, why_no_match, why_no_number
from hal.wire import Framer, read_available, wait_readable

MAX_LINE = 1024  # a text line longer than this is garbage
_CHARACTERS = 6  # place of the special characters in termios' list


class LineReader:
    """Bytes in, lines out; a line that is too long is dropped up to its end."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._dropping = False
        self.bad = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, in order, without CR and LF."""
        self._buffer += data
        *lines, rest = bytes(self._buffer).replace(b"\r", b"\n").split(b"\n")
        if lines and self._dropping:
            lines, self._dropping = lines[1:], False
        if len(rest) > MAX_LINE:
            self.bad += not self._dropping
            rest, self._dropping = b"", True
        self._buffer[:] = rest
        return [line for line in lines if 0 < len(line) <= MAX_LINE]

    @property
    def pending(self) -> int:
        """Count the bytes of a line that has no end yet."""
        return MAX_LINE if self._dropping else len(self._buffer)

    def reset(self) -> None:
        """Drop an incomplete line."""
        self._buffer.clear()
        self._dropping = False


def open_port(path: str, line: LineSettings) -> serial.Serial:
    """Open and configure a serial port exclusively, non-blocking. Raises HardwareError with the remedy."""
    try:
        port = serial.Serial(
            path,
            line.baud,
            parity=line.parity,
            stopbits=line.stop_bits,
            timeout=0,
            write_timeout=0,
            exclusive=True,
        )
    except (OSError, ValueError, termios.error) as e:
        code = getattr(e, "errno", None)
        hint = {
            errno.ENOENT: "no such device: is it plugged in? prefer a name of /dev/serial/by-id",
            errno.EACCES: "permission denied: add the user to the group of the device (dialout)",
            errno.EAGAIN: "in use by another program: stop it first",
            errno.EBUSY: "in use by another program: stop it first",
            errno.EINVAL: f"cannot do {line.baud} baud, parity {line.parity}: see the profile's 'line'",
        }.get(code or 0, str(e))
        raise HardwareError(f"{path}: {hint}") from None
    if line.latency_timer_ms:
        set_latency_timer(path, line.latency_timer_ms)
    try:
        settings = termios.tcgetattr(port.fileno())
        settings[_CHARACTERS][termios.VMIN] = 1  # 'nothing yet' is EAGAIN, so that no bytes mean 'gone'
        termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)
        termios.tcflush(port.fileno(), termios.TCIOFLUSH)
        os.set_blocking(port.fileno(), False)
    except (OSError, termios.error) as e:  # unplugged meanwhile; termios.error is no OSError
        port.close()
        raise HardwareError(f"{path}: gone while it was opened ({e})") from None
    return port


def set_latency_timer(path: str, ms: int, sys_root: str = "/sys") -> bool:
    """Set an FTDI adapter's latency timer; by default it holds bytes back for up to 16 ms.

    False when the port has no such timer or the system refuses."""
    try:
        _latency_timer(path, sys_root).write_text(str(ms))
        return True
    except OSError:
        return False


def latency_timer_ms(path: str, sys_root: str = "/sys") -> int | None:
    """Return the FTDI latency timer in ms, None when the port has no such timer (for doctor)."""
    try:
        return int(_latency_timer(path, sys_root).read_text())
    except (OSError, ValueError):
        return None


def _latency_timer(path: str, sys_root: str) -> Path:
    adapter = os.path.basename(os.path.realpath(path))
    return Path(sys_root, "bus/usb-serial/devices", adapter, "latency_timer")


class SerialDevice(Device):
    """A device that streams (or answers requests with) binary frames or text lines."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        self._port: serial.Serial | None = None
        self._fd = -1
        spec = binding.profile.bus_spec
        self._framer: Framer | None = None
        self._lines = LineReader()
        self._due_s, self._waited = 0.0, False
        self._unread, self._why = 0, ""  # lines since the last reading, and why the last of them gave none
        if isinstance(spec, BinaryFrame):
            self._framer = Framer(spec)
            names = [n for n, _ in spec.fields]
            self._index = array("i", [names.index(typed(b.channel.source, str)) for b in binding.bounds])
            self._flags = names.index(spec.invalid[0]) if spec.invalid else -1
            self._bad_flags: int = spec.invalid[1] if spec.invalid else 0
        else:
            self._text = typed(spec, TextLine)
            self._fields = [typed(b.channel.source, TextField) for b in binding.bounds]

    def connect(self) -> None:
        """Open the port; frames in its buffer are dropped."""
        self._port = open_port(self.binding.port, self.binding.profile.line)
        self._fd = self._port.fileno()
        self._lines.reset()
        self._waited, self._unread = False, 0
        if self._framer:
            self._framer.reset()

    def disconnect(self) -> None:
        """Close the port."""
        port, self._port, self._fd = self._port, None, -1
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    def wait_frame(self, until_ns: int) -> bool:
        """Wait for a whole frame, at most until `until_ns` (monotonic clock); True when one came.

        The next `read` stores it."""
        framer = self._framer
        while not self._waited:
            if framer is not None and framer.read(self._fd):
                self._waited = True
            elif not wait_readable(self._fd, until_ns):
                return False
        return True

    def read(self, sample: Sample, now_s: float) -> None:
        """Put the newest frame or line into `sample`."""
        framer = self._framer
        if framer is None:
            self._take_lines(sample, read_available(self._fd), now_s)
        elif framer.read(self._fd) or self._waited:
            self._waited = False
            flags = framer.whole(self._flags) & self._bad_flags if self._flags >= 0 else 0
            if flags:
                self.fail_all(sample, f"reports an error (status 0x{flags:X}): check the sensor")
            else:
                for i in range(len(self._index)):
                    self.put(sample, i, framer.number(self._index[i]), now_s)

    def counters(self) -> dict[str, int]:
        """Return frames, errors (bad frames), lost (gaps of the sequence), reconnections."""
        if self._framer is not None:
            framer = self._framer
            self.counts.update(frames=framer.frames, errors=framer.bad, lost=framer.lost)
        return self.counts

    def silence(self) -> str:
        """Say what arrives instead of a reading."""
        framer, baud = self._framer, self.binding.profile.line.baud
        if framer is None:
            if self._unread:
                return f"{self._unread} lines gave no reading; {self._why}"
            if self._lines.pending:
                return f"{self._lines.pending} bytes came and no line end (CR or LF): check baud {baud} and parity"
            return super().silence()
        if not framer.quiet_bytes:
            return super().silence()
        came = f"{framer.quiet_bytes} bytes came"
        if framer.quiet_sums > framer.quiet_lengths:
            return (
                f"{came}, {framer.quiet_sums} frames with a wrong CRC: "
                f"check 'crc', 'crc_endian', 'fields', baud {baud}"
            )
        if framer.quiet_lengths:
            return (
                f"{came}, {framer.quiet_lengths} frames with another length byte than {framer.spec.payload.size}: "
                f"check 'length', 'fields' and baud {baud}"
            )
        sync = framer.spec.sync.hex(" ")
        return f"{came} without a whole frame that begins with {sync}: check 'sync' and baud {baud}"

    def _take_lines(self, sample: Sample, data: bytes, now_s: float) -> None:
        spec = self._text
        if spec.request and now_s >= self._due_s:
            self._due_s = now_s + 1.0 / spec.request_hz
            with contextlib.suppress(BlockingIOError):  # the line is full: ask again at the next due time
                os.write(self._fd, spec.request)
        for raw in self._lines.feed(data) if data else ():
            line = raw.decode("ascii", "replace")
            problem = self._take_line(sample, line, now_s)
            if problem:
                self.counts["errors"] += 1
                self._unread, self._why = self._unread + 1, problem
            else:
                self.counts["frames"] += 1
                self._unread = 0

    def _take_line(self, sample: Sample, line: str, now_s: float) -> str:
        """Store the readings of a line; return '', or the reason when it gave none.

        A line with one number that cannot be read gives no reading at all."""
        spec = self._text
        match = spec.pattern.match(line)
        if match is None:
            return why_no_match(line, spec.pattern)
        values: list[tuple[int, float]] = []
        for i, field in enumerate(self._fields):
            text = match[field.group]
            if text is None:  # a reading of another kind of line
                continue
            value = number(text, field.base, spec.decimal)
            if value is None:
                return why_no_number(text, line, field.base, spec.decimal)
            if cut_short(line, match, field.group):
                return (
                    f"received {shown(line)}: the number goes on behind {shown(text)}, where the pattern ends: "
                    "end it with $"
                )
            values.append((i, value))
        for i, value in values:
            self.put(sample, i, value, now_s)
        return ""
