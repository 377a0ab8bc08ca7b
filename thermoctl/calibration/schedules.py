"""Predict a test before anything moves: its limits, the coil's power and temperature, its spectrum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control.law import COPPER_1_K
from thermoctl.daemon.tick.assemble import compensator
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.identify import experiments
from thermoctl.identify.experiments import Schedule

CUTOFF_HZ = 4.3e-4  # the coil's corner: 1 / (2 pi 370 s), its time constant in test 1 of the paper
# 13 s: the short ramps for the frequencies above the crossover, the long ones for those below
RAMPS_S = 6 * (0.1, 0.2, 0.1, 0.3) + 20 * (0.04, 0.06)
TRAVEL_UM = 10.0  # longest ramp for tuning
ROOM_C = 20.0  # coil temperature when it is not measured: that of protection.resistance_ohm


def of_config(config: str | Path) -> Path:
    """Name the file of a rig's experiments: it lies beside its configuration."""
    return Path(config).parent / "experiments.yaml"


def find(name: str, config: str | Path) -> Schedule:
    """Read one test of a rig's experiments. Raises InputError for an unknown name."""
    path = of_config(config)
    tests = experiments.load_experiments(path)
    if name not in tests:
        raise InputError(
            f"{path}: no experiment '{name}'{suggest(name, tests)}; there are {', '.join(tests)}"
        )
    return tests[name]


def triangles(settings: Settings, start_um: float) -> Schedule:
    """Ramp the setpoint up and down about `start_um` at the law's own rate, to fit the response.

    Each turn is a step of velocity, which excites the fast dynamics. At 1 mm/min the output moves by 5 um at
    most."""
    c = settings.control
    sign = -1.0 if start_um + TRAVEL_UM > c.setpoint_high_um else 1.0
    corners = [(0.0, start_um), (0.5, start_um)]
    for ramp_s in RAMPS_S:
        for to in (start_um + sign * min(c.setpoint_rate_um_s * ramp_s, TRAVEL_UM), start_um):
            corners.append((corners[-1][0] + ramp_s, to))
    t, um = np.array(corners).T
    return Schedule("tune", "triangles", t, um, float(t[-1]))


def within_limits(settings: Settings, schedules: Sequence[Schedule]) -> tuple[float, float]:
    """Return the lowest and highest setpoint, um.

    Raises InputError where they leave the configuration's limits."""
    c = settings.control
    low = min(float(s.setpoint_um.min()) for s in schedules)
    high = max(float(s.setpoint_um.max()) for s in schedules)
    if low < c.setpoint_low_um or high > c.setpoint_high_um:
        raise InputError(
            f"{settings.path}: the setpoints leave control.setpoint_low_um..setpoint_high_um ({c.setpoint_low_um:g}.."
            f"{c.setpoint_high_um:g}): {low:.4g} to {high:.4g} um"
        )
    return low, high


def check_predicted(inputs: experiments.Inputs, settings: Settings) -> None:
    """Refuse an experiment whose predicted readings exceed the limits of `protection`.

    Raises InputError that names the reading."""
    p = settings.protection
    for column, (low, high) in inputs.predicted.items():
        channel = "position_um" if column == "position_raw_um" else column
        top = min(
            p.high.get(channel, np.inf), p.coil_limit_c if channel == settings.channels.coil else np.inf
        )
        bottom = p.low.get(channel, -np.inf)
        if low < bottom or high > top:
            raise InputError(
                f"experiment '{inputs.name}': {column} would reach {low:.4g} to {high:.4g}, the protection of {settings.path} "
                f"allows {bottom:g} to {top:g}"
            )


def forecast(settings: Settings, schedule: Schedule, coil_c: float) -> tuple[np.ndarray | None, float | None]:
    """Predict the coil's power, W for each second, and its highest temperature, degC, from `coil_c`.

    Power: R20 (1 + alpha (T - 20 degC)) i^2 with the current that holds the flexures, i = x /
    flexure_um_per_a, largest in each second. Temperature: coil_c and the rise that the compensator's model
    gives this power. None where the configuration does not say: protection.resistance_ohm and
    flexure_um_per_a, compensation.model."""
    p = settings.protection
    if not (p.resistance_ohm and p.flexure_um_per_a):
        return None, None
    seconds = max(1, math.ceil(schedule.duration_s))
    um = np.abs(schedule.at(np.arange(10 * seconds) / 10)).reshape(seconds, 10).max(axis=1)
    model = compensator(settings)
    n = len(model.A_minus_I)
    one = np.zeros((n + 1, n + 1))  # matrix of the model's step, with the power as one more, constant state
    one[:n, :n], one[:n, n], one[n, n] = np.eye(n) + model.A_minus_I, model.B[:, 0], 1.0
    second = np.linalg.matrix_power(one, round(1.0 / model.period_s))
    power, rise, x = np.zeros(seconds), np.zeros(seconds), np.zeros(n + 1)
    for k, i in enumerate(um / p.flexure_um_per_a):
        x[n] = power[k] = (
            p.resistance_ohm * (1 + COPPER_1_K * (coil_c + float(model.C[0] @ x[:n]) - ROOM_C)) * i * i
        )
        x = second @ x
        rise[k] = model.C[0] @ x[:n]
    return power, coil_c + float(rise.max()) if model.C[0].any() else None


def power_lines(settings: Settings, schedule: Schedule) -> list[str]:
    """Describe the coil's power over a schedule and its spectrum, if they can be predicted."""
    power, peak = forecast(settings, schedule, ROOM_C)
    if power is None:
        return ["power is not predicted: protection.resistance_ohm and flexure_um_per_a are not set"]
    warms = "" if peak is None else f"; the coil warms by {peak - ROOM_C:.1f} K"
    lines = [f"about {power.mean():.2f} W on the mean, {power.max():.2f} W at most{warms}"]
    if np.ptp(power) > 0:
        t = np.arange(len(power), dtype=float)
        below = 100 * experiments.share_below(t, power, CUTOFF_HZ)
        lines.append(f"{below:.0f} % of the alternating power below f_c = {CUTOFF_HZ:g} Hz")
    return lines


def span(s: float) -> str:
    """Write seconds in words: 90 s, 12 min, 3 h 5 min."""
    if s < 2 * 60:
        return f"{s:.0f} s"
    if s < 2 * 3600:
        return f"{s / 60:.0f} min"
    return f"{int(s // 3600)} h {s % 3600 / 60:.0f} min"
