"""Which thermometers to fit: the best sets of k sensors for the position."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from thermoctl.identify import filter
from thermoctl.identify.statespace import StateSpace


def choose_sensors(
    model: StateSpace,
    variances: np.ndarray,
    r_v: float,
    gains_um_k: np.ndarray,
    most: int = 12,
    must: tuple[int, ...] = (),
) -> list[tuple[tuple[int, ...], float]]:
    """Return the best sensor sets of k = 1..`most` sensors, [(sensors, um)].

    The criterion is the standard error of the position, um. gains_um_k (M,): static position gain of each
    point. Forward selection with exchange until nothing improves; k = 1, 2 are exhaustive. `must` are always
    in the set (the embedded coil sensor).
    """
    m = len(model.c)
    out = []

    def error(s: tuple[int, ...]) -> float:
        """Return the position's standard error, um, with sensors `s`. Raises the InputError of `steady`."""
        g = gains_um_k @ model.c
        return float(np.sqrt(max(g @ filter.steady(model, variances, r_v, tuple(sorted(s))).p @ g, 0)))

    chosen: tuple[int, ...] = ()
    for k in range(max(1, len(must)), most + 1):
        if k <= 2:
            candidates = [s for s in combinations(range(m), k) if set(must) <= set(s)]
        else:
            candidates = [tuple(sorted((*chosen, j))) for j in range(m) if j not in chosen]
        best = min(candidates, key=error)
        value = error(best)
        improved = k > 2
        while improved:
            improved = False
            for out_ in [j for j in best if j not in must]:
                for in_ in [j for j in range(m) if j not in best]:
                    trial = tuple(sorted({*best, in_} - {out_}))
                    e = error(trial)
                    if e < value * (1 - 1e-6):
                        best, value, improved = trial, e, True
                        break
                if improved:
                    break
        chosen = best
        out.append((best, value))
    return out
