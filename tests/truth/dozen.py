"""What if all that nobody named is worth a dozen draws, and no rule asks what stands out of a misfit?

In place of the rules of verdict/misfit.py, each row of the likelihood has a weight. With s_b the share of noise in
the variance of a row under the likeliest hypothesis (1 as far as there is no remainder), and M = sum n_b (1 - s_b),

    weight_b = s_b + (1 - s_b) min(1, DRAWS / M)

So rows of noise count in full, and the rows of a misfit as DRAWS, wherever in frequency they are: also on a rig that
swings hundreds of times. An effect's own parameters cost half the logarithm of the weighed number of rows.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.diagnose import Sought
from thermoctl.diagnosis.evidence.fit import Fitted

DRAWS = 48.0  # 12: 14, 24: 19, 48: 21, 100: 22 of 34 right names on real rigs; 26 with the rules
ROUNDS = 6  # of choosing the likeliest hypothesis by the weights of the one before

Rows = list[
    tuple[np.ndarray, np.ndarray, np.ndarray]
]  # by output: number of rows, log densities, shares of noise


def weighed(found: Sought) -> Sought:
    """Return the same search with the log evidence of each hypothesis by weighed rows."""
    tried = found.searched.tried
    rows = [_rows(found.case, w.fitted) for w in tried]
    leader = int(np.argmax([w.score for w in tried]))
    scores: list[float] = []
    for _ in range(ROUNDS):
        weights = [s + (1 - s) * min(1.0, DRAWS / max(n @ (1 - s), 1e-9)) for n, _, s in rows[leader]]
        scores = [
            w.score + _change(own, weights, sum(len(e.own) for e in w.fitted.hypothesis.effects))
            for w, own in zip(tried, rows, strict=True)
        ]
        if (best := int(np.argmax(scores))) == leader:
            break
        leader = best
    again = tuple(
        dataclasses.replace(w, log_odds=w.log_odds + s - w.score) for w, s in zip(tried, scores, strict=True)
    )
    return dataclasses.replace(found, searched=dataclasses.replace(found.searched, tried=again))


def _change(rows: Rows, weights: list[np.ndarray], parameters: int) -> float:
    """Change of the log evidence by the weights, nats."""
    change = sum(float((w - 1) @ p) for w, (_, p, _) in zip(weights, rows, strict=True))
    all_rows = sum(float(n.sum()) for n, *_ in rows)
    counted = sum(float(w @ n) for w, (n, *_) in zip(weights, rows, strict=True))
    return change + 0.5 * parameters * float(np.log(all_rows / max(counted, 1.0)))


def _rows(case: Case, f: Fitted) -> Rows:
    out = []
    for g, sensor, remainder in zip(case.grids, f.average.sensor, f.average.remainder, strict=True):
        inverse = np.zeros(len(g.count))
        inverse[g.node] = np.concatenate([f.average.inverse[k] for k in g.channels])
        density = -0.5 * (g.power(f.powers) * inverse - g.count * np.log(inverse))
        share = np.clip(sensor * g.shape * inverse, 0, 1)
        out.append((g.count, density, 1 - remainder * (1 - share)))
    return out
