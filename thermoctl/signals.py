"""Every signal once: name, unit, meaning, and the limits it stays within when all is well.

A record row is one tick's signals in this order, all float64. The shared memory, the recording's schema, `status`, the
dashboard and the reference page derive from this table.

Rows replay: the signals `dt_s` to `delay_bits` are everything the law was given, those from `state` on what it gave.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

POINTS = (
    "coil",
    "bobbin",
    "inner_magnet",
    "outer_magnet",
    "inner_stator",
    "outer_stator",
    "stator_connector",
    "bobbin_connector",
    "shaft_1",
    "shaft_2",
    "bracket_1",
    "bracket_2",
)
"""The twelve temperature points, in the paper's order."""


@dataclass(frozen=True)
class Signal:
    """One column of the record: `unit` as pint reads it ('1' for a number), `low`..`high` what is plausible."""

    name: str
    unit: str
    meaning: str
    low: float = -inf
    high: float = inf


def _points(suffix: str, meaning: str) -> tuple[Signal, ...]:
    return tuple(
        Signal(f"{p}{suffix}", "degC", f"{p.replace('_', ' ')}: {meaning}", -40.0, 200.0) for p in POINTS
    )


SIGNALS: tuple[Signal, ...] = (
    Signal("t_s", "s", "seconds since the daemon's start, monotonic clock, at the start of the tick", 0.0),
    Signal("wall_s", "s", "seconds since 1970 of the system's clock; may step", 0.0),
    Signal("tick", "1", "ticks done since the start", 0.0),
    Signal("lateness_us", "us", "wake-up after the tick's deadline", 0.0),
    Signal("busy_us", "us", "from wake-up until the amplifier was written", 0.0),
    Signal("slips", "1", "ticks skipped because an earlier one took too long, since the start", 0.0),
    Signal("generation", "1", "how many reloads the parameters have seen", 0.0),
    # What the law was given.
    Signal("dt_s", "s", "measured time since the tick before", 0.0, 1.0),
    Signal("command", "1", "command taken in this tick: 0 none, 1 arm, 2 disarm, 3 setpoint", 0.0, 3.0),
    Signal("command_value", "1", "the command's value: the setpoint in um"),
    Signal("external_bits", "1", "fault bits raised outside the law", 0.0),
    Signal("position_raw_um", "um", "position encoder"),
    Signal(
        "output_reference_um",
        "um",
        "second encoder at the output, for proof only; the controller does not use it",
    ),
    Signal("voltage_v", "V", "coil voltage"),
    Signal("current_a", "A", "coil current"),
    Signal("air_c", "degC", "chamber air", -40.0, 80.0),
    *_points("_c", "measured"),
    Signal("supply_v", "V", "the amplifier's supply", 0.0),
    Signal("amplifier_state", "1", "0 offline, 1 disabled, 2 enabled, 3 fault, 4 quick stop", 0.0, 4.0),
    Signal("amplifier_fault", "1", "the amplifier's own error code; 0 none", 0.0),
    Signal("fresh_bits", "1", "bit c: channel c had a new reading in this tick", 0.0),
    Signal("status_bits", "1", "two bits a channel: 0 OK, 1 stale, 2 error, 3 absent", 0.0),
    Signal(
        "delay_bits",
        "1",
        "four bits a temperature, air first: age of a new reading when it arrived, 25 ms each, at most 15",
        0.0,
    ),
    # What the law gave.
    Signal("state", "1", "0 OFF, 1 SAFE, 2 READY, 3 ARMED, 4 FAULT", 0.0, 4.0),
    Signal(
        "fault_bits", "1", "standing faults, and those that led to FAULT; bits as in control/faults.py", 0.0
    ),
    Signal("setpoint_um", "um", "where the output shall be"),
    Signal("reference_um", "um", "the setpoint after its rate limiter"),
    Signal("position_um", "um", "position encoder after the moving average"),
    Signal("compensated_um", "um", "position plus compensation: what the controller holds at the reference"),
    Signal(
        "compensation_um", "um", "the thermal error that is compensated: bounded, slewed, frozen on a fault"
    ),
    Signal("expansion_um", "um", "the thermal error as the expansion model gives it"),
    Signal("control_v", "V", "output of the controller"),
    Signal("drive", "1", "what the amplifier was given, in its own unit"),
    Signal("enable", "1", "1 while the amplifier is enabled", 0.0, 1.0),
    Signal("power_w", "W", "electrical power of the coil as the estimator uses it"),
    Signal("air_rate_k_s", "K/s", "rate of the low-passed air temperature"),
    *_points("_est_c", "estimated"),
    Signal("innovation_c", "K", "last measured minus estimated coil temperature"),
    Signal("kalman_gain", "1", "gain of the last correction", 0.0, 1.0),
    Signal("position_age_s", "s", "time since the last frame of the position encoder", 0.0),
    Signal("coil_age_s", "s", "time since the last reading of the coil's temperature", 0.0),
)
"""The record row of one tick."""

NAMES = tuple(s.name for s in SIGNALS)
INDEX = {name: i for i, name in enumerate(NAMES)}
