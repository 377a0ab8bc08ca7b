# cython: annotation_typing=False, cdivision=True
"""CAN: ports that the tick can use without waiting, CiA-402 drives, and devices that a DBC file describes.

Ports ("interface:channel@bitrate", bitrate 1000000 where left out)
- slcan:/dev/serial/by-id/...   Lawicel ASCII on a serial port, spoken on the bare descriptor (python-can's own
  slcan reads a byte per call, 150 us a frame)
- socketcan:can0                python-can opens it and sets the kernel's filters; frames pass on the bare socket
- virtual:name and any other interface python-can knows: through the library

A CiA-402 drive in the tick: RPDO 1 = control word | command, then SYNC; TPDO 1 answers the SYNC with status word |
readings and is read one tick later. Heartbeats both ways: the drive stops by itself when ours is missing for
`watchdog_s`, we say ERROR when its own is. Set-up (identity, heartbeats, mode, PDO mapping, NMT start): hal.cia402.

Identifiers of 29 bits carry the bit EXTENDED everywhere, so that they never match an 11-bit one of the same number.
Remote frames, error frames and CAN FD frames are counted and passed over.

    status word & mask = value -> state          control word that takes the next step towards 'operation enabled'
      0x4F  0x00  not ready to switch on         -                        (the drive goes on by itself)
      0x4F  0x40  switch on disabled             0x06 shutdown
      0x6F  0x21  ready to switch on             0x07 switch on
      0x6F  0x23  switched on                    0x0F enable operation
      0x6F  0x27  operation enabled              0x0F
      0x6F  0x07  quick stop active              0x00 disable voltage
      0x4F  0x0F  fault reaction active          -
      0x4F  0x08  fault                          0x80 fault reset (rising edge), only while we do not want to drive

Only a new `enable` takes the steps. A drive that was in 'operation enabled' and leaves it without our command (quick
stop from an input, supply, its own fault) is disabled, and stays so until `enable` was withdrawn and is given again.
Until then its state reads as the one it left to, so that a stop between two ticks is seen, too.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import struct
import time
from array import array
from typing import Any

import can

from hal.backend import (
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_OFFLINE,
    AMP_QUICK_STOP,
    HardwareError,
    Sample,
)
from hal.cia402 import (
    NMT_ID,
    NMT_RESET_COMMUNICATION,
    SYNC_ID,
    Objects,
    Sdo,
    check_objects,
    foreign_heartbeat,
    set_up,
    switch_off,
)
from hal.devices import Device
from hal.profile import STATUS_WORD, Binding, Cia402, Dbc, LineSettings
from hal.serial_port import open_port
from hal.wire import EXTENDED, CanPort, SlcanLine, nearest
from thermoctl.yamlfile import InputError

MAX_TAKEN = 500  # frames of a bus that one tick takes
FAULT_RESET_S = 1.0  # between attempts to reset a drive's fault while it is not wanted to drive
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
_SYNC_ID, _RESET_S = SYNC_ID, FAULT_RESET_S
_OFFLINE, _DISABLED, _ENABLED, _FAULT, _QUICK_STOP = (
    AMP_OFFLINE,
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_QUICK_STOP,
)  # numbers of C, by can_bus.pxd
_STATES = (
    (0x4F, 0x00, "not ready to switch on"),
    (0x4F, 0x40, "switched off (switch on disabled)"),
    (0x6F, 0x21, "switched off (ready to switch on)"),
    (0x6F, 0x23, "switched on, operation disabled"),
    (0x6F, 0x27, "operation enabled"),
    (0x6F, 0x07, "quick stop active"),
    (0x4F, 0x0F, "fault reaction active"),
    (0x4F, 0x08, "fault"),
    (0, 0, "a state that CiA 402 does not know"),
)


Frame = tuple[int, bytes]


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
        """Lines that were no frame, and frames that the adapter refused."""
        return self.parser.bad + self.parser.refused

    @property
    def ignored(self) -> int:
        """Remote frames and CAN FD frames."""
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
        in_kernel = (
            [
                {
                    "can_id": i & ~EXTENDED,
                    "can_mask": 0x1FFF_FFFF if i & EXTENDED else 0x7FF,
                    "extended": bool(i & EXTENDED),
                }
                for i in ids
            ]
            if interface == "socketcan"
            else None
        )
        self._wanted = None if in_kernel or not ids else frozenset(ids)
        self._bus: Any
        try:
            self._bus = can.Bus(channel, interface=interface, bitrate=bitrate, can_filters=in_kernel)
        except (can.CanError, OSError, ValueError, ImportError) as e:
            raise HardwareError(
                f"{interface}:{channel}: cannot be opened ({e}); is the interface up (ip link set "
                f"{channel} up type can bitrate {bitrate})?"
            ) from None
        self._socket = self._bus.socket if interface == "socketcan" else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self.bad = self.ignored = self._pending = 0

    def flush(self) -> int:
        """Send what was queued, without waiting. Raises OSError when the bus is gone or takes nothing any more."""
        for can_id, data in self.queued():
            try:
                self._send(can_id, data)
                self._pending = 0
            except (BlockingIOError, can.CanError) as e:
                self._queue_full(e)
            except OSError as e:
                if e.errno != errno.ENOBUFS:
                    raise
                self._queue_full(e)
            except Exception as e:  # of whatever interface
                raise OSError(errno.EIO, f"{type(e).__name__}: {e}") from None
        return 0

    def _send(self, can_id: int, data: bytes) -> None:
        if self._socket is not None:
            self._socket.send(_FRAME.pack(can_id, len(data), data))
            return
        extended = bool(can_id & EXTENDED)
        self._bus.send(can.Message(arbitration_id=can_id & ~EXTENDED, data=data, is_extended_id=extended))

    def _queue_full(self, why: Exception) -> None:
        self.bad += 1
        self._pending += 1
        if self._pending > 100:
            raise OSError(errno.ENOBUFS, f"nobody on the bus takes frames ({why})")

    def take(self) -> int:
        """Take what has arrived; how many frames. Raises OSError: interface down; HardwareError: bus-off."""
        self.begin()
        taken = 0
        while taken < MAX_TAKEN:
            if self._socket is None:
                message = self._receive()
                if message is None:
                    break
                can_id = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
                if message.is_error_frame:
                    self.bad += 1
                elif message.is_remote_frame or message.is_fd:
                    self.ignored += 1
                elif self._wanted is None or can_id in self._wanted:
                    taken += self.deliver(can_id, bytes(message.data))
                continue
            try:
                raw = self._socket.recv(16)
            except BlockingIOError:
                break
            if len(raw) != _FRAME.size:
                self.ignored += 1
                continue
            raw_id, size, data = _FRAME.unpack(raw)
            if raw_id & _ERROR_FLAG:
                self.bad += 1
                if raw_id & _BUS_OFF:
                    raise HardwareError("CAN bus-off: check wiring, termination and bitrate")
            elif raw_id & _REMOTE:
                self.ignored += 1
            else:
                taken += self.deliver(raw_id, data[:size])
        return taken

    def _receive(self) -> Any:
        """The library's next message, or None. What else it raises is an interface that failed."""
        try:
            return self._bus.recv(0)
        except OSError:
            raise
        except Exception as e:
            raise OSError(errno.EIO, f"{type(e).__name__}: {e}") from None

    def close(self) -> None:
        """Leave the bus."""
        with contextlib.suppress(Exception):  # of whatever interface
            self._bus.shutdown()


def open_can(port: str, ids: tuple[int, ...]) -> SlcanPort | LibraryPort:
    """Open "interface:channel@bitrate"; `ids` are the frames wanted (the kernel filters where it can)."""
    match = re.fullmatch(r"(\w+):(.+?)(?:@(\d+))?", port)
    if match is None:
        raise HardwareError(
            f"port '{port}': interface:channel@bitrate was expected, as slcan:/dev/ttyACM0@1000000"
        )
    bitrate = int(match[3] or 1_000_000)
    if match[1] == "slcan":
        return SlcanPort(match[2], bitrate)
    return LibraryPort(match[1], match[2], bitrate, ids)


def drive_state(status_word: int) -> float:
    """The amplifier_state (AMP_*, hal.backend) of a CiA-402 status word."""
    if status_word & 0x4F in (0x0F, 0x08):
        return _FAULT
    if status_word & 0x6F == 0x27:
        return _ENABLED
    if status_word & 0x6F == 0x07:
        return _QUICK_STOP
    return _OFFLINE if status_word & 0x4F == 0x00 else _DISABLED


def state_name(status_word: int) -> str:
    """The CiA-402 state of a status word in the standard's words."""
    return next(name for mask, value, name in _STATES if status_word & mask == value)


def next_control_word(status_word: int, enable: bool) -> int:
    """The control word that takes a drive one step towards the wanted state (table in the module's text)."""
    state = status_word & 0x6F
    if not enable:
        return 0x06 if state in (0x23, 0x27) else 0x00
    if status_word & 0x4F == 0x40:
        return 0x06
    if state == 0x21:
        return 0x07
    return 0x0F if state in (0x23, 0x27) else 0x00


class Cia402Device(Device):
    """A CiA-402 drive: takes the command, gives its state, current and DC-link voltage."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        spec: Cia402 = binding.profile.bus_spec
        self._spec, self._node = spec, binding.address
        self._port: CanPort | None = None
        self._formats = check_objects(Objects(spec, binding.profile.file, self._node), spec)
        formats, command = [self._formats[o] for o in spec.transmit], self._formats[spec.command]
        sizes = [struct.calcsize(f) for f in formats]
        self._transmit_size, self._receive_size = sum(sizes), 2 + struct.calcsize(command)
        self._shift = array("i", [8 * sum(sizes[:k]) for k in range(len(sizes))])
        self._bits = array("i", [8 * size for size in sizes])
        self._signed = array("i", [f.islower() for f in formats])
        self._command_limit = 2 ** (8 * struct.calcsize(command) - 1) - 1
        if binding.profile.drive is not None and all(b.channel.source != STATUS_WORD for b in binding.bounds):
            raise InputError(
                f"{binding.place}: a drive needs its status word (object 0x6041) in the role amplifier_state: "
                "without it nobody sees that the drive stopped by itself"
            )
        sources = [b.channel.source for b in binding.bounds]
        self._index = array("i", [spec.transmit.index(o) if o in spec.transmit else -1 for o in sources])
        self._is_state = array("i", [o == STATUS_WORD for o in sources])
        self._patience_s, self._heartbeat_s = max(3 * spec.heartbeat_s, spec.watchdog_s), spec.heartbeat_s
        self._master = spec.master_id
        if binding.profile.drive is not None:
            (self._low, self._high), self._scale = binding.profile.drive.limits, binding.profile.drive.scale
        self._ids = (
            0x080 + self._node,
            0x180 + self._node,
            0x580 + self._node,
            *range(0x701, 0x780),  # heartbeats: the drive's, and who else sends ours
        )
        self._status_word = self._fault_code = self._heard = self._emergencies = 0
        self._odd_size, self._odd = -1, 0
        self._heard_s = self._beat_s = self._reset_s = -math.inf
        self._wanted = self._driving = self._left = False
        self._left_to, self._left_word = _OFFLINE, -1

    def connect(self) -> None:
        """Open the port, check the identity, configure heartbeats, mode and PDOs, start the node; it stays off."""
        port = open_can(self.binding.port, self._ids)
        try:
            sdo = Sdo(port, self._node, self._spec.sdo_timeout_s)
            self._fault_code = set_up(sdo, self._spec, self._formats, self.binding.port)
        except (HardwareError, OSError) as e:
            port.close()
            raise HardwareError(f"{self.binding.port} node {self._node}: set-up failed: {e}") from None
        self._port = port
        self._status_word = 0
        self._watch_state(_OFFLINE)  # it was lost while it drove: not enabled again by itself
        self._odd_size, self._odd = -1, 0
        self._heard_s = time.monotonic()
        self._beat_s = self._reset_s = -math.inf

    def switch_off(self) -> None:
        """Disable the drive over a link of its own. Raises HardwareError when it does not confirm."""
        port = open_can(self.binding.port, self._ids)
        try:
            switch_off(Sdo(port, self._node, self._spec.sdo_timeout_s), self._receive_size)
        finally:
            port.close()

    def disconnect(self) -> None:
        """Send the drive back to its power-on state and close the port."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(
                OSError
            ):  # reset communication: PDOs and watchdog are forgotten, it is off
                port.send((NMT_ID, bytes((NMT_RESET_COMMUNICATION, self._node))))
            port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Take TPDO 1, emergencies and the drive's heartbeat. HardwareError when the heartbeat is missing, or when another
        device sends ours."""
        port = self._port
        if port is None:
            raise HardwareError("not connected")
        for k in range(port.take()):
            kind, size, data = port.can_id(k) - self._node, port.size(k), port.data(k)
            if kind == 0x180 and size != self._transmit_size:
                self._odd_size, self._odd = size, self._odd + 1
            elif kind == 0x180:
                self._status_word = int(self._number(data, 0))
                self._heard += 1
                state = self._watch_state(drive_state(self._status_word))
                for i in range(len(self._index)):
                    if self._is_state[i]:
                        self.put(sample, i, state, now_s)
                    else:
                        self.put(
                            sample,
                            i,
                            self._fault_code if self._index[i] < 0 else self._number(data, self._index[i]),
                            now_s,
                        )
            elif kind == 0x700 and size == 1:
                if data == 0:  # boot-up
                    raise HardwareError("the drive restarted")  # its PDO mapping and watchdog are gone
                self._heard_s = now_s
                if data == 0x7F:  # it left operation when our heartbeat was missing
                    port.send((NMT_ID, bytes((0x01, self._node))))
            elif kind == 0x080 and size == 8:
                self._fault_code = data & 0xFFFF
                self._emergencies += 1
            elif kind == 0x700 + self._master - self._node:
                raise foreign_heartbeat(self._master, self.binding.port)
        if now_s - self._heard_s > self._patience_s:
            raise HardwareError(f"no heartbeat of node {self._node} for {self._patience_s * 1e3:.0f} ms")

    def _watch_state(self, state: float) -> float:
        """The state to show: what the drive is in, or what it left 'operation enabled' to by itself."""
        if self._driving and not self._left and state != _ENABLED:
            self._left, self._left_to = True, state
            self._left_word = self._status_word
        if self._wanted and state == _ENABLED and not self._left:
            self._driving, self._left_word = True, -1
        return self._left_to if self._left and state != _FAULT else state

    def _number(self, data: int, k: int) -> float:
        """Object k of TPDO 1."""
        span = 1
        span <<= self._bits[k]
        raw = data >> self._shift[k] & (span - 1)
        return raw - span if self._signed[k] and raw >= span // 2 else raw

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """RPDO 1, SYNC, and our heartbeat when it is due, in one write."""
        port, counts = self._port, 0
        if port is None:
            raise HardwareError("not connected")
        self._wanted = enable
        if not enable:
            self._driving = self._left = False
        steps = enable and not self._left
        word = next_control_word(self._status_word, steps)
        if steps and drive_state(self._status_word) == _ENABLED:
            counts = nearest(min(max(drive, self._low), self._high) / self._scale)
            counts = min(max(counts, -self._command_limit), self._command_limit)
        elif not enable and self._status_word & 0x4F == 0x08 and now_s - self._reset_s >= _RESET_S:
            word, self._reset_s = 0x80, now_s
        port.queue(0x200 + self._node, word | (counts & 0xFFFFFFFF) << 16, self._receive_size)
        port.queue(_SYNC_ID, 0, 0)
        if now_s - self._beat_s >= self._heartbeat_s:
            self._beat_s = now_s
            port.queue(0x700 + self._master, 0x05, 1)
        port.flush()

    def explain(self, sample: Sample, role: int) -> str:
        """Also how a drive left 'operation enabled' by itself, until it is enabled anew."""
        found = super().explain(sample, role)
        if found or self._left_word < 0 or not self._is_state[self.roles.index(role)]:
            return found
        return (
            f"{self.name}: left 'operation enabled' without a command: {state_name(self._left_word)} "
            f"(status word 0x{self._left_word:04X}): check its stop, limit and enable inputs and its supply"
        )

    def silence(self) -> str:
        """What the drive sends instead of TPDO 1."""
        if self._odd_size >= 0:
            return (
                f"{self._odd} TPDO 1 frames came with {self._odd_size} bytes, {self._transmit_size} were mapped: "
                "does another master map it?"
            )
        return (
            f"heartbeats of node {self._node} come, but no answer to SYNC (TPDO 1, 0x{0x180 + self._node:X}): "
            "did it leave the state operational?"
        )

    def counters(self) -> dict[str, int]:
        """Frames, lines that were none or TPDOs of another length, emergencies, reconnections, frames of other kinds."""
        self.counts.update(frames=self._heard, emergencies=self._emergencies)
        if self._port is not None:
            self.counts.update(errors=self._port.bad + self._odd, ignored=self._port.ignored)
        return self.counts


class DbcDevice(Device):
    """A device that sends what a DBC file describes; it is only listened to."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        spec: Dbc = binding.profile.bus_spec
        self._port: SlcanPort | LibraryPort | None = None
        self._messages: dict[int, tuple[Any, list[tuple[int, str]]]] = {}
        self._quiet, self._why = (
            0,
            "",
        )  # frames since the last reading, and what was wrong with the last of them
        for i, b in enumerate(binding.bounds):
            message = spec.database.get_message_by_name(b.channel.source.message)
            can_id = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
            self._messages.setdefault(can_id, (message, []))[1].append((i, b.channel.source.signal))

    def connect(self) -> None:
        """Open the port."""
        self._port = open_can(self.binding.port, tuple(self._messages))
        self._quiet = 0

    def disconnect(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Decode what has arrived. A frame that does not decode is counted, and told by `silence`."""
        port = self._port
        if port is None:
            raise HardwareError("not connected")
        for can_id, data in port.receive():
            entry = self._messages.get(can_id)
            if entry is None:
                self._quiet += 1
                if can_id ^ EXTENDED in self._messages:
                    here, there = (29, 11) if can_id & EXTENDED else (11, 29)
                    self._why = (
                        f"0x{can_id & ~EXTENDED:X} came as {here}-bit id, the DBC file says {there} bits"
                    )
                continue
            try:
                values = entry[0].decode(data, decode_choices=False)
                readings = [(i, float(values[signal])) for i, signal in entry[1] if signal in values]
            except Exception as e:  # what the library makes of foreign bytes
                self.counts["errors"] += 1
                self._quiet += 1
                self._why = f"{entry[0].name} came with {len(data)} bytes and does not decode ({e})"
                continue
            self.counts["frames"] += 1
            for i, value in readings:
                self._quiet, self._why = 0, ""
                self.put(sample, i, value, now_s)

    def silence(self) -> str:
        """What arrives instead of a reading."""
        wanted = ", ".join(f"0x{i & ~EXTENDED:X} ({29 if i & EXTENDED else 11} bits)" for i in self._messages)
        if self._quiet:
            return f"{self._quiet} frames came and gave no reading: {self._why or f'none is {wanted}'}"
        if self._port is not None and self._port.ignored:
            return (
                f"{self._port.ignored} remote or CAN FD frames came, {wanted} as classic data frame is wanted"
            )
        return f"{super().silence()}, the bitrate, and who sends {wanted}"

    def counters(self) -> dict[str, int]:
        """Frames, frames that did not decode, frames of other kinds, reconnections."""
        if self._port is not None:
            self.counts["ignored"] = self._port.ignored
        return self.counts
