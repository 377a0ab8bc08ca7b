"""The law of a diagnosis, its curve, and the refits of proposed laws."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import SIGNIFICANT, Fitted
from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.diagnosis.law.free import PIECES, SPREAD, pieces
from thermoctl.diagnosis.law.propose import Proposal
from thermoctl.diagnosis.law.refit import (
    SIMPLER,
    PlacedLaw,
    affordable,
    apart,
    at_bound,
    law_rate,
    laws_of,
    limit_of,
    refitted_law,
    simpler_law,
)
from thermoctl.diagnosis.law.signals import Signal
from thermoctl.diagnosis.law.smooth import Tracked, law_unit, tracked
from thermoctl.diagnosis.search.beam import Weighed
from thermoctl.diagnosis.search.shortlist import HALF
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.cores import batches, each
from thermoctl.plant.language import Plant

SURE = 3  # number of refits of a case that tell how far its promises are right
SEEN = 0.01  # least singular value of a direction of the free function that is drawn, over the largest one


@dataclass(frozen=True)
class Goal:
    """The odds that a law has to reach.

    - `least`: log posterior odds against the hypothesis that it is added to, by its number of terms
    - `near`: nats below the best law so far, from which a law is not worth a refit
    - `quiet`: the best hypothesis leaves only noise. Then a few refits tell how far promises are trusted"""

    least: tuple[float, ...]
    near: float
    quiet: bool


@dataclass(frozen=True)
class Curve:
    """The missing flow as a free function of a signal, its sd, and the law, at visited values `at` (k,)."""

    signal: Signal
    at: np.ndarray
    flow: np.ndarray
    sd: np.ndarray
    law: np.ndarray


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


def found_laws(
    case: Case,
    tried: Mapping[Keys, Weighed],
    f: Fitted,
    named: Collection[Key],
    probability: Mapping[Key, float],
    confirmed: Mapping[Key, float],
) -> Iterator[FoundLaw]:
    """Yield the named laws of a hypothesis, each with its gain over the best hypothesis without it.

    `confirmed`: of those that were tested."""
    mine = f.hypothesis.keys
    for law in (law for law in laws_of(f) if law.key in named):
        fewer = (w for keys, w in tried.items() if keys < mine and law.key not in keys)
        without, place, drawn = max(fewer, key=lambda w: w.score), law.proposal.place, None
        gain = tried[mine].score - without.score
        if place.part == "flow":
            linear = tracked(case, without.fitted, [place.target])
            drawn = curve(linear, law.proposal, law_rate(f, law), f.plant)
        sure = probability[law.key], confirmed.get(law.key, 1.0)
        yield FoundLaw(law, f, gain, *sure, drawn, law_unit(f.plant, place))


def curve(linear: Tracked, p: Proposal, rate: ex.Expr, plant: Plant) -> Curve | None:
    """Return the flow at the law's place as a free function of its first signal, and the law there.

    None for a law with a memory. None, too, if the plant without it lacks one of its signals:
    a lag of a sensor that was found beside it makes such signals. The free function is the law plus a fit to
    its residual."""
    signals = [s for t in p.terms for s in t.signals]
    if not signals or any(t.form.memory for t in p.terms):
        return None
    s = signals[0]
    parameters = {q: v.value for q, v in plant.parameters.items()}
    if not ex.names(rate) <= {*linear.metric.signals[0], *parameters, "t"}:
        return None
    values = linear.along(s.along)
    flows = linear.along(lambda run, t: ex.series(rate, {**run, **parameters}, t))
    knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, PIECES + 4)))
    parts = [pieces(v, knots) for v in values]
    whole = np.concatenate(parts)
    line = np.linalg.lstsq(whole, np.concatenate(flows), rcond=None)[0]
    rest = linear.target - linear.columns(p.place, [q[:, None] for q in flows])[:, 0]
    u, w, v = np.linalg.svd(linear.columns(p.place, parts), full_matrices=False)
    seen = w > SEEN * w[0]  # the plant's own parameters absorb the others
    noise = max(float(np.mean(rest**2)), 1.0)
    extra = v[seen].T @ ((u.T @ rest)[seen] / w[seen])
    sd = np.sqrt(noise * ((v[seen].T / w[seen]) ** 2).sum(axis=1))
    return Curve(s, knots, line + extra, sd, line)


def refits(
    case: Case, parent: Fitted, proposals: Sequence[Proposal], goal: Goal
) -> list[tuple[Proposal, Fitted]]:
    """Refit the proposals that may beat the best law so far, and return the refits that end at no bound.

    From the best sum, and from one with an insignificant term, the least significant term is left out. A term
    whose shape is at its upper bound gets the form that it becomes there.
    All promises are multiplied by the largest ratio so far of a refit's gain to its promise. Beside a best
    hypothesis that leaves only noise, this ratio is trusted after SURE refits, even if it is below one."""
    tried = list[tuple[Proposal, Fitted]]()
    queue, more = list(proposals), SIMPLER
    ratios = list[float]()
    leader, left, ahead = parent, affordable(case, parent), max(goal.least[0], 0.0)

    def wanted(p: Proposal) -> bool:
        """Return whether a law may still be the best, and a refit is left for it."""
        nonlocal left
        sure = goal.quiet and len(ratios) >= SURE
        reach = SPREAD * max(ratios) if sure else HALF * max([1.0, *ratios])
        least = max(goal.least[len(p.terms) - 1], ahead - goal.near, 0.0)
        if not left or case.budget.stopped() or p.cost + least > reach * p.promise:
            return False
        left -= 1
        return True

    for batch, rest in batches(queue, wanted):
        case.budget.progress(f"looking for a law: refit {len(queue) - rest} of {len(queue)} at most")
        fits = each(partial(refitted_law, case, parent, leader=leader), batch)
        for p, f in zip(batch, fits, strict=True):
            if f is None:
                continue
            more_evidence = f.log_evidence - parent.log_evidence
            ratios.append(more_evidence / max(p.promise, 1.0))
            leader = max(leader, f, key=lambda x: x.log_likelihood)
            if not at_bound(f):
                tried.append((p, f))
            best = more_evidence - p.cost >= ahead
            ahead = max(ahead, more_evidence - p.cost)
            if more and (at_bound(f) or len(p.terms) > 1 and (f.doubtful or best)):
                simpler = (simpler_law if len(p.terms) > 1 else limit_of)(laws_of(f)[0], f)
                if simpler.kind not in {q.kind for q in queue}:
                    queue.append(simpler)
                    more -= 1
    return [*tried, *_parts(case, parent, tried, leader)]


def _parts(
    case: Case, parent: Fitted, tried: Sequence[tuple[Proposal, Fitted]], leader: Fitted
) -> list[tuple[Proposal, Fitted]]:
    """Return the best law without terms that are not apart from none, refitted from its values.

    Refitted from the parent's values, the rest may have ended in a wrong optimum."""
    out: list[tuple[Proposal, Fitted]] = []
    while tried and not case.budget.stopped():
        p, f = max([*tried, *out], key=lambda x: x[1].log_evidence - x[0].cost)
        law = laws_of(f)[0]
        if len(p.terms) == 1 or min(apart(law, f)) > SIGNIFICANT:
            break
        part = simpler_law(law, f)
        again = refitted_law(case, parent, part, leader)
        if again is None or at_bound(again) or again.log_evidence - part.cost <= f.log_evidence - p.cost:
            break
        out.append((part, again))
    return out
