"""Periods of a reading's error that pass several times in a block of samples: screened above the blocks.

The screening sums blocks of samples, and keeps the lower half of their frequencies (coordinates.py). There an
error of the encoder that repeats faster vanishes. The plant's unknowns absorb nothing at such frequencies."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import chain

import numpy as np

from thermoctl.diagnosis.data.coordinates import Channel, Coordinates, transform
from thermoctl.diagnosis.hypothesis.candidates import Candidate
from thermoctl.diagnosis.search.gains import Column, Direction, scores
from thermoctl.diagnosis.search.metric import Metric
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import groups_of

TOGETHER = 16  # number of periods whose columns are transformed at a time: one by one takes twice as long
# A channel of all samples, and the weights of its highest rows, which the screening lacks.
Upper = tuple[Channel, np.ndarray]


def above(whole: Coordinates, inverse: Sequence[np.ndarray], screened: Coordinates) -> list[Upper]:
    """Return the channels that have rows above those of the screening. `inverse`: 1 / variance by band."""
    low = {(c.recording, c.output): c.rows for c in screened.channels}
    out = []
    for c, v in zip(whole.channels, inverse, strict=True):
        weight = np.sqrt(v)[c.band[low.get((c.recording, c.output), c.rows) :]]
        if weight.any():
            out.append((c, weight))
    return out


def fine(
    metric: Metric, trajectories: Sequence[Trajectory], c: Candidate, upper: Sequence[Upper]
) -> list[Direction]:
    """Return the best direction of a reading's periodic error, if any."""
    if not c.place.output or "periods" not in c.effect.shapes.values():
        return []
    j = list(c.rig.plant.outputs).index(c.place.output)
    own = [(channel, weight) for channel, weight in upper if channel.output == j]
    if not own:
        return []

    def rows(e: Sequence[np.ndarray]) -> np.ndarray:
        """Return the whitened highest rows of the output's values (N, ...) by recording."""
        return np.concatenate([(transform(k, e[k.recording])[-len(w) :].T * w).T for k, w in own])

    residual = rows([d.y[:, j] - run.y[:, j] for d, run in zip(metric.drives, metric.runs, strict=True)])
    found: list[Direction | None] = []
    groups = groups_of(c, metric)
    for some in (groups[k : k + TOGETHER] for k in range(0, len(groups), TOGETHER)):
        each = [list(g.columns()) for g in some]
        columns = list(chain.from_iterable(each))
        d = rows([_changed(columns, at, j) for at in trajectories])
        # all columns at once: a few that lie apart in memory take several times as long
        found += scores(each, d, d.T @ residual, np.linalg.norm(d, axis=0))
    best = min(filter(None, found), key=lambda d: d.log_p, default=None)
    return [dataclasses.replace(best, vector=None)] if best and best.gain > 0 else []


def _changed(columns: Sequence[Column], at: Trajectory, j: int) -> np.ndarray:
    """Return the changes (N, columns) of output j along a trajectory."""
    nothing = np.zeros(len(at.drive.t))
    return np.stack([q.changes(at)[1].get(j, nothing) for q in columns], axis=1)
