"""The screened directions that are worth a refit, alone or in pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence

import numpy as np

from thermoctl.diagnosis.hypothesis.candidates import EVENTS, Candidate, Key
from thermoctl.diagnosis.hypothesis.places import displacements
from thermoctl.diagnosis.search.gains import PLACES_EACH, Direction, foremost, once
from thermoctl.diagnosis.search.metric import Metric
from thermoctl.diagnosis.search.screening import Screened
from thermoctl.plant import expression as ex

PAIR = 2
HALF = 2.0  # largest gain of a refit that is reckoned with, over its first-order promise
ALIKE = 0.999  # limit of the cosine between two directions, so that their pair can be computed


Extension = tuple[tuple[Direction, ...], float]  # directions to add, and their predicted gain
Price = Callable[[Direction], float]  # log prior odds of a screened effect


def relabels(c: Candidate) -> bool:
    """Return whether the plant or a simpler entry at the same place already contains this physics."""
    if c.effect.where == "bending_pair":
        return any(_free_member(c, side) for side in ("TA", "TB"))
    displaced = displacements(c.rig)
    return (
        c.effect.where != "displacement"
        and "tau" in c.effect.shapes
        and any(p.output == c.place.output for p in displaced)
    )


def _free_member(c: Candidate, side: str) -> bool:
    """Return whether the displacement contains this side's temperature already, with a free coefficient.

    A coefficient of its distance to another temperature is another physics."""
    now, plant = ex.undelayed(c.place.symbols["y"]), c.rig.plant
    side = str(c.place.symbols[side].value)
    free = (
        n for n in ex.names(ex.derivative(now, side)) if n in plant.parameters and plant.parameters[n].range
    )
    moving = {*plant.nodes, *plant.inputs}
    return any(ex.names(ex.derivative(now, n)) & moving == {side} for n in free)


def simpler(added: Sequence[Direction], gain: float, looked: Screened, price: Price) -> list[Extension]:
    """Return the simpler entries at the places of `added`, to try instead of an insignificant effect.

    The entry that an effect contains may gain as much as this one, others what they promise themselves."""
    out: list[Extension] = []
    for d, promise in looked.promised:
        here = [a.candidate.effect for a in added if a.candidate.place.where == d.candidate.place.where]
        if d.gain > 0 and any(d.candidate.effect.name == a.contains for a in here):
            out.append(((d,), gain))
        elif d.gain > 0 and any(len(d.candidate.effect.parameters) < len(a.parameters) for a in here):
            out.append(((d,), promise + price(d)))
    return out


def shortlist(looked: Screened, price: Price, most: int, paired: bool) -> list[Extension]:
    """Return the directions whose predicted gain outweighs their prior odds, then pairs; each with its gain.

    The prior of a size, 2 to 5 nats, is not taken off: first-order promises of limits and lags err by more.
    First are those with the largest predicted gain, the best first. Then come those with the largest gain in
    energy, then pairs. The gain of a proposal by energy is infinite. At most PLACES_EACH places of an effect
    are listed alone. `most`: largest number of each kind. `paired`: with pairs not proposed by energy?"""
    worthwhile = []
    for d, promise in looked.promised:
        gain = promise + price(d)
        if gain > 0 and d.gain > 0 and not relabels(d.candidate):
            worthwhile.append((d, gain))
    worthwhile.sort(key=lambda x: -x[1])
    gains = {d.candidate.key: gain for d, gain in reversed(worthwhile)}
    best = foremost(once(d for d, _ in worthwhile), PLACES_EACH)[:most]
    out: list[Extension] = [
        ((d,), gain) for d in best if HALF * (gain := gains[d.candidate.key]) > worthwhile[0][1]
    ]
    listed = {d.candidate.key for (d,), _ in out}
    out += [((d,), np.inf) for d in largest(looked)[:most] if d.candidate.key not in listed]
    if paired:
        out += pairs(looked.every, looked.metric, price, most)
    if looked.energy:
        out += [(p, np.inf) for p, _ in pairs(looked.by_energy, looked.energy, price, most)]
    return out


def elsewhere(
    leading: Collection[Key], gain: float, looked: Screened, queue: Sequence[Extension]
) -> list[Extension]:
    """Return the one effect that leads at other places, if it promised as much there as where it leads.

    It may gain there as much as it does (`gain`). Empty if several effects lead together."""
    if len(leading) != 1:
        return []
    ((name, where),) = leading
    listed = {d.candidate.key for added, _ in queue for d in added} | {(name, where)}
    least = max((p for d, p in looked.promised if d.candidate.key == (name, where)), default=np.inf)
    others = [d for d, p in looked.promised if d.candidate.key[0] == name and p >= least]
    return [((d,), gain) for d in others if d.candidate.key not in listed and not relabels(d.candidate)]


def largest(looked: Screened) -> list[Direction]:
    """Return the candidates whose gain in energy is at least half of the best one's, the best first."""
    enough = [d for d in looked.by_energy if HALF * d.gain > looked.by_energy[0].gain]
    best = foremost(once(d for d in enough if not relabels(d.candidate)), PLACES_EACH)
    return [dataclasses.replace(d, vector=None) for d in best]


def _constant(c: Candidate) -> bool:
    """Return whether an entry is physics that does not happen at one moment, and new to the plant."""
    return EVENTS.isdisjoint(c.effect.shapes.values()) and not relabels(c)


def pairs(directions: Sequence[Direction], metric: Metric, price: Price, most: int) -> list[Extension]:
    """Return pairs of constant physics, at their joint sizes, that explain far more together than one by one.

    The plant's own parameters may imitate each effect of a pair alone, but not both together. So only their
    joint gain has to outweigh their prior odds."""
    kept = once(d for d in directions if d.vector is not None and d.gain > 0 and _constant(d.candidate))
    if len(kept) < PAIR:
        return []
    v = np.stack([d.vector for d in kept if d.vector is not None]).astype(float)
    g = np.maximum(v @ metric.residual, np.finfo(float).tiny)
    c = np.clip(v @ v.T, -ALIKE, ALIKE)
    # size of the first beside the second, along its unit vector
    first = (g[:, None] - c * g[None]) / (1 - c**2)
    joint = g[:, None] * first + g[None] * first.T
    own = np.array([price(d) for d in kept])
    alone = np.array([d.gain for d in kept])
    extra = np.triu(joint - np.maximum.outer(alone, alone), 1)
    worth = (extra > np.maximum.outer(alone, alone)) & (0.5 * joint + np.add.outer(own, own) > 0)
    out: list[Extension] = []
    for k in np.argsort(np.where(worth, -extra, 0.0), axis=None, kind="stable")[: int(worth.sum())]:
        a, b = np.unravel_index(k, extra.shape)
        pair = (resized(kept[a], first[a, b] / g[a]), resized(kept[b], first[b, a] / g[b]))
        if all(d is not None for d in pair):
            left = metric.residual - first[a, b] * v[a] - first[b, a] * v[b]
            promise = metric.around.rise(metric.powers(left))
            out.append((tuple(d for d in pair if d is not None), float(promise + own[a] + own[b])))
        if len(out) >= most // PAIR:
            break
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
