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
from thermoctl_hal.base.backend import HardwareError, Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.cia402 import DriveSteps, state_without_role
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.profile import ACTUAL_POSITION, POSITION_MODES, typed
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
        self._drive: DriveSteps | None = None
        amplifier, tracks = binding.profile.amplifier, spec.mode in POSITION_MODES
        if amplifier is not None and spec.command is not None:
            self._outputs = struct.Struct("<H" + spec.command[1])
            self._drive = DriveSteps(amplifier, spec.command[1], tracks, binding.profile.file)
            self._actual = spec.place_of(ACTUAL_POSITION) if tracks else None
            states = [p.offset == 0 and p.letter == "H" and not p.bits[1] for p in self._places]
            if True not in states:
                raise state_without_role(binding.place)
            self._state = states.index(True)

    def connect(self) -> None:
        """Bring the slave to OP; the first device configures every slave that a device describes."""
        self._bus = bus_of(self.binding.port)
        self._bus.join(self._position, [SlaveSetUp(b) for b in (self.binding, *self.binding.neighbours)])
        self._seen = self._bus.cycle
        if self._drive is not None:
            self._drive.reconnect()

    def switch_off(self) -> None:
        """Send every slave of the adapter to INIT, which disables a drive. Raises HardwareError."""
        self._bus.reset(self._position)

    def disconnect(self) -> None:
        """Disable the drive, as far as the link still works, and leave the adapter."""
        with contextlib.suppress(HardwareError, OSError):
            if self._drive is not None and self._position in self._bus.users:
                self._bus.slave(self._position).output = bytes(self._outputs.size)
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
            raw = self._drive.take(int(raw), self._actual.value(inputs) if self._actual else 0.0)
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
            word = self._drive.control_word(enable, now_s)
            self._bus.slave(self._position).output = self._outputs.pack(
                word, self._drive.counts(drive, now_s)
            )
            self._bus.exchange()

    def silence(self) -> str:
        """Report that the poller has posted no reading and no problem yet."""
        return "its poller has posted nothing"
