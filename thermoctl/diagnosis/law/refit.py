"""Refit a proposed law in the whole plant, as a hypothesis like any other."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed, fitted
from thermoctl.diagnosis.hypothesis import places as catalogue_places
from thermoctl.diagnosis.hypothesis.candidates import Candidate
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.law.forms import Form, Term, combined, law_effect, library, of_plant, readable
from thermoctl.diagnosis.law.propose import PROPOSALS, Proposal
from thermoctl.diagnosis.law.smooth import law_unit
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import name, num
from thermoctl.plant.language import Parameter, Plant
from thermoctl.plant.simulation.simulate import Excitation

FEWEST_REFITS = 3  # least number of refits, if NUMBERS allows fewer because the plant has many bodies
SIMPLER = 6  # number of further refits, of sums without their least significant term
# Numbers that one run of each refit computes in all, with slopes: about a minute for all refits.
NUMBERS = 3e7
RANGE = 100.0  # bound of a term's size, over its first value


@dataclasses.dataclass(frozen=True)
class PlacedLaw(Placed):
    """A law among the effects of a hypothesis. `rivals`: other laws at its place, and the share of each."""

    proposal: Proposal
    rivals: tuple[tuple[Proposal, Fitted, float], ...] = ()

    @property
    def log_odds(self) -> float:
        """Return its log prior odds."""
        return -self.proposal.cost


def laws_of(f: Fitted) -> list[PlacedLaw]:
    """Return the laws of a hypothesis, the last one first."""
    return [e for e in reversed(f.hypothesis.effects) if isinstance(e, PlacedLaw)]


def refitted_law(
    case: Case, parent: Fitted, p: Proposal, leader: Fitted, more: Sequence[Proposal] = ()
) -> Fitted | None:
    """Refit the parent with a law from its proposed sizes; None where the plant cannot be simulated.

    So is a law that reads what an effect adds and the parent lacks. The refit ends early if it stays far from
    `leader`, the likeliest one so far. `more`: laws at other places that are added, too."""
    plant, effects = parent.rough_plant, parent.hypothesis.effects
    there = {q: dataclasses.replace(v, value=p.start.get(q, v.value)) for q, v in plant.parameters.items()}
    plant = dataclasses.replace(plant, parameters=there)
    known = {*plant.nodes, *plant.inputs, *plant.parameters, *plant.outputs, *case.columns[0], "t"}
    if not known.issuperset(n for q in (p, *more) for n in (*q.place.nodes, *q.reads)):
        return None
    drives: Sequence[Excitation] = case.drives(parent.rough.model)
    try:
        for q in (p, *more):
            c = law_candidate(case.rig(plant, drives), q)
            values, ranges = _start(q)
            plant, before = c.extend(values, ranges), plant
            drives = case.drives_after(plant, before, drives)
            own = {short: long for short, long in c.own_in(plant).items() if short in ranges}
            effects = (*effects, PlacedLaw(dataclasses.replace(c, effect=_bounded(c, ranges)), own, q))
        f = fitted(case, plant, effects, None, leader, parent)
        room = _with_room(f, (p, *more))
        return fitted(case, room, effects, None, leader, parent) if room else f
    except FAILS:
        return None


def _with_room(f: Fitted, laws: Sequence[Proposal]) -> Plant | None:
    """Return the plant with flows that may vanish, where a law takes their place; None if it takes none's.

    The factor of such a flow is held at the lower bound that the plant file states for it."""
    ends = [{p.place.source, p.place.target} for p in laws if p.place.part == "flow"]
    rates = [x.rate for x in f.plant.flows.values() if {x.source, x.target} in ends]
    known, held = f.rough_plant.parameters, dict[str, Parameter]()
    for q in (q for q, side in f.fit.at_bound.items() if side == "low" and q in known):
        low, high = known[q].range or (0.0, 0.0)
        if low > 0 and any(ex.fill(rate, {q: ex.ZERO}) == ex.ZERO for rate in rates):
            held[q] = dataclasses.replace(known[q], range=(0.0, high))
    return dataclasses.replace(f.rough_plant, parameters={**known, **held}) if held else None


def law_candidate(rig: Rig, p: Proposal) -> Candidate:
    """Return a law as an effect at its place."""
    effect = law_effect(p.terms, p.place, law_unit(rig.plant, p.place))
    symbols = {str(of_plant(name(n)).value): name(n) for n in p.reads}
    if p.place.part == "reading":
        read = rig.physics.outputs[p.place.target]
        place = catalogue_places.Place(read.name, {"y": read.sensed or read.value}, output=read.name)
        return Candidate(effect, place, rig, symbols=symbols)
    ends = {"target": p.place.target, **({"source": p.place.source} if p.place.source else {})}
    ends |= {f"other{k}": n for k, (n, _) in enumerate(p.place.shares, 1)}
    return Candidate(effect, catalogue_places.Place(p.place.where, {}, ends), rig, symbols=symbols)


def _bounded(c: Candidate, ranges: Mapping[str, tuple[float, float]]) -> Effect:
    new = tuple(
        dataclasses.replace(q, low=ranges[q.name][0], high=ranges[q.name][1])
        if q.name in ranges and not q.amplitude
        else q
        for q in c.effect.parameters
    )
    return dataclasses.replace(c.effect, parameters=new)


def _start(p: Proposal) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Return the starting values of a refit, and the ranges of its parameters."""
    values: dict[str, float] = {}
    ranges: dict[str, tuple[float, float]] = {}
    sizes = iter(p.sizes)
    for k, t in enumerate(p.terms, 1):
        for q in t.form.sizes:
            values[f"{q}{k}"] = v = next(sizes)
            reach = RANGE * max(abs(v), 1e-300)
            ranges[f"{q}{k}"] = (-reach, reach)
        for q, shape in t.form.shapes.items():
            low, high = shape.scaled(shape.range, next(iter(t.signals), None), t.duration)
            values[f"{q}{k}"], ranges[f"{q}{k}"] = t.shapes[q], (low, high)
    return values, ranges


def settled(law: PlacedLaw, f: Fitted) -> Proposal:
    """Return a refitted law at the values of the refit."""
    p, terms, sizes = law.proposal, list[Term](), list[float]()
    for k, t in enumerate(p.terms, 1):
        values = {q: f.plant.parameters[law.own[f"{q}{k}"]].value for q in (*t.form.sizes, *t.form.shapes)}
        terms.append(dataclasses.replace(t, shapes={q: values[q] for q in t.form.shapes}))
        sizes += [values[q] for q in t.form.sizes]
    return dataclasses.replace(p, terms=tuple(terms), sizes=tuple(sizes))


def limit_of(law: PlacedLaw, f: Fitted) -> Proposal:
    """Return a refitted law of one term; of the form that it becomes, where a shape is at its upper bound."""
    p = settled(law, f)
    (term,), sizes = p.terms, p.sizes
    high = any(f.fit.at_bound.get(law.own[f"{q}1"]) == "high" for q in term.form.shapes)
    if term.form.limit and high:
        term, sizes = _likest(term, sizes, next(x for x in library() if x.name == term.form.limit))
    return dataclasses.replace(p, terms=(term,), sizes=sizes)


def _likest(term: Term, sizes: Sequence[float], form: Form) -> tuple[Term, tuple[float]]:
    """Return the term of another form, with one size, that is nearest where its signal goes."""
    signal = term.signals[0]
    at = {"z": np.array(signal.visited), "w": 1.0}
    own = {**term.shapes, **dict(zip(term.form.sizes, sizes, strict=True))}
    truth = np.asarray(ex.evaluate(term.form.text, {**at, **own}))
    grid = combined({q: s.scaled(s.values, signal, term.duration) for q, s in form.shapes.items()})
    tried = []
    for values in zip(*grid.values(), strict=True) if grid else [()]:
        shapes = dict(zip(grid, map(float, values), strict=True))
        unit = np.asarray(ex.evaluate(form.text, {**at, **shapes, "A": 1.0}))
        size = float(unit @ truth / (unit @ unit))
        tried.append((float(np.sum((size * unit - truth) ** 2)), size, shapes))
    _, size, shapes = min(tried, key=lambda x: x[0])
    return dataclasses.replace(term, form=form, shapes=shapes), (size,)


def apart(law: PlacedLaw, f: Fitted) -> list[float]:
    """Return how far the sizes of each term of a law are from none, in standard deviations; the largest."""
    terms, values = enumerate(law.proposal.terms, 1), f.plant.parameters
    named = [[law.own[f"{q}{k}"] for q in t.form.sizes] for k, t in terms]
    return [max(abs(values[n].value) / max(f.sd.get(n, 0.0), 1e-300) for n in own) for own in named]


def simpler_law(law: PlacedLaw, f: Fitted) -> Proposal:
    """Return a refitted law without its least significant term, at the values of the refit.

    The plant's parameters start there, too."""
    p = settled(law, f)
    sizes = np.split(np.array(p.sizes), np.cumsum([len(t.form.sizes) for t in p.terms])[:-1])
    kept = [k for k in range(len(p.terms)) if k != int(np.argmin(apart(law, f)))]
    left = tuple(float(v) for k in kept for v in sizes[k])
    start = {q: v.value for q, v in f.plant.parameters.items()}
    return dataclasses.replace(p, terms=tuple(p.terms[k] for k in kept), sizes=left, start=start)


def affordable(case: Case, parent: Fitted) -> int:
    """Return the number of refits of laws that NUMBERS allows. It is the same on every machine."""
    rows = sum(len(t) for t in case.tables)
    model = parent.rough.model
    numbers = rows * len(model.states) * (len(model.unknowns) + 1)
    return int(np.clip(NUMBERS / max(numbers, 1), FEWEST_REFITS, 2 * PROPOSALS + SIMPLER))


def law_rate(f: Fitted, law: PlacedLaw) -> ex.Expr:
    """Return the expression of the flow, storage or reading that contains a law of a hypothesis."""
    own, place = set(law.own.values()), law.proposal.place
    if place.part == "reading":
        o = f.plant.outputs[place.target]
        return o.sensed or o.value
    if place.part == "storage":
        return f.plant.nodes[place.target].storage
    if place.part == "parameter":
        terms = [t.expression(k) for k, t in enumerate(law.proposal.terms, 1)]
        names = {short: name(long) for short, long in law.candidate.own_in(f.plant).items()}
        return ex.fill(functools.reduce(ex.add, terms), names)
    return next(x.rate for x in reversed(list(f.plant.flows.values())) if ex.names(x.rate) & own)


def at_bound(f: Fitted) -> bool:
    """Return whether a parameter of a law is at its bound: then a simpler form describes it."""
    own = (e.own.values() for e in f.hypothesis.effects if isinstance(e, PlacedLaw))
    return any(set(names) & f.fit.at_bound.keys() for names in own)


def equation(f: Fitted, law: PlacedLaw, numbers: bool = False) -> str:
    """Return the flow of a law of a hypothesis with its parameters' short names or numbers.

    With numbers, the text of each memory follows."""
    c, text, values = law.candidate, readable(law_rate(f, law)), f.plant.parameters
    terms = enumerate(law.proposal.terms, 1)
    told = "".join(f"; m{k} is {t.memory_text(k)}" for k, t in terms if t.form.memory) if numbers else ""
    for q in c.effect.parameters:
        own = c.own(q.name)
        short = own if q.name in {*f.plant.nodes, *f.plant.inputs} else q.name
        shown = f"{values[own].value:.3g}" if numbers and own in values else short
        shown = f"({shown})" if shown.startswith("-") else shown
        text, told = re.sub(rf"\b{re.escape(own)}\b", shown, text), re.sub(rf"\b{q.name}\b", shown, told)
    return re.sub(rf"\b(m\d)_{re.escape(c.in_plant)}\b", r"\1", text) + told


def plain(f: Fitted, law: PlacedLaw) -> str | None:
    """Return a law without the typical sizes of its signals, as -34 * position; None where forms need them.

    A term that grows as a power of its signal takes them into its coefficient."""
    terms = [_plain(t, k, f, law) for k, t in enumerate(law.proposal.terms, 1)]
    return " + ".join(t for t in terms if t) if all(terms) else None


def _plain(t: Term, k: int, f: Fitted, law: PlacedLaw) -> str | None:
    text, used = t.form.text, ex.names(t.form.text)
    if used - {*t.form.sizes, *t.form.shapes, "z", "w"} or any(s.centre for s in t.signals):
        return None
    own = {q: f.plant.parameters[law.own[f"{q}{k}"]].value for q in (*t.form.sizes, *t.form.shapes)}
    z = np.array([0.5, 1.0, 2.0])
    with np.errstate(all="ignore"):
        once, twice = (np.asarray(ex.evaluate(text, {**own, "z": x, "w": 1.0})) for x in (z, 2 * z))
        power = np.log2(np.divide(twice, once)) * np.ones(3)
    if len(own) > len(t.form.shapes) + 1 or not np.allclose(power, power[0]):
        return None
    scale = np.prod(
        [s.size ** (power[0] if q == "z" else 1.0) for q, s in zip("zw", t.signals, strict=False)]
    )
    numbers = {**own, t.form.sizes[0]: own[t.form.sizes[0]] / scale}
    symbols = {q: num(float(f"{v:.4g}")) for q, v in numbers.items()}
    return readable(ex.fill(text, symbols | {q: s.value for q, s in zip("zw", t.signals, strict=False)}))
