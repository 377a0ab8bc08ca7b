"""Rows as a file holds them, before their clock is known; and a person's choices about their reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa

from thermoctl.recording.foreign.clock import Seconds

Cells: TypeAlias = np.ndarray | pa.Array
"""A column: float64, datetime64 or timedelta64 values, or texts."""


def place_in(path: Path, what: str = "row") -> Callable[[int], str]:
    """Return a function that names data row k (from 0) of a file without lines."""
    return lambda row: f"{path}: {what} {row + 1}"


def as_cells(values: np.ndarray) -> Cells:
    """Return an array of any kind as a column: numbers, times, or texts."""
    if values.dtype.kind in "iub":
        return values.astype(float)
    if values.dtype.kind in "fmM":
        return values
    return pa.array(
        [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values.tolist()]
    )


@dataclass(frozen=True)
class How:
    """Choices of a person about the reading of a file; the reader finds the others.

    - `time`: column of times, or the time from row to row, such as 0.1s
    - `sheet`: sheet of Excel, group of TDMS, variable of MATLAB
    - `missing`: further words and numbers for "no value"
    - `decimal`: the decimal sign
    - `run`: the one to read of several in a file, from 1
    - `equal_times`: spread, mean, first or last
    - `trace`: receives how the file was read, for people"""

    time: str | None = None
    sheet: str | None = None
    missing: tuple[str, ...] = ()
    decimal: str | None = None
    run: int | None = None
    equal_times: str | None = None
    trace: list[str] = field(default_factory=list, compare=False)


@dataclass
class Sheet:
    """Columns of one length, in the order of the file.

    - `place`: names data row k (from 0)
    - `units`: by column, where the file states them
    - `step_s`, `offset_s`: the stated time between rows, and of the first row
    - `start`: the date of time 0
    - `decimal`: the decimal sign that the file shows
    - `clock`: the times, where the format gives them
    - `left`: the first words of each column of text that was left out
    - `again`: reads the rows once more, cell by cell, if they make no table"""

    columns: dict[str, Cells]
    place: Callable[[int], str]
    units: dict[str, str] = field(default_factory=dict)
    name: str = ""
    step_s: float | None = None
    offset_s: float = 0.0
    start: str | None = None
    decimal: str | None = None
    clock: Seconds | None = None
    again: Callable[[], list[Sheet]] | None = None
    meta: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    left: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))
