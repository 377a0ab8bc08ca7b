"""Define every signal once: name, unit, meaning, and plausible limits.

A record row holds one tick's signals in this order, all float64. The shared memory, the recording's schema,
`status`, the dashboard and the reference page derive from this table.

Rows can be replayed: `dt_s` to `delay_bits` are all inputs of the law, `state` and later ones its outputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

from thermoctl.channels import POINTS as POINTS
from thermoctl.channels import STATUS_NAMES, TABLE

FAULT_WORD_BITS = 53
"""A float64 holds 53 bits exactly: the faults from this bit on are in `fault_bits_2`."""


@dataclass(frozen=True)
class Signal:
    """One column of a recording: `unit` as pint reads it ('1' for a number), plausible from `low` to `high`.

    `bits`: a word of bits; rows are merged by OR. `before`: its value in every recording made before the
    signal existed; None when it is unknown.
    """

    name: str
    unit: str
    meaning: str
    low: float = -inf
    high: float = inf
    bits: bool = False
    before: float | None = None


SIGNALS: tuple[Signal, ...] = (
    Signal("t_s", "s", "seconds since the daemon's start, monotonic clock, at the start of the tick", 0.0),
    Signal("wall_s", "s", "seconds since 1970 of the system's clock; may step", 0.0),
    Signal("tick", "1", "ticks done since the start", 0.0),
    Signal("lateness_us", "us", "wake-up after the tick's deadline", 0.0),
    Signal("busy_us", "us", "from wake-up until the amplifier was written", 0.0),
    Signal("slips", "1", "ticks skipped because an earlier one took too long, since the start", 0.0),
    Signal("generation", "1", "how many reloads the parameters have seen", 0.0),
    # Inputs of the law, with the time and the command.
    Signal("dt_s", "s", "measured time since the tick before", 0.0, 1.0),
    Signal("command", "1", "command taken in this tick: 0 none, 1 arm, 2 disarm, 3 setpoint", 0.0, 3.0),
    Signal("command_value", "1", "the command's value: the setpoint in um"),
    Signal("external_bits", "1", "fault bits raised outside the law", 0.0, bits=True),
    *(Signal(c.signal, c.unit, c.meaning, c.low, c.high) for c in TABLE),
    Signal("fresh_bits", "1", "bit c: channel c had a new reading in this tick", 0.0, bits=True),
    Signal(
        "status_bits",
        "1",
        "two bits a channel: " + ", ".join(f"{k} {name}" for k, name in enumerate(STATUS_NAMES)),
        0.0,
        bits=True,
    ),
    Signal(
        "delay_bits",
        "1",
        "four bits a temperature, air first: age of a new reading when it arrived, 25 ms each, at most 15",
        0.0,
        bits=True,
    ),
    # Outputs of the law.
    Signal("state", "1", "0 OFF, 1 SAFE, 2 READY, 3 ARMED, 4 FAULT", 0.0, 4.0),
    Signal(
        "fault_bits",
        "1",
        "active faults, and those that led to FAULT; bits as in control/faults.py",
        0.0,
        bits=True,
    ),
    Signal(
        "fault_bits_2",
        "1",
        f"the same for the faults from bit {FAULT_WORD_BITS} on, which is bit 0 of this word",
        0.0,
        bits=True,
        before=0.0,
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
    *(Signal(f"{p}_est_c", "degC", f"{p.replace('_', ' ')}: estimated", -40.0, 200.0) for p in POINTS),
    Signal("innovation_c", "K", "last measured minus estimated coil temperature"),
    Signal("kalman_gain", "1", "gain of the last correction", 0.0, 1.0),
    Signal("position_age_s", "s", "time since the last frame of the position encoder", 0.0),
    Signal("coil_age_s", "s", "time since the last reading of the coil's temperature", 0.0),
)
"""The record row of one tick."""

NAMES = tuple(s.name for s in SIGNALS)
INDEX = {name: i for i, name in enumerate(NAMES)}
OUTPUTS = NAMES[INDEX["state"] :]
"""Names of the law's outputs in a tick, in the order of its array."""
OUTPUT = {name: i for i, name in enumerate(OUTPUTS)}
BIT_WORDS = frozenset(s.name for s in SIGNALS if s.bits)


def fault_word(row: np.ndarray) -> int:
    """Return the fault bits of a record row, both words joined."""
    return int(row[INDEX["fault_bits"]]) | int(row[INDEX["fault_bits_2"]]) << FAULT_WORD_BITS


def join_fault_words(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the fault bits (uint64) of both columns of fault bits; NaN counts as no fault."""
    words = [np.nan_to_num(column).astype(np.uint64) for column in (low, high)]
    return words[0] | words[1] << np.uint64(FAULT_WORD_BITS)


def fault_words(rows: np.ndarray) -> np.ndarray:
    """Return the fault bits (uint64) of record rows (n, signals)."""
    return join_fault_words(rows[:, INDEX["fault_bits"]], rows[:, INDEX["fault_bits_2"]])
