"""When a recording cannot be judged by a plant: nothing moves, it is of another rig, or one channel's clock is shifted.

A recording like that gets no name of a missing physics. What is found is said in words that a report can print.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnose.screen import Metric
from thermoctl.plant.refit import Fit, Noise
from thermoctl.plant.simulate import Excitation
from thermoctl.recording.table import Table

STILL = 6.0  # an output whose whole spread is below this many sigmas of its noise does not move
FOLLOWS = 0.3  # share of an output's variation that a plant of the right rig leaves at most, even one that lacks physics
BOUNDS = 0.5  # share of the parameters at their bounds from which the rig is doubted


def still(drives: Sequence[Excitation], noise: Sequence[Noise]) -> str | None:
    """No input moves and no output does: nothing of the plant is excited."""
    if any(np.ptp(d.u[:, j]) > 0 for d in drives for j in range(d.u.shape[1])):
        return None
    for j, n in enumerate(noise):
        if any(np.isfinite(d.y[:, j]).any() and _spread(d.y[:, j]) > STILL * n.sigma for d in drives):
            return None
    return (
        "no input of the plant changes in these recordings and no output moves: next to nothing is excited, so next to nothing "
        "could be seen missing; record a run with the inputs moved"
    )


def _spread(y: np.ndarray) -> float:
    low, high = np.nanquantile(y, [0.02, 0.98])
    return float(high - low)


def other_rig(
    fitted: Fit, recorded: Sequence[np.ndarray], excess: dict[str, float], large: float, own: Sequence[str]
) -> str | None:
    """A plant that does not follow even roughly, or whose parameters (`own`) end at their bounds. `recorded`: per recording
    (N, outputs); `excess`: residual over noise; `large`: excess up to which the fit is good whatever the rest says."""
    if max(excess.values(), default=0.0) <= large:
        return None
    stacked, left = np.concatenate(list(recorded)), np.concatenate(list(fitted.residuals))
    reasons = []
    for j, o in enumerate(fitted.model.outputs):
        if o in excess and excess[o] > large and (total := float(np.nanvar(stacked[:, j]))) > 0:
            share = float(np.nanmean(left[:, j] ** 2)) / total
            if share > FOLLOWS:
                reasons.append(f"{share:.0%} of the variation of {o} is left")
    ends = sorted(q for q in fitted.at_bound if q in own)
    free = [q for q, _ in fitted.unknowns if q in own]
    if len(ends) >= 3 and len(ends) >= BOUNDS * len(free):
        reasons.append(f"{len(ends)} of {len(free)} parameters end at their bounds ({', '.join(ends[:5])})")
    if not reasons:
        return None
    return (
        "the plant does not follow these recordings even roughly: "
        + "; ".join(reasons)
        + ". Are they of this rig, with these columns and units? No name is given to what is missing"
    )


@dataclasses.dataclass(frozen=True)
class Early:
    """A channel that runs ahead of the others by `seconds`, and the score that shifting it back would gain at first order."""

    output: str
    index: int
    seconds: float
    gain: float


def early(metric: Metric) -> Early | None:
    """The output that would gain most by being later: its residual follows its own slope. No sensor reads ahead of time, so
    no entry of the catalogue says this; a clock does."""
    best: Early | None = None
    for j, o in enumerate(metric.model.outputs):
        rows = []
        for r, (d, run) in enumerate(zip(metric.drives, metric.runs, strict=True)):
            slope = np.zeros_like(run.y)
            slope[:, j] = np.gradient(run.y[:, j], d.t)
            rows.append(metric.rows(r, np.where(np.isfinite(d.y), slope, 0.0)))
        direction = metric.project(np.concatenate(rows)[:, None])[:, 0]
        size = float(direction @ direction)
        if size <= 0:
            continue
        score = float(direction @ metric.residual)
        found = Early(o, j, score / size, score * score / size)
        if found.seconds > 0 and (best is None or found.gain > best.gain):
            best = found
    return best


def later(table: Table, column: str, seconds: float) -> Table:
    """The table with one column's samples `seconds` later: by whole samples, each used once, so that its noise stays what it
    is under a jittering clock; NaN where a gap lies between."""
    step = float(np.median(np.diff(table.t)))
    count = min(max(round(seconds / step), 0), len(table.t))
    values = np.full(len(table.t), np.nan)
    values[count:] = table.columns[column][: len(table.t) - count]
    values[count:][np.abs(table.t[count:] - table.t[: len(table.t) - count] - seconds) > 1.5 * step] = np.nan
    return dataclasses.replace(table, columns={**table.columns, column: values})
