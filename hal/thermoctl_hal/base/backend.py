"""Define the interface between the control loop and the hardware.

A back end has `open()`, `read(now_s) -> Sample`, `write(drive, enable)` and `close()`. `hal.backend` in the
configuration selects it: real devices (serial, CAN, Modbus) or the simulated plant. A fault injector can wrap
either. thermoctl_hal.rig.make creates them.

- `open()` may block. It drives nothing: the amplifier is disabled afterwards. It raises HardwareError (one
  line: device, port, expectation, remedy), or yamlfile.InputError for a wrong configuration. A device without
  a role in `protection.required` may be absent: its channels are STALE, with a message, until it appears.
- `read(now_s)` never blocks and never raises for a faulty device. It allocates no arrays: it refills the
  same `Sample` object every time. Copy values that you need after the tick. A lost device is reconnected in
  the background. Its last values are kept until they are stale; its channels return to OK without any action.
- `write(drive, enable)` never blocks. The profile of the `drive` channel sets its unit: A for a CiA-402 drive
  in torque mode, V for a voltage amplifier. For the simulation it is the unit of the plant's input. A drive
  that is not finite, or `enable` False, sends zero and disables. A drive beyond the limits is clipped. Call
  it every tick, also when disabled: it sends the heartbeat for the amplifier's own watchdog.
- `close()` disables the amplifier first, then releases every device. It may be called twice, and after a
  failed open.
- `now_s` is in seconds. Real devices need the clock that every process shares (CLOCK_MONOTONIC,
  `time.monotonic()`). The simulated back end takes any clock, so it can run faster than real time.

A sample has arrays over the rig's channels (thermoctl/rig/channels.py), in their order:

    value    float64, in the role's unit; the last valid reading, NaN before the first one
    time_s   float64, when that reading was taken (clock of `now_s`); -inf before the first one
    fresh    bool, True when a reading arrived that earlier `read` calls had not shown
    status   uint8: OK
             STALE   newest reading older than the profile's `stale_after_s`; the value is held
             ERROR   the device reports a fault (sentinel, refused register), the reading is outside the
                     profile's range, or the link to the amplifier is lost
             ABSENT  no device is bound to this role: not a fault

Back ends of real devices also have, for `loop.pace: device`:

- `wait_frame(due_ns, until_ns)` waits for a whole frame of the position's device, at most until `until_ns`.
  While that device is lost it waits only until `due_ns`.
- `check_pacing()` raises InputError when no device of the rig can start the ticks.

`problem(role)` returns in one line why a role is not OK ('' when it is), in the device's own words: register,
exception, checksum, how often. `counters()` returns `<device>.frames`, `.errors`, `.reconnections` and the
driver's other counters.

A device with `bus: modbus` is slow: it blocks in its `poll()`. The daemon runs `poller.run_poller` for each
in its own process. That process writes the newest values to a `board.Board` in shared memory, and `read`
merges them. Without a board (doctor, tests) threads of the same process poll these devices.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from thermoctl.rig import channels

ROLES, ROLE = channels.CHANNELS, channels.INDEX
"""Roles of the paper's actuator only, and their indices: a rig's own are `settings.channels`."""
OK, STALE, ERROR, ABSENT = channels.OK, channels.STALE, channels.ERROR, channels.ABSENT
STATUS_NAMES = channels.STATUS_NAMES
AMP_OFFLINE, AMP_DISABLED, AMP_ENABLED = channels.AMP_OFFLINE, channels.AMP_DISABLED, channels.AMP_ENABLED
AMP_FAULT, AMP_QUICK_STOP = channels.AMP_FAULT, channels.AMP_QUICK_STOP


class HardwareError(Exception):
    """A device cannot be opened or configured. One line: device, port, expectation, remedy."""


class Sample:
    """One reading of every role; the arrays are described in the module's text."""

    __slots__ = ("value", "time_s", "fresh", "status")

    def __init__(self, count: int = len(ROLES)) -> None:
        """Make the sample of a rig with `count` channels."""
        self.value = np.full(count, np.nan)
        self.time_s = np.full(count, -np.inf)
        self.fresh = np.zeros(count, dtype=bool)
        self.status = np.full(count, ABSENT, dtype=np.uint8)


class Backend(Protocol):
    """Interface of the hardware to the loop; the module's docstring has the contract."""

    def open(self) -> None:
        """Connect to everything; all failures are reported together. Raises HardwareError."""

    def read(self, now_s: float) -> Sample:
        """Return the newest reading of every channel at now_s (monotonic seconds); never blocks."""

    def write(self, drive: float, enable: bool) -> None:
        """Send the command (in the unit of the profile) and whether the amplifier shall be enabled."""

    def close(self) -> None:
        """Disable the amplifier and release everything; may be called twice."""

    def problem(self, role: str) -> str:
        """Say why a role is not OK, in its device's own words; '' when it is OK."""

    def counters(self) -> dict[str, int]:
        """Return counts since the start by name: lost frames, failed checksums, reconnections."""


class Pacing(Protocol):
    """Two further methods of back ends of real devices, for `loop.pace: device`."""

    def check_pacing(self) -> None:
        """Raise InputError when no device of the rig can start the ticks."""

    def wait_frame(self, due_ns: int, until_ns: int) -> None:
        """Wait for a whole frame of the position's device; while it is lost, only until `due_ns`."""
