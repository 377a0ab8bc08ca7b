"""Inputs that are driven in levels, and whose readings scatter about these.

A simulation is driven by readings: a mass integrates the noise of a current's reading. A function of the
reading that is flat at each level takes this noise away, and predicts every part better. A limit, a dead zone
and a law with its edges at the levels do so. So the mean of each level is tried as the input. The mean has an
error, too: it is fitted to the outputs, with its own standard error as the prior. An input without levels is
smoothed in input_noise.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.between import CLEARLY, alone
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.simulation.simulate import SimulationError
from thermoctl.recording.table import Table

STEP = 8.0  # difference of two rows over the noise from which it is a step: chance 2e-8 without one
LEVEL = 10  # least number of rows of a level
MOST = 0.8  # least share of the rows that lie in levels
SAME = 4.0  # standard errors of a difference of two means below which they are one level
# Least ratio of von Neumann (1941), 2 for white noise: below it, the input moves within its levels. In 120
# recordings of rigs and generated cases no moving input has more than 1.04.
WHITE = 1.5
FARTHEST = 3.0  # standard errors by which a fitted level is from its mean at most
ROUNDS = 2  # number of fits of the levels, each about a new refit of the plant


@dataclass(frozen=True)
class Levels:
    """The levels of an input: by recording the number of the level in each row (N,), -1 for none.

    `values`, `means`, `sd` (levels,): as fitted, the means of their readings, and the standard errors."""

    of: list[np.ndarray]
    values: np.ndarray
    means: np.ndarray
    sd: np.ndarray

    def read(self, columns: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return readings (N,) of the first recordings with each level in place of those at it."""
        return [np.where(k >= 0, self.values[k], x) for k, x in zip(self.of, columns, strict=False)]


Courses = Mapping[str, Sequence[np.ndarray]]  # inputs (N,) by column and recording


def steady(
    case: Case, made: Callable[[Sequence[Table]], Case], tables: Sequence[Table], reserve: Sequence[Table]
) -> tuple[Case, list[Table], str]:
    """Return the case and the recordings set aside, with levels in place of inputs, and a sentence on them.

    Levels are taken where the plant alone fits clearly better with them. `made`: makes the case of
    recordings. Raises InputError."""
    given, n = [*tables, *reserve], len(tables)
    as_given = case, given[n:], ""
    if case.memory.recordings:
        return as_given
    try:
        found = _levels(case, made, given, n)
        if not found:
            return as_given
        driven = _driven(given, _read(given, found))
        other = made(driven[:n])
        gain = alone(other) - alone(case)
    except (InputError, SimulationError, np.linalg.LinAlgError):
        return as_given
    if gain <= CLEARLY:
        return as_given
    note = (
        f"the readings of {', '.join(found)} scatter about levels; with these the plant alone follows the recordings "
        f"better ({gain:.0f} nats): taken so"
    )
    return other, driven[n:], note


def _levels(
    case: Case, made: Callable[[Sequence[Table]], Case], given: Sequence[Table], n: int
) -> dict[str, Levels]:
    """Return the levels of inputs, fitted to the first n recordings. Raises InputError, SimulationError."""
    columns = {i.column for i in case.plant.inputs.values()}
    found = {c: v for c in sorted(columns) if (v := levels([t.columns[c] for t in given]))}
    for _ in range(ROUNDS if found else 0):
        found = _fitted(made(_driven(given, _read(given, found))[:n]), given[:n], found)
    return found


def _read(tables: Sequence[Table], found: Mapping[str, Levels]) -> Courses:
    return {c: v.read([t.columns[c] for t in tables]) for c, v in found.items()}


def _driven(tables: Sequence[Table], courses: Courses) -> list[Table]:
    return [
        replace(t, columns={**t.columns, **{c: v[k] for c, v in courses.items()}})
        for k, t in enumerate(tables)
    ]


def _fitted(case: Case, tables: Sequence[Table], found: Mapping[str, Levels]) -> dict[str, Levels]:
    """Return the levels after a step, with the plant's unknowns, to the outputs' errors at the case's refit.

    Raises SimulationError."""
    model, fit = case.null.model, case.null
    sigma = np.array([s.sigma for s in fit.noise])

    def errors(changed: Mapping[str, Levels]) -> np.ndarray:
        """Return the errors of all outputs over their noise (rows,)."""
        problem = Problem(
            model, [model.excitation(t) for t in _driven(tables, _read(tables, changed))], fit.noise
        )
        rows = [problem.errors(r, fit.values[r], fit.dx0[r]) / sigma for r in range(len(tables))]
        return np.nan_to_num(np.concatenate(rows).ravel())

    now = errors(found)
    changed = [
        errors({**found, c: replace(v, values=v.values + v.sd * (np.arange(len(v.sd)) == k))}) - now
        for c, v in found.items()
        for k in range(len(v.sd))
    ]
    parts = []
    problem = Problem(model, [model.excitation(t) for t in _driven(tables, _read(tables, found))], fit.noise)
    for r, d in enumerate(problem.excitations):
        unknowns, _, own = problem.jacobian(r, fit.values[r], fit.dx0[r])
        part = np.zeros((*own.shape[:2], len(problem.unknowns)))
        part[:, :, unknowns] = own * np.isfinite(d.y)[:, :, None] / sigma[:, None]
        parts.append(-part.reshape(-1, part.shape[2]))
    slopes = np.hstack([np.stack(changed, axis=1), np.concatenate(parts)])
    misfit = max(float(np.mean(now**2)), 1.0)  # missing physics must not move a level
    off = np.concatenate(
        [*((v.values - v.means) / v.sd for v in found.values()), np.zeros(parts[0].shape[1])]
    )
    total = slopes.T @ slopes + misfit * np.eye(len(off))
    off += np.linalg.solve(total, -slopes.T @ now - misfit * off)
    ends = np.cumsum([len(v.sd) for v in found.values()])
    return {
        c: replace(v, values=v.means + v.sd * np.clip(own, -FARTHEST, FARTHEST))
        for (c, v), own in zip(found.items(), np.split(off, ends), strict=False)
    }


def levels(columns: Sequence[np.ndarray]) -> Levels | None:
    """Return the levels of an input (N,) by recording; None where it is not driven so, or moves within.

    A level that comes again is one. Short parts that fit none, as between two levels, have none."""
    x, first = np.concatenate(columns), np.cumsum([len(c) for c in columns])[:-1]
    d = np.diff(x)
    noise = 1.4826 * float(np.median(np.abs(d))) / np.sqrt(2) if len(d) else 0.0
    if not (np.isfinite(x).all() and noise > 0):
        return None
    ends = np.union1d(np.flatnonzero(np.abs(d) > STEP * noise) + 1, first)
    parts = sorted(np.split(np.arange(len(x)), ends), key=lambda p: x[p].mean())
    long = [p for p in parts if len(p) >= LEVEL]
    if sum(map(len, long)) < MOST * len(x):
        return None
    scatter = sum(float(np.var(x[p]) * (len(p) - 1)) for p in long)
    if sum(float(np.sum(np.diff(x[p]) ** 2)) for p in long) <= WHITE * scatter:
        return None
    groups = [long[0]]
    for p in long[1:]:
        own = groups[-1]
        again = x[p].mean() - x[own].mean() < SAME * noise * np.sqrt(1 / len(p) + 1 / len(own))
        groups[-1:] = [np.append(own, p)] if again else [own, p]
    values = np.array([x[p].mean() for p in groups])
    of = np.full(len(x), -1)
    for p in parts:
        k = int(np.argmin(np.abs(values - x[p].mean())))
        if len(p) >= LEVEL or abs(values[k] - x[p].mean()) < SAME * noise / np.sqrt(len(p)):
            of[p] = k
    return Levels(np.split(of, first), values, values, noise / np.sqrt([len(p) for p in groups]))
