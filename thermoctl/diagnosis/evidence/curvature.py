"""Curvature of a log posterior at its maximum, standard deviations, and parameters at their bounds."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from itertools import accumulate, repeat, takewhile
from operator import mul

import numpy as np

from thermoctl.diagnosis.evidence.onsets import TIMES, UNSEEN
from thermoctl.diagnosis.evidence.posterior import Posterior, Seen
from thermoctl.plant.fitting.climb import Spot
from thermoctl.plant.simulation.simulate import SimulationError

MOST = 0.9  # largest share of the curvature that the unknown spectrum may remove
# Steps of an unknown in 0..1 without slopes: the first one, the factor to the next, and the fall, nats, that
# ends them.
FIRST, LONGER, FALL = 1e-6, 1.1, 1.0


def kept(h: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the curvature of the unknowns that the mask `of` (k,) selects; the others are eliminated."""
    cross = h[np.ix_(~of, of)]
    absorbed = cross.T @ np.linalg.pinv(h[np.ix_(~of, ~of)], hermitian=True) @ cross
    return np.asarray(h[np.ix_(of, of)] - absorbed)


def deviations(
    posterior: Posterior, values: np.ndarray, curvature: np.ndarray, bounds: Mapping[str, str]
) -> dict[str, float]:
    """Return the standard deviations of the effects' parameters, in their units.

    A parameter of the plant at its bound is held there: it cannot absorb part of an effect. A reading that
    jumps tells between which samples, not when."""
    problem, plant_parameters, out = posterior.problem, posterior.case.plant.parameters, dict[str, float]()
    moves = np.array([q not in bounds or q not in plant_parameters for q, _ in problem.unknowns], bool)
    sd = np.zeros(len(moves))
    inverse = np.linalg.pinv(curvature[np.ix_(moves, moves)], hermitian=True)
    sd[moves] = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        if q not in plant_parameters:
            slope = problem.scales[q].slope(float(values[0, posterior.model.parameters.index(q)]))
            out[q] = max(out.get(q, 0.0), float(sd[k] * slope))
    sample = min(float(np.median(np.diff(d.t))) for d in problem.excitations)
    jumps = (e for e in posterior.effects if e.candidate.place.output)
    for name in (e.own.get(p.name) for e in jumps for p in e.candidate.effect.parameters if p.shape in TIMES):
        if name in out:
            out[name] = float(np.hypot(out[name], sample / 12**0.5))
    return out


def relieved(matrix: np.ndarray, relief: np.ndarray) -> np.ndarray:
    """Return matrix - relief, limited so that no direction loses more than MOST of its curvature."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    w, q = np.linalg.eigh(matrix / np.outer(size, size))
    root = q * np.sqrt(np.maximum(w, 1e-12))  # matrix = size root root' size
    inner = np.linalg.solve(root, (relief / np.outer(size, size))) @ np.linalg.inv(root).T
    share, p = np.linalg.eigh(0.5 * (inner + inner.T))
    left = root @ (p * (1 - np.clip(share, 0.0, MOST))) @ p.T @ root.T
    return left * np.outer(size, size)


def without_slopes(
    posterior: Posterior, spot: Spot[Seen], matrix: np.ndarray
) -> tuple[np.ndarray, Spot[Seen]]:
    """Return the curvature (k,) by parameters of effects that have no slopes, else 0, and a spot.

    A level at which a signal is cut is such a parameter. Between two samples' values the log posterior does
    not change, and beyond them it falls at once. So the spot lies in the middle of these ends. The curvature
    is that of a normal density that falls by FALL at half their distance."""
    out, z = np.zeros(len(spot.z)), spot.z.copy()
    of_effects = {n for e in posterior.effects for n in e.own.values()}
    for k, (q, _) in enumerate(posterior.problem.unknowns):
        if q in of_effects and matrix[k, k] < UNSEEN:
            below, above = (_reach(posterior, spot, k, side) for side in (-1, 1))
            out[k] = 2 * FALL / (0.5 * (below + above)) ** 2
            z[k] += 0.5 * (above - below)
    try:
        middle = posterior.look(z, False) if out.any() else spot
    except SimulationError:
        middle = spot
    return out, middle if middle.height > spot.height - FALL else spot


def _reach(posterior: Posterior, spot: Spot[Seen], k: int, side: int) -> float:
    """Return the first step of unknown k by which the log posterior falls by FALL, or the room for steps.

    The log posterior falls the more, the longer the step: so the step is found by bisection."""
    room = 1 - spot.z[k] if side > 0 else spot.z[k]
    steps = list(takewhile(lambda step: step < room, accumulate(repeat(LONGER), mul, initial=FIRST)))

    def ends(step: float) -> bool:
        """Return whether a step falls by FALL, or cannot be simulated."""
        z = spot.z.copy()
        z[k] += side * step
        try:
            return spot.height - posterior.look(z, False).height >= FALL
        except SimulationError:
            return True

    return [*steps, max(room, FIRST)][bisect_left(steps, True, key=ends)]
