"""Rivals of every effect: a number that the plant file fixes is wrong.

A refit cannot move a fixed storage or rate. So its error takes the shape of an effect, such as a missing
mass. The entries of config/mistakes/ free one such number each: a factor, a constant, or an exponent. They
are refitted and weighed like the hypotheses of the search. A factor starts at the best power of ten, because
a storage that is far too small has no gradient at the factor 1. A reading whose first sample
contradicts the plant's initial state may be off by a constant.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed, fitted
from thermoctl.diagnosis.evidence.posterior import Posterior
from thermoctl.diagnosis.hypothesis.candidates import Candidate, Key, candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.files.shipped import shipped
from thermoctl.plant.fitting.cores import each
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant

MISTAKES = shipped("config/mistakes")
# Range of the constant, over the difference between the first sample and the plant's initial value.
WIDE = 10.0
DECADES = tuple(10.0**k for k in range(-6, 7))  # from a wrong digit to an error of two SI prefixes


def mistakes(case: Case, null: Fitted) -> list[Fitted]:
    """Return the refits of the plant with one significant factor each, of at most `shortlist` factors.

    `null`: the refit of the plant without any effect."""
    entries = catalogue((MISTAKES,))
    starts: dict[Key, list[tuple[float, Plant, Placed]]] = {}
    for plant in (case.plant, null.rough_plant):
        drives = case.drives(compile_plant(plant))
        rig = case.rig(plant, drives)
        for c in candidates(rig, entries):
            if c.effect.where != "sensor" or c.place.output in case.off:
                starts.setdefault(c.key, []).append(_start(case, c))
    best = sorted((min(s, key=lambda x: x[0]) for s in starts.values()), key=lambda x: x[0])

    def refitted(start: tuple[float, Plant, Placed]) -> Fitted | None:
        """Return the refit from a starting point; None where it fails or the search was stopped."""
        _, plant, placed = start
        try:
            return None if case.budget.stopped() else fitted(case, plant, (placed,), parent=null)
        except FAILS:
            return None

    most = case.limits.shortlist
    tried = best[: max(min(most, case.budget.fits - case.budget.fits_done), 0)]
    case.budget.untried += len(best[:most]) - len(tried)
    return [f for f in each(refitted, tried) if f is not None and not f.absent]


def _start(case: Case, c: Candidate) -> tuple[float, Plant, Placed]:
    """Return (least cost of the trial values, the plant with the best one, the factor as placed)."""
    (p,) = c.effect.parameters
    off = case.off.get(c.place.output or "")
    tried = (off,) if off is not None else (p.null,) if p.origin == "exponent" else DECADES
    span = {p.name: (p.low, p.high) if off is None else (-WIDE * abs(off), WIDE * abs(off))}
    own = c.own(p.name)
    placed = Placed(c, {p.name: own})
    problem = Posterior(case, c.extend({}, span), (placed,)).problem
    costs = [_cost(problem, {own: value}) for value in tried]
    k = int(np.argmin(costs))
    return costs[k], c.extend({p.name: tried[k]}, span), placed


def _cost(problem: Problem, values: Mapping[str, float]) -> float:
    try:
        return problem.evaluate(problem.start(values), False).cost
    except SimulationError:
        return float("inf")
