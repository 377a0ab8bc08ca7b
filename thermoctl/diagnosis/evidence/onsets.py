"""Move the times of jumps, and levels at which a signal is cut, to where they fit best.

A refit cannot: the outputs have no derivative by them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.evidence.posterior import Placed
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.language import Plant

TIMES = ("onset", "start", "end")  # shapes that are the time of a jump
ONSETS = 24  # number of onset times in a screening's grid over the recordings
FINER = 4  # each grid is finer than the one before by this factor
GAIN = 6.0  # least decrease of the squared errors over the noise to move one: three nats
UNSEEN = 1.0  # curvature by an unknown in 0..1 that says nothing about it
RATIO, FINEST = 1.64, 1.01  # ratio of neighbouring levels in a screening's grid, and in the finest one here


def moved(case: Case, plant: Plant, effects: Sequence[Placed], fit: Fit) -> Plant | None:
    """Return the plant with better times and levels, and no other change; None if no others fit better.

    Each is searched on finer and finer grids about it, from the screening's step on. The finest has a step of
    half a sample, or of levels the ratio FINEST."""
    kinds = {e.own.get(p.name): p.shape for e in effects for p in e.candidate.effect.parameters}
    own = {q: k for k, (q, r) in enumerate(fit.unknowns) if r is None and q in kinds}
    times = {q: k for q, k in own.items() if kinds[q] in TIMES}
    levels = {q: k for q, k in own.items() if kinds[q] == "level" and fit.hessian[k, k] < UNSEEN}
    if not times and not levels:
        return None
    drives = case.drives(fit.model)
    problem = Problem(fit.model, drives, case.noise, fit.priors)
    duration = max(float(d.t[-1]) for d in drives)
    sample = min(float(np.median(np.diff(d.t))) for d in drives)
    search = _Search(problem, fit.z.copy(), bool(levels))
    first = search.least
    for q, k in times.items():
        search.finer(q, k, duration / ONSETS, 0.5 * sample, lambda middle, step: middle + step)
    for q, k in levels.items():
        search.finer(q, k, np.log(RATIO), np.log(FINEST), lambda middle, step: middle * np.exp(step))
    if not search.least < first - GAIN:
        return None
    parameters = {
        q: dataclasses.replace(plant.parameters[q], value=float(problem.scales[q].value(search.z[k])))
        for q, k in (times | levels).items()
    }
    return dataclasses.replace(plant, parameters={**plant.parameters, **parameters})


class _Search:
    """The unknowns z with the least cost so far.

    `followed`: it is the cost after a Gauss-Newton step of the others, which may have imitated a wrong
    level."""

    def __init__(self, problem: Problem, z: np.ndarray, followed: bool):
        self.problem, self.z, self.followed = problem, z, followed
        self.least = self._cost(z)

    def finer(
        self, q: str, k: int, step: float, finest: float, beside: Callable[[float, np.ndarray], np.ndarray]
    ) -> None:
        """Search unknown k, parameter q, on grids from `step` to `finest`. `beside`: values at steps.

        A grid whose end is best is moved there."""
        scale = self.problem.scales[q]
        while step > finest:
            middle = scale.value(self.z[k])
            grid = np.clip(beside(middle, step * np.arange(1 - FINER, FINER) / FINER), scale.low, scale.high)
            best = middle
            for value in map(float, grid):
                trial = self.z.copy()
                trial[k] = scale.z(value)
                if value != middle and (now := self._cost(trial)) < self.least:
                    self.z, self.least, best = trial, now, value
            if best not in (grid[0], grid[-1]) or best == middle:
                step /= FINER

    def _cost(self, z: np.ndarray) -> float:
        """Return the cost of the unknowns z; infinite where the simulation fails."""
        try:
            now = self.problem.evaluate(z, self.followed)
            fall = now.gradient @ np.linalg.solve(now.matrix, now.gradient) if self.followed else 0.0
        except FAILS:
            return float("inf")
        return float(now.cost - fall)
