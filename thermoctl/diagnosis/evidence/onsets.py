"""Move the times of jumps to where they fit best. A refit cannot: a jump has no derivative by its time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.posterior import Placed
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import SimulationError

TIMES = ("onset", "start", "end")  # shapes that are the time of a jump
ONSETS = 24  # number of onset times in a screening's grid over the recordings
FINER = 4  # each grid is finer than the one before by this factor
GAIN = 6.0  # least decrease of the squared errors over the noise to move a time: three nats


def moved(case: Case, plant: Plant, effects: Sequence[Placed], fit: Fit) -> Plant | None:
    """Return the plant with better times of its jumps and no other change; None if no other times fit better.

    Each time is searched on finer and finer grids about it, from the screening's step to half a sample."""
    own = {e.own.get(p.name) for e in effects for p in e.candidate.effect.parameters if p.shape in TIMES}
    times = {q: k for k, (q, r) in enumerate(fit.unknowns) if q in own and r is None}
    if not times:
        return None
    drives = case.drives(fit.model)
    problem = Problem(fit.model, drives, case.noise, fit.priors)
    duration = max(float(d.t[-1]) for d in drives)
    sample = min(float(np.median(np.diff(d.t))) for d in drives)

    def cost(z: np.ndarray) -> float:
        """Return the cost of the unknowns z; infinite where the simulation fails."""
        try:
            return problem.evaluate(z, False).cost
        except SimulationError:
            return float("inf")

    z = fit.z.copy()
    first = least = cost(z)
    for q, k in times.items():
        step = duration / ONSETS
        while step > 0.5 * sample:
            middle = problem.scales[q].value(z[k])
            for time in middle + step * np.arange(1 - FINER, FINER) / FINER:
                trial = z.copy()
                trial[k] = problem.scales[q].z(float(np.clip(time, 0.0, duration)))
                if time != middle and (now := cost(trial)) < least:
                    z, least = trial, now
            step /= FINER
    if not least < first - GAIN:
        return None
    parameters = {
        q: dataclasses.replace(plant.parameters[q], value=float(problem.scales[q].value(z[k])))
        for q, k in times.items()
    }
    return dataclasses.replace(plant, parameters={**plant.parameters, **parameters})
