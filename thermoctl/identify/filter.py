"""A steady Kalman filter that estimates the temperatures of all points from the coil.

    x(n+1) = A x + B [power, d(air)/dt] + w, y = C x + v, rises above the air

The air's rate is a known input with a known effect. When only the air warms by 1 K, every rise falls by 1 K,
so C b_air = -1. The process noise w has four parts:

- an error of the coil's heat (b b')
- a drift of all points against the air (b_air b_air')
- outside heat into one body (C+ C+')
- a slowly decaying outside heat as a disturbance state

Their variances come from the calibration, where all points are measured. The chosen ones give the best
estimate of all points from the coil alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize

from thermoctl.files.yamlfile import InputError
from thermoctl.identify import kernels
from thermoctl.identify.statespace import StateSpace, _c

DECAY_S = 3600.0  # time constant of an outside heat
SMOOTH = 30  # samples over which the filter's error is averaged


def sensor_variance(step_k: float, noise_k: float) -> float:
    """R_v, K^2: quantisation step^2/12 and the sensor's own noise."""
    return step_k**2 / 12 + noise_k**2


def with_air(model: StateSpace) -> StateSpace:
    """Return the model with d(air)/dt (K/s) as second input.

    Over one period every rise falls by the air's rise, C b = -1 K."""
    b = -np.linalg.pinv(model.c, rcond=1e-3) @ np.ones(len(model.c)) * model.period_s
    return replace(model, b=np.column_stack([model.b[:, 0], b]))


@dataclass(frozen=True)
class Kalman:
    """Steady Kalman filter: gain (n, s) for `sensors`, error covariance p (n, n) K^2.

    The inputs of `model` are power W and d(air)/dt K/s."""

    model: StateSpace
    gain: np.ndarray
    sensors: tuple[int, ...]
    p: np.ndarray
    noise: np.ndarray

    def run(
        self, power_w: np.ndarray, air_rate: np.ndarray, measured_k: np.ndarray, x0: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the estimated rises (N, M) from measured ones (N, s) or (N,), NaN for no reading."""
        measured = np.atleast_2d(measured_k.T).T
        x0 = np.zeros(self.model.order) if x0 is None else x0
        x = kernels.steady_filter(
            _c(self.model.a),
            _c(self.model.b),
            _c(self.model.c[list(self.sensors)]),
            _c(self.gain),
            _c(x0),
            _c(np.column_stack([power_w, air_rate])),
            _c(measured),
        )
        return x @ self.model.c.T


def disturbed(model: StateSpace) -> StateSpace:
    """Return the model with one disturbance state: heat from outside into every body, the same K/s in each.

    It decays with the time constant DECAY_S."""
    n, m = model.b.shape
    into = np.linalg.pinv(model.c, rcond=1e-3) @ np.ones(len(model.c)) * model.period_s
    a = np.zeros((n + 1, n + 1))
    a[:n, :n], a[:n, n], a[n, n] = model.a, into, np.exp(-model.period_s / DECAY_S)
    return replace(
        model,
        a=a,
        b=np.vstack([model.b, np.zeros((1, m))]),
        c=np.column_stack([model.c, np.zeros(len(model.c))]),
        x0=np.append(model.x0, 0.0),
    )


def process_noise(model: StateSpace, variances: np.ndarray) -> np.ndarray:
    """Return Q (n, n) per period from the variances of its four sources.

    power error W^2, drift (K/s)^2, outside heat K^2 of each body, disturbance state (K/s)^2."""
    n = model.order
    disturbance = int(not model.c[:, -1].any())
    k = n - disturbance
    q = np.zeros((n, n))
    b = model.b[:k]
    inverse = np.linalg.pinv(model.c[:, :k], rcond=1e-2)
    q[:k, :k] = (
        variances[0] * np.outer(b[:, 0], b[:, 0])
        + variances[1] * np.outer(b[:, 1], b[:, 1])
        + variances[2] * inverse @ inverse.T
    )
    if disturbance:
        q[k, k] = variances[3]
    return q


def steady(model: StateSpace, variances: np.ndarray, r_v: float, sensors: tuple[int, ...] = (0,)) -> Kalman:
    """Steady Kalman filter by the Riccati equation. Raises InputError when it has no solution."""
    q = process_noise(model, variances)
    cs = model.c[list(sensors)]
    r = r_v * np.eye(len(sensors))
    try:
        p = linalg.solve_discrete_are(model.a.T, cs.T, q + 1e-14 * np.trace(q) * np.eye(len(q)), r)
    except (linalg.LinAlgError, ValueError):
        raise InputError("the filter's Riccati equation has no solution: lower the model's order") from None
    gain = p @ cs.T @ np.linalg.inv(cs @ p @ cs.T + r)
    return Kalman(model, gain, tuple(sensors), p - gain @ cs @ p, q)


@dataclass(frozen=True)
class Record:
    """One calibration recording at the filter's period.

    power (N,) W, air_rate (N,) K/s, rises (N, M) K (NaN: no reading)."""

    power_w: np.ndarray
    air_rate: np.ndarray
    rises: np.ndarray


def tune(model: StateSpace, records: list[Record], r_v: float) -> tuple[Kalman, np.ndarray]:
    """Return the filter that estimates all points best from the coil over the calibration, and its variances.

    The error is averaged over SMOOTH samples, so that the noise of the other thermometers has little weight.
    A weak prior on the logarithms keeps a variance that the data do not determine."""
    base = np.array([np.log(1e-2), np.log(1e-10), np.log(1e-6), np.log(1e-13)])
    used = 4 if not model.c[:, -1].any() else 3

    def cost(x: np.ndarray) -> float:
        """Return the weighted mean square error, K^2, times the prior's factor; 1e9 without a steady filter.

        `x`: logarithms of the first variances; those it lacks keep their values in `base`."""
        try:
            f = steady(model, np.exp(np.append(x, base[len(x) :])), r_v)
        except InputError:
            return 1e9
        total, count = 0.0, 0
        for rec in records:
            e = f.run(rec.power_w, rec.air_rate, rec.rises[:, 0]) - rec.rises
            e = np.nan_to_num(e[: len(e) // SMOOTH * SMOOTH]).reshape(-1, SMOOTH, e.shape[1]).mean(1)
            total, count = total + float((e**2).sum()), count + e.size
        value = total / count
        return (value if np.isfinite(value) else 1e9) * (1 + 1e-4 * float(((x - base[: len(x)]) ** 2).sum()))

    start = base[:used]
    best = optimize.minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={
            "maxfev": 140,
            "xatol": 0.1,
            "fatol": 1e-7,
            "initial_simplex": np.vstack([start, start + 3 * np.eye(used)]),
        },
    )
    variances = np.exp(np.append(best.x, base[used:]))
    return steady(model, variances, r_v), variances
