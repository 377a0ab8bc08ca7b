"""What the tests and benches of identification hold the product's estimators against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.identify import modal
from thermoctl.identify.expansion import Expansion
from thermoctl.identify.statespace import StateSpace


def time_constant_s(model: Expansion) -> float:
    """-T / ln f1, s; 0 where the model does not decay."""
    return -model.period_s / np.log(model.f1) if 0 < model.f1 < 1 else 0.0


def initial_state(m: StateSpace, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least-squares x0 (n,) of a free run over u (N, m) for y (N, l); NaN in y is left out."""
    still = np.zeros_like(u)
    columns = np.stack([m.simulate(still, e) for e in np.eye(m.order)], axis=-1)
    here = np.isfinite(y)
    f, left = columns[here], (y - m.simulate(u))[here]
    d = np.linalg.norm(f, axis=0)
    # slow states are nearly collinear over a short record: a ridge keeps them small
    return np.linalg.solve(f.T @ f / d / d[:, None] + 1e-5 * np.eye(m.order), f.T @ left / d) / d


def fit_percent(y: np.ndarray, model: np.ndarray) -> np.ndarray:
    """NRMSE fit of each column: 100 (1 - |y - model| / |y - mean|); NaN samples left out."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return 100 * (1 - np.sqrt(np.nansum((y - model) ** 2, 0) / np.nansum((y - np.nanmean(y, 0)) ** 2, 0)))


def identify_validated(
    u: np.ndarray,
    y: np.ndarray,
    period_s: float,
    orders: Sequence[int] = (1, 2, 3, 4),
    folds: Sequence[float] = (0.4, 0.6, 0.8),
    ahead: float = 0.2,
    block_s: float | None = None,
    others: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> StateSpace:
    """Model from one record u (N, m), y (N, l); order, kind of start (from equilibrium or not) and ridge by cross-validation.

    From the first 40, 60 and 80 % of the record every candidate is identified and run free over the next 20 %: the one with the least
    squared error of all is identified again from everything. `info` then has `validation`, {(order, rest, ridge): rms}. Nothing is centred:
    a passive network at rest at 0 needs no offset, and a record's own mean is no equilibrium. `others`: whole recordings (u, y) of the same
    rig, identified from together with this one wherever it is; all must then begin at rest. Raises InputError when no candidate can be
    identified from the first part."""
    n, block_s = len(u), block_s or period_s
    known = [modal.reduce(o, period_s, block_s) for o in others]
    longest = max([n, *(len(o[0]) for o in others)]) * period_s

    def fit(stop: int, order: int, rest: bool, ridge: float) -> StateSpace:
        records = [*known, modal.reduce((u[:stop], y[:stop]), period_s, block_s)]
        return modal.identify(records, order, rest, tau_range_s=(2 * block_s, longest), ridge=ridge)

    errors: dict[tuple[int, bool, float], float] = {}
    for choice in product(orders, (True,) if others else (True, False), (1e-7, 1e-2)):
        total = 0.0
        for part in folds:
            start, stop = int(part * n), int((part + ahead) * n)
            try:
                m = fit(start, *choice)
            except InputError:
                total = np.inf
                break
            x0 = m.x0 if choice[1] else initial_state(m, u[:start], y[:start])
            total += float(np.nanmean((m.simulate(u[:stop], x0)[start:] - y[start:stop]) ** 2))
        if np.isfinite(total):
            errors[choice] = float(np.sqrt(total / len(folds)))
    if not errors:
        raise InputError(f"{n} samples are too few to choose an order by cross-validation; give the order")
    best = min(errors, key=errors.__getitem__)
    model = fit(n, *best)
    return replace(
        model, info={**model.info, "order": best[0], "rest": best[1], "ridge": best[2], "validation": errors}
    )
