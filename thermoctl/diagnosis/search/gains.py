"""The gain of an effect from its first-order change of the outputs, and the sizes at which it is largest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincc

from thermoctl.diagnosis.hypothesis.candidates import Candidate
from thermoctl.diagnosis.hypothesis.effect import EffectParameter
from thermoctl.diagnosis.search.overlay import Overlay, Trajectory
from thermoctl.plant import expression as ex

PLACES_EACH = 3  # largest number of places of one effect in a shortlist, so that other effects have room
DECADES = 3.0  # range in which the first amplitude is searched, either way from the size of the others
NEAR = 4.0  # within this factor of the screened lag or delay the outputs change in proportion to it


@dataclass
class Direction:
    """One candidate at one shape: how much it would explain and where its refit should start."""

    candidate: Candidate
    shape: dict[str, float]
    gain: float
    dims: int
    start: dict[str, float]
    vector: np.ndarray | None = None  # unit vector of the projected direction
    elsewhere: float = 0.0  # log10 of the number of shapes from which the residual itself picked this one

    @property
    def log_p(self) -> float:
        """log10 of the probability of such a gain if nothing is missing."""
        return log_p(self.gain, self.dims) + self.elsewhere


def once(directions: Iterable[Direction]) -> list[Direction]:
    """Return the first direction of each candidate."""
    first: dict[tuple[str, str], Direction] = {}
    for d in directions:
        first.setdefault(d.candidate.key, d)
    return list(first.values())


def foremost(directions: Iterable[Direction], places: int) -> list[Direction]:
    """Return the directions at the first `places` places of each effect."""
    seen: dict[str, set[str]] = {}
    out = []
    for d in directions:
        effect, where = d.candidate.key
        used = seen.setdefault(effect, set())
        if where in used or len(used) < places:
            used.add(where)
            out.append(d)
    return out


def log_p(gain: float, dims: int) -> float:
    """Return log10 of the chi-square tail probability, also where that is too small for a float."""
    tail = float(gammaincc(0.5 * dims, 0.5 * max(gain, 0.0)))
    if tail > 0:
        return math.log10(tail)
    return -(gain - (dims - 2) * math.log(max(gain, 1.0))) / (2 * math.log(10))


@dataclass(frozen=True)
class Column:
    """The recipe of a direction: an effect at one shape, along one direction `dim` of its amplitudes.

    `group`: its group of the candidate. `recording`: the only one that it changes; "": all. `values`: the
    plant's parameters with a small amplitude; `scale`: the factor from the change at this amplitude to that
    at amplitude 1."""

    candidate: Candidate
    group: Any
    shape: dict[str, float]
    dim: tuple[float, ...]
    recording: str
    overlay: Callable[[], Overlay]
    values: Mapping[str, float]
    scale: float

    def changes(self, trajectory: Trajectory) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
        """Return its forces by state and its changes of outputs along a trajectory, all numbers finite."""
        elsewhere = self.recording and self.recording != trajectory.drive.name
        if elsewhere or self.candidate.begins.get(trajectory.drive.name, 0.0) < 0:
            return {}, {}  # or an event that comes later
        try:
            parts = self.overlay().changes(self.values, trajectory)
        except (KeyError, ex.ExpressionError):
            return {}, {}
        forces, outputs = (
            {k: _finite(v * self.scale) for k, v in part.items() if np.any(v)} for part in parts
        )
        return forces, outputs


def _finite(v: np.ndarray) -> np.ndarray:
    return v if np.isfinite(v @ v) else np.nan_to_num(v, nan=0.0, posinf=0.0, neginf=0.0)


def parameter_values(c: Candidate, shape: Mapping[str, float], s: Sequence[float]) -> dict[str, float]:
    """Return the values of the effect's parameters at amplitudes s and a shape."""
    values = {
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
            value = float(ex.evaluate(p.trial, values))
            out[p.name] = value if np.isfinite(value) else p.null
        else:
            out[p.name] = p.null
    return out


def scores(
    groups: Sequence[Sequence[Column]], rows: np.ndarray, g: np.ndarray, full: np.ndarray
) -> list[Direction | None]:
    """Return the best direction of each group of columns; None where the unknowns absorb all of them.

    - `rows` (rows, k): the columns after projection, or sketches with about the same inner products
    - `g` (k,): products of the columns with the residual; `full` (k,): norms of the columns before
      projection"""
    edges = np.cumsum([len(columns) for columns in groups])[:-1]
    parts = (np.split(x, edges, axis=-1) for x in (rows, g, full))
    return [_score(*part) for part in zip(groups, *parts, strict=True)]


def _score(columns: Sequence[Column], rows: np.ndarray, g: np.ndarray, full: np.ndarray) -> Direction | None:
    """Return the best direction of the columns of one group; arguments as of `scores`."""
    c, m = columns[0].candidate, rows.T @ rows
    if "windows" in c.effect.shapes.values():
        return _score_windows(columns, rows, full, g, m)
    left = np.sqrt(np.maximum(np.diag(m), 0)) / np.maximum(full, 1e-300)
    useful = (left > 1e-4) & (full > 1e-9)
    if not useful.any():
        return None
    scale = np.where(useful, np.sqrt(np.maximum(np.diag(m), 1e-300)), 1.0)
    sub = m[np.ix_(useful, useful)] / np.outer(scale[useful], scale[useful])
    coefficient = np.zeros(len(g))
    inverse = 1 / sub if len(sub) == 1 else np.linalg.pinv(sub, rcond=1e-8, hermitian=True)
    inverse = inverse / np.outer(scale[useful], scale[useful])
    coefficient[useful] = inverse @ g[useful]
    if c.effect.prior is not None:
        useful_columns = [q for q, u in zip(columns, useful, strict=True) if u]
        coefficient[useful] = _plausible(useful_columns, coefficient[useful], inverse)
    if len(g) == 1:
        coefficient[0] = _within(columns[0], float(coefficient[0]))
    gain = float(2 * g @ coefficient - coefficient @ m @ coefficient)
    if len(g) == 1 and not _possible(columns[0], float(coefficient[0])):
        gain = 0.0
    shape, s = _sizes(columns, coefficient)
    return _direction(c, shape, gain, int(useful.sum()), s, rows @ coefficient)


def _plausible(columns: Sequence[Column], coefficient: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the coefficients with the best sum of fit and log prior of the entry.

    The other amplitudes are products with the first one. If the plant's parameters absorb the first one, the
    data do not determine its size and sign. Then the prior of the other amplitudes determines them."""
    from scipy.optimize import minimize_scalar  # slow to load, and only an entry with a prior needs it

    c, shape = columns[0].candidate, columns[0].shape
    dims = np.array([q.dim for q in columns])  # (columns, amplitudes)
    step = covariance @ dims[:, 0]
    size, variance = float(dims[:, 0] @ coefficient), float(dims[:, 0] @ step)
    typical, prior = float(np.abs(dims.T @ coefficient)[1:].max(initial=0.0)), c.effect.prior
    if variance <= 0 or typical <= 0 or prior is None:
        return coefficient
    recorded = {"first_air": c.rig.first_air(c.rig.drives[0]), "duration": c.rig.duration}

    def coefficients_at(log_size: float) -> np.ndarray:
        """Return the best coefficients (columns,) at a given log size of the first amplitude."""
        return np.asarray(coefficient + step * (np.exp(log_size) - size) / variance)

    def cost(log_size: float) -> float:
        """Return -2 (log likelihood + log prior) at a log size of the first amplitude, up to a constant."""
        sizes = dims.T @ coefficients_at(log_size)
        values = {**parameter_values(c, shape, list(sizes)), **recorded}
        unlikely = float(ex.evaluate(prior, values)) + 2 * (len(sizes) - 1) * log_size
        return float((np.exp(log_size) - size) ** 2 / variance + unlikely)

    reach = np.log(typical) + np.log(10.0) * np.array([-DECADES, DECADES])
    return coefficients_at(float(minimize_scalar(cost, bounds=tuple(reach), method="bounded").x))


def _possible(column: Column, coefficient: float) -> bool:
    """Return whether the catalogue allows the size of a candidate that has only one column."""
    c = column.candidate
    amplitudes = [p for p in c.effect.parameters if p.amplitude]
    if amplitudes:
        return _allowed(amplitudes[0], coefficient)
    if "tau" in column.shape and (column.group != (0,) or (c.jumps and not c.variant)):
        # the change is in proportion to the lag only between neighbours of the grid
        return 1 / NEAR < coefficient < NEAR
    return coefficient > 0


def _within(column: Column, coefficient: float) -> float:
    """Return the coefficient of a candidate with only one column, clipped to the bounds of its amplitude.

    A coefficient of the wrong sign is not clipped: beside another effect the sign may turn
    (shortlist.pairs)."""
    c = column.candidate
    p = next((p for p in c.effect.parameters if p.amplitude), None)
    if p is None:
        return coefficient
    low, high = c.bounds(p)
    value = parameter_values(c, column.shape, [coefficient * v for v in column.dim])[p.name]
    beyond = float(np.clip(value, low, high)) - p.null
    return coefficient * beyond / (value - p.null) if beyond * (value - p.null) > 0 else coefficient


def _sizes(columns: Sequence[Column], coefficient: np.ndarray) -> tuple[dict[str, float], list[float]]:
    """Return the shape and the amplitudes at the best coefficients of the columns."""
    c, shape = columns[0].candidate, columns[0].shape
    if "phases" in c.effect.shapes.values():
        phase = float(np.arctan2(coefficient[1], coefficient[0]))
        return {**shape, "phase": phase}, [float(np.hypot(*coefficient))]
    if columns[0].recording:  # a refit begins with their mean
        return shape, [float(np.mean(coefficient))]
    if any(p.amplitude for p in c.effect.parameters):
        return shape, list(np.array([q.dim for q in columns]).T @ coefficient)
    factor = float(np.clip(coefficient[0], 1e-3, 5.0))  # a short lag changes the outputs in proportion
    return {k: v * factor if k == "tau" else v for k, v in shape.items()}, [1.0]


def _score_windows(
    columns: Sequence[Column], rows: np.ndarray, full: np.ndarray, g: np.ndarray, m: np.ndarray
) -> Direction | None:
    """Return the best pair of a start and an end; after the last column, that is the recording's end."""
    edges = [q.shape["start"] for q in columns]
    last, floor = len(edges), 1e-12 * float(full.max()) ** 2
    gain, window = -1.0, (0, 0, 0.0)
    for a in range(last):
        for b in range(a + 1, last + 1):
            top = g[a] - g[b] if b < last else g[a]
            bottom = m[a, a] + m[b, b] - 2 * m[a, b] if b < last else m[a, a]
            if bottom > floor and top * top / bottom > gain:
                gain, window = top * top / bottom, (a, b, top / bottom)
    if gain < 0:
        return None
    a, b, amplitude = window
    # Heat that ends and a lack of heat that starts differ by a constant, which parameters absorb.
    # The lack is likelier.
    if a == 0 and b < last and m[b, b] > floor and g[b] ** 2 / m[b, b] > 0.8 * gain:
        a, b, amplitude = b, last, g[b] / m[b, b]
        gain = g[a] ** 2 / m[a, a]
    shape = {"start": edges[a], "end": edges[b] if b < last else 10 * edges[-1]}
    vector = rows[:, a] - (rows[:, b] if b < last else 0)
    return _direction(columns[0].candidate, shape, gain, 1, [amplitude], vector)


def _allowed(p: EffectParameter, coefficient: float) -> bool:
    assert p.trial is not None  # an amplitude has one
    value = float(ex.evaluate(p.trial, {"s": coefficient, "tau": 1.0, "first_air": 0.0}))
    return (
        p.low - 1e-12 <= value <= p.high + 1e-12
        or (p.low < p.null < p.high)
        or (coefficient > 0 if p.low >= p.null else coefficient < 0 if p.high <= p.null else True)
    )


def _direction(
    c: Candidate,
    shape: Mapping[str, float],
    gain: float,
    dims: int,
    sizes: Sequence[float],
    along: np.ndarray,
) -> Direction:
    """Return the direction of a candidate at a shape, whose rows are `along`."""
    size = float(np.linalg.norm(along))
    return Direction(
        c,
        {k: v for k, v in shape.items() if k != "picked_from"},
        gain,
        dims,
        parameter_values(c, shape, sizes),
        (along / size).astype(np.float32) if size > 0 else None,
        float(np.log10(shape.get("picked_from", 1.0))),
    )
