"""The remainder of a hypothesis: its size in the sensors' units, its node, signals that correlate with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.evidence.levels import levels, over_noise
from thermoctl.diagnosis.evidence.where import Responses, along, responses
from thermoctl.diagnosis.hypothesis.rig import Rig

CORRELATED, SHOWN = 0.4, 3  # reported signals: least correlation with the residual; largest number


@dataclass(frozen=True)
class Left:
    """The part of the residual that the sensors' noise does not explain.

    - `rms`: rms of that part; `noise`: rms of the noise (`levels`); by output, in the output's unit
    - `over_noise`: rms of the whole residual divided by `noise`, by output
    - `node`: the node whose random forces explain the residual best
    - `follows`: signals that correlate with the residual of the output with the largest `over_noise`"""

    rms: dict[str, float]
    noise: dict[str, float]
    over_noise: dict[str, float]
    node: str | None
    follows: tuple[str, ...]


def left(case: Case, f: Fitted, reach: Responses) -> Left:
    """Measure and locate the residual of a fitted hypothesis."""
    measured = [g.output for g in case.grids]
    over = dict(zip(measured, over_noise(case, f), strict=True))
    noise = dict(zip(measured, levels(case, f), strict=True))
    rms = {o: noise[o] * float(np.sqrt(max(ratio**2 - 1, 0.0))) for o, ratio in over.items()}
    worst = max(over, key=lambda o: over[o])
    follow = follows(case, f, worst) if over[worst] > 1 else ()
    return Left(rms, noise, over, next(iter(located(case, f, reach)), None), follow)


def reached(case: Case) -> Responses:
    """Return how random forces at the nodes of the refitted original plant change its outputs."""
    rates = set(Rig(case.plant, [], []).pairs.values())  # positions store nothing
    return responses(case.null, case.drives(case.null.model), case.coordinates, rates)


def located(case: Case, f: Fitted, reach: Responses) -> list[str]:
    """Return the nodes, sorted by how well random forces there explain the residuals, the best first."""
    scores = {}
    for i, node in enumerate(reach.nodes):
        by_cell = np.zeros(len(reach.share))
        for g, own in zip(case.grids, f.average.sensor, strict=True):
            channels = [(k, case.coordinates.channels[k]) for k in g.channels]
            cells = np.concatenate([reach.cells(k, c, i) for k, c in channels], axis=1)
            count = np.concatenate([c.count for _, c in channels])
            power = np.concatenate([f.powers[k] for k in g.channels])
            by_cell -= 0.5 * (count * np.log(own + cells) + power / (own + cells)).sum(axis=1)
        scores[node] = float(logsumexp(by_cell))
    return sorted(scores, key=lambda n: -scores[n])


def follows(case: Case, f: Fitted, output: str) -> tuple[str, ...]:
    """Return signals, or their changes, whose correlation with an output's residual is CORRELATED or more.

    The strongest is first; there are at most SHOWN."""
    model, j = f.fit.model, f.fit.model.outputs.index(output)
    products: dict[str, list[tuple[float, float, float]]] = {}
    drives = case.drives(model)
    for d, values, errors in zip(drives, along(f.fit, drives), f.fit.residuals, strict=True):
        e = errors[:, j]
        for name in (*model.plant.inputs, *case.plant.nodes):
            x = np.asarray(values[name], float)
            for label, signal in ((name, x), (f"change of {name}", np.gradient(x, d.t))):
                good = np.isfinite(e) & np.isfinite(signal)
                a, b = e[good] - e[good].mean(), signal[good] - signal[good].mean()
                products.setdefault(label, []).append((float(a @ b), float(a @ a), float(b @ b)))
    size = {}
    for label, parts in products.items():
        cross, first, second = np.sum(parts, axis=0)
        size[label] = abs(cross) / np.sqrt(first * second) if first * second > 0 else 0.0
    return tuple(sorted((k for k, v in size.items() if v >= CORRELATED), key=lambda k: -size[k])[:SHOWN])
