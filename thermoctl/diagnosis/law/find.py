"""The law of a diagnosis, and the refits of proposed laws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.law.curve import Curve, curve
from thermoctl.diagnosis.law.propose import Proposal
from thermoctl.diagnosis.law.refit import (
    SIMPLER,
    PlacedLaw,
    affordable,
    at_bound,
    law_of,
    law_rate,
    refitted_law,
    simpler_law,
)
from thermoctl.diagnosis.law.smooth import law_unit, tracked
from thermoctl.diagnosis.search.beam import SPREAD
from thermoctl.diagnosis.search.shortlist import HALF
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.cores import LEAST, batches, each

SURE = 3  # number of refits of a case that tell how far its promises are right


@dataclass(frozen=True)
class Goal:
    """The odds that a law has to reach.

    - `least`: log posterior odds against the hypothesis that it is added to
    - `near`: nats below the best law so far, from which a law is not worth a refit
    - `quiet`: the best hypothesis leaves only noise. Then a few refits tell how far promises are trusted"""

    least: float
    near: float
    quiet: bool


Tried = tuple[Proposal, Fitted]


@dataclass(frozen=True)
class FoundLaw:
    """A law that a diagnosis found.

    - `fitted`: the hypothesis with it, and perhaps with effects of the catalogue
    - `gain`: log posterior odds against the best hypothesis without it
    - `probability`: posterior probability of a law at its place
    - `confirmed`: probability that it predicts data that it was not fitted to (confirm.py)"""

    placed: PlacedLaw
    fitted: Fitted
    gain: float
    probability: float
    confirmed: float
    curve: Curve | None
    unit: str | None

    @property
    def proposal(self) -> Proposal:
        """Return its place and terms."""
        return self.placed.proposal

    @property
    def rivals(self) -> tuple[tuple[Proposal, Fitted, float], ...]:
        """Return other laws at its place that fit about as well, each with its refit and its share."""
        return self.placed.rivals

    @property
    def share(self) -> float:
        """Return its share of the posterior probability of all laws at its place."""
        return 1.0 - sum(share for _, _, share in self.rivals)

    @property
    def rate(self) -> ex.Expr:
        """Return the expression of the law's flow, or of the storage that contains the law."""
        return law_rate(self.fitted)


def found_law(
    case: Case, f: Fitted, parent: Fitted, gain: float, probability: float, confirmed: float
) -> FoundLaw | None:
    """Return the law of a hypothesis, None where it has none. `parent`: the hypothesis without it."""
    law = law_of(f)
    if law is None:
        return None
    p = law.proposal
    drawn = curve(tracked(case, parent, [p.place.target]), p, law_rate(f), f.plant)
    return FoundLaw(law, f, gain, probability, confirmed, drawn, law_unit(f.plant, p.place))


def refits(
    case: Case, parent: Fitted, proposals: Sequence[Proposal], goal: Goal, say: Callable[[str], None]
) -> list[Tried]:
    """Refit the proposals that may beat the best law so far.

    From the best sum, and from one with an insignificant term, the least significant term is left out.
    All promises are multiplied by the largest ratio so far of a refit's gain to its promise. Beside a best
    hypothesis that leaves only noise, this ratio is trusted after SURE refits, even if it is below one."""
    tried: list[Tried] = []
    queue, more = list(proposals), SIMPLER
    goal, ratios = replace(goal, least=max(goal.least, 0.0)), list[float]()
    leader, left, ahead = parent, affordable(case, parent), goal.least

    def wanted(p: Proposal) -> bool:
        """Return whether a law may still be the best, and a refit is left for it."""
        nonlocal left
        sure = goal.quiet and len(ratios) >= SURE
        reach = SPREAD * max(ratios) if sure else HALF * max([1.0, *ratios])
        if not left or case.budget.stopped() or p.cost + goal.least > reach * p.promise:
            return False
        left -= 1
        return True

    for batch, rest in batches(queue, wanted):
        say(f"looking for a law: refit {len(queue) - rest} of {len(queue)} at most")
        fits = each(partial(refitted_law, case, parent, leader=leader), batch, LEAST * len(batch))
        for p, f in zip(batch, fits, strict=True):
            if f is None:
                continue
            more_evidence = f.log_evidence - parent.log_evidence
            ratios.append(more_evidence / max(p.promise, 1.0))
            leader = max(leader, f, key=lambda x: x.log_likelihood)
            if not f.absent and not at_bound(f):
                tried.append((p, f))
            best = more_evidence - p.cost >= ahead
            ahead = max(ahead, more_evidence - p.cost)
            goal = replace(goal, least=max(goal.least, ahead - goal.near))
            if len(p.terms) > 1 and more and (f.doubtful or at_bound(f) or best):
                simpler = simpler_law(p, f)
                if simpler.kind not in {q.kind for q in queue}:
                    queue.append(simpler)
                    more -= 1
    return tried
