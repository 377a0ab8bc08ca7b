"""Periods of a reading's error that pass several times in a block of samples: screened above the blocks.

The screening sums blocks of samples, and keeps the lower half of their frequencies (coordinates.py). There an
error of the encoder that repeats faster vanishes. The plant's unknowns absorb nothing at such frequencies."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.data.coordinates import Channel, Coordinates, transform
from thermoctl.diagnosis.hypothesis.candidates import Candidate
from thermoctl.diagnosis.search.gains import Direction, score
from thermoctl.diagnosis.search.metric import Metric
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import groups_of

# A channel of all samples, and the weights of its rows: 0 for the rows that the screening has.
Upper = tuple[Channel, np.ndarray]


def above(whole: Coordinates, inverse: Sequence[np.ndarray], screened: Coordinates) -> list[Upper]:
    """Return the channels that have rows above those of the screening. `inverse`: 1 / variance by band."""
    low = {(c.recording, c.output): c.rows for c in screened.channels}
    out = []
    for c, v in zip(whole.channels, inverse, strict=True):
        weight = np.sqrt(v)[c.band]
        weight[: low.get((c.recording, c.output), c.rows)] = 0.0
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
        """Return whitened rows of the output's values (N, ...) by recording."""
        return np.concatenate([(transform(k, e[k.recording]).T * w).T for k, w in own])

    residual = rows([d.y[:, j] - run.y[:, j] for d, run in zip(metric.drives, metric.runs, strict=True)])
    best: dict[int, Direction] = {}
    for g in groups_of(c, metric):
        columns = list(g.columns())
        changed = [
            [q.changes(at)[1].get(j, np.zeros(len(at.drive.t))) for q in columns] for at in trajectories
        ]
        d = rows([np.stack(part, axis=1) for part in changed])
        score(columns, d, d.T @ residual, np.linalg.norm(d, axis=0), best)
    return [dataclasses.replace(d, vector=None) for d in best.values() if d.gain > 0]
