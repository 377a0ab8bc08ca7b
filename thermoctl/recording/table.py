"""A recording in memory: a time column and any number of signals.

The time is in seconds and strictly increasing; every other cell is a number or missing (NaN).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Table:
    """A recording: time `t` (N,) in seconds and `columns`, each (N,) float64, NaN where missing.

    `name`: the file's stem; `path`: its path; `meta`: texts of the file (configuration, model). `units`: unit
    of a column, where the file states it. `notes`: the reader's guesses and conversions, for people.
    `recorded`: the numbers are as in the file, not yet in the units of a plant."""

    name: str
    path: str
    t: np.ndarray
    columns: dict[str, np.ndarray]
    meta: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    recorded: bool = False

    def __len__(self) -> int:
        return len(self.t)


def exact(t: float) -> str:
    """Return a time with the digits that tell it from every other: 0.464, not 0.46400000000000002."""
    return np.format_float_positional(t, trim="-")
