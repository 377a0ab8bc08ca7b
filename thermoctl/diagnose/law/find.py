"""The law of a remainder: proposed by sparse regression, refitted in the whole plant, weighed by evidence.

1. `propose` proposes terms of the library at the places where a free function helps most.
2. The best are refitted as a hypothesis like any other: same noise, remainder and evidence. The prior odds of
   a law fall with the number of places, signals and forms that it was chosen from.
3. A law counts where it is no shape of the misfit that stays (`misfit`). Two things tell: how far it
   stands out of that misfit, and how much error it removes from data that it was not fitted to.
4. Of the laws that count, the evidence decides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import expit, softmax

from thermoctl.diagnose.case import Case
from thermoctl.diagnose.fit import Fitted, Placed, with_residuals
from thermoctl.diagnose.held_out import Worth, worth
from thermoctl.diagnose.law.curve import Curve, curve
from thermoctl.diagnose.law.misfit import closed, held_back, misfit_odds
from thermoctl.diagnose.law.propose import Proposal, propose_laws
from thermoctl.diagnose.law.refit import SIMPLER, affordable, at_bound, law_rate, refitted_law, simpler_law
from thermoctl.diagnose.law.smooth import law_unit, tracked
from thermoctl.diagnose.limits import Limits
from thermoctl.diagnose.shortlist import HALF
from thermoctl.plant import expression as ex
from thermoctl.plant.cores import LEAST, batches, each
from thermoctl.plant.simulate import SimulationError
from thermoctl.recording.table import Table

TESTED = 8  # likeliest laws, on data that they were not fitted to

Tried = tuple[Proposal, Fitted]


@dataclass(frozen=True)
class Law:
    """A law that was refitted.

    - `gain`: log posterior odds against the hypothesis without it
    - `probability`: that the law describes the part of the misfit that it claims
    - `closed`: share of the misfit's energy that it closes on the data of `worth`
    - `rivals`: other laws, with their probability among all laws"""

    proposal: Proposal
    fitted: Fitted
    gain: float
    probability: float
    worth: Worth
    closed: float
    curve: Curve | None
    rivals: tuple[tuple[Proposal, Fitted, float], ...]
    unit: str | None

    @property
    def placed(self) -> Placed:
        """The law among the effects of its hypothesis."""
        return self.fitted.hypothesis.effects[-1]

    @property
    def share(self) -> float:
        """Its probability among the laws that fit about as well."""
        return 1.0 - sum(share for _, _, share in self.rivals)

    @property
    def rate(self) -> ex.Expr:
        """Return the law's flow, or the storage with it."""
        return law_rate(self.fitted)


def find_law(
    case: Case,
    parent: Fitted,
    limits: Limits,
    reserve: Sequence[Table],
    say: Callable[[str], None] = lambda text: None,
) -> Law | None:
    """Propose and prove a law for what `parent` leaves. None where no law is supported.

    No law is fitted to the `reserve`. Without one it is the last part of each recording, and the law is then
    refitted to all of the data."""
    say("looking for a law of the remainder")
    try:
        if reserve:
            law = _chosen(case, parent, limits, reserve, True, say)
        else:
            short, base, last = held_back(case, parent)
            first = _chosen(short, base, limits, last, False, say)
            law = first and _refitted_to_all(case, parent, first)
        return law and replace(law, fitted=with_residuals(case, law.fitted))
    except (SimulationError, np.linalg.LinAlgError):
        return None


def _chosen(
    case: Case,
    parent: Fitted,
    limits: Limits,
    reserve: Sequence[Table],
    apart: bool,
    say: Callable[[str], None],
) -> Law | None:
    """Return the law with the largest evidence of those that count. Raises SimulationError.

    `apart`: whether the reserve is other recordings."""
    proposals, at = propose_laws(case, parent, limits.rare)
    tried = _refits(case, parent, proposals, say)
    if not tried:
        return None
    gains = np.array([f.log_evidence - p.cost - parent.log_evidence for p, f in tried])
    evidence = gains / limits.temperature
    odds = _both(evidence, [misfit_odds(case, parent, f, p, limits) for p, f in tried])
    likely = np.argsort(-odds, kind="stable")[:TESTED]
    first = worth(case, parent, tried[likely[0]][1], reserve)
    others = [tried[k][1] for k in likely[1:]]
    values = [first, *each(lambda f: worth(case, parent, f, reserve, first), others, LEAST * len(others))]
    odds = _both(
        evidence[likely],
        [
            misfit_odds(case, parent, tried[k][1], tried[k][0], limits, v, apart)
            for k, v in zip(likely, values, strict=True)
        ],
    )
    sure, shut = expit(odds), np.array([closed(case, v) for v in values])
    counts = np.flatnonzero((sure >= limits.name) & (shut > 0))
    if not len(counts):
        return None
    share = softmax(evidence[likely[counts]])
    order = counts[np.argsort(-share, kind="stable")]
    best = int(order[0])
    p, f = tried[likely[best]]
    rivals = tuple(
        (*tried[likely[k]], float(s))
        for k, s in zip(order[1:], np.sort(share)[::-1][1:], strict=True)
        if s > 1 - limits.set
    )
    drawn, unit = curve(at, p, law_rate(f), f.plant), law_unit(f.plant, p.place)
    gain, probability, share_closed = float(gains[likely[best]]), float(sure[best]), float(shut[best])
    return Law(p, f, gain, probability, values[best], share_closed, drawn, rivals, unit)


def _both(one: np.ndarray, other: Sequence[float]) -> np.ndarray:
    """Return about the smaller of two log odds: those of two things that both have to hold."""
    return -np.logaddexp(-one, -np.array(other))


def _refits(
    case: Case, parent: Fitted, proposals: Sequence[Proposal], say: Callable[[str], None]
) -> list[Tried]:
    """Refit the proposals, and sums without their least significant term, while more may gain than so far.

    Promises are of first order: all are taken for too small by the largest `ratio` so far."""
    tried: list[Tried] = []
    queue, more = list(proposals), SIMPLER
    gain, ratio, leader, left = 0.0, 1.0, parent, affordable(case, parent)

    def wanted(p: Proposal) -> bool:
        """Return whether a law may still win, and a refit is left for it."""
        nonlocal left
        if not left or case.budget.stopped() or p.cost + gain > HALF * ratio * p.promise:
            return False
        left -= 1
        return True

    for batch, rest in batches(queue, wanted):
        say(f"looking for a law of the remainder: refit {len(queue) - rest} of {len(queue)} at most")
        fits = each(partial(refitted_law, case, parent, leader=leader), batch, LEAST * len(batch))
        for p, f in zip(batch, fits, strict=True):
            if f is None:
                continue
            more_evidence = f.log_evidence - parent.log_evidence
            gain, ratio = max(gain, more_evidence - p.cost), max(ratio, more_evidence / max(p.promise, 1.0))
            leader = max(leader, f, key=lambda x: x.log_likelihood)
            if not f.absent and not at_bound(f):
                tried.append((p, f))
            if len(p.terms) > 1 and more and (f.doubtful or at_bound(f)):
                simpler = simpler_law(p, f)
                if simpler.kind not in {q.kind for q in queue}:
                    queue.append(simpler)
                    more -= 1
    return tried


def _refitted_to_all(case: Case, parent: Fitted, law: Law) -> Law | None:
    """Return the law at its parameters from all of the data; None where it is not significant there."""
    at = tracked(case, parent, [law.proposal.place.target])
    f = refitted_law(case, parent, law.proposal, parent)
    if f is None or f.absent or at_bound(f):
        return None
    gain = f.log_evidence - law.proposal.cost - parent.log_evidence
    return replace(law, fitted=f, gain=gain, curve=curve(at, law.proposal, law_rate(f), f.plant))
