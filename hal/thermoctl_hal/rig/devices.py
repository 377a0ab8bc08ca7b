# cython: annotation_typing=False, cdivision=True
"""Real devices as one back end, with reconnection.

A failed link is closed. A thread connects it again while the ticks continue.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.rig.channels import AT, DEFAULT, AxesChannels, Channels
from thermoctl_hal.base.backend import ABSENT, STALE, HardwareError, Sample
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.wire import Ages, wait_readable
from thermoctl_hal.rig.board import Board
from thermoctl_hal.rig.poller import RECONNECT_S, poll_until, ports


class DevicesBackend:
    """`thermoctl_hal.base.backend.Backend` over real devices.

    Other processes poll the slow devices and post to `board`; without a board, threads of this process poll
    them. A fast device may be absent at the start when none of its roles is `required` (None: every role
    is)."""

    def __init__(
        self,
        fast: list[Device],
        slow: list[Device],
        board: Board | None = None,
        required: Iterable[str] | None = None,
        channels: Channels = DEFAULT,
    ) -> None:
        self.fast, self.slow, self.board = fast, slow, board
        self.roles, count = channels.index, len(channels.names)
        self.required = {self.roles[r] for r in required} if required is not None else set(range(count))
        self.sample = Sample(count)
        self._owner = {role: d for d in [*fast, *slow] for role in d.roles}
        # With loop.pace: device, the frames of this device start the ticks.
        self._pacing = self._owner.get(AT["position_um"])
        self._slow_drives = [d for d in slow if d.drives]
        self._seen = dict.fromkeys(slow, 0)
        limit_s = np.full(count, np.inf)  # age at which a reading is stale
        for b in (b for d in self._owner.values() for b in d.binding.bounds):
            limit_s[self.roles[b.role]] = b.channel.stale_after_s
        self._ages = Ages(self.sample, limit_s)
        shared = [
            (self.roles[b.role], k)
            for d in self._owner.values()
            for b in d.binding.bounds
            if isinstance(channels, AxesChannels)
            for k in channels.copies(b.role)
        ]
        self._copied, self._copies = [r for r, _ in shared], [k for _, k in shared]
        self._owner |= {k: self._owner[r] for r, k in shared}
        self._read_as = dict(zip(self._copies, self._copied, strict=True))
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._repairs: dict[Device, threading.Thread] = {}
        self._now_s = 0.0

    def open(self) -> None:
        """Connect every fast device, the one that drives first, and start the polling of slow ones.

        Raises HardwareError that reports all failures together."""
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
            self.board = Board.private(len(self.roles))
            for group in ports(self.slow):
                self._start(poll_until, (group, self.board, self._stop), f"poll {group[0].name}")

    def _start(self, target: Callable[..., None], args: tuple[object, ...], name: str) -> None:
        thread = threading.Thread(target=target, args=args, daemon=True, name=name)
        thread.start()
        self._threads.append(thread)

    def read(self, now_s: float) -> Sample:
        """Read all devices once; see thermoctl_hal.base.backend."""
        sample = self.sample
        self._now_s = now_s
        self._ages.begin()
        for device in self.fast:
            if device.up:
                try:
                    device.read(sample, now_s)
                except (OSError, HardwareError) as e:
                    self._lost(device, e)
        board = self.board
        if board is not None:
            for device in self.slow:
                self._seen[device] = board.merge(sample, device.roles, self._seen[device])
        self._ages.judge(now_s)
        for k in range(len(self._copied)):
            self._copy(self._copied[k], self._copies[k])
        return sample

    def _copy(self, read: int, further: int) -> None:
        """Copy a reading that several axes share to its place in another axis."""
        s = self.sample
        s.value[further], s.time_s[further] = s.value[read], s.time_s[read]
        s.fresh[further], s.status[further] = s.fresh[read], s.status[read]

    def check_pacing(self) -> None:
        """Raise InputError where the position's device cannot start the ticks (loop.pace: device)."""
        device = self._pacing
        if device is None or device.binding.profile.bus != "serial-binary":
            found = "no device" if device is None else f"{device.name} ({device.binding.profile.bus})"
            raise InputError(
                f"loop.pace: device: the position comes from {found}; an encoder that streams frames "
                "(bus: serial-binary) was expected: set loop.pace: clock"
            )

    def wait_frame(self, due_ns: int, until_ns: int) -> None:
        """Wait for a whole frame of the position's device, at most until `until_ns` (loop.pace: device).

        Wait only until `due_ns` while the device is gone. Returns early on a signal."""
        device = self._pacing
        if device is not None and device.up:
            try:
                device.wait_frame(until_ns)
                return
            except (OSError, HardwareError) as e:
                self._lost(device, e)
        wait_readable(-1, due_ns)

    def write(self, drive: float, enable: bool, axis: int = 0) -> None:
        """Send the command to the device that drives this axis; see thermoctl_hal.base.backend."""
        if not enable or drive - drive != 0.0:  # not finite
            drive, enable = 0.0, False
        for device in self.fast:
            if device.drives and device.up and device.axis == axis:
                try:
                    device.write(drive, enable, self._now_s)
                except (OSError, HardwareError) as e:
                    self._lost(device, e)
        if self.board is not None:
            for device in self._slow_drives:
                if device.axis == axis:
                    self.board.send(device, drive, enable, self._now_s)

    def close(self) -> None:
        """Disable and release everything; see thermoctl_hal.base.backend."""
        self._stop.set()
        self._switch_off()  # before the wait for a device that is being connected
        for repair in list(self._repairs.values()):
            repair.join(5.0)
        self._switch_off()
        for device in self.fast:
            if device.up:
                device.up = False
                device.disconnect()
        for thread in self._threads:
            thread.join(5.0)
        if self._threads:
            self._threads, self.board = [], None

    def _switch_off(self) -> None:
        """Disable every amplifier that is connected."""
        for device in self.fast:
            if device.drives and device.up:
                with contextlib.suppress(OSError, HardwareError):
                    device.write(0.0, False, time.monotonic())

    def problem(self, role: str) -> str:
        """Return in one line why `role` is not OK; '' when it is."""
        i = self.roles[role]
        if i not in self._owner:
            return f"{role}: no device of hal.devices has this role"
        i = self._read_as.get(i, i)
        text = self._owner[i].explain(self.sample, i)
        if text and self.board is not None and self._owner[i].slow:
            return self.board.problem(i) or text
        return text

    def counters(self) -> dict[str, int]:
        """Return the counters of all devices as `<device>.<counter>`.

        Those of a slow device are the values that its poller posted last."""
        counts = {f"{d.name}.{name}": n for d in self.fast for name, n in d.counters().items()}
        for d in self.slow:
            posted = d.counters() if self.board is None else self.board.counts(d)
            counts |= {f"{d.name}.{name}": n for name, n in posted.items()}
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
