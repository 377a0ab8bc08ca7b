# cython: annotation_typing=False, cdivision=True
"""Base of every driver: the bound channels of one device, the check of each reading, the counters.

A driver implements one protocol. Its `connect` may block (opening, configuring). Its `read` and `write` may
not: the tick calls them.

A channel is ERROR when the device reports a fault: a sentinel, a bad status flag, a refused register. After a
lost answer, a damaged frame or a lost link the last value is kept until it is stale. The amplifier is the
exception: without its link its state is unknown, so its channels are ERROR at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thermoctl.rig.channels import AxesChannels
from thermoctl_hal.base.backend import ERROR, STALE, Sample
from thermoctl_hal.base.binding import NO_VALUE, Binding
from thermoctl_hal.base.wire import Channels


def _never() -> bool:
    return False


class Device:
    """Bound channels, the check of each reading, counters.

    A subclass implements connect, disconnect, and either read (and write where `drives`) or, where `slow`,
    poll."""

    def __init__(self, binding: Binding) -> None:
        self.binding = binding
        self.name = binding.name
        self.slow = False
        self.drives = binding.profile.amplifier is not None
        self.roles = [binding.channels.index[b.role] for b in binding.bounds]
        columns = zip(*((b.scale, b.offset, b.low, b.high) for b in binding.bounds), strict=True)
        self._channels = Channels(np.array(self.roles, np.intc), *(np.array(c, float) for c in columns))
        self.problems: dict[int, str] = {}  # by role: the present problem; a good reading clears it
        self.counts: dict[str, int] = {"frames": 0, "errors": 0, "reconnections": 0}
        self.up = False
        parts = binding.channels.parts if isinstance(binding.channels, AxesChannels) else {}
        self.axis = list(parts).index(binding.axis) if binding.axis else 0
        """Number of the axis that it drives."""
        self.is_urgent: Callable[[], bool] = _never
        """Says whether another device of the port must be served now, so that a reading is broken off."""

    def connect(self) -> None:
        """Open and configure the device; may block.

        Raises HardwareError with port and remedy; the caller adds the device's name."""
        raise NotImplementedError

    def switch_off(self) -> None:
        """Disable the amplifier over a link of its own, without set-up (only devices that drive).

        Raises HardwareError, OSError."""
        raise NotImplementedError

    def disconnect(self) -> None:
        """Release the port; never raises."""
        raise NotImplementedError

    def read(self, sample: Sample, now_s: float) -> None:
        """Put the readings that have arrived into `sample`; never blocks.

        Raises OSError or HardwareError when the link is gone."""
        raise NotImplementedError

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send the command; never blocks. Raises the errors of `read`."""

    def wait_frame(self, until_ns: int) -> bool:
        """Wait for a whole frame (only devices with `bus: serial-binary`); see thermoctl_hal.serial.port."""
        raise NotImplementedError

    def poll(self, sample: Sample) -> None:
        """Read every channel once (only slow devices); blocks up to the profile's timeout.

        Raises the errors of `read`."""
        raise NotImplementedError

    def put(self, sample: Sample, bound: int, raw: float, time_s: float) -> None:
        """Store `raw`, scaled, for bound channel `bound`; ERROR when out of range or not finite."""
        if self._channels.put(sample, bound, raw, time_s):
            if self.problems:
                self.problems.pop(self.roles[bound], None)
        else:
            b = self.binding.bounds[bound]
            self.fail(
                sample,
                bound,
                f"reading {raw * b.scale + b.offset:g} is outside {b.low:g} .. {b.high:g}: "
                + ("overload, or no value" if abs(raw) > NO_VALUE else "check sensor and wiring"),
            )

    def fail(self, sample: Sample, bound: int, problem: str) -> None:
        """Mark bound channel `bound` as ERROR; the last valid value stays."""
        sample.status[self.roles[bound]] = ERROR
        self.miss(bound, problem)

    def miss(self, bound: int, problem: str) -> None:
        """Note why bound channel `bound` has no new reading; the last value is kept until it is stale."""
        self.problems[self.roles[bound]] = f"{self.name} {self.binding.bounds[bound].channel.name}: {problem}"

    def fail_all(self, sample: Sample, problem: str) -> None:
        """Mark every channel as ERROR."""
        for i in range(len(self.roles)):
            self.fail(sample, i, problem)

    def miss_all(self, problem: str) -> None:
        """Note for every channel why it has no new reading."""
        for i in range(len(self.roles)):
            self.miss(i, problem)

    def silence(self) -> str:
        """Say what arrives instead of a reading while the link is open."""
        return "nothing arrives: check its power and cable"

    def counters(self) -> dict[str, int]:
        """Return the driver's counters by name."""
        return self.counts

    def explain(self, sample: Sample, role: int) -> str:
        """Say in one line why this role is not OK; '' when it is."""
        if sample.status[role] not in (ERROR, STALE):
            return ""
        return self.problems.get(role) or (
            f"{self.name}: no new reading on {self.binding.port}: {self.silence()}"
        )
