"""Define every signal once: name, unit, meaning, and plausible limits.

A record row holds one tick's signals, all float64. The shared memory, the recording's schema, `status`, the
dashboard and the reference page derive from this table. The signals that every rig has come first and have
the same index (`AT`) everywhere; those of the declared points follow. `of_channels` gives the whole row:

    loop | inputs of the law | outputs of the law | channels of an axis, air | points: measured |
    words of bits: fresh, status, delay | points: estimated

A row can be replayed: `dt_s`, `command` to `external_bits`, the channels and the words are all inputs of the
law.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from math import inf

import numpy as np

from thermoctl.rig.channels import DEFAULT, FIXED, STATUS_NAMES, Channels, of_text

FAULT_WORD_BITS = 53
"""A float64 holds 53 bits exactly: the faults from this bit on are in `fault_bits_2`."""
FRESH_PER_WORD, STATUS_PER_WORD, DELAYS_PER_WORD = 52, 26, 13
"""Channels in a word of bits: 1, 2 and 4 bits each, 52 bits a word."""


@dataclass(frozen=True)
class Signal:
    """One column of a recording: `unit` as pint reads it ('1' for a number), plausible from `low` to `high`.

    `bits`: a word of bits; rows are merged by OR."""

    name: str
    unit: str
    meaning: str
    low: float = -inf
    high: float = inf
    bits: bool = False


_LOOP = (
    Signal("t_s", "s", "seconds since the daemon's start, monotonic clock, at the start of the tick", 0.0),
    Signal("wall_s", "s", "seconds since 1970 of the system's clock; may step", 0.0),
    Signal("tick", "1", "ticks done since the start", 0.0),
    Signal("lateness_us", "us", "wake-up after the tick's deadline", 0.0),
    Signal("busy_us", "us", "from wake-up until the amplifier was written", 0.0),
    Signal("slips", "1", "ticks skipped because an earlier one took too long, since the start", 0.0),
    Signal("generation", "1", "how many reloads the parameters have seen", 0.0),
    Signal("dt_s", "s", "measured time since the tick before", 0.0, 1.0),
    Signal("command", "1", "command taken in this tick: 0 none, 1 arm, 2 disarm, 3 setpoint", 0.0, 3.0),
    Signal("command_value", "1", "the command's value: the setpoint in um"),
    Signal("external_bits", "1", "fault bits raised outside the law", 0.0, bits=True),
)
_OUTPUTS = (
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
    Signal("innovation_c", "K", "last measured minus estimated coil temperature"),
    Signal("kalman_gain", "1", "gain of the last correction", 0.0, 1.0),
    Signal("position_age_s", "s", "time since the last frame of the position encoder", 0.0),
    Signal("coil_age_s", "s", "time since the last reading of the coil's temperature", 0.0),
)
OUTPUTS = tuple(s.name for s in _OUTPUTS)
"""Names of the law's outputs in a tick, in the order of its array; the points' estimates follow there."""
OUTPUT = {name: i for i, name in enumerate(OUTPUTS)}
_EVERY_RIG = (*_LOOP, *_OUTPUTS, *(Signal(c.signal, c.unit, c.meaning, c.low, c.high) for c in FIXED))
AT = {s.name: i for i, s in enumerate(_EVERY_RIG)}
"""Index of each signal that every rig has."""


def words(name: str, count: int, per_word: int) -> tuple[str, ...]:
    """Return the names of the words of bits that `count` channels take: NAME_bits, NAME_bits_2 ..."""
    return tuple(f"{name}_bits" + (f"_{k + 1}" if k else "") for k in range(-(-count // per_word)))


class Row:
    """The record row of a rig: its signals, their index, and where its parts lie.

    Slices: `readings` (all channels), `measured` (the points among them), `estimates` (of the points), and
    the words of bits `fresh`, `status`, `delay`."""

    def __init__(self, channels: Channels):
        self.channels = channels
        points, n = channels.points, len(channels.names)
        measured = tuple(
            Signal(c.signal, c.unit, c.meaning, c.low, c.high) for c in channels.table if c.point
        )
        fresh, status = words("fresh", n, FRESH_PER_WORD), words("status", n, STATUS_PER_WORD)
        delay = words("delay", 1 + len(points), DELAYS_PER_WORD)
        states = ", ".join(f"{k} {name}" for k, name in enumerate(STATUS_NAMES))
        meanings = {
            "fresh": (FRESH_PER_WORD, "bit c: channel c had a new reading in this tick"),
            "status": (STATUS_PER_WORD, f"two bits a channel: {states}"),
            "delay": (
                DELAYS_PER_WORD,
                "four bits a temperature, air first: age of a new reading when it arrived, 25 ms each, at most 15",
            ),
        }
        bits = []
        for name in (*fresh, *status, *delay):
            kind, _, number = name.partition("_bits")
            per_word, meaning = meanings[kind]
            first = per_word * (int(number[1:]) - 1) if number else 0
            bits.append(
                Signal(name, "1", meaning + (f"; from number {first} on" if first else ""), 0.0, bits=True)
            )
        estimated = tuple(
            Signal(f"{p.name}_est_c", "degC", f"{p.words}: estimated", -40.0, 200.0) for p in points
        )
        self.signals = (*_EVERY_RIG, *measured, *bits, *estimated)
        self.names = tuple(s.name for s in self.signals)
        self.index = {name: i for i, name in enumerate(self.names)}
        first = AT[FIXED[0].signal]
        ends = np.cumsum([first + n, len(fresh), len(status), len(delay), len(estimated)]).tolist()
        self.readings = slice(first, ends[0])
        self.measured = slice(len(_EVERY_RIG), ends[0])
        self.fresh, self.status, self.delay, self.estimates = (
            slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)
        )
        self.bit_words = frozenset(s.name for s in self.signals if s.bits)

    def __len__(self) -> int:
        return len(self.signals)

    def states(self, rows: np.ndarray) -> np.ndarray:
        """Return the status (rows, channels) of each reading, OK to ABSENT, from record rows."""
        return _unpack(np.atleast_2d(rows)[:, self.status], len(self.channels.names), STATUS_PER_WORD, 2)

    def arrived(self, rows: np.ndarray) -> np.ndarray:
        """Return where (rows, channels) a reading was new, from record rows."""
        return _unpack(np.atleast_2d(rows)[:, self.fresh], len(self.channels.names), FRESH_PER_WORD, 1) > 0

    def duplicates(self) -> list[str]:
        """Return the names that two signals would have."""
        return sorted({n for n in self.names if self.names.count(n) > 1})


def _unpack(found: np.ndarray, count: int, per_word: int, bits: int) -> np.ndarray:
    """Return (rows, count) numbers of `bits` bits each from words (rows, words)."""
    whole = np.nan_to_num(found).astype(np.int64)
    item = np.arange(count)
    return whole[:, item // per_word] >> bits * (item % per_word) & (1 << bits) - 1


def of_recording(meta: Mapping[str, str]) -> Row:
    """Return the row of the rig that made a recording, from the recording's metadata."""
    return of_channels(of_text(meta["points"]) if "points" in meta else DEFAULT)


def recorded_states(columns: Mapping[str, np.ndarray], meta: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the status of each channel, OK to ABSENT, from a recording's columns of status words."""
    names = of_recording(meta).channels.names
    packed = np.column_stack([columns[n] for n in words("status", len(names), STATUS_PER_WORD)])
    return dict(zip(names, _unpack(packed, len(names), STATUS_PER_WORD, 2).T, strict=True))


@cache
def of_channels(channels: Channels) -> Row:
    """Return the record row of a rig with these channels."""
    return Row(channels)


def fault_word(row: np.ndarray) -> int:
    """Return the fault bits of a record row, both words joined."""
    return int(row[AT["fault_bits"]]) | int(row[AT["fault_bits_2"]]) << FAULT_WORD_BITS


def join_fault_words(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the fault bits (uint64) of both columns of fault bits; NaN counts as no fault."""
    both = [np.nan_to_num(column).astype(np.uint64) for column in (low, high)]
    return both[0] | both[1] << np.uint64(FAULT_WORD_BITS)


def fault_words(rows: np.ndarray) -> np.ndarray:
    """Return the fault bits (uint64) of record rows (n, signals)."""
    return join_fault_words(rows[:, AT["fault_bits"]], rows[:, AT["fault_bits_2"]])


def units(names: Iterable[str]) -> dict[str, str]:
    """Return the units of those names that are signals of a rig, or end as a temperature's do."""
    fixed = {s.name: s.unit for s in _EVERY_RIG}
    by_name = {n: fixed.get(n, "degC" if n.endswith("_c") else "") for n in names}
    return {n: unit for n, unit in by_name.items() if unit}


PAPER = of_channels(DEFAULT)
"""The row of the paper's actuator, which is that of a rig file without `points`."""
SIGNALS, NAMES, INDEX, POINTS = PAPER.signals, PAPER.names, PAPER.index, DEFAULT.point_names
"""Of the paper's actuator only: a rig's own are `settings.row`."""
