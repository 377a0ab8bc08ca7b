"""Refine a model with real poles by its one-step prediction errors.

x(n+1) = A x + B u + K e,  e = y - C x                                                            (6)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg, optimize

from thermoctl.files.yamlfile import InputError
from thermoctl.identify import kernels
from thermoctl.identify.statespace import StateSpace, _c


def innovations(model: StateSpace, u: np.ndarray, y: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Return the one-step prediction errors e (N, l) of (6), with K = `gain` (n, l)."""
    closed = model.a - gain @ model.c
    both = _c(np.hstack([model.b, gain]))
    return y - kernels.simulate(_c(closed), both, _c(model.c), _c(model.x0), _c(np.hstack([u, y])))


def prediction_gain(model: StateSpace, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Estimate a start for K (n, l) of (6).

    Process noise comes from the slow part of the residual, sensor noise from its differences."""
    e = y - model.simulate(u, model.x0)
    white = np.diff(e, 2, axis=0)
    r = white.T @ white / len(white) / 6
    r += 1e-9 * np.trace(r) / len(r) * np.eye(len(r)) + 1e-18 * np.eye(len(r))
    slow = np.linalg.pinv(model.c, rcond=1e-6) @ (e[8:] + e[:-8]).T / 2
    w = slow[:, 1:] - model.a @ slow[:, :-1]
    q = w @ w.T / w.shape[1] * 0.01
    q += 1e-12 * (np.trace(q) + 1e-18) * np.eye(len(q))
    p = linalg.solve_discrete_are(model.a.T, model.c.T, q, r)
    return model.a @ p @ model.c.T @ np.linalg.inv(model.c @ p @ model.c.T + r)


def by_prediction_errors(
    model: StateSpace, u: np.ndarray, y: np.ndarray, most: int = 7
) -> tuple[StateSpace, np.ndarray]:
    """Refine poles, B, K and C on u (N, m), y (N, l); return (model, K (n, l)).

    Minimises the sum of squares of the whitened innovations in at most `most` steps; it stays among stable
    models with positive poles. Raises InputError for a model that is not diagonal (`statespace.modal`)."""
    if np.abs(model.a - np.diag(np.diag(model.a))).max() > 1e-12:
        raise InputError("prediction-error refinement starts from a model with real poles (diagonal A)")
    n, m, l = model.order, model.b.shape[1], len(model.c)  # noqa: E741
    gain = prediction_gain(model, u, y)
    covariance = np.cov(innovations(model, u, y, gain).T).reshape(l, l)
    root = np.linalg.inv(linalg.cholesky(covariance + 1e-18 * np.eye(l), lower=True))
    uy = _c(np.hstack([u, y]))

    def at(x: np.ndarray) -> tuple[StateSpace, np.ndarray]:
        """Return model and K (n, l) of the unknowns x: poles, B, K, C."""
        a, b, k, c = np.split(x, np.cumsum([n, n * m, n * l]))
        return replace(model, a=np.diag(a), b=b.reshape(n, m), c=c.reshape(l, n)), k.reshape(n, l)

    def residuals(x: np.ndarray) -> np.ndarray:
        """Return the whitened innovations (N l,); inf where the model or its filter is not allowed."""
        trial, k = at(x)
        if (x[:n] <= 0).any() or max(
            x[:n].max(), np.abs(np.linalg.eigvals(trial.a - k @ trial.c)).max()
        ) >= 1:
            return np.full(y.size, np.inf)
        return (innovations(trial, u, y, k) @ root.T).ravel()

    def slopes(x: np.ndarray) -> np.ndarray:
        """Return the derivatives (N l, unknowns) of the residuals: one simulation for each unknown.

        de = -(dC x + C dx), dx(n+1) = (A - K C) dx + dA x + dB u + dK e - K dC x"""
        trial, k = at(x)
        closed, c, rest = _c(trial.a - k @ trial.c), _c(trial.c), np.zeros(n)
        states = kernels.simulate(closed, _c(np.hstack([trial.b, k])), np.eye(n), _c(trial.x0), uy)

        def moved(into: np.ndarray, drive: np.ndarray) -> np.ndarray:
            """Return -C dx (N, l), driven by drive (N,) into the states by `into` (n,)."""
            return -kernels.simulate(closed, _c(into[:, None]), c, rest, _c(drive[:, None]))

        e = y - states @ trial.c.T
        parts = [moved(row, states[:, i]) for i, row in enumerate(np.eye(n))]
        parts += [moved(row, drive) for drives in (u, e) for row in np.eye(n) for drive in drives.T]
        for j in range(l):
            for i in range(n):
                part = moved(-k[:, j], states[:, i])
                part[:, j] -= states[:, i]
                parts.append(part)
        return np.stack([(p @ root.T).ravel() for p in parts], axis=1)

    start = np.concatenate([np.diag(model.a), model.b.ravel(), gain.ravel(), model.c.ravel()])
    solution = optimize.least_squares(residuals, start, slopes, ftol=1e-6, x_scale="jac", max_nfev=most)
    refined, gain = at(solution.x)
    return replace(refined, info={**model.info, "prediction_error": 2 * solution.cost / y.size}), gain
