"""Readings that hang: equal ones, one after another, in a channel whose noise does not stop beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import log

import numpy as np

from thermoctl.checks.finding import Finding
from thermoctl.plant.language import Plant
from thermoctl.recording.table import Table
from thermoctl.units import dimension

ALARM = 1e-6  # probability of a false alarm for each column and recording
FEW = 8  # a shorter run never has a probability below ALARM
WILD = 0.05  # share of the readings around a run that may be wild: as many may lie beyond a limit
JUMP = 2.0  # a body leaves its rest with a step like others: below so many times the largest of these
COUNTED = ("1", "1/s", "m", "m/s")  # kinds of readings that encoders count: without noise while a body rests


def without_hung(plant: Plant, tables: Sequence[Table]) -> tuple[list[Table], list[str]]:
    """Return recordings without the readings that hang, and one note on them, if there are any."""
    out, places = [], list[str]()
    for table in tables:
        columns = dict(table.columns)
        for column, rows in _hung_rows(plant, table):
            columns[column] = columns[column].copy()
            columns[column][rows[1:]] = np.nan  # the first one was read
            begin, end = table.t[rows[[0, -1]]] - table.t[0]
            places.append(f"{column} in {table.name} from {begin:.6g} to {end:.6g} s")
        out.append(replace(table, columns=columns))
    return out, [f"readings that hang were left out: {'; '.join(places)}"] if places else []


def hung_findings(plant: Plant, table: Table) -> list[Finding]:
    """Return a warning for each stretch in which readings hang."""
    found = []
    for column, rows in _hung_rows(plant, table):
        begin, end = table.t[rows[[0, -1]]]
        what = f"'{column}' hangs from t = {begin:.6g} to {end:.6g} s: {len(rows)} equal readings, and noise before and after"
        advice = "diagnose and refit leave them out; empty those cells for other programs."
        found.append(Finding("hung", table.path, what, advice, severe=False))
    return found


def _hung_rows(plant: Plant, table: Table) -> list[tuple[str, np.ndarray]]:
    """Return the column and the rows of each stretch in which an output's readings hang."""
    counted, found = {dimension(u) for u in COUNTED}, []
    for o in {o.column: o for o in plant.outputs.values() if o.column in table.columns}.values():
        there = np.flatnonzero(np.isfinite(table.columns[o.column]))
        rests = o.unit is None or dimension(o.unit) in counted
        stretches = _hung(table.columns[o.column][there], rests)
        found += [(o.column, there[a : b + 1]) for a, b in stretches]
    return found


def quantum(values: np.ndarray) -> float:
    """Return the step of the readings: the least difference of any two values. Of rows, it may be a slope."""
    return float(np.diff(np.unique(values)).min(initial=np.inf))


def _hung(y: np.ndarray, rests: bool) -> list[tuple[int, int]]:
    """Return the first and last row of each stretch in which readings y (N,) hang.

    N readings hold by chance a run of n equal steps with a probability below N p^n. p is the largest share of
    equal steps in any other n rows, by the rule of succession (k + 1) / (n + 2). It is at least the share
    that rounding makes equal in the noise beside the run. So rests, coarse steps and values that are logged
    slowly explain a run elsewhere. Several runs that hang do not explain each other, unless they share a
    value: a clipped reading or a dead zone comes back to it. `rests`: may noise end with the motion?"""
    edges = np.flatnonzero(np.concatenate([[1.0], np.diff(y), [1.0]]))
    runs = [(int(a), int(b) - 1) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a > FEW]
    step = quantum(y) if runs else 0.0
    apart = {run: p for run in runs if (p := _equal_by_noise(y, *run, step, rests)) is not None}
    levels = [y[a] for a, _ in apart]
    equal = np.diff(y) == 0
    for a, b in apart:
        equal[a:b] = False
    count, found = np.append(0, np.cumsum(equal)), []
    for (a, b), by_noise in apart.items():
        n = b - a
        p = max(by_noise, (int(np.max(count[n:] - count[:-n])) + 1) / (n + 2))
        if p < 1 and n * -log(p) > log(len(y) / ALARM) and levels.count(y[a]) == 1:
            found.append((a, b))
    return found


def _equal_by_noise(y: np.ndarray, a: int, b: int, step: float, rests: bool) -> float | None:
    """Return the probability of two equal readings by the noise on both sides of a run.

    None where there is no such noise, or where physics explains the run. A value at the end of those around
    it may be a limit, and 0 is what a stopped thing reads."""
    wide = b - a + 1
    sides = y[max(a - wide, 0) : a], y[b + 1 : b + 1 + wide]
    beside = np.concatenate(sides)
    beyond = min(np.sum(beside < y[a]), np.sum(beside > y[a]))
    if min(map(len, sides)) < FEW or y[a] == 0 or beyond <= WILD * len(beside):
        return None
    usual = max(float(np.abs(np.diff(side)).max()) for side in sides)
    if rests and abs(y[b + 1] - y[b]) <= JUMP * usual:
        return None
    noises = []
    for side in sides:
        rough = float(np.median(np.abs(np.diff(side, 3))))
        # A motion that is read six times a period or more has third differences below its second ones.
        if rough <= np.median(np.abs(np.diff(side, 2))):
            return None
        noises.append(1.4826 * rough / 20**0.5)  # those of white noise have 1 + 9 + 9 + 1 times its variance
    # Two readings with noise s are rounded to the same multiple of q with probability q / (2 sqrt(pi) s).
    return step / (2 * np.pi**0.5 * min(noises))
