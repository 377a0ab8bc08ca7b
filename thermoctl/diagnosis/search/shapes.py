"""The values of an entry's shapes (onsets, periods, thresholds ...) that a screening tries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.evidence.onsets import ONSETS
from thermoctl.diagnosis.hypothesis.candidates import Candidate
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name
from thermoctl.plant.simulation.simulate import Simulation

REPEATED = 2.0  # least number of periods over the span of the signal
BEYOND = 1 / 3, 2 / 3  # levels above the last quantile: shares of the way to the extreme
LEAST_STEPS = 1.5  # least period of a reading's error, in its steps; rounding has the period of one step
ROUNDED = 1e-9  # gap between readings that only the arithmetic makes, over their range
WHOLE = 0.01  # largest distance of a rounded reading from a multiple of its step, in steps
# Periods over the span of the signal: up to the first number all are tried, up to the second the strongest.
SLOW_TURNS, FINE_TURNS = 60.0, 4000
COARSER = 3  # ratio of the steps of onset times, where the recording of an event is tried, too
STRONGEST = 16  # number of the strongest periods that are tried


def _fine_turns(x: np.ndarray, errors: Sequence[np.ndarray], span: float) -> np.ndarray:
    """Return the numbers of periods over the span of x, above SLOW_TURNS, at which errors are strongest.

    They are peaks of the spectrum over x. `errors`: (N,) by recording; their part that is slow in time is
    removed first."""
    fast = []
    for e in errors:
        e = np.nan_to_num(e)
        total = np.concatenate([[0.0], np.cumsum(e)])
        half = max(len(e) // 200, 4)
        low, high = np.maximum(np.arange(len(e)) - half, 0), np.minimum(np.arange(len(e)) + half + 1, len(e))
        fast.append(e - (total[high] - total[low]) / (high - low))
    e = np.concatenate(fast)
    e = np.clip(e, *(np.array([-8, 8]) * (1.4826 * float(np.median(np.abs(e))) or np.inf)))
    good = np.isfinite(x)
    if not good.any():
        return np.zeros(0)
    bins = 8 * FINE_TURNS
    index = np.clip(((x[good] - np.min(x[good])) / span * bins).astype(int), 0, bins - 1)
    power = np.abs(np.fft.rfft(np.bincount(index, e[good], bins), 4 * bins))[
        : 4 * FINE_TURNS
    ]  # in steps of a quarter of a period
    power[: int(4 * SLOW_TURNS)] = 0.0
    peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    return peaks[np.argsort(-power[peaks])[:STRONGEST]] / 4


Grid = list[dict[str, float]]


def shape_grid(kind: str, candidate: Candidate, runs: Sequence[Simulation]) -> Grid:
    """Return the values of a shape that a screening tries; not of phases and windows (`groups_of`).

    A value may hold `picked_from`, the number of values from which the residual itself picked it. A period
    holds `longest`, the longest period that repeats in the recordings. A level holds `least` and `most`, the
    ends of its prior."""
    if kind in ("onsets", "times", "lags", "delays"):
        grid = _times(kind, candidate.rig.duration, candidate.rig.sample)
        return [{"onset": 0.0}, *grid[1::COARSER]] if kind == "onsets" and candidate.begins else grid
    if kind in ("periods", "distances"):
        return _positions(kind, candidate, runs)
    if kind in ("speeds", "creep_speeds"):
        v = np.abs(_signal(candidate, runs, _symbols(candidate)["v"]))
        top = float(np.nanmax(v)) or 1.0
        if kind == "creep_speeds":  # the speed below which dry friction gives way smoothly
            return [{"creep": 1e-3 * top}]
        return [{"speed": float(q)} for q in np.geomspace(0.01 * top, 0.6 * top, 8)]
    return _levels(kind, candidate, runs)


def _symbols(candidate: Candidate) -> dict[str, Expr]:
    return {**candidate.place.symbols, **candidate.symbols}


def _signal(candidate: Candidate, runs: Sequence[Simulation], e: Expr) -> np.ndarray:
    """Return the values of an expression over all recordings, one after the other."""
    rig, parts = candidate.rig, []
    for d, run, columns in zip(rig.drives, runs, rig.columns, strict=True):
        values = {
            **{c: columns[c] for c in rig.spare},
            **dict(zip(rig.plant.inputs, d.u.T, strict=False)),
            **dict(zip(rig.plant.nodes, run.x.T, strict=True)),
            "t": d.t,
            **{q: p.value for q, p in rig.plant.parameters.items()},
        }
        parts.append(np.broadcast_to(np.asarray(ex.evaluate(e, values), float), d.t.shape))
    return np.concatenate(parts)


def _times(kind: str, duration: float, dt: float) -> Grid:
    """Return onsets in recordings of `duration` s, or time constants of lags and delays.

    `dt`: the sampling time in s."""
    if kind == "onsets":
        return [{"onset": float(v)} for v in np.linspace(0, duration, ONSETS + 2)[1:-1]]
    least, most, count = {"times": (3, 0.6, 12), "lags": (0.5, 0.1, 10), "delays": (0.3, 0.03, 9)}[kind]
    return [{"tau": float(v)} for v in np.geomspace(least * dt, most * duration, count)]


def _positions(kind: str, candidate: Candidate, runs: Sequence[Simulation]) -> Grid:
    """Return periods or distances over the signal x, or for a distance over the position."""
    rig, symbols = candidate.rig, _symbols(candidate)
    x = _signal(candidate, runs, symbols["x"]) if "x" in symbols else np.array([0.0, 1.0])
    if kind == "distances" and "x" not in symbols:
        position = rig.position_of.get(candidate.place.nodes.get("v") or "")
        x = _signal(candidate, runs, name(position)) if position else x
    span = float(np.ptp(x[np.isfinite(x)])) or 1.0
    if kind == "distances":
        return [{"distance": float(v)} for v in np.geomspace(1e-3 * span, 0.5 * span, 8)]
    longest = span / REPEATED
    # over the span, neighbouring periods differ by a quarter of a period
    slow = [{"period": float(span / n), "longest": longest} for n in np.arange(REPEATED, SLOW_TURNS, 0.25)]
    if not candidate.place.output:
        return slow
    j = list(rig.plant.outputs).index(candidate.place.output)
    errors = [d.y[:, j] - run.y[:, j] for d, run in zip(rig.drives, runs, strict=True)]
    fine = {"longest": longest, "picked_from": 4.0 * FINE_TURNS}
    every = slow + [{"period": float(span / n), **fine} for n in _fine_turns(x, errors, span)]
    steps = (_step(d.y[:, j]) for d in rig.drives)
    step = max(rig.plant.outputs[candidate.place.output].resolution or 0.0, *steps)
    moved = float(np.ptp(np.concatenate([run.y[:, j] for run in runs]))) or np.inf
    least = LEAST_STEPS * step * span / moved
    return [p for p in every if p["period"] > least]


def _step(y: np.ndarray) -> float:
    """Return the step of a reading (N,): all its values are multiples of it from the first; else 0."""
    values = np.unique(y[np.isfinite(y)])
    if len(values) < 2:
        return 0.0
    gaps = np.diff(values)
    step = float(gaps[gaps > ROUNDED * (values[-1] - values[0])].min())
    part = (values - values[0]) / step
    return step if np.abs(part - np.round(part)).max() < WHOLE else 0.0


def _levels(kind: str, candidate: Candidate, runs: Sequence[Simulation]) -> Grid:
    """Return levels of the reading, the input or the signal that the effect acts on."""
    symbols = _symbols(candidate)
    target = symbols.get("y") or symbols.get("u") or symbols.get("a")
    z = _signal(candidate, runs, target) if target is not None else np.array([0.0, 1.0])
    z = z[np.isfinite(z)]
    if kind == "small_levels":
        top = float(np.max(np.abs(z))) or 1.0
        ends = {"least": 1e-4 * top, "most": 0.6 * top}
        return [{"level": float(v), **ends} for v in np.geomspace(1e-3 * top, ends["most"], 14)]
    quantiles = [0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.94, 0.97, 0.99]
    if kind == "drive_levels":
        z, quantiles = np.abs(z), [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98]
    if kind == "end_levels" and candidate.variant == 1:
        quantiles = [1 - q for q in quantiles]
    half = 0.5 * float(np.ptp(z))  # a fit without the limit may have kept the signal inside it
    ends = {"least": float(np.min(z)) - half, "most": float(np.max(z)) + half}
    end = float(np.quantile(z, round(quantiles[-1])))
    levels = np.quantile(z, quantiles)
    # The signal may exceed the last quantile only in one pulse.
    beyond = levels[-1] + np.array(BEYOND) * (end - levels[-1])
    return [{"level": float(v), **ends} for v in np.unique([*levels, *beyond])]
