"""The contract between the loop and the hardware: one small interface for every back end.

A back end has `open()`, `read(now_s) -> Sample`, `write(drive, enable)`, `close()`. `hal.backend` in the
configuration chooses it: real devices (serial, CAN, Modbus), the simulated plant or a replayed recording. A
fault injector can wrap any of them. hal.make makes them.

The contract
- `open()` may block and raises HardwareError (one line: device, port, what was expected, what to do) or
  yamlfile.InputError (the configuration is at fault). Opening drives nothing: the amplifier is disabled
  afterwards. A device without a role in `protection.required` may be absent: it is STALE, with its message,
  until it comes.
- `read(now_s)` never blocks, never raises for a device that misbehaves, and allocates no arrays: it returns
  the same `Sample` object every time, refilled in place. Copy values that you need after the tick. A device
  that is gone is reconnected in the background. Its last values are kept until they are stale; its channels
  return to OK without any action.
- `write(drive, enable)` never blocks. `drive` is the amplifier's command in the unit of the `drive` channel's
  profile (A for a CiA-402 drive in torque mode, V for a voltage amplifier; for the simulation the unit of the
  plant's input). A drive that is not finite, or `enable` False, sends zero and disables. A drive beyond the
  limits is clipped. Call it every tick, also when disabled: it carries the heartbeat that keeps the
  amplifier's own watchdog fed.
- `close()` disables the amplifier first, then releases every device. It may be called twice and after a
  failed open.
- `now_s` is seconds on one clock that every process shares (CLOCK_MONOTONIC, `time.monotonic()`) for real
  devices; the simulated and replayed back ends take any clock, so they run faster than real time when the
  caller's clock does.

The sample: arrays over ROLES (thermoctl/channels.py; index by `ROLE[name]`), all of length len(ROLES)
- `value`   float64, in the role's unit; the last valid reading, NaN before the first one.
- `time_s`  float64, when that reading was taken (clock of `now_s`); -inf before the first one.
- `fresh`   bool, True when a reading arrived that earlier `read` calls had not shown.
- `status`  uint8: OK; STALE (newest reading older than the profile's `stale_after_s`, the value is held);
            ERROR (the device reports a fault: invalid reading, sentinel such as an open thermocouple, refused
            register; or the reading is outside the profile's range, or the amplifier's link is gone);
            ABSENT (no device is bound to this role: not a fault).
`wait_frame(due_ns, until_ns)` (real devices only; loop.pace: device) waits until the position's device has
sent a whole frame, at most until `until_ns`, and only until `due_ns` while that device is gone;
`check_pacing()` raises InputError where no device of the rig can start the ticks.
`problem(role)` says in one line why a role is not OK ('' when it is), in the device's own words: register,
exception, checksum, open wire, length of a frame, how often. `counters()` gives `<device>.frames`, `.errors`,
`.reconnections` and the driver's other counters.

Slow buses. A device with `bus: modbus` blocks in its `poll()`. The daemon runs `hal.poller.run_poller` for
each in a process of its own, which writes the newest values to a `hal.board.Board` in shared memory; `read`
merges them. Without a board (doctor, tests) threads of the same process poll these devices. `hal.make` lists
slow and fast devices.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from thermoctl import channels

ROLES, ROLE = channels.CHANNELS, channels.INDEX
"""What a channel can be to the controller, and each one's place in the arrays of a sample."""
OK, STALE, ERROR, ABSENT = channels.OK, channels.STALE, channels.ERROR, channels.ABSENT
STATUS_NAMES = channels.STATUS_NAMES
AMP_OFFLINE, AMP_DISABLED, AMP_ENABLED = channels.AMP_OFFLINE, channels.AMP_DISABLED, channels.AMP_ENABLED
AMP_FAULT, AMP_QUICK_STOP = channels.AMP_FAULT, channels.AMP_QUICK_STOP


class HardwareError(Exception):
    """A device cannot be opened or configured. One line: device, port, what was expected, what to do."""


class Sample:
    """One reading of every role; the arrays are described in the module's text."""

    __slots__ = ("value", "time_s", "fresh", "status")

    def __init__(self) -> None:
        self.value = np.full(len(ROLES), np.nan)
        self.time_s = np.full(len(ROLES), -np.inf)
        self.fresh = np.zeros(len(ROLES), dtype=bool)
        self.status = np.full(len(ROLES), ABSENT, dtype=np.uint8)


class Backend(Protocol):
    """What the loop needs of hardware; the contract stands in the module's text."""

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
