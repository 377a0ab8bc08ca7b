# cython: annotation_typing=False
"""The loop: one tick a period, alone in its process.

    sample -> estimate -> compensate -> control -> protect -> actuate -> publish

Nothing in a tick waits, parses, logs or touches a disk. A tick that takes too long skips the ticks it
covered. They are counted and published, and the phase is kept (policy `skip`). A tick of real devices runs in
C from end to end (loop.pxd has the types). After a sleep, Python's objects are no longer in the cache. Each
of priority, locked memory, processor and latency limit is requested from the kernel. A refusal is a warning,
not an error.
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control import arming, faults
from thermoctl.control.law import DELAY_S, Law
from thermoctl.control.model import CompensatorModel, Parameters
from thermoctl.daemon.tick.arrival import put_counters
from thermoctl.daemon.tick.clock import now_ns, sleep_until, suspended_ns, wall_s
from thermoctl.daemon.tick.ring import Box, Mailbox, Record, Remarks, Ring
from thermoctl.daemon.tick.shared import LOOP_PID, START_S, Shared
from thermoctl.rig.channels import AT, DEFAULT, Channels
from thermoctl.rig.signals import AT as SIGNAL_AT
from thermoctl.rig.signals import of_channels
from thermoctl_hal.base.backend import ABSENT, Backend, Pacing
from thermoctl_hal.rig.devices import DevicesBackend

RELOAD = float(len(arming.COMMANDS))
"""The mailbox command that applies the parameter block; the others are arming's."""
SUSPEND_NS = 1_000_000  # a smaller difference is no suspend: the two clocks are read one after the other
SUSPEND_EVERY = 16  # ticks between two checks for a suspend
STATE_EVERY = 1000  # ticks between two snapshots of the law's state, and between two of the devices' counters
_HEAD = SIGNAL_AT["state"]  # numbers of a row before the law's outputs, in the order of `publish`
_STATE_EVERY, _SUSPEND_EVERY, _SUSPEND_NS = (
    STATE_EVERY,
    SUSPEND_EVERY,
    SUSPEND_NS,
)  # numbers of C, by loop.pxd
_COUNTERS_AT = STATE_EVERY // 2  # not in the tick of the law's state
_DELAY_S, _LATEST = DELAY_S, 15
_OFF, _STATE, _CODE = arming.OFF, SIGNAL_AT["state"], SIGNAL_AT["amplifier_fault"]
_THERMAL = AT["air_c"]  # the air is the first thermal channel, all later ones are thermal
_ABSENT = ABSENT
_AMPLIFIER_WRITE = 1 << faults.BIT["amplifier_write"]
_FAULT, _OTHER_AXIS = arming.FAULT, 1 << faults.BIT["other_axis"]
_OWN_FAULTS = (1 << 64) - 1 - _OTHER_AXIS


class Axis:
    """Back end, law and record of one axis, and the stages of its tick. A rig without axes is one.

    backend: an open back end. publish: the ring that takes the finished rows, or a function that is called
    with each. mailbox, parameters, state, remarks: as in shared.Shared, or None where nobody commands or
    reads. wall_s, suspended_ns: clocks that replace the system's.
    """

    def __init__(
        self,
        backend: Backend,
        model: CompensatorModel,
        parameters: Parameters,
        period_s: float,
        publish: Ring | Callable[[np.ndarray], Any],
        mailbox: Mailbox | None = None,
        parameter_box: Box | None = None,
        state_box: Box | None = None,
        start_s: float = 0.0,
        remarks: Remarks | None = None,
        channels: Channels = DEFAULT,
    ):
        self.backend, self.publish_row, self.mailbox = backend, publish, mailbox
        self.parameter_box, self.state_box, self.start_s = parameter_box, state_box, start_s
        self.law: Any = Law(model, parameters, period_s)  # its state is declared in law.pxd only
        self.reading: Any = None
        self.channels, self._n = channels, len(channels.names)
        self.row = self._head = np.zeros(len(of_channels(channels)))
        self.record = Record(self.row, _HEAD)
        self._delay = np.zeros(self._n, np.uint8)
        self.remarks: Any = remarks
        self.said = [(0.0, "")] * self._n
        self._status = np.zeros(self._n, np.uint8)
        self.slips = self.generation = self.external = self.write_failed = 0
        self.guards: list[Axis] = []  # axes whose FAULT disarms this one
        self.command, self.value, self.busy_us = arming.NONE, 0.0, 0.0
        self.wall_s: Callable[[], float] | None = None
        self.suspended_ns: Callable[[], int] | None = None

    def tick(
        self, now_s: float, dt_s: float, lateness_us: float = 0.0, clock_ns: Callable[[], int] | None = None
    ) -> None:
        """Run one tick that began at `now_s`, `dt_s` after the one before.

        clock_ns: clock that measures the busy time; None: the loop's own clock.
        """
        begin = now_ns() if clock_ns is None else int(clock_ns())
        self.sample(now_s)
        self.law.estimate(dt_s)
        self.law.compensate()
        self.law.control(self.command, self.value)
        self.law.protect(self.command, self.external)
        self.actuate()
        end = now_ns() if clock_ns is None else int(clock_ns())
        self.busy_us = (end - begin) * 1e-3
        self.publish(now_s, dt_s, lateness_us)

    def sample(self, now_s: float) -> None:
        """Read new values into the law's arrays, and take the next command."""
        if isinstance(self.backend, DevicesBackend):
            devices = self.backend
            reading = devices.read(now_s)
        else:
            reading = self.backend.read(now_s)
        if reading is not self.reading:  # the same object every time, by contract
            self.reading = reading
            fresh = reading.fresh.view(np.uint8)
            self._fresh, self._time_s = fresh, reading.time_s
            self.law.bind(reading.value, fresh, reading.status, self._delay)
            self.record.bind(reading.value, fresh, reading.status, self._delay, self.law.outputs)
            self._status = reading.status
        for c in range(_THERMAL, self._n):
            if self._fresh[c]:  # temperatures come from slow buses: record the age of each
                age = (now_s - self._time_s[c]) / _DELAY_S
                self._delay[c] = 0 if age < 0.0 else _LATEST if age >= _LATEST else int(age)
        self.command, self.value, self.external = 0, 0.0, self.write_failed
        for other in self.guards:
            # Two axes in FAULT must not wait for each other.
            if other.trips_others() and self.law.state != _FAULT:
                self.external |= _OTHER_AXIS
        if self.mailbox is not None and self.mailbox.waiting():
            command = self.mailbox.take()
            if command is not None:
                self._obey(*command)

    def trips_others(self) -> bool:
        """Return whether this axis is in FAULT by a fault of its own, not of another axis."""
        return self.law.state == _FAULT and self.law.latched & _OWN_FAULTS != 0

    def _obey(self, kind: float, value: float) -> None:
        if kind == RELOAD:
            numbers = None if self.parameter_box is None else self.parameter_box.get()
            if numbers is not None:
                self.law.configure(Parameters.unpack(numbers))
                self.generation += 1
                self.keep_state()
        elif kind < RELOAD:
            self.command, self.value = int(kind), value

    def actuate(self) -> None:
        """Send the amplifier's command. A failed write is a fault of the next tick."""
        try:
            if isinstance(self.backend, DevicesBackend):
                devices = self.backend
                devices.write(self.law.drive, self.law.enable > 0.0)
            else:
                self.backend.write(self.law.drive, self.law.enable > 0.0)
            self.write_failed = 0
        except OSError:
            self.write_failed = _AMPLIFIER_WRITE

    def publish(self, now_s: float, dt_s: float, lateness_us: float) -> None:
        """Publish the finished row, and at intervals the law's state, where a replay may start."""
        law, head = self.law, self._head
        head[0] = now_s - self.start_s
        head[1] = wall_s() if self.wall_s is None else float(self.wall_s())
        head[2] = law.tick
        head[3], head[4] = lateness_us, self.busy_us
        head[5], head[6] = self.slips, self.generation
        head[7] = dt_s
        head[8], head[9], head[10] = self.command, self.value, self.external
        self.record.fill()
        if isinstance(self.publish_row, Ring):
            ring = self.publish_row
            ring.write(head)
        else:
            self.publish_row(self.row)
        if self.remarks is not None:
            self.remark(head[0], dt_s)
        if law.tick % _STATE_EVERY == 1:
            self.keep_state()

    def remark(self, t_s: float, dt_s: float) -> None:
        """Publish the remarks: ages, verdicts, onsets and the devices' messages.

        One channel a tick is checked for a new message; all are checked when a fault is new. Nothing is a
        fault while the law warms up.
        """
        law, head = self.law, self._head
        off = head[_STATE] == _OFF
        bits = 0 if off else law.faults | law.latched
        trips = 0 if off else law.trips | law.latched
        new = self.remarks.fill(law.age, law.verdict, bits, trips, t_s, law.tick, dt_s, head[_CODE])
        if new:
            for c in range(self._n):
                self._say(c, t_s)
        elif not off:
            self._say(law.tick % self._n, t_s)

    def _say(self, c: int, t_s: float) -> None:
        """Publish channel c's message when the channel is invalid and the message is new."""
        verdict = self.law.verdict[c]
        if self._status[c] == _ABSENT or (verdict == 0.0 and self.said[c][0] == 0.0):
            return
        words = self.backend.problem(self.channels.names[c]) if verdict > 0.0 and self._status[c] else ""
        if (verdict, words) == self.said[c]:
            return
        self.said[c] = (verdict, words)
        if verdict > 0.0:
            self.remarks.put(c, t_s, (words or self._verdict_in_words(c, int(verdict) - 1)).encode())

    def _verdict_in_words(self, c: int, kind: int) -> str:
        """Describe the law's verdict on a reading for which the device gives no message."""
        p, value = self.law.parameters, self.reading.value[c]
        return (
            "reported as invalid",
            f"no new reading within protection.stale_s ({p.stale_s[c]:g} s)",
            f"reads {value:g}, outside protection.low..high ({p.low[c]:g}..{p.high[c]:g})",
            f"jumped to {value:g}, faster than protection.rate ({p.rate[c]:g} a second)",
            f"stands at {value:g} without a change for longer than protection.frozen_s ({p.frozen_s[c]:g} s)",
        )[kind]

    def keep_state(self) -> None:
        """Store the law's tick, generation and state in `state_box`: a replay or the next run needs them."""
        if self.state_box is not None:
            self.state_box.put(np.concatenate(((self.law.tick, self.generation), self.law.snapshot())))


def run_loop(
    settings: Settings,
    shared: Shared,
    rig: Axis,
    stopping: Callable[[], bool],
    warm_up_ticks: int = 100,
    further: Sequence[tuple[Axis, Shared]] = (),
) -> None:
    """Tick until `stopping()`; the caller opens the back end before and disables the amplifier after.

    further: the other axes; they tick after the first one, with its time and step.
    """
    period_ns, spin_ns = round(settings.loop.period_s * 1e9), round(settings.loop.spin_s * 1e9)
    paced, device = settings.loop.pace == "device", cast(Pacing, rig.backend)
    counted = settings.loop.pace == "tick"
    if paced:
        device.check_pacing()
    for s in [shared, *[s for _, s in further]]:
        s.counters[START_S], s.counters[LOOP_PID] = rig.start_s, os.getpid()
    before = now_ns()
    slept_before = suspended_ns() if rig.suspended_ns is None else int(rig.suspended_ns())
    deadline = before + period_ns
    while not stopping():
        if paced:  # a late frame delays the tick, but by less than two periods
            sleep_until(before + period_ns // 2)
            device.wait_frame(deadline, deadline + period_ns)
            now = now_ns()
            deadline = min(deadline, now)
        else:
            now = sleep_until(deadline, spin_ns)
            if now < deadline:  # a signal woke us: its handler has run
                continue
        lateness_us = (now - deadline) * 1e-3
        gap_ns = 0
        if rig.law.tick % _SUSPEND_EVERY == 0:  # CLOCK_MONOTONIC stops during a suspend
            slept = suspended_ns() if rig.suspended_ns is None else int(rig.suspended_ns())
            gap_ns = slept - slept_before if slept - slept_before > _SUSPEND_NS else 0
            slept_before = slept
        if counted:  # time is counted in ticks: a stall of the machine also stops the simulated rig
            now_s, dt_s = rig.start_s + (rig.law.tick + 1) * rig.law.period_s, rig.law.period_s
        else:
            now_s, dt_s = now * 1e-9, (now - before + gap_ns) * 1e-9
        rig.tick(now_s, dt_s, lateness_us)
        _count(rig, shared, lateness_us, warm_up_ticks)
        for other, its in further:
            other.slips = rig.slips
            other.tick(now_s, dt_s, lateness_us)
            _count(other, its, lateness_us, warm_up_ticks)
        before = now
        deadline = now + period_ns if paced else deadline + period_ns
        late_ns = now_ns() - deadline
        if late_ns > 0:  # skip, and keep the phase
            skipped = late_ns // period_ns + (1 if late_ns % period_ns else 0)
            rig.slips += skipped
            deadline += skipped * period_ns


def _count(rig: Axis, shared: Shared, lateness_us: float, warm_up_ticks: int) -> None:
    """Add a tick to the histograms; at intervals publish the devices' counters."""
    if rig.law.tick % _STATE_EVERY == _COUNTERS_AT:
        put_counters(shared, rig.backend.counters())
    if rig.law.tick > warm_up_ticks:
        lateness, busy = shared.lateness, shared.busy
        lateness.add(lateness_us)
        busy.add(rig.busy_us)


def run_reference(settings: Settings, shared: Shared, stopping: Callable[[], bool]) -> None:
    """Run an idle loop half a period apart, to measure the machine's best lateness.

    It has the control loop's clock, priority and processor.
    """
    period_ns, spin_ns = round(settings.loop.period_s * 1e9), round(settings.loop.spin_s * 1e9)
    deadline = now_ns() // period_ns * period_ns + period_ns + period_ns // 2
    while not stopping():
        now = sleep_until(deadline, spin_ns)
        if now >= deadline:
            shared.reference.add((now - deadline) * 1e-3)
        while deadline <= now:
            deadline += period_ns


def become_real_time(settings: Settings, warn: Callable[[str], None]) -> list[Any]:
    """Ask for priority, processor, locked memory and low latency, and freeze the garbage collector.

    Returns the files that must stay open: the latency request lasts as long as its file. Each refusal is
    one `warn` line.
    """
    kept: list[Any] = []
    loop = settings.loop

    def attempt(action: Callable[[], Any], what: str, advice: str) -> None:
        """Call `action`; where the system refuses it, warn with `what` and `advice`."""
        try:
            action()
        except (OSError, PermissionError, ValueError, AttributeError) as e:
            warn(f"{what} refused ({getattr(e, 'strerror', None) or e}): {advice}")

    if loop.cpu is not None and loop.cpu >= 0:
        attempt(
            lambda: os.sched_setaffinity(0, {loop.cpu}),
            f"processor {loop.cpu}",
            "the loop runs where the scheduler puts it; set loop.cpu to an allowed processor",
        )
    if loop.priority > 0:
        attempt(
            lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(loop.priority)),
            f"real-time priority {loop.priority}",
            "expect late ticks; run under the systemd unit or allow it (LimitRTPRIO, CAP_SYS_NICE)",
        )
    attempt(_lock_memory, "locked memory", "page faults may delay ticks; raise LimitMEMLOCK")

    def hold_latency() -> None:
        """Request a wake-up latency of 0 us, in force while the file in `kept` is open. Raises OSError."""
        file = os.open("/dev/cpu_dma_latency", os.O_WRONLY)
        os.write(file, (0).to_bytes(4, "little"))
        kept.append(file)

    attempt(
        hold_latency,
        "/dev/cpu_dma_latency",
        "deep idle states may double the wake-up latency; give the service's group write access (udev rule)",
    )
    gc.collect()
    gc.freeze()
    gc.disable()
    return kept


def _lock_memory() -> None:
    current_and_future = 3
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(current_and_future) != 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))


def die_with_parent(signal_number: int = signal.SIGTERM) -> None:
    """Ask the kernel to send this process a signal when its parent ends, however it ends."""
    set_parent_death_signal = 1
    ctypes.CDLL(None, use_errno=True).prctl(set_parent_death_signal, signal_number, 0, 0, 0)
