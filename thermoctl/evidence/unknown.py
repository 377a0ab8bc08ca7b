"""What no entry explains: how large the remainder is in the sensors' units, at which node it enters, and what it follows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from thermoctl.evidence.case import Case
from thermoctl.evidence.fit import Fitted
from thermoctl.evidence.noise import averaged
from thermoctl.evidence.remainder import SHARES


@dataclass(frozen=True)
class Left:
    """The residual beside the sensors' noise. `rms`, `over_noise`: by output; `node`: where forces explain it best, None where
    errors of the sensors do; `log_odds`: of that node against the second best; `share`: of the node's typical flow."""

    rms: dict[str, float]
    noise: dict[str, float]
    over_noise: dict[str, float]
    node: str | None
    log_odds: float
    share: float


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
    return Left(
        rms,
        noise,
        over,
        node,
        scores[best] - rest if np.isfinite(rest) else 0.0,
        min(shares[best], float(SHARES[-1])),
    )
