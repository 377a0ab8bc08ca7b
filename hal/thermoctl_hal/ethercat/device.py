"""EtherCAT slaves: inputs of any slave, and CiA-402 drives over CANopen over EtherCAT.

One frame a cycle carries the outputs of all slaves and returns with their inputs, see
thermoctl_hal.ethercat.bus. A process of its own polls each device at the rate of its fastest channel. A
device that has seen the newest cycle runs another; otherwise it uses the cycle of a neighbour. The command
goes out with a cycle of its own, in the same poll.

A drive stops by itself when no frame arrives for `watchdog_s`: its slave controller leaves the state OP, and
the drive follows. Each set-up writes that time, see thermoctl_hal.ethercat.slave. A slave is lost, and
connected again, when it is not in OP or when the frames do not come back.
"""

from __future__ import annotations

import contextlib
import math
import struct

from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import AMP_ENABLED, AMP_FAULT, AMP_OFFLINE, HardwareError, Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.cia402 import (
    FAULT_RESET_S,
    MAX_STEP_S,
    drive_state,
    largest_command,
    next_control_word,
)
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.profile import ACTUAL_POSITION, POSITION_MODES, Amplifier, typed
from thermoctl_hal.ethercat.bus import EthercatBus, bus_of
from thermoctl_hal.ethercat.read import Ethercat, Place
from thermoctl_hal.ethercat.slave import SlaveSetUp

LAST_CYCLES = 3  # cycles with control word 0, before the link is closed


class EthercatDevice(Device):
    """A slave, of which the inputs are read; a drive takes the command, too."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        load("pysoem", f"{binding.place}: {binding.name} on EtherCAT")
        self.slow = True  # a frame that is lost blocks for milliseconds
        self.counts |= {"lost": 0, "incomplete": 0}
        spec = typed(binding.profile.bus_spec, Ethercat)
        self._position, self._seen = binding.address, 0
        self._places = [typed(b.channel.source, Place) for b in binding.bounds]
        self._bus = EthercatBus(binding.port)
        self._drive: Cia402Steps | None = None
        if binding.profile.amplifier is not None and spec.command is not None:
            self._drive = Cia402Steps(spec, binding.profile.amplifier, binding.profile.file)
            states = [p.offset == 0 and p.letter == "H" and not p.bits[1] for p in self._places]
            if True not in states:
                raise InputError(
                    f"{binding.place}: a drive needs its status word (object 0x6041) in the role amplifier_state: "
                    "without it nobody sees that the drive stopped by itself"
                )
            self._state = states.index(True)

    def connect(self) -> None:
        """Bring the slave to OP; the first device configures every slave that a device describes."""
        self._bus = bus_of(self.binding.port)
        self._bus.join(self._position, [SlaveSetUp(b) for b in (self.binding, *self.binding.neighbours)])
        self._seen = self._bus.cycle
        if self._drive is not None:
            self._drive.restart()

    def switch_off(self) -> None:
        """Send every slave of the adapter to INIT, which disables a drive. Raises HardwareError."""
        self._bus.reset(self._position)

    def disconnect(self) -> None:
        """Disable the drive, as far as the link still works, and leave the adapter."""
        with contextlib.suppress(HardwareError, OSError):
            if self._drive is not None and self._position in self._bus.users:
                self._bus.slave(self._position).output = bytes(self._drive.size)
                for _ in range(LAST_CYCLES):
                    self._bus.exchange()
        self._bus.leave(self._position)

    def poll(self, sample: Sample) -> None:
        """Store the inputs of a cycle that this device has not seen, running one where there is none.

        Raises HardwareError when the slave is not in OP or the frames do not come back."""
        bus = self._bus
        if bus.cycle == self._seen:
            bus.exchange()
        self.counts.update(lost=bus.lost, incomplete=bus.incomplete)
        if self._position in bus.sick:
            raise HardwareError(f"{self.binding.port}: {bus.problem(self._position)}")
        if bus.cycle == self._seen:
            self.miss_all("the frame did not come back, or not every slave took part in it")
            return
        self._seen = bus.cycle
        self.counts["frames"] += 1
        inputs = bus.slave(self._position).input
        for i, place in enumerate(self._places):
            self._store(sample, i, place, inputs)

    def _store(self, sample: Sample, i: int, place: Place, inputs: bytes) -> None:
        raw = place.value(inputs)
        if self._drive is not None and i == self._state:
            raw = self._drive.observe(int(raw), inputs)
        elif place.invalid is not None:
            where, test = place.invalid
            bits = int(where.value(inputs)) & test.mask
            if bits != test.value:
                self.fail(
                    sample,
                    i,
                    f"input {where.offset} reads 0x{bits:X}, a good reading has 0x{test.value:X}: the device reports "
                    "a fault of this channel (open wire?)",
                )
                return
        if raw in place.sentinels or not math.isfinite(raw):
            self.fail(sample, i, f"input {place.offset} reads {raw:g}: open or missing sensor")
        else:
            self.put(sample, i, raw, self._bus.time_s)

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send the command with a cycle of its own. Raises HardwareError."""
        if self._drive is not None:
            self._bus.slave(self._position).output = self._drive.outputs(drive, enable, now_s)
            self._bus.exchange()

    def silence(self) -> str:
        """Report that the poller has posted no reading and no problem yet."""
        return "its poller has posted nothing"


class Cia402Steps:
    """The outputs of a drive: control word and command. The rules are those of thermoctl_hal.can.drive."""

    def __init__(self, spec: Ethercat, amplifier: Amplifier, place: str) -> None:
        if spec.command is None:
            raise TypeError("a profile with 'command' was expected")
        self._amplifier, self._letter = amplifier, spec.command[1]
        self.size = 2 + struct.calcsize("<" + self._letter)
        self._most = largest_command(self._letter, amplifier, place)
        self._actual: Place | None = None
        if spec.mode in POSITION_MODES:
            items = list(spec.transmit)
            at = items.index(ACTUAL_POSITION)
            before = sum(struct.calcsize("<" + spec.transmit[o]) for o in items[:at])
            self._actual = Place(before, spec.transmit[ACTUAL_POSITION])
        self.restart()

    def restart(self) -> None:
        """Forget the state, after a new connection; the drive is not enabled again by itself."""
        self._word, self._left_to = 0, AMP_OFFLINE
        self._wanted = self._driving = self._left = False
        self._position, self._target, self._target_s, self._reset_s = 0.0, math.nan, 0.0, -math.inf

    def observe(self, word: int, inputs: bytes) -> float:
        """Take the status word; return the AMP_* state, or the one to which the drive left by itself."""
        self._word, state = word, drive_state(word)
        if self._actual is not None:
            self._position = self._actual.value(inputs)
        if self._driving and not self._left and state != AMP_ENABLED:
            self._left, self._left_to = True, state
        if self._wanted and state == AMP_ENABLED and not self._left:
            self._driving = True
        return self._left_to if self._left and state != AMP_FAULT else state

    def outputs(self, drive: float, enable: bool, now_s: float) -> bytes:
        """Return control word and command of this cycle."""
        self._wanted = enable
        if not enable:
            self._driving = self._left = False
        steps = enable and not self._left
        is_enabled = steps and drive_state(self._word) == AMP_ENABLED
        word = next_control_word(self._word, steps)
        if not enable and self._word & 0x4F == 0x08 and now_s - self._reset_s >= FAULT_RESET_S:
            word, self._reset_s = 0x80, now_s
        low, high = self._amplifier.limits
        wanted = min(max(drive, low), high) / self._amplifier.scale
        counts = wanted if is_enabled else 0.0
        if self._actual is not None:
            counts = self._towards(wanted, is_enabled, now_s)
        return struct.pack("<H" + self._letter, word, min(max(round(counts), -self._most), self._most))

    def _towards(self, wanted: float, is_enabled: bool, now_s: float) -> float:
        """Return the target position: the present one until enabled, then nearer to `wanted`."""
        step = self._amplifier.slew_per_s / self._amplifier.scale
        step *= min(max(now_s - self._target_s, 0.0), MAX_STEP_S)
        self._target_s = now_s
        if not is_enabled or math.isnan(self._target):
            self._target = self._position
        else:
            self._target += min(max(wanted - self._target, -step), step)
        return self._target
