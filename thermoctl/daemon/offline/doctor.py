"""Examine a rig while no daemon holds it: `check` reads files only, `doctor` connects and reads.

The checks of real time read /proc and /sys below `root` and change nothing. docs/how-to/real-time.md explains
them.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.lock import holder, socket_too_long
from thermoctl.daemon.offline.ready import obstacles
from thermoctl.daemon.tick.arrival import expected_hz, slow
from thermoctl.daemon.tick.assemble import (
    check_mode,
    compensator,
    lacks,
    law_parameters,
    origin,
    power_warning,
    priority_warning,
    unknown_group,
)
from thermoctl.daemon.tick.loop import become_real_time
from thermoctl.extras import lacking
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.writer import disk_warning
from thermoctl.rig.channels import AMPLIFIER_STATES
from thermoctl_hal.base.backend import OK, STATUS_NAMES, Backend, HardwareError, Sample
from thermoctl_hal.base.latency_timer import latency_timer_ms
from thermoctl_hal.rig.make import (
    device_notes,
    device_warnings,
    fast_devices,
    make_backend,
    make_backends,
    whole_frames,
)


def check(settings: Settings) -> int:
    """Check the configuration, the model, the plant and the profiles; no hardware is touched.

    Returns 1 where the rig could never be armed."""
    with _drivers(settings):
        make_backends(settings)  # back ends of all axes
    return _each_axis(settings, _check) if settings.axes else _check(settings)


def _check(settings: Settings) -> int:
    law_parameters(settings)
    model = compensator(settings)
    reported: list[tuple[bool, str]] = []
    notes: list[str] = []
    with _drivers(settings):
        check_mode(settings)
        notes = lacks(settings)
        if settings.hal.backend == "devices":
            notes = [
                *device_notes(settings),
                *notes,
                *filter(None, (origin(settings), unknown_group(settings))),
            ]
        reported = list(obstacles(settings))
        warnings = power_warning(settings), priority_warning(settings), *device_warnings(settings)
        reported += [(False, w) for w in warnings if w]
    if long := socket_too_long(settings):
        reported.append((True, long))
    for in_the_way, line in reported:
        print(f"{'error' if in_the_way else 'warning'}: {line}")
    bad = any(in_the_way for in_the_way, _ in reported)
    verdict = "NOT READY, the rig could not be armed" if bad else "good"
    print(
        f"{settings.path}: {verdict}. back end {settings.hal.backend}, period {settings.loop.period_s * 1e3:g} ms, "
        + (
            f"model {settings.compensation.model} ({model.kind}, order {len(model.A_minus_I)})"
            if settings.compensation.model
            else "no model: nothing is estimated and nothing is compensated"
        )
    )
    if note := disk_warning(settings.recording):
        notes.append(note)
    for note in notes:
        print(f"note: {note}")
    return int(bad)


@contextlib.contextmanager
def _drivers(settings: Settings) -> Iterator[None]:
    """Print a note where a driver's package is missing; other checks go on."""
    try:
        yield
    except ModuleNotFoundError as e:
        if (line := lacking(e)) is None:
            raise
        print(f"note: {settings.path}: not every device was checked; running it {line}")


def _each_axis(settings: Settings, examine: Callable[[Settings], int]) -> int:
    """Examine every axis; return the largest exit status."""
    statuses = []
    for part in settings.axes:
        print(f"axis {part.axis}:", flush=True)
        statuses.append(examine(part))
    return max(statuses)


@dataclass
class _Readings:
    """Number of reads, new readings of each role, frames of each device's counter, and the last sample."""

    reads: int
    counts: dict[str, int]
    frames: dict[str, int]
    sample: Sample


def doctor(settings: Settings, seconds: float = 2.0) -> int:
    """Connect and read every channel for `seconds`; print value, unit and rate. Drives nothing.

    Returns 1 when a channel is bad. Then prints which properties of the machine make ticks late, with
    remedies (docs/how-to/real-time.md); these do not change the exit status."""
    if (pid := holder(settings)) is not None:  # a second master on the buses could disarm the rig
        raise InputError(
            f"{settings.path}: pid {pid} holds the rig; look with `thermoctl status`, or stop it first"
        )
    if settings.axes:
        return _each_axis(settings, lambda part: doctor(part, seconds))
    backend = make_backend(settings)
    try:
        backend.open()
        counted = _read_for(backend, seconds, settings.loop.period_s, settings.channels.names)
        bad = _print_channels(settings, backend, counted, seconds)
    except HardwareError as e:
        print(f"thermoctl: {e}", file=sys.stderr)
        return 3
    finally:
        backend.close()
    for note in device_notes(settings) if settings.hal.backend == "devices" else ():
        print(f"note: {note}")
    print("\nreal time:")
    refused: list[str] = []
    become_real_time(settings, refused.append)
    for line in refused or ["priority, locked memory, processor and latency request are all granted"]:
        print(f"  {line}")
    for property in real_time_checks(settings):
        print(
            f"  {property.name:24}{'good' if property.good else 'tune'}  {property.found}"
            + ("" if property.good else f"\n{'':30}-> {property.remedy}")
        )
    return 1 if bad else 0


def _read_for(backend: Backend, seconds: float, period_s: float, roles: tuple[str, ...]) -> _Readings:
    """Read every period for `seconds`, with the amplifier disabled."""
    counts, reads = dict.fromkeys(roles, 0), 0
    before = dict(backend.counters())
    begin = now = time.monotonic()
    while not reads or now < begin + seconds:
        sample = backend.read(now)
        for role, fresh in zip(roles, sample.fresh, strict=True):
            counts[role] += int(fresh)
        reads += 1
        backend.write(0.0, False)  # a drive sends readings after each SYNC; it stays disabled
        time.sleep(period_s)
        now = time.monotonic()
    frames = {name: count - before.get(name, 0) for name, count in backend.counters().items()}
    return _Readings(reads, counts, frames, sample)


def _print_channels(settings: Settings, backend: Backend, found: _Readings, seconds: float) -> int:
    """Print one line a channel; return how many are bad."""
    expected, sample, bad = expected_hz(settings), found.sample, 0
    framed = whole_frames(settings) if expected else {}
    print(f"{'channel':24}{'value':>14} {'unit':8}{'status':8}{'rate':>10}")
    for k, channel in enumerate(settings.channels.table):
        role = channel.role
        state = STATUS_NAMES[sample.status[k]]
        if state == "ABSENT" and role not in settings.protection.required:
            continue
        bad += sample.status[k] != OK
        count, most_hz = found.counts[role], found.reads / seconds
        if (name := framed.get(role)) is not None and f"{name}.frames" in found.frames:
            count, most_hz = max(count, found.frames[f"{name}.frames"]), math.inf
        rate_hz = count / seconds
        problem = backend.problem(role) or slow(role, rate_hz, expected, most_hz)
        if not problem and role == "amplifier_state" and sample.value[k] in range(len(AMPLIFIER_STATES)):
            problem = AMPLIFIER_STATES[int(sample.value[k])]
        of = f" of {expected[role]:g}" if role in expected else ""
        print(
            f"{role:24}{sample.value[k]:14.4f} {channel.unit:8}{state:8}{rate_hz:7.1f}{of} Hz"
            + f"   {problem}".rstrip()
        )
    if counters := backend.counters():
        print("counters: " + ", ".join(f"{name} {count}" for name, count in counters.items()))
    return bad


@dataclass(frozen=True)
class Check:
    """One property of the machine: `good`, the value `found`, and the `remedy` when it is not good."""

    name: str
    good: bool
    found: str
    remedy: str


def real_time_checks(settings: Settings, root: str = "/") -> Iterator[Check]:
    """Check the machine for these settings: loop.cpu, loop.spin_s and the serial ports."""
    base, cpu = Path(root), settings.loop.cpu
    yield _preemption(base)
    if cpu < 0:
        yield Check(
            "own processor",
            False,
            "loop.cpu is -1: the loop runs where the scheduler puts it",
            "isolate one and name it in loop.cpu",
        )
    else:
        for name, file, what in (
            ("isolated processor", "isolated", "isolcpus=managed_irq,domain,{0}"),
            ("no tick on it", "nohz_full", "nohz_full={0} rcu_nocbs={0}"),
        ):
            text = _text(base / "sys/devices/system/cpu" / file)
            yield Check(
                name,
                cpu in cpu_list(text),
                f"{file}: {text or 'none'}",
                f"add {what.format(cpu)} to the kernel's command line (GRUB_CMDLINE_LINUX), update-grub, reboot",
            )
        yield _interrupts(base, cpu)
    yield _throttling(base, settings.loop.spin_s / settings.loop.period_s)
    yield _dma_latency(base)
    yield _governor(base, cpu)
    yield from _latency_timers(settings, str(base / "sys"))


def cpu_list(text: str) -> set[int]:
    """Return the numbers of a kernel list such as '0-2,5'; empty for '' and '(null)'."""
    numbers: set[int] = set()
    for low, high in re.findall(r"(\d+)(?:-(\d+))?", text):
        numbers.update(range(int(low), int(high or low) + 1))
    return numbers


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _preemption(base: Path) -> Check:
    if _text(base / "sys/kernel/realtime") == "1":
        return Check("PREEMPT_RT", True, "the kernel is PREEMPT_RT", "")
    model = re.search(r"\bPREEMPT\w*", _text(base / "proc/version"))
    return Check(
        "PREEMPT_RT",
        False,
        f"the kernel is {model[0] if model else 'not preemptible'}",
        "apt-get install linux-image-rt-amd64 and boot it: tails of milliseconds become tens of microseconds",
    )


def _interrupts(base: Path, cpu: int) -> Check:
    mine = []
    for irq in sorted((base / "proc/irq").glob("[0-9]*"), key=lambda p: int(p.name)):
        allowed = _text(irq / "effective_affinity_list") or _text(irq / "smp_affinity_list")
        # A directory names its handler.
        if cpu in cpu_list(allowed) and any(p.is_dir() for p in irq.iterdir()):
            mine.append(irq.name)
    shown = ", ".join(mine[:8]) + (", .." if len(mine) > 8 else "")
    return Check(
        "interrupts elsewhere",
        not mine,
        f"interrupts on processor {cpu}: {shown or 'none'}",
        f"write the other processors to /proc/irq/N/smp_affinity_list (irqbalance: IRQBALANCE_BANNED_CPULIST={cpu})",
    )


def _throttling(base: Path, burnt: float) -> Check:
    runtime, period = (
        _text(base / "proc/sys/kernel/sched_rt_runtime_us"),
        _text(base / "proc/sys/kernel/sched_rt_period_us"),
    )
    if not runtime or not period:
        return Check("real-time throttling", True, "not there", "")
    share = 1.0 if int(runtime) < 0 else int(runtime) / int(period)
    running = (
        "off"
        if int(runtime) < 0
        else f"real-time tasks may take {100 * share:.0f} %, loop.spin_s burns {100 * burnt:.0f} %"
    )
    return Check(
        "real-time throttling",
        burnt < share - 0.3 or int(runtime) < 0,
        running,
        "sysctl -w kernel.sched_rt_runtime_us=-1 (in /etc/sysctl.d/ to keep it), or spin less (loop.spin_s)",
    )


def _dma_latency(base: Path) -> Check:
    device = base / "dev/cpu_dma_latency"
    if not device.exists():
        return Check("cpu_dma_latency", True, "this machine has none", "")
    allowed = os.access(device, os.W_OK)
    return Check(
        "cpu_dma_latency",
        allowed,
        "writable: deep idle states are refused while the loop runs"
        if allowed
        else "not writable for this user",
        "thermoctl service install (its udev rule gives the group thermoctl access)",
    )


def _governor(base: Path, cpu: int) -> Check:
    governor = _text(base / f"sys/devices/system/cpu/cpu{max(cpu, 0)}/cpufreq/scaling_governor")
    return Check(
        "frequency governor",
        governor in ("", "performance"),
        governor or "the clock does not scale here",
        "cpupower frequency-set -g performance (or echo performance into scaling_governor at boot)",
    )


def _latency_timers(settings: Settings, sys_root: str) -> Iterator[Check]:
    if settings.hal.backend != "devices":
        return
    for device in fast_devices(settings):
        port = re.sub(r"^(slcan|rtu):|@\d+$", "", device.binding.port)
        wanted, present = device.binding.profile.line.latency_timer_ms, latency_timer_ms(port, sys_root)
        if present is not None:
            yield Check(
                f"latency_timer of {device.name}",
                present <= max(wanted, 1),
                f"{present} ms",
                f"echo 1 > {sys_root}/bus/usb-serial/devices/{os.path.basename(os.path.realpath(port))}/latency_timer "
                "(the udev rule of `thermoctl service install` does it at every plug)",
            )
