"""Every entry of the catalogue at every place of a plant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from thermoctl.diagnosis.hypothesis.builder import Candidate as Candidate
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.hypothesis.places import FAULTS, PLACES, Place, askable, displacements
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name

Key = tuple[str, str]  # (effect, where)
Keys = frozenset[Key]  # the effects of a hypothesis
EVENTS = {"onsets", "windows"}  # shapes that happen at one moment
DIFFERS = "free_parameter"  # the place of what differs between recordings
FAR = 5.0  # durations of a recording between it and one that begins before or after an event


def spoken(keys: Iterable[Key]) -> list[str]:
    """Return `effect at place` of each effect, sorted."""
    return [f"{effect} at {where}" for effect, where in sorted(keys)]


def _choices(rig: Rig, effect: Effect, place: Place) -> list[dict[str, Expr]]:
    """Return every choice of the signals that an effect needs beside its place."""
    choices: list[dict[str, Expr]] = [{}]
    for need in effect.needs:
        if need in place.symbols:
            continue
        found = rig.signals(need, place.nodes.get("v"))
        if need == "T" and effect.where == "displacement":
            found = sorted(ex.names(place.symbols["y"]) & set(found)) or found
        if need == "v" and effect.where == "conductance":  # a fluid's flow stirs as a speed does
            found = [*found, *rig.coolants()]
        choices = [{**c, need: name(s)} for c in choices for s in found if s != place.where]
    return choices


def _placed(rig: Rig, effect: Effect) -> Iterator[tuple[Place, Effect]]:
    """Yield the places where an effect can act, each with the entry for it.

    A reading that the plant trusts has no fault. Without an ambient nothing reads it. A position that
    does not grow has no lag of its growth."""
    if effect.in_air and not rig.air:
        return
    for place in PLACES[effect.where](rig):
        here = effect.at(place.exponent)
        trusted = effect.where in FAULTS and rig.plant.trusts(place.where)
        still = effect.where == "displacement" and not effect.needs and place not in displacements(rig)
        if here and askable(rig, place) and not (trusted or still):
            yield place, here


def candidates(rig: Rig, effects: Mapping[str, Effect]) -> list[Candidate]:
    """Return every effect at every place where it can act, with every choice of the signals it needs."""
    out = []
    for effect in effects.values():
        if not set(effect.reads) <= rig.plant.nodes.keys() | rig.plant.inputs.keys():
            continue
        clocks = _clocks(rig, effect)
        for place, here in _placed(rig, effect):
            for variant, changes in enumerate(effect.changes):
                if any("recorded" in c for c in changes) and not place.input:
                    continue
                for k, choice in enumerate(_choices(rig, effect, place)):
                    for which, begins in clocks.items():
                        label = f"{variant}{k}{which}"
                        candidate = Candidate(here, place, rig, variant, choice, label, begins, len(clocks))
                        if not candidate.jumps and any("straight" in c for c in changes):
                            continue  # without a held input it would equal the variant without `straight`
                        out.append(candidate)
    return out


def _clocks(rig: Rig, effect: Effect) -> dict[str, dict[str, float]]:
    """Return when each recording begins on the clock of an event, s, by name of that clock; "" is any other.

    The event is at the same time of each, or at a time of one that it changes alone or with later ones."""
    clocks: dict[str, dict[str, float]] = {"": {}}
    names = [d.name for d in rig.drives]
    in_pieces = any(d.x0 is not None for d in rig.drives)
    if in_pieces or len(names) < 2 or EVENTS.isdisjoint(effect.shapes.values()):
        return clocks
    before, after = -FAR * rig.duration, FAR * rig.duration
    for k, own in enumerate(names):
        past = {n: before if j < k else after for j, n in enumerate([*names, ""])}
        clocks[f" from {own}"] = past | {own: 0.0}
    for own in names[:-1]:
        clocks[f" in {own}"] = dict.fromkeys([*names, ""], before) | {own: 0.0}
    return clocks


def found_again(found: Sequence[Candidate], key: Key, label: str) -> Candidate:
    """Return a candidate by its effect, place and label. Raises StopIteration.

    An event that began in an earlier recording is past in all of these, or lasts in all."""
    choice, _, clock = label.partition(" ")
    same = [c for c in found if (c.key, c.label) == (key, label)]
    if same or not clock:
        return next(iter(same))
    c = next(c for c in found if (c.key, c.label) == (key, choice))
    far = FAR * c.rig.duration * (1 if clock.startswith("from ") else -1)
    return replace(c, label=label, begins=dict.fromkeys([*(d.name for d in c.rig.drives), ""], far))
