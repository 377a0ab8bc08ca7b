"""The experiment that tells surviving explanations apart, best per hour of rig time inside the rig's limits.

Two explanations a, b predict readings y_a, y_b (N,) of an experiment. What their parameters are still uncertain by counts against
them (Buzzi-Ferraris & Forzatti, Chem. Eng. Sci. 38 (1983) 225), with R the noise's covariance, J = dy/dz, P = cov z:

    D_ab = (y_a - y_b)' (R + J_a P_a J_a' + J_b P_b J_b')^-1 (y_a - y_b)                                                       (1)

What the experiment tells about which explanation is true, in bits (lower bound of Kolchinsky & Tracey, Entropy 19 (2017) 361):

    I = -sum_a w_a log2 sum_b w_b exp(-D_ab / 8)                                                                               (2)

Chosen is the most I per hour among those that reach ENOUGH of the best I. The family: levels, steps both ways, warm-up and
cool-down, trapezoids slow and fast, triangles small and large, pseudo-random sequences of two bands; every input by itself and
all together, in several lengths and from several starts. Inputs stay inside the range, and below the speed, that was recorded,
and every reading, as every surviving hypothesis predicts it, inside its recorded range, unless limits are given. Where nothing of
the family stays inside, it is tried again with smaller excursions of the inputs (SHARES).
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.refit import Scale
from thermoctl.plant.simulate import Model, SimulationError, compile_plant
from thermoctl.plant.units import dimension
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table
from thermoctl.yamlfile import InputError

if TYPE_CHECKING:
    from thermoctl.diagnose.explain import Case, Explanation
    from thermoctl.diagnose.outcome import Diagnosis

FORMAT = "thermoctl-experiments/1"
FILES = ("next_experiment.yaml", "next_experiment.csv")
SETPOINT = "setpoint_um"  # what the daemon commands; the current of a flexure's actuator follows it
ROUNDS = 3
MOST = 5  # explanations that are compared
LIKELY = 0.02  # an explanation below this share of the likeliest one is not worth rig time
POINTS, READINGS = (
    700,
    4000,
)  # of a simulated experiment, at most; a reading more often than that counts as less noise
SECONDS = 30.0  # after which no further candidate is looked at
ENOUGH = 0.8  # of the best experiment's bits that a shorter one must reach
TOGETHER = 0.98  # correlation from which two inputs are taken to be one lever (voltage and current)
SHARES = (
    1.0,
    0.7,
    0.5,
    0.3,
)  # of the inputs' recorded excursion from rest, the largest that keeps readings inside
TOLD_APART = 20.0  # D that decides: odds of e^(D/2) for one of two on the mean
SURROUNDINGS = ("K", "W/m^2", "Pa")  # dimensions of what the surroundings do and no one commands


Limits = Mapping[str, tuple[float, float]]
NONE: Limits = {}


@dataclass(frozen=True)
class Lever:
    """An input that can be driven, and those that move with it: {input: (factor, offset)}; its limits and rest."""

    name: str
    moves: Mapping[str, tuple[float, float]]
    low: float
    high: float
    rest: float
    rate: float  # most it was seen to change in a second


@dataclass(frozen=True)
class Excitation:
    """What the inputs do: corners (K, 2) of seconds and value each, on straight lines; `starts` are constant inputs."""

    title: str
    duration_s: float
    corners: Mapping[str, np.ndarray]
    starts: Mapping[str, float]

    def table(self, plant: Plant, step_s: float, name: str = "next_experiment") -> Table:
        """The inputs as a recording of `step_s`, by their columns."""
        t = np.arange(int(np.floor(self.duration_s / step_s + 1e-9)) + 1) * step_s
        columns = {plant.inputs[n].column: np.interp(t, c[:, 0], c[:, 1]) for n, c in self.corners.items()}
        columns |= {
            plant.inputs[n].column if n in plant.inputs else plant.outputs[n].column: np.full(len(t), v)
            for n, v in self.starts.items()
        }
        return Table(name, name, t, columns)


# -------------------------------------------------------------------------------------------------- what can be driven


def levers(
    plant: Plant, tables: Sequence[Table], only: Sequence[str] = (), limits: Limits = NONE
) -> list[Lever]:
    """The inputs that moved in the recordings and are no part of the surroundings (temperatures, sunshine, pressure), those that
    moved alike as one. `only`: names that count, whatever their unit; `limits`: by input, instead of what was recorded. Raises
    InputError for an unknown name."""
    for n in only:
        if n not in plant.inputs:
            raise InputError(f"'{n}' is not an input of {plant.file}; there are {', '.join(plant.inputs)}")
    found: list[Lever] = []
    series: list[np.ndarray] = []
    for i in plant.inputs.values():
        if (only and i.name not in only) or (
            not only and i.unit and any(dimension(i.unit) == dimension(u) for u in SURROUNDINGS)
        ):
            continue
        parts = [t.columns[i.column] for t in tables if i.column in t.columns]
        values = np.concatenate(parts) if parts else np.zeros(0)
        good = values[np.isfinite(values)]
        if not len(good) or not any(np.nanstd(p) > 1e-6 * max(abs(good).max(), 1e-300) for p in parts):
            continue
        for k, other in enumerate(series):
            both = np.isfinite(values) & np.isfinite(other)
            if len(other) == len(values) and abs(np.corrcoef(values[both], other[both])[0, 1]) > TOGETHER:
                factor, offset = np.polyfit(other[both], values[both], 1)
                found[k] = dataclasses.replace(
                    found[k], moves={**found[k].moves, i.name: (float(factor), float(offset))}
                )
                break
        else:
            low, high = limits.get(i.name, (float(good.min()), float(good.max())))
            first = float(np.median([p[np.isfinite(p)][0] for p in parts if np.isfinite(p).any()]))
            rate = max(
                (
                    float(np.nanmax(np.abs(np.diff(t.columns[i.column]) / np.diff(t.t))))
                    for t in tables
                    if i.column in t.columns and len(t.t) > 1
                ),
                default=np.inf,
            )
            found.append(Lever(i.name, {i.name: (1.0, 0.0)}, low, high, min(max(first, low), high), rate))
            series.append(values)
    return found


def _ramps(lever: Lever, plateaus: Sequence[tuple[float, float]], step_s: float) -> np.ndarray:
    """Corners (K, 2) of (seconds, value) plateaus one after the other, the ramps between them no faster than was recorded."""
    corners = [(0.0, lever.rest)]
    for seconds, value in plateaus:
        t, now = corners[-1]
        ramp = max(abs(value - now) / max(lever.rate, 1e-300), 1e-3 * step_s)
        if ramp > seconds:  # too slow to get there in time
            ramp, value = seconds, now + (value - now) * seconds / ramp
        corners += [(t + ramp, value), (t + seconds, value)]
    return np.array([c for k, c in enumerate(corners) if k == 0 or c[0] > corners[k - 1][0]])


def courses(lever: Lever, duration_s: float, step_s: float, seed: int = 0) -> dict[str, np.ndarray]:
    """The family for one lever: {what it does: corners (K, 2)}."""
    low, high, T = lever.low, lever.high, duration_s
    middle, span = 0.5 * (low + high), high - low
    away = high if high - lever.rest >= lever.rest - low else low
    half = lever.rest + 0.5 * (away - lever.rest)

    def sequence(hold_s: float) -> list[tuple[float, float]]:
        """Pseudo-random levels of `hold_s` or a multiple: amplitudes at both ends and between, from a maximum length register."""
        state, out = 0b1010011 + 17 * seed, []
        levels = (low, high, high, middle, low, low + 0.75 * span, low, high)
        for _ in range(int(T / hold_s)):
            state = (state << 1 | ((state >> 6 ^ state >> 5) & 1)) & 0x7F
            out.append((hold_s, levels[state & 7]))
        return [*out, (T - hold_s * len(out), lever.rest)]

    def swings(low: float, high: float, period_s: float) -> list[tuple[float, float]]:
        count = max(int(T / period_s), 1)
        return [(0.5 * period_s, q) for _ in range(count) for q in (high, low)]

    plans: dict[str, list[tuple[float, float]]] = {
        "at rest, then held at its end": [(0.1 * T, lever.rest), (0.9 * T, away)],
        "held at its end, then at rest (warm-up and cool-down)": [(0.5 * T, away), (0.5 * T, lever.rest)],
        "held at half, then at rest": [(0.5 * T, half), (0.5 * T, lever.rest)],
        "in four levels up and down": [
            (T / 7, lever.rest + (away - lever.rest) * q) for q in (0.25, 0.5, 0.75, 1.0, 0.66, 0.33, 0.0)
        ],
        "in slow trapezoids": swings(low, high, T / 2),
        "in fast trapezoids": swings(low, high, T / 12),
        "in small fast trapezoids": swings(middle - 0.1 * span, middle + 0.1 * span, T / 12),
        "in a pseudo-random sequence, slow": sequence(max(T / 20, 2 * step_s)),
        "in a pseudo-random sequence, fast": sequence(max(T / 80, 2 * step_s)),
    }
    out = {k: _ramps(lever, p, step_s) for k, p in plans.items()}
    for word, part in (("large", 1.0), ("small", 0.2)):
        at = np.linspace(0, T, 9)
        swing = 0.5 * min(part * span, lever.rate * T / 8)
        wave = np.where(np.arange(9) % 2, swing, -swing) + middle
        out[f"in {word} triangles"] = np.column_stack([at, wave])
    return out


def family(plant: Plant, tables: Sequence[Table], found: Sequence[Lever], step_s: float) -> list[Excitation]:
    """The candidates: every lever by itself, the others at rest, and all together, over half, one and two recordings' length."""
    usual = float(np.median([t.t[-1] - t.t[0] for t in tables]))
    still, several = _still(plant, tables, {n for lever in found for n in lever.moves})
    out = []
    for share in (1.0, 0.5, 2.0):
        T = usual * share
        rest = {lever.name: np.array([[0.0, lever.rest], [T, lever.rest]]) for lever in found}
        plans: list[tuple[str, dict[str, np.ndarray]]] = []
        for lever in found:
            plans += [
                (f"{lever.name} {word}", rest | {lever.name: c})
                for word, c in courses(lever, T, step_s).items()
            ]
        if len(found) > 1:
            each = [courses(lever, T, step_s, seed) for seed, lever in enumerate(found)]
            words = [w for w in each[0] if w.startswith(("in a pseudo", "held at its end"))]
            plans += [
                (
                    f"{' and '.join(q.name for q in found)} {w}",
                    {q.name: c[w] for q, c in zip(found, each, strict=True)},
                )
                for w in words
            ]
        for title, courses_ in plans:
            corners = {
                n: np.column_stack([c[:, 0], c[:, 1] * factor + offset])
                for lever in found
                for c in (courses_[lever.name],)
                for n, (factor, offset) in lever.moves.items()
            }
            for starts in several if share == 1.0 else several[:1]:
                word = ", ".join(f"{n} {v:.4g}" for n, v in starts.items())
                out.append(
                    Excitation(
                        f"{title}, {T:.5g} s" + (f", from {word}" if len(several) > 1 else ""),
                        T,
                        corners,
                        still | starts,
                    )
                )
    return out


def _still(
    plant: Plant, tables: Sequence[Table], moved: set[str]
) -> tuple[dict[str, float], list[dict[str, float]]]:
    """Inputs nobody drives at their mean, readings that a start asks for at their first values; and the starts to choose among:
    where an input was constant in every recording but differed between them, both ends."""
    still, low, high = {}, {}, {}
    for i in plant.inputs.values():
        if i.name in moved:
            continue
        means = [
            float(np.nanmean(t.columns[i.column]))
            for t in tables
            if i.column in t.columns and np.isfinite(t.columns[i.column]).any()
        ]
        constant = all(
            np.nanstd(t.columns[i.column]) < 1e-9 * (abs(m) + 1e-300)
            for t, m in zip(tables, means, strict=False)
        )
        still[i.name] = float(np.mean(means)) if means else 0.0
        spread = max(means) - min(means) if means else 0.0
        if (
            constant
            and spread > 0.05 * max(abs(m) for m in means)
            and any(i.name in ex.names(n.initial) for n in plant.nodes.values())
        ):
            low[i.name], high[i.name] = min(means), max(means)
    asked = {e.value for n in plant.nodes.values() for e in ex.walk(n.initial) if e.op == "first"}
    for o in plant.outputs.values():
        values = [
            t.columns[o.column][np.isfinite(t.columns[o.column])][0]
            for t in tables
            if o.column in t.columns and np.isfinite(t.columns[o.column]).any()
        ]
        if o.name in asked and values:
            still[o.name] = float(np.mean(values))
    return still, [low, high] if low else [{}]


# ------------------------------------------------------------------------------------------------ what it would tell


@dataclass
class _Believer:
    """One explanation ready to predict: (z by its unknowns) values, scales and root of the covariance."""

    label: str
    weight: float
    model: Model
    root: np.ndarray  # (z, z), P = root root'
    slopes: np.ndarray  # dq / dz of the model's unknowns that are not known, else 0


def _believer(e: Explanation, free: Callable[[Plant], Plant]) -> _Believer:
    model = compile_plant(free(e.plant))
    found = e.fit
    inflate = max(found.cost / max(found.samples - len(found.z), 1), 1.0)
    covariance = np.linalg.pinv(found.hessian, hermitian=True) * inflate
    place = {q: k for k, (q, r) in enumerate(found.unknowns) if r is None}
    nq = len(model.unknowns)
    P, slopes = np.eye(nq), np.zeros(nq)
    for c, q in enumerate(model.unknowns):
        p = model.plant.parameters.get(q)
        if c < len(model.active) and p is not None and p.range:
            slopes[c] = Scale(p).slope(p.value)
            P[c, c] = 0.09  # its own value in every recording: anything within its range
        elif c >= len(model.active):
            slopes[c] = model.plant.nodes[model.uncertain[c - len(model.active)]].initial_sigma or 0.0
    known = [c for c, q in enumerate(model.unknowns) if q in place and slopes[c]]
    index = [place[model.unknowns[c]] for c in known]
    P[np.ix_(known, known)] = covariance[np.ix_(index, index)]
    P[np.diag_indices(nq)] = np.minimum(np.diag(P), 1.0)  # no parameter is more uncertain than its range
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    label = " and ".join(f"{c.effect.name} at {c.place.where}" for c in e.effects) or "nothing missing"
    return _Believer(label, e.probability, model, root, slopes)


def _predict(b: _Believer, table: Table) -> tuple[np.ndarray, np.ndarray] | None:
    """Readings and states of an experiment (N, ny + nx) and what they are uncertain by (N, ny + nx, z); None where it fails."""
    try:
        run = b.model.run(b.model.excitation(table), sensitivities=True, rtol=1e-5)
    except (SimulationError, InputError):
        return None
    assert run.dy is not None and run.dx is not None
    slopes = np.concatenate([run.dy, run.dx], axis=1) * b.slopes @ b.root
    y = np.concatenate([run.y, run.x], axis=1)
    return (y, slopes) if np.all(np.isfinite(y)) and np.all(np.isfinite(slopes)) else None


def distance(
    a: tuple[np.ndarray, np.ndarray],
    b: tuple[np.ndarray, np.ndarray],
    columns: Sequence[tuple[int, int]],
    sigma: np.ndarray,
) -> float:
    """D of (1) over the given pairs of columns (of a, of b) with noise `sigma` (columns,), by Woodbury's identity."""
    difference = np.concatenate(
        [(a[0][:, i] - b[0][:, j]) / s for (i, j), s in zip(columns, sigma, strict=True)]
    )
    load = np.concatenate(
        [np.hstack([a[1][:, i], b[1][:, j]]) / s for (i, j), s in zip(columns, sigma, strict=True)]
    )
    inner = load.T @ difference
    taken = np.linalg.solve(np.eye(load.shape[1]) + load.T @ load, inner)
    return float(max(difference @ difference - inner @ taken, 0.0))


def bits(D: np.ndarray, weights: np.ndarray) -> float:
    """I of (2)."""
    return float(-weights @ np.log2(np.exp(-D / 8) @ weights))


def noise_of(case: Case, e: Explanation) -> np.ndarray:
    """What one reading is uncertain by, per output (ny,): residual rms of the likeliest explanation, or the sensor's noise where
    larger, widened for the correlation of neighbours (whose mean tells less than that of independent ones)."""
    out = []
    for o, n in zip(case.model.outputs, case.noise, strict=True):
        j = e.fit.model.outputs.index(o)
        r = [q[np.isfinite(q[:, j]), j] for q in e.fit.residuals]
        r = [q for q in r if len(q) > 8]
        square = np.concatenate([q**2 for q in r]).mean() if r else n.sigma**2
        lag = (
            np.sum([np.sum(q[1:] * q[:-1]) for q in r]) / max(np.sum([np.sum(q**2) for q in r]), 1e-300)
            if r
            else 0.0
        )
        lag = float(np.clip(lag, 0.0, 0.98))
        out.append(np.sqrt(max(square, n.sigma**2) * (1 + lag) / (1 - lag)))
    return np.array(out)


def survivors(found: Diagnosis) -> list[Explanation]:
    """The explanations that the recordings leave standing, likeliest first, one of each set of effects."""
    out: dict[tuple, Explanation] = {}
    for e in sorted([found.final, *found.rivals], key=lambda e: -e.probability):
        if e.effects:
            out.setdefault(tuple(sorted(c.key for c in e.effects)), e)
    best = max((e.probability for e in out.values()), default=0.0)
    return [e for e in out.values() if e.probability >= LIKELY * best and e.probability > 0][:MOST]


def propose(
    case: Case, found: Diagnosis, drivable: Sequence[str] = (), limits: Limits = NONE
) -> tuple[dict[str, Any], Excitation] | None:
    """The next experiment for an undecided diagnosis: the contract's entry and its excitation; None where one explanation
    stands alone or nothing can be driven. `limits`: {input or output: (low, high)} of the rig. Raises InputError for a name that
    is neither."""
    for n in limits:
        if n not in case.plant.inputs and n not in case.plant.outputs:
            raise InputError(
                f"a limit of '{n}': no such input or output of {case.plant.file}; there are "
                + ", ".join((*case.plant.inputs, *case.plant.outputs))
            )
    from thermoctl.diagnose import observer

    standing = survivors(found)
    if found.verdict not in ("ambiguous", "unexplained") or len(standing) < 2:
        return None
    drive = levers(case.plant, case.tables, drivable, limits)
    if not drive:
        return None
    case.progress("looking for the experiment that tells them apart")

    def free(plant: Plant) -> Plant:
        return plant if set(plant.inputs) == set(case.plant.inputs) else observer.without(plant)

    believers = [_believer(e, free) for e in standing]
    weights = np.array([b.weight for b in believers])
    weights /= weights.sum()
    step = float(np.median(np.concatenate([np.diff(t.t) for t in case.tables])))
    sigma = noise_of(case, standing[0])
    outputs = list(case.model.outputs)
    seen = [j for j, o in enumerate(outputs) if any(np.isfinite(d.y[:, j]).any() for d in case.drives)]

    points, deadline = min(POINTS, max(READINGS // len(outputs), 150)), time.thread_time() + SECONDS

    def judged(x: Excitation) -> tuple[float, np.ndarray, list] | None:
        if time.thread_time() > deadline:
            return None
        grid = max(step, x.duration_s / points)
        table = x.table(case.plant, grid)
        told = [_predict(b, table) for b in believers]
        if any(p is None for p in told) or _leaves(case, outputs, told, limits):
            return None
        s = sigma[seen] * np.sqrt(step / grid)
        D = np.zeros((len(believers), len(believers)))
        for i in range(len(believers)):
            for k in range(i):
                pairs = [
                    (
                        believers[i].model.outputs.index(outputs[j]),
                        believers[k].model.outputs.index(outputs[j]),
                    )
                    for j in seen
                ]
                D[i, k] = D[k, i] = distance(told[i], told[k], pairs, s)  # type: ignore[arg-type]
        return bits(D, weights), D, told

    for share in SHARES:
        candidates = family(case.plant, case.tables, [_smaller(lever, share) for lever in drive], step)
        with ThreadPoolExecutor(max_workers=2) as pool:
            scores = list(pool.map(judged, candidates))
        good = [(x, s) for x, s in zip(candidates, scores, strict=True) if s is not None]
        if good:
            break
    else:
        return None
    most = max(s[0] for _, s in good)
    chosen, (told_bits, D, told) = max(
        (c for c in good if c[1][0] >= ENOUGH * most), key=lambda c: c[1][0] / c[0].duration_s
    )
    hours = chosen.duration_s / 3600
    sigmas = np.sqrt(D[0, 1:])
    apart = [
        {"explanation": b.label, "from": believers[0].label, "sigmas": float(q)}
        for b, q in zip(believers[1:], sigmas, strict=True)
    ]
    clear = bool(np.all(sigmas**2 >= TOLD_APART))
    hardest = believers[1 + int(np.argmin(sigmas))].label
    why = (
        f"It would set {believers[0].label} apart from {hardest} by {sigmas.min():.1f} standard errors, after what "
        f"their parameters are still uncertain by ({told_bits:.2f} bits in {hours:.3g} h; best per hour of {len(good)} candidates)."
    )
    also = (
        None
        if clear
        else _sensor(
            case,
            believers,
            told,
            weights,
            sigma,
            seen,
            outputs,
            np.sqrt(step / max(step, chosen.duration_s / points)),
            D,
        )
    )
    inputs = {n: c.tolist() for n, c in chosen.corners.items()} | {
        n: [[0.0, v]] for n, v in chosen.starts.items() if n in case.plant.inputs
    }
    entry = {
        "profile": chosen.title,
        "why": why,
        "also_helpful": also,
        "duration_s": chosen.duration_s,
        "sample_s": step,
        "hours": hours,
        "bits": told_bits,
        "bits_per_hour": told_bits / hours,
        "candidates": len(good),
        "separates": apart,
        "inputs": inputs,
        "predicted": _predicted(case, outputs, told),
        "limits": {n: list(span) for n, span in limits.items()},
        "file": FILES[0],
    }
    return entry, chosen


def _smaller(lever: Lever, share: float) -> Lever:
    """The lever with its range drawn together about its rest."""
    return dataclasses.replace(
        lever,
        low=lever.rest + share * (lever.low - lever.rest),
        high=lever.rest + share * (lever.high - lever.rest),
    )


def _recorded(case: Case, j: int) -> np.ndarray:
    """All readings of output number j."""
    return np.concatenate([d.y[np.isfinite(d.y[:, j]), j] for d in case.drives])


def _leaves(case: Case, outputs: Sequence[str], told: Sequence[Any], limits: Limits) -> bool:
    """Whether any hypothesis predicts a reading outside its limits. Where none are given: outside the recorded range, which is
    widened only to where the rig starts from."""
    for j, o in enumerate(outputs):
        y = _recorded(case, j)
        for p in told if len(y) or o in limits else ():
            low, high = (
                limits.get(o, (min(y.min(), p[0][0, j]), max(y.max(), p[0][0, j]))) if len(y) else limits[o]
            )
            if p[0][:, j].min() < low or p[0][:, j].max() > high:
                return True
    return False


def _predicted(case: Case, outputs: Sequence[str], told: Sequence[Any]) -> dict[str, dict[str, Any]]:
    """For each output its unit, the lowest and highest value that any hypothesis predicts, and what was recorded."""
    out = {}
    for j, o in enumerate(outputs):
        y = _recorded(case, j)
        out[o] = {
            "unit": case.plant.outputs[o].unit,
            "column": case.plant.outputs[o].column,
            "low": float(min(p[0][:, j].min() for p in told)),
            "high": float(max(p[0][:, j].max() for p in told)),
            "recorded": [float(y.min()), float(y.max())] if len(y) else None,
        }
    return out


def peaks(entry: Mapping[str, Any]) -> list[str]:
    """The predicted range of every reading of a proposal beside what was recorded, and the limits it was kept in, as lines."""
    lines = []
    for name, p in entry["predicted"].items():
        unit = f" {p['unit']}" if p["unit"] else ""
        known = (
            f"recorded {p['recorded'][0]:.4g} to {p['recorded'][1]:.4g}"
            if p["recorded"]
            else "never recorded"
        )
        limit = entry["limits"].get(name)
        kept = f", --limit {limit[0]:g} to {limit[1]:g}" if limit else ""
        lines.append(f"{name}: {p['low']:.4g} to {p['high']:.4g}{unit} predicted ({known}{kept})")
    return lines


def _sensor(
    case: Case,
    believers: Sequence[_Believer],
    told: Sequence[Any],
    weights: np.ndarray,
    sigma: np.ndarray,
    seen: Sequence[int],
    outputs: Sequence[str],
    share: float,
    D: np.ndarray,
) -> str:
    """Where even the best experiment leaves doubt: the stored quantity whose own sensor would tell most, in words."""
    first, best = believers[0], (bits(D, weights), "")
    for node in case.plant.nodes.values():
        if any(
            o.value.op == "name" and o.value.value == node.name
            for k, o in enumerate(case.plant.outputs.values())
            if k in seen
        ):
            continue
        alike = [sigma[j] for j in seen if case.plant.outputs[outputs[j]].unit == node.unit]
        if not alike or any(node.name not in b.model.states for b in believers):
            continue
        more = D.copy()
        for i, a in enumerate(believers):
            for k, b in enumerate(believers[:i]):
                pairs = [(a.model.outputs.index(outputs[j]), b.model.outputs.index(outputs[j])) for j in seen]
                pairs.append(
                    (
                        len(a.model.outputs) + a.model.states.index(node.name),
                        len(b.model.outputs) + b.model.states.index(node.name),
                    )
                )
                more[i, k] = more[k, i] = distance(
                    told[i], told[k], pairs, np.append(sigma[seen], np.median(alike)) * share
                )
        if (found := bits(more, weights)) > best[0] + 0.1:
            best = (found, node.name)
    if best[1]:
        return (
            f"A sensor of its own at {best[1]} would tell more ({best[0]:.2f} bits with the same experiment)."
        )
    return (
        f"No experiment of the family decides for sure between {first.label} and the others inside the recorded limits; a larger range of "
        "the inputs or another sensor would be needed."
    )


# --------------------------------------------------------------------------------------------------------- the file


def write(folder: Path, case: Case, entry: Mapping[str, Any], chosen: Excitation) -> list[str]:
    """next_experiment.yaml, which `thermoctl experiment` runs, and next_experiment.csv, the same inputs over time by their columns,
    for a person; returns their names. On the program's own rig it is the setpoint that is driven."""
    plant = case.plant
    driven = {plant.inputs[n].column: (plant.inputs[n].unit, c) for n, c in chosen.corners.items()}
    if (corners := _as_setpoint(case, chosen)) is not None:
        driven = {SETPOINT: ("um", corners)}
    lines = [
        f"# {chosen.title}",
        f"# {entry['why']}",
        *(f"# {line}" for line in peaks(entry)),
        f"format: {FORMAT}",
        "experiments:",
        "  next_experiment:",
        f"    title: {json.dumps(chosen.title)}",
        f"    sample_s: {entry['sample_s']:.9g}",
        "    inputs:",
    ]
    for column, (unit, c) in driven.items():
        lines.append(
            f"      {json.dumps(column)}: {{"
            + (f"unit: {json.dumps(unit)}, " if unit else "")
            + f"corners: [{', '.join(f'[{t:.9g}, {v:.9g}]' for t, v in c)}]}}"
        )
    still = {plant.inputs[n].column: v for n, v in chosen.starts.items() if n in plant.inputs}
    if still:
        lines.append("    assumed:            # what the surroundings were taken to be; not driven")
        lines += [f"      {json.dumps(column)}: {v:.9g}" for column, v in still.items()]
    if entry["predicted"]:
        lines.append(
            "    predicted:          # lowest and highest of each reading; checked against the rig's protection"
        )
        lines += [
            f"      {json.dumps(p['column'])}: [{p['low']:.6g}, {p['high']:.6g}]"
            for p in entry["predicted"].values()
        ]
    (folder / FILES[0]).write_text("\n".join(lines) + "\n", encoding="utf-8")
    t = np.arange(0.0, chosen.duration_s + 1e-9, max(entry["sample_s"], chosen.duration_s / 20_000))
    write_table(
        folder / FILES[1],
        Table(
            "next_experiment",
            FILES[1],
            t,
            {n: np.interp(t, c[:, 0], c[:, 1]) for n, (_, c) in driven.items()},
        ),
    )
    return list(FILES)


def _as_setpoint(case: Case, chosen: Excitation) -> np.ndarray | None:
    """The corners of the setpoint that makes a driven input what it should be, where the recordings show one to follow it."""
    if any(SETPOINT not in t.columns for t in case.tables):
        return None
    setpoint = np.concatenate([t.columns[SETPOINT] for t in case.tables])
    for n, c in chosen.corners.items():
        values = np.concatenate([t.columns[case.plant.inputs[n].column] for t in case.tables])
        both = np.isfinite(values) & np.isfinite(setpoint)
        if both.sum() > 10 and abs(np.corrcoef(values[both], setpoint[both])[0, 1]) > TOGETHER:
            factor, offset = np.polyfit(values[both], setpoint[both], 1)
            inside = np.clip(c[:, 1] * factor + offset, np.nanmin(setpoint), np.nanmax(setpoint))
            return np.column_stack([c[:, 0], inside])
    return None


# -------------------------------------------------------------------------------------------- run it and decide again


def resolve(
    diagnosed: Callable[[Sequence[str]], dict[str, Any]],
    recordings: Sequence[str],
    out: Path,
    record: Callable[[Path, Path], None],
    rounds: int = ROUNDS,
    told: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Diagnose; while nothing is decided run the proposed experiment on the rig and decide again with its data, `rounds` times at
    most. `diagnosed(recordings)` writes a result into `out`; `record(experiment, recording)` runs an experiment file on the rig.
    The last result says in `resolved` what was run and how the verdict moved."""
    paths, history = list(recordings), []
    result = diagnosed(paths)
    for k in range(1, rounds + 1):
        if not result["next_experiment"]:
            break
        before = {
            "verdict": result["verdict"],
            "findings": [(f["effect"], f["where"], f["probability"]) for f in result["findings"]],
        }
        told(f"round {k}: {before['verdict']}; running: {result['next_experiment']['profile']}")
        recording = out / f"round_{k}.csv"
        record(out / FILES[0], recording)
        history.append(
            {**before, "experiment": result["next_experiment"]["profile"], "recording": str(recording)}
        )
        paths.append(str(recording))
        result = diagnosed(paths)
    result["resolved"] = history
    (out / "diagnosis.json").write_text(
        json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    return result
