# cython: annotation_typing=False, cdivision=True
"""CAN: ports that the tick can use without waiting, CiA-402 drives, and devices that a DBC file describes.

Ports ("interface:channel@bitrate", bitrate 1000000 where left out)
- slcan:/dev/serial/by-id/...   Lawicel ASCII on a serial port, spoken on the bare descriptor (python-can's own
  slcan reads a byte per call, 150 us a frame)
- socketcan:can0                python-can opens it and sets the kernel's filters; frames pass on the bare socket
- virtual:name and any other interface python-can knows: through the library

A CiA-402 drive in the tick: RPDO 1 = control word | command, then SYNC; TPDO 1 answers the SYNC with status word |
readings and is read one tick later. Heartbeats both ways: the drive stops by itself when ours is missing for
`watchdog_s`, we say ERROR when its own is. Set-up (identity, heartbeats, mode, PDO mapping, NMT start) runs through
canopen and the EDS file.

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
import logging
import math
import os
import re
import struct
import threading
import time
from array import array
from typing import Any

import can
import canopen
import cantools
from canopen.objectdictionary import datatypes

from hal.backend import (
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_OFFLINE,
    AMP_QUICK_STOP,
    HardwareError,
    Sample,
)
from hal.devices import Device
from hal.profile import Binding, Cia402, Dbc, LineSettings
from hal.serial_port import open_port
from hal.wire import CanPort, SlcanLine, nearest
from thermoctl.yamlfile import InputError

SYNC_ID, NMT_ID = 0x080, 0x000
HEARTBEAT_LOST = 0x8130  # CiA 301 error code of a missing heartbeat
SDO_TIMEOUT_S = 0.3
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
_EXTENDED, _REMOTE, _ERROR_FLAG, _BUS_OFF = 0x8000_0000, 0x4000_0000, 0x2000_0000, 0x40
_SYNC_ID, _RESET_S = SYNC_ID, FAULT_RESET_S
_OFFLINE, _DISABLED, _ENABLED, _FAULT, _QUICK_STOP = (
    AMP_OFFLINE,
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_QUICK_STOP,
)  # numbers of C, by can_bus.pxd
_FORMATS = {
    datatypes.INTEGER8: "b",
    datatypes.INTEGER16: "h",
    datatypes.INTEGER32: "i",
    datatypes.UNSIGNED8: "B",
    datatypes.UNSIGNED16: "H",
    datatypes.UNSIGNED32: "I",
    datatypes.BOOLEAN: "B",
}

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
        self._port = open_port(path, LineSettings(baud=3_000_000), f"slcan:{path}")
        super().__init__(self._port.fileno())
        os.write(self._port.fileno(), b"\r\rC\rS%d\rO\r" % _SLCAN_BITRATES[bitrate])

    @property
    def bad(self) -> int:
        """Lines that were no frame, and frames that the adapter refused."""
        return self.parser.bad + self.parser.refused

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
                {"can_id": i, "can_mask": 0x1FFF_FFFF if i > 0x7FF else 0x7FF, "extended": i > 0x7FF}
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
        self.bad = self._pending = 0

    def flush(self) -> int:
        """Send what was queued, without waiting. Raises OSError when the bus is gone or takes nothing any more."""
        for can_id, data in self.queued():
            try:
                if self._socket is None:
                    self._bus.send(
                        can.Message(arbitration_id=can_id, data=data, is_extended_id=can_id > 0x7FF)
                    )
                else:
                    flag = _EXTENDED if can_id > 0x7FF else 0
                    self._socket.send(_FRAME.pack(can_id | flag, len(data), data))
                self._pending = 0
            except (BlockingIOError, can.CanOperationError) as e:
                self._queue_full(e)
            except OSError as e:
                if e.errno != errno.ENOBUFS:
                    raise
                self._queue_full(e)
        return 0

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
                message = self._bus.recv(0)
                if message is None:
                    break
                if self._wanted is None or message.arbitration_id in self._wanted:
                    taken += self.deliver(message.arbitration_id, bytes(message.data))
                continue
            try:
                raw_id, size, data = _FRAME.unpack(self._socket.recv(16))
            except BlockingIOError:
                break
            if raw_id & _ERROR_FLAG:
                self.bad += 1
                if raw_id & _BUS_OFF:
                    raise HardwareError("CAN bus-off: check wiring, termination and bitrate")
            elif not raw_id & _REMOTE:
                taken += self.deliver(raw_id & 0x1FFF_FFFF, data[:size])
        return taken

    def close(self) -> None:
        """Leave the bus."""
        with contextlib.suppress(can.CanError, OSError):
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


def _format(dictionary: Any, index: int) -> str:
    """struct letter of an object; KeyError where it is missing or no number of up to 4 bytes."""
    return _FORMATS[dictionary[index].data_type]


class _SetupNetwork(canopen.Network):
    """canopen over one of our ports, for the time of the set-up: a thread passes frames on."""

    def __init__(self, port: SlcanPort | LibraryPort) -> None:
        super().__init__()
        self._port, self._done = port, threading.Event()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self.failure: Exception | None = None
        self._thread.start()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """As canopen asks for it; `remote` frames are none of what we send."""
        self._port.send((can_id, bytes(data)))

    def _pass_on(self) -> None:
        while not self._done.is_set():
            try:
                frames = self._port.receive()
            except (OSError, HardwareError) as e:
                self.failure = e
                return
            for can_id, data in frames:
                self.notify(can_id, bytearray(data), time.time())
            if not frames:
                self._done.wait(0.0005)

    def finish(self) -> None:
        """Stop passing frames on, and wait for the thread."""
        self._done.set()
        self._thread.join(1.0)


class Cia402Device(Device):
    """A CiA-402 drive: takes the command, gives its state, current and DC-link voltage."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        spec: Cia402 = binding.profile.bus_spec
        self._spec, self._node = spec, binding.address
        self._port: CanPort | None = None
        dictionary = canopen.import_od(str(spec.eds), node_id=self._node)
        try:
            formats = [_format(dictionary, i) for i in spec.transmit]
            command = _format(dictionary, spec.command)
        except KeyError as e:
            raise InputError(
                f"{binding.profile.file}: {spec.eds}: object {e} of the PDOs is not in it"
            ) from None
        if not command.islower():
            raise InputError(
                f"{binding.profile.file}: {spec.eds}: the command 0x{spec.command:X} has no sign"
            )
        sizes = [struct.calcsize(f) for f in formats]
        self._transmit_size, self._receive_size = sum(sizes), 2 + struct.calcsize(command)
        self._shift = array("i", [8 * sum(sizes[:k]) for k in range(len(sizes))])
        self._bits = array("i", [8 * size for size in sizes])
        self._signed = array("i", [f.islower() for f in formats])
        self._command_limit = 2 ** (8 * struct.calcsize(command) - 1) - 1
        self._dictionary = dictionary
        if self._transmit_size > 8:
            raise InputError(
                f"{binding.profile.file}: a PDO has 8 bytes, transmit takes {self._transmit_size}"
            )
        self._index = array(
            "i",
            [
                spec.transmit.index(b.channel.source) if b.channel.source in spec.transmit else -1
                for b in binding.bounds
            ],
        )
        if binding.profile.drive is not None and all(b.channel.source != 0x6041 for b in binding.bounds):
            raise InputError(
                f"{binding.place}: a drive needs its status word (object 0x6041) in the role amplifier_state: "
                "without it nobody sees that the drive stopped by itself"
            )
        self._is_state = array("i", [b.channel.source == 0x6041 for b in binding.bounds])
        self._patience_s, self._heartbeat_s = max(3 * spec.heartbeat_s, spec.watchdog_s), spec.heartbeat_s
        self._master = spec.master_id
        if binding.profile.drive is not None:
            (self._low, self._high), self._scale = binding.profile.drive.limits, binding.profile.drive.scale
        self._ids = (0x080 + self._node, 0x180 + self._node, 0x580 + self._node, 0x700 + self._node)
        self._status_word = self._fault_code = self._heard = self._emergencies = 0
        self._heard_s = self._beat_s = self._reset_s = -math.inf
        self._wanted = self._driving = self._left = False
        self._left_to, self._left_word = _OFFLINE, -1

    def connect(self) -> None:
        """Open the port, check the identity, configure heartbeats, mode and PDOs, start the node; it stays off."""
        port = open_can(self.binding.port, self._ids)
        network = _SetupNetwork(port)
        try:
            self._set_up(network)
        except (canopen.SdoAbortedError, canopen.SdoCommunicationError, KeyError, OSError) as e:
            network.finish()
            port.close()
            raise HardwareError(
                f"{self.name}: {self.binding.port} node {self._node}: set-up failed "
                f"({network.failure or e}): check power, node id, bitrate and termination"
            ) from None
        except HardwareError:
            network.finish()
            port.close()
            raise
        network.finish()
        self._port = port
        self._status_word = 0
        self._watch_state(_OFFLINE)  # it was lost while it drove: not enabled again by itself
        self._heard_s = time.monotonic()
        self._beat_s = self._reset_s = -math.inf

    def _set_up(self, network: _SetupNetwork) -> None:
        logging.getLogger("canopen").setLevel(logging.CRITICAL)  # what it would log, we raise
        spec = self._spec
        node = network.add_node(self._node, self._dictionary)
        assert isinstance(node, canopen.RemoteNode)
        node.sdo.RESPONSE_TIMEOUT, node.sdo.MAX_RETRIES = SDO_TIMEOUT_S, 1
        network.send_message(
            NMT_ID, bytes((0x80, self._node))
        )  # pre-operational: PDOs rest while they are mapped
        device_type = node.sdo[0x1000].raw
        if device_type & 0xFFFF != 402:
            raise HardwareError(
                f"{self.name}: node {self._node} says device profile {device_type & 0xFFFF}, "
                "402 (drive) was expected: is the node id right?"
            )
        node.sdo[0x1016][1].raw = spec.master_id << 16 | round(spec.watchdog_s * 1000)
        node.sdo[0x1017].raw = round(spec.heartbeat_s * 1000)
        node.sdo[0x6040].raw = 0
        node.sdo[0x6060].raw = spec.mode
        for index, sub, value in spec.start_up:
            (node.sdo[index][sub] if sub else node.sdo[index]).raw = value
        for pdo, cob_id, objects in (
            (node.tpdo[1], 0x180, spec.transmit),
            (node.rpdo[1], 0x200, (0x6040, spec.command)),
        ):
            pdo.clear()
            for index in objects:
                pdo.add_variable(index)
            pdo.cob_id, pdo.trans_type, pdo.enabled = cob_id + self._node, 1, True
            pdo.save()
        self._fault_code = node.sdo[0x603F].raw
        if self._fault_code == HEARTBEAT_LOST:  # it missed us while we were away: no news
            node.sdo[0x6040].raw = 0x80
            node.sdo[0x6040].raw = 0
            self._fault_code = node.sdo[0x603F].raw
        network.send_message(NMT_ID, bytes((0x01, self._node)))  # operational

    def disconnect(self) -> None:
        """Send the drive back to its power-on state and close the port."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(
                OSError
            ):  # reset communication: PDOs and watchdog are forgotten, it is off
                port.send((NMT_ID, bytes((0x82, self._node))))
            port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Take TPDO 1, emergencies and the drive's heartbeat. HardwareError when the heartbeat is missing."""
        port = self._port
        if port is None:
            raise HardwareError("not connected")
        for k in range(port.take()):
            kind, size, data = port.can_id(k) - self._node, port.size(k), port.data(k)
            if kind == 0x180 and size == self._transmit_size:
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

    def counters(self) -> dict[str, int]:
        """Frames, lines that were none, emergencies, reconnections."""
        self.counts.update(frames=self._heard, emergencies=self._emergencies)
        if self._port is not None:
            self.counts["errors"] = self._port.bad
        return self.counts


class DbcDevice(Device):
    """A device that sends what a DBC file describes; it is only listened to."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        spec: Dbc = binding.profile.bus_spec
        self._port: SlcanPort | LibraryPort | None = None
        self._messages: dict[int, tuple[Any, list[tuple[int, str]]]] = {}
        for i, b in enumerate(binding.bounds):
            message = spec.database.get_message_by_name(b.channel.source.message)
            self._messages.setdefault(message.frame_id, (message, []))[1].append((i, b.channel.source.signal))

    def connect(self) -> None:
        """Open the port."""
        self._port = open_can(self.binding.port, tuple(self._messages))

    def disconnect(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Decode what has arrived."""
        assert self._port is not None
        for can_id, data in self._port.receive():
            entry = self._messages.get(can_id)
            if entry is None:
                continue
            try:
                values = entry[0].decode(data, decode_choices=False)
            except (cantools.database.DecodeError, ValueError):
                self.counts["errors"] += 1
                continue
            self.counts["frames"] += 1
            for i, signal in entry[1]:
                if signal in values:
                    self.put(sample, i, float(values[signal]), now_s)
