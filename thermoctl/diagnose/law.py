"""The law of a remainder: proposed by sparse regression, refitted in the whole plant, weighed by evidence.

1. `law_smooth` tracks the recordings with unknown flows and linearises the plant about this trajectory.
2. Each place and signal is scored with a free function of the signal (straight lines between quantiles).
3. Where that score is high, the library's forms are tried, alone and in sums of up to three terms.
4. The best are refitted as a hypothesis like any other: same noise, remainder and evidence. The prior odds of
   a law fall with the number of places, signals and forms that it was chosen from.
5. A law counts where it stands out of the misfit that stays and reduces the error on data that did not
   choose it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.diagnose import places as catalogue_places
from thermoctl.diagnose.candidates import Candidate
from thermoctl.diagnose.case import Case
from thermoctl.diagnose.fit import Fitted, Placed, as_refitted, fitted
from thermoctl.diagnose.held_out import Worth, worth
from thermoctl.diagnose.law_forms import (
    Place,
    Signal,
    Term,
    law_effect,
    library,
    places,
    readable,
    signals,
    terms,
)
from thermoctl.diagnose.law_smooth import Tracked, flow_unit, tracked
from thermoctl.diagnose.limits import Limits
from thermoctl.diagnose.misfit import energies, physics
from thermoctl.diagnose.roles import Structure
from thermoctl.diagnose.search import Searched, Weighed
from thermoctl.diagnose.shortlist import ALIKE, HALF
from thermoctl.diagnose.unknown import located, reached
from thermoctl.plant import expression as ex
from thermoctl.plant.residuals import HUGE
from thermoctl.plant.simulate import SimulationError
from thermoctl.recording.table import Table
from thermoctl.yamlfile import InputError

PIECES = 8  # of a free function of a signal
TRACKED = 20  # nodes with an unknown flow, those that explain the residual best: 24 knots each
NODES = 4  # of a plant, at which a free flow in time explains most
SECOND = 10  # signals of a place that may be the second one of a form
COMBINATIONS = 12  # places and signals whose forms are tried
POOL = 60  # terms that a sum of terms is built from
REFITS, FEWEST_REFITS = 12, 3  # the best proposals; of a plant of many bodies fewer, see NUMBERS
SIMPLER = 6  # further refits, of sums of terms without their least significant one
NUMBERS = 3e7  # that one run of each refit computes, with slopes: so that all refits take less than a minute
TERMS = 3
CHUNK = 256  # terms whose responses are computed at a time
SEEN = 0.01  # of the strongest direction of a free function: weaker ones are not drawn
RANGE = 100.0  # times its first size that the size of a term may reach


@dataclass(frozen=True)
class Proposal:
    """Terms at a place, their sizes and the gain in log likelihood that the linearised plant promises."""

    place: Place
    terms: tuple[Term, ...]
    sizes: tuple[float, ...]
    promise: float
    look: float  # log of the number of places, signals and forms that a term was chosen from

    @property
    def cost(self) -> float:
        """Log of the number of laws that it was chosen from; a second signal is chosen once more."""
        return self.look * sum(max(len(t.signals), 1) for t in self.terms) + float(np.log(2)) * self.shapes

    @property
    def shapes(self) -> int:
        """Number of parameters beside the sizes."""
        return sum(len(t.form.shapes) for t in self.terms)

    @property
    def score(self) -> float:
        """Promised gain less the cost of the description."""
        return self.promise - self.cost


@dataclass(frozen=True)
class Curve:
    """The remainder's flow over a signal without any form, its sd, and the law, at visited points."""

    signal: Signal
    at: np.ndarray
    flow: np.ndarray
    sd: np.ndarray
    law: np.ndarray


@dataclass(frozen=True)
class Law:
    """A law that was refitted.

    - `gain`: log posterior odds against the hypothesis without it
    - `physics`: probability that it is no shape of the misfit that stays
    - `closed`: share of the misfit's energy that it closes on the data of `worth`
    - `rivals`: other laws, with their probability among all laws"""

    proposal: Proposal
    fitted: Fitted
    gain: float
    physics: float
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
    def rate(self) -> ex.Expr:
        """Return the law's flow."""
        return law_rate(self.fitted)


def simpler_law(p: Proposal, f: Fitted) -> Proposal:
    """Return a refitted law without its least significant term, at the values of the refit."""
    c, values = f.hypothesis.effects[-1].candidate, f.plant.parameters

    def value(q: str) -> float:
        return values[c.own(q)].value

    sizes = [[value(f"{q}{k}") for q in t.form.sizes] for k, t in enumerate(p.terms, 1)]
    significant = [
        max(abs(value(f"{q}{k}")) / max(f.sd.get(c.own(f"{q}{k}"), 0.0), 1e-300) for q in t.form.sizes)
        for k, t in enumerate(p.terms, 1)
    ]
    kept = [k for k in range(len(p.terms)) if k != int(np.argmin(significant))]
    terms = tuple(
        dataclasses.replace(p.terms[k], shapes={q: value(f"{q}{k + 1}") for q in p.terms[k].form.shapes})
        for k in kept
    )
    return dataclasses.replace(p, terms=terms, sizes=tuple(v for k in kept for v in sizes[k]))


def law_rate(f: Fitted) -> ex.Expr:
    """Return the flow of the law that a hypothesis holds as its last effect."""
    own = set(f.hypothesis.effects[-1].own.values())
    return next(x.rate for x in reversed(list(f.plant.flows.values())) if ex.names(x.rate) & own)


def at_bound(f: Fitted) -> bool:
    """Return whether a parameter of the law is at its bound: the form degenerates to a simpler one."""
    return bool(set(f.hypothesis.effects[-1].own.values()) & f.fit.at_bound.keys())


def find_law(
    case: Case,
    parent: Fitted,
    limits: Limits,
    reserve: Sequence[Table],
    say: Callable[[str], None] = lambda text: None,
) -> Law | None:
    """Propose and prove a law for what `parent` leaves. None where no law is supported."""
    say("looking for a law of the remainder")
    try:
        proposals, at = propose_laws(case, parent)
    except (SimulationError, np.linalg.LinAlgError):
        return None
    tried: list[tuple[Proposal, Fitted]] = []
    queue, more = list(proposals), SIMPLER
    gain, leader, left = 0.0, parent, affordable(case, parent)
    for k, p in enumerate(queue):
        if not left or case.budget.stopped() or p.cost + gain > HALF * p.promise:
            continue
        left -= 1
        say(f"looking for a law of the remainder: refit {k + 1}")
        f = refitted_law(case, parent, p, at, leader)
        if f is None:
            continue
        gain = max(gain, f.log_evidence - p.cost - parent.log_evidence)
        leader = max(leader, f, key=lambda x: x.log_likelihood)
        if not f.absent and not at_bound(f):
            tried.append((p, f))
        if len(p.terms) > 1 and more and (f.doubtful or at_bound(f)):
            queue.append(simpler_law(p, f))
            more -= 1
    if not tried:
        return None
    gains = np.array([f.log_evidence - p.cost - parent.log_evidence for p, f in tried])
    share = np.exp((gains - gains.max()) / limits.temperature)
    share /= share.sum()
    best = int(np.argmax(gains))
    p, f = tried[best]
    sure = _physics(case, parent, f, p, limits)
    odds = float(np.clip(gains[best] / limits.temperature, -500, 500))
    probability = sure / (1 + np.exp(-odds))
    value = worth(case, parent, f, reserve)
    shut = closed(value, {o.name: case.noise[j].sigma for j, o in enumerate(case.plant.outputs.values())})
    if probability < limits.name or shut <= 0:
        return None
    rivals = tuple(
        (q, g, float(s))
        for k, ((q, g), s) in enumerate(zip(tried, share, strict=True))
        if k != best and s > 1 - limits.set
    )
    curve = _curve(at, p, f)
    return Law(
        p,
        f,
        float(gains[best]),
        sure,
        float(probability),
        value,
        shut,
        curve,
        rivals,
        flow_unit(case.plant, p.place.target),
    )


def affordable(case: Case, parent: Fitted) -> int:
    """Return how many laws may be refitted: a count of the work, the same on every machine."""
    rows = sum(len(t) for t in case.tables)
    model = parent.rough.model
    numbers = rows * len(model.states) * (len(model.unknowns) + 1)
    return int(np.clip(NUMBERS / max(numbers, 1), FEWEST_REFITS, REFITS + SIMPLER))


def closed(value: Worth, noise: Mapping[str, float]) -> float:
    """Return the share of the misfit's energy beyond the noise that a law closes."""

    def energy(rms: Mapping[str, float]) -> float:
        return sum(max((r / noise[o]) ** 2 - 1, 0.0) for o, r in rms.items())

    before, after = energy(value.refit_only), energy(value.after)
    return 1 - after / before if before > 0 and np.isfinite(after) else 0.0


def _physics(case: Case, parent: Fitted, law: Fitted, p: Proposal, limits: Limits) -> float:
    """Return the probability that a law is no shape of the misfit.

    The misfit had as many chances as there were laws to choose from."""
    searched = Searched((Weighed(law, 0.0), Weighed(parent, 0.0)), False)
    energy = energies(case, searched, limits)
    mine, rival = energy[law.hypothesis.keys], energy[parent.hypothesis.keys]
    dims = sum(len(t.form.sizes) + len(t.form.shapes) for t in p.terms)
    sure = physics(rival.all - mine.all, mine.misfit, 1 - (1 - limits.alike) ** dims)
    return 1 / (1 + (1 - sure) / max(sure, 1e-300) * np.exp(p.cost))


# ------------------------------------------------------------------------------------------------- proposals


def propose_laws(case: Case, parent: Fitted) -> tuple[list[Proposal], Tracked]:
    """Return the most promising laws, best first, and the linearised plant. Raises SimulationError."""
    drives = case.drives(parent.rough.model)
    rig = Structure(parent.rough_plant, drives, [t.columns for t in case.tables])
    where = places(rig)
    nodes = [p.target for p in where if p.source is None]
    if len(nodes) > TRACKED:
        nodes = located(case, as_refitted(case, parent), reached(case))[:TRACKED]
    at = tracked(case, parent, nodes)
    likely = sorted(at.explained, key=lambda n: -at.explained[n])[:NODES]
    combos = [(p, s) for p in where if {*p.nodes} & {*likely} for s in signals(rig, p, at.runs)]
    free = [(_free(at, p, s), p, s) for p, s in combos]
    free.sort(key=lambda x: -x[0])
    chosen = free[:COMBINATIONS]
    pool: list[tuple[float, Place, Term, np.ndarray]] = []
    for place in dict.fromkeys(p for _, p, _ in chosen):
        found = [s for _, p, s in chosen if p == place]
        every = [s for _, p, s in free if p == place][:SECOND]
        pool += _singles(at, place, found, every)
    pool.sort(key=lambda x: -x[0])
    base = float(np.log(max(len(combos), 1)) + np.log(len(library())))
    out = [_proposal(at, p, (t,), x, base) for _, p, t, x in _varied(pool)]
    for place in dict.fromkeys(p for _, p, _, _ in pool):
        out += _sums(at, place, [x for x in pool if x[1] == place][:POOL], base)
    out.sort(key=lambda p: -p.score)
    return _distinct(out)[:REFITS], at


def _free(at: Tracked, place: Place, s: Signal) -> float:
    """Return the promised gain of a free function of a signal.

    Each piece costs half a log of the rows."""
    values = [_along(s, run, d.t) for run, d in zip(at.runs, at.metric.drives, strict=True)]
    knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, PIECES)))
    x = at.columns(place, [_pieces(v, knots) for v in values])
    return _promise(at, x)[0] - 0.5 * len(knots) * float(np.log(len(at.target)))


def _along(s: Signal, run: Mapping[str, np.ndarray | float], t: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.asarray(ex.evaluate(s.value, run), float), t.shape)


def _pieces(v: np.ndarray, knots: np.ndarray) -> np.ndarray:
    if len(knots) < 2:
        return np.ones((len(v), 1))
    return np.stack([np.interp(v, knots, row) for row in np.eye(len(knots))], axis=1)


def _promise(at: Tracked, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the gain in log likelihood of these columns at their best sizes, and the sizes."""
    scale = np.linalg.norm(x, axis=0)
    scale[scale == 0] = 1.0
    c = np.linalg.lstsq(x / scale, at.target, rcond=1e-8)[0] / scale
    return at.metric.log_likelihood(at.target - x @ c) - at.now, c


def _singles(
    at: Tracked, place: Place, found: Sequence[Signal], every: Sequence[Signal]
) -> list[tuple[float, Place, Term, np.ndarray]]:
    """Return every term at a place: (gain in energy, place, term, its columns)."""
    tried = [t for t in terms(every, at.duration) if not t.signals or t.signals[0] in found]
    still = at.columns(place, [np.ones((len(d.t), 1)) for d in at.metric.drives])
    out = []
    for k in range(0, len(tried), CHUNK):
        part = tried[k : k + CHUNK]
        flows = [
            np.concatenate([t.values(run, d.t) for t in part], axis=1)
            for run, d in zip(at.runs, at.metric.drives, strict=True)
        ]
        x = at.columns(place, flows)
        column = 0
        for t in part:
            n = len(t.form.sizes)
            own = x[:, column : column + n]
            column += n
            if np.all(np.abs(own) < HUGE) and np.any(own) and (not t.signals or not _alike(own, still)):
                c = np.linalg.lstsq(own, at.target, rcond=1e-10)[0]
                gain = float(at.target @ at.target - np.sum((at.target - own @ c) ** 2))
                out.append((gain, place, t, own))
    return out


def _alike(x: np.ndarray, y: np.ndarray) -> bool:
    """Return whether single columns (rows, 1) point the same way."""
    a, b = x / np.abs(x).max(), y / max(np.abs(y).max(), 1e-300)
    return x.shape[1] == 1 and abs(float(a[:, 0] @ b[:, 0])) > ALIKE * float(
        np.linalg.norm(a) * np.linalg.norm(b)
    )


def _varied(
    pool: Sequence[tuple[float, Place, Term, np.ndarray]],
) -> list[tuple[float, Place, Term, np.ndarray]]:
    """Return the best value of the shapes of each form over each signal at each place, at most POOL."""
    best: dict[Any, tuple[float, Place, Term, np.ndarray]] = {}
    for entry in pool:
        best.setdefault((entry[1], entry[2].form.name, entry[2].signals), entry)
    return list(best.values())[:POOL]


def _proposal(at: Tracked, place: Place, law: tuple[Term, ...], x: np.ndarray, base: float) -> Proposal:
    promise, c = _promise(at, x)
    p = Proposal(place, law, tuple(map(float, c)), promise, base)
    dims = len(c) + p.shapes
    return dataclasses.replace(p, promise=promise - 0.5 * dims * float(np.log(len(at.target))))


def _sums(
    at: Tracked, place: Place, pool: Sequence[tuple[float, Place, Term, np.ndarray]], base: float
) -> list[Proposal]:
    """Return sums of two and three terms, grown from the best term by what each other one adds."""
    if not pool:
        return []
    out: list[Proposal] = []
    law: tuple[Term, ...] = (pool[0][2],)
    columns = pool[0][3]
    for _ in range(TERMS - 1):
        q, _ = np.linalg.qr(columns)
        rest = at.target - q @ (q.T @ at.target)
        added = []
        for _, _, t, x in pool:
            own = x - q @ (q.T @ x)
            if t in law or np.linalg.norm(own) < 1e-3 * np.linalg.norm(x):
                continue
            c = np.linalg.lstsq(own, rest, rcond=1e-8)[0]
            added.append((float(rest @ rest - np.sum((rest - own @ c) ** 2)), t, x))
        if not added:
            break
        _, t, x = max(added, key=lambda a: a[0])
        law, columns = (*law, t), np.concatenate([columns, x], axis=1)
        out.append(_proposal(at, place, law, columns, base))
    return out


def _distinct(found: Sequence[Proposal]) -> list[Proposal]:
    """Return proposals whose forms, signals or places differ."""
    out: dict[Any, Proposal] = {}
    for p in found:
        out.setdefault((p.place, frozenset((t.form.name, t.signals) for t in p.terms)), p)
    return list(out.values())


def _curve(at: Tracked, p: Proposal, f: Fitted) -> Curve | None:
    """Return the flow at the law's place as a free function of its first signal, and the law there.

    None for a law with a memory. The free function is the law plus a fit of its residual."""
    found = [s for t in p.terms for s in t.signals]
    if not found or any(t.form.memory for t in p.terms):
        return None
    s, rate = found[0], law_rate(f)
    known = {q: v.value for q, v in f.plant.parameters.items()}
    values = [_along(s, run, d.t) for run, d in zip(at.runs, at.metric.drives, strict=True)]
    flows = [
        np.broadcast_to(np.asarray(ex.evaluate(rate, {**run, **known}), float), d.t.shape)
        for run, d in zip(at.runs, at.metric.drives, strict=True)
    ]
    knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, PIECES + 4)))
    pieces = [_pieces(v, knots) for v in values]
    whole = np.concatenate(pieces)
    line = np.linalg.lstsq(whole, np.concatenate(flows), rcond=None)[0]
    rest = at.target - at.columns(p.place, [q[:, None] for q in flows])[:, 0]
    u, w, v = np.linalg.svd(at.columns(p.place, pieces), full_matrices=False)
    seen = w > SEEN * w[0]  # the rest is the plant's own
    noise = max(float(np.mean(rest**2)), 1.0)
    extra = v[seen].T @ ((u.T @ rest)[seen] / w[seen])
    sd = np.sqrt(noise * ((v[seen].T / w[seen]) ** 2).sum(axis=1))
    return Curve(s, knots, line + extra, sd, line)


# --------------------------------------------------------------------------------------------------- refits


def law_candidate(case: Case, rig: Structure, p: Proposal) -> Candidate:
    """Return a law as an effect at its place."""
    effect = law_effect(p.terms, p.place, flow_unit(case.plant, p.place.target))
    ends = {"target": p.place.target, **({"source": p.place.source} if p.place.source else {})}
    return Candidate(effect, catalogue_places.Place(p.place.where, {}, ends), rig)


def refitted_law(case: Case, parent: Fitted, p: Proposal, at: Tracked, leader: Fitted) -> Fitted | None:
    """Refit the parent with a law from its proposed sizes; None where the plant cannot be simulated.

    The refit ends early if it stays far from `leader`, the likeliest one so far."""
    rig = Structure(parent.rough_plant, case.drives(parent.rough.model), [t.columns for t in case.tables])
    c = law_candidate(case, rig, p)
    values, ranges = _start(p, at.duration)
    free = {q: v for q, v in ranges.items()}
    plant = c.extend({**{e.name: e.null for e in c.effect.parameters}, **values}, free)
    own = {q: c.own(q) for q in free if c.own(q) in plant.parameters}
    c = dataclasses.replace(c, effect=_bounded(c, free))
    try:
        return fitted(
            case, plant, (*parent.hypothesis.effects, Placed(c, own)), None, leader, parent.rough.cost
        )
    except (SimulationError, InputError, np.linalg.LinAlgError, ex.ExpressionError):
        return None


def _bounded(c: Candidate, ranges: Mapping[str, tuple[float, float]]) -> Any:
    new = tuple(
        dataclasses.replace(q, low=ranges[q.name][0], high=ranges[q.name][1])
        if q.name in ranges and not q.amplitude
        else q
        for q in c.effect.parameters
    )
    return dataclasses.replace(c.effect, parameters=new)


def _start(p: Proposal, duration: float) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Return the values that a refit starts from, and the ranges of what it moves."""
    values: dict[str, float] = {}
    ranges: dict[str, tuple[float, float]] = {}
    sizes = iter(p.sizes)
    for k, t in enumerate(p.terms, 1):
        for q in t.form.sizes:
            v = next(sizes)
            values[f"{q}{k}"] = v
            reach = RANGE * max(abs(v), 1e-300)
            ranges[f"{q}{k}"] = (-reach, reach)
        for q, shape in t.form.shapes.items():
            scale = duration if shape.of == "duration" else 1.0
            values[f"{q}{k}"] = t.shapes[q]
            ranges[f"{q}{k}"] = (shape.range[0] * scale, shape.range[1] * scale)
    return values, ranges


def equation(rate: ex.Expr, f: Fitted) -> str:
    """Return a law's flow with short names of its parameters."""
    c, text = f.hypothesis.effects[-1].candidate, readable(rate)
    for q in c.effect.parameters:
        text = re.sub(rf"\b{re.escape(c.own(q.name))}\b", q.name, text)
    return text
