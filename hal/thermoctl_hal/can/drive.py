# cython: annotation_typing=False, cdivision=True
"""A CiA-402 drive in the tick.

RPDO 1 = control word | command, then SYNC. TPDO 1 answers the SYNC with status word | readings; it is read
one tick later. Heartbeats go both ways: the drive stops by itself when ours is missing for `watchdog_s`, and
its channels are ERROR when its own is missing. Set-up (identity, heartbeats, mode, PDO mapping, NMT start):
thermoctl_hal.can.set_up. States, control words and when it is enabled: thermoctl_hal.base.cia402.
"""

from __future__ import annotations

import contextlib
import math
import struct
import time
from array import array

from thermoctl_hal.base.backend import HardwareError, Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.cia402 import DriveSteps, state_name, state_without_role
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.profile import ACTUAL_POSITION, POSITION_MODES, STATUS_WORD, Cia402, Object, typed
from thermoctl_hal.can.bus import AnyPort, open_can
from thermoctl_hal.can.set_up import (
    NMT_ID,
    NMT_RESET_COMMUNICATION,
    NMT_START,
    SYNC_ID,
    Objects,
    Sdo,
    check_objects,
    foreign_heartbeat,
    set_up,
    switch_off,
)

_PRE_OPERATIONAL = 0x7F  # NMT state in a heartbeat; 0: the node has just booted
_COMMANDS = 0x200, 0x300, 0x400, 0x500  # identifiers of RPDO 1 to 4, without the node id
_SYNC_ID = SYNC_ID  # a number of C, by drive.pxd


class Cia402Device(Device):
    """A CiA-402 drive: takes the command, gives its state, current and DC-link voltage."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        spec = typed(binding.profile.bus_spec, Cia402)
        self._spec, self._node = spec, binding.address
        self._port: AnyPort | None = None
        self._formats = check_objects(Objects(spec, binding.profile.file, self._node), spec)
        formats, command = [self._formats[o] for o in spec.transmit], self._formats[spec.command]
        sizes = [struct.calcsize(f) for f in formats]
        self._transmit_size, self._receive_size = sum(sizes), 2 + struct.calcsize(command)
        self._shift = array("i", [8 * sum(sizes[:k]) for k in range(len(sizes))])
        self._bits = array("i", [8 * size for size in sizes])
        self._signed = array("i", [f.islower() for f in formats])
        sources = [typed(b.channel.source, Object) for b in binding.bounds]
        amplifier = binding.profile.amplifier
        if amplifier is not None and STATUS_WORD not in sources:
            raise state_without_role(binding.place)
        self._index = array("i", [spec.transmit.index(o) if o in spec.transmit else -1 for o in sources])
        self._is_state = array("i", [o == STATUS_WORD for o in sources])
        self._patience_s, self._heartbeat_s = max(3 * spec.heartbeat_s, spec.watchdog_s), spec.heartbeat_s
        self._master = spec.master_id
        tracks = spec.mode in POSITION_MODES
        self.steps = DriveSteps(amplifier, command, tracks, binding.profile.file)
        self._actual = spec.transmit.index(ACTUAL_POSITION) if tracks else -1
        self._ids = (
            0x080 + self._node,
            0x180 + self._node,
            0x580 + self._node,
            *(base + self._node for base in _COMMANDS),  # another master's
            *range(0x701, 0x780),  # heartbeats: the drive's, and a foreign one with our node id
        )
        self._fault_code = self._frames = self._emergencies = 0
        self._odd_size, self._odd = -1, 0
        self._heard_s = self._beat_s = -math.inf

    def connect(self) -> None:
        """Open the port, set the drive up and start its node; the drive stays disabled."""
        port = open_can(self.binding.port, self._ids, self.binding.shared)
        port.drop_echoes()
        try:
            sdo = Sdo(port, self._node, self._spec.sdo_timeout_s)
            self._fault_code = set_up(sdo, self._spec, self._formats, self.binding.port)
        except (HardwareError, OSError) as e:
            port.close()
            raise HardwareError(f"{self.binding.port} node {self._node}: set-up failed: {e}") from None
        self._port = port
        self.steps.reconnect()
        self._odd_size, self._odd = -1, 0
        self._heard_s = time.monotonic()
        self._beat_s = -math.inf

    def switch_off(self) -> None:
        """Disable the drive over a link of its own. Raises HardwareError when the drive does not confirm."""
        port = open_can(self.binding.port, self._ids, self.binding.shared)
        try:
            switch_off(Sdo(port, self._node, self._spec.sdo_timeout_s), self._receive_size)
        finally:
            port.close()

    def disconnect(self) -> None:
        """Send the drive back to its power-on state and close the port."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError):  # the drive resets PDOs and watchdog, and is off
                port.send((NMT_ID, bytes((NMT_RESET_COMMUNICATION, self._node))))
            port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Take TPDO 1, emergencies and the drive's heartbeat.

        Raises HardwareError without its heartbeat, or when another device sends ours or the command."""
        port = self._port
        if port is None:
            raise HardwareError("not connected")
        for k in range(port.take()):
            kind, size, data = port.can_id(k) - self._node, port.size(k), port.data(k)
            if kind == 0x180 and size != self._transmit_size:
                self._odd_size, self._odd = size, self._odd + 1
            elif kind == 0x180:
                self._store(sample, data, now_s)
            elif kind == 0x700 and size == 1:
                self._take_heartbeat(port, data, now_s)
            elif kind == 0x080 and size == 8:
                self._fault_code = data & 0xFFFF
                self._emergencies += 1
            elif kind == 0x700 + self._master - self._node:
                raise foreign_heartbeat(self._master, self.binding.port)
            elif 0x200 <= kind <= 0x500:
                raise HardwareError(
                    f"another device on {self.binding.port} sends the command 0x{kind + self._node:X} of node {self._node}: "
                    "two masters would drive one axis; switch the other one off"
                )
        if now_s - self._heard_s > self._patience_s:
            raise HardwareError(f"no heartbeat of node {self._node} for {self._patience_s * 1e3:.0f} ms")

    def _take_heartbeat(self, port: AnyPort, state: int, now_s: float) -> None:
        """Take a heartbeat with the NMT state of the drive. Raises HardwareError when the drive restarted."""
        if state == 0:  # boot-up
            # The drive has lost its PDO mapping and watchdog settings.
            raise HardwareError("the drive restarted")
        self._heard_s = now_s
        if state == _PRE_OPERATIONAL:  # the drive left `operational` because our heartbeat was missing
            port.send((NMT_ID, bytes((NMT_START, self._node))))

    def _store(self, sample: Sample, data: int, now_s: float) -> None:
        """Store the readings of a TPDO 1."""
        self._frames += 1
        position = self._number(data, self._actual) if self._actual >= 0 else 0.0
        state = self.steps.take(int(self._number(data, 0)), position)
        for i in range(len(self._index)):
            if self._is_state[i]:
                self.put(sample, i, state, now_s)
            elif self._index[i] < 0:
                self.put(sample, i, self._fault_code, now_s)
            else:
                self.put(sample, i, self._number(data, self._index[i]), now_s)

    def _number(self, data: int, k: int) -> float:
        """Return object k of TPDO 1."""
        span = 1
        span <<= self._bits[k]
        raw = data >> self._shift[k] & (span - 1)
        return raw - span if self._signed[k] and raw >= span // 2 else raw

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send RPDO 1, SYNC, and our heartbeat when it is due, in one write."""
        port = self._port
        if port is None:
            raise HardwareError("not connected")
        word = self.steps.control_word(enable, now_s)
        counts = self.steps.counts(drive, now_s)
        port.queue(0x200 + self._node, word | (counts & 0xFFFFFFFF) << 16, self._receive_size)
        port.queue(_SYNC_ID, 0, 0)
        if now_s - self._beat_s >= self._heartbeat_s:
            self._beat_s = now_s
            port.queue(0x700 + self._master, 0x05, 1)
        port.flush()

    def explain(self, sample: Sample, role: int) -> str:
        """Say also how a drive left 'operation enabled' by itself, until it is enabled anew."""
        found, word = super().explain(sample, role), self.steps.left_word
        if found or word < 0 or not self._is_state[self.roles.index(role)]:
            return found
        return (
            f"{self.name}: left 'operation enabled' without a command: {state_name(word)} "
            f"(status word 0x{word:04X}): check its stop, limit and enable inputs and its supply"
        )

    def silence(self) -> str:
        """Say what the drive sends instead of TPDO 1."""
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
        """Return the counters; errors are bad lines and TPDOs of another length."""
        self.counts.update(frames=self._frames, emergencies=self._emergencies)
        if self._port is not None:
            self.counts.update(errors=self._port.bad + self._odd, ignored=self._port.ignored)
        return self.counts
