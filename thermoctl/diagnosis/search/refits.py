"""Refits of a hypothesis with screened effects, in parallel.

Also the ranges of an effect's parameters in a refit, and its values there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed, fitted
from thermoctl.diagnosis.evidence.onsets import TIMES
from thermoctl.diagnosis.hypothesis.effect import EffectParameter
from thermoctl.diagnosis.search.gains import Direction
from thermoctl.diagnosis.search.screen import sharpened
from thermoctl.diagnosis.search.screening import Screened
from thermoctl.diagnosis.search.shortlist import Extension
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.cores import each
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation

SHORTEST = 0.1  # shortest lag of a reading of held inputs, in sampling intervals
LATE = 0.75  # the same of an input: half a row is what late rows come to on average
# Smooth dry friction creeps. A refit may make this creep slower than the screening's by this factor: an axis
# that sticks rests for a long time.
STICKING = 300.0
START = 10.0  # factor on the catalogue's standard deviation of an initial state that nobody measured


def refitted(
    case: Case, parent: Fitted, looked: Screened, batch: Sequence[Extension], leader: Fitted
) -> list[Fitted | None]:
    """Refit the parent with each extension of a batch, in parallel; None where a refit fails."""
    starts = [tuple(sharpened(looked.metric, looked.rig, d) for d in added) for added, _ in batch]
    return each(lambda added: _refitted(case, parent, added, looked, leader), starts)


def _refitted(
    case: Case, parent: Fitted, added: Sequence[Direction], looked: Screened, leader: Fitted
) -> Fitted | None:
    effects, plant = parent.hypothesis.effects, parent.rough_plant
    drives: Sequence[Excitation] = looked.metric.drives
    try:
        for d in added:
            rig = case.rig(plant, drives)
            d = dataclasses.replace(d, candidate=dataclasses.replace(d.candidate, rig=rig))
            (plant, own), before = extend(d), plant
            if not own:  # an earlier effect replaced the place it acts on, so that it would change nothing
                return None
            drives = case.drives_after(plant, before, drives)
            effects = (*effects, Placed(d.candidate, own))
        return fitted(case, free_starts(parent.plant, plant), effects, None, leader, parent)
    except FAILS:
        return None


def free_starts(before: Plant, after: Plant) -> Plant:
    """Widen the initial states of bodies that an effect added: nobody measured where they start.

    A node into which nothing flows is none: it holds a reading of the start. Nor is a slow sensor's, which an
    output reads alone: its spread is that of the true value."""
    moving = {end for f in after.flows.values() if f.rate is not ex.ZERO for end in (f.source, f.target)}
    read = [ex.names(o.value) & after.nodes.keys() for o in after.outputs.values()]
    nodes = {
        n.name: n
        if n.name in before.nodes or n.name not in moving or {n.name} in read or not n.initial_sigma
        else dataclasses.replace(n, initial_sigma=START * n.initial_sigma)
        for n in after.nodes.values()
    }
    return dataclasses.replace(after, nodes=nodes)


def ranges_of(direction: Direction) -> dict[str, tuple[float, float]]:
    """Return the ranges of the effect's parameters in a refit: wide about the estimate, in their bounds.

    The time of a jump after the recordings' end has none."""
    ranges = {p.name: _range(direction, p) for p in direction.candidate.effect.parameters}
    return {n: (float(span[0]), float(span[1])) for n, span in ranges.items() if span}


def _range(direction: Direction, p: EffectParameter) -> tuple[float, float] | None:
    c = direction.candidate
    value, duration, kind = direction.start[p.name], c.rig.duration, c.effect.shapes.get(p.shape or "", "")
    if p.shape in TIMES:
        return (0.0, duration) if value <= duration else None
    if p.shape == "phase":
        return value - np.pi, value + np.pi
    if p.shape == "period":
        return 0.75 * value, max(value, min(1.33 * value, direction.shape.get("longest", np.inf)))
    if p.shape == "level":  # the prior must not follow where the screening stood
        return max(p.low, direction.shape["least"]), direction.shape["most"]
    straight = any("straight" in change for change in c.effect.changes[c.variant])
    # a shorter lag only draws a held input straight, or moves an input whose rows are up to one late
    shortest = c.rig.sample * (LATE if c.place.input else SHORTEST if straight else 0.0)
    if kind == "delays":
        return shortest, max(max(shortest, value) * 8, 0.05 * duration)
    if kind == "lags" and shortest:
        return max(shortest, value / 30), max(shortest, value) * 30
    if p.shape:
        least = STICKING if kind == "creep_speeds" else 30
        return max(p.low, value / least), min(p.high, value * 30)
    floor, ceiling = c.bounds(p)
    if np.isfinite(floor) and np.isfinite(ceiling):
        return floor, ceiling
    if p.name == "C" and value > 0:
        return value / 100, value * 100
    reach = 30 * max(abs(value - p.null), 1e-3 * abs(p.null), 1e-12)
    return max(p.low, p.null - reach), min(p.high, p.null + reach)


def extend(direction: Direction) -> tuple[Plant, dict[str, str]]:
    """Return the plant with a screened effect at its starting values, and the names of its parameters."""
    ranges = ranges_of(direction)
    values: dict[str, float] = {}
    for p in direction.candidate.effect.parameters:
        value = direction.start[p.name] if p.typical is None else p.typical
        if p.name in ranges:
            low, high = ranges[p.name]
            inside = 1e-4 * (high - low)
            value = float(np.clip(value, low + inside, high - inside))
        values[p.name] = value
    plant = direction.candidate.extend(values, ranges)
    return plant, direction.candidate.own_in(plant)
