"""The emulators' ends of a pseudo terminal and of a TCP connection, and the checksums of their protocols.

Nothing of `hal` is used here: the frames come from the protocols' public descriptions, so that an error in our own
encoders cannot hide one in our decoders.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import socket
import struct
import termios
import tty
from pathlib import Path


def _crc_table(polynomial: int) -> tuple[int, ...]:
    """Table of a reflected 16-bit CRC."""
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (polynomial if byte & 1 else 0)
        table.append(byte)
    return tuple(table)


_TABLE = _crc_table(0xA001)


def modbus_crc(data: bytes) -> bytes:
    """CRC-16 of Modbus (start 0xFFFF, polynomial 0x8005 reflected), low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return bytes((crc & 0xFF, crc >> 8))


def waiting(fd: int) -> int:
    """Bytes that can be read from a terminal. To read or select an empty one waits for a worker of the kernel, which a
    busy machine runs tens of milliseconds late."""
    return int(struct.unpack("i", fcntl.ioctl(fd, termios.FIONREAD, bytes(4)))[0])


class Pty:
    """A serial port at `path` that can be unplugged. Bytes that nobody reads are lost, as on a wire."""

    def __init__(self, path: Path) -> None:
        self.path, self.fd = path, -1
        self.plug()

    def plug(self) -> None:
        """Make the port; the program at the other end opens `path`."""
        if self.fd >= 0:
            return
        self.fd, slave = pty.openpty()
        tty.setraw(slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(self.fd, False)

    def unplug(self) -> None:
        """Take the port away: whoever has it open gets an error, as with a USB adapter."""
        if self.fd >= 0:
            self.path.unlink(missing_ok=True)
            os.close(self.fd)
            self.fd = -1

    def read(self) -> bytes:
        """What has arrived; nothing while nobody has the port open."""
        if self.fd < 0 or not waiting(self.fd):
            return b""
        try:
            return os.read(self.fd, 4096)
        except OSError:  # EAGAIN; EIO while nobody has it open
            return b""

    def write(self, data: bytes) -> None:
        """Send; what does not fit into the buffer is lost."""
        if self.fd >= 0 and data:
            with contextlib.suppress(OSError):
                os.write(self.fd, data)


class Canary:
    """A terminal with both ends here: how late its bytes come is how late the kernel moves those of the others."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.sent_s = -1.0

    def late_s(self, now_s: float) -> float:
        """Age of the byte that has not yet come, 0 without one; the next one is sent when it has."""
        if self.sent_s >= 0.0 and not waiting(self.slave):
            return now_s - self.sent_s
        if self.sent_s >= 0.0:
            os.read(self.slave, 1)
        os.write(self.master, b".")
        self.sent_s = now_s
        return 0.0


class TcpPort:
    """A TCP server with one client, the newest. `plugged` False: the connection is cut and new ones are refused."""

    def __init__(self, port: int) -> None:
        self.port, self.client = port, None
        self.listener: socket.socket | None = None
        self.plug()

    def plug(self) -> None:
        """Listen."""
        if self.listener is None:
            self.listener = socket.socket()
            self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.listener.bind(("127.0.0.1", self.port))
            self.listener.listen(4)
            self.listener.setblocking(False)

    def drop(self) -> None:
        """Cut the connection; the next one is taken."""
        if self.client is not None:
            self.client.close()
            self.client = None

    def unplug(self) -> None:
        """Cut the connection and refuse new ones."""
        self.drop()
        if self.listener is not None:
            self.listener.close()
            self.listener = None

    def read(self) -> bytes:
        """What has arrived."""
        if self.listener is not None:
            with contextlib.suppress(BlockingIOError):
                connection, _ = self.listener.accept()
                self.drop()
                connection.setblocking(False)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.client = connection
        if self.client is None:
            return b""
        try:
            data = self.client.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self.drop()
        return data

    def write(self, data: bytes) -> None:
        """Send."""
        if self.client is not None:
            try:
                self.client.sendall(data)
            except OSError:
                self.drop()
