"""`make bench-points`: processor time of a whole tick (sample, law, record, ring) against points and axes, beside plain C.

The C is tests/bench/realtime/law.c, compiled for each number of points: the same law with the same bits (checked here), and its
row into a ring. It reads no devices, clocks or commands.

The back end gives prepared readings at once: a new position and drive state every tick, current and voltage every 50 and
temperatures every 100 ticks. Devices cost the same for any points and are left out. The least of many repeats counts, because
others run on the machine.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.bench.realtime.run import law_numbers
from thermoctl.control.law import COMPILED, Law
from thermoctl.control.model import CompensatorModel, Parameters
from thermoctl.daemon.tick.loop import Axis
from thermoctl.daemon.tick.ring import Ring
from thermoctl.rig.channels import AT, COIL, DEFAULT, Channels, Point, of_points
from thermoctl.rig.signals import OUTPUTS, of_channels
from thermoctl_hal.base.backend import ABSENT, OK, Sample

TICKS, REPEATS = 5000, 15
HERE = Path(__file__).parent
SEEDED = np.random.default_rng(3)


class Prepared:
    """A back end whose readings are always there."""

    def __init__(self, channels: Channels) -> None:
        self.sample, self.k = Sample(len(channels.names)), 0
        s = self.sample
        s.value[:], s.status[:], s.time_s[:] = 22.0, OK, 0.0
        s.value[AT["amplifier_state"]], s.value[AT["amplifier_fault"]] = 1.0, 0.0

    def read(self, now_s: float) -> Sample:
        """Mark what is new in this tick."""
        self.k += 1
        fresh = self.sample.fresh
        fresh[: AT["voltage_v"]] = fresh[AT["supply_v"] : AT["air_c"]] = True
        fresh[AT["voltage_v"] : AT["supply_v"]] = self.k % 50 == 0
        fresh[AT["air_c"] :] = self.k % 100 == 0
        return self.sample

    def write(self, drive: float, enable: bool) -> None:
        """Take the command."""

    def problem(self, role: str) -> str:
        """Nothing is wrong."""
        return ""


def model(points: int) -> CompensatorModel:
    """Return a model with a state for each point."""
    A = -np.diag(np.geomspace(1e-6, 1e-4, points))
    gain = SEEDED.normal(size=points) * 0.01
    b2 = np.full(points, 0.1)
    return CompensatorModel(
        "kalman", 1e-3, A, np.full((points, 2), 1e-5), np.eye(points), gain, 1e-4, 0.04, 0.9, 0 * b2, b2, 1.0
    )


def parameters_of(n: int) -> Parameters:
    """Return limits of n channels that no reading meets."""
    limits = {name: np.full(n, np.inf) for name in ("high", "rate", "stale_s", "frozen_s")}
    return Parameters(0.01, 0.01, 0.0, 1.0, low=np.full(n, -np.inf), required=np.zeros(n), **limits)


def channels_of(points: int) -> Channels:
    """Return the channels of so many points."""
    names = [Point("coil", role="coil"), *(Point(f"p{k}") for k in range(1, points))]
    return DEFAULT if points == len(DEFAULT.points) else of_points(names)


def microseconds(points: int, axes: int = 1) -> float:
    """Return the processor time of one tick of all axes, us: the least mean of REPEATS runs."""
    channels = channels_of(points)
    rigs = []
    for _ in range(axes):
        ring = Ring(np.zeros(1, np.uint64), np.zeros((8192, len(of_channels(channels)))))
        limits = parameters_of(COIL + points)
        rigs.append(Axis(Prepared(channels), model(points), limits, 1e-3, ring, channels=channels))
    for rig in rigs:
        rig.guards = [other for other in rigs if other is not rig]
    best = np.inf
    for repeat in range(REPEATS):
        begin = time.thread_time()
        for k in range(TICKS):
            for rig in rigs:
                rig.tick((repeat * TICKS + k) * 1e-3, 1e-3)
        best = min(best, (time.thread_time() - begin) / TICKS * 1e6)
    return best


class Twin:
    """law.c, compiled for so many points, with the law's numbers and the readings of TICKS ticks."""

    def __init__(self, points: int, folder: Path) -> None:
        self.points, library = points, folder / f"law{points}.so"
        flags = ["-O2", "-ffp-contract=off", "-D_GNU_SOURCE", f"-DPOINTS={points}", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, "-o", library, HERE / "realtime/law.c", "-lm"], check=True)
        self.library, self.numbers = ctypes.CDLL(str(library)), folder / f"law{points}.bin"
        self.model, self.parameters = model(points), parameters_of(COIL + points)
        prepared = Prepared(channels_of(points))
        rows = []
        for _ in range(TICKS):
            s = prepared.read(0.0)
            rows.append((s.value.copy(), s.fresh.astype(np.uint8), s.status.astype(np.uint8)))
        self.readings = [np.array(part) for part in zip(*rows, strict=True)]

    def run(self, axes: int = 1) -> tuple[float, np.ndarray]:
        """Return the processor time of one tick of all axes, us, and the first axis' last outputs."""
        law_numbers(self.model, self.parameters, 1e-3).tofile(self.numbers)
        assert self.library.axes_load(str(self.numbers).encode()) == 0
        out = np.zeros(len(OUTPUTS) + self.points)
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in self.readings]
        begin = time.thread_time()
        self.library.axes_run(
            ctypes.c_long(TICKS), axes, *pointers, ctypes.c_double(1e-3), out.ctypes.data_as(ctypes.c_void_p)
        )
        return (time.thread_time() - begin) / TICKS * 1e6, out

    def microseconds(self, axes: int = 1) -> float:
        """Return the least of REPEATS runs, us a tick."""
        return min(self.run(axes)[0] for _ in range(REPEATS))

    def check(self) -> None:
        """Exit where law.c and the law differ by a bit: as it is, in position mode, by the coil's resistance."""
        values, _, status = self.readings
        self._check("as it is")
        self.parameters = replace(self.parameters, position_mode=1.0)
        self._check("in position mode")
        self.parameters = replace(self.parameters, resistance_ohm=5.0)
        values[:, AT["voltage_v"]], values[:, AT["current_a"]], status[:, COIL] = 2.6, 0.5, ABSENT
        self._check("by the coil's resistance")
        self.parameters = parameters_of(COIL + self.points)
        values[:], status[:, COIL] = 22.0, OK
        values[:, AT["amplifier_state"]], values[:, AT["amplifier_fault"]] = 1.0, 0.0

    def _check(self, what: str) -> None:
        values, fresh, status = self.readings
        law = Law(self.model, self.parameters, 1e-3)
        value, now, state = values[0].copy(), fresh[0].copy(), status[0].copy()
        law.bind(value, now, state)
        for k in range(TICKS):
            value[:], now[:], state[:] = values[k], fresh[k], status[k]
            law.step(1e-3)
        if not np.array_equal(self.run()[1], np.asarray(law.outputs), equal_nan=True):
            raise SystemExit(f"law.c is not the law {what}: their outputs of {self.points} points differ")


def main() -> int:
    """Print the table."""
    if not COMPILED:
        print("the law is not compiled: make install")
        return 1
    with tempfile.TemporaryDirectory() as name:
        print("points   tick, us   beside the paper's twelve   law.c and its row, us   ratio")
        twins = {points: Twin(points, Path(name)) for points in (12, 4, 8, 16, 32, 64)}
        found = {points: microseconds(points) for points in twins}
        for points, us in sorted(found.items()):
            twins[points].check()
            c_us = twins[points].microseconds()
            print(f"{points:6d} {us:10.2f} {us / found[12]:27.2f} {c_us:23.2f} {us / c_us:7.2f}")
        print("\naxes of twelve points   tick of all, us   law.c and its rows, us   ratio")
        for axes in (1, 2, 4):
            us, c_us = microseconds(12, axes), twins[12].microseconds(axes)
            print(f"{axes:6d} {us:32.2f} {c_us:24.2f} {us / c_us:7.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
