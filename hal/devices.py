# cython: annotation_typing=False, cdivision=True
"""Real devices as one back end: what every driver shares, and the keeping up of links.

A driver knows one protocol. Its `connect` may block (opening, configuring); `read` and `write`, called in the tick, may
not. A link that fails is closed, and a thread connects it again while the tick goes on.

ERROR is for what a device says of itself: a sentinel, a bad status flag, a refused register. A lost answer, a damaged
frame or a link that is gone leaves the last value standing until it is stale. The device that drives is the exception:
without its link nothing is known of the amplifier, so its channels are ERROR at once.
"""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from hal.backend import ABSENT, ERROR, ROLE, ROLES, STALE, HardwareError, Sample
from hal.profile import Binding, bind, check_rig, rig_notes
from hal.wire import Ages, Channels, wait_readable
from thermoctl.yamlfile import InputError

RECONNECT_S = 0.25  # between attempts to open a device that is gone
SLOW_BUSES = ("modbus",)


class Device:
    """What drivers share: bound channels, the check of each reading, counters. Subclasses implement connect,
    disconnect, and either read (+ write where `drives`) or, where `slow`, poll."""

    def __init__(self, binding: Binding) -> None:
        self.binding = binding
        self.name = binding.name
        self.slow = binding.profile.bus in SLOW_BUSES
        self.drives = binding.profile.drive is not None
        self.roles = [ROLE[b.role] for b in binding.bounds]
        columns = zip(*((b.scale, b.offset, b.low, b.high) for b in binding.bounds), strict=True)
        self._channels = Channels(np.array(self.roles, np.intc), *(np.array(c, float) for c in columns))
        self.problems: dict[int, str] = {}  # by role: what is wrong now; a good reading clears it
        self.counts: dict[str, int] = {"frames": 0, "errors": 0, "reconnections": 0}
        self.up = False

    def connect(self) -> None:
        """Open and configure; may block. Raises HardwareError with the port and what to do, without the device's name."""
        raise NotImplementedError

    def switch_off(self) -> None:
        """Devices that drive: disable the amplifier over a link of its own, without set-up. Raises HardwareError, OSError."""
        raise NotImplementedError

    def disconnect(self) -> None:
        """Release the port; never raises."""
        raise NotImplementedError

    def read(self, sample: Sample, now_s: float) -> None:
        """Take what has arrived into `sample`; never blocks. Raises OSError or HardwareError when the link is gone."""
        raise NotImplementedError

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send the command; never blocks. Raises as read does."""

    def poll(self, sample: Sample) -> None:
        """Slow devices: read every channel once; blocks up to the profile's timeout. Raises as read does."""
        raise NotImplementedError

    def put(self, sample: Sample, bound: int, raw: float, time_s: float) -> None:
        """Store reading `raw` of the bound channel number `bound`, scaled; out of range or not finite is ERROR."""
        if self._channels.put(sample, bound, raw, time_s):
            if self.problems:
                self.problems.pop(self.roles[bound], None)
        else:
            b = self.binding.bounds[bound]
            self.fail(
                sample,
                bound,
                f"reading {raw * b.scale + b.offset:g} is outside {b.low:g} .. {b.high:g}: "
                "check sensor and wiring",
            )

    def fail(self, sample: Sample, bound: int, problem: str) -> None:
        """Mark the bound channel number `bound` as ERROR; the last valid value stays."""
        sample.status[self.roles[bound]] = ERROR
        self.miss(bound, problem)

    def miss(self, bound: int, problem: str) -> None:
        """Note why no reading of the bound channel number `bound` came; the last value stands until it is stale."""
        self.problems[self.roles[bound]] = f"{self.name} {self.binding.bounds[bound].channel.name}: {problem}"

    def fail_all(self, sample: Sample, problem: str) -> None:
        """Mark every channel as ERROR."""
        for i in range(len(self.roles)):
            self.fail(sample, i, problem)

    def miss_all(self, problem: str) -> None:
        """Note why no reading came of any channel."""
        for i in range(len(self.roles)):
            self.miss(i, problem)

    def silence(self) -> str:
        """Why no reading comes although the link is open: what arrives instead, or that nothing does."""
        return "nothing arrives: check its power and cable"

    def counters(self) -> dict[str, int]:
        """What the driver has counted, by name."""
        return self.counts

    def explain(self, sample: Sample, role: int) -> str:
        """One line: why this role is not OK; '' when it is."""
        if sample.status[role] not in (ERROR, STALE):
            return ""
        return self.problems.get(role) or (
            f"{self.name}: no new reading on {self.binding.port}: {self.silence()}"
        )


def make_devices(settings: Any) -> list[Device]:
    """The drivers of `settings.hal.devices` (yamlfile nodes), not connected. Profiles are relative to the config file.
    Raises InputError."""
    bindings = _bindings(settings)
    check_rig(bindings)
    return [_driver(b) for b in bindings]


def _bindings(settings: Any) -> list[Binding]:
    return [bind(node, Path(settings.path).parent) for node in settings.hal.devices]


def device_notes(settings: Any) -> list[str]:
    """What is allowed in `settings.hal.devices` and yet probably meant otherwise, a line each. Raises InputError."""
    return rig_notes(_bindings(settings))


def driving_devices(settings: Any) -> list[Device]:
    """The drivers of the devices that take the command, not connected. A mistake in another device's binding or profile
    does not count. Raises InputError where no device drives because of one."""
    devices, mistakes = [], []
    for node in settings.hal.devices:
        try:
            binding = bind(node, Path(settings.path).parent)
            if binding.profile.drive is not None:
                devices.append(_driver(binding))
        except InputError as e:
            mistakes.append(e)
    if mistakes and not devices:
        raise mistakes[0]
    return devices


def _driver(binding: Binding) -> Device:
    bus = binding.profile.bus
    if bus == "modbus":
        from hal.modbus import ModbusDevice

        return ModbusDevice(binding)
    if bus.startswith("can"):
        from hal.can_bus import Cia402Device, DbcDevice

        return Cia402Device(binding) if bus == "can-cia402" else DbcDevice(binding)
    from hal.serial_port import SerialDevice

    return SerialDevice(binding)


class DevicesBackend:
    """`hal.backend.Backend` over real devices. With a board, slow devices are polled by other processes; without, by
    threads of this one. A fast device without a role of `required` (None: every role is) may be absent at the start."""

    def __init__(
        self, fast: list[Device], slow: list[Device], board: Any = None, required: Any = None
    ) -> None:
        self.fast, self.slow, self.board = fast, slow, board
        self.required = {ROLE[r] for r in required} if required is not None else set(range(len(ROLES)))
        self.sample = Sample()
        self._owner = {role: d for d in [*fast, *slow] for role in d.roles}
        self._pacing: Any = self._owner.get(ROLE["position_um"])  # loop.pace: device
        self._seen = dict.fromkeys(slow, 0)
        limit_s = np.full(len(ROLES), np.inf)  # age at which a reading is stale
        for b in (b for d in self._owner.values() for b in d.binding.bounds):
            limit_s[ROLE[b.role]] = b.channel.stale_after_s
        self._ages = Ages(self.sample, limit_s)
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._repairs: dict[Device, threading.Thread] = {}
        self._now_s = 0.0

    def open(self) -> None:
        """Connect every fast device, the one that drives first (all failures are reported together), and start the polling
        of slow ones."""
        self._stop.clear()
        failures, absent = [], []
        for device in sorted(self.fast, key=lambda d: not d.drives):
            try:
                device.connect()
                device.up = True
            except (HardwareError, OSError) as e:
                if device.drives or self.required.intersection(device.roles):
                    failures.append(f"{device.name}: {e}")
                else:
                    absent.append((device, e))
        if failures:
            self.close()
            raise HardwareError("; ".join(failures))
        self.sample.status[:] = ABSENT
        for device in [*self.fast, *self.slow]:
            self.sample.status[device.roles] = STALE
        for device, why in absent:
            self._connect_again(device, f"{why}; trying again")
        if self.board is None and self.slow:
            from hal.board import Board, poll_until

            self.board = Board.private()
            for device in self.slow:
                thread = threading.Thread(
                    target=poll_until,
                    args=(device, self.board, self._stop),
                    daemon=True,
                    name=f"poll {device.name}",
                )
                thread.start()
                self._threads.append(thread)

    def read(self, now_s: float) -> Sample:
        """One pass over all devices; see hal.backend."""
        sample = self.sample
        self._now_s = now_s
        self._ages.begin()
        for device in self.fast:
            if device.up:
                try:
                    device.read(sample, now_s)
                except (OSError, HardwareError) as e:
                    self._lost(device, e)
        for device in self.slow:
            self._seen[device] = self.board.merge(sample, device.roles, self._seen[device])
        self._ages.judge(now_s)
        return sample

    def check_pacing(self) -> None:
        """Raises InputError where the position's device cannot give the time (loop.pace: device)."""
        device = self._pacing
        if device is None or device.binding.profile.bus != "serial-binary":
            what = "no device" if device is None else f"{device.name} ({device.binding.profile.bus})"
            raise InputError(
                f"loop.pace: device: the position comes from {what}; an encoder that streams frames "
                "(bus: serial-binary) was expected: set loop.pace: clock"
            )

    def wait_frame(self, due_ns: int, until_ns: int) -> None:
        """Wait until the position's device has sent a whole frame, at most until `until_ns`; only until `due_ns` while it is
        gone (pace: device). Returns early when a signal came."""
        device = self._pacing
        try:
            if device is not None and device.up:
                device.wait_frame(until_ns)
                return
        except (OSError, HardwareError) as e:
            self._lost(device, e)
        wait_readable(-1, due_ns)

    def write(self, drive: float, enable: bool) -> None:
        """Command to the device that drives; see hal.backend."""
        if not enable or drive - drive != 0.0:  # not finite
            drive, enable = 0.0, False
        for device in self.fast:
            if device.drives and device.up:
                try:
                    device.write(drive, enable, self._now_s)
                except (OSError, HardwareError) as e:
                    self._lost(device, e)

    def close(self) -> None:
        """Disable and release everything; see hal.backend."""
        self._stop.set()
        for repair in list(self._repairs.values()):
            repair.join(5.0)
        for device in self.fast:
            if device.up:
                if device.drives:
                    with contextlib.suppress(OSError, HardwareError):
                        device.write(0.0, False, time.monotonic())
                device.up = False
                device.disconnect()
        for thread in self._threads:
            thread.join(5.0)
        if self._threads:
            self._threads, self.board = [], None

    def problem(self, role: str) -> str:
        """Why `role` is not OK, in one line, or ''."""
        i = ROLE[role]
        if i not in self._owner:
            return f"{role}: no device of hal.devices has this role"
        text = self._owner[i].explain(self.sample, i)
        if text and self.board is not None and self._owner[i].slow:
            return self.board.problem(i) or text
        return text

    def counters(self) -> dict[str, int]:
        """`<device>.<what>`: frames, errors, reconnections and what else a driver counts; of slow devices what their
        pollers posted."""
        counts = {f"{d.name}.{what}": n for d in self.fast for what, n in d.counters().items()}
        for d in self.slow:
            posted = d.counters() if self.board is None else self.board.counts(d)
            counts |= {f"{d.name}.{what}": n for what, n in posted.items()}
        return counts

    def _lost(self, device: Device, why: Exception) -> None:
        device.up = False
        text = (
            f"lost on {device.binding.port} ({getattr(why, 'strerror', None) or why}); "
            "reconnecting: check cable and power"
        )
        if device.drives:
            device.fail_all(self.sample, text)
        self._connect_again(device, text)

    def _connect_again(self, device: Device, why: str) -> None:
        device.miss_all(why)
        thread = threading.Thread(
            target=self._repair, args=(device, why), daemon=True, name=f"reconnect {device.name}"
        )
        self._repairs[device] = thread
        thread.start()

    def _repair(self, device: Device, why: str) -> None:
        device.disconnect()
        while not self._stop.wait(RECONNECT_S):
            try:
                device.connect()
            except (HardwareError, OSError) as e:
                device.miss_all(why if str(e) in why else f"{why}; now: {e}")
                continue
            device.problems.clear()
            device.counts["reconnections"] += 1
            device.up = True
            return
