"""The expansion model: position error from temperatures, first order, M inputs, one output.

    yL(n+1) = f1 yL(n) + sum_m [b_m,1 T_m(n-1) + b_m,2 T_m(n)]                               (2), (3), (39)

Equation error (the paper's (5)) has the *measured* yL in the regressor. Noise on yL biases f1 towards 0: with
0.05 um of noise a time constant of 180 s was found as 3.2 s.

Output error: the regressor holds the model's own past output. For a given f1 the model is linear in b, with
inputs filtered by 1/(z - f1) and the decay f1^n of the first output. So one number f1 is searched, with a
least-squares solution for each.

Ridge: the gains g multiply the noise of the thermometers. Its variance is quantisation step^2/12 plus the
sensor's own, times (1 - f1)/(1 + f1) after the filter 1/(z - f1). Adding N sigma^2 g'g to the criterion
minimises the expected squared error *with such inputs*. The nearly collinear gains need that. The
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

BLOCK = 64  # samples that are rotated into the bank's triangles at once


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
    rises: list[np.ndarray],
    y: list[np.ndarray],
    period_s: float,
    input_sigma_k: float | np.ndarray = 0.0,
    air: list[np.ndarray] | None = None,
    tau_range_s: tuple[float, float] | None = None,
    output_step_um: float = 0.0,
) -> Expansion:
    """Fit the expansion by output error: search over f1, ridge least squares for the gains on T(n).

    rises (N, M) K and y (N,) um (NaN: not measured) of each recording, which has an offset and a start of its
    own. `air` (N,) degC ties b_air to the sum of the gains. `input_sigma_k`: error of the inputs that the
    model will be driven by (quantisation included), one for all or one each. `output_step_um`: the encoder's
    step; its variance is the least that a fit may leave.
    The returned offset and start are those of the last recording."""
    for r, v in zip(rises, y, strict=True):
        _check(r, v)
    m, own = rises[0].shape[1], 2 * len(rises)
    measured = np.concatenate(y)
    here = np.isfinite(measured)
    count = int(here.sum())
    if count < 4 * m:
        raise InputError(f"{count} measured positions for {m} temperatures; at least {4 * m}")
    drives = [r + (a - a[0])[:, None] for r, a in zip(rises, air, strict=True)] if air else rises
    lo, hi = tau_range_s or (2 * period_s, max(len(r) for r in rises) * period_s / 4)
    sigma2 = np.broadcast_to(np.asarray(input_sigma_k, float) ** 2, (m,))

    def solve(log_tau: float) -> tuple[float, np.ndarray, float]:
        """Return the cost, um^2, the coefficients and f1 at a time constant, given as ln(tau/s)."""
        f = float(np.exp(-period_s / np.exp(log_tau)))
        blocks = []
        for k, drive in enumerate(drives):
            z = np.zeros((len(drive), m + own))
            z[:, :m] = signal.lfilter([0, 1 - f], [1, -f], drive, axis=0)
            z[:, m + 2 * k] = 1
            z[:, m + 2 * k + 1] = f ** np.arange(len(drive))
            blocks.append(z)
        z = np.vstack(blocks)[here]
        g, right = z.T @ z, z.T @ measured[here]
        noise = np.concatenate([sigma2 * (1 - f) / (1 + f) * count, np.full(own, 1e-9 * count)])
        noise[:m] += 1e-6 * np.trace(g[:m, :m]) / m
        theta = linalg.solve(g + np.diag(noise), right, assume_a="pos")
        left = float(((measured[here] - z @ theta) ** 2).sum() + theta @ (noise * theta))
        return left + count * output_step_um**2 / 12, theta, f

    grid = np.linspace(np.log(lo), np.log(hi), 13)
    k = int(np.argmin([solve(v)[0] for v in grid]))
    best = optimize.minimize_scalar(
        lambda v: solve(v)[0],
        bounds=(grid[max(k - 1, 0)], grid[min(k + 1, 12)]),
        method="bounded",
        options={"xatol": 1e-3},
    )
    cost, theta, f = solve(best.x)
    gains = (1 - f) * theta[:m]
    return Expansion(
        f,
        np.zeros(m),
        gains,
        period_s,
        float(gains.sum()) if air else 0.0,
        float(theta[-2]),
        {"method": "output error", "start_um": float(theta[-1]), "rms_um": float(np.sqrt(cost / count))},
    )


class Bank:
    """Online output error with one lag: for each of some fixed poles the triangle of its least squares.

    Call `update` with each new sample; `bounded` gives the Expansion of the best pole."""

    def __init__(
        self,
        inputs: int,
        period_s: float,
        poles: int = 16,
        tau_range_s: tuple[float, float] = (20.0, 2000.0),
        prior_sigma: float = 30.0,
        input_sigma_k: float = 0.1,
    ):
        self.period_s, self.inputs, self.sigma_k, self.samples = period_s, inputs, input_sigma_k, 0
        self.poles = np.exp(-period_s / np.geomspace(*tau_range_s, poles))
        # Unknowns: gains, initial output, offset. Each triangle has the measurement as its last column.
        self.triangles = np.tile(np.eye(inputs + 2, inputs + 3) / prior_sigma, (poles, 1, 1))
        # Inputs filtered by 1/(z - f1), and the decay of the initial output.
        self.state = np.zeros((poles, inputs + 1))
        self.state[:, -1] = 1.0
        self.waiting: list[np.ndarray] = []  # rows (poles, inputs + 3) that are not yet in the triangles

    def update(self, rises: np.ndarray, y: float) -> None:
        """Take temperature rises (M,) K and the measured position, um (NaN: none)."""
        if np.isfinite(y):
            self.waiting.append(np.column_stack([self.state, np.tile([1.0, y], (len(self.state), 1))]))
            if len(self.waiting) == BLOCK:
                self._fold()
        f = self.poles[:, None]
        self.state *= f
        self.state[:, :-1] += (1 - f) * rises
        self.samples += 1

    def _fold(self) -> None:
        """Rotate the waiting rows into the triangles."""
        if self.waiting:
            rows = np.concatenate([self.triangles, np.stack(self.waiting, axis=1)], axis=1)
            self.triangles = np.asarray(np.linalg.qr(rows, mode="r"))
            self.waiting = []

    def bounded(self, low: np.ndarray | float, high: np.ndarray | float) -> Expansion:
        """Return the best Expansion whose static gains (M,) um/K lie within low..high.

        Collinear gains that the data cannot separate are fitted within the bounds, not clipped afterwards.
        The criterion has, as in `output_error`, the ridge for the inputs' error."""
        self._fold()
        m = self.inputs
        bounds = np.full((2, m + 2), [[-np.inf], [np.inf]])
        bounds[:, :m] = np.broadcast_to(low, m), np.broadcast_to(high, m)
        best: tuple[float, float, np.ndarray] = (np.inf, 0.0, np.zeros(m + 2))
        for f, rows in zip(self.poles, self.triangles, strict=True):
            ridge = self.sigma_k * np.sqrt((1 - f) / (1 + f) * self.samples) * np.eye(m, m + 3)
            both = np.vstack([rows, ridge])
            found = optimize.lsq_linear(both[:, :-1], both[:, -1], bounds)
            if found.cost < best[0]:
                best = (found.cost, float(f), found.x)
        _, f, theta = best
        return Expansion(
            f,
            np.zeros(m),
            (1 - f) * theta[:m],
            self.period_s,
            0.0,
            float(theta[-1]),
            {"method": "online bank", "start_um": float(theta[m]), "samples": self.samples},
        )


def _check(rises: np.ndarray, y: np.ndarray) -> None:
    if rises.ndim != 2 or len(rises) != len(y):
        raise InputError(f"temperatures {rises.shape} and positions {y.shape} do not belong together")
    if not np.isfinite(rises).all():
        row = int(np.flatnonzero(~np.isfinite(rises).all(1))[0])
        raise InputError(f"a temperature is missing at sample {row}; use the filter's estimate as input")
