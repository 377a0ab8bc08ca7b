"""Is it the effect, or another law of the same signal at the same place?

An effect states how a term depends on a signal s: a storage on its temperature, a friction on a velocity.
Physics that nobody named may depend on s in any other way, and a single effect then takes part of it. So
every hypothesis that holds some of the findings meets one more with an unknown law beside them,

    term (1 + sum_k w_k h_k(s)),   w normal with sd eta,   eta log-uniform (unknown_flow.py)

h_k: KNOTS straight lines over the range of s. A new flow or reading has its typical size as term. An effect
whose form is right needs small w beside it, and large ones in its place: then the evidence keeps it. One
that is as wrong as it is large gains nothing beside the law, and its own prior odds decide against it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
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
from thermoctl.diagnose.search import Keys, Weighed
from thermoctl.diagnose.unknown_flow import SHARES, Missing, evidence
from thermoctl.diagnose.where import typical_flow
from thermoctl.plant import expression as ex
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
    """A law beside a hypothesis: its log Bayes factor, and where a refit starts.

    `start`: w; `sd`: the likeliest eta; `average`: log of the mean evidence over eta, less that of `sd`"""

    candidate: Candidate
    gain: float
    start: np.ndarray
    sd: float
    average: float
    refitted: bool = False


def weigh_laws(
    case: Case, tried: Mapping[Keys, Weighed], physics: Mapping[Keys, Mapping[Key, float]], limits: Limits
) -> tuple[Posterior, Laws]:
    """Return the posterior with unknown laws, and the scores of the hypotheses that hold one.

    To first order a law may gain what it cannot: before one leads, it is refitted with the plant. At most as
    many as directions of a screening are."""
    scores = {keys: tried[keys].score for keys in physics}
    posterior = weigh(scores, physics, limits)
    if posterior.something < limits.name:
        return posterior, Laws()
    laws, odds_of = _found(case, tried, posterior, physics, limits)

    def score(at: tuple[Keys, Key]) -> float:
        return float(scores[at[0]] + laws[at].gain + odds_of[at[1]])

    for _ in range(limits.shortlist):
        lead = max(laws, key=score, default=None)
        if lead is None or laws[lead].refitted or score(lead) < max(scores.values()):
            break
        laws[lead] = _refitted(case, tried[lead[0]].fitted, laws[lead])
    added = {at: score(at) for at in laws}
    return weigh(scores, physics, limits, added), added


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
        e.key: e
        for keys in likely
        for e in tried[keys].fitted.hypothesis.effects
        if e.key in standouts(physics[keys]) and posterior.effects[e.key] >= least and term_of(e.candidate)
    }
    laws = {}
    for keys in sorted((k for k in physics if effects and any(k <= h for h in likely)), key=sorted):
        try:
            beside = Linearised(case, tried[keys].fitted)
            for key, e in effects.items():
                law = beside.law(e.candidate)
                if law:
                    laws[keys, key] = law
        except (SimulationError, np.linalg.LinAlgError):
            continue
    where = places(case) if effects else {}
    return laws, {key: odds((e,), where, limits) + np.log(limits.rare) for key, e in effects.items()}


def _refitted(case: Case, f: Fitted, law: UnknownLaw) -> UnknownLaw:
    """Return a law with its gain after a refit of the whole plant; minus infinity where that fails."""
    squares = " + ".join(f"W{k}**2" for k in range(KNOTS))
    prior = ex.parse(f"({squares}) / {law.sd**2!r}")
    c = dataclasses.replace(law.candidate, effect=dataclasses.replace(law.candidate.effect, prior=prior))
    names = [p.name for p in c.effect.parameters]
    reach = REACH * law.sd
    try:
        plant = c.extend(
            {n: float(np.clip(v, -reach, reach)) for n, v in zip(names, law.start, strict=True)},
            dict.fromkeys(names, (-reach, reach)),
        )
        placed = Placed(c, {n: c.own(n) for n in names if c.own(n) in plant.parameters})
        found = fitted(case, plant, (*f.hypothesis.effects, placed), None, None, f)
    except (SimulationError, InputError, np.linalg.LinAlgError):
        return dataclasses.replace(law, gain=-np.inf, refitted=True)
    return dataclasses.replace(law, gain=found.log_evidence - f.log_evidence + law.average, refitted=True)


def missing_law(posterior: Posterior, tried: Sequence[Weighed]) -> Missing:
    """Return the probability that an unknown law is there, and where it most likely is."""
    if not posterior.laws:
        return Missing()
    at = max(posterior.laws, key=lambda key: posterior.laws[key])
    c = next(e.candidate for w in tried for e in w.fitted.hypothesis.effects if e.key == at)
    term, flow = term_of(c), c.rig.physics.flows.get(c.place.flow or "")
    assert term is not None  # a law has one
    ends = (*c.place.nodes.values(), *((flow.source, flow.target) if flow else ()))
    return Missing(
        sum(posterior.laws.values()),
        next((n for n in ends if n), None),
        f"something at {at[1]} depends on {term.signal} in a way that no effect explains",
    )


class Linearised:
    """A fitted hypothesis, its whitened rows and its trajectories. Raises SimulationError."""

    def __init__(self, case: Case, f: Fitted):
        f = as_weighed(f)
        self.metric = Rows(Plain(case, f, ROWS), f.average, True)
        self.rig = Structure(f.rough_plant, self.metric.drives, [t.columns for t in case.tables])
        self.at = [Trajectory(self.metric, self.rig, r) for r in range(len(self.metric.drives))]
        _, self.weight = self.metric.weighed(self.metric.residual)

    def law(self, of: Candidate) -> UnknownLaw | None:
        """Return an unknown law in an effect's place; None where it has no signal."""
        term, place = term_of(of), of.place
        if place.output:  # other effects may have changed the reading
            now = self.rig.plant.outputs[place.output].value
            place = dataclasses.replace(place, symbols={**place.symbols, "y": now})
        law = term and _law(dataclasses.replace(of, place=place, rig=self.rig), term, self.at)
        if not law:
            return None
        (group,) = groups_of(law, self.metric)
        rows = [rows for _, rows in directions(self.metric, self.at, group.columns())]
        x = self.metric.project(np.concatenate(rows, axis=1) * self.metric.weight[:, None])
        found = [evidence(self.metric, x * share, self.weight) for share in SHARES]
        scores = np.array([score for score, _ in found])
        k = int(np.argmax(scores))
        gain = float(logsumexp(scores) - np.log(len(SHARES)))
        return UnknownLaw(law, gain, SHARES[k] * found[k][1], float(SHARES[k]), gain - float(scores[k]))


def _law(c: Candidate, term: Term, at: Sequence[Trajectory]) -> Candidate | None:
    """Return an unknown law in the place of an effect, None where its signal does not move."""
    build = Builder(c, {}, {})
    signal = np.concatenate([a.value(build.expression(term.signal), {}) for a in at])
    low, high = float(signal.min()), float(signal.max())
    if not np.isfinite(high - low) or high <= low:
        return None
    width = (high - low) / (KNOTS - 1)
    hats = " + ".join(
        f"W{k} * max(1 - abs({term.signal} - ({low + k * width!r})) / {width!r}, 0)" for k in range(KNOTS)
    )
    if term.kind in OWN:
        what: Any = f"{OWN[term.kind]} * (1 + {hats})"
    else:
        size = _size(c, term, build, at)
        if size <= 0:
            return None
        old = {"value": "y + ", "drive": "u + "}.get(term.kind, "")
        what = f"{old}{size!r} * ({hats})"
    if term.kind == "flow":
        what = {**term.ends, "rate": what}
    parameters = tuple(
        EffectParameter(
            f"W{k}", "1", -np.inf, np.inf, 0.0, ex.name(f"s{k + 1}" if k else "s"), None, False, None, None
        )
        for k in range(KNOTS)
    )
    dims = tuple(map(tuple, np.eye(KNOTS).tolist()))
    law = Effect(
        NAME, "", c.effect.where, c.effect.needs, (({term.kind: what},),), {}, parameters, dims, "", (), ""
    )
    return dataclasses.replace(c, effect=law, variant=0)


def _size(c: Candidate, term: Term, build: Builder, at: Sequence[Trajectory]) -> float:
    """Return the typical size of a reading, a drive, or of the flows at the ends of a new one."""
    if term.kind == "flow":
        ends = [c.place.nodes[e] for e in term.ends.values() if e in c.place.nodes]
        sizes = [typical_flow(c.rig.plant, n, [a.values for a in at]) for n in ends]
        return float(np.exp(np.mean(np.log(sizes)))) if sizes and min(sizes) > 0 else 0.0
    moved = np.concatenate([a.value(build.symbols["y" if term.kind == "value" else "u"], {}) for a in at])
    return float(np.std(moved))
