"""Inputs that are driven in levels, whose readings scatter about them.

A simulation is driven by what was read: a mass integrates the noise of a current's reading. Functions of the
reading that are flat at each level take this noise away, and predict every part better: a limit, a dead zone,
a law with its edges at the levels (regression dilution). So the mean of each level is tried as the input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.between import CLEARLY, alone
from thermoctl.diagnosis.report.words import listed
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.simulation.simulate import SimulationError
from thermoctl.recording.table import Table

STEP = 8.0  # difference of two rows over the noise from which it is a step: chance 2e-8 without one
LEVEL = 10  # least number of rows of a level
SAME = 4.0  # standard errors of a difference of two means below which they are one level
MOST = 0.8  # least share of the rows that lie in levels
# Least ratio of von Neumann (1941), 2 for white noise: below it, the input moves within its levels. In 120
# recordings of rigs and generated cases no moving input has more than 1.04.
WHITE = 1.5


def steady(
    case: Case, made: Callable[[Sequence[Table]], Case], reserve: Sequence[Table]
) -> tuple[Case, list[Table]]:
    """Return the case, and the recordings set aside, with the means of levels as inputs where they fit clearly better.

    `made`: makes the case of recordings. Else both as they are. Raises InputError."""
    given = [*case.tables, *reserve]
    of_columns = {
        c: levels([t.columns[c] for t in given]) for c in {i.column for i in case.plant.inputs.values()}
    }
    found = {c: v for c, v in of_columns.items() if v}
    if not found or case.memory.recordings:
        return case, list(reserve)
    tables = [
        replace(t, columns={**t.columns, **{c: v[k] for c, v in found.items()}}) for k, t in enumerate(given)
    ]
    try:
        other = made(tables[: len(case.tables)])
        gain = alone(other) - alone(case)
    except (InputError, SimulationError, np.linalg.LinAlgError):
        return case, list(reserve)
    if gain <= CLEARLY:
        return case, list(reserve)
    other.notes.append(
        f"the readings of {listed(sorted(found))} scatter about levels; with the mean of each level the plant alone follows the recordings "
        f"better ({gain:.0f} nats): taken so"
    )
    return other, tables[len(case.tables) :]


def levels(columns: Sequence[np.ndarray]) -> list[np.ndarray] | None:
    """Return the mean of its level for each reading (N,) by recording.

    None where one of them is not driven in levels, with white noise. Readings between levels stay."""
    x, first = np.concatenate(columns), np.cumsum([len(c) for c in columns])[:-1]
    d = np.diff(x)
    noise = 1.4826 * float(np.median(np.abs(d))) / np.sqrt(2) if len(d) else 0.0
    if not (np.isfinite(x).all() and noise > 0):
        return None
    ends = np.union1d(np.flatnonzero(np.abs(d) > STEP * noise) + 1, first)
    parts = [p for p in np.split(np.arange(len(x)), ends) if len(p) >= LEVEL]
    if sum(map(len, parts)) < MOST * len(x):
        return None
    scatter = sum(float(np.var(x[p]) * (len(p) - 1)) for p in parts)
    if sum(float(np.sum(np.diff(x[p]) ** 2)) for p in parts) <= WHITE * scatter:
        return None
    out, level = x.copy(), np.zeros(0, int)
    for p in sorted(parts, key=lambda p: x[p].mean()):  # a level that comes again is one
        error = noise * np.sqrt(1 / len(p) + 1 / max(len(level), 1))
        again = len(level) and x[p].mean() - x[level].mean() < SAME * error
        level = np.append(level, p) if again else p
        out[level] = x[level].mean()
    return np.split(out, first)
