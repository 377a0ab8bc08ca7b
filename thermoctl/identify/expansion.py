"""The expansion model: position error from temperatures, first order, M inputs, one output.

    yL(n+1) = f1 yL(n) + sum_m [b_m,1 T_m(n-1) + b_m,2 T_m(n)]                               (2), (3), (39)

Equation error (the paper's (5)) has the *measured* yL in the regressor. Noise on yL biases f1 towards 0: with
0.05 um of noise a time constant of 180 s was found as 3.2 s.

Output error: the regressor holds the model's own past output. For a given f1 the model is linear in b, with
inputs filtered by 1/(z - f1) and the decay f1^n of the first output. So one number f1 is searched, with a
least-squares solution for each.

Ridge: the gains g multiply the noise of the thermometers. Its variance is quantisation step^2/12 plus the
sensor's own, times (1 - f1)/(1 + f1) after the filter 1/(z - f1). Adding N sigma^2 g'g to the criterion
minimises the expected squared error *with such inputs*. The 25 nearly collinear parameters need that. The
time constant itself is not well determined, but the prediction is.

The output moves with the bodies' absolute temperatures, but the model has rises above the air. T_abs = rise +
air, so air enters with the sum of all gains: b_air = sum(b1 + b2). Two hours of test do not excite a free air
regressor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import linalg, optimize, signal

from thermoctl.files.yamlfile import InputError
from thermoctl.identify import kernels


@dataclass(frozen=True)
class Expansion:
    """f1, b1 (M,) for T(n-1), b2 (M,) for T(n), um per K; b_air for air - air(0), um/K.

    offset_um added to the output."""

    f1: float
    b1: np.ndarray
    b2: np.ndarray
    period_s: float
    b_air: float = 0.0
    offset_um: float = 0.0
    info: dict[str, Any] = field(default_factory=dict)

    def predict(self, rises: np.ndarray, air: np.ndarray | None = None, start_um: float = 0.0) -> np.ndarray:
        """Free run yL (N,) on rises (N, M) and air (N,) degC; `start_um` is yL(0) without the offset."""
        drive = np.zeros(len(rises))
        drive[1:] = rises[:-1] @ self.b2
        drive[2:] += rises[:-2] @ self.b1
        if self.b_air and air is not None:
            drive[1:] += self.b_air * (air[:-1] - air[0])
        drive[0] = start_um
        return signal.lfilter([1.0], [1.0, -self.f1], drive) + self.offset_um


def output_error(
    rises: np.ndarray | list[np.ndarray],
    y: np.ndarray | list[np.ndarray],
    period_s: float,
    input_sigma_k: float | np.ndarray = 0.0,
    air: np.ndarray | list[np.ndarray] | None = None,
    tau_range_s: tuple[float, float] | None = None,
    lags: int = 2,
    output_step_um: float = 0.0,
) -> Expansion:
    """Fit the expansion by output error: search over f1, ridge least squares for the gains.

    rises (N, M) K, y (N,) um (NaN: not measured), or lists of recordings, each with an offset and a start of
    its own. `air` (N,) degC ties b_air to the sum of the gains. `lags` 1 uses T(n) alone.
    `input_sigma_k`: error of the inputs that the model will be driven by (quantisation included), one for all
    or one each. `output_step_um`: the encoder's step; its variance is the least that a fit may leave.
    The returned offset and start are those of the last recording."""
    many = [rises] if isinstance(rises, np.ndarray) else rises
    ys = [y] if isinstance(y, np.ndarray) else y
    airs = [None] * len(many) if air is None else [air] if isinstance(air, np.ndarray) else air
    for r, v in zip(many, ys, strict=True):
        _check(r, v)
    m = many[0].shape[1]
    measured = np.concatenate(ys)
    here = np.isfinite(measured)
    if here.sum() < 4 * m:
        raise InputError(f"{int(here.sum())} measured positions for {m} temperatures; at least {4 * m}")
    drives = [r if a is None else r + (a - a[0])[:, None] for r, a in zip(many, airs, strict=True)]
    lo, hi = tau_range_s or (2 * period_s, max(len(r) for r in many) * period_s / 4)
    sigma2 = np.broadcast_to(np.asarray(input_sigma_k, float) ** 2, (m,))
    own = 2 * len(many)

    def solve(log_tau: float) -> tuple[float, np.ndarray, float]:
        """Return the cost, um^2, the coefficients and f1 at a time constant, given as ln(tau/s)."""
        f = float(np.exp(-period_s / np.exp(log_tau)))
        blocks = []
        for k, drive in enumerate(drives):
            z = np.zeros((len(drive), m * lags + own))
            now = signal.lfilter([0, 1 - f], [1, -f], drive, axis=0)
            z[:, m * (lags - 1) : m * lags] = now
            if lags == 2:
                z[1:, :m] = now[:-1]
            z[:, m * lags + 2 * k] = 1
            z[:, m * lags + 2 * k + 1] = f ** np.arange(len(drive))
            blocks.append(z)
        z = np.vstack(blocks)[here]
        g, right = z.T @ z, z.T @ measured[here]
        noise = np.concatenate(
            [np.tile(sigma2, lags) * (1 - f) / (1 + f) * here.sum(), np.full(own, 1e-9 * here.sum())]
        )
        noise[: m * lags] += 1e-6 * np.trace(g[: m * lags, : m * lags]) / (m * lags)
        theta = linalg.solve(g + np.diag(noise), right, assume_a="pos")
        cost = (
            float(((measured[here] - z @ theta) ** 2).sum() + theta @ (noise * theta))
            + here.sum() * output_step_um**2 / 12
        )
        return cost, theta, f

    grid = np.linspace(np.log(lo), np.log(hi), 13)
    costs = [solve(v)[0] for v in grid]
    k = int(np.argmin(costs))
    best = optimize.minimize_scalar(
        lambda v: solve(v)[0],
        bounds=(grid[max(k - 1, 0)], grid[min(k + 1, 12)]),
        method="bounded",
        options={"xatol": 1e-3},
    )
    cost, theta, f = solve(best.x)
    b2 = (1 - f) * theta[m * (lags - 1) : m * lags]
    b1 = (1 - f) * theta[:m] if lags == 2 else np.zeros(m)
    return Expansion(
        f,
        b1,
        b2,
        period_s,
        float((b1 + b2).sum()) if air is not None else 0.0,
        float(theta[-2]),
        {"method": "output error", "start_um": float(theta[-1]), "rms_um": float(np.sqrt(cost / here.sum()))},
    )


class Bank:
    """Online output error: fixed poles, each with a square-root RLS on inputs filtered by it.

    The best pole is used.

    Call `update(rises (K, M), y (K,))` with new samples in time order (NaN in y where the reference is
    absent); `model()` gives the present Expansion. About 0.7 us a sample and pole for 12 temperatures."""

    def __init__(
        self,
        inputs: int,
        period_s: float,
        poles: int = 16,
        tau_range_s: tuple[float, float] = (20.0, 2000.0),
        weight: float = 1.0,
        prior_sigma: float = 30.0,
        input_sigma_k: float | np.ndarray = 0.1,
    ):
        p = 2 * inputs + 2
        self.sigma2 = np.broadcast_to(np.asarray(input_sigma_k, float) ** 2, (inputs,))
        self.period_s, self.weight, self.inputs = period_s, weight, inputs
        self.poles = np.exp(-period_s / np.geomspace(*tau_range_s, poles))
        self.r = np.zeros((poles, p, p + 1))
        self.r[:, np.arange(p), np.arange(p)] = 1 / prior_sigma
        self.cost = np.zeros(poles)
        self.state = np.zeros((poles, p - 1))
        self.state[:, 2 * inputs] = 1.0
        self.last = np.zeros((1, inputs))
        self.samples = 0

    def update(self, rises: np.ndarray, y: np.ndarray) -> None:
        """Take rises (K, M) and measured positions (K,)."""
        rises = np.ascontiguousarray(np.atleast_2d(rises), dtype=float)
        if self.samples == 0 and len(rises):
            self.last[0] = rises[0]
        kernels.bank_run(
            self.r,
            self.cost,
            self.state,
            self.poles,
            rises,
            np.ascontiguousarray(y, dtype=float),
            self.weight,
            self.last,
        )
        self.samples += len(rises)

    def model(self) -> Expansion:
        """Return the Expansion of the pole with the least criterion so far.

        The criterion is the squared error plus, as in `output_error`, the ridge for the inputs' error.
        """
        m, p = self.inputs, self.r.shape[1]
        best = (np.inf, 0, np.zeros(p))
        for k in range(len(self.poles)):
            rows = self._rows(k)
            left = linalg.qr(rows, mode="r", check_finite=False)[0]
            theta = linalg.solve_triangular(left[:p, :p], left[:p, p])
            criterion = self.cost[k] + left[p, p] ** 2
            if criterion < best[0]:
                best = (criterion, k, theta)
        _, k, theta = best
        f = float(self.poles[k])
        return Expansion(
            f,
            (1 - f) * theta[:m],
            (1 - f) * theta[m : 2 * m],
            self.period_s,
            0.0,
            float(theta[-1]),
            {"method": "online bank", "start_um": float(theta[2 * m]), "samples": self.samples},
        )

    def bounded(self, low: np.ndarray, high: np.ndarray) -> Expansion:
        """Return the best Expansion of one lag whose static gains (M,) um/K lie within low..high.

        Collinear gains that the data cannot separate are fitted within the bounds, not clipped afterwards.
        """
        m = self.inputs
        free = np.full(2, np.inf)
        best = (np.inf, 0, np.zeros(m + 2))
        for k in range(len(self.poles)):
            rows = self._rows(k)
            solution = optimize.lsq_linear(
                rows[:, m:-1], rows[:, -1], (np.append(low, -free), np.append(high, free))
            )
            criterion = self.cost[k] + 2 * solution.cost
            if criterion < best[0]:
                best = (criterion, k, solution.x)
        _, k, theta = best
        f = float(self.poles[k])
        return Expansion(
            f,
            np.zeros(m),
            (1 - f) * theta[:m],
            self.period_s,
            0.0,
            float(theta[-1]),
            {"method": "online bank, bounded", "start_um": float(theta[m]), "samples": self.samples},
        )

    def _rows(self, k: int) -> np.ndarray:
        """Return the triangle of pole k with the ridge for the inputs' error; right-hand side last."""
        count = self.samples if self.weight == 1 else (1 - self.weight**self.samples) / (1 - self.weight)
        f, p = self.poles[k], self.r.shape[1]
        ridge = np.append(np.tile(self.sigma2, 2) * (1 - f) / (1 + f) * count, [0, 0])
        return np.vstack([self.r[k], np.column_stack([np.diag(np.sqrt(ridge)), np.zeros(p)])])


def _check(rises: np.ndarray, y: np.ndarray) -> None:
    if rises.ndim != 2 or len(rises) != len(y):
        raise InputError(f"temperatures {rises.shape} and positions {y.shape} do not belong together")
    if not np.isfinite(rises).all():
        row = int(np.flatnonzero(~np.isfinite(rises).all(1))[0])
        raise InputError(f"a temperature is missing at sample {row}; use the filter's estimate as input")
