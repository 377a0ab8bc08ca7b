"""Errors of the findings on data that took no part in any choice, measured once, after all choices."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import stdtr

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.data.outliers import outlier_note, without_outliers
from thermoctl.diagnosis.data.rows import means
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.plant.fitting import refit
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.recording.table import Table

ENOUGH = 3  # from this number of recordings on, the last one is set aside
# Blocks of a recording; with too few recordings, every other block is fitted and the rest checked.
BLOCKS = 16
STEPS = 2  # largest number of steps from the refit of all blocks to that of half of them
APART = 2.0  # ratio of an error on recordings set aside to the noise, from which it is no noise


@dataclass(frozen=True)
class Worth:
    """Root-mean-square errors per output of the original plant, refitted, and with the findings.

    - `reserved`: are they errors on recordings set aside? Otherwise they are cross-validated on the
      recordings that took part in the choice
    - `noise`: standard deviation of each output's noise
    - `worse`: probability that the findings predict the recordings set aside worse than a refit alone; 0
      without such recordings
    - `tables`: the recordings that the errors were measured on
    - `errors`: by the keys of a result's `fit`, one array (N, outputs) for each of these recordings"""

    before: dict[str, float]
    refit_only: dict[str, float]
    after: dict[str, float]
    reserved: bool
    names: tuple[str, ...]
    noise: dict[str, float]
    worse: float = 0.0
    tables: tuple[Table, ...] = ()
    errors: Mapping[str, Sequence[np.ndarray]] = field(default_factory=dict)

    @property
    def not_followed(self) -> dict[str, float]:
        """Errors of a refit on recordings set aside that are far above the noise, by output, over it."""
        over = {o: rms / self.noise[o] for o, rms in self.refit_only.items()}
        return {o: ratio for o, ratio in over.items() if self.reserved and ratio > APART}

    @property
    def share_closed(self) -> float | None:
        """Share of the energy above the noise, summed over outputs, that the findings remove."""
        before, after = (
            sum(max((rms.get(o, np.inf) / self.noise[o]) ** 2 - 1, 0.0) for o in self.refit_only)
            for rms in (self.refit_only, self.after)
        )
        return float(1 - after / before) if before > 0 and np.isfinite(after) else None


def split(tables: Sequence[Table], held_out: Sequence[Table]) -> tuple[list[Table], list[Table]]:
    """Return the recordings that the choice is made on, and those that are set aside."""
    if held_out or len(tables) < ENOUGH:
        return list(tables), list(held_out)
    return list(tables[:-1]), list(tables[-1:])


def cleaned(case: Case, null: Fitted, reserve: Sequence[Table]) -> tuple[Case, tuple[Table, ...]]:
    """Return recordings set aside without single outliers, and the case that notes these."""
    if case.block > 1:
        return case, tuple(reserve)  # their means are without them
    model = compile_plant(null.plant)
    drives = [model.excitation(t) for t in reserve]
    errors = [errors_aside(case, null.plant, t) for t in reserve]
    stated = [_as_stated(model, d) for d in drives]
    tables, wild = without_outliers(reserve, case.plant, drives, errors, stated, case.noise)
    notes = [*case.notes, *([outlier_note(wild)] if wild else [])]
    return dataclasses.replace(case, outliers=case.outliers + wild, notes=notes), tuple(tables)


def _as_stated(model: Model, d: Excitation) -> np.ndarray:
    """Return the errors (N, outputs) with the start that the plant file states."""
    try:
        return d.y - model.run(model.prepare(d)).y
    except SimulationError:
        return np.full_like(d.y, np.nan)


def worth(case: Case, null: Fitted, best: Fitted, reserve: Sequence[Table]) -> Worth:
    """Measure the errors on the reserve. Without one, cross-validate: see `_crossed`."""
    noise = {o: n.sigma for o, n in zip(case.plant.outputs, case.noise, strict=True)}
    if reserve:
        if case.block > 1:
            reserve = [means(compile_plant(null.plant), t, case.block) for t in reserve]
        plants = {"before": case.plant, "refit_only": null.plant, "after": best.plant}
        errors = {k: [errors_aside(case, plant, t) for t in reserve] for k, plant in plants.items()}
        lost = worse(errors["refit_only"], errors["after"])
    else:
        errors = {"before": [errors_aside(case, case.plant, t) for t in case.tables]}
        errors |= {"refit_only": _crossed(case, null), "after": _crossed(case, best)}
        lost = 0.0
    before, refit_only, after = (rms_of(e, null.fit.model.outputs) for e in errors.values())
    names, tables = tuple(t.name for t in reserve), tuple(reserve or case.tables)
    return Worth(before, refit_only, after, bool(reserve), names, noise, lost, tables, errors)


def worse(alone: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> float:
    """Return the probability that the errors `after` are larger on average than the errors `alone`.

    Differences of squares, each over its output's sum of squares, are summed over blocks: errors are not
    independent from row to row (Diebold & Mariano 1995). The blocks' mean has Student's t distribution."""
    if not all(np.isfinite(a[np.isfinite(b)]).all() for b, a in zip(alone, after, strict=True)):
        return 1.0  # a simulation failed
    size = np.nansum(np.concatenate(alone) ** 2, axis=0)
    seen = size > 0
    blocks = [
        float(np.nansum((a[part][:, seen] ** 2 - b[part][:, seen] ** 2) / size[seen]))
        for b, a in zip(alone, after, strict=True)
        for part in np.array_split(np.arange(len(a)), BLOCKS)
    ]
    mean, spread = float(np.mean(blocks)), float(np.std(blocks, ddof=1)) / np.sqrt(len(blocks))
    return float(stdtr(len(blocks) - 1, mean / spread)) if spread > 0 else float(mean > 0)


def rms_of(errors: Sequence[np.ndarray], outputs: Sequence[str]) -> dict[str, float]:
    """Return the root-mean-square error of each measured output, over all recordings."""
    joined = np.concatenate(errors)
    return {
        o: float(np.sqrt(np.nanmean(joined[:, j] ** 2)))
        for j, o in enumerate(outputs)
        if np.isfinite(joined[:, j]).any()
    }


def errors_aside(case: Case, plant: Plant, table: Table) -> np.ndarray:
    """Return the free-run errors (N, outputs) on a recording set aside, its initial states fitted.

    An event in one of the other recordings may be past or not yet there: the better one is taken. NaN where
    it cannot be simulated."""
    clocks = [
        p for q, p in plant.parameters.items() if q not in case.plant.parameters and p.values and not p.range
    ]
    ways = [plant]
    for p in clocks:
        others = dataclasses.replace(p, value=-p.value)
        ways += [dataclasses.replace(w, parameters={**w.parameters, p.name: others}) for w in ways]
    errors = [_errors_aside(case, w, table) for w in ways]
    sigma = np.array([n.sigma for n in case.noise])
    return min(errors, key=lambda e: float(np.nansum((e / sigma) ** 2)) if np.isfinite(e).any() else np.inf)


def _errors_aside(case: Case, plant: Plant, table: Table) -> np.ndarray:
    """Return the errors on a recording set aside, as `errors_aside`, of a plant with its events."""
    try:
        return _aside(case, plant, table).residuals[0]
    except FAILS:  # InputError: it has no reading
        return np.full_like(compile_plant(plant).excitation(table).y, np.nan)


def _aside(case: Case, plant: Plant, table: Table) -> refit.Fit:
    """Return the refit of a recording's own unknowns: initial states, and values by recording (`_own`)."""
    free = tuple(q for q, p in plant.parameters.items() if p.range)
    own = _own(case, plant)
    held = {q: p if q in own else dataclasses.replace(p, range=None) for q, p in plant.parameters.items()}
    model = compile_plant(dataclasses.replace(plant, parameters=held), free)  # the same machine code
    d = model.excitation(table)
    return refit.fit_by_first_parts(model, [d], case.noise, tolerance=1e-3, seconds=np.inf)


def _own(case: Case, plant: Plant) -> set[str]:
    """Return what has a value in each recording, by the plant file or since it differs between recordings."""
    own = {q: p for q, p in plant.parameters.items() if p.per_recording and p.range}
    return {q for q, p in own.items() if p.known or q in case.plant.parameters}


def with_values_aside(case: Case, plant: Plant, reserve: Sequence[Table]) -> Plant:
    """Return a plant with the values that its parameters have in recordings set aside.

    The value for any other recording stays."""
    parameters = dict(plant.parameters)
    for table, q in itertools.product(reserve, _own(case, plant)):
        try:
            value = _aside(case, plant, table).parameters()[q]
        except FAILS:
            continue
        p = parameters[q]
        parameters[q] = dataclasses.replace(p, values={**p.values, table.name: value})
    return dataclasses.replace(plant, parameters=parameters)


def _crossed(case: Case, f: Fitted) -> list[np.ndarray]:
    """Return the errors in each recording's blocks, each from a refit to every other block.

    The first block is always fitted and has no error (NaN)."""
    measured = {o.column for o in case.plant.outputs.values()}
    errors = [np.full((len(t), len(f.fit.model.outputs)), np.nan) for t in case.tables]
    for parity in (0, 1):  # the first block is always fitted: only there an effect on the initial state shows
        train = [_masked(t, measured, parity, True) for t in case.tables]
        model = compile_plant(f.plant)
        drives = [model.excitation(t) for t in train]
        try:
            refitted = refit.fit(
                model, drives, case.noise, f.fit.z, STEPS, tolerance=1e-3, priors=f.fit.priors, seconds=np.inf
            )
            for r, t in enumerate(case.tables):
                aside = model.excitation(_masked(t, measured, 1 - parity, False)).y
                # The initial state is that of the whole recording.
                d = dataclasses.replace(drives[r], y=aside)
                error = d.y - model.run(model.prepare(d), refitted.values[r], refitted.dx0[r]).y
                errors[r] = np.where(np.isfinite(aside), error, errors[r])
        except SimulationError:
            continue
    return errors


def _masked(table: Table, measured: set[str], parity: int, first: bool) -> Table:
    span = (table.t - table.t[0]) / max(float(table.t[-1] - table.t[0]), 1e-300)
    block = np.minimum(span * BLOCKS, BLOCKS - 1).astype(int)
    keep = np.where(block == 0, first, block % 2 == parity)
    return dataclasses.replace(
        table,
        columns={k: np.where(keep, v, np.nan) if k in measured else v for k, v in table.columns.items()},
    )
