"""Where simulation and recording part: one smooth unknown input at a time, at each node and on each sensor.

A node's unknown flow q(t) (straight lines between knots) drives the linearised plant; a sensor's unknown error adds to its
output alone. Which one explains most of the residual, at equal freedom, is where the mismatch sits: a sensor's fault does not
propagate, a node's does. The best node's flow is then recovered on a finer grid, and compared with the recorded signals.

Physics that nobody listed is still a function of the rig's state, which a sensor's noise is not. `patterns` therefore tries, at
first order, an unknown function g (straight lines between knots) of one signal s at a time,

    storage_n dn/dt += g(s)   at each node,      rate_f *= 1 + g(s)   in each flow      and      storage_n /= 1 + g(n)   of each node,

the first two with a g for each direction of motion where the node is a velocity, and dynamics that the plant lacks between a flow
that follows inputs and its nodes: the flow through a bank of damped resonators (poles exp((-DAMPING +- i) w_k h), frequencies over
the whole band) beside itself. Noise is independent of past inputs, whatever its colour (Ljung, System Identification, 16.6).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

from thermoctl.diagnose.effects import Rig
from thermoctl.diagnose.evidence import Colour
from thermoctl.diagnose.screen import Metric, Trajectory, _Column, directions, log_p
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant

COARSE, FINE = 10, 40  # knots a recording
LEVELS = 8  # knots over the values of a signal
RESONATORS, DAMPING = 12, 0.1  # from two periods a recording to a quarter of the sampling rate
PEAKS = 16  # the same for a storage, where a change of phase is narrow
CYCLES = 3, 200  # fewest and most of a rhythm in the longest recording
HARMONICS = (1, 2, 4)  # that are summed
BANDS, SLOWEST, LEAST = 14, 2, 4  # of frequencies, from two cycles a recording on; fewest coefficients of one


@dataclass
class Suspect:
    """A node or an output with an unknown smooth input, a node, flow or storage with an unknown function of a signal, a flow
    with unknown dynamics, or two outputs that share something: how much of the residual it explains."""

    kind: str  # 'node', 'output', 'flow', 'storage', 'dynamics', 'rhythm' or 'together'
    name: str
    gain: float
    dims: int
    follows: str | None = None  # the signal that it is a function of; None: of time
    period: float = 0.0  # of a rhythm, s
    looks: int = 1  # of which this is the best

    @property
    def log_p(self) -> float:
        """log10 of the chance of such a gain by noise."""
        return log_p(self.gain, self.dims) + float(np.log10(self.looks))

    def sentence(self) -> str:
        """In words."""
        if self.kind == "dynamics":
            return f"dynamics between {self.name} and what it drives (a resonance, a slow part) would explain it best"
        if self.kind == "rhythm":
            return f"a rhythm of {self.period:.4g} s of its own in {self.name} would explain it best"
        if self.kind == "together":
            return f"{self.name} share what is left of them, which the noise of two sensors does not"
        what = {
            "node": "an unknown flow into",
            "output": "an unknown error of",
            "flow": "an unknown factor of",
            "storage": "an unknown factor of the storage of",
        }[self.kind]
        return f"{what} {self.name}, a function of {self.follows or 'time'}, would explain it best"


@dataclass
class Missing:
    """A recovered unknown flow into a node: per recording its times and values (unit of storage times node per second)."""

    node: str
    t: list[np.ndarray]
    flow: list[np.ndarray]
    rms: float
    when: list[list[float]]
    follows: list[str]


def _hats(t: np.ndarray, knots: int) -> np.ndarray:
    edges = np.linspace(t[0], t[-1], knots)
    return np.stack([np.interp(t, edges, row) for row in np.eye(knots)])


def _columns(metric: Metric, kind: str, index: int, knots: int) -> list[_Column]:
    out = []
    n = len(metric.drives)
    for r, d in enumerate(metric.drives):
        for hat in _hats(d.t, knots):
            column = _Column((index,))
            for q in range(n):
                column.forces.append({index: hat} if kind == "node" and q == r else {})
                column.outputs.append({index: hat} if kind == "output" and q == r else {})
            out.append(column)
    return out


def suspects(metric: Metric) -> list[Suspect]:
    """Every node and every output with an unknown smooth input, likeliest first."""
    found = []
    for kind, names in (("node", metric.model.states), ("output", metric.model.outputs)):
        for index, label in enumerate(names):
            columns = _columns(metric, kind, index, COARSE)
            rows = np.concatenate([metric.project(part) for _, part in directions(metric, columns)], axis=1)
            gain, dims = _gain(rows, metric.residual)
            if dims:
                found.append(Suspect(kind, label, gain, dims))
    return sorted(found, key=lambda s: s.log_p)


def patterns(metric: Metric, rig: Rig) -> list[Suspect]:
    """Every node and flow with an unknown function of one signal, likeliest first."""
    at = [Trajectory(metric, rig, r) for r in range(len(metric.drives))]
    plant, states = rig.plant, list(metric.model.states)
    signals = {n: [run.x[:, k] for run in metric.runs] for k, n in enumerate(states)}
    signals |= {
        i: [d.u[:, j] for d in metric.drives] for j, i in enumerate(plant.inputs) if i in rig.moving_inputs
    }
    hats = {n: _levels(parts, LEVELS) for n, parts in signals.items()}
    peaks = {n: _levels(signals[n], PEAKS) for n in states}
    places: list[tuple[str, str, list[tuple[str, float]]]] = [("node", n, [(n, 1.0)]) for n in states]
    for f in plant.flows.values():
        places.append(
            (
                "flow",
                f.name,
                [
                    (n, s)
                    for n, s in ((f.source, -1.0), (f.target, 1.0))
                    if n is not None and n in plant.nodes
                ],
            )
        )
    columns: list[_Column] = []
    for f in plant.flows.values():
        if ex.names(f.rate) & rig.moving_inputs and not ex.names(f.rate) & set(states):
            ends = [
                (n, s) for n, s in ((f.source, -1.0), (f.target, 1.0)) if n is not None and n in plant.nodes
            ]
            parts = []
            for trajectory in at:
                bank = _resonators(trajectory.value(f.rate, {}), trajectory.drive.t)
                parts.append(
                    [
                        {
                            states.index(n): sign * b / trajectory.value(plant.nodes[n].storage, {})
                            for n, sign in ends
                        }
                        for b in bank
                    ]
                )
            columns += [
                _Column(("dynamics", f.name, None), list(forces), [{} for _ in at])
                for forces in zip(*parts, strict=True)
            ]
    places += [("storage", n, [(n, 1.0)]) for n in states]
    for kind, name, ends in places:
        base = []
        for trajectory in at:
            if kind == "storage":
                k = states.index(name)
                base.append({k: np.gradient(trajectory.run.x[:, k], trajectory.drive.t)})
                continue
            rate = (
                trajectory.value(plant.flows[name].rate, {})
                if kind == "flow"
                else np.ones(len(trajectory.drive.t))
            )
            base.append(
                {
                    states.index(n): sign * rate / trajectory.value(plant.nodes[n].storage, {})
                    for n, sign in ends
                }
            )
        moving = next((signals[n] for n, _ in ends if n in rig.velocities), None)
        sides = (
            [[np.ones(len(d.t)) for d in metric.drives]]
            if moving is None
            else [[v > 0 for v in moving], [v < 0 for v in moving]]
        )
        near = [n for n, _ in ends]
        if kind == "storage":
            sides = [[np.ones(len(d.t)) for d in metric.drives]]
        else:
            near += [i for i in rig.moving_inputs if kind == "node" or i in ex.names(plant.flows[name].rate)]
        if moving is not None and kind != "storage":
            near += [n for n in states if n not in near]
        for s in near:
            for hat, side in itertools.product((peaks if kind == "storage" else hats)[s], sides):
                column = _Column((kind, name, s), outputs=[{} for _ in at])
                for forces, h, on in zip(base, hat, side, strict=True):
                    column.forces.append({k: v * h * on for k, v in forces.items()})
                columns.append(column)
    rows: dict[tuple[Any, ...], list[np.ndarray]] = {}
    for part, block in directions(metric, columns):
        block = metric.project(block)
        for k, column in enumerate(part):
            rows.setdefault(column.item, []).append(block[:, k])
    found = []
    for (kind, name, s), vectors in rows.items():
        gain, dims = _gain(np.stack(vectors, axis=1), metric.residual)
        if dims:
            found.append(Suspect(kind, name, gain, dims, s))
    return sorted(found, key=lambda suspect: suspect.log_p)


def rhythms(metric: Metric) -> list[Suspect]:
    """The best period of each output, likeliest first."""
    span = max(float(d.t[-1] - d.t[0]) for d in metric.drives)
    parts: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    at = 0
    for r, d in enumerate(metric.drives):
        for j, (index, _, _) in enumerate(metric.problem.rows[r]):
            t = d.t[index]
            if metric.blocks > 1 and len(t):
                t = t[: len(t) // metric.blocks * metric.blocks].reshape(-1, metric.blocks).mean(axis=1)
            w = metric.residual[at : at + len(t)]
            at += len(t)
            if len(t) > 4 * CYCLES[0]:
                parts.setdefault(j, []).append((t, np.clip(w, -4, 4) if np.std(w) < 2 else w))
    found = []
    for j, series in parts.items():
        fastest = min(0.25 / float(np.median(np.diff(t))) for t, _ in series)  # 1/s
        f = np.arange(CYCLES[0] / span, min(fastest, CYCLES[1] / span), 1 / (3 * span))
        if not len(f):
            continue
        power = np.zeros(len(f) * max(HARMONICS))  # at f_0 + k/(3 span), also for harmonics
        grid = f[0] + np.arange(len(power)) / (3 * span)
        grid = grid[grid <= fastest]
        for t, w in series:
            size = max(float(np.var(w)), 1.0)
            power[: len(grid)] += (
                2 * np.abs(np.exp(-2j * np.pi * grid[:, None] * t) @ w) ** 2 / (len(t) * size)
            )
        for count in HARMONICS:
            total, dims = np.zeros(len(f)), np.zeros(len(f), dtype=int)
            for h in range(1, count + 1):
                k = np.rint((h * f - f[0]) * 3 * span).astype(int)
                inside = h * f <= grid[-1]
                total[inside] += power[k[inside]]
                dims[inside] += 2 * len(series)
            full = dims == 2 * len(series) * count
            if full.any():
                best = int(np.argmax(np.where(full, total, 0.0)))
                found.append(
                    Suspect(
                        "rhythm",
                        metric.model.outputs[j],
                        float(total[best]),
                        int(dims[best]),
                        None,
                        float(1 / f[best]),
                        len(f) * len(HARMONICS),
                    )
                )
    return sorted(found, key=lambda s: s.log_p)


def together(residuals: Sequence[np.ndarray], colours: Sequence[Colour], plant: Plant) -> list[Suspect]:
    """Every pair of outputs, measured by themselves, in what their residuals (N, outputs; per recording) share; likeliest first."""
    columns = [o.column for o in plant.outputs.values()]
    names, longest = list(plant.outputs), max(map(len, residuals))
    spectra = []
    for r in residuals:
        innovations = [
            np.clip(lfilter(c.ar, c.ma, np.nan_to_num(r[:, j])) / c.sigma, -5, 5)
            for j, c in enumerate(colours)
        ]
        spectra.append(np.fft.rfft(np.stack(innovations, axis=1), axis=0))
    edges = np.geomspace(SLOWEST, max(longest // 2, SLOWEST + 1), BANDS)
    bands = []
    for low, high in itertools.pairwise(edges):
        parts = [
            s[round(low * len(r) / longest) : round(high * len(r) / longest)]
            for s, r in zip(spectra, residuals, strict=True)
        ]
        bands.append(np.concatenate(parts))
    bands = [b for b in bands if len(b) >= LEAST]
    if not bands:
        return []
    gain = np.zeros((len(names), len(names)))
    for b in bands:
        cross = b.conj().T @ b
        power = np.diag(cross).real
        shared = np.abs(cross) ** 2 / np.maximum(np.outer(power, power), 1e-30)
        gain -= 2 * (len(b) - 1) * np.log1p(-np.minimum(shared, 1 - 1e-12))
    pairs = [(i, j) for i, j in itertools.combinations(range(len(names)), 2) if columns[i] != columns[j]]
    found = [
        Suspect("together", f"{names[i]} and {names[j]}", float(gain[i, j]), 2 * len(bands), looks=len(pairs))
        for i, j in pairs
    ]
    return sorted(found, key=lambda s: s.log_p)


def _resonators(u: np.ndarray, t: np.ndarray) -> list[np.ndarray]:
    """What each of the bank makes of a signal, both quadratures."""
    h = float(np.median(np.diff(t)))
    out = []
    for w in np.geomspace(4 * np.pi * h / float(t[-1] - t[0]), np.pi / 2, RESONATORS):
        pole = np.exp((-DAMPING + 1j) * w)
        z = lfilter([1 - abs(pole)], [1, -pole], u - u[0])
        out += [z.real, z.imag]
    return out


def _levels(parts: list[np.ndarray], count: int) -> list[list[np.ndarray]]:
    """Hats over the values of a signal, per hat and recording; none where it takes too few values."""
    edges = np.unique(np.quantile(np.concatenate(parts), np.linspace(0.01, 0.99, count)))
    if len(edges) < 2:
        return []
    return [[np.interp(p, edges, row) for p in parts] for row in np.eye(len(edges))]


def _gain(rows: np.ndarray, r: np.ndarray) -> tuple[float, int]:
    size = np.linalg.norm(rows, axis=0)
    keep = size > 1e-9
    if not keep.any():
        return 0.0, 0
    scaled = rows[:, keep] / size[keep]
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    good = values > 1e-6 * values[-1]
    z = (vectors[:, good].T @ (scaled.T @ r)) / np.sqrt(values[good])
    return float(z @ z), int(good.sum())


def missing_flow(metric: Metric, node: str, signals: dict[str, list[np.ndarray]]) -> Missing:
    """The unknown flow into a node that the residual asks for: knots of a smooth curve, ridge chosen by cross-validation.
    `signals`: name to per-recording arrays, to say which the flow follows."""
    index = metric.model.states.index(node)
    columns = _columns(metric, "node", index, FINE)
    rows = np.concatenate([part for _, part in directions(metric, columns)], axis=1)
    rows = metric.project(rows)
    gram, g = rows.T @ rows, rows.T @ metric.residual
    scale = float(np.trace(gram)) / len(gram) or 1.0
    rough = np.zeros_like(gram)
    for r in range(len(metric.drives)):
        second = np.diff(np.eye(FINE), 2, axis=0)
        rough[r * FINE : (r + 1) * FINE, r * FINE : (r + 1) * FINE] = second.T @ second
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for ridge in 10.0 ** np.arange(-8, 2):
        inverse = np.linalg.inv(gram + scale * ridge * rough + 1e-10 * scale * np.eye(len(gram)))
        q = inverse @ g
        dof = float(np.trace(inverse @ gram))
        left = float(metric.residual @ metric.residual - 2 * q @ g + q @ gram @ q)
        gcv = left / max(len(metric.residual) - 1.4 * dof, 1.0) ** 2
        if best is None or gcv < best[0]:
            best = (gcv, q, inverse)
    assert best is not None
    q, inverse = best[1], best[2]
    storage = metric.model.plant.nodes[node].storage
    times, flows, when = [], [], []
    sd = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    for r, d in enumerate(metric.drives):
        known = dict(zip(metric.model.parameters, map(float, metric.fit.values[r]), strict=True))
        mean_x = dict(zip(metric.model.states, metric.runs[r].x.mean(axis=0), strict=True))
        mean_u = dict(zip(metric.model.inputs, d.u.mean(axis=0), strict=False))
        c = float(ex.evaluate(storage, {**known, **mean_u, **mean_x}))
        edges = np.linspace(d.t[0], d.t[-1], FINE)
        part = q[r * FINE : (r + 1) * FINE] * c
        times.append(edges)
        flows.append(part)
        seen = np.abs(part) > np.maximum(3 * sd[r * FINE : (r + 1) * FINE] * c, 0.25 * np.max(np.abs(part)))
        when.append(_intervals(edges, seen))
    rms = float(np.sqrt(np.mean(np.concatenate(flows) ** 2)))
    likeness = {}
    for key, parts in signals.items():
        a = np.concatenate(
            [np.interp(edges, d.t, s) for edges, d, s in zip(times, metric.drives, parts, strict=True)]
        )
        b = np.concatenate(flows)
        if np.ptp(a) > 0 and np.ptp(b) > 0:
            likeness[key] = abs(float(np.corrcoef(a, b)[0, 1]))
    follows = [k for k in sorted(likeness, key=lambda k: -likeness[k]) if likeness[k] > 0.5][:3]
    return Missing(node, times, flows, rms, [w for part in when for w in part], follows)


def _intervals(t: np.ndarray, on: np.ndarray) -> list[list[float]]:
    out: list[list[float]] = []
    for k in map(int, np.flatnonzero(on)):
        lo, hi = float(t[max(k - 1, 0)]), float(t[min(k + 1, len(t) - 1)])
        if out and lo <= out[-1][1]:
            out[-1][1] = hi
        else:
            out.append([lo, hi])
    return out


__all__ = ["Missing", "Suspect", "missing_flow", "patterns", "rhythms", "suspects", "together"]
