"""`make bench-realtime`: the loop beside cyclictest, a paired C reference, a C twin and a straightforward loop.

Each round runs, one after the other on the same processor with the same priority, locked memory and latency request:

    cyclictest   rt-tests' wake-up latency
    daemon       the whole daemon (loop, recorder, command socket) on two ptys: encoder frames, CiA-402 over Lawicel CAN; and
                 as long again with a C reference loop one priority higher and with the same deadlines (paired, per tick)
    twin         the same loop in C, in the same two halves
    plain        pyserial + python-can + numpy, for comparison (without stress)

idle and under stress: stress-ng on all processors and a disk, and a client that asks the daemon's status 100 times a second.
Times of a shared machine say little; ratios and differences within a round do. Needs root (or SCHED_FIFO and locked
memory), two processors, a C compiler, and Debian's packages rt-tests and stress-ng.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import dataclasses
import gc
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[3]
HERE = Path(__file__).resolve().parent
PERIOD_NS = 1_000_000
PRIORITY, PEER_PRIORITY = 80, 85
FAR_US = 200.0  # the bar of the paired difference's p99.9
CONFIG = """
rig: {{name: wire}}
loop: {{period_s: 1 ms, cpu: {cpu}, priority: {priority}}}
control: {{kp: 0.004, ti_s: 0.0108, td_s: 0, output_limit: 1.5, moving_average: 2}}
compensation: {{enable: true, model: {root}/config/models/wire.yaml, bound_um: 40, slew_um_s: 1}}
protection:
  required: [position_um, amplifier_state]
  low:  {{position_um: -400}}
  high: {{position_um: 400}}
  rate: {{position_um: 50000}}
  stale_s: {{position_um: 0.5}}
  coil_limit_c: 80
recording: {{directory: {work}/recordings, budget_gb: 1, tier_budget_gb: 0.1}}
hal:
  backend: devices
  devices:
    - name: encoder
      profile: {root}/config/devices/encoder-serial.yaml
      port: {work}/encoder
      roles: {{position: position_um}}
    - name: drive
      profile: {root}/config/devices/drive-cia402.yaml
      port: slcan:{work}/can@1000000
      roles: {{state: amplifier_state, fault: amplifier_fault, supply: supply_v}}
socket: {{path: {work}/rig.sock}}
"""


class Bench:
    """The built programs, the configuration, and the peer at the other end of the wires."""

    def __init__(self, work: Path, cpu: int):
        self.work, self.cpu, self.other = work, cpu, 0 if cpu else 1
        self.config = work / "bench.yaml"
        self.config.write_text(CONFIG.format(cpu=cpu, priority=PRIORITY, root=ROOT, work=work))
        for name, sources, libraries in (
            ("reference", ["reference.c"], []),
            ("peer", ["peer.c"], ["-lutil", "-lm"]),
            ("twin", ["twin.c", "law.c"], ["-lm"]),
        ):
            self._cc([*sources], work / name, *libraries)
        self._cc(["law.c"], work / "law.so", "-shared", "-fPIC", "-lm")
        self.peer: subprocess.Popen | None = None

    def _cc(self, sources: list[str], out: Path, *more: str) -> None:
        subprocess.run(
            [
                "cc",
                "-O2",
                "-Wall",
                "-Wextra",
                "-ffp-contract=off",
                "-D_GNU_SOURCE",
                "-o",
                str(out),
                *(str(HERE / s) for s in sources),
                *more,
            ],
            check=True,
        )

    def start_peer(self) -> None:
        self.peer = subprocess.Popen(
            [
                self.work / "peer",
                str(self.other),
                str(PEER_PRIORITY),
                self.work / "encoder",
                self.work / "can",
                "400000",
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.peer.stdout and self.peer.stdout.readline().strip() == "ready"

    def stop_peer(self) -> None:
        if self.peer is not None:
            self.peer.terminate()
            self.peer.wait(10)
            self.peer = None

    def reference(self, first_ns: int, seconds: float) -> tuple[subprocess.Popen, Path]:
        """The paired reference, started with the phase of `first_ns`; and where its rows come to be."""
        out = self.work / "reference.bin"
        return subprocess.Popen(
            [
                self.work / "reference",
                str(self.cpu),
                str(PRIORITY + 1),
                str(first_ns),
                str(PERIOD_NS),
                str(round(seconds * 1e9 / PERIOD_NS)),
                out,
            ]
        ), out


def rows_of(path: Path, columns: int) -> np.ndarray:
    return np.fromfile(path, np.int64).reshape(-1, columns)


def paired(rows: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """us by which each wake-up of `rows` (deadline, wake, end) came after the reference's at the same deadline; how late the reference
    was itself; and how long before the deadline the tick before had ended."""
    key = np.round((reference[:, 0] - rows[0, 0]) / PERIOD_NS).astype(np.int64)
    own = np.round((rows[:, 0] - rows[0, 0]) / PERIOD_NS).astype(np.int64)
    _, a, b = np.intersect1d(own, key, return_indices=True)
    return (
        (rows[a, 1] - reference[b, 1]) * 1e-3,
        (reference[b, 1] - reference[b, 0]) * 1e-3,
        (rows[a, 0] - rows[np.maximum(a - 1, 0), 2]) * 1e-3,
    )


def run_cyclictest(bench: Bench, seconds: float) -> np.ndarray:
    """Its wake-up latencies, us (from a histogram of nanoseconds)."""
    out = bench.work / "cyclictest.txt"
    subprocess.run(
        (
            f"cyclictest -p {PRIORITY} -a {bench.cpu} -t 1 -m -i {PERIOD_NS // 1000} -D "
            f"{max(1, round(seconds))} -q -N -h 1000000 --histfile={out}"
        ).split(),
        check=True,
        stdout=subprocess.DEVNULL,
    )
    values: list[float] = []
    for line in out.read_text().splitlines():
        if line.startswith("# Max Latencies"):
            values.append(float(line.split()[-1]) * 1e-3)
        elif not line.startswith("#") and line.strip():
            at, count = line.split()
            if int(count):
                values += [int(at) * 1e-3] * int(count)
    return np.array(values)


def run_twin(bench: Bench, seconds: float) -> dict[str, Any]:
    out = bench.work / "twin.bin"
    twin = subprocess.Popen(
        [
            bench.work / "twin",
            str(bench.cpu),
            str(PRIORITY),
            str(PERIOD_NS),
            str(round(2 * seconds * 1e9 / PERIOD_NS)),
            bench.work / "law.bin",
            bench.work / "encoder",
            bench.work / "can",
            out,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert twin.stdout
    reference, reference_out = bench.reference(
        int(twin.stdout.readline()) + round(seconds * 1e9), seconds - 0.5
    )
    _, errors = twin.communicate(timeout=2 * seconds + 30)
    reference.wait(20)
    if twin.returncode:
        raise SystemExit(f"the C twin failed: {errors}")
    rows = rows_of(out, 3)[100:]
    return figures(rows, rows_of(reference_out, 2))


def figures(rows: np.ndarray, reference: np.ndarray) -> dict[str, Any]:
    """Of rows deadline, wake, end: wake (lateness, us) and tick (wake-up to end of all work, us) until the reference came
    beside it, paired from then on; ticks and slips of both. far: ticks paired more than FAR_US apart; those of them in which the
    reference was late, too; and in which the tick before had ended in time."""
    span = round((rows[-1, 0] - rows[0, 0]) / PERIOD_NS) + 1
    alone = rows[rows[:, 0] < reference[0, 0]] if len(reference) else rows
    late, of_reference, free = paired(rows, reference) if len(reference) else (np.array([]),) * 3
    far = late > FAR_US
    return {
        "wake": (alone[:, 1] - alone[:, 0]) * 1e-3,
        "tick": (alone[:, 2] - alone[:, 1]) * 1e-3,
        "paired": late,
        "far": np.array([far.sum(), (far & (of_reference > FAR_US / 2)).sum(), (far & (free > 0)).sum()]),
        "ticks": len(rows),
        "slips": span - len(rows),
    }


def run_plain(bench: Bench, seconds: float) -> dict[str, Any]:
    out = bench.work / "plain.bin"
    subprocess.run(
        [
            sys.executable,
            HERE / "plain_loop.py",
            str(bench.cpu),
            str(PRIORITY),
            str(round(seconds * 1e9 / PERIOD_NS / 2)),
            bench.work / "encoder",
            bench.work / "can",
            out,
        ],
        check=True,
    )
    rows = rows_of(out, 3)[100:]
    return figures(rows, rows[:0, :2])


def run_daemon(bench: Bench, seconds: float, ask_hz: float) -> dict[str, Any]:
    """The daemon for `seconds` after it is ready; rows from its own ring, ends of ticks from the probe."""
    from thermoctl.configuration.settings import load_settings
    from thermoctl.daemon.control_socket import ask
    from thermoctl.daemon.tick.assemble import shared_name
    from thermoctl.daemon.tick.shared import START_S, Shared
    from thermoctl.files.yamlfile import InputError
    from thermoctl.rig.signals import INDEX

    settings = load_settings(bench.config)
    stamps_path = bench.work / "stamps.bin"
    log = open(bench.work / "daemon.log", "w")  # noqa: SIM115 - the daemon writes to it as long as it lives
    daemon = subprocess.Popen(
        [
            sys.executable,
            HERE / "daemon.py",
            bench.config,
            stamps_path,
            str(round((2 * seconds + 60) * 1e9 / PERIOD_NS)),
        ],
        stderr=log,
    )
    try:
        deadline = time.monotonic() + 120
        while True:
            with contextlib.suppress(InputError):
                if ask(settings.socket.path, {"command": "status"}).get("ticks", 0) > 500:
                    break
            if time.monotonic() > deadline or daemon.poll() is not None:
                raise SystemExit("the daemon did not start:\n" + (bench.work / "daemon.log").read_text())
            time.sleep(0.05)
        shared = Shared.attach(shared_name(settings))
        head, parts = shared.ring.head, []
        newest = shared.ring.newest()
        start_s = float(shared.counters[START_S])
        first = (start_s + newest[INDEX["t_s"]]) * 1e9 - newest[INDEX["lateness_us"]] * 1e3
        reference, reference_out = bench.reference(round(first) + round(seconds * 1e9), seconds)
        before, ended, asked = processes(daemon.pid), threading.Event(), [0]

        def client() -> None:
            while not ended.wait(1.0 / ask_hz):
                with contextlib.suppress(InputError):
                    asked[0] += bool(ask(settings.socket.path, {"command": "status"})["ok"])

        thread = threading.Thread(target=client)
        if ask_hz:
            thread.start()
        end, lost = time.monotonic() + 2 * seconds, 0
        while time.monotonic() < end:
            time.sleep(0.2)
            rows, head, missed = shared.ring.read(head)
            lost += missed
            parts.append(rows)
        ended.set()
        if ask_hz:
            thread.join()
        reference.wait(30)
        after = processes(daemon.pid)
    finally:
        daemon.send_signal(signal.SIGTERM)
        daemon.wait(60)
        log.close()
    rows = np.concatenate(parts)
    wake = np.round((start_s + rows[:, INDEX["t_s"]]) * 1e9).astype(np.int64)
    due = np.round(wake - rows[:, INDEX["lateness_us"]] * 1e3).astype(np.int64)
    stamps = np.fromfile(stamps_path, np.int64)
    stamps = stamps[stamps > 0]
    end_of = stamps[np.minimum(np.searchsorted(stamps, wake, side="right"), len(stamps) - 1)]
    result = figures(np.column_stack([due, wake, end_of]), rows_of(reference_out, 2))
    result["slips"] = int(rows[-1, INDEX["slips"]] - rows[0, INDEX["slips"]])
    return result | {
        "lost": lost,
        "asked": asked[0],
        "before": before,
        "after": after,
        "fresh": float((rows[:, INDEX["fresh_bits"]].astype(np.int64) & 1).mean()),
    }


def processes(pid: int) -> dict[str, int]:
    """Resident kB and open descriptors of a process and its children, summed."""
    found = {"rss_kb": 0, "fds": 0}
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    for p in [pid, *children]:
        with contextlib.suppress(OSError):
            status = Path(f"/proc/{p}/status").read_text()
            found["rss_kb"] += int(status.split("VmRSS:")[1].split()[0])
            found["fds"] += len(os.listdir(f"/proc/{p}/fd"))
    return found


# ---- the law --------------------------------------------------------------------------------------------------------


def law_numbers(model: Any, parameters: Any, period_s: float) -> np.ndarray:
    """Model and parameters in the order that law_load of law.c takes them."""
    from thermoctl.control import faults
    from thermoctl.control.law import MAX_AVERAGE
    from thermoctl.rig.channels import COIL

    trip_others = faults.mask("fault", "critical", readings=False)
    first = model.A_minus_I[0].copy()
    first[0] += 1.0
    along = float(model.C[0] @ model.gain[:, 0])
    p = parameters
    parts = [
        model.A_minus_I.shape[0],
        len(model.sensors),
        model.kind == "mkf",
        model.sensors,
        [bit for c in range(len(p.low)) for bit in faults.READING_BIT[min(c, COIL + 1) * 5 :][:5]],
        model.C.any(axis=1),
        model.b1.any() or model.b2.any() or model.b_air != 0.0,
        model.A_minus_I,
        model.B,
        model.C,
        model.gain,
        model.b1,
        model.b2,
        model.b_air,
        model.f1,
        model.offset_um,
        model.expansion_period_s,
        model.R_w,
        model.R_v,
        model.air_filter_s,
        model.period_s,
        period_s,
        float(first @ first),
        1.0 / along if abs(along) > 1e-9 else 0.0,
        0.5 * model.period_s / max(float(np.abs(model.A_minus_I).sum(axis=1).max()), 1e-12),
        p.kp,
        p.ti_s,
        p.td_s,
        p.output_limit,
        p.setpoint_rate_um_s,
        p.setpoint_low_um,
        p.setpoint_high_um,
        int(min(max(p.moving_average, 1), MAX_AVERAGE)),
        p.compensate,
        p.position_mode,
        p.bound_um,
        p.slew_um_s,
        p.low,
        p.high,
        p.rate,
        p.stale_s,
        p.frozen_s,
        p.required,
        p.following_um,
        p.following_s,
        p.coil_limit_c,
        p.coil_rate_k_s,
        p.coil_rate_time_s,
        p.innovation_limit_c,
        p.innovation_time_s,
        p.power_limit_w,
        p.power_time_s,
        p.idle_current_a,
        p.idle_power_w,
        p.idle_s,
        p.saturation_s,
        p.amplifier_s,
        p.late_s,
        p.agree_time_s,
        p.drift_limit_c,
        p.monitored_limit_c,
        p.resistance_current_a,
        p.resistance_ohm,
        p.resistance_tolerance,
        p.resistance_v,
        p.current_per_drive,
        p.current_tolerance_a,
        p.flexure_um_per_a,
        p.position_tolerance_um,
        p.reference_tolerance_um,
        p.order_limit_c,
        trip_others,
        faults.mask("critical"),
    ]
    return np.concatenate([np.atleast_1d(np.asarray(x, dtype=float)).ravel() for x in parts])


def readings(ticks: int, seed: int = 7) -> dict[str, np.ndarray]:
    """Readings of a warm day in the paper's motion, with the encoder's missing frames and now and then a bad reading."""
    from thermoctl.rig.channels import AMP_DISABLED, AMP_ENABLED, CHANNELS

    rng = np.random.default_rng(seed)
    n = len(CHANNELS)
    t = np.arange(ticks) * 1e-3
    values = np.full((ticks, n), 22.0)
    values[:, 0] = np.round(20 * np.sin(t) / 0.005) * 0.005
    values[:, 2], values[:, 3] = 6.0, 0.5
    values[:, 8:] += np.outer(2 * (1 - np.exp(-t / 20)), np.linspace(1, 0.1, 12)) + rng.normal(
        0, 0.02, (ticks, 12)
    )
    values[:, [2, 3, 7]] += rng.normal(0, 1e-3, (ticks, 3))
    values[:, 4], values[:, 5], values[:, 6] = 24.0, AMP_ENABLED, 0.0
    disabled = ((np.arange(ticks) - 140) % 1000 < 70) | (np.arange(ticks) < 210)  # around each DISARM and ARM
    values[disabled, 5] = AMP_DISABLED
    fresh = np.zeros((ticks, n), np.uint8)
    fresh[:, [0, 4, 5, 6]] = rng.random((ticks, 1)) > 0.02
    fresh[::50, 2:4] = 1
    fresh[::100, 7:] = 1
    fresh[0] = 1
    status = np.zeros((ticks, n), np.uint8)
    status[:, 1] = 3
    for _ in range(max(1, ticks // 5000)):
        at, channel = int(rng.integers(500, ticks)), int(rng.choice([0, 2, 8, 12]))
        status[at : at + 30, channel] = rng.integers(1, 3)
    commands = np.zeros(ticks, np.intc)
    commands[200::1000], commands[150::1000] = 1, 2
    commands[400::1000] = 3
    return {
        "values": values,
        "fresh": fresh,
        "status": status,
        "dt": np.full(ticks, 1e-3) + rng.exponential(2e-5, ticks),
        "commands": commands,
        "command_values": rng.uniform(-30, 30, ticks),
    }


def bench_law(bench: Bench, ticks: int = 20000, repeats: int = 15) -> dict[str, float]:
    """Equal bits first; then the batch beside plain C, interleaved; then calls as the tick makes them."""
    import Cython.Build
    import setuptools

    from thermoctl.configuration.settings import load_settings
    from thermoctl.control.law import COMPILED, Law
    from thermoctl.daemon.tick.assemble import compensator, law_parameters
    from thermoctl.rig.signals import OUTPUTS

    if not COMPILED:
        raise SystemExit("the law is not compiled: make install")
    folder = ROOT / "build/bench-realtime"  # kept: built again only when the law's types have changed
    folder.mkdir(parents=True, exist_ok=True)
    if (
        not (folder / "batch.pyx").exists()
        or (folder / "batch.pyx").read_text() != (HERE / "batch.pyx").read_text()
    ):
        shutil.copy(HERE / "batch.pyx", folder / "batch.pyx")
    here = os.getcwd()
    os.chdir(folder)
    try:
        extension = setuptools.Extension(
            "batch", ["batch.pyx"], extra_compile_args=["-O2", "-ffp-contract=off"]
        )
        setuptools.setup(
            name="batch",
            script_args=["-q", "build_ext", "--inplace"],
            ext_modules=Cython.Build.cythonize([extension], quiet=True, include_path=[str(ROOT)]),
        )
    finally:
        os.chdir(here)
    sys.path.insert(0, str(folder))
    import batch

    settings = load_settings(ROOT / "config/wire.yaml")
    model, parameters = compensator(settings), law_parameters(settings)
    # The prepared readings are of no one rig: what compares them with each other is computed, but trips nothing.
    parameters = dataclasses.replace(
        parameters,
        **dict.fromkeys(
            (
                "position_tolerance_um",
                "current_tolerance_a",
                "resistance_v",
                "drift_limit_c",
                "innovation_limit_c",
                "monitored_limit_c",
                "order_limit_c",
                "following_um",
                "saturation_s",
                "power_limit_w",
                "coil_rate_k_s",
                "idle_current_a",
                "idle_power_w",
                "bound_um",
                "late_s",
            ),
            np.inf,
        ),
    )
    law_numbers(model, parameters, settings.loop.period_s).tofile(bench.work / "law.bin")
    data = readings(ticks)
    n = data["values"].shape[1]
    value, now, state = np.full(n, np.nan), np.zeros(n, np.uint8), np.full(n, 3, np.uint8)
    library = ctypes.CDLL(str(bench.work / "law.so"))
    names = ("values", "fresh", "status", "dt", "commands", "command_values")
    arrays = [np.ascontiguousarray(data[k]) for k in names]
    c_out, out = np.zeros((2, ticks, len(OUTPUTS) + len(model.C)))

    def in_c() -> float:
        assert library.batch_load(str(bench.work / "law.bin").encode()) == 0
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (*arrays, c_out)]
        begin = time.thread_time()  # the processor's time, not the machine's: others run beside us
        library.batch_run(ctypes.c_long(ticks), *pointers)
        return time.thread_time() - begin

    def ours() -> float:
        law = Law(model, parameters, settings.loop.period_s)
        law.bind(value, now, state)
        begin = time.thread_time()
        batch.run(law, *arrays, out, value, now, state)
        return time.thread_time() - begin

    pairs = np.array([(in_c(), ours()) for _ in range(repeats)])
    if not np.array_equal(c_out, out, equal_nan=True):
        column = int(np.flatnonzero((c_out != out).any(axis=0))[0])
        tick = int(np.flatnonzero(c_out[:, column] != out[:, column])[0])
        raise SystemExit(
            f"law.c is not the law: {OUTPUTS[column]} of tick {tick} is {c_out[tick, column]!r}, "
            f"the law's {out[tick, column]!r}"
        )
    armed = float((out[:, 0] == 3).mean())
    if armed < 0.2:
        raise SystemExit(
            f"the prepared readings leave the law armed in {armed:.0%} of the ticks only: the batch shows too little"
        )
    law = Law(model, parameters, settings.loop.period_s)
    law.bind(value, now, state)
    calls = np.zeros(ticks)
    clock = time.perf_counter_ns
    gc.disable()
    for k in range(ticks):
        value[:], now[:], state[:] = arrays[0][k], arrays[1][k], arrays[2][k]
        begin = clock()
        law.estimate(1e-3)
        law.compensate()
        law.control(0, 0.0)
        law.protect(0, 0)
        calls[k] = clock() - begin
    gc.enable()
    return {
        "ratio": float(np.median(pairs[:, 1] / pairs[:, 0])),
        "c_ns": float(np.median(pairs[:, 0])) / ticks * 1e9,
        "ours_ns": float(np.median(pairs[:, 1])) / ticks * 1e9,
        "call_p50_us": float(np.median(calls)) * 1e-3,
        "call_p99_us": float(np.percentile(calls, 99)) * 1e-3,
        "armed": armed,
        "ticks": ticks,
    }


# ---- the whole ------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def stress(work: Path):
    """stress-ng on all processors, on memory and on the disk."""
    load = subprocess.Popen(
        (
            f"stress-ng --cpu 0 --vm 1 --vm-bytes 128M --hdd 1 --hdd-bytes 128M --temp-path {work} --quiet"
        ).split(),
        stdout=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        load.terminate()
        load.wait(20)


def machine() -> list[str]:
    """What was measured on."""
    model = next(
        (
            line.split(":")[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        platform.machine(),
    )
    virtual = "hypervisor" in Path("/proc/cpuinfo").read_text()
    runtime = Path("/proc/sys/kernel/sched_rt_runtime_us").read_text().strip()
    return [
        f"{os.cpu_count()} x {model}{', virtual machine' if virtual else ''}; Linux {platform.release()} "
        f"({platform.version()}); Python {platform.python_version()}",
        f"load average at the start {os.getloadavg()[0]:.1f}; sched_rt_runtime_us {runtime}; "
        f"cyclictest {version('cyclictest')}",
    ]


def version(program: str) -> str:
    done = subprocess.run(
        ["dpkg-query", "-W", "-f", "${Version}", "rt-tests"], capture_output=True, text=True, check=False
    )
    return done.stdout or program


def percentiles(values: np.ndarray) -> list[float]:
    return [float(np.percentile(values, q)) for q in (50, 99, 99.9)] + [float(values.max())]


def measure(bench: Bench, rounds: int, seconds: float, stressed: bool) -> Iterator[dict[str, list]]:
    """`rounds` of cyclictest, daemon, twin (their order turns), and plain where idle; what was found so far after each."""
    found: dict[str, list] = {"cyclictest": [], "daemon": [], "twin": [], "plain": []}
    runs = {
        "cyclictest": lambda: run_cyclictest(bench, seconds),
        "daemon": lambda: run_daemon(bench, seconds, 100.0 if stressed else 0.0),
        "twin": lambda: run_twin(bench, seconds),
    }
    names = list(runs)
    for k in range(rounds):
        for name in names[k % 3 :] + names[: k % 3]:
            found[name].append(runs[name]())
        if not stressed:
            found["plain"].append(run_plain(bench, seconds / 2))
        print(f"  round {k + 1} of {rounds}{' under stress' if stressed else ''} done", file=sys.stderr)
        yield found


def report(law: dict, conditions: dict[str, dict]) -> tuple[list[str], int]:
    """The tables as Markdown lines, and how many bars were missed."""
    lines = [
        "",
        "| wake-up latency, us | p50 | p99 | p99.9 | max | overruns in 1000 |",
        "|---|---|---|---|---|---|",
    ]
    bars: list[tuple[str, str, str, bool | None]] = []

    def pool(found: dict, who: str, what: str) -> np.ndarray:
        return np.concatenate([r[what] for r in found[who]])

    for name, found in conditions.items():
        rows = {
            "cyclictest": np.concatenate(found["cyclictest"]),
            "daemon": pool(found, "daemon", "wake"),
            "C twin": pool(found, "twin", "wake"),
        }
        if found["plain"]:
            rows["pyserial + python-can"] = pool(found, "plain", "wake")
        for who, values in rows.items():
            key = {"C twin": "twin", "pyserial + python-can": "plain"}.get(who, who)
            slips = "" if who == "cyclictest" else f"{overruns(found[key]):.2f}"
            lines.append(
                f"| {who}, {name} | " + " | ".join(f"{v:.1f}" for v in percentiles(values)) + f" | {slips} |"
            )
    lines += [
        "",
        "| paired: later than the C reference at the same deadline, us | p50 | p99 | p99.9 | max |",
        "|---|---|---|---|---|",
    ]
    for name, found in conditions.items():
        for who, key in (("daemon", "daemon"), ("a second C loop (the twin)", "twin")):
            lines.append(
                f"| {who}, {name} | "
                + " | ".join(f"{v:.1f}" for v in percentiles(pool(found, key, "paired")))
                + " |"
            )
    lines += [
        "",
        f"| more than {FAR_US:g} us later than the reference | ticks | of | the reference was late, too | the tick before had ended |",
        "|---|---|---|---|---|",
    ]
    for name, found in conditions.items():
        for who, key in (("daemon", "daemon"), ("the twin", "twin")):
            far, late, free = np.sum([r["far"] for r in found[key]], axis=0)
            lines.append(
                f"| {who}, {name} | {far} | {sum(len(r['paired']) for r in found[key])} | {late} | {free} |"
            )
    lines += [
        "",
        "| whole tick, wake-up to end of all work, us | p50 | p99 | p99.9 | max |",
        "|---|---|---|---|---|",
    ]
    for name, found in conditions.items():
        for who, key in (("daemon", "daemon"), ("C twin", "twin"), ("pyserial + python-can", "plain")):
            if found[key]:
                lines.append(
                    f"| {who}, {name} | "
                    + " | ".join(f"{v:.1f}" for v in percentiles(pool(found, key, "tick")))
                    + " |"
                )
    for name, found in conditions.items():
        p = percentiles(pool(found, "daemon", "paired"))
        bars += [
            (f"paired difference, p99, {name}", f"{p[1]:.1f} us", "<= 80 us", p[1] <= 80),
            (f"paired difference, p99.9, {name}", f"{p[2]:.1f} us", "<= 200 us", p[2] <= 200),
            (
                f"paired difference, p50, {name}",
                f"{p[0]:.1f} us",
                "aim <= 12 us",
                None if p[0] > 12 else True,
            ),
            (
                f"paired difference, p99, {name}",
                f"{p[1]:.1f} us",
                "aim <= 40 us",
                None if p[1] > 40 else True,
            ),
        ]
        ratio = np.median(
            [
                np.median(d["wake"]) / np.median(c)
                for d, c in zip(found["daemon"], found["cyclictest"], strict=True)
            ]
        )
        bars.append(
            (f"wake-up p50 over cyclictest, {name}", f"{ratio:.2f}", "<= 1.5, aim 1.1", bool(ratio <= 1.5))
        )
        for q, bar, text in ((50, 2.0, "<= 2, aim 1.3"), (99, 3.0, "<= 3")):
            each = [
                np.percentile(d["tick"], q) / np.percentile(t["tick"], q)
                for d, t in zip(found["daemon"], found["twin"], strict=True)
            ]
            bars.append(
                (
                    f"whole tick over the C twin, p{q}, {name}",
                    f"{np.median(each):.2f}",
                    text,
                    bool(np.median(each) <= bar),
                )
            )
        if found["plain"]:
            each = [
                np.median(p["tick"]) / np.median(t["tick"])
                for p, t in zip(found["plain"], found["twin"], strict=True)
            ]
            bars.append(
                (
                    f"(pyserial + python-can over the C twin, p50, {name})",
                    f"{np.median(each):.1f}",
                    "beside it",
                    None,
                )
            )
        own, limit = overruns(found["daemon"]), 1.5 * overruns(found["twin"]) + 2.0
        bars.append(
            (
                f"overruns in 1000 ticks, {name}",
                f"{own:.2f}",
                f"<= {limit:.2f} (1.5 x the twin's + 2)",
                own <= limit,
            )
        )
        lost = sum(d["lost"] for d in found["daemon"])
        bars.append((f"ticks lost by a reader at 5 Hz, {name}", f"{lost}", "0", lost == 0))
        if any(d["asked"] for d in found["daemon"]):
            rate = np.mean([d["asked"] for d in found["daemon"]])
            bars.append((f"status answers a round, {name}", f"{rate:.0f}", "asked 100 times a second", None))
    bars += [
        (
            "law, batch, over plain C with the same bits",
            f"{law['ratio']:.2f} ({law['ours_ns']:.0f} / {law['c_ns']:.0f} ns)",
            "<= 2",
            law["ratio"] <= 2.0,
        ),
        (
            "law, called from the tick, p50",
            f"{law['call_p50_us']:.2f} us (p99 {law['call_p99_us']:.2f})",
            "< 5 us",
            law["call_p50_us"] < 5.0,
        ),
    ]
    lines += ["", "| figure | measured | bar | met |", "|---|---|---|---|"]
    for name, measured, wanted, met in bars:
        said = (
            "-"
            if met is None and not wanted.startswith("aim")
            else "not reached"
            if met is None
            else "yes"
            if met
            else "**no**"
        )
        lines.append(f"| {name} | {measured} | {wanted} | {said} |")
    return lines, sum(met is False for *_, met in bars)


def overruns(runs: list[dict]) -> float:
    """Skipped ticks in 1000."""
    return 1000.0 * sum(r["slips"] for r in runs) / max(1, sum(r["ticks"] + r["slips"] for r in runs))


def main() -> int:
    """Run it all; 0, or 1 when a bar was missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each program in each round")
    parser.add_argument("--conditions", nargs="+", choices=("idle", "stress"), default=["idle", "stress"])
    parser.add_argument("--cpu", type=int, default=1)
    parser.add_argument("--out", type=Path, help="also write the tables here (Markdown)")
    parser.add_argument("--raw", type=Path, help="also write percentiles of every round here (JSON)")
    args = parser.parse_args()
    for program in ("cyclictest", "stress-ng", "cc"):
        if shutil.which(program) is None:
            raise SystemExit(f"{program}: not found; apt-get install rt-tests stress-ng gcc")
    head = machine()
    with tempfile.TemporaryDirectory(prefix="thermoctl-rt-") as folder:
        bench = Bench(Path(folder), args.cpu)
        law = bench_law(bench)
        conditions: dict[str, dict] = {}
        print(f"  law: batch {law['ratio']:.2f} x C, call {law['call_p50_us']:.2f} us", file=sys.stderr)
        try:
            bench.start_peer()
            for condition in args.conditions:
                with stress(bench.work) if condition == "stress" else contextlib.nullcontext():
                    for found in measure(bench, args.rounds, args.seconds, condition == "stress"):
                        conditions[condition] = found
                        if args.out:  # so that a run that is cut short leaves its rounds
                            args.out.write_text("\n".join([*head, *report(law, conditions)[0], ""]))
        finally:
            bench.stop_peer()
    lines, missed = report(law, conditions)
    head.append(
        f"{args.rounds} rounds of {args.seconds:g} s; the rest of the machine was "
        f"{'shared with other work' if os.getloadavg()[0] > 2.5 else 'quiet'} (load {os.getloadavg()[0]:.1f} at the end)"
    )
    text = "\n".join([*head, *lines, ""])
    print(text)
    if args.out:
        args.out.write_text(text)
    if args.raw:
        summary = {
            c: {
                who: [percentiles(r["wake"] if isinstance(r, dict) else r) for r in runs]
                for who, runs in found.items()
            }
            for c, found in conditions.items()
        }
        args.raw.write_text(json.dumps(summary, indent=1))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
