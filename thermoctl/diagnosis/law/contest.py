"""Unknown laws as hypotheses beside those of the catalogue, with the same search, evidence and prior odds.

A law is proposed from the residual of a hypothesis (`propose`), refitted, and extended by effects of the
catalogue like any other hypothesis. Each of its terms has the prior odds of an effect that is `rare`. The
choice among places, signals and forms makes them smaller (`Proposal.cost`)."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np
from scipy.special import softmax

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed, placed_at
from thermoctl.diagnosis.evidence.levels import only_noise
from thermoctl.diagnosis.evidence.posterior import Hypothesis
from thermoctl.diagnosis.hypothesis.candidates import DIFFERS, Keys
from thermoctl.diagnosis.hypothesis.places import Place
from thermoctl.diagnosis.law.find import Goal, refits
from thermoctl.diagnosis.law.forms import LAW
from thermoctl.diagnosis.law.free import pays
from thermoctl.diagnosis.law.propose import TERMS, Proposal, more_terms, propose_laws, propose_pairs
from thermoctl.diagnosis.law.refit import PlacedLaw, at_bound, laws_of, limit_of, refitted_law, settled
from thermoctl.diagnosis.search.beam import BEATEN, NEAR, Search, Weighed, grow, rebuilt, swap
from thermoctl.diagnosis.search.shortlist import PAIR


def with_laws(s: Search) -> Search:
    """Add laws to a search and return it: beside the plant alone, and beside the leading hypothesis.

    No law is sought if the plant leaves only noise and no effect was found. Nor is one if a single effect
    leaves only noise and no law is worth its odds beside it (`pays`). The size of a residual alone does not
    see tens of nats, by which a law may fit better than the effect that imitates it. Two effects may imitate
    one law with more parameters than it has. Nothing is left beside them then, so a law is always tried."""
    case, alone, best = s.case, s.tried[frozenset()], s.best
    effects = len(best.fitted.hypothesis.effects)
    if only_noise(case, best.fitted) and effects < PAIR and (not effects or not _pays(case, best)):
        return s
    queue, known = [alone, best, *_beside_bounded(s, best), _the_same(s)], set[Keys]()
    while queue and not case.budget.stopped():
        parent, *queue = queue
        keys = parent.fitted.hypothesis.keys
        if keys in known or keys and only_noise(case, parent.fitted):
            continue
        known.add(keys)
        case.budget.progress("looking for a law")
        quiet, many = only_noise(case, s.best.fitted), len(parent.fitted.hypothesis.effects)
        rivals = [s.best if quiet else _leading(s, many + k + 1) for k in range(TERMS)]
        near = NEAR if quiet else BEATEN
        least = tuple(w.score - parent.score - near for w in rivals)
        goal = Goal(least, NEAR if quiet else 0.0, quiet)
        done = case.budget.fits_done
        _compete(s, _laws(s, parent, goal), done)
        if not only_noise(case, s.best.fitted):
            queue += _without_laws(s)
    if not case.budget.stopped() and not only_noise(case, s.best.fitted):
        case.budget.progress("looking for laws at two places")
        done = case.budget.fits_done
        _compete(s, _pairs(s), done)
    _as_known(s)
    lead, weighed = s.best, {*s.tried}
    _make_rarer(s, weighed)  # another hypothesis may lead now, with effects that its law makes needless
    if s.best.fitted is not lead.fitted:
        _fewer(s)
        _make_rarer(s, s.tried.keys() - weighed)
    s.admit()
    return s


def _make_rarer(s: Search, which: Set[Keys]) -> None:
    """Give hypotheses the odds `rare` once more where an effect was tried in place of their law.

    Known physics at a node is likelier than an unknown law there that imitates it."""
    for keys in which:
        w = s.tried[keys]
        if any(_replaced(w, law, other) for law in laws_of(w.fitted) for other in s.tried.values()):
            s.tried[keys] = replace(w, log_odds=w.log_odds + float(np.log(s.case.limits.rare)))


def _replaced(w: Weighed, law: PlacedLaw, other: Weighed) -> bool:
    """Return whether another hypothesis has an effect at a law's nodes or reading in its place."""
    keys = w.fitted.hypothesis.keys
    new = [e for e in other.fitted.hypothesis.effects if e.key not in keys]
    if len(new) != 1 or isinstance(new[0], PlacedLaw) or keys - other.fitted.hypothesis.keys != {law.key}:
        return False
    return _shares_nodes(law, new[0].candidate.place, other.fitted)


def _shares_nodes(law: PlacedLaw, place: Place, f: Fitted) -> bool:
    """Return whether a place of a hypothesis has one of a law's nodes, or its reading."""
    flow = f.plant.flows.get(place.flow or "")
    ends = {flow.source, flow.target} if flow else set()
    own = law.proposal.place
    return not {*own.nodes, own.target}.isdisjoint({*place.nodes.values(), *ends, place.output})


def _beside_bounded(s: Search, best: Weighed) -> list[Weighed]:
    """Return a hypothesis without each of its effects that ended at a bound: there it is other physics.

    A creep that takes far longer than the recording is a spring."""
    keys, bounds = best.fitted.hypothesis.keys, best.fitted.fit.at_bound.keys()
    bounded = [e.key for e in best.fitted.hypothesis.effects if bounds & {*e.own.values()}]
    return [s.tried[keys - {key}] for key in bounded if keys - {key} in s.tried]


def _the_same(s: Search) -> Weighed:
    """Return the likeliest hypothesis in which no parameter differs between recordings.

    A parameter that differs may stand for a law: beside it the law is not seen."""
    same = (
        w
        for w in s.tried.values()
        if all(e.candidate.effect.where != DIFFERS for e in w.fitted.hypothesis.effects)
    )
    return max(same, key=lambda w: w.score)


def _without_laws(s: Search) -> list[Weighed]:
    """Return the effects of the leading hypothesis, where it has a law: beside them alone others may fit."""
    keys = frozenset(e.key for e in s.best.fitted.hypothesis.effects if not isinstance(e, PlacedLaw))
    return [s.tried[keys]] if keys in s.tried and keys != s.best.fitted.hypothesis.keys else []


def _compete(s: Search, laws: Sequence[Weighed], done: int) -> None:
    """Add laws to a search, and extend one that leads the hypotheses with no more terms and effects.

    Effects that imitate a law may be ahead of it with one more. Its refits, those since `done`, take none
    from the catalogue."""
    s.case.budget.fits += s.case.budget.fits_done - done
    before = s.best
    s.keep(laws)
    for w in laws:
        if w is _leading(s, _size(w)):
            s.extended(w)
    if s.best is not before:
        # the search may have spent its refits before it met the law
        budget, limits = s.case.budget, s.case.limits
        budget.fits = max(budget.fits, budget.fits_done + limits.beam * limits.shortlist)
        grow(s)
        swap(s)
        _fewer(s)


def _as_known(s: Search) -> None:
    """Extend what stands beside the leading law by effects at its nodes, from the law's refit.

    There an effect may be found that is the law, and whose own refit ended in a wrong optimum."""
    best = s.best.fitted
    laws = laws_of(best)
    if not laws or s.case.budget.stopped():
        return
    base = _beside(s, [e for e in best.hypothesis.effects if not isinstance(e, PlacedLaw)], best)
    if base:
        values = {q: p.value for q, p in best.plant.parameters.items()}
        try:
            there = replace(base, fitted=placed_at(s.case, base.fitted, values))
            s.extended(there, lambda place: any(_shares_nodes(law, place, best) for law in laws))
        except FAILS:
            return
        if s.best.fitted is not best:
            swap(s)


def _fewer(s: Search) -> None:
    """Leave out each effect beside the leading law in turn, and refit, until it leads no more without one.

    An effect must not explain what one more term of the law does: so that is refitted, too."""
    known = set[Keys]()
    while laws := laws_of(s.best.fitted):
        best = s.best
        effects = [e for e in best.fitted.hypothesis.effects if not isinstance(e, PlacedLaw)]
        for e in effects:
            keys = best.fitted.hypothesis.keys - {e.key}
            base = _beside(s, [o for o in effects if o is not e], best.fitted)
            if base is None or keys in known or s.case.budget.stopped():
                continue
            known.add(keys)
            if keys not in s.tried:
                _keep_laws(s, base, [settled(law, best.fitted) for law in laws])
            if keys in s.tried:
                _more(s, base, s.tried[keys].fitted)
        if s.best is best:
            return


def _more(s: Search, base: Weighed, f: Fitted) -> None:
    """Refit a hypothesis with one more term in each of its laws in turn; `base`: it without laws."""
    laws = [settled(law, f) for law in laws_of(f)]
    for k, law in enumerate(laws):
        others = [*laws[:k], *laws[k + 1 :]]
        try:
            more = more_terms(s.case, f, law, s.case.limits)
        except FAILS:
            more = []
        for p in (p for p in more if len(p.terms) <= TERMS):
            _keep_laws(s, base, [p, *others])


def _keep_laws(s: Search, base: Weighed, laws: Sequence[Proposal]) -> None:
    """Refit a hypothesis with laws, and keep it if all of it is significant."""
    f = refitted_law(s.case, base.fitted, laws[0], base.fitted, laws[1:])
    if f and not f.absent and not f.doubtful and not at_bound(f):
        s.keep([s.weighed(f)])


def _beside(s: Search, effects: Sequence[Placed], values: Fitted) -> Weighed | None:
    """Return a hypothesis of the catalogue, refitted from the values of another one if it is not known."""
    keys = frozenset(e.key for e in effects)
    if keys not in s.tried and (w := rebuilt(s, effects, values, values)):
        s.keep([w])
    return s.tried.get(keys)


def _size(w: Weighed) -> int:
    """Return the number of effects of a hypothesis, each term of a law counted as one."""
    return sum(len(e.proposal.terms) if isinstance(e, PlacedLaw) else 1 for e in w.fitted.hypothesis.effects)


def _leading(s: Search, size: int) -> Weighed:
    """Return the likeliest hypothesis of at most this size."""
    return max((w for w in s.tried.values() if _size(w) <= size), key=lambda w: w.score)


def _pays(case: Case, best: Weighed) -> bool:
    try:
        return pays(case, best.fitted, case.limits)
    except FAILS:
        return False


def _pairs(s: Search) -> list[Weighed]:
    """Return the best hypothesis with laws at two places, and with each of these laws alone.

    Where a shape is at its bound, the form that the law becomes there is refitted."""
    case, alone = s.case, s.tried[frozenset()].fitted
    try:
        queue = propose_pairs(case, alone, case.limits)
    except FAILS:
        return []
    found, best = list[Weighed](), alone
    for pair in queue:
        f = refitted_law(case, alone, pair[0], best, pair[1:])
        if f is None or f.absent:
            continue
        best = max(best, f, key=lambda x: x.log_likelihood)
        placed = [e for e in f.hypothesis.effects if isinstance(e, PlacedLaw)]
        limit = tuple(limit_of(e, f) for e in placed)
        if at_bound(f) and {p.kind for p in limit} != {p.kind for p in pair}:
            queue.append((limit[0], limit[1]))
        elif not at_bound(f) and not f.doubtful:
            found.append(s.weighed(f))
    if not found:
        return []
    top = max(found, key=lambda w: w.score)
    laws = [limit_of(e, top.fitted) for e in top.fitted.hypothesis.effects if isinstance(e, PlacedLaw)]
    single = [refitted_law(case, alone, p, alone) for p in laws]
    return [top, *(s.weighed(f) for f in single if f)]


def _laws(s: Search, parent: Weighed, goal: Goal) -> list[Weighed]:
    """Return a hypothesis with the best law at each place, beside a parent and beside parts of it.

    Only laws that may reach the goal are refitted.
    The effects of the parent may imitate the law that is proposed beside them. So it is refitted without
    them, too, and without those that it makes insignificant. There its promise is larger by their gain."""
    case, alone = s.case, s.tried[frozenset()]
    try:
        proposals = propose_laws(case, parent.fitted, case.limits)
    except FAILS:
        return []
    keys = parent.fitted.hypothesis.keys
    taken = {key[1] for key in keys if key[0] == LAW}
    proposals = [p for p in proposals if p.place.where not in taken]

    def refitted(base: Weighed) -> list[tuple[Proposal, Weighed]]:
        """Return the laws that were refitted beside a hypothesis; single ones beside a part of the parent."""
        more, single = parent.score - base.score, base is not parent
        some = [replace(p, promise=p.promise + more) for p in proposals if len(p.terms) == 1 or not single]
        least = replace(goal, least=tuple(x + more for x in goal.least))
        tried = refits(case, base.fitted, some, least)
        return [(p, Weighed(f, base.log_odds - p.cost)) for p, f in tried]

    bases, groups = [parent], [refitted(parent)]
    while (base := _part(s, bases[-1], groups[-1])) or alone not in bases:
        bases.append(base or alone)
        groups.append(refitted(bases[-1]))
    found = (
        _best([x for x in some if x[0].place == place], case.limits.set)
        for some in groups
        for place in {p.place: 0 for p, _ in some}
    )
    return [w for w in found if w and len(w.fitted.hypothesis.effects) <= case.limits.effects]


def _part(s: Search, base: Weighed, laws: Sequence[tuple[Proposal, Weighed]]) -> Weighed | None:
    """Return a hypothesis without the effects that the best law beside it makes insignificant.

    Where there is no room for a law, the effect that is worth least is left out; None if all may stay."""
    effects = base.fitted.hypothesis.effects
    absent = max(laws, key=lambda x: x[1].score)[1].fitted.absent if laws else frozenset()
    rest = tuple(e for e in effects if e.key not in absent)
    if len(rest) >= s.case.limits.effects:
        less = [s.tried[k] for e in effects if (k := base.fitted.hypothesis.keys - {e.key}) in s.tried]
        return max(less, key=lambda w: w.score, default=None)
    if len(rest) == len(effects):
        return None
    return _beside(s, rest, base.fitted)


def _best(laws: Sequence[tuple[Proposal, Weighed]], certain: float) -> Weighed | None:
    """Return the likeliest law at one place whose parts are significant; None if there is none.

    Its `rivals` are the others that fit about as well."""
    laws = [(p, w) for p, w in laws if not w.fitted.doubtful and not w.fitted.absent]
    if not laws:
        return None
    share = softmax(np.array([w.score for _, w in laws]))
    order = np.argsort(-share, kind="stable")
    best = laws[order[0]][1]
    kinds = {laws[order[0]][0].kind}
    rivals: list[tuple[Proposal, Fitted, float]] = []
    for k in order[1:]:
        if share[k] > 1 - certain and laws[k][0].kind not in kinds:
            kinds.add(laws[k][0].kind)
            rivals.append((laws[k][0], laws[k][1].fitted, float(share[k])))
    *effects, law = best.fitted.hypothesis.effects
    hypothesis = Hypothesis((*effects, replace(law, rivals=tuple(rivals))))
    return replace(best, fitted=replace(best.fitted, hypothesis=hypothesis))
