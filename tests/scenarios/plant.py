"""A stage on a flexure behind a voice coil, its eddy damping, the copper, and four bodies that warm.

m x'' + c x' + k x = F i,  F/k = UM_PER_A, c/k = SLOW_S, m/c = FAST_S        exact over a step of 1 ms
R = R20 (1 + 0.00393 (T_coil - 20)),  C dT/dt = R i^2 + sum of G (T_other - T)
"""

from __future__ import annotations

import math
import random

STEP_S = 1e-3
UM_PER_A, SLOW_S, FAST_S = 307.7, 0.0108, 0.001
R20_OHM, ALPHA = 5.0, 0.00393
AIR_C = 22.0
BODIES = ("coil", "bobbin", "magnet", "stator")
_CAPACITY = (40.0, 120.0, 600.0, 2000.0)  # J/K
_CHAIN = (0.8, 1.2, 2.0)  # W/K, coil to bobbin to magnet to stator
_TO_AIR = (0.02, 0.05, 0.3, 2.0)


class Plant:
    """The stage. `jam`: it does not move whatever the current; `coil_open`: no current flows. `i_a`, `x_um`, `volts`."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.x_um = self.v_um = self.i_a = self.volts = 0.0
        self.t_c = [AIR_C] * len(BODIES)
        self.jam, self.tick = False, 0
        slow, fast = math.exp(-STEP_S / SLOW_S), math.exp(-STEP_S / FAST_S)
        self._slow, self._fast = slow, fast

    def mend(self) -> None:
        """The stage moves freely."""
        self.jam = False

    def step(self, target_a: float, supply_v: float, coil_open: bool) -> None:
        """One millisecond with the current that the output stage makes as long as its supply suffices."""
        resistance = R20_OHM * (1 + ALPHA * (self.t_c[0] - 20))
        limit = supply_v / resistance
        wanted = 0.0 if coil_open else max(-limit, min(limit, target_a))
        self.i_a += (wanted - self.i_a) * (1 - math.exp(-STEP_S / 0.5e-3))
        if coil_open:
            self.i_a = 0.0
        self.volts = math.copysign(supply_v, target_a) if coil_open and target_a else resistance * self.i_a
        if (
            not self.jam
        ):  # two first-order lags one after the other: the two real poles of mass, damping, flexure
            self.v_um += (UM_PER_A * self.i_a - self.v_um) * (1 - self._fast)
            self.x_um += (self.v_um - self.x_um) * (1 - self._slow)
        self.tick += 1
        if self.tick % 20 == 0:
            self._warm(20 * STEP_S, resistance)

    def _warm(self, dt_s: float, resistance: float) -> None:
        flow = [g * (AIR_C - t) for g, t in zip(_TO_AIR, self.t_c, strict=True)]
        flow[0] += resistance * self.i_a**2
        for k, g in enumerate(_CHAIN):
            between = g * (self.t_c[k + 1] - self.t_c[k])
            flow[k] += between
            flow[k + 1] -= between
        self.t_c = [t + dt_s * q / c for t, q, c in zip(self.t_c, flow, _CAPACITY, strict=True)]

    def noisy(self, value: float, sigma: float) -> float:
        """A reading with noise."""
        return value + self.random.gauss(0.0, sigma)
