"""What no entry explains: how large the remainder is in the sensors' units, at which node it enters, and what it follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from thermoctl.evidence.case import Case
from thermoctl.evidence.fit import Fitted
from thermoctl.evidence.noise import averaged
from thermoctl.evidence.remainder import SHARES, signals

CORRELATED, SHOWN = 0.4, 3  # correlation from which a signal is told, and how many are


@dataclass(frozen=True)
class Left:
    """The residual beside the sensors' noise. `rms`, `over_noise`: by output; `node`: where forces explain it best, None where
    errors of the sensors do; `log_odds`: of that node against the second best; `share`: of the node's typical
    flow; `follows`: signals that the residual goes with."""

    rms: dict[str, float]
    noise: dict[str, float]
    over_noise: dict[str, float]
    node: str | None
    log_odds: float
    share: float
    follows: tuple[str, ...]


def left(case: Case, f: Fitted) -> Left:
    """Measure what a fitted hypothesis leaves, and locate it."""
    rms, noise, over = {}, {}, {}
    for g, sensor in zip(case.grids, f.average.sensor, strict=True):
        name = case.null.model.outputs[case.coordinates.channels[g.channels[0]].output]
        power = sum(float(f.powers[k].sum()) for k in g.channels) / g.count.sum()
        own = max(
            float(sensor.min()), g.variance
        )  # the white part; a slow part that is not stated is no sensor's
        rms[name] = float(np.sqrt(max(power - own, 0.0)))
        noise[name] = float(np.sqrt(own))
        over[name] = float(np.sqrt(power / own))
    scores, shares = [], []
    for i in range(-1, len(case.remainder.nodes)):
        cells = (
            case.cells
            if i < 0
            else case.remainder.cells(case.coordinates, [g.channels for g in case.grids], i)
        )
        if i < 0:
            cells = tuple(c[:1] for c in cells)
        prior = case.remainder.prior[:1] * 0.0 if i < 0 else np.full(len(cells[0]), -np.log(len(cells[0])))
        found = averaged(case.grids, f.powers, cells, prior)
        scores.append(found.log_likelihood)
        shares.append(float(found.cells @ case.remainder.share[: len(found.cells)]))
    order = np.argsort(scores)[::-1]
    best = int(order[0])
    rest = float(logsumexp([scores[k] for k in order[1:]])) if len(order) > 1 else -np.inf
    node = case.remainder.nodes[best - 1] if best else None
    worst = max(over, key=lambda o: over[o]) if over else ""
    return Left(
        rms,
        noise,
        over,
        node,
        scores[best] - rest if np.isfinite(rest) else 0.0,
        min(shares[best], float(SHARES[-1])),
        follows(case, f, worst) if over and over[worst] > 1 else (),
    )


def follows(case: Case, f: Fitted, output: str) -> tuple[str, ...]:
    """The signals (and their changes) that correlate with an output's residual by CORRELATED or more, the strongest first."""
    model, j = f.fit.model, f.fit.model.outputs.index(output)
    found: dict[str, list[tuple[float, float, float]]] = {}
    for r, d in enumerate(case.drives(model)):
        values = signals(model, d, f.fit.values[r], model.run(d, f.fit.values[r], f.fit.dx0[r]).x)
        e = f.fit.residuals[r][:, j]
        for name in (*model.plant.inputs, *case.plant.nodes):
            x = np.broadcast_to(np.asarray(values[name], float), d.t.shape)
            for label, signal in ((name, x), (f"change of {name}", np.gradient(x, d.t))):
                good = np.isfinite(e) & np.isfinite(signal)
                a, b = e[good] - e[good].mean(), signal[good] - signal[good].mean()
                found.setdefault(label, []).append((float(a @ b), float(a @ a), float(b @ b)))
    size = {}
    for label, parts in found.items():
        cross, first, second = np.sum(parts, axis=0)
        size[label] = abs(cross) / np.sqrt(first * second) if first * second > 0 else 0.0
    return tuple(sorted((k for k, v in size.items() if v >= CORRELATED), key=lambda k: -size[k])[:SHOWN])
