"""Where the refit of a hypothesis starts: at its effects' full size, or beside the hypothesis before it."""

from __future__ import annotations

import numpy as np

from thermoctl.diagnosis.evidence.onsets import TIMES
from thermoctl.diagnosis.evidence.posterior import Posterior
from thermoctl.diagnosis.hypothesis.candidates import Keys
from thermoctl.plant.fitting.climb import bounded_step
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import Evaluation, Problem
from thermoctl.plant.simulation.simulate import SimulationError

SHARE = 0.01  # share of an effect's size from which the first step towards its full size is taken


def first_point(posterior: Posterior, parent: float) -> tuple[np.ndarray, Evaluation | None, list[int]]:
    """Return the unknowns where a refit starts, their evaluation, and the indices of those to hold at first.

    The evaluation is None if it failed. The refit starts with the effects at full size, if these improve the
    fit. The plant's own parameters may have imitated the effect. Then at full size the cost is above
    `parent`, the cost of the refit without the effect. In that case one Gauss-Newton step is taken from a
    small share of the effect. Sizes and the plant's parameters change in this step, shapes do not. The refit
    starts at full size, at the small share or after the step, whichever has the least cost.

    At a small share the time of a jump means next to nothing: a step may take it anywhere. So where a refit
    does not start at full size, times may be held until the other unknowns are fitted."""
    problem = posterior.problem
    full = problem.start({})
    starts = [(full, _evaluated(problem, full))]
    plant = posterior.plant.parameters
    names = {problem.unknowns[k][0]: p for k, (_, p) in posterior.sizes.items() if p.amplitude}
    if _cost(starts[0]) < parent or not names:
        return *starts[0], []
    small = problem.start({q: p.null + SHARE * (plant[q].value - p.null) for q, p in names.items()})
    own = {n for e in posterior.effects for n in e.own.values()}
    free = np.array([k for k, (q, _) in enumerate(problem.unknowns) if q not in own or q in names])
    try:
        now = problem.evaluate(small, True)
        stepped = _along_values(posterior, small, now, free)
    except SimulationError:
        return *starts[0], []
    starts += [(small, now), (stepped, _evaluated(problem, stepped))]
    best = min(starts, key=_cost)
    return *best, [] if best is starts[0] else _times(posterior)


def _times(posterior: Posterior) -> list[int]:
    """Return the indices of the unknowns that are times of jumps."""
    of = {e.own.get(p.name): p.shape for e in posterior.effects for p in e.candidate.effect.parameters}
    return [k for k, (q, _) in enumerate(posterior.problem.unknowns) if of.get(q) in TIMES]


def _evaluated(problem: Problem, z: np.ndarray) -> Evaluation | None:
    try:
        return problem.evaluate(z, False)
    except SimulationError:
        return None


def _cost(start: tuple[np.ndarray, Evaluation | None]) -> float:
    return start[1].cost if start[1] else float("inf")


def _along_values(posterior: Posterior, z: np.ndarray, now: Evaluation, free: np.ndarray) -> np.ndarray:
    """Return z after one Gauss-Newton step of the unknowns `free`, linear in the values of the parameters.

    A parameter that an effect replaces goes towards zero. On its logarithmic scale it could not get there."""
    problem = posterior.problem
    values, _ = problem.unpack(z)
    low, high = (bound - z for bound in posterior.bounds)
    current, slope = z.copy(), np.ones(len(z))
    for k, (q, r) in enumerate(problem.unknowns[: problem.n_parameters]):
        scale = problem.scales[q]
        current[k] = float(values[r or 0, posterior.model.parameters.index(q)])
        slope[k] = scale.slope(current[k])
        low[k], high[k] = (scale.low - current[k]) / slope[k], (scale.high - current[k]) / slope[k]
    zero = np.zeros(len(free))
    part, bounds = now.matrix[np.ix_(free, free)], (low[free], high[free])
    step, _ = bounded_step(zero, now.gradient[free], part, 0.0, bounds)
    out = z.copy()
    for k, change in zip(free, step, strict=True):
        if k < problem.n_parameters:
            scale = problem.scales[problem.unknowns[k][0]]
            out[k] = scale.z(float(np.clip(current[k] + slope[k] * change, scale.low, scale.high)))
        else:
            out[k] = z[k] + change
    return out


def beside_parent(posterior: Posterior, parent: Keys, fit: Fit) -> np.ndarray:
    """Return the unknowns at the maximum `fit` of a parent, with a small share of each effect that it lacks.

    `parent`: the keys of its effects."""
    problem, plant = posterior.problem, posterior.plant.parameters
    small = {
        e.own[p.name]: p.null + SHARE * (plant[e.own[p.name]].value - p.null)
        for e in posterior.effects
        if e.key not in parent
        for p in e.candidate.effect.sizes
        if e.own.get(p.name) in plant
    }
    z = problem.start(small)
    place = {unknown: k for k, unknown in enumerate(problem.unknowns)}
    for unknown, value in zip(fit.unknowns, fit.z, strict=True):
        if unknown in place:
            z[place[unknown]] = value
    z[posterior.shared] = posterior.past.z
    return z
