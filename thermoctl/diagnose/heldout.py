"""What an explanation is worth on data that took no part in its fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.fft import dct

from thermoctl.diagnose.explain import Case, Explanation
from thermoctl.plant.language import Plant
from thermoctl.plant.refit import Prior, fit, updated
from thermoctl.plant.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.recording.table import Table

UNDETERMINED = 20.0
BIN = 6  # coefficients of a spectrum that are averaged at least
FORETOLD = 6.0  # standard deviations of chance from which errors follow a prediction
BLOCKS = 16  # of a single recording, every other one held out


def folds(case: Case, blocks: bool = False) -> list[tuple[list[Table], list[Table]]]:
    """(training tables, test tables): each recording in turn; or each cut into `blocks`, of which every other one is held out,
    and then the others. A single recording is always cut."""
    if len(case.tables) > 1 and not blocks:
        return [
            ([t for q, t in enumerate(case.tables) if q != r], [case.tables[r]])
            for r in range(len(case.tables))
        ]
    measured = {o.column for o in case.plant.outputs.values()}

    def masked(table: Table, parity: int) -> Table:
        span = (table.t - table.t[0]) / max(float(table.t[-1] - table.t[0]), 1e-300)
        keep = np.minimum(span * BLOCKS, BLOCKS - 1).astype(int) % 2 == parity
        columns = {k: np.where(keep, v, np.nan) if k in measured else v for k, v in table.columns.items()}
        return dataclasses.replace(table, columns=columns)

    even, odd = ([masked(t, parity) for t in case.tables] for parity in (0, 1))
    return [(even, odd), (odd, even)]


def unseen_errors(
    case: Case, plant: Plant, refit: bool = True, blocks: bool = False, beliefs: Sequence[Prior] = ()
) -> list[np.ndarray]:
    """Free-run errors (N, outputs) on each fold's test data, the plant fitted to that fold's training data only."""
    out: list[np.ndarray] = []
    for train, test in folds(case, blocks):
        model = compile_plant(plant)
        drives = [model.excitation(t) for t in test]
        try:
            dx0: Sequence[np.ndarray | None] = [None] * len(test)
            if refit:
                training = [model.excitation(t) for t in train]
                found = fit(
                    model,
                    training,
                    case.noise,
                    iterations=15,
                    tolerance=1e-3,
                    seconds=case.patience,
                    priors=beliefs,
                )
                model = Model(updated(plant, found, training), model.code)
                if train[0].path == test[0].path:  # recordings, split: their starts took part
                    dx0 = list(found.dx0)
            out += [
                _but_for_start(case, model, d)
                if begin is None and model.uncertain
                else d.y - model.run(model.prepare(d), None, begin).y
                for d, begin in zip(drives, dx0, strict=True)
            ]
        except SimulationError:
            out += [np.full_like(d.y, np.nan) for d in drives]
    return out


def _but_for_start(case: Case, model: Model, d: Excitation) -> np.ndarray:
    """Free-run error on a recording that took no part, less what its uncertain start explains at first order: where it began
    is no physics, and a free axis carries an error of its start to the end."""
    run = model.run(model.prepare(d), None, None, sensitivities=True)
    assert run.dy is not None
    error = d.y - run.y
    good = np.isfinite(error)
    scale = np.array([n.sigma for n in case.noise])
    by_start = run.dy[:, :, len(model.active) :]
    prior = np.array([model.plant.nodes[n].initial_sigma or 1.0 for n in model.uncertain])
    rows, left = (by_start / scale[None, :, None])[good] * prior, (error / scale)[good]
    shift = np.linalg.solve(rows.T @ rows + np.eye(len(prior)), rows.T @ left) * prior
    return error - by_start @ shift


def errors_of(case: Case, e: Explanation, blocks: bool) -> list[np.ndarray]:
    """`unseen_errors` of an explanation, kept by the case: search, proof and report ask for the same ones."""
    key = (id(e.plant), blocks)
    if key not in case.unseen:
        case.unseen[key] = (e.plant, unseen_errors(case, e.plant, blocks=blocks, beliefs=e.fit.priors))
    return case.unseen[key][1]


def prediction(case: Case, before: Explanation, after: Explanation) -> tuple[float, float, float, bool]:
    """`pooled_gain` of one explanation over another, and whether it is that of blocks: what a single recording does not determine, an
    encoder's phase, a share of two paths, predicts no other recording, but the blocks between those that it was fitted to."""
    gain = pooled_gain(case, errors_of(case, before, False), errors_of(case, after, False))
    if gain[2] < 1.0 or len(case.tables) == 1:
        return *gain, False
    between = pooled_gain(case, errors_of(case, before, True), errors_of(case, after, True))
    return (*between, True) if between[2] < 1.0 else (*gain, False)


def foretold(before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> float:
    """By how many standard deviations of chance the errors (N, outputs) `before` follow what the two predictions differ by,
    d = before - after:  z = sum(before d) / sqrt(sum_k S(k) D(k)^2), with D the cosine transform of d and S the errors' own
    spectrum after, in bins of a third of an octave and BIN coefficients at least, so that the noise's colour counts."""
    follows, chance = 0.0, 0.0
    for a, b in zip(before, after, strict=True):
        for j in range(a.shape[1]):
            good = np.isfinite(a[:, j]) & np.isfinite(b[:, j])
            if good.sum() < 4 * BIN:
                continue
            error, d = np.where(good, b[:, j], 0.0), np.where(good, a[:, j] - b[:, j], 0.0)
            power = dct(error, norm="ortho") ** 2 / good.mean()
            edges = [0]
            while edges[-1] < len(power):
                edges.append(max(edges[-1] + BIN, int(edges[-1] * 2 ** (1 / 3))))
            edges[-1] = len(power)
            size = np.diff(edges)
            spectrum = np.repeat(np.add.reduceat(power, edges[:-1]) / size, size)
            scale = float(np.mean(b[good, j] ** 2)) or 1.0  # every output weighs by its own errors
            follows += float(a[good, j] @ d[good]) / scale
            chance += float(spectrum @ dct(d, norm="ortho") ** 2) / scale**2
    return follows / float(np.sqrt(chance)) if chance else 0.0


def pooled_gain(
    case: Case, before: Sequence[np.ndarray], after: Sequence[np.ndarray], draws: int = 400
) -> tuple[float, float, float]:
    """Ratio of held-out rms after / before over all outputs in units of their noise, with its 90 % interval (paired block
    bootstrap), whose upper end is a one-sided 95 % bound. What happens in one block only, a saturation that is reached once, a tank
    that overflows once, is missing from every third draw: there the ratio itself is the bound, where the errors before follow
    what the two predictions differ by as noise would not (`foretold`). A recording that the others do not determine, so that the plant alone
    misses it UNDETERMINED times as far as the one it predicts best, judges nothing."""
    sigma = np.array([n.sigma for n in case.noise])
    misses = [float(np.sqrt(np.nanmean((a / sigma) ** 2))) for a in before]
    pairs: list[tuple[float, float]] = []
    judging: list[tuple[np.ndarray, np.ndarray]] = []
    for a, b, miss in zip(before, after, misses, strict=True):
        if miss > UNDETERMINED * min(misses):
            continue
        judging.append((a, b))
        if not np.isfinite(b[np.isfinite(a)]).all():
            return np.inf, np.inf, np.inf
        x, y = np.nansum((a / sigma) ** 2, axis=1), np.nansum((b / sigma) ** 2, axis=1)
        block = max(5, len(x) // 20)
        n = len(x) // block
        x, y = x[: n * block].reshape(n, block).sum(1), y[: n * block].reshape(n, block).sum(1)
        pairs += [(p, q) for p, q in zip(x, y, strict=True) if p > 0]
    values = np.array(pairs)
    if len(values) < 4:
        return 1.0, 0.0, np.inf
    index = np.random.default_rng(3).integers(0, len(values), (draws, len(values)))
    ratio = np.sqrt(values[index, 1].sum(1) / np.maximum(values[index, 0].sum(1), 1e-300))
    found = float(np.sqrt(values[:, 1].sum() / values[:, 0].sum()))
    low, high = (float(np.quantile(ratio, q)) for q in (0.05, 0.95))
    if high >= 1.0 > found and foretold(*zip(*judging, strict=True)) > FORETOLD:
        high = found
    return found, low, high


def held_out(case: Case, base: Explanation, final: Explanation) -> dict[str, Any]:
    """Fit the plant's own parameters, and those of the explanation, without some of the data; errors on that data: each recording in
    turn, or blocks of all where only those show what the explanation is worth (`data` says which)."""
    blocks = len(case.tables) == 1 or bool(final.effects) and prediction(case, base, final)[3]
    out = {
        "before": unseen_errors(case, case.plant, False, blocks),
        "refit_only": errors_of(case, base, blocks),
    }
    out["after"] = errors_of(case, final, blocks) if final.effects else out["refit_only"]
    figures: dict[str, Any] = {f"held_out_{k}": rms(case.model, v) for k, v in out.items()}
    figures["data"] = "blocks" if blocks else "recordings"
    figures["gain"] = _gain(case, out["refit_only"], out["after"]) if final.effects else {}
    return figures


def _gain(
    case: Case, before: Sequence[np.ndarray], after: Sequence[np.ndarray], draws: int = 400
) -> dict[str, Any]:
    """Per output: held-out rms ratio after / refit only with a 95 % interval by paired block bootstrap."""
    rng = np.random.default_rng(2)
    out = {}
    for j, o in enumerate(case.model.outputs):
        pairs = []
        for a, b in zip(before, after, strict=True):
            good = np.isfinite(a[:, j]) & np.isfinite(b[:, j])
            if good.sum() < 20:
                continue
            block = max(5, int(good.sum()) // 25)
            x, y = a[good, j] ** 2, b[good, j] ** 2
            n = len(x) // block
            pairs += list(
                zip(
                    x[: n * block].reshape(n, block).mean(1),
                    y[: n * block].reshape(n, block).mean(1),
                    strict=True,
                )
            )
        if len(pairs) < 4:
            continue
        values = np.array(pairs)
        index = rng.integers(0, len(values), (draws, len(values)))
        ratio = np.sqrt(values[index, 1].sum(1) / np.maximum(values[index, 0].sum(1), 1e-300))
        out[o] = {
            "ratio": float(np.sqrt(values[:, 1].sum() / max(values[:, 0].sum(), 1e-300))),
            "interval": [float(np.quantile(ratio, 0.025)), float(np.quantile(ratio, 0.975))],
        }
    return out


def rms(model: Model, residuals: Sequence[np.ndarray]) -> dict[str, float]:
    """Root mean square per output that was measured, of residuals per recording (N, outputs)."""
    stacked = np.concatenate(list(residuals))
    return {
        o: float(np.sqrt(np.nanmean(stacked[:, j] ** 2)))
        for j, o in enumerate(model.outputs)
        if np.isfinite(stacked[:, j]).any()
    }
