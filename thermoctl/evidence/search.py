"""A beam of hypotheses, grown by the score test, compared by log evidence and prior odds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.diagnose.effects import Candidate
from thermoctl.diagnose.screen import Direction, sharpened
from thermoctl.diagnose.search import extend, finalists, sticking
from thermoctl.evidence.case import Case
from thermoctl.evidence.fit import Fitted, Placed, fitted
from thermoctl.evidence.limits import Limits
from thermoctl.evidence.screening import Screened, places, screened
from thermoctl.plant.simulate import SimulationError
from thermoctl.yamlfile import InputError

EVENTS = ("onsets", "windows")  # shapes that happen at one moment


@dataclass(frozen=True)
class Weighed:
    """A fitted hypothesis and its log prior odds; `chance`: family-wise p of what it leaves, None where it was not screened."""

    fitted: Fitted
    log_odds: float

    @property
    def score(self) -> float:
        """log p(D | h) + log p(h)"""
        return self.fitted.log_evidence + self.log_odds


@dataclass(frozen=True)
class Searched:
    """All hypotheses tried, best first; whether the budget ended the search; the chance of what the null leaves."""

    tried: tuple[Weighed, ...]
    truncated: bool
    p_null: float


def odds(effects: Sequence[Placed], where: Mapping[str, set[str]], limits: Limits) -> float:
    """Log prior odds of a hypothesis against no effect: entries share the odds alike, and their places theirs."""
    total = 0.0
    for e in effects:
        c = e.candidate
        share = len(where) * len(where.get(c.effect.name, {c.place.where}))
        total += np.log(limits.missing / (1 - limits.missing) / share) + np.log(_class(c, limits))
    return float(total)


def _class(c: Candidate, limits: Limits) -> float:
    """Odds of an entry's class against constant physics."""
    event = any(kind in EVENTS for kind in c.effect.shapes.values()) or any(p.per_recording for p in c.effect.parameters)
    return (limits.rare if event else 1.0) * (limits.rare if c.place.input and c.effect.where != "drive" else 1.0)


def search(case: Case, limits: Limits) -> Searched:
    """Extend the beam's best hypotheses until no extension is significant, or none is better, or the budget is spent."""
    where = places(case)
    null = Weighed(fitted(case, case.plant, (), case.null), 0.0)
    tried: dict[frozenset[tuple[str, str]], Weighed] = {frozenset(): null}
    beam, p_null, seen = [null], 1.0, set()
    for _ in range(limits.effects):
        best = beam[0].score
        for parent in beam[: limits.screened]:
            if parent.fitted.hypothesis.keys in seen:
                continue
            seen.add(parent.fitted.hypothesis.keys)
            looked = screened(case, parent.fitted)
            if parent is null:
                p_null = looked.p_any
            if looked.p_any < limits.alpha:
                for w in extensions(case, parent, looked, where, limits, tried):
                    tried[w.fitted.hypothesis.keys] = w
        beam = sorted(tried.values(), key=lambda w: -w.score)[: limits.beam]
        if beam[0].score <= best or case.budget.spent:
            break
    return Searched(tuple(sorted(tried.values(), key=lambda w: -w.score)), case.budget.spent, p_null)


def extensions(
    case: Case,
    parent: Weighed,
    looked: Screened,
    where: Mapping[str, set[str]],
    limits: Limits,
    tried: Mapping[frozenset[tuple[str, str]], Weighed],
) -> list[Weighed]:
    """The parent with each direction of the shortlist, refitted."""
    out = []
    for direction in finalists(looked.directions, limits.shortlist):
        keys = parent.fitted.hypothesis.keys | {direction.candidate.key}
        if keys in tried or case.budget.spent:
            continue
        leader = max(w.fitted.log_likelihood for w in [*tried.values(), *out])
        found = [f for d in starts(looked, direction) if (f := _refitted(case, parent, d, looked, leader)) is not None]
        found = [f for f in found if not f.absent]
        if found:
            best = max(found, key=lambda f: f.log_evidence)
            out.append(Weighed(best, odds(best.hypothesis.effects, where, limits)))
    return out


def starts(looked: Screened, direction: Direction) -> list[Direction]:
    """The starting points that a direction's shape asks for."""
    first = sharpened(looked.metric, looked.rig, direction)
    stuck = sticking(first)
    return [first, *([stuck] if stuck else [])]


def _refitted(case: Case, parent: Weighed, direction: Direction, looked: Screened, leader: float) -> Fitted | None:
    try:
        plant, own = extend(parent.fitted.rough_plant, direction, looked.metric.drives)
        return fitted(case, plant, (*parent.fitted.hypothesis.effects, Placed(direction.candidate, own)), None, leader)
    except (SimulationError, InputError, np.linalg.LinAlgError):
        return None
