"""Is it the effect, or another law of the same signal at the same place?

An effect states how a term depends on a signal s: a storage on its temperature, a friction on a velocity.
Physics that nobody named may depend on s in any other way, and a single effect then takes part of it. So
every hypothesis that holds some of the findings meets one more with an unknown law beside them,

    term (1 + sum_k w_k h_k(s)),   w normal with sd eta,   eta log-uniform (unknown_flow.py)

h_k: KNOTS straight lines over the range of s. A new flow or reading has its typical size as term. An effect
whose form is right needs small w beside it, and large ones in its place: then the evidence keeps it. One
that is as wrong as it is large gains nothing beside the law, and its own prior odds decide against it.

Its form may be right, and its size no constant: friction in one zone of the travel. So there are further laws
in its place. The effect's fitted size follows the position there, or another signal s2 of its form.

    size sum_k w_k h_k(s2).

All laws in the place of an effect share its prior odds. None follows the time. In a run that decays by itself
it tells as much as any speed or temperature does, and right names were lost."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from thermoctl.diagnose.builder import Builder
from thermoctl.diagnose.candidates import Candidate
from thermoctl.diagnose.case import Case
from thermoctl.diagnose.catalogue import OWN, Effect, EffectParameter
from thermoctl.diagnose.decide import Key, Laws, Posterior, weigh
from thermoctl.diagnose.fit import Fitted, Placed, as_weighed, fitted
from thermoctl.diagnose.limits import Limits
from thermoctl.diagnose.misfit import standouts
from thermoctl.diagnose.odds import odds
from thermoctl.diagnose.overlay import Trajectory
from thermoctl.diagnose.roles import Structure
from thermoctl.diagnose.screen import directions, groups_of
from thermoctl.diagnose.screening import ROWS, Plain, Rows, places
from thermoctl.diagnose.search import BEATEN, Keys, Weighed
from thermoctl.diagnose.unknown_flow import SHARES, Missing, evidence
from thermoctl.diagnose.where import typical_flow
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.simulate import SimulationError
from thermoctl.yamlfile import InputError

NAME = "unknown_law"
KNOTS = 8  # of a law
REACH = 10.0  # standard deviations that w may be off in a refit

# The signal that the symbols of a form tell; the first that has all of them.
SIGNALS = (
    ("TA - TB", "TA", "TB"),
    ("T - air", "T", "air"),
    *((s, s) for s in ("T", "v", "x", "i", "u", "air", "y")),
)


@dataclass(frozen=True)
class Term:
    """The term of the plant that an effect changes: kind of the change, ends of a flow, form and signal."""

    kind: str
    ends: Mapping[str, str]
    signal: str


def term_of(c: Candidate) -> Term | None:
    """Return the term that an effect changes; None for an effect of time, of memory, or of no signal."""
    *before, last = c.effect.changes[c.variant]
    ((kind, what),) = last.items()
    if kind == "exponent":
        return Term("rate", {}, str(c.rig.physics.flows[c.place.flow or ""].source))
    moving = any("flow" in item and str(item["flow"]["rate"]) != "0" for item in before)
    moving |= kind == "flow" and bool(before)
    if c.effect.timed or moving or kind not in ("flow", "rate", "value", "storage", "drive", "resistance"):
        return None
    form = ex.parse(str(what["rate"] if kind == "flow" else what))
    if any(e.op == "delay" for e in ex.walk(form)):
        return None
    read = ex.names(form)
    signal = next((text for text, *needed in SIGNALS if read.issuperset(needed)), None)
    ends = {k: what[k] for k in ("from", "into") if k in what} if kind == "flow" else {}
    return Term(kind, ends, signal) if signal else None


@dataclass(frozen=True)
class UnknownLaw:
    """A law beside a hypothesis: the signal that it follows, its log Bayes factor, and where a refit starts.

    `start`: w; `sd`: the likeliest eta; `average`: log of the mean evidence over eta, less that of `sd`"""

    candidate: Candidate
    signal: str
    gain: float
    start: np.ndarray
    sd: float
    average: float
    refitted: bool = False


def weigh_laws(
    case: Case, tried: Mapping[Keys, Weighed], physics: Mapping[Keys, Mapping[Key, float]], limits: Limits
) -> tuple[Posterior, Laws, dict[Key, str]]:
    """Return the posterior with unknown laws, and the scores of the hypotheses that hold one.

    Also the signal that the likeliest law in the place of each effect follows.

    To first order a law may gain more than it can, or less where it is large. So where one leads, it, those
    near it, and the same one without its effect are refitted. At most as many as a screening's directions."""
    scores = {keys: tried[keys].score for keys in physics}
    posterior = weigh(scores, physics, limits)
    if posterior.something < limits.name:
        return posterior, Laws(), {}
    laws, odds_of = _found(case, tried, posterior, physics, limits)

    def score(at: tuple[Keys, Key]) -> float:
        """Return the log evidence with a law, prior odds included."""
        return float(scores[at[0]] + laws[at].gain + odds_of[at[1]])

    for _ in range(limits.shortlist):
        lead = max(laws, key=score, default=None)
        if lead is None or score(lead) < max(scores.values()):
            break
        alone = lead[0] - {lead[1]}, lead[1]
        near = [
            at
            for at, law in laws.items()
            if not law.refitted and (at == alone or score(at) >= score(lead) - BEATEN)
        ]
        if not near:
            break
        at = max(near, key=score)
        laws[at] = _refitted(case, tried[at[0]].fitted, laws[at])
    added = {at: score(at) for at in laws}
    signal = {at[1]: laws[at].signal for at in sorted(laws, key=score)}
    return weigh(scores, physics, limits, added), added, signal


def _found(
    case: Case,
    tried: Mapping[Keys, Weighed],
    posterior: Posterior,
    physics: Mapping[Keys, Mapping[Key, float]],
    limits: Limits,
) -> tuple[dict[tuple[Keys, Key], UnknownLaw], dict[Key, float]]:
    """Return the laws in the places of effects, and their log prior odds by effect.

    All likely hypotheses meet them, and those of `physics` that hold a part of their effects. A law that only
    one met would favour that one. Where more than `beam` are likely, only effects that would be named give a
    place. The prior odds of a law are those of the effect, and `rare`: nobody knows it."""
    total = np.cumsum([0.0, *posterior.hypotheses.values()])
    likely = [keys for keys, p in zip(posterior.hypotheses, total, strict=False) if p < limits.set]
    least = limits.name if len(likely) > limits.beam else 0.0
    effects = {
        e.key: (e, tried[keys].fitted.plant)
        for keys in reversed(likely)  # the likeliest is last, and stays
        for e in tried[keys].fitted.hypothesis.effects
        if e.key in standouts(physics[keys]) and posterior.effects[e.key] >= least and term_of(e.candidate)
    }
    laws = {}
    for keys in sorted((k for k in physics if effects and any(k <= h for h in likely)), key=sorted):
        try:
            beside = Linearised(case, tried[keys].fitted)
            for key, e in effects.items():
                law = beside.law(*e)
                if law:
                    laws[keys, key] = law
        except (SimulationError, np.linalg.LinAlgError):
            continue
    where = places(case) if effects else {}
    return laws, {key: odds((e,), where, limits) + np.log(limits.rare) for key, (e, _) in effects.items()}


def _refitted(case: Case, f: Fitted, law: UnknownLaw) -> UnknownLaw:
    """Return a law with its gain after a refit of the whole plant; minus infinity where that fails."""
    squares = " + ".join(f"{p.name}**2" for p in law.candidate.effect.parameters)
    prior = ex.parse(f"({squares}) / {law.sd**2!r}")
    c = dataclasses.replace(law.candidate, effect=dataclasses.replace(law.candidate.effect, prior=prior))
    names = [p.name for p in c.effect.parameters]
    reach = REACH * law.sd
    start = np.clip(law.start, -reach, reach).tolist()
    try:
        plant = c.extend(dict(zip(names, start, strict=True)), dict.fromkeys(names, (-reach, reach)))
        placed = Placed(c, {n: c.own(n) for n in names if c.own(n) in plant.parameters})
        found = fitted(case, plant, (*f.hypothesis.effects, placed), None, None, f)
    except (SimulationError, InputError, np.linalg.LinAlgError):
        return dataclasses.replace(law, gain=-np.inf, refitted=True)
    return dataclasses.replace(law, gain=found.log_evidence - f.log_evidence + law.average, refitted=True)


def missing_law(posterior: Posterior, tried: Sequence[Weighed], signals: Mapping[Key, str]) -> Missing:
    """Return the probability that an unknown law is there, and where it most likely is.

    `signals`: those that laws follow, by the effect in whose place they are."""
    if not posterior.laws:
        return Missing()
    at = max(posterior.laws, key=lambda key: posterior.laws[key])
    c = next(e.candidate for w in tried for e in w.fitted.hypothesis.effects if e.key == at)
    flow = c.rig.physics.flows.get(c.place.flow or "")
    ends = (*c.place.nodes.values(), *((flow.source, flow.target) if flow else ()))
    return Missing(
        sum(posterior.laws.values()),
        next((n for n in ends if n), None),
        f"something at {at[1]} depends on {signals[at]} in a way that no effect explains",
    )


class Linearised:
    """A fitted hypothesis, its whitened rows and its trajectories. Raises SimulationError."""

    def __init__(self, case: Case, f: Fitted):
        f = as_weighed(f)
        self.metric = Rows(Plain(case, f, ROWS), f.average, True)
        self.rig = Structure(f.rough_plant, self.metric.drives, [t.columns for t in case.tables])
        self.at = [Trajectory(self.metric, self.rig, r) for r in range(len(self.metric.drives))]
        _, self.weight = self.metric.weighed(self.metric.residual)

    def law(self, of: Placed, plant: Plant) -> UnknownLaw | None:
        """Return the unknown law with the largest gain in the place of an effect, as it is in `plant`.

        None where the effect has no signal."""
        c, place = of.candidate, of.candidate.place
        term = term_of(c)
        if place.output:  # other effects may have changed the reading
            now = self.rig.plant.outputs[place.output].value
            place = dataclasses.replace(place, symbols={**place.symbols, "y": now})
        if term is None:
            return None
        here = dataclasses.replace(c, place=place, rig=self.rig)
        sizes = {n: plant.parameters[q].value for n, q in of.own.items()}
        found = [
            self._weighed(law, signal)
            for signal, law in [
                (term.signal, _law(here, term, self.at)),
                *((s, _varied(x, sizes, s, self.at)) for s, x in _others(here, term)),
            ]
            if law
        ]
        if not found:
            return None
        best = max(found, key=lambda law: law.gain)
        return dataclasses.replace(
            best, gain=best.gain - np.log(len(found)), average=best.average - np.log(len(found))
        )

    def _weighed(self, law: Candidate, signal: str) -> UnknownLaw:
        (group,) = groups_of(law, self.metric)
        rows = np.concatenate([rows for _, rows in directions(self.metric, self.at, group.columns())], axis=1)
        x = self.metric.project(rows * self.metric.weight[:, None])
        found = [evidence(self.metric, x * share, self.weight) for share in SHARES]
        scores = np.array([score for score, _ in found])
        k = int(np.argmax(scores))
        gain = float(logsumexp(scores) - np.log(len(SHARES)))
        average = gain - float(scores[k])
        return UnknownLaw(law, signal, gain, SHARES[k] * found[k][1], float(SHARES[k]), average)


def _law(c: Candidate, term: Term, at: Sequence[Trajectory]) -> Candidate | None:
    """Return an unknown law in the place of an effect, None where its signal does not move."""
    hats = _hats(c, term.signal, at)
    if hats is None:
        return None
    law = _sum(hats)
    if term.kind in OWN:
        what: Any = f"{OWN[term.kind]} * (1 + {law})"
    else:
        size = _size(c, term, Builder(c, {}, {}), at)
        if size <= 0:
            return None
        old = {"value": "y + ", "drive": "u + "}.get(term.kind, "")
        what = f"{old}{size!r} * ({law})"
    if term.kind == "flow":
        what = {**term.ends, "rate": what}
    return _replaced(c, ({term.kind: what},), KNOTS)


def _varied(
    c: Candidate, sizes: Mapping[str, float], signal: str, at: Sequence[Trajectory]
) -> Candidate | None:
    """Return a law by which the `sizes` of an effect follow a signal, None where it does not move."""
    hats = _hats(c, signal, at)
    known, count = {}, 0
    for p in c.effect.parameters:
        v = sizes.get(p.name, p.null)
        known[p.name] = repr(v)
        if hats and p.amplitude and v != p.null:
            known[p.name] = f"({p.null!r} + {v - p.null!r} * ({_sum(hats, count)}))"
            count += KNOTS
    if not count:
        return None
    pattern = re.compile(rf"\b({'|'.join(known)})\b")

    def told(what: Any) -> Any:
        """Return a change with the sizes' laws in the place of their names."""
        if isinstance(what, Mapping):
            return {k: told(v) for k, v in what.items()}
        return pattern.sub(lambda m: known[m[1]], what) if isinstance(what, str) else what

    return _replaced(c, tuple(map(told, c.effect.changes[c.variant])), count)


def _others(c: Candidate, term: Term) -> Iterator[tuple[str, Candidate]]:
    """Yield further signals that the size of an effect may follow, and the effect that knows them."""
    if term.kind == "rate" and "exponent" in c.effect.changes[c.variant][-1]:
        return  # it has no size
    read = set().union(*(ex.names(ex.parse(text)) for text in _texts(c.effect.changes[c.variant])))
    for text, *needed in SIGNALS:
        if text != term.signal and read.issuperset(needed):
            yield text, c
    v = c.place.nodes.get("v")
    if v in c.rig.position_of and "x" not in read:
        x = ex.name(c.rig.position_of[v])
        yield "x", dataclasses.replace(c, symbols={**c.symbols, "x": x})


def _texts(changes: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the forms of changes."""
    for change in changes:
        for kind, what in change.items():
            if isinstance(what, Mapping):
                yield str(what.get("rate", "0"))
            elif kind != "straight":
                yield str(what)


def _hats(c: Candidate, signal: str, at: Sequence[Trajectory]) -> list[str] | None:
    """Return the straight lines over the range of a signal, None where it does not move."""
    values = np.concatenate([a.value(Builder(c, {}, {}).expression(signal), {}) for a in at])
    low, high = float(values.min()), float(values.max())
    if not np.isfinite(high - low) or high <= low:
        return None
    width = (high - low) / (KNOTS - 1)
    return [f"max(1 - abs({signal} - ({low + k * width!r})) / {width!r}, 0)" for k in range(KNOTS)]


def _sum(hats: Sequence[str], first: int = 0) -> str:
    return " + ".join(f"W{first + k} * {hat}" for k, hat in enumerate(hats))


def _replaced(c: Candidate, change: tuple[Mapping[str, Any], ...], count: int) -> Candidate:
    """Return the candidate with another change, whose parameters are `count` amplitudes W0, W1, ..."""
    trials = (ex.name(f"s{k + 1}" if k else "s") for k in range(count))
    parameters = tuple(
        EffectParameter(f"W{k}", "1", -np.inf, np.inf, 0.0, trial, None, False, None, None)
        for k, trial in enumerate(trials)
    )
    dims = tuple(map(tuple, np.eye(count).tolist()))
    law = Effect(NAME, "", c.effect.where, c.effect.needs, (change,), {}, parameters, dims, "", (), "")
    return dataclasses.replace(c, effect=law, variant=0)


def _size(c: Candidate, term: Term, build: Builder, at: Sequence[Trajectory]) -> float:
    """Return the typical size of a reading, a drive, or of the flows at the ends of a new one."""
    if term.kind == "flow":
        ends = [c.place.nodes[e] for e in term.ends.values() if e in c.place.nodes]
        sizes = [typical_flow(c.rig.plant, n, [a.values for a in at]) for n in ends]
        return float(np.exp(np.mean(np.log(sizes)))) if sizes and min(sizes) > 0 else 0.0
    moved = np.concatenate([a.value(build.symbols["y" if term.kind == "value" else "u"], {}) for a in at])
    return float(np.std(moved))
