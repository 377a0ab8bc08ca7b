"""Proposals of laws: sparse regression on the linearised plant.

1. `smooth` tracks the recordings with unknown flows and linearises the plant about this trajectory.
2. Each place and signal is scored with a free function of the signal (straight lines between quantiles).
3. Where that score is high, the library's forms are tried: alone, in pairs, and in sums of three terms."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.law.forms import Family, Term, combined, families, library
from thermoctl.diagnosis.law.free import (
    NODES,
    at_refit,
    choices,
    energy,
    entered,
    log_number,
    places_in,
    predicted,
    ranked,
    unlikely,
)
from thermoctl.diagnosis.law.signals import Place, Signal, rates
from thermoctl.diagnosis.law.smooth import Tracked, tracked
from thermoctl.diagnosis.limits import Thresholds
from thermoctl.diagnosis.search.screen import chunks
from thermoctl.diagnosis.search.shortlist import ALIKE
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.residuals import HUGE

# Largest number of nodes with an unknown flow, those that explain the residual best: 24 knots each.
TRACKED = 20
SECOND = 10  # number of signals of a place that may be the second one of a form
COMBINATIONS = 12  # number of ranked (place, signal) pairs whose forms are tried
POOL = 60  # number of terms from which sums of terms are built
PAIRED = 600  # number of terms that are tried two at a time
PAIRS, LIKELY = 24, 50_000  # number of pairs that are kept; number of best pairs among which they are sought
GROWN = 8  # number of pairs, those with the best score, to which a third term is added
# Number of proposals of either kind; of those with one term, by score; of those with different signals.
PROPOSALS, SINGLE, SIGNALS = 14, 5, 4
TERMS = 3
# Number of terms whose shapes are searched more finely; of finer grids; of values of each shape in them.
ZOOMED, ZOOMS, FINE = 20, 2, 9
CHUNK = 256  # number of terms whose responses are computed at a time
NEEDED = 15.0  # nats that free flows into two nodes need beside one: two terms of a law are not likelier
# Number of terms of each law of a pair; number of pairs, and of those that hold the same law.
EACH, COUPLES, SHARED = 8, 6, 2
WIDTH = 0.05  # width of a switch, in typical sizes of its signal (config/laws.yaml)
ADDED = 4  # number of terms of a law's own signals that are added to it
PLAIN = (
    "constant",
    "linear",
)  # forms that are no laws of a reading: an offset, and a gain as in the catalogue
SLIGHT = ("timed", "spent")  # forms of two signals, of which the first one alone shows little
KEPT = 20  # number of values of the shapes of a form over a signal that are kept for sums


@dataclass(frozen=True)
class Proposal:
    """Terms at a place, their sizes, and the gain in log likelihood that the linearised plant predicts.

    `start`: of a part of a refitted law, the values of the plant's parameters there."""

    place: Place
    terms: tuple[Term, ...]
    sizes: tuple[float, ...]
    promise: float
    look: float  # log of the number of places, signals and forms that a term was chosen from
    limits: Thresholds
    start: Mapping[str, float] = field(default_factory=dict, compare=False)

    @property
    def cost(self) -> float:
        """Return minus the log of its prior odds.

        Each term has the odds `missing` and `rare`, and is chosen from many places, signals and forms; a
        second signal adds one more choice. A flow that a difference or a velocity drives usually reverses
        with it: other terms have the prior `rare`."""
        chosen = self.look * sum(max(len(t.signals), 1) for t in self.terms)
        chosen += len(self.terms) * unlikely(self.limits)
        return chosen + float(np.log(2)) * self.shapes + sum(self._form_cost(t) for t in self.terms)

    def _form_cost(self, t: Term) -> float:
        """Return minus the log of a form's prior over the prior if all forms were equally likely."""
        if t.reverses is None:
            return 0.0
        odd, rare = sum(form.odd for form in library()) / len(library()), self.limits.rare
        return float(np.log(odd / (1 - rare)) if t.reverses else np.log((1 - odd) / rare))

    @property
    def kind(self) -> tuple[Place, tuple[tuple[str, tuple[Signal, ...]], ...]]:
        """Return place, forms and signals, without the values of shapes."""
        return self.place, tuple(sorted(((t.form.name, t.signals) for t in self.terms), key=str))

    @property
    def reads(self) -> AbstractSet[str]:
        """Return the names that its signals and shares read."""
        read = [s.value for t in self.terms for s in t.signals] + [share for _, share in self.place.shares]
        return {n for e in read for n in ex.names(e)}

    @property
    def shapes(self) -> int:
        """Number of parameters that are not sizes."""
        return sum(len(t.form.shapes) for t in self.terms)

    @property
    def score(self) -> float:
        """Predicted gain minus `cost`."""
        return self.promise - self.cost


@dataclass(frozen=True, eq=False)
class Found:
    """A term at a place: its gain in energy, and its responses (rows, sizes)."""

    gain: float
    place: Place
    term: Term
    columns: np.ndarray

    @property
    def kind(self) -> tuple[str, tuple[Signal, ...]]:
        """Return the term without the values of its shapes."""
        return self.term.form.name, self.term.signals


def propose_laws(case: Case, parent: Fitted, limits: Thresholds) -> list[Proposal]:
    """Return the most promising laws, best first. Raises SimulationError.

    Laws of unread columns, and of readings, take no turn from the others: the best of each kind come one by
    one. The trajectory that follows a reading has the reading's error: so its laws are proposed about the
    refit's own."""
    rig, where, linear = linearised(case, parent)
    combos = choices(case, rig, where, linear.likely[:NODES], linear)
    base, pool, kinds = (log_number(combos), limits), list[Found](), list[list[Proposal]]()
    for part, new in _in_turn(rig, [c for c in combos if c[0].part != "reading"]):
        pool = _best_first([*pool, *_terms(case, linear, ranked(linear, part), COMBINATIONS, new)])
        kinds.append(_mixed([p for p in _composed(linear, pool, base) if not new or _reads(p.terms, new)]))
    linear, read = at_refit(case, parent), [c for c in combos if c[0].part == "reading"]
    kinds.append(_mixed(_composed(linear, _terms(case, linear, ranked(linear, read), COMBINATIONS), base)))
    kinds.sort(key=lambda ps: -max((p.score for p in ps), default=-np.inf))
    return [p for ps in itertools.zip_longest(*kinds) for p in ps if p]


def _composed(linear: Tracked, pool: Sequence[Found], base: tuple[float, Thresholds]) -> list[Proposal]:
    """Return the laws of one term, and of sums of terms, the best first."""
    out = [_proposal(linear, f.place, (f.term,), f.columns, base) for f in _varied(pool)]
    for place in dict.fromkeys(f.place for f in pool):
        out += _sums(linear, place, [f for f in pool if f.place == place], base)
    return sorted(out, key=lambda p: -p.score)


def more_terms(case: Case, f: Fitted, law: Proposal, limits: Thresholds) -> list[Proposal]:
    """Return a refitted law with one more term of its own signals, best first. Raises SimulationError.

    `law`: at its refitted values. A law of the library is rarely exact: an effect of the catalogue must not
    explain what another form of the law does. So switches of a free width come first, with and without the
    other terms."""
    linear = at_refit(case, f)
    own = list(dict.fromkeys(s for t in law.terms for s in t.signals))
    out = []
    for term in _varied(_best_first(_singles(linear, law.place, own, own, frozenset()))):
        promise, sizes = predicted(linear, term.columns, len(term.term.form.shapes))
        terms = (*law.terms, term.term)
        out.append(
            dataclasses.replace(law, terms=terms, sizes=(*law.sizes, *map(float, sizes)), promise=promise)
        )
    return _softened(law) + sorted(out, key=lambda p: -p.score)[:ADDED]


def _softened(law: Proposal) -> list[Proposal]:
    """Return a law whose switches are steps of a free width, with and without its other terms."""
    form = next(f for f in library() if f.name == "logistic")
    first = np.cumsum([0, *(len(t.form.sizes) for t in law.terms)])
    soft = {
        k: dataclasses.replace(t, form=form, shapes={**t.shapes, "s": WIDTH})
        for k, t in enumerate(law.terms)
        if t.form.name == "switch"
    }
    if not soft:
        return []
    every = tuple(soft.get(k, t) for k, t in enumerate(law.terms))
    alone = tuple(law.sizes[first[k]] for k in soft)
    out = [dataclasses.replace(law, terms=every)]
    if len(soft) < len(every):
        out.append(dataclasses.replace(law, terms=tuple(soft.values()), sizes=alone))
    return out


def _in_turn(
    rig: Rig, combos: Sequence[tuple[Place, Signal]]
) -> list[tuple[list[tuple[Place, Signal]], AbstractSet[str]]]:
    """Return the places and signals without unread columns, and then all, with the unread columns in them."""
    spare = {*rig.spare}
    read = [(p, s) for p, s in combos if s.label not in spare]
    new = {s.label for _, s in combos} & spare
    return [(read, set()), ([*combos], new)] if new else [(read, set())]


def _reads(terms: Sequence[Term | Family], columns: AbstractSet[str]) -> bool:
    """Return whether a term has one of these columns as a signal."""
    return any(s.label in columns for t in terms for s in t.signals)


def _best_first(pool: Sequence[Found]) -> list[Found]:
    return sorted(pool, key=lambda f: -f.gain)


def _terms(
    case: Case,
    linear: Tracked,
    free: Sequence[tuple[float, Place, Signal]],
    count: int,
    new: AbstractSet[str] = frozenset(),
) -> list[Found]:
    """Return terms over the first `count` of ranked places and signals, the best first.

    `new`: columns of which each term reads one; any term without them."""
    pool: list[Found] = []
    for place in dict.fromkeys(p for _, p, _ in free[:count]):
        first = [s for _, p, s in free[:count] if p == place]
        own = [s for _, p, s in free if p == place]
        # not as effects change them: a law must not need an effect
        flows = rates(case.plant, place, linear.metric.signals, own)
        pool += _singles(linear, place, first, [*own[:SECOND], *flows], new)
    pool = _best_first(pool)
    return _best_first([*pool, *(_zoomed(linear, f) for f in _varied(pool)[:ZOOMED])])


def propose_pairs(case: Case, parent: Fitted, limits: Thresholds) -> list[tuple[Proposal, Proposal]]:
    """Return pairs of laws with one term each, at two nodes, best first. Raises SimulationError.

    There is no pair if free flows into two nodes are less than NEEDED above those into one. Each law is
    proposed beside a free flow into the node of the other. Both laws state the promise of the pair. Promises
    of pairs with one law in common err together: so few of them are returned."""
    rig, where, linear = linearised(case, parent)
    likely = linear.likely[:NODES]
    couples = {(a, b): linear.flows((a, b)) for a, b in itertools.combinations(likely, 2)}
    alone = max(linear.flows((n,))[0] for n in likely)
    best = max(couples, key=lambda c: couples[c][0], default=None)
    if best is None or couples[best][0] < alone + NEEDED:
        return []
    combos = choices(case, rig, [p for p in where if p in map(Place, best)], best, linear)
    base, out = (log_number(combos), limits), list[tuple[Proposal, Proposal]]()
    for part, new in _in_turn(rig, combos):
        each = []
        for n, other in (best, best[::-1]):
            beside = linear.beside(other, couples[best][1])
            free = ranked(beside, [c for c in part if c[0] == Place(n)])
            single = [f for f in _varied(_terms(case, beside, free, EACH)) if len(f.term.form.sizes) == 1]
            each.append(single[:EACH])
        both = [p for p in itertools.product(*each) if not new or _reads([f.term for f in p], new)]
        out += _couples([_couple(linear, a, b, base) for a, b in both])
    return out


def _couple(linear: Tracked, a: Found, b: Found, base: tuple[float, Thresholds]) -> tuple[Proposal, Proposal]:
    """Return two laws at two places, each with the promise of both together."""
    x = np.concatenate([linear.columns(f.place, linear.along(f.term.values)) for f in (a, b)], axis=1)
    promise, sizes = predicted(linear, x, sum(len(f.term.form.shapes) for f in (a, b)))
    first, second = (
        Proposal(f.place, (f.term,), (float(q),), promise, *base) for f, q in zip((a, b), sizes, strict=True)
    )
    return first, second


def _couples(pairs: Sequence[tuple[Proposal, Proposal]]) -> list[tuple[Proposal, Proposal]]:
    """Return the best COUPLES pairs, at most SHARED of them with the same law."""
    kept, held = list[tuple[Proposal, Proposal]](), Counter[Any]()
    for pair in sorted(pairs, key=lambda p: p[0].cost + p[1].cost - p[0].promise):
        if all(held[p.kind] < SHARED for p in pair):
            kept.append(pair)
            held.update(p.kind for p in pair)
    return kept[:COUPLES]


def linearised(case: Case, parent: Fitted) -> tuple[Rig, list[Place], Tracked]:
    """Return the parts of a hypothesis' plant, the places of laws, and the plant about its recordings.

    Raises SimulationError."""
    drives = case.drives(parent.rough.model)
    rig = case.rig(parent.rough_plant, drives)
    where = places_in(case, rig)
    return rig, where, tracked(case, parent, entered(case, parent, where, TRACKED))


def _singles(
    linear: Tracked, place: Place, first: Sequence[Signal], every: Sequence[Signal], new: AbstractSet[str]
) -> list[Found]:
    """Return the terms at a place, the best KEPT of each form over each signal. `new`: as in `_terms`."""
    still = linear.columns(place, linear.along(lambda run, t: np.ones((len(t), 1))))
    duration = max(float(d.t[-1]) for d in linear.metric.drives)
    sample = max(float(np.median(np.diff(d.t))) for d in linear.metric.drives)
    out = []
    tried = families(first, every, duration, sample)
    others = [s for s in every if s not in first]
    tried += [f for f in families(others, every, duration, sample) if f.form.of in SLIGHT]
    tried = [f for f in tried if not new or _reads((f,), new)]
    if place.part != "flow":  # a capacity remembers nothing, and a reading that does is a slow sensor
        tried = [f for f in tried if not f.form.memory]
    if place.part == "reading":
        tried = [f for f in tried if f.form.name not in PLAIN]
    for part in chunks(tried, lambda f: f.count, CHUNK):
        of_families = zip(*(linear.along(f.values) for f in part), strict=True)
        x = linear.columns(place, [np.concatenate(q, axis=1) for q in of_families])
        ends = np.cumsum([f.count * len(f.form.sizes) for f in part])
        for f, own in zip(part, np.split(x, ends[:-1], axis=1), strict=True):
            out += _best(linear, place, f, own, still if f.signals else np.zeros_like(still))
    return out


def _best(linear: Tracked, place: Place, f: Family, x: np.ndarray, still: np.ndarray) -> list[Found]:
    """Return the KEPT terms of a family that explain most, without those that are nearly constant."""
    n = len(f.form.sizes)
    with np.errstate(all="ignore"):
        square = np.einsum("rk,rk->k", x, x)
        gain = (linear.target @ x) ** 2 / square
        nearly_constant = np.abs(still[:, 0] @ x) > ALIKE * np.sqrt(square) * np.linalg.norm(still)
    if n > 1:
        gain = np.repeat([energy(own, linear.target) for own in np.split(x, f.count, axis=1)], n)
    usable = (np.abs(x).max(axis=0) < HUGE) & (square > 0) & ((n > 1) | ~nearly_constant)
    gain = np.where(usable, gain, -1.0)[::n]
    order = [k for k in np.argsort(-gain, kind="stable")[:KEPT] if gain[k] >= 0]
    return [Found(float(gain[k]), place, f.term(k), x[:, k * n : (k + 1) * n].copy()) for k in order]


def _zoomed(linear: Tracked, chosen: Found) -> Found:
    """Return a term with better values of its shapes, searched on finer and finer grids about them."""
    t = chosen.term
    grid = {q: np.unique(s.scaled(s.values, t.signals[0], t.duration)) for q, s in t.form.shapes.items()}
    for _ in range(ZOOMS if grid else 0):
        grid = {q: _between(v, chosen.term.shapes[q]) for q, v in grid.items()}
        f = Family(t.form, t.signals, combined(grid), t.duration, t.sample)
        x = linear.columns(chosen.place, linear.along(f.values))
        best = _best(linear, chosen.place, f, x, np.zeros((len(x), 1)))[:1]
        chosen = max([chosen, *best], key=lambda b: b.gain)
    return chosen


def _between(values: np.ndarray, v: float) -> np.ndarray:
    """Return FINE values between the two neighbours of the value nearest to v."""
    k = int(np.argmin(np.abs(values - v)))
    return np.linspace(values[max(k - 1, 0)], values[min(k + 1, len(values) - 1)], FINE)


def _varied(pool: Sequence[Found]) -> list[Found]:
    """Return, for each form, signal and place, the term with the best values of its shapes; at most POOL."""
    best: dict[Any, Found] = {}
    for f in pool:
        best.setdefault((f.place, f.kind), f)
    return list(best.values())[:POOL]


def _proposal(
    linear: Tracked, place: Place, law: tuple[Term, ...], x: np.ndarray, base: tuple[float, Thresholds]
) -> Proposal:
    promise, c = predicted(linear, x, sum(len(t.form.shapes) for t in law))
    return Proposal(place, law, tuple(map(float, c)), promise, *base)


def _sums(
    linear: Tracked, place: Place, pool: Sequence[Found], base: tuple[float, Thresholds]
) -> list[Proposal]:
    """Return sums of two and three terms at a place.

    Terms are added one by one to the best term, and to the best pairs. A pair may explain much where each of
    its terms alone does not, because the plant's own parameters imitate it. Terms that do not reverse with
    the signal that drives the flow are unlikely: so the best pairs without them are tried, too."""
    likely = [f for f in pool if f.term.reverses is not False]
    couples = _pairs(linear, pool) + (_pairs(linear, likely) if len(likely) < len(pool) else [])
    pairs = []
    for a, b in couples:
        x = np.concatenate([a.columns, b.columns], axis=1)
        pairs.append((_proposal(linear, place, (a.term, b.term), x, base), x))
    pairs.sort(key=lambda p: -p[0].score)
    starts: list[tuple[tuple[Term, ...], np.ndarray]] = [((f.term,), f.columns) for f in pool[:1]]
    starts += [(p.terms, x) for p, x in pairs[:GROWN]]
    out = [p for p, _ in pairs]
    for law, columns in starts:
        while len(law) < TERMS:
            added = _added(linear, law, columns, pool[:POOL])
            if added is None:
                break
            law, columns = (*law, added.term), np.concatenate([columns, added.columns], axis=1)
            out.append(_proposal(linear, place, law, columns, base))
    return out


def _added(linear: Tracked, law: Sequence[Term], columns: np.ndarray, pool: Sequence[Found]) -> Found | None:
    """Return the term that explains most of the residual of a sum of terms; None if none is independent."""
    q, _ = np.linalg.qr(columns)
    rest = linear.target - q @ (q.T @ linear.target)
    best, most = None, 0.0
    for f in pool:
        own = f.columns - q @ (q.T @ f.columns)
        if f.term in law or np.linalg.norm(own) < 1e-3 * np.linalg.norm(f.columns):
            continue
        c = np.linalg.lstsq(own, rest, rcond=1e-8)[0]
        gain = float(rest @ rest - np.sum((rest - own @ c) ** 2))
        if best is None or gain > most:
            best, most = f, gain
    return best


def _pairs(linear: Tracked, pool: Sequence[Found]) -> list[tuple[Found, Found]]:
    """Return the pairs of terms that explain most together, one for each pair of forms with signals."""
    single = [f for f in pool if f.columns.shape[1] == 1][:PAIRED]
    if len(single) < 2:
        return []
    v = np.concatenate([f.columns for f in single], axis=1)
    v = v / np.linalg.norm(v, axis=0)
    g, c = v.T @ linear.target, np.clip(v.T @ v, -ALIKE, ALIKE)
    joint = (g[:, None] ** 2 + g[None] ** 2 - 2 * c * np.outer(g, g)) / (1 - c**2)
    joint = np.triu(np.where(abs(c) < ALIKE, joint, 0.0), 1)
    out: dict[Any, tuple[Found, Found]] = {}
    for k in np.argsort(-joint, axis=None)[:LIKELY]:
        a, b = (single[i] for i in np.unravel_index(k, joint.shape))
        out.setdefault(frozenset((a.kind, b.kind)), (a, b))
        if len(out) == PAIRS:
            break
    return list(out.values())


def _mixed(proposals: Sequence[Proposal]) -> list[Proposal]:
    """Return laws to refit: the best, the best of one term, one of each signal, then the rest by score.

    Laws of one term come early, because the predicted gain of sums is often too large."""
    single = [p for p in proposals if len(p.terms) == 1]
    signal: dict[Any, Proposal] = {}
    for p in single:
        if len(p.terms[0].signals) == 1:
            signal.setdefault((p.place, p.terms[0].signals), p)
    mixed: dict[Any, Proposal] = {}
    for p in (*proposals[:1], *single[:SINGLE], *list(signal.values())[:SIGNALS], *proposals):
        mixed.setdefault(p.kind, p)
    return list(mixed.values())[:PROPOSALS]
