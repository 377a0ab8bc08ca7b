"""A first plant of an axis: a mass or inertia with friction, and a spring where the data show one.

Integrating the balance of forces twice needs no derivative of a measured position:

    double integral of F = m (x - x_0 - v_0 t) + b integral of x + k double integral of (x - x_rest)

Least squares over time give m, b and k. With a measured velocity the balance is integrated once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thermoctl.plant.first.columns import UNITS, Column, identifiers, noise
from thermoctl.plant.first.thermal import MARGIN, UNKNOWN_SCALE, confirm, parameter, unknown
from thermoctl.recording.table import Table

SPRING = 0.25  # a spring is written where it lowers the squared error of the balance to this share
DRIVES = ("force", "torque", "current", "voltage", "duty", "power")


def draft(table: Table, drives: Sequence[Column], sensors: Sequence[Column]) -> list[str]:
    """Return the lines of a first plant file of an axis, from its drive and its position or velocity."""
    drive = next(d for d in drives if d.kind in DRIVES)
    place = next((c for c in sensors if c.kind in ("position", "angle")), None)
    speed = next((c for c in sensors if c.kind in ("velocity", "turning")), None)
    turns = (
        any(c is not None and c.kind in ("angle", "turning") for c in (place, speed))
        or drive.kind == "torque"
    )
    ids = identifiers([c.name for c in (drive, *(c for c in (place, speed) if c))])
    force, name = drive.values(table), ids[drive.name]
    mass, damping, stiffness = _sizes(
        table.t, force, place.values(table) if place else None, speed.values(table) if speed else None
    )
    by_force = drive.kind in ("force", "torque")
    margin = MARGIN * (1.0 if by_force else UNKNOWN_SCALE)
    size, unit, unit_x, unit_v = ("inertia", "N*m", "rad", "rad/s") if turns else ("mass", "N", "m", "m/s")
    per = {"rad": "kg*m^2", "m": "kg"}[unit_x]
    drag = "N*m*s" if turns else "N*s/m"
    lines = ["inputs:", f"  {name}: {{{drive.keys(name)}}}{confirm(drive.doubt)}", "parameters:"]
    if not by_force:
        own = UNITS[drive.kind] if drive.unit else "1"
        per_unit = unit if own == "1" else f"{unit}/{own}"
        lines.append(
            unknown(
                "K_drive",
                per_unit,
                f"{unit} for each {own if own != '1' else 'unit'} of '{drive.name}', from its data sheet",
            )
        )
    lines += [parameter(size, mass, per, margin), parameter("damping", damping, drag, margin * MARGIN)]
    if stiffness > 0:
        lines.append(parameter("stiffness", stiffness, "N*m" if turns else "N/m", margin))
        lines.append(
            f"  rest: {{value: 0, unit: {unit_x}}}  # confirm: the position at which the spring is relaxed"
        )
    start = f"first({ids[speed.name]}), initial_sigma: {_spread(speed.values(table))}" if speed else "0"
    if place and not speed:  # a recording may start in motion
        start += f", initial_sigma: {_pace(table.t, place.values(table)):.2g}"
    lines += ["nodes:", f"  speed: {{unit: {unit_v}, storage: {size}, initial: {start}}}"]
    if place:
        x = place.values(table)
        lines.append(
            f"  place: {{unit: {unit_x}, storage: 1, initial: first({ids[place.name]}), initial_sigma: {_spread(x)}}}"
        )
    rate = name if by_force else f"K_drive * {name}"
    lines += [
        "flows:",
        f"  drive: {{into: speed, rate: {rate}, unit: {unit}}}  # confirm: a positive '{drive.name}' moves it forward",
        f"  friction: {{from: speed, rate: damping * speed, unit: {unit}}}",
    ]
    if stiffness > 0:
        lines.append(
            f"  spring: {{from: speed, rate: stiffness * (place - rest), unit: {unit}}}  # confirm: a spring holds it"
        )
    if place:
        lines.append(f"  travel: {{into: place, rate: speed, unit: {unit_v}}}")
    lines.append("outputs:")
    for c, node in ((place, "place"), (speed, "speed")):
        if c:
            lines.append(
                f"  {ids[c.name]}: {{value: {node}, {c.keys(ids[c.name])}{noise(c.values(table))}}}{confirm(c.doubt)}"
            )
    return lines


def _pace(t: np.ndarray, x: np.ndarray) -> float:
    """Return the size of the speed, from the places in a hundred parts of a recording."""
    samples = np.linspace(0, len(t) - 1, min(len(t), 100)).astype(int)
    return max(float(np.std(np.diff(x[samples]) / np.diff(t[samples]))), 1e-12)


def _spread(values: np.ndarray) -> str:
    return f"{max(0.002 * float(np.ptp(values)), 1e-12):.2g}"


def _sizes(
    t: np.ndarray, force: np.ndarray, place: np.ndarray | None, speed: np.ndarray | None
) -> tuple[float, float, float]:
    """Return mass, damping and stiffness for the drive as a force; 0 where there is no spring."""
    dt = np.diff(t)

    def integral(values: np.ndarray) -> np.ndarray:
        """Return the integral over time up to each sample (N,), by trapezoids."""
        return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * dt)])

    held = np.concatenate([[0.0], np.cumsum(force[:-1] * dt)])
    time = t - t[0]
    if speed is not None:
        x = place if place is not None else integral(speed)
        plain, target = [speed - speed[0], integral(speed)], held
        springy = [*plain, integral(x), time]
    else:
        assert place is not None
        plain, target = [place - place[0], integral(place - place[0]), time], integral(held)
        springy = [*plain, integral(integral(place - place[0])), time**2]
    fits = [np.linalg.lstsq(np.column_stack(columns), target, rcond=None) for columns in (plain, springy)]
    errors = [
        float(np.sum((target - np.column_stack(c) @ f[0]) ** 2))
        for c, f in zip((plain, springy), fits, strict=True)
    ]
    stiffness_column = 2 if speed is not None else 3
    spring = float(fits[1][0][stiffness_column])
    with_spring = place is not None and spring > 0 and fits[1][0][0] > 0 and errors[1] < SPRING * errors[0]
    mass, damping = map(float, fits[with_spring][0][:2])
    travel = max(
        float(np.ptp(place if place is not None else integral(speed if speed is not None else force))), 1e-12
    )
    if not mass > 0:  # the data do not give it: use the order of magnitude
        mass = max(float(np.ptp(force)), 1e-9) * float(time[-1]) ** 2 / travel / 100
    if not damping > 0:
        damping = mass / float(time[-1])
    return mass, damping, spring if with_spring else 0.0
