"""Score test of every effect at every place: how much of the residual it could explain, without a refit.

    r: whitened residual of the refit, with initial states at the means of their priors
    d: first-order change of the outputs by an effect, whitened
    r', d': r and d after projection, without the part that the plant's unknowns absorb (metric.py)
    gain = (d'^T r')^2 / (d'^T d')

The gain is chi-square with one degree of freedom (k for k amplitudes) where nothing is missing.
d is computed from the plant with a small effect. Its change of dx/dt along the fitted trajectory drives the
linearised plant (`Model.respond`). Its change of the outputs is added. New nodes are integrated alone along
that trajectory. Rows are sums over blocks of samples: white noise stays white, and thousands of directions
fit in memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np

from thermoctl.diagnosis.evidence.onsets import ONSETS, TIMES
from thermoctl.diagnosis.hypothesis.candidates import EVENTS, Candidate
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.search.gains import Column, Direction, parameter_values, scores
from thermoctl.diagnosis.search.metric import Metric, Pushed
from thermoctl.diagnosis.search.overlay import Overlay, Trajectory
from thermoctl.diagnosis.search.shapes import COARSER, shape_grid
from thermoctl.plant.fitting.cores import ABREAST, each

EPSILON = 1e-4  # amplitude of an effect at which its first-order change is computed
CHUNK = 96  # columns that are simulated at a time

T = TypeVar("T")


def directions(
    metric: Metric, trajectories: Sequence[Trajectory], groups: Iterable[Group]
) -> Iterator[tuple[list[list[Column]], np.ndarray]]:
    """Yield the columns of some groups, by group, and their rows (rows, k), not whitened."""
    left = chunks((list(g.columns()) for g in groups), len, CHUNK)
    while parts := list(itertools.islice(left, ABREAST)):
        flat = [list(itertools.chain.from_iterable(part)) for part in parts]
        rows = each(lambda p: metric.responses(partial(_pushed, p, trajectories), len(p)), flat)
        yield from zip(parts, rows, strict=True)


def chunks(items: Iterable[T], size: Callable[[T], int], least: int) -> Iterator[list[T]]:
    """Yield the items in lists whose sizes sum to `least` or more; the last one may be smaller."""
    part: list[T] = []
    for item in items:
        part.append(item)
        if sum(map(size, part)) >= least:
            yield part
            part = []
    if part:
        yield part


def _pushed(part: Sequence[Column], trajectories: Sequence[Trajectory], r: int) -> Pushed:
    """Return the first-order changes that the columns of a part cause in recording r."""
    forces: list[tuple[int, int]] = []
    values: list[np.ndarray] = []
    changed: dict[tuple[int, int], np.ndarray] = {}
    for c, column in enumerate(part):
        pushed, read = column.changes(trajectories[r])
        forces += [(state, c) for state in pushed]
        values += pushed.values()
        changed |= {(j, c): delta for j, delta in read.items()}
    return Pushed(forces, np.stack(values, axis=1) if values else np.zeros((0, 0)), changed)


@dataclass(frozen=True)
class Norms:
    """A simulated column; the norm of its whitened rows before (`whole`) and after projection (`left`)."""

    column: Column
    whole: float
    left: float


def projected(metric: Metric, plain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the norms (k,) of whitened rows, and these rows (rows, k) after projection."""
    rows = plain * metric.weight[:, None]
    return np.linalg.norm(rows, axis=0), np.asfortranarray(metric.project(rows))


Keep = Callable[[Sequence[Sequence[Column]], np.ndarray], None]
Select = Callable[[Sequence[Metric], Sequence[Trajectory], list["Group"]], list["Group"]]


def screen(
    metrics: Sequence[Metric],
    rig: Rig,
    placed: Sequence[Candidate],
    edges: np.ndarray | None = None,
    select: Select = lambda metrics, trajectories, groups: groups,
    norms: list[Norms] | None = None,
    keep: Keep | None = None,
) -> list[list[Direction]]:
    """Return every candidate's best direction, best first, in each of the metrics.

    The metrics share a fit and differ only in their weights. `edges`: onsets to try instead of the grid.
    `select` chooses the groups that are simulated (sketch.py, again.py). If it chooses all, the norms of the
    columns in the first metric are appended to `norms`. Then `keep` receives groups of columns with rows."""
    first = metrics[0]
    trajectories = [Trajectory(first, rig, r) for r in range(len(first.drives))]
    groups = [g for c in placed for g in groups_of(c, first, edges)]
    every, groups = len(groups), select(metrics, trajectories, groups)
    if len(groups) < every:
        norms = None
    best: list[dict[int, Direction]] = [{} for _ in metrics]
    for part, plain in directions(first, trajectories, groups):
        if norms is not None and keep:
            keep(part, plain)
        for metric, leaders in zip(metrics, best, strict=True):
            full, rows = projected(metric, plain)
            if metric is first and norms is not None:
                columns, left = itertools.chain.from_iterable(part), np.linalg.norm(rows, axis=0)
                norms += map(Norms, columns, map(float, full), map(float, left))
            for d in filter(None, scores(part, rows, metric.residual @ rows, full)):
                old = leaders.get(id(d.candidate))
                if old is None or d.log_p < old.log_p:
                    leaders[id(d.candidate)] = d
    return [sorted(leaders.values(), key=lambda d: d.log_p) for leaders in best]


def sharpened(metric: Metric, rig: Rig, direction: Direction) -> Direction:
    """Return the direction with its onset (or start and end) refined to the sample.

    A refit cannot move them: a jump has no derivative by its time. Each grid is four times finer than the
    one before."""
    if EVENTS.isdisjoint(direction.candidate.effect.shapes.values()):
        return direction
    step = rig.duration / ONSETS * (COARSER if direction.candidate.begins else 1)
    while step > 0.5 * rig.sample:
        near = np.concatenate(
            [
                direction.shape[k] + step * np.arange(-4, 5) / 4
                for k in TIMES
                if direction.shape.get(k, np.inf) <= rig.duration
            ]
        )
        (better,) = screen(
            [metric], rig, [direction.candidate], np.unique(near[(near >= 0) & (near < rig.duration)])
        )
        if better and better[0].gain > direction.gain:
            direction = better[0]
        step /= 4
    return direction


@dataclass(frozen=True)
class Group:
    """The columns of an effect at a place that are scored together: amplitudes at one shape, or onsets.

    `sizes`: shape, direction in the amplitudes and recording of each column. `overlay`: returns
    the candidate's Overlay, which is built once."""

    candidate: Candidate
    number: Any
    sizes: tuple[tuple[dict[str, float], tuple[float, ...], str], ...]
    overlay: Callable[[], Overlay]

    def columns(self) -> Iterator[Column]:
        """Yield the columns."""
        c = self.candidate
        scale = 1 / EPSILON if any(p.amplitude for p in c.effect.parameters) else 1.0
        for shape, dim, recording in self.sizes:
            own = {c.own(k): v for k, v in _values(c, shape, dim).items()}
            yield Column(c, self.number, shape, dim, recording, self.overlay, own, scale)


def _values(c: Candidate, shape: Mapping[str, float], dim: Sequence[float]) -> dict[str, float]:
    return parameter_values(c, shape, [EPSILON * v for v in dim])


def groups_of(c: Candidate, metric: Metric, edges: np.ndarray | None = None) -> list[Group]:
    """Return the groups of columns that one candidate needs. `edges`: onsets to try instead of the grid."""
    effect = c.effect
    grids = {
        key: shape_grid(kind, c, metric.runs)
        if edges is None or kind != "onsets"
        else [{"onset": float(v)} for v in edges]
        for key, kind in effect.shapes.items()
        if kind not in ("phases", "windows")
    }
    windowed = "windows" in effect.shapes.values()
    if windowed:
        duration, count = c.rig.duration, ONSETS // (COARSER if c.begins else 1)
        grids["window"] = [
            {"start": float(v), "end": 10 * duration}
            for v in (np.linspace(0, duration, count + 1)[:-1] if edges is None else edges)
        ]
    phases = [{"phase": 0.0}, {"phase": float(np.pi / 2)}] if "phases" in effect.shapes.values() else [{}]
    shapes = [
        {k: v for part in combination for k, v in part.items()}
        for combination in itertools.product(*grids.values())
    ] or [{}]
    dims = effect.dims if any(p.amplitude for p in effect.parameters) else ((1.0,),)
    names = [d.name for d in c.rig.drives[not c.rig.earlier :]]
    only = names if any(p.from_first for p in effect.parameters) else [""]
    sizes = [
        tuple(({**shape, **phase}, dim, r) for dim in dims for phase in phases for r in only)
        for shape in shapes
    ]
    if windowed:
        sizes = [tuple(s for part in sizes for s in part)]

    @cache
    def overlay() -> Overlay:
        """Return the parts of the plant that the candidate changes: the groups share them."""
        return Overlay(c.rig.plant, c.extend(_values(c, *sizes[0][0][:2])))

    return [Group(c, ("all",) if windowed else (g,), part, overlay) for g, part in enumerate(sizes)]
