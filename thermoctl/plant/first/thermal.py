"""A first plant of a thermal rig: every thermometer becomes a body.

Heat balances the sum of all bodies,

    integral of heat dt = C sum (T - T_start) + G sum integral of (T - T_air) dt,

whose least squares give the size of a body's heat capacity C and of its conductance G to the air. Without a
recorded heat they give G / C and the temperature of the air: one C is held at 1. Everything else is a guess
with a comment in the file: which body is heated, and which bodies touch.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.integrate import cumulative_trapezoid

from thermoctl.plant.first.columns import Column, identifiers, noise, words
from thermoctl.recording.table import Table

MARGIN = 5.0  # the ranges of a first guess reach from value / MARGIN to value * MARGIN
UNKNOWN_SCALE = 200.0  # factor by which the ranges are wider if the user has to write the scale of the heat
ABSENT = 1e-5  # lower end of a link's conductance over the guess, nearly 0, because the link may not exist
FEW_BODIES = 3  # with more bodies only neighbours get a link, not every pair
FULL = {1.0: "", 100.0: " / 100", 255.0: " / 255"}  # ends of a duty's scale, and what divides it


@dataclass(frozen=True)
class _Heat:
    """The heat of one column: `rate` in W, its parameter's line, and `size` (N,) with that parameter at 1."""

    column: Column
    rate: str
    parameter: str
    size: np.ndarray
    known: bool


def draft(table: Table, drives: Sequence[Column], air: Column | None, sensors: Sequence[Column]) -> list[str]:
    """Return the lines of a first plant file, from heating inputs, the air's temperature and sensors."""
    inputs = [*drives, *([air] if air else [])]
    ids = identifiers([c.name for c in (*inputs, *sensors)])
    readings = {ids[c.name]: c.values(table) for c in sensors}
    heats = [_heat(table, c, ids, drives) for c in drives]
    heats = [h for h in heats if h.rate]
    if air:
        around = air.values(table)
    else:
        first = min(v[0] for v in readings.values()) if heats else _end(table.t, list(readings.values()))
        around = np.full(len(table), first)
    column_of = {c.name: ids[c.name] for c in sensors}
    heated = [_heated(table.t, h, readings, column_of) for h in heats]
    sizes = _sizes_of_bodies(table.t, heats, heated, readings, around)
    margin = MARGIN * (1.0 if all(h.known for h in heats) else UNKNOWN_SCALE)
    bodies = {s: _body(s, set(ids.values())) for s in readings}
    ambient = ids[air.name] if air else "T_ambient"
    names, links = list(bodies.values()), _links(list(bodies.values()))
    lines = ["inputs:"] if inputs else []
    lines += [f"  {ids[c.name]}: {{{c.keys(ids[c.name])}}}{confirm(c.doubt)}" for c in drives]
    if air:
        lines.append(
            f"  {ambient}: {{{air.keys(ambient)}, between_samples: linear, role: ambient}}{confirm(air.doubt)}"
        )
    lines.append("parameters:")
    lines += [h.parameter for h in heats if h.parameter]
    if not air:
        least, most = (float(f(list(readings.values()))) for f in (np.min, np.max))
        span = f", range: [{2 * least - most:.4g}, {2 * most - least:.4g}]" if not heats else ""
        lines.append(
            f"  T_ambient: {{value: {around[0]:.4g}, unit: degC{span}}}  # confirm: temperature of the air"
        )
    for sensor, body in bodies.items():
        capacity, conductance = sizes[sensor]
        free = not heats and body == names[0]
        lines += [
            held(f"C_{body}", "J/K")
            if free
            else parameter(f"C_{body}", capacity, "J/K", margin * (1.0 if heats else MARGIN)),
            parameter(f"G_{body}", conductance, "W/K", margin, ABSENT),
        ]
    typical = float(np.mean([g for _, g in sizes.values()]))
    lines += [parameter(f"G_{a}_{b}", typical, "W/K", margin * MARGIN, ABSENT) for a, b in links]
    lines.append("nodes:")
    for sensor, body in bodies.items():
        lines.append(
            f"  {body}: {{unit: degC, storage: C_{body}, initial: first({sensor}), initial_sigma: 0.5}}"
        )
    lines.append("flows:")
    for h, sensor in zip(heats, heated, strict=True):
        body = bodies[sensor]
        lines.append(
            f"  heat_{ids[h.column.name]}: {{into: {body}, rate: {h.rate}, unit: W}}  # confirm: it heats '{body}'"
        )
    for a, b in links:
        lines.append(
            f"  {a}_to_{b}: {{from: {a}, into: {b}, rate: G_{a}_{b} * ({a} - {b}), unit: W}}"
            f"  # confirm: '{a}' and '{b}' touch; if not, delete this line and G_{a}_{b}"
        )
    for body in names:
        lines.append(f"  {body}_to_air: {{from: {body}, rate: G_{body} * ({body} - {ambient}), unit: W}}")
    lines.append("outputs:")
    for c in sensors:
        name = ids[c.name]
        lines.append(
            f"  {name}: {{value: {bodies[name]}, {c.keys(ids[c.name])}{noise(readings[name])}}}{confirm(c.doubt)}"
        )
    return lines


def confirm(doubt: str) -> str:
    """Return a comment that asks to confirm, or nothing."""
    return f"  # confirm: {doubt}" if doubt else ""


def parameter(name: str, value: float, unit: str, margin: float = MARGIN, least: float = 0.0) -> str:
    """Return a parameter's line with its range; `least`: its lower end as a share of the value, if not 0."""
    low, high = value * (least or 1 / margin), value * margin
    return f"  {name}: {{value: {value:.3g}, unit: {unit}, range: [{low:.3g}, {high:.3g}]}}"


def held(name: str, unit: str) -> str:
    """Return the line of a parameter that is 1, because nothing recorded drives the plant."""
    return f"  {name}: {{value: 1, unit: {unit}}}  # confirm: held at 1; a free run gives only ratios to it"


def unknown(name: str, unit: str, what: str) -> str:
    """Return the line of a parameter that the recording cannot give: its value is a question mark."""
    return f'  {name}: {{value: "?", unit: {unit}}}  # confirm: {what}; write it for the question mark'


def _heat(table: Table, c: Column, ids: Mapping[str, str], drives: Sequence[Column]) -> _Heat:
    values, name = c.values(table), ids[c.name]
    several = sum(d.kind == c.kind for d in drives) > 1
    own = f"_{name}" if several else ""
    currents = [d for d in drives if d.kind == "current"]
    if c.kind == "current":
        voltage = next((d for d in drives if d.kind == "voltage"), None)
        size = values**2
        if voltage is not None and not several:
            u = voltage.values(table)
            r = float(np.sum(u * values) / max(float(np.sum(size)), 1e-12))
            line = f"  R: {{value: {r:.3g}, unit: ohm}}  # confirm: '{voltage.name}' over '{c.name}'; of a motor, at rest"
            return _Heat(c, f"R * {name}**2", line, r * size, True)
        line = unknown(
            f"R{own}", "ohm", f"resistance that '{c.name}' heats, measured; temperatures alone give ratios"
        )
        return _Heat(c, f"R{own} * {name}**2", line, size, False)
    if c.kind == "voltage":
        if len(currents) == 1 and not several:
            return _Heat(c, "", "", values, True)  # the power of the heater is that of its current
        line = unknown(f"R{own}", "ohm", f"resistance that '{c.name}' heats, measured")
        return _Heat(c, f"{name}**2 / R{own}", line, values**2, False)
    if c.kind == "duty":
        full = next((f for f in FULL if values.max() <= f * 1.001), 100.0) if c.unit in ("", "1") else 1.0
        line = unknown(
            f"P_full{own}",
            "W",
            f"power of '{c.name}' at {full:g}" if full != 1 else f"power of '{c.name}' when full on",
        )
        return _Heat(c, f"P_full{own} * {name}{FULL[full]}", line, values / full, False)
    if not c.unit:
        span = f"from {values.min():.3g} to {values.max():.3g}"
        line = (
            f"  W_{name}: {{value: 1, unit: W}}  # confirm: watts for each unit of '{c.name}', which has no unit and runs "
            f"{span} (1: it is in W)"
        )
        return _Heat(c, f"W_{name} * {name}", line, values, False)
    return _Heat(c, name, "", values, True)


def _sizes_of_bodies(
    t: np.ndarray,
    heats: Sequence[_Heat],
    heated: Sequence[str],
    readings: Mapping[str, np.ndarray],
    air: np.ndarray,
) -> dict[str, tuple[float, float]]:
    """Return capacity and conductance by sensor: of all bodies together, or of one with a heat of its own."""
    every = _sizes(t, [h.size for h in heats], list(readings.values()), air)
    sizes = dict.fromkeys(readings, every)
    if len(set(heated)) > 1:
        for sensor in set(heated):
            own = [h.size for h, s in zip(heats, heated, strict=True) if s == sensor]
            sizes[sensor] = _sizes(t, own, [readings[sensor]], air)
    return sizes


def _sizes(
    t: np.ndarray, heats: Sequence[np.ndarray], sensors: Sequence[np.ndarray], air: np.ndarray
) -> tuple[float, float]:
    """Return a body's heat capacity, J/K, and conductance to the air, W/K, from the heat balance.

    Without heats the capacity is 1."""
    stored = np.sum([v - v[0] for v in sensors], axis=0)
    lost = np.sum([integral(t, v - air) for v in sensors], axis=0)
    span = float(t[-1] - t[0])
    if not heats:
        conductance = -float(np.sum(stored * lost) / max(float(np.sum(lost**2)), 1e-12))
        return 1.0, conductance if conductance > 0 else 1 / span
    energy = integral(t, np.sum(heats, axis=0))
    capacity, conductance = np.linalg.lstsq(np.column_stack([stored, lost]), energy, rcond=None)[0]
    if not capacity > 0:
        capacity = max(abs(energy[-1]) / max(float(np.ptp(stored)), 1e-9), 1e-9)
    if not conductance > 0:
        conductance = capacity / span
    return float(capacity), float(conductance)


def integral(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the integral over time up to each sample (N,); each value holds until the next sample."""
    return np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(t))])


def _end(t: np.ndarray, sensors: Sequence[np.ndarray]) -> float:
    """Return the temperature to which unheated bodies go: by an exponential, else their last mean."""
    mean = np.mean(sensors, axis=0)
    time = t - t[0]
    area = cumulative_trapezoid(mean, t, initial=0)
    rate, pull = np.linalg.lstsq(np.column_stack([-area, time]), mean - mean[0], rcond=None)[0]
    end, reach = float(pull / rate) if rate > 0 else np.nan, float(np.ptp(mean))
    return end if mean.min() - reach <= end <= mean.max() + reach else float(mean[-1])


def _heated(t: np.ndarray, heat: _Heat, sensors: Mapping[str, np.ndarray], ids: Mapping[str, str]) -> str:
    """Return the sensor whose name shares most words with the heat's, else the one that correlates best.

    `ids`: name in the plant by column."""
    own = set(words(heat.column.name))
    shared = {name: len(own & set(words(column))) for column, name in ids.items()}
    first = max(shared.values())
    if first and list(shared.values()).count(first) == 1:
        return max(shared, key=lambda name: shared[name])
    power, steps = heat.size, max(len(t) // 200, 1)

    def rise(values: np.ndarray) -> float:
        """Return the covariance of a temperature's rate and the power, K W/s."""
        rate = np.diff(values[::steps]) / np.diff(t[::steps])
        drive = power[::steps][: len(rate)]
        return float(np.mean((rate - rate.mean()) * (drive - drive.mean())))

    return max(sensors, key=lambda c: rise(sensors[c]))


def _links(bodies: list[str]) -> list[tuple[str, str]]:
    pairs = list(combinations(bodies, 2))
    return pairs if len(bodies) <= FEW_BODIES else list(zip(bodies, bodies[1:], strict=False))


def _body(sensor: str, taken: set[str]) -> str:
    """Return a body's name from its sensor's: T_block is in 'block'."""
    bare = re.sub(r"^(T|temp|temperature)_+|_+(T|C|degC|temp|temperature)$", "", sensor, flags=re.IGNORECASE)
    return (
        bare if bare and bare != sensor and not bare[0].isdigit() and bare not in taken else f"body_{sensor}"
    )
