"""Serial ports, and the lines of text that arrive on them.

Ports: "/dev/serial/by-id/..." or "socket://host:port", a serial line behind a network adapter. pyserial opens
and configures the line, exclusively, so that a second program is refused. The tick then reads and writes the
bare descriptor without waiting.
"""

from __future__ import annotations

import errno
import os
import re
import socket
import termios
import time

import serial

from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.latency_timer import set_latency_timer
from thermoctl_hal.base.profile import LineSettings

NETWORK = "socket://"
CONNECT_S = 3.0  # longest time to connect to a network adapter
QUIET_S = 0.05  # longest pause within a line or frame: an adapter holds bytes back
MAX_LINE = 1024  # a text line longer than this is garbage
_INPUT, _CHARACTERS = 0, 6  # indices of the input's modes and the special characters in termios' list


class LineReader:
    """Divides received bytes into lines; a line that is too long is dropped up to its end.

    end: the bytes that end a line; empty: CR, LF or both."""

    def __init__(self, end: bytes = b"") -> None:
        self._end = end
        self._buffer = bytearray()
        self._dropping = False
        self._heard_s = 0.0  # time of the newest bytes
        self.bad = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, in order, without their ends."""
        self._heard_s = time.monotonic()
        self._buffer += data
        text = bytes(self._buffer)
        *lines, rest = text.split(self._end) if self._end else text.replace(b"\r", b"\n").split(b"\n")
        if lines and self._dropping:
            lines, self._dropping = lines[1:], False
        if len(rest) > MAX_LINE:
            self.bad += not self._dropping
            rest, self._dropping = rest[:MAX_LINE], True
        self._buffer[:] = rest
        return [line for line in lines if 0 < len(line) <= MAX_LINE]

    @property
    def pending(self) -> int:
        """Count the bytes of a line that has no end yet."""
        return len(self._buffer)

    def drop_half(self, period_s: float) -> None:
        """Drop an incomplete line if its rest is lost: nothing came for most of `period_s`."""
        if time.monotonic() - self._heard_s > min(QUIET_S, 0.7 * period_s):
            self.reset()

    def reset(self, is_amid: bool = False) -> None:
        """Drop an incomplete line. is_amid: drop the next one, too, which may be the end of a line."""
        self._buffer.clear()
        self._dropping = is_amid


def open_port(path: str, line: LineSettings) -> serial.Serial | socket.socket:
    """Open a serial port exclusively, or socket://host:port, non-blocking.

    Raises HardwareError with the remedy."""
    if path.startswith(NETWORK):
        match = re.fullmatch(r"socket://(\[[^]]+\]|[^:/]+):(\d+)/?", path)
        if match is None:
            raise HardwareError(f"port '{path}': socket://host:port was expected")
        return connected(path, match[1], match[2], CONNECT_S)
    try:
        port = serial.Serial(
            path,
            line.baud,
            bytesize=line.data_bits,
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
        settings[_INPUT] |= (
            termios.INPCK
        )  # a character with wrong parity or stop bit arrives as 0, not as data
        # Without data, a read raises EAGAIN: an empty result means that the port is gone.
        settings[_CHARACTERS][termios.VMIN] = 1
        termios.tcsetattr(port.fileno(), termios.TCSANOW, settings)
        termios.tcflush(port.fileno(), termios.TCIOFLUSH)
        os.set_blocking(port.fileno(), False)
    except (OSError, termios.error) as e:  # unplugged meanwhile; termios.error is not an OSError
        port.close()
        raise HardwareError(f"{path}: gone while it was opened ({e})") from None
    return port


def connected(where: str, host: str, number: str, timeout_s: float) -> socket.socket:
    """Connect to a port of a host, non-blocking. Raises HardwareError, which names `where`."""
    try:
        port = socket.create_connection((host.strip("[]"), int(number)), timeout_s)
        port.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        port.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        port.setblocking(False)
    except (OSError, OverflowError) as e:
        raise HardwareError(f"{where}: nobody answers ({e}): check power, network and address") from None
    return port
