"""A first plant of an axis: a mass or inertia with friction, and a spring where the data show one.

Integrating the balance of forces twice needs no derivative of a measured position:

    double integral of F = m (x - x_0 - v_0 t) + b integral of x + k double integral of (x - x_rest)

Least squares over time give m, b and k. With a measured velocity the balance is integrated once. A free
motion gives only b / m and k / m: the mass is held at 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from thermoctl.plant.first.columns import UNITS, Column, identifiers, noise
from thermoctl.plant.first.thermal import MARGIN, UNKNOWN_SCALE, confirm, held, parameter, unknown
from thermoctl.recording.table import Table

TURNED = (
    1.2  # friction alone never turns a free motion: its path is at most so many times the way from end to end
)
SPRING = 0.25  # a spring is written where it lowers the squared error of the balance to this share
OWN = (  # names that the plant file itself gives
    "speed", "place", "mass", "inertia", "damping", "stiffness", "rest", "K_drive", "drive", "friction", "spring", "travel",
)  # fmt: skip
DRIVES = ("force", "torque", "current", "voltage", "duty", "power")


def draft(table: Table, drives: Sequence[Column], sensors: Sequence[Column]) -> list[str]:
    """Return the lines of a first plant file of an axis from its readings, and its drive if any."""
    drive = next((d for d in drives if d.kind in DRIVES), None)
    place = next((c for c in sensors if c.kind in ("position", "angle")), None)
    speed = next((c for c in sensors if c.kind in ("velocity", "turning")), None)
    moving = [c for c in (drive, place, speed) if c]
    turns = any(c.kind in ("angle", "turning", "torque") for c in moving)
    ids = identifiers([c.name for c in moving], OWN)
    force, x, v = (c.values(table) if c else None for c in (drive, place, speed))
    sizes = _free(table.t, x, v) if force is None else _Sizes(*_sizes(table.t, force, x, v))
    by_force = drive is None or drive.kind in ("force", "torque")
    margin = MARGIN * (1.0 if by_force else UNKNOWN_SCALE)
    size, unit, unit_x, unit_v = ("inertia", "N*m", "rad", "rad/s") if turns else ("mass", "N", "m", "m/s")
    per = {"rad": "kg*m^2", "m": "kg"}[unit_x]
    drag = "N*m*s" if turns else "N*s/m"
    lines = []
    if drive:
        name = ids[drive.name]
        lines += ["inputs:", f"  {name}: {{{drive.keys(name)}}}{confirm(drive.doubt)}"]
    lines.append("parameters:")
    if drive and not by_force:
        own = UNITS[drive.kind] if drive.unit else "1"
        per_unit = unit if own == "1" else f"{unit}/{own}"
        each = own if own != "1" else "unit"
        lines.append(
            unknown("K_drive", per_unit, f"{unit} for each {each} of '{drive.name}', from its data sheet")
        )
    lines.append(parameter(size, sizes.mass, per, margin) if drive else held(size, per))
    lines.append(parameter("damping", sizes.damping, drag, margin * MARGIN))
    if sizes.stiffness > 0:
        low, high = sizes.rest - sizes.reach, sizes.rest + sizes.reach
        span = f", range: [{low:.3g}, {high:.3g}]" if sizes.reach else ""
        lines.append(parameter("stiffness", sizes.stiffness, "N*m" if turns else "N/m", margin))
        lines.append(
            f"  rest: {{value: {sizes.rest:.3g}, unit: {unit_x}{span}}}"
            f"  # confirm: the {'position' if place else 'way from the start'} at which the spring is relaxed"
        )
    start = f"first({ids[speed.name]}), initial_sigma: {_spread(v)}" if speed and v is not None else "0"
    if x is not None and not speed:  # a recording may start in motion
        start += f", initial_sigma: {_pace(table.t, x):.2g}"
    lines += ["nodes:", f"  speed: {{unit: {unit_v}, storage: {size}, initial: {start}}}"]
    if place or sizes.stiffness > 0:
        start = f"first({ids[place.name]}), initial_sigma: {_spread(x)}" if place and x is not None else "0"
        lines.append(f"  place: {{unit: {unit_x}, storage: 1, initial: {start}}}")
    lines.append("flows:")
    if drive:
        rate = name if by_force else f"K_drive * {name}"
        lines.append(
            f"  drive: {{into: speed, rate: {rate}, unit: {unit}}}  # confirm: a positive '{drive.name}' moves it forward"
        )
    lines.append(f"  friction: {{from: speed, rate: damping * speed, unit: {unit}}}")
    if sizes.stiffness > 0:
        lines.append(
            f"  spring: {{from: speed, rate: stiffness * (place - rest), unit: {unit}}}  # confirm: a spring holds it"
        )
    if place or sizes.stiffness > 0:
        lines.append(f"  travel: {{into: place, rate: speed, unit: {unit_v}}}")
    lines.append("outputs:")
    return lines + [
        f"  {ids[c.name]}: {{value: {node}, {c.keys(ids[c.name])}{noise(c.values(table))}}}{confirm(c.doubt)}"
        for c, node in ((place, "place"), (speed, "speed"))
        if c
    ]


def _pace(t: np.ndarray, x: np.ndarray) -> float:
    """Return the rms speed, from the places in a hundred parts of a recording."""
    samples = np.linspace(0, len(t) - 1, min(len(t), 100)).astype(int)
    return max(float(np.mean((np.diff(x[samples]) / np.diff(t[samples])) ** 2) ** 0.5), 1e-12)


def _spread(values: np.ndarray) -> str:
    return f"{max(0.002 * float(np.ptp(values)), 1e-12):.2g}"


class _Sizes(NamedTuple):
    """Mass, damping, stiffness (0: no spring), position of rest, and its range (0: known)."""

    mass: float
    damping: float
    stiffness: float
    rest: float = 0.0
    reach: float = 0.0


def _free(t: np.ndarray, place: np.ndarray | None, speed: np.ndarray | None) -> _Sizes:
    """Return the sizes of a free motion for a mass of 1.

    Only a spring turns it back. Then its frequency is that of the largest spectral line; the logarithmic
    decrement from the first half to the second gives the damping. Else least squares give the damping."""
    time, integral = t - t[0], partial(cumulative_trapezoid, x=t, initial=0)
    seen = place if place is not None else speed
    assert seen is not None
    x = seen if place is not None else integral(seen)
    if np.ptp(x) > TURNED * abs(x[-1] - x[0]):
        n = len(t)
        wave = np.interp(np.linspace(0, time[-1], n), time, seen - seen.mean())
        power = np.abs(np.fft.rfft(wave, 8 * n))
        pulsation = 2 * np.pi * max(int(np.argmax(power)), 1) / (8 * time[-1] * n / (n - 1))
        fall = float(np.log(np.std(wave[: n // 2]) / max(float(np.std(wave[n // 2 :])), 1e-12)))
        damping = 4 * fall / float(time[-1]) if fall > 0 else 1 / float(time[-1])
        return _Sizes(1.0, damping, pulsation**2, float(x.mean()), float(np.ptp(x)))
    # x - x_0 = v_0 t - b integral of (x - x_0), or v - v_0 = -b (x - x_0)
    columns = [integral(x - x[0]), time] if place is not None else [x]
    damping = -float(np.linalg.lstsq(np.column_stack(columns), seen - seen[0], rcond=None)[0][0])
    return _Sizes(1.0, damping if damping > 0 else 1 / float(time[-1]), 0.0)


def _sizes(
    t: np.ndarray, force: np.ndarray, place: np.ndarray | None, speed: np.ndarray | None
) -> tuple[float, float, float]:
    """Return mass, damping and stiffness for the drive as a force; 0 where there is no spring."""
    time, integral = t - t[0], partial(cumulative_trapezoid, x=t, initial=0)
    held = np.concatenate([[0.0], np.cumsum(force[:-1] * np.diff(t))])
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
