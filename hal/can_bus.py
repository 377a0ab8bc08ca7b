# cython: annotation_typing=False, cdivision=True
"""CAN ports that the tick can use without waiting.

A port is written "interface:channel@bitrate"; the default bitrate is 1000000.

    slcan:/dev/serial/by-id/...   Lawicel ASCII on a serial port, read and written on the bare descriptor
                                  (python-can's own slcan reads one byte a call, 150 us a frame)
    socketcan:can0                python-can opens it and sets the kernel's filters; frames pass on the socket
    virtual:name, others          through python-can

Identifiers of 29 bits carry the bit EXTENDED everywhere, so that they never match an 11-bit one of the same
number. Remote frames, error frames and CAN FD frames are counted and otherwise ignored.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
from typing import Any

from hal.backend import HardwareError
from hal.profile import LineSettings
from hal.serial_port import open_port
from hal.wire import EXTENDED, CanPort, SlcanLine

MAX_TAKEN = 500  # most frames that one tick takes from a bus: bounds the time of a tick on a full bus
MAX_REFUSED = 100  # the bus counts as lost after so many refused frames in a row
_SLCAN_BITRATES = {
    10_000: 0,
    20_000: 1,
    50_000: 2,
    100_000: 3,
    125_000: 4,
    250_000: 5,
    500_000: 6,
    800_000: 7,
    1_000_000: 8,
}
_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of the kernel
_REMOTE, _ERROR_FLAG, _BUS_OFF = 0x4000_0000, 0x2000_0000, 0x40


class SlcanPort(SlcanLine):
    """A Lawicel adapter on a serial port, opened with its bitrate set."""

    def __init__(self, path: str, bitrate: int) -> None:
        if bitrate not in _SLCAN_BITRATES:
            raise HardwareError(
                f"slcan:{path}: bitrate {bitrate} is not one of {', '.join(map(str, _SLCAN_BITRATES))}"
            )
        self._port = open_port(path, LineSettings(baud=3_000_000))
        super().__init__(self._port.fileno())
        os.write(self._port.fileno(), b"\r\rC\rS%d\rO\r" % _SLCAN_BITRATES[bitrate])

    @property
    def bad(self) -> int:
        """Count lines that are no frame, and frames that the adapter refused."""
        return self.parser.bad + self.parser.refused

    @property
    def ignored(self) -> int:
        """Count remote frames and CAN FD frames."""
        return self.parser.ignored

    def close(self) -> None:
        """Close the channel and the line."""
        with contextlib.suppress(OSError):
            os.write(self._port.fileno(), b"C\r")
        with contextlib.suppress(OSError):
            self._port.close()


class LibraryPort(CanPort):
    """An interface opened by python-can; SocketCAN frames pass on the bare socket."""

    def __init__(self, interface: str, channel: str, bitrate: int, ids: tuple[int, ...]) -> None:
        import can  # takes a second; rigs on slcan do not need it

        self._library: Any = can
        in_kernel = [_kernel_filter(i) for i in ids] if interface == "socketcan" else None
        self._wanted = None if in_kernel or not ids else frozenset(ids)
        self._bus: Any
        try:
            self._bus = can.Bus(channel, interface=interface, bitrate=bitrate, can_filters=in_kernel)
        except (can.CanError, OSError, ValueError, ImportError) as e:
            raise HardwareError(
                f"{interface}:{channel}: cannot be opened ({e}); is the interface up (ip link set "
                f"{channel} up type can bitrate {bitrate})?"
            ) from None
        self._socket: Any = self._bus.socket if interface == "socketcan" else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self.bad = self.ignored = self._pending = 0

    def flush(self) -> int:
        """Send the queued frames, without waiting. Raises OSError when the bus is gone or full."""
        for can_id, data in self.queued():
            try:
                self._send(can_id, data)
                self._pending = 0
            except (BlockingIOError, self._library.CanError) as e:
                self._queue_full(e)
            except OSError as e:
                if e.errno != errno.ENOBUFS:
                    raise
                self._queue_full(e)
            except Exception as e:  # interfaces of python-can raise errors of their own
                raise OSError(errno.EIO, f"{type(e).__name__}: {e}") from None
        return 0

    def _send(self, can_id: int, data: bytes) -> None:
        if self._socket is not None:
            self._socket.send(_FRAME.pack(can_id, len(data), data))
            return
        extended = bool(can_id & EXTENDED)
        message = self._library.Message
        self._bus.send(message(arbitration_id=can_id & ~EXTENDED, data=data, is_extended_id=extended))

    def _queue_full(self, why: Exception) -> None:
        self.bad += 1
        self._pending += 1
        if self._pending > MAX_REFUSED:
            raise OSError(errno.ENOBUFS, f"nobody on the bus takes frames ({why})")

    def take(self) -> int:
        """Take the frames that have arrived; return how many.

        Raises OSError: interface down; HardwareError: bus-off."""
        self.begin()
        take = self._take_message if self._socket is None else self._take_raw
        taken = 0
        while taken < MAX_TAKEN and (found := take()) >= 0:
            taken += found
        return taken

    def _take_message(self) -> int:
        """Take the library's next message; 1 when it was delivered, 0 when not, -1 when there is none."""
        message = self._receive()
        if message is None:
            return -1
        can_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
        if message.is_error_frame:
            self.bad += 1
        elif message.is_remote_frame or message.is_fd:
            self.ignored += 1
        elif self._wanted is None or can_id in self._wanted:
            return int(self.deliver(can_id, bytes(message.data)))
        return 0

    def _take_raw(self) -> int:
        """Take the next frame of the kernel's socket; the result is that of `_take_message`."""
        try:
            raw = self._socket.recv(_FRAME.size)
        except BlockingIOError:
            return -1
        if len(raw) != _FRAME.size:
            self.ignored += 1
            return 0
        raw_id, size, data = _FRAME.unpack(raw)
        if raw_id & _ERROR_FLAG:
            self.bad += 1
            if raw_id & _BUS_OFF:
                raise HardwareError("CAN bus-off: check wiring, termination and bitrate")
            return 0
        if raw_id & _REMOTE:
            self.ignored += 1
            return 0
        return int(self.deliver(raw_id, data[:size]))

    def _receive(self) -> Any:
        """Return the library's next message, or None. Raises OSError when the interface failed."""
        try:
            return self._bus.recv(0)
        except OSError:
            raise
        except Exception as e:
            raise OSError(errno.EIO, f"{type(e).__name__}: {e}") from None

    def close(self) -> None:
        """Leave the bus."""
        with contextlib.suppress(Exception):  # interfaces of python-can raise errors of their own
            self._bus.shutdown()


def _kernel_filter(can_id: int) -> dict[str, int | bool]:
    extended = bool(can_id & EXTENDED)
    mask = 0x1FFF_FFFF if extended else 0x7FF
    return {"can_id": can_id & ~EXTENDED, "can_mask": mask, "extended": extended}


def open_can(port: str, ids: tuple[int, ...]) -> SlcanPort | LibraryPort:
    """Open "interface:channel@bitrate" for the frames `ids`. Raises HardwareError."""
    match = re.fullmatch(r"(\w+):(.+?)(?:@(\d+))?", port)
    if match is None:
        raise HardwareError(
            f"port '{port}': interface:channel@bitrate was expected, as slcan:/dev/ttyACM0@1000000"
        )
    bitrate = int(match[3] or 1_000_000)
    if match[1] == "slcan":
        return SlcanPort(match[2], bitrate)
    return LibraryPort(match[1], match[2], bitrate, ids)
