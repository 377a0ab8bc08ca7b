"""Score test of every effect at every place: how much of the residual it could explain, without a refit.

    r: whitened residual of the refit, the starts moved back to their priors' means
    d: first-order change of the outputs by an effect, whitened
    r', d': the same without what the plant's unknowns absorb (metric.py)
    gain = (d'^T r')^2 / (d'^T d')

The gain is chi-square with one degree of freedom (k for k amplitudes) where nothing is missing.
d comes from the effect laid over the plant. Its change of dx/dt along the fitted trajectory drives the
linearised plant (`Model.respond`). Its change of the outputs adds directly. New nodes are integrated
alone along that trajectory. Rows are sums over blocks of samples: white noise stays white, and thousands
of directions fit in memory.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import gammaincc

from thermoctl.diagnose.candidates import Candidate
from thermoctl.diagnose.catalogue import EffectParameter
from thermoctl.diagnose.metric import Metric, Pushed
from thermoctl.diagnose.onsets import ONSETS
from thermoctl.diagnose.overlay import Overlay, Trajectory
from thermoctl.diagnose.rig import Rig
from thermoctl.diagnose.shapes import shape_grid
from thermoctl.plant import expression as ex
from thermoctl.plant.cores import ABREAST, LEAST, each

EPSILON = 1e-4  # amplitude at which a direction is taken
CHUNK = 96
EXACT = 4_000  # columns, up to which all are simulated
DECADES = 3.0  # up and down from one unit: where quotients of amplitudes are looked for
NEAR = 4.0  # factor about the screened lag or delay within which the outputs change in proportion


@dataclass
class Direction:
    """One candidate at one shape: how much it would explain and where its refit should start."""

    candidate: Candidate
    shape: dict[str, float]
    gain: float
    dims: int
    start: dict[str, float]
    vector: np.ndarray | None = None  # unit vector of the projected direction
    excited: float = 0.0  # share of the direction that the plant's own parameters leave
    elsewhere: float = 0.0  # log10 of how many shapes this one was picked from by the residual itself

    @property
    def log_p(self) -> float:
        """log10 of the chance of such a gain where nothing is missing."""
        return log_p(self.gain, self.dims) + self.elsewhere


def log_p(gain: float, dims: int) -> float:
    """log10 of the chi-square tail, also where that is too small for a float."""
    return float(_log_p(np.asarray(gain), dims))


def _log_p(gain: np.ndarray, dims: int) -> np.ndarray:
    with np.errstate(divide="ignore"):
        value = np.log10(gammaincc(0.5 * dims, 0.5 * np.maximum(gain, 0.0)))
    return np.where(
        np.isfinite(value), value, -(gain - (dims - 2) * np.log(np.maximum(gain, 1.0))) / (2 * np.log(10))
    )


@dataclass(frozen=True)
class Column:
    """A direction to be built: an effect at one shape, along one of its amplitudes.

    item = (candidate, group, (shape, dim), columns in the group); `scale`: over the amplitude in `values`."""

    item: tuple[Any, ...]
    overlay: Callable[[], Overlay]
    values: Mapping[str, float]
    scale: float

    def changes(self, at: Trajectory) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
        """Return its forces by state and its changes of outputs along a trajectory, all numbers finite."""
        try:
            parts = self.overlay().changes(self.values, at)
        except (KeyError, ex.ExpressionError):
            return {}, {}
        forces, outputs = (
            {k: _finite(v * self.scale) for k, v in part.items() if np.any(v)} for part in parts
        )
        return forces, outputs


def _finite(v: np.ndarray) -> np.ndarray:
    return np.nan_to_num(v, nan=0.0, posinf=0.0, neginf=0.0)


Entry = tuple[Column, np.ndarray, float]  # its projected rows, and the norm of the whole ones


def directions(
    metric: Metric, at: Sequence[Trajectory], columns: Iterable[Column]
) -> Iterator[tuple[Sequence[Column], np.ndarray]]:
    """Yield rows (rows, k) of columns, not whitened, a chunk at a time."""
    left = iter(columns)
    while parts := [p for _ in range(ABREAST) if (p := list(itertools.islice(left, CHUNK)))]:
        rows = each(lambda p: metric.responses(partial(_pushed, p, at), len(p)), parts, LEAST * len(parts))
        yield from zip(parts, rows, strict=True)


def _pushed(part: Sequence[Column], at: Sequence[Trajectory], r: int) -> Pushed:
    """Return the first-order changes by columns in recording r."""
    forces: list[tuple[int, int]] = []
    values: list[np.ndarray] = []
    changed: dict[tuple[int, int], np.ndarray] = {}
    for c, column in enumerate(part):
        pushed, read = column.changes(at[r])
        forces += [(state, c) for state in pushed]
        values += pushed.values()
        changed |= {(j, c): delta for j, delta in read.items()}
    return Pushed(forces, np.stack(values, axis=1) if values else np.zeros((0, 0)), changed)


@dataclass(frozen=True)
class Norms:
    """A column that was simulated, the norm of its whitened rows, and that of their projection."""

    column: Column
    whole: float
    left: float


Select = Callable[[Sequence[Metric], Sequence[Trajectory], list["Group"]], list["Group"]]


def screen(
    metrics: Sequence[Metric],
    rig: Rig,
    found: Sequence[Candidate],
    edges: np.ndarray | None = None,
    select: Select = lambda metrics, at, groups: groups,
    norms: list[Norms] | None = None,
) -> list[list[Direction]]:
    """Return every candidate's best direction, best first, in each of the metrics.

    The metrics share a fit and differ only in their weights. `edges`: onsets to try instead of the grid.
    Of more than EXACT columns, `select` chooses the groups that are simulated (sketch.py). `norms` receives
    those of the first metric, if all columns are simulated."""
    first = metrics[0]
    at = [Trajectory(first, rig, r) for r in range(len(first.drives))]
    groups = [g for c in found for g in groups_of(c, first, edges)]
    if sum(len(g.sizes) for g in groups) > EXACT:
        groups, norms = select(metrics, at, groups), None
    best: list[dict[int, Direction]] = [{} for _ in metrics]
    pending: dict[tuple[Any, ...], list[Entry]] = {}
    columns = (column for g in groups for column in g.columns())
    for part, plain in directions(first, at, columns):
        for metric, leaders in zip(metrics, best, strict=True):
            rows = plain * metric.weight[:, None]
            full = np.linalg.norm(rows, axis=0)
            rows = metric.project(rows)
            if metric is first and norms is not None:
                left = np.linalg.norm(rows, axis=0)
                norms += [Norms(*n) for n in zip(part, map(float, full), map(float, left), strict=True)]
            for k, column in enumerate(part):
                candidate, group, _, count = column.item
                key = (id(metric), id(candidate), group)
                entries = pending.setdefault(key, [])
                entries.append((column, rows[:, k].copy(), float(full[k])))
                if len(entries) == count:
                    del pending[key]
                    _score_rows(entries, metric, leaders)
    return [sorted(leaders.values(), key=lambda d: d.log_p) for leaders in best]


def sharpened(metric: Metric, rig: Rig, found: Direction) -> Direction:
    """Return the direction with its onset (or start and end) refined to the sample.

    A refit cannot move them: a jump has no slope to follow. Each step's grid is four times as fine."""
    kinds = found.candidate.effect.shapes.values()
    if "onsets" not in kinds and "windows" not in kinds:
        return found
    duration = max(float(d.t[-1]) for d in metric.drives)
    step, sample = duration / ONSETS, min(float(np.median(np.diff(d.t))) for d in metric.drives)
    while step > 0.5 * sample:
        near = np.concatenate(
            [
                found.shape[k] + step * np.arange(-4, 5) / 4
                for k in ("onset", "start", "end")
                if found.shape.get(k, np.inf) <= duration
            ]
        )
        (better,) = screen([metric], rig, [found.candidate], np.unique(near[(near >= 0) & (near < duration)]))
        if better and better[0].gain > found.gain:
            found = better[0]
        step /= 4
    return found


@dataclass(frozen=True)
class Group:
    """The columns of an effect at a place that are scored together: amplitudes at one shape, or onsets.

    `sizes`: shape and direction in the amplitudes of each column. `overlay` of the candidate, made once."""

    candidate: Candidate
    number: Any
    sizes: tuple[tuple[dict[str, float], tuple[float, ...]], ...]
    overlay: Callable[[], Overlay]

    def columns(self) -> Iterator[Column]:
        """Yield the columns."""
        c = self.candidate
        scale = 1 / EPSILON if any(p.amplitude for p in c.effect.parameters) else 1.0
        for shape, dim in self.sizes:
            own = {c.own(k): v for k, v in _values(c, shape, dim).items()}
            yield Column((c, self.number, (shape, dim), len(self.sizes)), self.overlay, own, scale)


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
        duration = max(float(d.t[-1]) for d in metric.drives)
        grids["window"] = [
            {"start": float(v), "end": 10 * duration}
            for v in (np.linspace(0, duration, ONSETS + 1)[:-1] if edges is None else edges)
        ]
    phases = [{"phase": 0.0}, {"phase": float(np.pi / 2)}] if "phases" in effect.shapes.values() else [{}]
    shapes = [
        {k: v for part in combination for k, v in part.items()}
        for combination in itertools.product(*grids.values())
    ] or [{}]
    dims = effect.dims if any(p.amplitude for p in effect.parameters) else ((1.0,),)
    sizes = [tuple(({**shape, **phase}, dim) for dim in dims for phase in phases) for shape in shapes]
    if windowed:
        sizes = [tuple(s for part in sizes for s in part)]

    @cache
    def overlay() -> Overlay:  # of every group: only the values differ
        return Overlay(c.rig.plant, c.extend(_values(c, *sizes[0][0])))

    return [Group(c, ("all",) if windowed else (g,), part, overlay) for g, part in enumerate(sizes)]


def parameter_values(c: Candidate, shape: Mapping[str, float], s: Sequence[float]) -> dict[str, float]:
    """The effect's parameters at amplitudes s and a shape."""
    known = {
        "s": s[0] if len(s) else 0.0,
        **{f"s{k + 1}": v for k, v in enumerate(s) if k},
        **shape,
        "first_air": c.rig.first_air(c.rig.drives[0]),
    }
    out = {}
    for p in c.effect.parameters:
        if p.shape:
            out[p.name] = float(shape.get(p.shape, p.null))
        elif p.trial is not None:
            value = float(ex.evaluate(p.trial, known))
            out[p.name] = value if np.isfinite(value) else p.null
        else:
            out[p.name] = p.null
    return out


def _score_rows(entries: Sequence[Entry], metric: Metric, best: dict[int, Direction]) -> None:
    """Score the columns of one group, and keep their best direction."""
    rows = np.stack([e[1] for e in entries], axis=1)
    full = np.array([e[2] for e in entries])
    score([e[0] for e in entries], rows, rows.T @ metric.residual, full, best)


def score(
    columns: Sequence[Column], rows: np.ndarray, g: np.ndarray, full: np.ndarray, best: dict[int, Direction]
) -> None:
    """Score the columns of one group, and keep their best direction if it is the candidate's best so far.

    - `rows` (rows, k): projected; only their products count, so sketched ones will do
    - `g` (k,): products with the residual; `full` (k,): norms of the whole rows"""
    c, m = columns[0].item[0], rows.T @ rows
    if "windows" in c.effect.shapes.values():
        _score_windows(c, columns, rows, full, g, m, best)
        return
    left = np.sqrt(np.maximum(np.diag(m), 0)) / np.maximum(full, 1e-300)
    useful = (left > 1e-4) & (full > 1e-9)
    if not useful.any():
        return
    scale = np.where(useful, np.sqrt(np.maximum(np.diag(m), 1e-300)), 1.0)
    sub = m[np.ix_(useful, useful)] / np.outer(scale[useful], scale[useful])
    coefficient = np.zeros(len(g))
    inverse = 1 / sub if len(sub) == 1 else np.linalg.pinv(sub, rcond=1e-8, hermitian=True)
    inverse = inverse / np.outer(scale[useful], scale[useful])
    coefficient[useful] = inverse @ g[useful]
    shape, _ = columns[0].item[2]
    if c.effect.prior is not None:
        told = [q for q, u in zip(columns, useful, strict=True) if u]
        coefficient[useful] = _plausible(c, told, coefficient[useful], inverse)
    gain = float(2 * g @ coefficient - coefficient @ m @ coefficient)
    if len(g) == 1 and not _possible(c, columns[0], float(coefficient[0])):
        gain = 0.0
    shape, s = _sizes(c, columns, shape, coefficient)
    _keep(
        best,
        Direction(c, shape, gain, int(useful.sum()), {}, None, float(left[useful].max())),
        s,
        lambda: rows @ coefficient,
    )


def _plausible(
    c: Candidate, columns: Sequence[Column], coefficient: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Return coefficients whose amplitudes are likely by the catalogue's prior, and fit as well as may be.

    The other amplitudes are products with the first. Where the plant absorbs that one alone, the data leave
    its size and its sign open, and only the prior of the others tells it."""
    shape, _ = columns[0].item[2]
    dims = np.array([q.item[2][1] for q in columns])  # (columns, amplitudes)
    step = covariance @ dims[:, 0]
    size, variance = float(dims[:, 0] @ coefficient), float(dims[:, 0] @ step)
    typical, prior = float(np.abs(dims.T @ coefficient)[1:].max(initial=0.0)), c.effect.prior
    if variance <= 0 or typical <= 0 or prior is None:
        return coefficient
    known = {"first_air": c.rig.first_air(c.rig.drives[0]), "duration": c.rig.duration}

    def at(log_size: float) -> np.ndarray:
        return np.asarray(coefficient + step * (np.exp(log_size) - size) / variance)

    def surprise(log_size: float) -> float:
        sizes = dims.T @ at(log_size)
        values = {**parameter_values(c, shape, list(sizes)), **known}
        unlikely = float(ex.evaluate(prior, values)) + 2 * (len(sizes) - 1) * log_size
        return float((np.exp(log_size) - size) ** 2 / variance + unlikely)

    reach = np.log(typical) + np.log(10.0) * np.array([-DECADES, DECADES])
    return at(float(minimize_scalar(surprise, bounds=tuple(reach), method="bounded").x))


def _possible(c: Candidate, column: Column, coefficient: float) -> bool:
    """Return whether the catalogue allows the size of a direction that has only one."""
    amplitudes = [p for p in c.effect.parameters if p.amplitude]
    shape, _ = column.item[2]
    if amplitudes:
        return _allowed(amplitudes[0], coefficient)
    if "tau" in shape and (column.item[1] != (0,) or (c.jumps and not c.variant)):
        # in proportion only from one lag of the grid to the next
        return 1 / NEAR < coefficient < NEAR
    return coefficient > 0


def _sizes(
    c: Candidate, columns: Sequence[Column], shape: dict[str, float], coefficient: np.ndarray
) -> tuple[dict[str, float], list[float]]:
    """Return the shape and the amplitudes at the best coefficients of the columns."""
    if "phases" in c.effect.shapes.values():
        phase = float(np.arctan2(coefficient[1], coefficient[0]))
        return {**shape, "phase": phase}, [float(np.hypot(*coefficient))]
    if any(p.amplitude for p in c.effect.parameters):
        return shape, list(np.array([q.item[2][1] for q in columns]).T @ coefficient)
    factor = float(np.clip(coefficient[0], 1e-3, 5.0))  # a short lag changes the outputs in proportion
    return {k: v * factor if k == "tau" else v for k, v in shape.items()}, [1.0]


def _score_windows(
    c: Candidate,
    columns: Sequence[Column],
    rows: np.ndarray,
    full: np.ndarray,
    g: np.ndarray,
    m: np.ndarray,
    best: dict[int, Direction],
) -> None:
    """Keep the best pair of a start and an end; an end beyond the last column is that of the recording."""
    edges = [q.item[2][0]["start"] for q in columns]
    last, floor = len(edges), 1e-12 * float(full.max()) ** 2
    gain, at = -1.0, (0, 0, 0.0)
    for a in range(last):
        for b in range(a + 1, last + 1):
            top = g[a] - g[b] if b < last else g[a]
            bottom = m[a, a] + m[b, b] - 2 * m[a, b] if b < last else m[a, a]
            if bottom > floor and top * top / bottom > gain:
                gain, at = top * top / bottom, (a, b, top / bottom)
    if gain < 0:
        return
    a, b, amplitude = at
    # Heat that ends and a lack of heat that starts differ by a constant, which parameters absorb.
    # The lack is likelier.
    if a == 0 and b < last and m[b, b] > floor and g[b] ** 2 / m[b, b] > 0.8 * gain:
        a, b, amplitude = b, last, g[b] / m[b, b]
        gain = g[a] ** 2 / m[a, a]
    shape = {"start": edges[a], "end": edges[b] if b < last else 10 * edges[-1]}
    vector = rows[:, a] - (rows[:, b] if b < last else 0)
    excited = float(np.linalg.norm(vector)) / max(full[a], 1e-300)
    _keep(best, Direction(c, shape, gain, 1, {}, None, excited), [amplitude], lambda: vector)


def _allowed(p: EffectParameter, coefficient: float) -> bool:
    assert p.trial is not None  # an amplitude has one
    at = float(ex.evaluate(p.trial, {"s": coefficient, "tau": 1.0, "first_air": 0.0}))
    return (
        p.low - 1e-12 <= at <= p.high + 1e-12
        or (p.low < p.null < p.high)
        or (coefficient > 0 if p.low >= p.null else coefficient < 0 if p.high <= p.null else True)
    )


def _keep(
    best: dict[int, Direction], new: Direction, sizes: Sequence[float], along: Callable[[], np.ndarray]
) -> None:
    """Keep a direction if it is its candidate's best so far. Only then `along` computes its rows."""
    shape = {k: v for k, v in new.shape.items() if k != "picked_from"}
    new = dataclasses.replace(new, elsewhere=float(np.log10(new.shape.get("picked_from", 1.0))))
    old = best.get(id(new.candidate))
    if old is None or new.log_p < old.log_p:
        vector = along()
        size = float(np.linalg.norm(vector))
        best[id(new.candidate)] = dataclasses.replace(
            new,
            shape=shape,
            start=parameter_values(new.candidate, new.shape, sizes),
            vector=(vector / size).astype(np.float32) if size > 0 else None,
        )
