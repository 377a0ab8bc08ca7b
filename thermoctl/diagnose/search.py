"""A beam of hypotheses, grown by the score test, compared by log evidence and prior odds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from thermoctl.diagnose.candidates import Candidate, candidates
from thermoctl.diagnose.case import Budget, Case
from thermoctl.diagnose.decide import Key
from thermoctl.diagnose.extend import extend, sticking, weaker
from thermoctl.diagnose.fit import WHITE, Fitted, Placed, as_refitted, fitted, over_noise
from thermoctl.diagnose.limits import Limits
from thermoctl.diagnose.memory import NOTHING, remade
from thermoctl.diagnose.observer import TRUSTS, drifts, held, linear
from thermoctl.diagnose.places import PLACES
from thermoctl.diagnose.roles import Structure
from thermoctl.diagnose.screen import Direction, Metric, sharpened
from thermoctl.diagnose.screening import Screened, places, screened
from thermoctl.plant import expression as ex
from thermoctl.plant import refit
from thermoctl.plant.language import Plant
from thermoctl.plant.simulate import SimulationError, compile_plant
from thermoctl.yamlfile import InputError

EVENTS = ("onsets", "windows")  # shapes that happen at one moment
PAIR = 2
SURPLUS = 5.0  # nats over every other extension, from which one with an insignificant part is kept
BEATEN = 10.0  # nats below the best: such a parent is not extended where the best leaves no more than noise
HALF = 2.0  # times its first-order promise that a refit may gain
PLACES_EACH = 3  # of one effect in a shortlist
ALIKE = 0.999  # cosine of two directions, above which they are one
Keys = frozenset[Key]
START = 10.0  # factor on the catalogue's standard deviation of an initial state that nobody measured


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
    """All hypotheses tried, best first; whether the budget ended the search."""

    tried: tuple[Weighed, ...]
    truncated: bool


def odds(effects: Sequence[Placed], where: Mapping[str, set[str]], limits: Limits) -> float:
    """Return the log prior odds of a hypothesis against no effect.

    The odds are shared equally among the entries, and each entry's among its places."""
    total = 0.0
    for e in effects:
        c = e.candidate
        share = len(where) * len(where.get(c.effect.name, {c.place.where}))
        total += np.log(limits.missing / (1 - limits.missing) / share) + np.log(_class(c, limits))
    return float(total)


def _class(c: Candidate, limits: Limits) -> float:
    """Odds of an entry's class against constant physics."""
    event = any(kind in EVENTS for kind in c.effect.shapes.values()) or any(
        p.per_recording for p in c.effect.parameters
    )
    return (limits.rare if event else 1.0) * (
        limits.rare if c.place.input and c.effect.where != "drive" else 1.0
    )


@dataclass
class Search:
    """A search under way: where each effect fits, hypotheses by their effects, and those already extended."""

    case: Case
    limits: Limits
    where: Mapping[str, set[str]]
    tried: dict[Keys, Weighed] = field(default_factory=dict)
    seen: set[Keys] = field(default_factory=set)

    @property
    def best(self) -> Weighed:
        """Return the likeliest hypothesis so far."""
        return max(self.tried.values(), key=lambda w: w.score)

    def keep(self, found: Iterable[Weighed]) -> None:
        """Add hypotheses; of two refits of one the likelier stays."""
        for w in found:
            keys = w.fitted.hypothesis.keys
            if keys not in self.tried or w.score > self.tried[keys].score:
                self.tried[keys] = w

    def extended(self, parent: Weighed) -> list[Weighed]:
        """Extend a hypothesis, once."""
        if parent.fitted.hypothesis.keys in self.seen:
            return []
        if self.case.budget.spent:
            self.case.budget.untried += 1
            return []
        self.seen.add(parent.fitted.hypothesis.keys)
        found = extensions(self.case, parent, self.where, self.limits, self.tried)
        self.keep(found)
        return found

    def weighed(self, f: Fitted) -> Weighed:
        """Return a refit with its prior odds."""
        return Weighed(f, odds(f.hypothesis.effects, self.where, self.limits))


def search(case: Case, limits: Limits) -> Searched:
    """Extend the best hypotheses until no predicted gain outweighs its prior odds, or the budget is spent.

    A rig that drifts far is searched with an observer first."""
    s = started(case, limits)
    with_observer(s)
    grow(s)
    swap(s)
    return Searched(tuple(sorted(s.tried.values(), key=lambda w: -w.score)), case.budget.spent)


def started(case: Case, limits: Limits) -> Search:
    """Return a search that holds the plant without effects."""
    s = Search(case, limits, places(case))
    s.keep([s.weighed(fitted(case, case.plant, (), case.null))])
    s.keep(recalled(s))
    return s


def grow(s: Search) -> None:
    """Extend the beam until none of its extensions is better."""
    for _ in range(s.limits.effects):
        beam = leaders(list(s.tried.values()), s.limits)
        best = beam[0].score
        close = max(over_noise(s.case, beam[0].fitted, s.limits.clean)) <= s.limits.clean
        for parent in beam:
            if close and parent.score < best - BEATEN:
                continue
            known = parent.fitted.hypothesis.keys in s.seen
            if not s.extended(parent) and parent is beam[0] and not known:
                break  # the best cannot be extended: no rival with more effects is needed
        if s.best.score <= best or s.case.budget.spent:
            break


def swap(s: Search) -> None:
    """Leave out each effect of the best hypothesis in turn, and extend the rest, until none replaces it.

    So each effect meets its rivals beside the same others, whichever way the beam took."""
    while True:
        best = s.best
        effects = best.fitted.hypothesis.effects
        for e in effects if len(effects) > 1 else ():
            rest = tuple(o for o in effects if o is not e)
            if s.case.budget.spent or frozenset(o.key for o in rest) in s.seen:
                continue
            parent = s.tried.get(frozenset(o.key for o in rest)) or rebuilt(s, rest, best.fitted, best.fitted)
            if parent:
                s.extended(parent)
        if s.best is best:
            return


def rebuilt(s: Search, effects: Sequence[Placed], values: Fitted, leader: Fitted | None) -> Weighed | None:
    """Refit the case's plant with some effects of a hypothesis, from its values; None where this fails."""
    case, known = s.case, values.rough_plant.parameters
    parameters = {n: known.get(n, p) for n, p in case.plant.parameters.items()}
    plant = dataclasses.replace(case.plant, parameters=parameters)
    drives, placed = case.drives(case.null.model), tuple[Placed, ...]()
    try:
        for e in effects:  # an expression of its place may hold what an effect left out had added
            found = candidates(
                Structure(plant, drives, [t.columns for t in case.tables]), {e.key[0]: e.candidate.effect}
            )
            c = next(c for c in found if (c.key, c.label) == (e.key, e.candidate.label))
            start = {
                p.name: known[e.own[p.name]].value if p.name in e.own else p.null for p in c.effect.parameters
            }
            inputs = plant.inputs.keys()
            plant, own = extend(plant, Direction(c, {}, 0.0, len(e.own), start), drives)
            if plant.inputs.keys() != inputs:
                drives = case.drives(compile_plant(plant))
            placed = (*placed, Placed(c, own))
        return s.weighed(fitted(case, free_starts(case.plant, plant), placed, None, leader))
    except (StopIteration, SimulationError, InputError, np.linalg.LinAlgError):
        return None


def with_observer(s: Search) -> None:
    """Search with a plant that follows its recordings, and refit its best hypotheses in the free run.

    Only for a rig that drifts: there a free run from a wrong hypothesis leads no refit to the right one."""
    case = s.case
    drives = case.drives(case.null.model)
    about = linear(case.null, drives)
    if about is None or not drifts(about, max(float(d.t[-1]) for d in drives)):
        return
    for trust in TRUSTS:
        if max(over_noise(case, as_refitted(case, s.best.fitted), s.limits.clean)) <= s.limits.clean:
            return
        plant = held(case.plant, about, case.noise, float(np.median(np.diff(drives[0].t))), trust)
        if plant is None:
            return
        model = compile_plant(plant)
        null = refit.fit(model, case.drives(model), case.noise, iterations=WHITE, seconds=np.inf)
        budget = Budget(s.limits.fits, case.budget.progress, case.budget.stopped)
        following = started(
            dataclasses.replace(case, plant=plant, null=null, budget=budget, memory=NOTHING), s.limits
        )
        grow(following)
        for w in leaders(list(following.tried.values()), s.limits):
            effects = w.fitted.hypothesis.effects
            free = rebuilt(s, effects, w.fitted, None) if effects else None
            if free and not free.fitted.absent:
                s.keep([free])


def recalled(s: Search) -> list[Weighed]:
    """Return the hypotheses of an earlier diagnosis, refitted to these recordings from where they were."""
    case, out = s.case, list[Weighed]()
    drives, columns = case.drives(case.null.model), [t.columns for t in case.tables]
    likeliest = max((h.log_evidence for h in case.memory.hypotheses), default=0.0)
    for past in case.memory.hypotheses:
        far = past.log_evidence < likeliest - BEATEN * s.limits.effects
        if not past.effects or case.budget.spent or far:
            continue
        try:
            plant, made = remade(past, case.plant, drives, columns, case.catalogue)
            effects = [Placed(c, own) for c, own in made]
            leader = max((w.fitted for w in (*s.tried.values(), *out)), key=lambda f: f.log_likelihood)
            f = fitted(case, free_starts(case.plant, plant), effects, None, leader)
        except (SimulationError, InputError, np.linalg.LinAlgError):
            continue
        out.append(s.weighed(f))
    return out


def leaders(tried: Sequence[Weighed], limits: Limits) -> list[Weighed]:
    """Return the beam: hypotheses in turn by score and by free-run error.

    By error too: the remainder may absorb an effect that a later extension explains."""
    ranked = [sorted(tried, key=lambda w: -w.score), sorted(tried, key=lambda w: w.fitted.rough.cost)]
    out: dict[Keys, Weighed] = {}
    for pair in zip(*ranked, strict=True):
        for w in pair:
            out.setdefault(w.fitted.hypothesis.keys, w)
    return list(out.values())[: limits.beam]


def relabels(c: Candidate) -> bool:
    """Return whether the plant or a simpler entry at the same place already contains this physics."""
    if c.effect.where == "bending_pair":
        return any(_free_member(c, side) for side in ("TA", "TB"))
    displaced = PLACES["displacement"](c.rig)
    return (
        c.effect.where == "sensor"
        and "tau" in c.effect.shapes
        and any(p.output == c.place.output for p in displaced)
    )


def _free_member(c: Candidate, side: str) -> bool:
    """Does the displacement hold this side's temperature already, with a coefficient that a refit moves?"""
    now = ex.substitute(c.place.symbols["y"], lambda e: e.args[0] if e.op == "delay" else None)
    slope = ex.derivative(now, str(c.place.symbols[side].value))
    parameters = c.rig.plant.parameters
    return any(n in parameters and parameters[n].range for n in ex.names(slope))


def extensions(
    case: Case, parent: Weighed, where: Mapping[str, set[str]], limits: Limits, tried: Mapping[Keys, Weighed]
) -> list[Weighed]:
    """Refit the parent with each direction, and with each pair of directions, of the shortlist."""
    out: list[Weighed] = []
    doubtful: list[Weighed] = []
    ahead = max(tried.values(), key=lambda w: w.score)
    # beside a hypothesis that leaves no more than noise only promises count
    promised = parent is not ahead and max(over_noise(case, ahead.fitted, limits.clean)) <= limits.clean
    looked = screened(case, parent.fitted, limits.clean)
    queue = shortlist(looked, where, limits)
    for k, (added, gain) in enumerate(queue):
        case.budget.planned = case.budget.fits_done + len(queue) - k
        keys = parent.fitted.hypothesis.keys | {d.candidate.key for d in added}
        if keys in tried or len(keys) > limits.effects:
            continue
        if parent.score + HALF * gain < ahead.score or promised and np.isinf(gain):
            continue
        if case.budget.spent:
            case.budget.untried += 1
            continue
        leader = max((w.fitted for w in [*tried.values(), *out]), key=lambda f: f.log_likelihood)
        fits = _followed(case, parent, looked, added, leader)
        found = [f for f in fits if not f.absent]
        if found:
            best = max(found, key=lambda f: f.log_evidence)
            w = Weighed(best, odds(best.hypothesis.effects, where, limits))
            (doubtful if best.doubtful else out).append(w)
        if any(f.absent or f.doubtful for f in fits):
            queued = {d.candidate.key for ds, _ in queue for d in ds}
            queue += [((d,), gain) for d in simpler(added, looked) if d.candidate.key not in queued]
    simplest = max((w.score for w in (parent, *out)), default=parent.score)
    return [*out, *(w for w in doubtful if w.score > simplest + SURPLUS)]


def simpler(added: Sequence[Direction], looked: Screened) -> list[Direction]:
    """Return the entries at the same places with fewer parameters, to try without an insignificant part."""
    return [
        d
        for d in looked.directions
        if any(
            d.candidate.place.where == a.candidate.place.where
            and len(d.candidate.effect.parameters) < len(a.candidate.effect.parameters)
            for a in added
        )
        and d.gain > 0
    ]


def shortlist(
    looked: Screened, where: Mapping[str, set[str]], limits: Limits
) -> list[tuple[tuple[Direction, ...], float]]:
    """Return the directions whose predicted gain outweighs their prior odds, then pairs; each with its gain.

    The best is first; at most PLACES_EACH of one effect. Those with the largest gain in energy follow."""
    paying = []
    for d, promise in zip(looked.directions, looked.promises, strict=True):
        gain = promise + odds((Placed(d.candidate, {}),), where, limits)
        if gain > 0 and d.gain > 0 and not relabels(d.candidate):
            paying.append((d, gain))
    paying.sort(key=lambda x: -x[1])
    out: list[tuple[tuple[Direction, ...], float]] = []
    for d, gain in paying:
        alike = [o for (o,), _ in out if o.candidate.effect is d.candidate.effect]
        if len(alike) < PLACES_EACH and d.candidate.key not in {o.candidate.key for o in alike}:
            out.append(((d,), gain))
    out = [(d, gain) for d, gain in out[: limits.shortlist] if HALF * gain > out[0][1]]
    known = {d.candidate.key for (d,), _ in out}
    out += [((d,), np.inf) for d in largest(looked)[: limits.shortlist] if d.candidate.key not in known]
    together = pairs([d for d, _ in paying], looked.metric, limits)
    if looked.energy:
        together += pairs(looked.by_energy, looked.energy, limits)
    return [*out, *((p, np.inf) for p in together)]


def largest(looked: Screened) -> list[Direction]:
    """Return the direction of each candidate whose gain in energy is at least half of the best one's."""
    first: dict[tuple[str, str], Direction] = {}
    for d in looked.by_energy:
        if HALF * d.gain > looked.by_energy[0].gain and not relabels(d.candidate):
            first.setdefault(d.candidate.key, dataclasses.replace(d, vector=None))
    return list(first.values())


def pairs(directions: Sequence[Direction], metric: Metric, limits: Limits) -> list[tuple[Direction, ...]]:
    """Return pairs of constant physics, at their joint sizes, that explain far more together than one by one.

    The plant's own parameters may imitate each alone, but not both together."""
    best: dict[tuple[str, str], Direction] = {}
    for d in directions:
        if d.vector is not None and not any(kind in EVENTS for kind in d.candidate.effect.shapes.values()):
            best.setdefault(d.candidate.key, d)
    kept = list(best.values())
    if len(kept) < PAIR:
        return []
    v = np.stack([d.vector for d in kept if d.vector is not None]).astype(float)
    g = np.maximum(v @ metric.residual, np.finfo(float).tiny)
    c = np.clip(v @ v.T, -ALIKE, ALIKE)
    first = (g[:, None] - c * g[None]) / (
        1 - c**2
    )  # size of the first beside the second, along its unit vector
    joint = g[:, None] * first + g[None] * first.T
    alone = np.array([d.gain for d in kept])
    extra = np.triu(joint - np.maximum.outer(alone, alone), 1)
    out: list[tuple[Direction, ...]] = []
    for k in np.argsort(-extra, axis=None):
        a, b = np.unravel_index(k, extra.shape)
        if len(out) >= limits.shortlist // PAIR or extra[a, b] <= max(alone[a], alone[b]):
            break
        pair = (resized(kept[a], first[a, b] / g[a]), resized(kept[b], first[b, a] / g[b]))
        if all(d is not None for d in pair):
            out.append(tuple(d for d in pair if d is not None))
    return out


def resized(d: Direction, factor: float) -> Direction | None:
    """Return the direction with its size multiplied by `factor`; None if the size leaves its bounds."""
    start = dict(d.start)
    for p in d.candidate.effect.parameters:
        if p.amplitude:
            start[p.name] = p.null + factor * (start[p.name] - p.null)
            low, high = d.candidate.bounds(p)
            if not low <= start[p.name] <= high:
                return None
    return dataclasses.replace(d, start=start)


def _followed(
    case: Case, parent: Weighed, looked: Screened, added: Sequence[Direction], leader: Fitted
) -> list[Fitted]:
    """Refit the parent with the directions from several starting points, which depend on their shapes.

    If every refit fits worse than the parent, start again from a weaker effect."""
    first = tuple(sharpened(looked.metric, looked.rig, d) for d in added)
    stuck = tuple(sticking(d) or d for d in first)
    found = [_refitted(case, parent, first, looked, leader)]
    if stuck != first and max(d.gain for d in first) > looked.directions[0].gain / PAIR:
        found.append(_refitted(case, parent, stuck, looked, leader))
    if all(f is None or f.rough.cost > parent.fitted.rough.cost for f in found):
        found.append(_refitted(case, parent, tuple(weaker(d) for d in first), looked, leader))
    return [f for f in found if f is not None]


def _refitted(
    case: Case, parent: Weighed, added: Sequence[Direction], looked: Screened, leader: Fitted
) -> Fitted | None:
    effects, plant = parent.fitted.hypothesis.effects, parent.fitted.rough_plant
    drives = looked.metric.drives
    try:
        for d in added:
            rig = Structure(plant, drives, [t.columns for t in case.tables])
            d = dataclasses.replace(d, candidate=dataclasses.replace(d.candidate, rig=rig))
            inputs = plant.inputs.keys()
            plant, own = extend(plant, d, drives)
            if plant.inputs.keys() != inputs:  # a column of the recordings that an effect needs
                drives = case.drives(compile_plant(plant))
            effects = (*effects, Placed(d.candidate, own))
        return fitted(case, free_starts(case.plant, plant), effects, None, leader, parent.fitted.rough.cost)
    except (SimulationError, InputError, np.linalg.LinAlgError):
        return None


def free_starts(before: Plant, after: Plant) -> Plant:
    """Widen the initial states of bodies that an effect added: nobody measured where they start."""
    nodes = {
        n.name: n
        if n.name in before.nodes or not n.initial_sigma
        else dataclasses.replace(n, initial_sigma=START * n.initial_sigma)
        for n in after.nodes.values()
    }
    return dataclasses.replace(after, nodes=nodes)
