"""Single outliers of recordings: readings that are far from their neighbours, and no answer of the plant."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.special import bdtrc

from thermoctl.diagnosis.data.rows import OUTLIER, switches
from thermoctl.plant.fitting.whitening import Noise
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.recording.table import Table

LEAST = 40  # least number of readings of an output in a recording: of fewer none is left out
RIGHT, SOON = 2, 10  # number of rows right after a switch; in which an answer of two rows may begin
CHANCE = 0.05  # chance of so many outliers right after switches, below which the plant answers there
TOLD = 6  # largest number of outliers' times that a note lists for a column

Outliers = tuple[tuple[str, str, tuple[float, ...]], ...]  # recording, column, times in s


def without_outliers(
    tables: Sequence[Table],
    plant: Plant,
    drives: Sequence[Excitation],
    residuals: Sequence[np.ndarray],
    as_stated: Sequence[np.ndarray],
    noise: Sequence[Noise],
) -> tuple[list[Table], Outliers]:
    """Return the recordings without cells whose residual is far from its neighbours', and these cells.

    Soon after an input switches, an error of two rows may be an answer to that. So may one at the end be, and
    one of a single row if more of these come right after switches than by chance.
    `as_stated`: residuals with the stated initial states. First readings that these predict are no outliers:
    their large residual is due to an initial state that the refit moved."""
    out, dropped = [], []
    for t, d, e, stated in zip(tables, drives, residuals, as_stated, strict=True):
        columns, after, soon = dict(t.columns), _after_switches(d, RIGHT), _after_switches(d, SOON)
        for j, o in enumerate(plant.outputs.values()):
            index = np.flatnonzero(np.isfinite(e[:, j]))
            if len(index) < LEAST:
                continue
            away = e[index, j] - _median_of_five(e[index, j])
            limit = OUTLIER * max(1.4826 * float(np.median(np.abs(away))), noise[j].sigma)
            predicted = np.logical_and.accumulate(np.abs(stated[index, j]) <= limit)
            far = (np.abs(away) > limit) & (_from_neighbours(e[index, j]) > limit) & ~predicted
            lasts = ~_lonely(e[index, j])
            lasts[:-1] &= soon[index[:-1]]  # nothing but a switch is answered so quickly
            odd = _without_answers(index[far & ~lasts], after)
            if len(odd) and far.sum() < 0.02 * len(index):
                columns[o.column] = columns[o.column].copy()
                columns[o.column][odd] = np.nan
                dropped.append((t.name, o.column, tuple(float(at) for at in t.t[odd] - t.t[0])))
        out.append(dataclasses.replace(t, columns=columns))
    return out, tuple(dropped)


def _after_switches(d: Excitation, rows: int) -> np.ndarray:
    """Return which rows (N,) are the first ones in which an input that switched may act."""
    after = np.zeros(len(d.t) + rows, bool)
    for u in d.u.T:
        after[np.add.outer(np.flatnonzero(switches(u)) + 1, np.arange(rows))] = True
    return after[: len(d.t)]


def _without_answers(odd: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the rows of outliers without those that the plant answers a switch with."""
    answers = after[odd]
    by_chance = bdtrc(float(answers.sum()) - 1, len(odd), after.mean()) if answers.any() else 1.0
    return odd[~answers] if by_chance <= CHANCE else odd


def _lonely(e: np.ndarray) -> np.ndarray:
    """Return which values are farther from both neighbours than these are from each other.

    An answer to a switch of an input lasts longer than a row. The first value has the next two for
    neighbours. Beyond the last one the line through the two before it goes on."""
    before, after = np.roll(e, 1), np.roll(e, -1)
    before[0], after[-1] = e[2], 3 * e[-2] - 2 * e[-3]
    away = np.minimum(np.abs(e - before), np.abs(e - after))
    return np.asarray(np.abs(before - after) < away)


def _from_neighbours(e: np.ndarray) -> np.ndarray:
    """Return how far each value is from the cubic through two neighbours on either side.

    The crest of a fast swing is far from the median of its neighbours, but not from such a curve. One of two
    wild values in a row is far from the curve that leaves out the other: the larger distance counts."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(e, 3, mode="symmetric"), 7)
    ahead = np.array([0.0, -0.3, 1.0, -1.0, 0.0, 0.5, -0.2])  # without the next value
    return np.asarray(np.maximum(np.abs(around @ ahead), np.abs(around @ ahead[::-1])))


def _median_of_five(e: np.ndarray) -> np.ndarray:
    """Return the median of each value and its two neighbours on either side; ends are mirrored."""
    # scipy.ndimage has it, and takes a tenth of a diagnosis' time until work starts
    around = np.lib.stride_tricks.sliding_window_view(np.pad(e, 2, mode="symmetric"), 5)
    return np.asarray(np.sort(around, axis=1)[:, 2])


def outlier_note(outliers: Outliers) -> str:
    """Return a sentence that lists the readings that were left out."""
    count = sum(len(times) for *_, times in outliers)
    places = []
    for recording, column, times in outliers:
        more = f" and {len(times) - TOLD} more" if len(times) > TOLD else ""
        at = ", ".join(f"{t:.6g}" for t in times[:TOLD])
        places.append(f"{column} in {recording} at {at}{more} s")
    return f"{count} single outlier{'s were' if count > 1 else ' was'} left out: {'; '.join(places)}"
