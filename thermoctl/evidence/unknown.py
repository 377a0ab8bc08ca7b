"""What no entry explains: how large the remainder is in the sensors' units, at which node it enters, and what it follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from thermoctl.evidence.case import Case
from thermoctl.evidence.fit import Fitted
from thermoctl.evidence.remainder import signals

CORRELATED, SHOWN = 0.4, 3  # correlation from which a signal is told, and how many are


@dataclass(frozen=True)
class Left:
    """The residual beside the sensors' noise. `rms`, `over_noise`: by output; `node`: where forces explain it best;
    `log_odds`: of that node against the others; `share`: of the node's typical flow; `follows`: signals that the residual goes with."""

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
    for g, own in zip(case.grids, f.average.sensor, strict=True):
        name = case.null.model.outputs[case.coordinates.channels[g.channels[0]].output]
        power = sum(float(f.powers[k].sum()) for k in g.channels) / g.count.sum()
        own = max(own, g.variance)
        rms[name] = float(np.sqrt(max(power - own, 0.0)))
        noise[name] = float(np.sqrt(own))
        over[name] = float(np.sqrt(power / own))
    node, log_odds, share = _located(case, f)
    worst = max(over, key=lambda o: over[o]) if over else ""
    return Left(
        rms, noise, over, node, log_odds, share, follows(case, f, worst) if over and over[worst] > 1 else ()
    )


def _located(case: Case, f: Fitted) -> tuple[str | None, float, float]:
    """The node whose random forces explain the residuals best, its log odds against the others, the forces' typical size."""
    outputs = [g.channels for g in case.grids]
    scores, shares = [], []
    for i in range(len(case.remainder.nodes)):
        by_cell = np.zeros(len(case.remainder.share))
        for g, own, cells in zip(
            case.grids, f.average.sensor, case.remainder.cells(case.coordinates, outputs, i), strict=True
        ):
            count = np.concatenate([case.coordinates.channels[k].count for k in g.channels])
            power = np.concatenate([f.powers[k] for k in g.channels])
            by_cell -= 0.5 * (count * np.log(own + cells) + power / (own + cells)).sum(axis=1)
        total = float(logsumexp(by_cell))
        scores.append(total)
        shares.append(float(np.exp(by_cell - total) @ case.remainder.share))
    if not scores:
        return None, 0.0, 0.0
    best = int(np.argmax(scores))
    rest = [s for k, s in enumerate(scores) if k != best]
    return case.remainder.nodes[best], scores[best] - float(logsumexp(rest)) if rest else 0.0, shares[best]


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
