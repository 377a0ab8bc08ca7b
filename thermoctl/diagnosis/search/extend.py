"""A plant with a screened effect: the ranges of its parameters in a refit, and where the refit starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.evidence.onsets import TIMES
from thermoctl.diagnosis.hypothesis.effect import EffectParameter
from thermoctl.diagnosis.search.gains import Direction
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation

# Smooth dry friction creeps. A refit may make this creep slower than the screening's by this factor. A
# second refit starts there, because an axis that sticks rests for a long time.
STICKING = 300.0
WEAK = 0.1


def ranges_of(direction: Direction, duration: float) -> dict[str, tuple[float, float]]:
    """Return the ranges of the effect's parameters in a refit: wide about the estimate, in their bounds.

    The time of a jump after the recordings' end has none."""
    ranges = {p.name: _range(direction, p, duration) for p in direction.candidate.effect.parameters}
    return {n: (float(span[0]), float(span[1])) for n, span in ranges.items() if span}


def _range(direction: Direction, p: EffectParameter, duration: float) -> tuple[float, float] | None:
    value = direction.start[p.name]
    kind = direction.candidate.effect.shapes.get(p.shape or "", "")
    if p.shape in TIMES:
        return (0.0, duration) if value <= duration else None
    if p.shape == "phase":
        return value - np.pi, value + np.pi
    if p.shape == "period":
        return 0.75 * value, max(value, min(1.33 * value, direction.shape.get("longest", np.inf)))
    if p.shape == "level":  # the prior must not follow where the screening stood
        return max(p.low, direction.shape["least"]), direction.shape["most"]
    if kind == "delays":
        return 0.0, max(value * 8, 0.05 * duration)
    if p.shape:
        least = STICKING if kind == "creep_speeds" else 30
        return max(p.low, value / least), min(p.high, value * 30)
    floor, ceiling = direction.candidate.bounds(p)
    if np.isfinite(floor) and np.isfinite(ceiling):
        return floor, ceiling
    if p.name == "C" and value > 0:
        return value / 100, value * 100
    reach = 30 * max(abs(value - p.null), 1e-3 * abs(p.null), 1e-12)
    return max(p.low, p.null - reach), min(p.high, p.null + reach)


def weaker(direction: Direction) -> Direction:
    """Return the direction with a refit that starts at the share WEAK of its size."""
    effect, start = direction.candidate.effect, dict(direction.start)
    for p in effect.parameters:
        if p.fades(effect.shapes):
            start[p.name] = p.null + WEAK * (start[p.name] - p.null)
    return dataclasses.replace(direction, start=start)


def sticking(direction: Direction) -> Direction | None:
    """Return the direction with a start at friction that sticks; None for an effect without creep.

    A refit that starts at a faster creep does not find such friction."""
    effect = direction.candidate.effect
    start = {
        p.name: direction.start[p.name] / STICKING
        for p in effect.parameters
        if effect.shapes.get(p.shape or "") == "creep_speeds"
    }
    return dataclasses.replace(direction, start={**direction.start, **start}) if start else None


def extend(base: Plant, direction: Direction, drives: Sequence[Excitation]) -> tuple[Plant, dict[str, str]]:
    """Return the plant with a screened effect at its starting values, and the names of its parameters."""
    duration = max(float(d.t[-1]) for d in drives)
    ranges = ranges_of(direction, duration)
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
