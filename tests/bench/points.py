"""`make bench-points`: processor time of a whole tick (sample, law, record, ring) against the number of points and axes.

The back end gives prepared readings at once: a new position and drive state every tick, current and voltage every 50 and
temperatures every 100 ticks. Devices cost the same for any points and are left out. The least of many repeats counts, because
others run on the machine.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from hal.backend import OK, Sample
from thermoctl.channels import AT, COIL, DEFAULT, Channels, Point, of_points
from thermoctl.control.law import COMPILED
from thermoctl.control.model import CompensatorModel, Parameters
from thermoctl.daemon.loop import Rig
from thermoctl.daemon.ring import Ring
from thermoctl.signals import of_channels

TICKS, REPEATS = 5000, 15
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


def microseconds(points: int, axes: int = 1) -> float:
    """Return the processor time of one tick of all axes, us: the least mean of REPEATS runs."""
    names = [Point("coil", role="coil"), *(Point(f"p{k}") for k in range(1, points))]
    channels = DEFAULT if points == len(DEFAULT.points) else of_points(names)
    n = COIL + points
    limits = {name: np.full(n, np.inf) for name in ("high", "rate", "stale_s", "frozen_s")}
    parameters = Parameters(0.01, 0.01, 0.0, 1.0, low=np.full(n, -np.inf), required=np.zeros(n), **limits)
    rigs = []
    for _ in range(axes):
        ring = Ring(np.zeros(1, np.uint64), np.zeros((8192, len(of_channels(channels)))))
        rigs.append(Rig(Prepared(channels), model(points), parameters, 1e-3, ring, channels=channels))
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


def main() -> int:
    """Print the table."""
    if not COMPILED:
        print("the law is not compiled: make install")
        return 1
    print("points   tick, us   beside the paper's twelve")
    found = {points: microseconds(points) for points in (12, 4, 8, 16, 32, 64)}
    for points, us in sorted(found.items()):
        print(f"{points:6d} {us:10.2f} {us / found[12]:10.2f}")
    print("\naxes of twelve points   tick of all, us")
    for axes in (1, 2, 4):
        print(f"{axes:6d} {microseconds(12, axes):26.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
