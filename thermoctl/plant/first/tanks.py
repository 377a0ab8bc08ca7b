"""A first plant of tanks: each level is a tank, the pump fills the first, each runs into the next.

The balance of the volume gives the sizes:

    integral of the inflow = A sum (h - h_0) + k integral of sqrt(h_last)

Without a recorded inflow they give k / A: the first area is held at 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermoctl.plant.first.columns import UNITS, Column, identifiers, noise
from thermoctl.plant.first.thermal import MARGIN, UNKNOWN_SCALE, confirm, held, integral, parameter, unknown
from thermoctl.recording.table import Table


def draft(table: Table, drives: Sequence[Column], sensors: Sequence[Column]) -> list[str]:
    """Return the lines of a first plant file, from flows or a pump's command, and levels."""
    ids = identifiers([c.name for c in (*drives, *sensors)])
    levels = [c.values(table) for c in sensors]
    has_flow = all(d.kind == "flow" and d.unit for d in drives)
    inflow = np.sum([d.values(table) for d in drives], axis=0) if drives else None
    area, outlet = _sizes(table.t, inflow, levels)
    margin = MARGIN * (1.0 if has_flow else UNKNOWN_SCALE)
    lines = [
        *(["inputs:"] if drives else []),
        *(f"  {ids[d.name]}: {{{d.keys(ids[d.name])}}}{confirm(d.doubt)}" for d in drives),
        "parameters:",
    ]
    for d in drives:
        if not (d.kind == "flow" and d.unit):
            own = UNITS[d.kind] if d.unit else "1"
            unit = "m^3/s" if own == "1" else f"m^3/s/{own}"
            what = f"flow for each unit of '{d.name}', measured; levels alone give ratios"
            lines.append(unknown(f"K_{ids[d.name]}", unit, what))
    tanks = [f"tank_{ids[c.name]}" for c in sensors]
    lines += [
        parameter(f"area_{n}", area, "m^2", margin * (1.0 if drives else MARGIN))
        if drives or k
        else held(f"area_{n}", "m^2")
        for k, n in enumerate(tanks)
    ]
    lines += [parameter(f"outlet_{n}", outlet, "m^2.5/s", margin * MARGIN) for n in tanks]
    lines.append("nodes:")
    for c, n, h in zip(sensors, tanks, levels, strict=True):
        spread = max(0.005 * float(np.ptp(h)), 1e-9)
        lines.append(
            f"  {n}: {{unit: m, storage: area_{n}, initial: first({ids[c.name]}), initial_sigma: {spread:.2g}}}"
        )
    lines.append("flows:")
    for d in drives:
        rate = ids[d.name] if d.kind == "flow" and d.unit else f"K_{ids[d.name]} * {ids[d.name]}"
        lines.append(
            f"  fill_{ids[d.name]}: {{into: {tanks[0]}, rate: {rate}, unit: m^3/s}}  # confirm: it fills '{tanks[0]}'"
        )
    for n, below in zip(tanks, [*tanks[1:], ""], strict=True):
        into = f", into: {below}" if below else ""
        to = f"runs into '{below}'; if not, delete 'into'" if below else "runs out"
        lines.append(
            f'  out_of_{n}: {{from: {n}{into}, rate: "outlet_{n} * sqrt(max({n}, 0))", unit: m^3/s}}'
            f"  # confirm: '{n}' {to}"
        )
    lines.append("outputs:")
    for c, n, h in zip(sensors, tanks, levels, strict=True):
        lines.append(
            f"  {ids[c.name]}: {{value: {n}, {c.keys(ids[c.name])}, role: level{noise(h)}}}{confirm(c.doubt)}"
        )
    return lines


def _sizes(t: np.ndarray, inflow: np.ndarray | None, levels: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return a tank's area, m^2, and its outlet's coefficient, m^2.5/s, from the balance of the volume.

    Without an inflow the area is 1."""
    stored = np.sum([h - h[0] for h in levels], axis=0)
    lost = integral(t, np.sqrt(np.maximum(levels[-1], 0.0)))
    if inflow is None:
        return 1.0, max(-float(np.sum(stored * lost) / max(float(np.sum(lost**2)), 1e-12)), 1e-9)
    volume = integral(t, inflow)
    area, outlet = map(float, np.linalg.lstsq(np.column_stack([stored, lost]), volume, rcond=None)[0])
    if not area > 0:
        area = max(float(volume[-1]), 1e-12) / max(float(np.ptp(stored)), 1e-9)
    if not outlet > 0:
        outlet = max(float(volume[-1]), 1e-12) / max(float(lost[-1]), 1e-9)
    return area, outlet
