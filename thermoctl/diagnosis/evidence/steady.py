"""Inputs whose readings scatter about what drives the plant: levels, or a smooth course.

A simulation is driven by readings: a mass integrates the noise of a current's reading. A function of the
reading that is flat at each level takes this noise away, and predicts every part better. A limit, a dead zone
and a law with its edges at the levels do so. So the mean of each level is tried as the input. The mean has an
error, too: it is fitted to the outputs, with its own standard error as the prior. An input on straight lines
is smoothed by Gaussians of growing width. Otherwise a lag and an advance together would smooth it, or an
advance by a part of a row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter1d

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.between import CLEARLY, alone
from thermoctl.diagnosis.evidence.input_noise import scatter
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
WIDTHS = (2.0, 8.0, 32.0)  # standard deviations of a smoothing Gaussian, in rows
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
Kind = Callable[[Case, Callable[[Sequence[Table]], Case], Sequence[Table], int], Iterator[Courses]]


def steady(
    case: Case, made: Callable[[Sequence[Table]], Case], tables: Sequence[Table], reserve: Sequence[Table]
) -> tuple[Case, list[Table], dict[str, str]]:
    """Return the case and the recordings set aside, with inputs without their scatter, and what was taken.

    Levels, and then the smooth course of each other input, are taken where the plant alone fits clearly
    better with them. `made`: makes the case of recordings. Raises InputError."""
    given, n, notes = [*tables, *reserve], len(tables), dict[str, str]()
    straight = sorted(
        {i.column for i in case.plant.inputs.values() if i.linear and not case.plant.trusts(i.name)}
    )
    kinds: list[tuple[str, Kind]] = [("levels", _levels)]
    kinds += [("a smooth course", partial(_smoothed, column=c)) for c in straight]
    for what, kind in () if case.memory.recordings else kinds:
        if better := _better(case, made, given, n, kind):
            case, given, columns, gain = better
            notes[what] = (
                f"the readings of {columns} scatter about {what}; with it the plant alone follows the recordings better "
                f"({gain:.0f} nats): taken so"
            )
    return case, given[n:], notes


def _better(
    case: Case, made: Callable[[Sequence[Table]], Case], given: Sequence[Table], n: int, kind: Kind
) -> tuple[Case, list[Table], str, float] | None:
    """Return case, recordings, columns and gain, nats, of the best courses; None if none is clearly better.

    Of courses that become better one by one, the last is the best."""
    best: tuple[Case, list[Table], str, float] | None = None
    try:
        for courses in kind(case, made, given, n):
            if best is None:
                start = alone(case)
            driven = _driven(given, courses)
            other = made(driven[:n])
            gain = alone(other) - start
            if gain <= (best[3] if best else CLEARLY):
                break
            best = other, driven, ", ".join(courses), gain
    except (InputError, SimulationError, np.linalg.LinAlgError):
        pass
    return best


def _levels(
    case: Case, made: Callable[[Sequence[Table]], Case], given: Sequence[Table], n: int
) -> Iterator[Courses]:
    """Yield the levels of inputs, fitted to the first n recordings. Raises InputError, SimulationError."""
    columns = {i.column for i in case.plant.inputs.values()}
    found = {c: v for c in sorted(columns) if (v := levels([t.columns[c] for t in given]))}
    for _ in range(ROUNDS if found else 0):
        found = _fitted(made(_driven(given, _read(given, found))[:n]), given[:n], found)
    if found:
        yield _read(given, found)


def _smoothed(
    case: Case, made: Callable[[Sequence[Table]], Case], given: Sequence[Table], n: int, column: str
) -> Iterator[Courses]:
    """Yield an input of white noise about a smooth course, smoother and smoother."""
    for width in WIDTHS if scatter([t.columns[column] for t in given]) else ():
        yield {column: [gaussian_filter1d(t.columns[column], width) for t in given]}


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
