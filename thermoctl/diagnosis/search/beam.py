"""A beam of hypotheses, grown by the score test, compared by log evidence and prior odds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Budget, Case
from thermoctl.diagnosis.data.memory import NOTHING, PlacedBefore
from thermoctl.diagnosis.evidence.fit import (
    HOPELESS,
    WHITE,
    Fitted,
    Placed,
    as_refitted,
    fitted,
    near_nothing,
    placed_at,
    placed_before,
)
from thermoctl.diagnosis.evidence.levels import only_noise
from thermoctl.diagnosis.evidence.odds import odds
from thermoctl.diagnosis.evidence.posterior import BELIEF
from thermoctl.diagnosis.hypothesis.candidates import Key, Keys, candidates, found_again
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.hypothesis.places import Place
from thermoctl.diagnosis.search.again import Known
from thermoctl.diagnosis.search.gains import Direction
from thermoctl.diagnosis.search.mistakes import mistakes
from thermoctl.diagnosis.search.observer import TRUSTS, drifts, held, linear
from thermoctl.diagnosis.search.refits import free_starts, refitted
from thermoctl.diagnosis.search.screen import Norms
from thermoctl.diagnosis.search.screening import Screened, places, screened
from thermoctl.diagnosis.search.shortlist import HALF, Extension, elsewhere, shortlist, simpler
from thermoctl.plant.fitting import refit
from thermoctl.plant.fitting.cores import batches
from thermoctl.plant.fitting.residuals import Scale
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation, compile_plant

INSIGNIFICANT = "refitted, and it or a part of it is not significant"
FAILED = "its refit could not be simulated"
SURPLUS = 5.0  # nats by which an effect of no size must lead, so that the others are refitted without it
# If the best leaves only noise, a hypothesis so many nats below, a hundredth as likely, is not extended.
NEAR = 4.6
# Nats below the best, from which a law is left out; for each effect allowed, also an earlier hypothesis.
BEATEN = 10.0


@dataclass(frozen=True)
class Weighed:
    """A fitted hypothesis and its log prior odds."""

    fitted: Fitted
    log_odds: float

    @property
    def score(self) -> float:
        """Log p(D | h) + log p(h)"""
        return self.fitted.log_evidence + self.log_odds


@dataclass(frozen=True)
class Searched:
    """All hypotheses tried, best first; whether the budget ended the search.

    `norms`: of all columns in the screening without effects; empty where not all were screened.
    `where`: the places where each effect fits. `promised`: the largest first-order gain of a placed effect,
    nats; `refused`: refits that are no hypotheses, and why."""

    tried: tuple[Weighed, ...]
    truncated: bool
    norms: Sequence[Norms] = ()
    where: Mapping[str, set[str]] = field(default_factory=dict)
    promised: Mapping[Key, float] = field(default_factory=dict)
    refused: Mapping[Keys, str] = field(default_factory=dict)


@dataclass
class Search:
    """A search under way: where each effect fits, hypotheses by their effects, and those already extended."""

    case: Case
    where: Mapping[str, set[str]]
    tried: dict[Keys, Weighed] = field(default_factory=dict)
    seen: set[Keys] = field(default_factory=set)
    norms: list[Norms] = field(default_factory=list)  # norms of the screening without effects
    promised: dict[Key, float] = field(default_factory=dict)  # largest first-order gain of a placed effect
    known: Known = field(default_factory=Known)  # rows of the first screening
    refused: dict[Keys, str] = field(default_factory=dict)  # extensions, and why each may be no hypothesis
    like: dict[Keys, Weighed] = field(default_factory=dict)  # refused, but contains a simpler entry

    @property
    def best(self) -> Weighed:
        """Return the likeliest hypothesis so far."""
        return max(self.tried.values(), key=lambda w: w.score)

    def keep(self, found: Iterable[Weighed]) -> None:
        """Add hypotheses. Of two refits of the same hypothesis the likelier one stays."""
        for w in found:
            keys = w.fitted.hypothesis.keys
            if keys not in self.tried or w.score > self.tried[keys].score:
                self.tried[keys] = w

    def refuse(self, keys: Keys, f: Fitted | None) -> None:
        """Note that a refit may be no hypothesis, and keep one that contains a simpler entry."""
        self.refused[keys] = INSIGNIFICANT if f else FAILED
        if f and not f.absent and any(e.candidate.effect.contains for e in f.hypothesis.effects):
            self.like[keys] = self.weighed(f)

    def admit(self) -> None:
        """Keep refused hypotheses with an entry that contains a simpler one, at most as likely as with that.

        The data do not tell the two apart where the other part of the entry may be nothing."""
        for keys, w in self.like.items():
            for e in w.fitted.hypothesis.effects:
                simple = (e.candidate.effect.contains or "", e.key[1])
                simpler = self.tried.get(keys - {e.key} | {simple})
                if simpler and keys not in self.tried:
                    odds = min(w.log_odds, simpler.score - w.fitted.log_evidence)
                    self.tried[keys] = Weighed(w.fitted, odds)

    def extended(self, parent: Weighed, again: Callable[[Place], bool] | None = None) -> list[Weighed]:
        """Extend a hypothesis, once; by nothing where its plant has no responses.

        `again`: from other values of its parameters, with effects at these places that it has not yet."""
        if parent.fitted.hypothesis.keys in self.seen and not again:
            return []
        if self.case.budget.spent:
            self.case.budget.untried += 1
            return []
        self.seen.add(parent.fitted.hypothesis.keys)
        self.case.budget.screen()
        try:
            looked = screened(self.case, parent.fitted, self.known)
        except FAILS:
            return []
        if not parent.fitted.hypothesis.effects and not again:
            self.norms = looked.norms
        if again:  # the error that is left there is no guide: only first-order steps are
            there = [(d, gain) for d, gain in looked.promised if again(d.candidate.place)]
            looked = dataclasses.replace(looked, promised=there, energy=None, by_energy=[])
        for d, gain in looked.promised:
            self.promised[d.candidate.key] = max(gain, self.promised.get(d.candidate.key, 0.0))
        found = extensions(self, parent, looked, again is not None)
        self.keep(found)
        return found

    def weighed(self, f: Fitted) -> Weighed:
        """Return a refit with its prior odds."""
        return Weighed(f, odds(f.hypothesis.effects, self.where, self.case.limits))

    def price(self, d: Direction) -> float:
        """Return the log prior odds of a screened effect."""
        return odds((Placed(d.candidate, {}),), self.where, self.case.limits)


def search(case: Case) -> Search:
    """Extend the best hypotheses until no predicted gain outweighs its prior odds, or the budget is spent.

    Wrong numbers of the plant file are rivals. Where a rig that drifts far is left with a misfit, it is
    searched with an observer, too."""
    s = started(case)
    null = s.best
    rivals = [s.weighed(f) for f in mistakes(case, null.fitted)]
    if rivals:
        s.keep(rivals)
        s.extended(null)  # also where a rival fits better
    grow(s)
    swap(s)
    if with_observer(s):
        grow(s)
        swap(s)
    s.admit()
    return s


def searched(s: Search) -> Searched:
    """Return the result of a search."""
    order = tuple(sorted(s.tried.values(), key=lambda w: -w.score))
    refused = {keys: why for keys, why in s.refused.items() if keys not in s.tried}
    return Searched(order, bool(s.case.budget.untried), s.norms, s.where, s.promised, refused)


def started(case: Case) -> Search:
    """Return a search that holds the plant without effects."""
    s = Search(case, places(case))
    s.keep([s.weighed(fitted(case, case.plant, (), case.null))])
    recall(s)
    return s


def grow(s: Search) -> None:
    """Extend the beam until none of its extensions is better."""
    for _ in range(s.case.limits.effects):
        first, *others = leaders(list(s.tried.values()), s.case.limits.beam)
        # one effect more may make such a hypothesis the better one
        fewer = [w for w in others if _number(w) < _number(first)]
        if only_noise(s.case, first.fitted):
            near = first.score - NEAR
            others = [w for w in others if w.score >= near or _number(w) < _number(first)]
        known = first.fitted.hypothesis.keys in s.seen
        parents = [first, *others]
        while parents:
            parent, *parents = parents
            if not s.extended(parent) and parent is first and not known:
                parents = fewer  # the best cannot be extended: no rival with more effects is needed
        if s.best.score <= first.score:
            break


def _number(w: Weighed) -> int:
    """Return the number of effects of a hypothesis."""
    return len(w.fitted.hypothesis.effects)


def swap(s: Search) -> None:
    """Leave out each effect of the best hypothesis in turn, and extend the rest, until none replaces it.

    So each effect is compared with its rivals beside the same other effects, in whatever order the beam added
    them. The rest is refitted even if the budget is spent: misfit.py compares the effect with it. Where it is
    the best, promises were compared without its gain: the rest of each of its effects is extended again."""
    while True:
        s.keep([*simplified(s), *cleared(s)])
        best = s.best
        effects = best.fitted.hypothesis.effects
        # the rest of a single effect is the plant alone, which is extended first of all
        for e in effects if len(effects) > 1 or frozenset() not in s.seen else ():
            rest, keys = tuple(o for o in effects if o is not e), best.fitted.hypothesis.keys - {e.key}
            if keys in s.seen:
                continue
            if s.case.budget.stopped():
                s.case.budget.untried += 1
                continue
            parent = s.tried.get(keys) or rebuilt(s, rest, best.fitted, best.fitted)
            if parent is None:
                continue
            if not parent.fitted.doubtful:
                s.keep([parent])
                if s.best is parent:
                    s.seen -= {parent.fitted.hypothesis.keys - {o.key} for o in rest}
            s.extended(parent)
        if s.best is best:
            return


def afresh(s: Search) -> None:
    """Extend parts of the best hypothesis that are far from the plant file's values from these.

    Without an effect a refit may move a parameter to where the effect changes nothing. So the lag of a member
    is hidden whose expansion is nearly none. Where the best hypothesis is near these values, it is right
    against a part that is far less likely."""
    best, own = s.best, s.case.plant.parameters
    scales = {q: Scale(p) for q, p in own.items() if p.range}

    def far(f: Fitted) -> bool:
        """Return whether a parameter is farther from its value in the file than its prior spreads."""
        there = {q: max(f.rough_plant.parameters[q].value, x.low) for q, x in scales.items()}
        return any(abs(x.z(there[q]) - x.z(own[q].value)) > BELIEF for q, x in scales.items())

    parts = [w for keys, w in s.tried.items() if keys < best.fitted.hypothesis.keys]
    least = -np.inf if far(best.fitted) else best.score - HOPELESS
    for w in (w for w in parts if w.score > least and far(w.fitted)):
        try:
            there = placed_at(s.case, w.fitted, {q: p.value for q, p in own.items()})
        except FAILS:
            continue
        s.extended(dataclasses.replace(w, fitted=there), lambda place: True)
        if s.best is not best:
            swap(s)
            s.admit()
            return


def simplified(s: Search) -> list[Weighed]:
    """Refit the best hypothesis with the simpler entry that an effect of it contains, from its values.

    Where others lead by far, the promise of the simpler entry was not worth a refit."""
    best, found = s.best.fitted, []
    for e in best.hypothesis.effects:
        simple = s.case.catalogue.get(e.candidate.effect.contains or "")
        if simple is None or not {p.name for p in simple.parameters if not p.amplitude} <= e.own.keys():
            continue
        keys = best.hypothesis.keys - {e.key} | {(simple.name, e.key[1])}
        known = keys in s.tried or keys in s.refused or len(keys) < len(best.hypothesis.effects)
        if known or s.case.budget.stopped():
            continue
        w = rebuilt(s, best.hypothesis.effects, best, best, {e.key: simple})
        if w and not w.fitted.doubtful and not w.fitted.absent:
            found.append(w)
        else:
            s.refuse(keys, w.fitted if w else None)
    return found


def cleared(s: Search) -> list[Weighed]:
    """Refit the best hypothesis without an effect that is near nothing, from its values.

    A refit of the others that ended in a wrong optimum may be all that such an effect is ahead of. The refit
    in white noise may have ended there, too."""
    best, found = s.best, list[Weighed]()
    values = dataclasses.replace(best.fitted, rough_plant=best.fitted.plant)
    for e in best.fitted.hypothesis.effects:
        rest = tuple(o for o in best.fitted.hypothesis.effects if o is not e)
        known = s.tried.get(best.fitted.hypothesis.keys - {e.key})
        if not known or known.score > best.score - SURPLUS or s.case.budget.stopped():
            continue
        if near_nothing(best.fitted, e) and (w := rebuilt(s, rest, values, best.fitted, near=best.fitted)):
            found.append(w)
    return found


def rebuilt(
    s: Search,
    effects: Sequence[Placed],
    values: Fitted,
    leader: Fitted | None,
    instead: Mapping[Key, Effect] | None = None,
    near: Fitted | None = None,
) -> Weighed | None:
    """Refit the case's plant with some effects of a hypothesis, from its values; None where this fails.

    It fails for a law: the catalogue has no place for it. `instead`: by effect, a simpler one that takes its
    place. `near`: a hypothesis that has the effects, too: where the refit is less likely, it starts again
    from all unknowns of that one."""
    case, known, instead = s.case, values.rough_plant, instead or {}
    if any(e.key[0] not in case.catalogue for e in effects):
        return None
    parameters = {n: known.parameters.get(n, p) for n, p in case.plant.parameters.items()}
    plant = dataclasses.replace(case.plant, parameters=parameters)
    entries = {e.key[0]: e.candidate.effect for e in effects} | {x.name: x for x in instead.values()}
    before = [
        _simpler(b, e.candidate.effect, instead[e.key]) if e.key in instead else b
        for e, b in zip(effects, placed_before(effects, known), strict=True)
    ]
    return remade(s, before, plant, entries, leader, near)


def _simpler(before: PlacedBefore, richer: Effect, simple: Effect) -> PlacedBefore:
    """Return a simpler effect with the values of one that contains it: those of the same name.

    The first amplitude is the richer one's: F is FC of Stribeck's friction."""
    names = {p.name: p.name for p in simple.parameters if p.name in before.values}
    first = [next((p.name for p in x.parameters if p.amplitude), "") for x in (simple, richer)]
    names.setdefault(*first)
    return PlacedBefore(
        (simple.name, before.key[1]),
        before.label,
        {p: before.values[q] for p, q in names.items()},
        {p: before.ranges[q] for p, q in names.items() if q in before.ranges},
    )


def remade(
    s: Search,
    effects: Sequence[PlacedBefore],
    plant: Plant,
    entries: Mapping[str, Effect],
    leader: Fitted | None,
    near: Fitted | None = None,
) -> Weighed | None:
    """Refit a plant with effects of an earlier hypothesis, from their values; None where this fails.

    Each place is looked up again: its expressions may have held an effect that is not there now."""
    case, placed = s.case, tuple[Placed, ...]()
    drives: Sequence[Excitation] = case.drives(case.null.model)
    try:
        for e in effects:
            c = found_again(candidates(case.rig(plant, drives), entries), e.key, e.label)
            plant, before = c.extend(e.values, e.ranges), plant
            drives = case.drives_after(plant, before, drives)
            placed = (*placed, Placed(c, {p: c.own(p) for p in e.values if c.own(p) in plant.parameters}))
        return s.weighed(fitted(case, free_starts(case.plant, plant), placed, None, leader, near))
    except (StopIteration, *FAILS):
        return None


def with_observer(s: Search) -> bool:
    """Search with a plant that follows its recordings, and refit its best hypotheses in the free run.

    Only for a rig that drifts: there a free run from a wrong hypothesis leads no refit to the right one.
    Return whether a hypothesis was found that the search had not."""
    case = s.case
    drives = case.drives(case.null.model)
    about = linear(case.null, drives)
    if about is None or not drifts(about, max(float(d.t[-1]) for d in drives)):
        return False
    if only_noise(case, as_refitted(case, s.best.fitted)):
        return False
    known = len(s.tried)
    for trust in TRUSTS:
        plant = held(case.plant, about, case.noise, float(np.median(np.diff(drives[0].t))), trust)
        if plant is None:
            break
        try:
            following = _following(s, plant)
        except FAILS:
            continue  # the plant with an observer cannot be simulated: the free search stands
        for w in leaders(list(following.tried.values()), case.limits.beam):
            effects = w.fitted.hypothesis.effects
            free = rebuilt(s, effects, w.fitted, None) if effects else None
            if free and not free.fitted.absent:
                s.keep([free])
        if len(s.tried) > known:
            break
    return len(s.tried) > known


def _following(s: Search, plant: Plant) -> Search:
    """Return a search with a plant that follows its recordings. Raises SimulationError."""
    case, model = s.case, compile_plant(plant)
    null = refit.fit(model, case.drives(model), case.noise, iterations=WHITE, seconds=np.inf)
    budget = Budget(case.limits.fits, case.budget.progress, case.budget.stopped)
    own = dataclasses.replace(case, plant=plant, null=null, budget=budget, memory=NOTHING)
    following = started(own)
    grow(following)
    return following


def recall(s: Search) -> None:
    """Refit the hypotheses of an earlier diagnosis to these recordings, from their earlier values."""
    past = s.case.memory.hypotheses
    likeliest = max((h.log_evidence for h in past), default=0.0)
    for h in past:
        far = h.log_evidence < likeliest - BEATEN * s.case.limits.effects
        if not h.effects or far:
            continue
        if s.case.budget.spent:
            s.case.budget.untried += 1
        else:
            leader = max((w.fitted for w in s.tried.values()), key=lambda f: f.log_likelihood)
            found = remade(s, h.effects, s.case.plant, s.case.catalogue, leader)
            if found:
                s.keep([found])


def leaders(tried: Sequence[Weighed], most: int) -> list[Weighed]:
    """Return the beam: the best hypotheses by score and by free-run error, in turn.

    The error counts, too, because the remainder may absorb an effect that a later extension explains."""
    ranked = [sorted(tried, key=lambda w: -w.score), sorted(tried, key=lambda w: w.fitted.rough.cost)]
    out: dict[Keys, Weighed] = {}
    for pair in zip(*ranked, strict=True):
        for w in pair:
            out.setdefault(w.fitted.hypothesis.keys, w)
    return list(out.values())[:most]


def extensions(s: Search, parent: Weighed, looked: Screened, again: bool = False) -> list[Weighed]:
    """Refit the parent with each direction, and with each pair of directions, of the shortlist.

    An extension is left out if twice its predicted gain does not bring it to the leader. Every prediction is
    multiplied by the largest ratio so far of a refit's gain to its prediction. `again`: those that were
    refused are tried, too, at any promise."""
    case, limits, tried = s.case, s.case.limits, s.tried
    out: list[Weighed] = []
    # beside effects that leave only noise, two more would imitate a small misfit
    misfit = not parent.fitted.hypothesis.effects or not only_noise(case, parent.fitted)
    queue, ratio = shortlist(looked, s.price, limits.shortlist, paired=misfit and not again), 1.0
    known = {*tried} if again else tried.keys() | s.refused.keys()
    new = s.best.fitted.hypothesis.keys - parent.fitted.hypothesis.keys
    queue += elsewhere(new, s.best.score - parent.score, looked, queue)

    def wanted(item: Extension) -> bool:
        """Return whether an extension is new and may win, and a refit is left."""
        added, gain = item
        keys = parent.fitted.hypothesis.keys | {d.candidate.key for d in added}
        if keys in known or len(keys) > limits.effects:
            return False
        if not again and parent.score + HALF * ratio * gain < max(w.score for w in [*tried.values(), *out]):
            return False
        case.budget.untried += case.budget.spent
        if case.budget.spent:
            return False
        known.add(keys)
        return True

    for batch, left in batches(queue, wanted):
        leader = max((w.fitted for w in [*tried.values(), *out]), key=lambda f: f.log_likelihood)
        case.budget.planned = case.budget.fits_done + left + len(batch)
        for (added, gain), f in zip(batch, refitted(case, parent.fitted, looked, batch, leader), strict=True):
            gained = s.weighed(f).score - parent.score if f else -np.inf
            ratio = max(ratio, gained / max(gain, 1.0)) if np.isfinite(gain) else ratio
            s.refuse(parent.fitted.hypothesis.keys | {d.candidate.key for d in added}, f)
            if f and not (f.absent or f.doubtful):
                out.append(s.weighed(f))
            elif f:
                queued = {d.candidate.key for ds, _ in queue for d in ds}
                more = simpler(added, gain, looked, s.price)
                queue += [x for x in more if x[0][0].candidate.key not in queued]
    return out
