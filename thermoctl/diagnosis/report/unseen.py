"""Detection limits: the smallest size of each effect that would show in the recordings after a refit.

    smallest = SEEN |p(s) - p(0)|,   s = 1 / |d'|

d' is the whitened first-order change of the outputs by the effect at s = 1, without the part that the plant's
own parameters absorb (screen.py). It depends on the plant, the inputs and the sensors, not on the readings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, as_refitted
from thermoctl.diagnosis.hypothesis.candidates import Candidate, candidates
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.diagnosis.search.gains import NEAR, parameter_values
from thermoctl.diagnosis.search.metric import Metric, Plain
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import Group, Norms, directions, groups_of, projected

SEEN = 5.0  # an effect shows if its size is this many standard errors
ABSORBED = 1e-4  # an effect is imitated if the projection leaves less than this share of its direction's norm
STILL = 1e-9  # an effect is not excited if its whitened direction has a smaller norm
NOT_EXCITED = "these inputs do not excite it"
IMITATED = "the plant's own parameters imitate it"
TOO_LARGE = "its largest size would not show"


@dataclass(frozen=True)
class Visible:
    """The smallest size of an effect at a place that would show; `reason`: why no size would.

    `moves`: the output that this size changes most relative to its span, the rms change before a refit, and
    that rms over the span."""

    candidate: Candidate
    parameter: str
    smallest: float
    reason: str | None = None
    moves: tuple[str, float, float] | None = None

    @property
    def unit(self) -> str | None:
        """The parameter's unit."""
        if not self.parameter:
            return None
        return self.candidate.extend({}).parameters[self.candidate.own(self.parameter)].unit

    def entry(self) -> dict[str, Any]:
        """Return the entry of `not_seen` in diagnosis.json."""
        effect, where = self.candidate.key
        smallest = float(f"{self.smallest:.4g}")
        return {
            "effect": effect,
            "where": where,
            "parameter": self.parameter,
            "smallest": smallest,
            "unit": self.unit,
        }


def not_seen(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return `not_seen` of a result: the smallest size of each effect that would have shown."""
    null = next(w.fitted for w in diagnosis.searched.tried if not w.fitted.hypothesis.effects)
    norms = [n for n in diagnosis.searched.norms if n.column.candidate.effect.sizes]
    seen = _best((n, None) for n in norms) if norms else visible(diagnosis.case, null)
    return [v.entry() for v in seen if v.reason is None]


def visible(case: Case, null: Fitted) -> list[Visible]:
    """Return the smallest visible size of every effect at every place, by effect and place.

    `null`: the refit of the plant alone. Of several variants and parameters the most visible one counts. The
    noise is that of the first screening."""
    metric = Metric(Plain(case, null.rough), as_refitted(case, null).average, True)
    rig = case.rig(null.rough_plant, metric.drives)
    trajectories = [Trajectory(metric, rig, r) for r in range(len(metric.drives))]
    placed = [c for c in candidates(rig, case.catalogue) if c.effect.sizes]
    return _best(_norms(metric, trajectories, (g for c in placed for g in groups_of(c, metric))))


Rms = Mapping[str, tuple[float, float]]
"""By output, the rms change that a direction causes at s = 1, and the output's span."""


def _best(norms: Iterable[tuple[Norms, Rms | None]]) -> list[Visible]:
    """Return the most visible size of each effect at each place."""
    best: dict[tuple[str, str], Visible] = {}
    for n, rms in norms:
        new = _visible(n, rms)
        old = best.get(new.candidate.key)
        if old is None or (new.reason is not None, new.smallest) < (old.reason is not None, old.smallest):
            best[new.candidate.key] = new
    return [best[key] for key in sorted(best)]


def _moves(rms: Rms, times: float) -> tuple[str, float, float]:
    name = max(rms, key=lambda o: rms[o][0] / rms[o][1])
    return name, times * rms[name][0], times * rms[name][0] / rms[name][1]


def _norms(
    metric: Metric, trajectories: Sequence[Trajectory], groups: Iterable[Group]
) -> Iterator[tuple[Norms, Rms]]:
    readings = np.concatenate([d.y for d in metric.drives])
    names = metric.model.outputs
    for part, plain in directions(metric, trajectories, groups):
        full, rows = projected(metric, plain)
        left = np.linalg.norm(rows, axis=0)
        energy = _energies(metric, plain)
        for k, (column, whole, size) in enumerate(zip(chain.from_iterable(part), full, left, strict=True)):
            rms = {
                names[j]: (float(e[k] / np.isfinite(readings[:, j]).sum()) ** 0.5, span)
                for j, e in energy.items()
                if (span := float(np.nanmax(readings[:, j]) - np.nanmin(readings[:, j]))) > 0
            }
            yield Norms(column, float(whole), float(size)), rms


def _energies(metric: Metric, plain: np.ndarray) -> dict[int, np.ndarray]:
    """Return the sum of squares (k,) of rows (rows, k), not whitened, by output."""
    energies: dict[int, np.ndarray] = {}
    begin = 0
    for c in metric.plain.coordinates.channels:
        energies[c.output] = energies.get(c.output, 0.0) + np.sum(plain[begin : begin + c.rows] ** 2, axis=0)
        begin += c.rows
    return energies


def _visible(n: Norms, rms: Rms | None) -> Visible:
    """Return the smallest visible size of a column, and the output that it moves most if `rms` is known."""
    c, shape, dim = n.column.candidate, n.column.shape, n.column.dim
    if n.whole < STILL:
        return Visible(c, "", np.inf, NOT_EXCITED)
    if n.left < ABSORBED * n.whole:
        return Visible(c, "", np.inf, IMITATED)
    times = SEEN / n.left  # the smallest size as a multiple of that at s = 1
    if any(p.amplitude for p in c.effect.sizes):
        absent = parameter_values(c, shape, [0.0 for _ in dim])
        values = parameter_values(c, shape, [times * v for v in dim])
        p = next(p for p in c.effect.sizes if values[p.name] != absent[p.name])
        smallest = abs(values[p.name] - absent[p.name])
        too_large = smallest > max(abs(np.array(c.bounds(p)) - absent[p.name]))
    else:
        # A lag, delay or dead zone: the outputs change in proportion to it near a value of the grid.
        times = max(times, 1 / NEAR)
        p = c.effect.sizes[0]
        smallest, too_large = shape[str(p.shape)] * times, n.left < SEEN
    if too_large:
        return Visible(c, p.name, smallest, TOO_LARGE)
    return Visible(c, p.name, smallest, moves=_moves(rms, times) if rms else None)
