"""Findings of a diagnosis that wrong columns explain better: swapped columns, and gains that no sensor has.

The checks before a diagnosis find swapped columns where nothing else is missing. Here each pair is swapped
in the rows that were diagnosed. These hold the same numbers under other names, so that log evidences can be
compared:

    swapped where  score(best with the pair swapped) - score(best as recorded) > log(RARITY pairs)
              and  misfit(best with the pair swapped) < HALF misfit(best as recorded), if that leaves one

A real plant is wrong in small ways, and each may change its evidence by hundreds of nats: so a misfit has to
fall, too. An input and an output are no pair: a simulation that is driven by a reading predicts it without
physics.
A pair is refitted if, swapped, it fits the plant file's own values better than as recorded: these do not
depend on the columns. Of those that improve the plant without effects by as much, the likeliest is searched
for effects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from math import exp, log

import numpy as np

from thermoctl.checks.finding import Finding
from thermoctl.checks.labels import RARITY, Hypothesis, swaps
from thermoctl.diagnosis.data.case import FAILS, ROUGH, Budget, Case, grids_of
from thermoctl.diagnosis.data.coordinates import Coordinates
from thermoctl.diagnosis.evidence.fit import Fitted, fitted
from thermoctl.diagnosis.evidence.levels import over_noise
from thermoctl.diagnosis.hypothesis.candidates import spoken
from thermoctl.diagnosis.result import Diagnosis
from thermoctl.diagnosis.search.beam import search
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.recording.table import Table

# Least and largest gain of a real sensor: a stem in still air reads a third at worst; 1.8 would be degF for
# degC.
GAINS = (0.3, 1.5)
HALF = 0.5  # share of the misfit that may stay: a true swap removes nearly all of it
GAIN, SIZE = "sensor_gain", "A"


def relabelled(found: Diagnosis) -> list[Finding]:
    """Return severe findings where a wrong column explains the recordings better than the diagnosis.

    A diagnosis that goes on from an earlier one is not checked: the earlier recordings are not there."""
    if found.decision.verdict == "consistent" or found.case.memory.recordings:
        return []
    first, *more = dict.fromkeys(t.path for t in found.case.tables)
    where = f"{first} and {len(more)} more" if more else first
    swapped = _swapped(found, where)
    return [swapped] if swapped else absurd(found, where)


def _swapped(found: Diagnosis, where: str) -> Finding | None:
    """Return a finding where the recordings with two columns swapped are far likelier."""
    known, now = found.case, {w.fitted.hypothesis.keys: w.score for w in found.searched.tried}
    inputs = {i.column for i in known.plant.inputs.values()}
    pairs = [h for h in swaps(known.plant, known.tables) if len(inputs & {*h.columns}) != 1]
    proof = log(RARITY * max(len(pairs), 1))
    best: tuple[float, Hypothesis, Case] | None = None
    goal = known.null.cost
    for h in better_unfitted(known, pairs):
        budget = Budget(known.limits.fits, known.budget.progress, known.budget.stopped)
        try:
            again = changed(known, [h.change(t) for t in known.tables], goal, budget)
            if again is None:
                continue
            goal = again.null.cost
            score = fitted(again, again.plant, (), again.null).log_evidence
        except FAILS:
            continue
        if score > now[frozenset()] + proof and (best is None or score > best[0]):
            best = score, h, again
    if best is None or known.budget.stopped():
        return None
    _, h, again = best
    leader, present = search(again).best, found.searched.tried[0]
    if leader.score <= max(now.values()) + proof:
        return None
    stays = _misfit(known, present.fitted)
    if stays and _misfit(again, leader.fitted) >= HALF * stays:
        return None
    effects = ", ".join(spoken(leader.fitted.hypothesis.keys))
    present_effects = ", ".join(spoken(found.best.hypothesis.keys))
    a, b = h.columns
    return Finding(
        "swapped",
        where,
        f"the columns '{a}' and '{b}' are swapped: so read, the recordings fit the plant "
        f"{f'with {effects} ' if effects else ''}better than with {present_effects or 'no effect'} as they are "
        f"({exp(min(leader.score - max(now.values()), 200.0)):.0e} times as likely)",
        h.suggestion,
    )


def better_unfitted(known: Case, pairs: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the pairs that fit the plant file's own values better swapped, the best first."""
    recorded = unfitted_cost(known, known.tables)
    costs = [(unfitted_cost(known, [h.change(t) for t in known.tables]), h) for h in pairs]
    return [h for cost, h in sorted(costs, key=lambda item: item[0]) if cost < recorded]


def unfitted_cost(known: Case, tables: Sequence[Table]) -> float:
    """Return the cost of recordings at the plant file's own values; infinite where there is no simulation."""
    try:
        problem = Problem(known.null.model, _drives(known, tables), known.noise)
        return problem.evaluate(problem.start({}), False).cost
    except FAILS:
        return np.inf


def changed(known: Case, tables: Sequence[Table], goal: float, budget: Budget) -> Case | None:
    """Return the case with changed columns in the same rows, so that log evidences can be compared.

    Nothing is averaged or left out again. None if the cost of the refit stays above `goal`.
    Raises SimulationError."""
    drives = _drives(known, tables)
    null = fit(known.null.model, drives, known.noise, tolerance=ROUGH, seconds=np.inf, goal=goal)
    if null.cost > goal:
        return None
    coordinates = Coordinates(drives)
    grids = grids_of(coordinates, drives, null, known.block)
    return dataclasses.replace(
        known, tables=tuple(tables), null=null, coordinates=coordinates, grids=grids, budget=budget
    )


def _drives(known: Case, tables: Sequence[Table]) -> list[Excitation]:
    return [dataclasses.replace(known.null.model.excitation(t), rtol=known.rtol) for t in tables]


def _misfit(case: Case, f: Fitted) -> float:
    """Return the sum over outputs of the residual's mean square over the noise, above `clean` squared."""
    return sum(max(x**2 - case.limits.clean**2, 0.0) for x in over_noise(case, f))


def absurd(found: Diagnosis, where: str) -> list[Finding]:
    """Return a finding for each named gain that no real sensor has.

    A gain at a bound of its range is no measurement: it stands for another fault."""
    findings = []
    for e in found.shown:
        if e.key[0] != GAIN or SIZE not in e.own or e.own[SIZE] in found.best.fit.at_bound:
            continue
        gain = found.best.plant.parameters[e.own[SIZE]].value
        if not GAINS[0] <= gain <= GAINS[1]:
            item = next(r for r in found.case.plant.readings() if r.name == e.key[1])
            findings.append(
                Finding(
                    "gain",
                    where,
                    f"the recordings ask for a gain of {gain:.3g} at '{item.name}', which no sensor has",
                    f"Is the column '{item.column}' in another unit, or another quantity? State it in the plant file: "
                    f"column: {{name: {item.column}, unit: ...}}. Or is a fixed number that it is multiplied by wrong?",
                )
            )
    return findings
