"""How the loop sees hardware: one small interface, whatever is behind it.

A back end has `open()`, `read(now_s) -> Sample`, `write(drive, enable)`, `close()`. `hal.backend` in the configuration
chooses what stands behind it: real devices (serial, CAN, Modbus), the simulated plant or a replayed recording; a
fault-injecting wrapper goes around any of them.

The contract
- `open()` may block and raises HardwareError (one line: device, port, what was expected, what to do) or
  yamlfile.InputError (the configuration is at fault). Opening drives nothing: the amplifier is disabled afterwards. A
  device without a role in `protection.required` may be absent: it is STALE, with its message, until it comes.
- `read(now_s)` never blocks, never raises for a device that misbehaves, and allocates no arrays: it returns the same
  `Sample` object every time, refilled in place. Copy what must outlive the tick. A device that is gone is reconnected in
  the background; its last values stand until they are stale, and its channels come back by themselves.
- `write(drive, enable)` never blocks. `drive` is the amplifier's command in the unit of the `drive` channel's profile
  (A for a CiA-402 drive in torque mode, V for a voltage amplifier; for the simulation the unit of the plant's input).
  A drive that is not finite, or `enable` False, sends zero and disables. A drive beyond the limits is clipped.
  Call it every tick, also when disabled: it carries the heartbeat that keeps the amplifier's own watchdog fed.
- `close()` disables the amplifier first, then releases every device. It may be called twice and after a failed open.
- `now_s` is seconds on one clock that every process shares (CLOCK_MONOTONIC, `time.monotonic()`) for real devices; the
  simulated and replayed back ends take any clock, so they run faster than real time when the caller's clock does.

The sample: arrays over ROLES (thermoctl/channels.py; index by `ROLE[name]`), all of length len(ROLES)
- `value`   float64, in the role's unit; the last valid reading, NaN before the first one.
- `time_s`  float64, when that reading was taken (clock of `now_s`); -inf before the first one.
- `fresh`   bool, True when a reading arrived that earlier `read` calls had not shown.
- `status`  uint8: OK; STALE (newest reading older than the profile's `stale_after_s`, the value is held);
            ERROR (what the device says of itself: reported invalid, sentinel such as an open thermocouple, a register
            it refuses, outside the profile's range; and the amplifier's roles at once when its link is gone);
            ABSENT (no device is bound to this role: not a fault).
`wait_frame(due_ns, until_ns)` (real devices only; loop.pace: device) waits until the position's device has sent a whole
frame, at most until `until_ns`, and only until `due_ns` while that device is gone; `check_pacing()` raises InputError
where no device of the rig can give the time.
`problem(role)` says in one line why a role is not OK ('' when it is), in the device's own words: register, exception,
checksum, open wire, length of a frame, how often. `counters()` gives `<device>.frames`, `.errors`, `.reconnections` and
what else a driver counts.

Slow buses. `slow_devices(settings)` lists devices whose `poll()` blocks (any profile with `bus: modbus`): the daemon
runs each in a process of its own with `hal.board.run_poller`, which writes newest values to a `hal.board.Board` in
shared memory; the back end made with `make_backend(settings, board)` merges them in `read`. Without a board
(`make_backend(settings)`: doctor, tests) it polls them from threads of its own.
`fast_devices(settings)` lists those that are read inside the tick.
"""

from __future__ import annotations

from typing import Any, Protocol

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
        """The newest reading of every channel at now_s (monotonic seconds); never blocks."""

    def write(self, drive: float, enable: bool) -> None:
        """Send the drive (in the unit of its profile) and whether the amplifier shall be enabled."""

    def close(self) -> None:
        """Disable the amplifier and let go of everything; may be called twice."""

    def problem(self, role: str) -> str:
        """What the device of a role says is wrong, in its own words; '' when nothing is."""

    def counters(self) -> dict[str, int]:
        """Counts since the start by name: frames lost, checksums that failed, reconnections."""


def make_backend(settings: Any, board: Any = None) -> Backend:
    """The back end that `settings.hal` asks for, not yet open; inside the fault injector where `hal.faults` lists any.

    board: a hal.board.Board that poller processes fill, or None to poll slow devices from threads of this process.
    Raises InputError where the configuration, a profile or the plant is at fault.
    """
    kind = settings.hal.backend
    backend: Backend
    if kind == "simulated":
        from hal.simulated import simulated_backend

        backend = simulated_backend(settings)
    elif kind == "replay":
        from hal.replay import replay_backend

        backend = replay_backend(settings)
    elif kind == "devices":
        from hal.devices import DevicesBackend

        backend = DevicesBackend(
            fast_devices(settings), slow_devices(settings), board, settings.protection.required
        )
    else:
        raise ValueError(f"hal.backend is {kind!r}; settings.py allows simulated, devices or replay")
    if settings.hal.faults:
        from hal.faulty import FaultInjector, schedule

        backend = FaultInjector(backend, schedule(settings.hal.faults), seed=settings.hal.seed)
    return backend


def fast_devices(settings: Any) -> list:
    """The devices of `hal.devices` that are read and written inside the tick, not yet open (hal.devices.Device)."""
    from hal.devices import make_devices

    return [d for d in make_devices(settings) if not d.slow]


def slow_devices(settings: Any) -> list:
    """The devices of `hal.devices` with a blocking poll(), not yet open (class hal.modbus.ModbusDevice)."""
    from hal.devices import make_devices

    return [d for d in make_devices(settings) if d.slow]


def can_drive(settings: Any) -> bool:
    """Whether anything takes the command, so that the rig may be armed. Raises InputError."""
    if settings.hal.backend != "devices":
        return True
    from hal.devices import driving_devices

    return bool(driving_devices(settings))


def disable_amplifier(settings: Any) -> None:
    """Disable the amplifier of `hal.devices` over a link of its own: for when the loop can no longer do it. No other device is
    opened, and a mistake in another device's profile does not count. Raises HardwareError, OSError, InputError."""
    if settings.hal.backend != "devices":
        return
    from hal.devices import driving_devices

    for device in driving_devices(settings):
        device.switch_off()
