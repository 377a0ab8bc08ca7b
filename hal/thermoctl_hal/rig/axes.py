"""One axis of a rig with several: its part of the one sample of all devices, and its amplifier."""

from __future__ import annotations

from thermoctl.rig.channels import AxesChannels
from thermoctl_hal.base.backend import Sample
from thermoctl_hal.rig.devices import DevicesBackend


class AxisBackend:
    """`thermoctl_hal.base.backend.Backend` of one axis.

    The first axis reads all devices; the others, which tick after it, see what it read. Opening or closing
    one axis opens or closes all devices."""

    def __init__(self, devices: DevicesBackend, channels: AxesChannels, axis: str):
        self.devices, self.name, self.axis = devices, axis, list(channels.parts).index(axis)
        part, whole = channels.parts[axis], devices.sample
        self.sample = Sample(0)
        self.sample.value, self.sample.time_s = whole.value[part], whole.time_s[part]
        self.sample.fresh, self.sample.status = whole.fresh[part], whole.status[part]
        self.open, self.close, self.counters = devices.open, devices.close, devices.counters
        self.check_pacing, self.wait_frame = devices.check_pacing, devices.wait_frame

    def read(self, now_s: float) -> Sample:
        """Return this axis' part of the sample; see thermoctl_hal.base.backend."""
        if self.axis == 0:
            self.devices.read(now_s)
        return self.sample

    def write(self, drive: float, enable: bool) -> None:
        """Send the command to this axis' amplifier; see thermoctl_hal.base.backend."""
        self.devices.write(drive, enable, self.axis)

    def problem(self, role: str) -> str:
        """Say why this axis' `role` is not OK; '' when it is."""
        return self.devices.problem(f"{self.name}.{role}")
