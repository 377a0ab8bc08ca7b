"""Curvature of a log posterior at its maximum, standard deviations, and parameters at their bounds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thermoctl.diagnosis.evidence.posterior import Posterior
from thermoctl.plant.fitting.residuals import Problem

EDGE = 1e-6  # share of a parameter's range: closer to an end, the parameter is at its bound
MOST = 0.9  # largest share of the curvature that the unknown spectrum may remove


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
