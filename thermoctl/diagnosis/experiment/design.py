"""The candidate experiments: the inputs that can be driven, and how, inside the rig's limits.

The candidates are levels, steps both ways, warm-up and cool-down, slow and fast trapezoids, small and large
triangles, and pseudo-random sequences of two bands. Each input is driven alone, then all together, with
several durations and initial conditions. Inputs stay inside the recorded range, unless limits are given, and
change no faster than was recorded."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.recording.table import Table
from thermoctl.units import dimension, readable_time

TOGETHER = 0.98  # correlation from which two inputs count as one lever, such as voltage and current
FEWEST = 10  # two inputs with so few common samples are not taken as one
# Dimensions of temperature, sunshine and pressure: these cannot be commanded.
SURROUNDINGS = ("K", "W/m^2", "Pa")
LENGTHS = (1.0, 0.5, 2.0)  # durations of experiments, over the median duration of the recordings
STARTS_APART = 0.05  # relative difference of an input, constant in each recording, that makes two starts

Ranges = Mapping[str, tuple[float, float]]
NONE: Ranges = {}
Plateaus = list[tuple[float, float]]  # (duration in s, value) of each plateau


@dataclass(frozen=True)
class Lever:
    """An input that can be driven, with its limits and its value at rest.

    `moves`: the inputs that move with it, itself too, each as factor * value + offset."""

    name: str
    moves: Mapping[str, tuple[float, float]]
    low: float
    high: float
    rest: float
    rate: float  # largest recorded change in a second


@dataclass(frozen=True)
class Excitation:
    """The inputs of an experiment: by input, corners (K, 2) of (s, value), with straight lines between.

    `starts`: values of the constant inputs."""

    title: str
    duration_s: float
    corners: Mapping[str, np.ndarray]
    starts: Mapping[str, float]

    def table(self, plant: Plant, step_s: float, name: str = "next_experiment") -> Table:
        """Return the inputs at every `step_s` as a table, by their column names."""
        t = np.arange(int(np.floor(self.duration_s / step_s + 1e-9)) + 1) * step_s
        columns = {plant.inputs[n].column: np.interp(t, c[:, 0], c[:, 1]) for n, c in self.corners.items()}
        columns |= {
            plant.inputs[n].column if n in plant.inputs else plant.outputs[n].column: np.full(len(t), v)
            for n, v in self.starts.items()
        }
        return Table(name, name, t, columns)


def recorded(tables: Sequence[Table], column: str) -> list[np.ndarray]:
    """Return a column of each recording that has it."""
    return [t.columns[column] for t in tables if column in t.columns]


def levers(
    plant: Plant, tables: Sequence[Table], only: Sequence[str] = (), limits: Ranges = NONE
) -> list[Lever]:
    """Find the inputs that moved in the recordings and can be commanded.

    Inputs that moved together are one lever. Temperatures, sunshine, pressure and the time of day belong to
    the surroundings and are left out, unless `only` names them. `only`: the inputs that may be driven.
    `limits`: by input, a range instead of the recorded one. Raises InputError for an unknown name."""
    for n in only:
        if n not in plant.inputs:
            raise InputError(f"'{n}' is not an input of {plant.file}; there are {', '.join(plant.inputs)}")
    out, series = list[Lever](), list[np.ndarray]()
    for i in plant.inputs.values():
        surroundings = i.unit and any(dimension(i.unit) == dimension(u) for u in SURROUNDINGS)
        parts = recorded(tables, i.column)
        if (i.name not in only if only else surroundings or i.role == "time_of_day") or not _moved(parts):
            continue
        values = np.concatenate(parts)
        for k, other in enumerate(series):
            if line := together(other, values):
                out[k] = dataclasses.replace(out[k], moves={**out[k].moves, i.name: line})
                break
        else:
            out.append(_lever(i.name, i.column, tables, limits))
            series.append(values)
    return out


def _moved(parts: Sequence[np.ndarray]) -> bool:
    largest = max((abs(v[np.isfinite(v)]).max(initial=0.0) for v in parts), default=0.0)
    return any(np.nanstd(p) > 1e-6 * max(largest, 1e-300) for p in parts if np.isfinite(p).any())


def together(a: np.ndarray, b: np.ndarray) -> tuple[float, float] | None:
    """Return the factor and the offset by which b follows a; None where they do not move together."""
    if len(a) != len(b):
        return None
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() <= FEWEST or not abs(np.corrcoef(a[both], b[both])[0, 1]) > TOGETHER:
        return None
    factor, offset = np.polyfit(a[both], b[both], 1)
    return float(factor), float(offset)


def _lever(name: str, column: str, tables: Sequence[Table], limits: Ranges) -> Lever:
    parts = [(t.t, t.columns[column]) for t in tables if column in t.columns]
    finite = [v[np.isfinite(v)] for _, v in parts if np.isfinite(v).any()]
    good = np.concatenate(finite)
    low, high = limits.get(name, (float(good.min()), float(good.max())))
    first = float(np.median([v[0] for v in finite]))
    rates = [float(np.nanmax(np.abs(np.diff(v) / np.diff(t)))) for t, v in parts if len(t) > 1]
    return Lever(name, {name: (1.0, 0.0)}, low, high, min(max(first, low), high), max(rates, default=np.inf))


def _ramps(lever: Lever, plateaus: Plateaus, step_s: float) -> np.ndarray:
    """Return the corners (K, 2) of consecutive plateaus.

    The ramps between them are no faster than was recorded."""
    corners = [(0.0, lever.rest)]
    for seconds, value in plateaus:
        t, now = corners[-1]
        ramp = max(abs(value - now) / max(lever.rate, 1e-300), 1e-3 * step_s)
        if ramp > seconds:  # the plateau cannot be reached in its duration
            ramp, value = seconds, now + (value - now) * seconds / ramp
        corners += [(t + ramp, value), (t + seconds, value)]
    return np.array([c for k, c in enumerate(corners) if k == 0 or c[0] > corners[k - 1][0]])


def _pseudo_random(lever: Lever, hold_s: float, duration_s: float, seed: int) -> Plateaus:
    """Return levels held for `hold_s` or a multiple, from a 7-bit shift register of maximum length."""
    low, high = lever.low, lever.high
    levels = (low, high, high, 0.5 * (low + high), low, low + 0.75 * (high - low), low, high)
    state, out = 0b1010011 + 17 * seed, []
    for _ in range(int(duration_s / hold_s)):
        state = (state << 1 | ((state >> 6 ^ state >> 5) & 1)) & 0x7F
        out.append((hold_s, levels[state & 7]))
    return [*out, (duration_s - hold_s * len(out), lever.rest)]


def _swings(low: float, high: float, period_s: float, duration_s: float) -> Plateaus:
    count = max(int(duration_s / period_s), 1)
    return [(0.5 * period_s, q) for _ in range(count) for q in (high, low)]


def courses(lever: Lever, duration_s: float, step_s: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the courses of one lever: {description: corners (K, 2)}."""
    low, high, whole = lever.low, lever.high, duration_s
    middle, span = 0.5 * (low + high), high - low
    away = high if high - lever.rest >= lever.rest - low else low
    half = lever.rest + 0.5 * (away - lever.rest)

    plans: dict[str, Plateaus] = {
        "at rest, then held at its end": [(0.1 * whole, lever.rest), (0.9 * whole, away)],
        "held at its end, then at rest (warm-up and cool-down)": [
            (0.5 * whole, away),
            (0.5 * whole, lever.rest),
        ],
        "held at half, then at rest": [(0.5 * whole, half), (0.5 * whole, lever.rest)],
        "in four levels up and down": [
            (whole / 7, lever.rest + (away - lever.rest) * q) for q in (0.25, 0.5, 0.75, 1.0, 0.66, 0.33, 0.0)
        ],
        "in slow trapezoids": _swings(low, high, whole / 2, whole),
        "in fast trapezoids": _swings(low, high, whole / 12, whole),
        "in small fast trapezoids": _swings(middle - 0.1 * span, middle + 0.1 * span, whole / 12, whole),
        "in a pseudo-random sequence, slow": _pseudo_random(lever, max(whole / 20, 2 * step_s), whole, seed),
        "in a pseudo-random sequence, fast": _pseudo_random(lever, max(whole / 80, 2 * step_s), whole, seed),
    }
    out = {k: _ramps(lever, p, step_s) for k, p in plans.items()}
    for word, part in (("large", 1.0), ("small", 0.2)):
        times = np.linspace(0, whole, 9)
        swing = 0.5 * min(part * span, lever.rate * whole / 8)
        wave = np.where(np.arange(9) % 2, swing, -swing) + middle
        out[f"in {word} triangles"] = np.column_stack([times, wave])
    return out


def family(plant: Plant, tables: Sequence[Table], driven: Sequence[Lever], step_s: float) -> list[Excitation]:
    """Return the candidates: each lever alone, the others at rest, and all together; at each of LENGTHS."""
    usual = float(np.median([t.t[-1] - t.t[0] for t in tables]))
    constant, starts = _constant(plant, tables, {n for lever in driven for n in lever.moves})
    out = []
    for share in LENGTHS:
        duration_s = usual * share
        for title, plan in _plans(driven, duration_s, step_s):
            corners = {
                n: np.column_stack([plan[lever.name][:, 0], plan[lever.name][:, 1] * factor + offset])
                for lever in driven
                for n, (factor, offset) in lever.moves.items()
            }
            for start in starts if share == LENGTHS[0] else starts[:1]:
                text = f"{title}, {readable_time(duration_s)}"
                if len(starts) > 1:
                    text += ", from " + ", ".join(f"{n} {v:.4g}" for n, v in start.items())
                out.append(Excitation(text, duration_s, corners, constant | start))
    return out


def _plans(
    driven: Sequence[Lever], duration_s: float, step_s: float
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Return (title, {lever: corners}) of every candidate of one duration."""
    rest = {lever.name: np.array([[0.0, lever.rest], [duration_s, lever.rest]]) for lever in driven}
    plans = [
        (f"{lever.name} {words}", rest | {lever.name: c})
        for lever in driven
        for words, c in courses(lever, duration_s, step_s).items()
    ]
    if len(driven) > 1:
        each = {v.name: courses(v, duration_s, step_s, seed) for seed, v in enumerate(driven)}
        together = [w for w in each[driven[0].name] if w.startswith(("in a pseudo", "held at its end"))]
        plans += [(f"{' and '.join(each)} {w}", {n: c[w] for n, c in each.items()}) for w in together]
    return plans


def _constant(
    plant: Plant, tables: Sequence[Table], moved: set[str]
) -> tuple[dict[str, float], list[dict[str, float]]]:
    """Return the mean of each input that is not driven, and the initial conditions to try.

    An input in an initial state that is constant in each recording, and differs between recordings, gives
    two: its smallest and its largest value."""
    constant, low, high = {}, {}, {}
    for i in plant.inputs.values():
        if i.name in moved:
            continue
        parts = [p for p in recorded(tables, i.column) if np.isfinite(p).any()]
        means = [float(np.nanmean(p)) for p in parts]
        constant[i.name] = float(np.mean(means)) if means else 0.0
        if not means or not any(i.name in ex.names(n.initial) for n in plant.nodes.values()):
            continue
        steady = all(np.nanstd(p) < 1e-9 * (abs(m) + 1e-300) for p, m in zip(parts, means, strict=True))
        if steady and max(means) - min(means) > STARTS_APART * max(abs(m) for m in means):
            low[i.name], high[i.name] = min(means), max(means)
    asked = {e.value for n in plant.nodes.values() for e in ex.walk(n.initial) if e.op == "first"}
    for o in plant.outputs.values():
        values = [p[np.isfinite(p)][0] for p in recorded(tables, o.column) if np.isfinite(p).any()]
        if o.name in asked and values:
            constant[o.name] = float(np.mean(values))
    return constant, [low, high] if low else [{}]
