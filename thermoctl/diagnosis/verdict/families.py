"""Families of effects that imitate each other. It may be sure that one of a family is there, but not which.

Two effects are of one family where a catalogue entry mimics or contains the other, or where they are one
entry at two places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from thermoctl.diagnosis.hypothesis.candidates import Key, Keys
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.verdict.decide import Probabilities

MEMBER = 0.02  # probability from which an effect is a member


@dataclass(frozen=True)
class Family:
    """Members, the likeliest first, and the probability that at least one of them is there."""

    members: tuple[Key, ...]
    probability: float


def families(
    posterior: Probabilities,
    physics: Mapping[Keys, Mapping[Key, float]],
    named: Sequence[Key],
    entries: Mapping[str, Effect],
    asked: Mapping[Key, float],
    name: float,
) -> tuple[Family, ...]:
    """Return the families of which one effect is there with probability `name` or more.

    A family is all effects that are related to its likeliest member: two or more. None of them is `named`, or
    related to an effect that is named at the same place. `physics`: probability that an effect of a
    hypothesis is no misfit. `asked`: for the effects that were tested, the probability that they predict
    data that they were not fitted to."""
    likely = sorted(
        (k for k, p in posterior.effects.items() if p >= MEMBER), key=lambda k: (-posterior.effects[k], k)
    )
    open_ = [k for k in likely if k not in named]
    certain: list[Family] = []
    while open_:
        members = tuple(k for k in open_ if k == open_[0] or related(k, open_[0], entries))
        open_ = [k for k in open_ if k not in members]
        first = members[0]
        if len(members) < 2 or any(k[1] == first[1] and related(k, first, entries) for k in named):
            continue
        p = sum(
            q * max((physics[keys][k] for k in members if k in keys), default=0.0)
            for keys, q in posterior.hypotheses.items()
        )
        p = min(p, max((asked[k] for k in members if k in asked), default=1.0))
        if p >= name:
            certain.append(Family(members, p))
    return tuple(certain)


def related(a: Key, b: Key, entries: Mapping[str, Effect]) -> bool:
    """Return whether two placed effects are of one family."""
    one, other = entries.get(a[0]), entries.get(b[0])
    if one is None or other is None:  # a law
        return False
    return a[0] == b[0] or b[0] in (*one.mimics, one.contains) or a[0] in (*other.mimics, other.contains)
