"""Curvature of a log posterior at its maximum, standard deviations, and parameters at their bounds."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from itertools import accumulate, repeat, takewhile
from operator import mul

import numpy as np

from thermoctl.diagnosis.evidence.onsets import UNSEEN
from thermoctl.diagnosis.evidence.posterior import Posterior, Seen
from thermoctl.plant.fitting.climb import Spot
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.simulation.simulate import SimulationError

EDGE = 1e-6  # share of a parameter's range: closer to an end, the parameter is at its bound
MOST = 0.9  # largest share of the curvature that the unknown spectrum may remove
# Steps of an unknown in 0..1 without slopes: the first one, the factor to the next, and the fall, nats, that
# ends them.
FIRST, LONGER, FALL = 1e-6, 3.0, 1.0


def kept(h: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the curvature of the unknowns that the mask `of` (k,) selects; the others are eliminated."""
    cross = h[np.ix_(~of, of)]
    absorbed = cross.T @ np.linalg.pinv(h[np.ix_(~of, ~of)], hermitian=True) @ cross
    return np.asarray(h[np.ix_(of, of)] - absorbed)


def deviations(
    posterior: Posterior, values: np.ndarray, curvature: np.ndarray, bounds: Mapping[str, str]
) -> dict[str, float]:
    """Return the standard deviations of the effects' parameters, in their units.

    A parameter of the plant at its bound is held there: it cannot absorb part of an effect."""
    problem, plant_parameters, out = posterior.problem, posterior.case.plant.parameters, dict[str, float]()
    moves = np.array([q not in bounds or q not in plant_parameters for q, _ in problem.unknowns])
    sd = np.zeros(len(moves))
    inverse = np.linalg.pinv(curvature[np.ix_(moves, moves)], hermitian=True)
    sd[moves] = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        if q not in plant_parameters:
            slope = problem.scales[q].slope(float(values[0, posterior.model.parameters.index(q)]))
            out[q] = max(out.get(q, 0.0), float(sd[k] * slope))
    return out


def at_bound(problem: Problem, z: np.ndarray) -> dict[str, str]:
    """Return "low" or "high" for each parameter at an end of its range."""
    return {
        q: "low" if z[k] <= EDGE else "high"
        for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters])
        if not EDGE < z[k] < 1 - EDGE
    }


def relieved(matrix: np.ndarray, relief: np.ndarray) -> np.ndarray:
    """Return matrix - relief, limited so that no direction loses more than MOST of its curvature."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    w, q = np.linalg.eigh(matrix / np.outer(size, size))
    root = q * np.sqrt(np.maximum(w, 1e-12))  # matrix = size root root' size
    inner = np.linalg.solve(root, (relief / np.outer(size, size))) @ np.linalg.inv(root).T
    share, p = np.linalg.eigh(0.5 * (inner + inner.T))
    left = root @ (p * (1 - np.clip(share, 0.0, MOST))) @ p.T @ root.T
    return left * np.outer(size, size)


def without_slopes(posterior: Posterior, spot: Spot[Seen], matrix: np.ndarray) -> np.ndarray:
    """Return the curvature (k,) of the log posterior by parameters of effects that have no slopes, else 0.

    A level at which a signal is cut is such a parameter. On each side the first step counts by which the
    log posterior falls by FALL and more."""
    out = np.zeros(len(spot.z))
    of_effects = {n for e in posterior.effects for n in e.own.values()}
    for k, (q, _) in enumerate(posterior.problem.unknowns):
        if q in of_effects and matrix[k, k] < UNSEEN:
            out[k] = np.mean([_fall(posterior, spot, k, side) for side in (-1, 1)])
    return out


def _fall(posterior: Posterior, spot: Spot[Seen], k: int, side: int) -> float:
    """Return twice the fall over the square of the first step of unknown k that falls by FALL.

    The log posterior falls the more, the longer the step: so the step is found by bisection."""
    room = 1 - spot.z[k] if side > 0 else spot.z[k]
    steps = list(takewhile(lambda step: step < room, accumulate(repeat(LONGER), mul, initial=FIRST)))
    falls = dict[float, float]()

    def ends(step: float) -> bool:
        """Return whether a step falls by FALL, or cannot be simulated."""
        z = spot.z.copy()
        z[k] += side * step
        try:
            falls[step] = spot.height - posterior.look(z, False).height
        except SimulationError:
            falls[step] = np.inf
        return falls[step] >= FALL

    first = bisect_left(steps, True, key=ends)
    if first == len(steps) or np.isinf(falls[steps[first]]):
        return 0.0
    return float(2 * falls[steps[first]] / steps[first] ** 2)
