# cython: annotation_typing=False, cdivision=True
"""A CiA-402 drive in the tick.

RPDO 1 = control word | command, then SYNC. TPDO 1 answers the SYNC with status word | readings; it is read
one tick later. Heartbeats go both ways: the drive stops by itself when ours is missing for `watchdog_s`, and
its channels are ERROR when its own is missing. Set-up (identity, heartbeats, mode, PDO mapping, NMT start):
thermoctl_hal.can.set_up. States and control words: thermoctl_hal.base.cia402.

Only a new `enable` takes the steps towards 'operation enabled'. A drive that leaves it without our command
(quick stop from an input, supply, its own fault) is disabled. It stays disabled until `enable` was withdrawn
and is given again. Until then its state reads as the state it left to, so that a stop between two ticks is
seen, too.
"""

from __future__ import annotations

import contextlib
import math
import struct
import time
from array import array

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import AMP_ENABLED, AMP_FAULT, AMP_OFFLINE, HardwareError, Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.cia402 import (
    FAULT_RESET_S,
    MAX_STEP_S,
    drive_state,
    largest_command,
    next_control_word,
    state_name,
)
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.profile import ACTUAL_POSITION, POSITION_MODES, STATUS_WORD, Cia402, Object, typed
from thermoctl_hal.base.wire import nearest
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
_SYNC_ID, _RESET_S = SYNC_ID, FAULT_RESET_S
_OFFLINE, _ENABLED, _FAULT = AMP_OFFLINE, AMP_ENABLED, AMP_FAULT  # numbers of C, by drive.pxd


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
        self._command_limit = 0
        sources = [typed(b.channel.source, Object) for b in binding.bounds]
        amplifier = binding.profile.amplifier
        if amplifier is not None and STATUS_WORD not in sources:
            raise InputError(
                f"{binding.place}: a drive needs its status word (object 0x6041) in the role amplifier_state: "
                "without it nobody sees that the drive stopped by itself"
            )
        self._index = array("i", [spec.transmit.index(o) if o in spec.transmit else -1 for o in sources])
        self._is_state = array("i", [o == STATUS_WORD for o in sources])
        self._patience_s, self._heartbeat_s = max(3 * spec.heartbeat_s, spec.watchdog_s), spec.heartbeat_s
        self._master = spec.master_id
        if amplifier is not None:
            self._command_limit = largest_command(command, amplifier, binding.profile.file)
            (self._low, self._high), self._scale = amplifier.limits, amplifier.scale
            self._slew = amplifier.slew_per_s / amplifier.scale
        self._actual = spec.transmit.index(ACTUAL_POSITION) if spec.mode in POSITION_MODES else -1
        self._target, self._target_s, self._actual_counts = math.nan, 0.0, 0.0
        self._ids = (
            0x080 + self._node,
            0x180 + self._node,
            0x580 + self._node,
            *(base + self._node for base in _COMMANDS),  # another master's
            *range(0x701, 0x780),  # heartbeats: the drive's, and a foreign one with our node id
        )
        self._status_word = self._fault_code = self._frames = self._emergencies = 0
        self._odd_size, self._odd = -1, 0
        self._heard_s = self._beat_s = self._reset_s = -math.inf
        self._wanted = self._driving = self._left = False
        self._left_to, self._left_word = _OFFLINE, -1

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
        self._status_word = 0
        self._watch_state(_OFFLINE)  # lost while it drove: it must not be enabled again by itself
        self._target = math.nan
        self._odd_size, self._odd = -1, 0
        self._heard_s = time.monotonic()
        self._beat_s = self._reset_s = -math.inf

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
        self._status_word = int(self._number(data, 0))
        self._frames += 1
        if self._actual >= 0:
            self._actual_counts = self._number(data, self._actual)
        state = self._watch_state(drive_state(self._status_word))
        for i in range(len(self._index)):
            if self._is_state[i]:
                self.put(sample, i, state, now_s)
            elif self._index[i] < 0:
                self.put(sample, i, self._fault_code, now_s)
            else:
                self.put(sample, i, self._number(data, self._index[i]), now_s)

    def _watch_state(self, state: float) -> float:
        """Return the drive's state, or the one that it entered when it left 'operation enabled' by itself."""
        if self._driving and not self._left and state != _ENABLED:
            self._left, self._left_to = True, state
            self._left_word = self._status_word
        if self._wanted and state == _ENABLED and not self._left:
            self._driving, self._left_word = True, -1
        return self._left_to if self._left and state != _FAULT else state

    def _number(self, data: int, k: int) -> float:
        """Return object k of TPDO 1."""
        span = 1
        span <<= self._bits[k]
        raw = data >> self._shift[k] & (span - 1)
        return raw - span if self._signed[k] and raw >= span // 2 else raw

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send RPDO 1, SYNC, and our heartbeat when it is due, in one write."""
        port, counts = self._port, 0
        if port is None:
            raise HardwareError("not connected")
        self._wanted = enable
        if not enable:
            self._driving = self._left = False
        steps = enable and not self._left
        word = next_control_word(self._status_word, steps)
        if self._actual >= 0:
            counts = self._position_target(drive, steps, now_s)
        elif steps and drive_state(self._status_word) == _ENABLED:
            counts = nearest(min(max(drive, self._low), self._high) / self._scale)
        counts = min(max(counts, -self._command_limit), self._command_limit)
        if not enable and self._status_word & 0x4F == 0x08 and now_s - self._reset_s >= _RESET_S:
            word, self._reset_s = 0x80, now_s
        port.queue(0x200 + self._node, word | (counts & 0xFFFFFFFF) << 16, self._receive_size)
        port.queue(_SYNC_ID, 0, 0)
        if now_s - self._beat_s >= self._heartbeat_s:
            self._beat_s = now_s
            port.queue(0x700 + self._master, 0x05, 1)
        port.flush()

    def _position_target(self, drive: float, steps: bool, now_s: float) -> int:
        """Return the target position in counts: the present one until enabled, then towards `drive`.

        The target moves by at most `slew_per_s`, so that enabling or a step of the command is no jump."""
        step = self._slew * min(max(now_s - self._target_s, 0.0), MAX_STEP_S)
        self._target_s = now_s
        if not steps or drive_state(self._status_word) != _ENABLED or self._target != self._target:
            self._target = self._actual_counts
        else:
            wanted = min(max(drive, self._low), self._high) / self._scale
            self._target += min(max(wanted - self._target, -step), step)
        return nearest(self._target)

    def explain(self, sample: Sample, role: int) -> str:
        """Say also how a drive left 'operation enabled' by itself, until it is enabled anew."""
        found = super().explain(sample, role)
        if found or self._left_word < 0 or not self._is_state[self.roles.index(role)]:
            return found
        return (
            f"{self.name}: left 'operation enabled' without a command: {state_name(self._left_word)} "
            f"(status word 0x{self._left_word:04X}): check its stop, limit and enable inputs and its supply"
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
