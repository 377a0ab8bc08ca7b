"""Verdict from posterior, remainder and held-out error: a pure function.

The first row of ROWS whose condition holds decides."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.diagnosis.limits import Thresholds
from thermoctl.diagnosis.verdict import OVERRULED


@dataclass(frozen=True)
class Probabilities:
    """Probability of each hypothesis tried (by its effects), and of each effect.

    `something`: probability that at least one effect or law is there"""

    hypotheses: Mapping[Keys, float]
    effects: Mapping[Key, float]
    something: float


@dataclass(frozen=True)
class Facts:
    """All numbers that a verdict depends on.

    - `something`: probability that at least one effect or law is there
    - `known`: the same; 0 if other data confirmed no effect or law
    - `named`: effects whose own probability is high enough
    - `over_noise`: the largest ratio of a residual to its sensor's noise
    - `worse`: probability that the held-out error is larger with the findings
    - `remains`: the largest probability of a remainder at an output
    - `flow`: probability that a flow is missing which no output shows alone
    - `apart`: the largest ratio of an error on recordings set aside to its sensor's noise; 0 without them"""

    something: float
    known: float
    named: tuple[Key, ...]
    over_noise: float
    worse: float = 0.0
    remains: float = 0.0
    flow: float = 0.0
    apart: float = 0.0


@dataclass(frozen=True)
class Decision:
    """The verdict, the named effects, the alternatives, and the row that decided, with its numbers."""

    verdict: str
    named: tuple[Key, ...]
    alternatives: tuple[tuple[Key, float], ...]
    row: str
    numbers: Mapping[str, float]


def weigh(
    scores: Mapping[Keys, float], physics: Mapping[Keys, Mapping[Key, float]], divisor: float = 1.0
) -> Probabilities:
    """Return the posterior of hypotheses, the likeliest first, and of each effect.

    `scores`: log evidence plus log prior odds, divided by `divisor`. `physics`: probability that each effect
    of a hypothesis is physics and no unnamed misfit."""
    scores = {keys: score / divisor for keys, score in scores.items()}
    total = logsumexp(np.array([*scores.values()]))
    of = {keys: float(np.exp(score - total)) for keys, score in scores.items()}
    order = sorted(of, key=lambda keys: (-of[keys], -scores[keys], sorted(keys)))
    hypotheses = {keys: of[keys] for keys in order}
    effects: dict[Key, float] = {}
    something = 0.0
    for keys, q in hypotheses.items():
        something += q * max(physics[keys].values(), default=0.0)
        for key in keys:
            effects[key] = effects.get(key, 0.0) + q * physics[keys][key]
    return Probabilities(hypotheses, effects, something)


def _only_noise(f: Facts, limits: Thresholds) -> bool:
    """Is the residual about as large as the noise, and neither a remainder nor an unknown flow certain?"""
    return f.over_noise <= limits.clean and max(f.remains, f.flow) < limits.name


ROWS: tuple[tuple[str, Callable[[Facts, Thresholds], bool], str], ...] = (
    (
        "nothing is supported for sure and the residual is the sensors' noise",
        lambda f, q: f.something < q.name and _only_noise(f, q),
        "consistent",
    ),
    ("nothing is supported for sure and a remainder stays", lambda f, q: f.something < q.name, "unexplained"),
    (
        "something is missing, and nothing else confirms an effect or law",
        lambda f, q: f.known < q.name,
        "unexplained",
    ),
    (OVERRULED, lambda f, q: f.worse >= q.name, "unexplained"),
    ("something is supported, but no effect for sure", lambda f, q: not f.named, "ambiguous"),
    (
        "findings are supported and the residual is the sensors' noise",
        lambda f, q: _only_noise(f, q) and f.apart <= q.clean,
        "explained",
    ),
    ("findings are supported and a remainder stays beside them", lambda f, q: True, "partly_explained"),
)


def decide(posterior: Probabilities, facts: Facts, limits: Thresholds) -> Decision:
    """Return the decision by the first row of ROWS whose condition holds."""
    row, verdict = next((text, verdict) for text, holds, verdict in ROWS if holds(facts, limits))
    numbers = {k: v for k, v in vars(facts).items() if k != "named"}
    numbers |= {f"{e} at {w}": posterior.effects[e, w] for e, w in facts.named}
    named = facts.named if verdict in ("explained", "partly_explained") else ()
    return Decision(verdict, named, alternatives(posterior, named, limits), row, numbers)


def alternatives(
    posterior: Probabilities, named: Sequence[Key], limits: Thresholds
) -> tuple[tuple[Key, float], ...]:
    """Return the other effects of the likeliest hypotheses that together reach probability `limits.set`."""
    total, effects = 0.0, set[Key]()
    for keys, p in sorted(posterior.hypotheses.items(), key=lambda item: (-item[1], sorted(item[0]))):
        if total >= limits.set:
            break
        total += p
        effects |= keys
    return tuple(
        sorted(((k, posterior.effects[k]) for k in effects - set(named)), key=lambda x: (-x[1], x[0]))
    )
