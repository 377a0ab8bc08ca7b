# cython: annotation_typing=False, cdivision=True
"""CAN ports that the tick can use without waiting.

A port is written "interface:channel@bitrate,second"; the default bitrate is 1000000.

    slcan:/dev/serial/by-id/...   Lawicel ASCII on a serial port, read and written on the bare descriptor
                                  (python-can's own slcan reads one byte a call, 150 us a frame). `second`
                                  is the baud rate of the adapter's serial side (3000000)
    socketcan:can0                python-can opens it and sets the kernel's filters; frames pass on the socket
    virtual:name, others          through python-can; a thread reads an interface whose receive may block.
                                  `second` is the data bitrate of CAN FD; without it the bus is classic

Identifiers of 29 bits carry the bit EXTENDED everywhere, so that they never match an 11-bit one of the same
number. A device may want a parameter group of J1939 instead. It then gives BY_PGN | number of the group, and
gets its frames from any source address, at any priority. Remote frames and error frames are counted and
otherwise ignored. CAN FD frames are returned separately, by `long_frames`, so that a device which does not
expect them never sees them.

Bus-off: the kernel and gs_usb send error frames, PCAN raises an error, IXXAT reports a state
(`can.BusState.ERROR`). An slcan adapter has no message for it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
import threading
from collections import defaultdict, deque
from typing import Any

from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.line import open_port
from thermoctl_hal.base.profile import LineSettings
from thermoctl_hal.base.wire import EXTENDED, CanPort, SlcanLine

MAX_TAKEN = 500  # most frames that one tick takes from a bus: bounds the time of a tick on a full bus
READ_S = 0.1  # longest wait of a reading thread before it checks whether it has to end
MAX_REFUSED = 100  # the bus counts as lost after so many refused frames in a row
# A bitrate's place is its number in the command S of Lawicel.
_SLCAN_BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)
SLCAN_BAUD = 3_000_000
SHARED = ("socketcan", "virtual", "udp_multicast")  # any number of programs and devices may open these
KERNEL_ERRORS = ("gs_usb", "socketcan", "socketcand")  # interfaces with the kernel's error frames
NEVER_BLOCK = ("virtual", "udp_multicast")  # interfaces whose recv(0) returns at once
_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of the kernel
_FD_FRAME = struct.Struct("=IB3x64s")  # struct canfd_frame
_REMOTE, _ERROR_FLAG, _BUS_OFF = 0x4000_0000, 0x2000_0000, 0x40


BY_PGN = 1 << 32
"""Marks the number of a parameter group among the identifiers that a device wants."""
_PGN, _PGN_TO_ALL, _TO_ONE = 0x3FFFF00, 0x3FF0000, 240  # a PF below 240 is followed by the receiver's address
BUS_OFF = "CAN bus-off: check wiring, termination and bitrate"

NO_FD = (
    "the device takes CAN FD frames: give an interface with a data bitrate, as socketcan:can0@1000000,5000000"
)


def pgn_of(can_id: int) -> int:
    """Return BY_PGN | the parameter group of an identifier of 29 bits; 0 for one of 11 bits."""
    if not can_id & EXTENDED:
        return 0
    is_to_one = can_id >> 16 & 0xFF < _TO_ONE
    return BY_PGN | (can_id & (_PGN_TO_ALL if is_to_one else _PGN)) >> 8


def is_wanted(can_id: int, ids: frozenset[int]) -> bool:
    """Return whether `ids` has the identifier or its parameter group."""
    return can_id in ids or pgn_of(can_id) in ids


class SlcanPort(SlcanLine):
    """A Lawicel adapter on a serial port, opened with its bitrate set."""

    def __init__(self, path: str, bitrate: int, baud: int = SLCAN_BAUD) -> None:
        if bitrate not in _SLCAN_BITRATES:
            raise HardwareError(
                f"slcan:{path}: bitrate {bitrate} is not one of {', '.join(map(str, _SLCAN_BITRATES))}"
            )
        self._port = open_port(path, LineSettings(baud=baud))
        super().__init__(self._port.fileno())
        os.write(self._port.fileno(), b"\r\rC\rS%d\rO\r" % _SLCAN_BITRATES.index(bitrate))

    @property
    def bad(self) -> int:
        """Count lines that are no frame, and frames that the adapter refused."""
        return self.parser.bad + self.parser.refused

    @property
    def ignored(self) -> int:
        """Count remote frames and CAN FD frames."""
        return self.parser.ignored

    def send_long(self, can_id: int, data: bytes) -> None:
        """Refuse a CAN FD frame. Raises HardwareError."""
        raise HardwareError(NO_FD)

    def close(self) -> None:
        """Close the channel and the line."""
        with contextlib.suppress(OSError):
            os.write(self._port.fileno(), b"C\r")
        with contextlib.suppress(OSError):
            self._port.close()


class LibraryPort(CanPort):
    """An interface opened by python-can; SocketCAN frames pass on the bare socket."""

    def __init__(
        self, interface: str, channel: str, bitrate: int, ids: tuple[int, ...], data_bitrate: int = 0
    ) -> None:
        import can  # takes a second; rigs on slcan do not need it

        self._library: Any = can
        in_kernel = [_kernel_filter(i) for i in ids] if interface == "socketcan" and ids else None
        self._wanted = None if in_kernel or not ids else frozenset(ids)
        self._bus: Any
        self._is_fd = bool(data_bitrate)
        self._has_kernel_errors = interface in KERNEL_ERRORS
        more: dict[str, Any] = {"fd": True, "data_bitrate": data_bitrate} if data_bitrate else {}
        if interface == "socketcan":
            more["receive_own_messages"] = False  # also where ~/.canrc sets it
        try:
            self._bus = can.Bus(channel, interface=interface, bitrate=bitrate, can_filters=in_kernel, **more)
        except (can.CanError, OSError, ValueError, ImportError) as e:
            raise HardwareError(
                f"{interface}:{channel}: cannot be opened ({e}); is the interface up (ip link set "
                f"{channel} up type can bitrate {bitrate})?"
            ) from None
        self._socket: Any = self._bus.socket if interface == "socketcan" else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self.bad = self.ignored = self._pending = 0
        self._long: list[tuple[int, bytes]] = []
        self._arrived: deque[Any] | None = None
        self._closing = threading.Event()
        self._reader: threading.Thread | None = None
        if self._socket is None and interface not in NEVER_BLOCK:
            self._arrived = deque(maxlen=MAX_TAKEN)
            self._reader = threading.Thread(target=self._read_on, daemon=True, name=f"read {channel}")
            self._reader.start()

    def _read_on(self) -> None:
        """Receive in a thread; an error is handed on as the last item."""
        arrived = self._arrived
        while arrived is not None and not self._closing.is_set():
            try:
                message = self._bus.recv(READ_S)
                if message is None:
                    self._check_state()
            except Exception as e:  # interfaces of python-can raise errors of their own
                if not self._closing.is_set():
                    arrived.append(e)
                return
            if message is not None:
                arrived.append(message)

    def flush(self) -> int:
        """Send the queued frames, without waiting. Raises OSError when the bus is gone or full."""
        for can_id, data in self.queued():
            try:
                self._send(can_id, data)
                self._pending = 0
            except (BlockingIOError, self._library.CanError) as e:
                if _says_bus_off(e):
                    raise _failed(e) from None
                self._queue_full(e)
            except OSError as e:
                if e.errno != errno.ENOBUFS:
                    raise
                self._queue_full(e)
            except Exception as e:  # interfaces of python-can raise errors of their own
                raise _failed(e) from None
        return 0

    def _send(self, can_id: int, data: bytes) -> None:
        if self._socket is not None:
            self._socket.send(_FRAME.pack(can_id, len(data), data))
            return
        extended = bool(can_id & EXTENDED)
        message = self._library.Message
        self._bus.send(message(arbitration_id=can_id & ~EXTENDED, data=data, is_extended_id=extended))

    def send_long(self, can_id: int, data: bytes) -> None:
        """Send a CAN FD frame at the data bitrate. Raises OSError, HardwareError."""
        if not self._is_fd:
            raise HardwareError(NO_FD)
        extended = bool(can_id & EXTENDED)
        message = self._library.Message(
            arbitration_id=can_id & ~EXTENDED,
            data=data,
            is_extended_id=extended,
            is_fd=True,
            bitrate_switch=True,
        )
        try:
            self._bus.send(message)
        except Exception as e:  # interfaces of python-can raise errors of their own
            raise _failed(e) from None

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
            if message.arbitration_id & _BUS_OFF and self._has_kernel_errors:
                raise HardwareError(BUS_OFF)
            self._check_state()
        elif not message.is_rx:
            pass  # gs_usb and others hand back what we sent
        elif message.is_remote_frame:
            self.ignored += 1
        elif self._wanted is None or is_wanted(can_id, self._wanted):
            return self._sort(can_id, bytes(message.data), message.is_fd)
        return 0

    def _check_state(self) -> None:
        """Raise HardwareError where the interface reports bus-off as its state."""
        try:
            is_off = self._bus.state is self._library.BusState.ERROR
        except Exception:  # many interfaces of python-can have none
            return
        if is_off:
            raise HardwareError(BUS_OFF)

    def _sort(self, can_id: int, data: bytes, is_fd: bool) -> int:
        """Deliver a frame, or keep it for `long_frames`; 1 when it was delivered."""
        if not is_fd:
            return int(self.deliver(can_id, data))
        if len(self._long) < MAX_TAKEN:
            self._long.append((can_id, data))
        return 0

    def long_frames(self) -> list[tuple[int, bytes]]:
        """Return the CAN FD frames that have arrived, and forget them."""
        found, self._long = self._long, []
        return found

    def _take_raw(self) -> int:
        """Take the next frame of the kernel's socket; the result is that of `_take_message`."""
        try:
            raw = self._socket.recv(_FD_FRAME.size)
        except BlockingIOError:
            return -1
        if len(raw) not in (_FRAME.size, _FD_FRAME.size):
            self.ignored += 1
            return 0
        is_fd = len(raw) == _FD_FRAME.size
        raw_id, size, data = (_FD_FRAME if is_fd else _FRAME).unpack(raw)
        if raw_id & _ERROR_FLAG:
            self.bad += 1
            if raw_id & _BUS_OFF:
                raise HardwareError(BUS_OFF)
            return 0
        if raw_id & _REMOTE:
            self.ignored += 1
            return 0
        return self._sort(raw_id, data[:size], is_fd)

    def _receive(self) -> Any:
        """Return the library's next message, or None. Raises OSError when the interface failed."""
        if self._arrived is not None:
            found = self._arrived.popleft() if self._arrived else None
            if isinstance(found, Exception):
                raise _failed(found)
            return found
        try:
            return self._bus.recv(0)
        except Exception as e:
            raise _failed(e) from None

    def close(self) -> None:
        """Leave the bus."""
        self._closing.set()
        if self._reader is not None:
            self._reader.join(1.0)
        with contextlib.suppress(Exception):  # interfaces of python-can raise errors of their own
            self._bus.shutdown()


def _says_bus_off(error: Exception) -> bool:
    """Return whether an interface's error means bus-off, by its text or its name."""
    return bool(re.search(r"bus[\s_-]?off", f"{type(error).__name__} {error}", re.IGNORECASE))


def _failed(error: Exception) -> OSError:
    """Return the OSError for an error of an interface."""
    if _says_bus_off(error):
        return OSError(errno.ENETDOWN, BUS_OFF)
    return error if isinstance(error, OSError) else OSError(errno.EIO, f"{type(error).__name__}: {error}")


def _kernel_filter(can_id: int) -> dict[str, int | bool]:
    if can_id & BY_PGN:
        number = (can_id & ~BY_PGN) << 8
        is_to_one = number >> 16 & 0xFF < _TO_ONE
        return {"can_id": number, "can_mask": _PGN_TO_ALL if is_to_one else _PGN, "extended": True}
    extended = bool(can_id & EXTENDED)
    mask = 0x1FFF_FFFF if extended else 0x7FF
    return {"can_id": can_id & ~EXTENDED, "can_mask": mask, "extended": extended}


class Hub:
    """An adapter that several devices of this process share; each has a `SharedPort`."""

    def __init__(self, port: str, adapter: SlcanPort | LibraryPort) -> None:
        self.port, self.adapter, self.broken = port, adapter, False
        self.ports: list[SharedPort] = []
        self.lock = threading.Lock()

    def pump(self) -> None:
        """Hand the frames that have arrived to the ports that want them.

        While another thread sets a device up, its own pump does this. Raises OSError, HardwareError."""
        if self.broken:
            raise OSError(errno.EIO, f"{self.port} was lost")
        if not self.lock.acquire(blocking=False):
            return
        try:
            for can_id, data in self.adapter.receive():
                for port in self.ports:
                    if is_wanted(can_id, port.ids):
                        port.inbox.append((can_id, data))
            for can_id, data in self.adapter.long_frames():
                for port in self.ports:
                    if is_wanted(can_id, port.ids):
                        port.long_inbox.append((can_id, data))
        except (OSError, HardwareError):
            self.broken = True
            raise
        finally:
            self.lock.release()

    def send(self, frames: list[tuple[int, bytes]]) -> None:
        """Send frames. Raises OSError."""
        if self.broken:
            raise OSError(errno.EIO, f"{self.port} was lost")
        with self.lock:
            try:
                self.adapter.send(*frames)
            except OSError:
                self.broken = True
                raise


class SharedPort(CanPort):
    """The part of a shared adapter that one device sees: the frames with its `ids`."""

    def __init__(self, hub: Hub, ids: tuple[int, ...]) -> None:
        self.hub, self.ids = hub, frozenset(ids)
        self.inbox: deque[tuple[int, bytes]] = deque(maxlen=MAX_TAKEN)
        self.long_inbox: deque[tuple[int, bytes]] = deque(maxlen=MAX_TAKEN)

    @property
    def bad(self) -> int:
        """Count the adapter's bad frames."""
        return int(self.hub.adapter.bad)

    @property
    def ignored(self) -> int:
        """Count the frames that the adapter ignored."""
        return int(self.hub.adapter.ignored)

    def take(self) -> int:
        """Take this device's frames; return how many. Raises OSError, HardwareError."""
        self.hub.pump()
        self.begin()
        taken = 0
        while self.inbox:
            can_id, data = self.inbox.popleft()
            taken += self.deliver(can_id, data)
        return taken

    def drop_echoes(self) -> None:
        """Drop frames that the adapter hands back, for every user of the adapter."""
        self.hub.adapter.drop_echoes()

    def long_frames(self) -> list[tuple[int, bytes]]:
        """Return the CAN FD frames that have arrived, and forget them."""
        found = list(self.long_inbox)
        self.long_inbox.clear()
        return found

    def flush(self) -> int:
        """Send the queued frames. Raises OSError."""
        self.hub.send(self.queued())
        return 0

    def send_long(self, can_id: int, data: bytes) -> None:
        """Send a CAN FD frame. Raises OSError, HardwareError."""
        with self.hub.lock:
            self.hub.adapter.send_long(can_id, data)

    def close(self) -> None:
        """End the use of the adapter; its last user closes it."""
        with _LOCKS[self.hub.port]:
            if self in self.hub.ports:
                self.hub.ports.remove(self)
            if not self.hub.ports:
                self.hub.adapter.close()
                if _HUBS.get(self.hub.port) is self.hub:
                    del _HUBS[self.hub.port]


_HUBS: dict[str, Hub] = {}
_LOCKS: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)  # a dead port delays no other one
AnyPort = SlcanPort | LibraryPort | SharedPort
_PORT = re.compile(r"(\w+):(.+?)(?:@(\d+)(?:,(\d+))?)?")


def open_can(port: str, ids: tuple[int, ...], shared: bool = False) -> AnyPort:
    """Open "interface:channel@bitrate,second" for the frames `ids`.

    shared: other devices of this process use the adapter, too. Raises HardwareError."""
    if not shared:
        return _open(port, ids)
    with _LOCKS[port]:
        hub = _HUBS.get(port)
        if hub is None or hub.broken:
            hub = _HUBS[port] = Hub(port, _open(port, ()))
        view = SharedPort(hub, ids)
        hub.ports.append(view)
        return view


def _open(port: str, ids: tuple[int, ...]) -> SlcanPort | LibraryPort:
    match = _PORT.fullmatch(port)
    if match is None:
        raise HardwareError(
            f"port '{port}': interface:channel@bitrate was expected, as slcan:/dev/ttyACM0@1000000"
        )
    bitrate, second = int(match[3] or 1_000_000), int(match[4] or 0)
    if match[1] == "slcan":
        return SlcanPort(match[2], bitrate, second or SLCAN_BAUD)
    return LibraryPort(match[1], match[2], bitrate, ids, second)
