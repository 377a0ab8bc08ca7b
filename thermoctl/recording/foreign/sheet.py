"""Rows as a file holds them, before their clock is known; and a person's choices about their reading."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from thermoctl.recording.foreign.clock import Seconds

Cells: TypeAlias = np.ndarray | pa.Array
"""A column: float64, datetime64 or timedelta64 values, or texts."""
INDEX = " "  # name of an index without a name: a clock, or left out beside one
MOST_ITEMS = 64  # largest number of items of a list that is one sample, such as an acceleration


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


def of_lists(
    path: Path,
    columns: Mapping[str, Sequence[Any]],
    place: Callable[[int], str] | None = None,
    name: str = "",
) -> Sheet:
    """Return lists of one length as a sheet of texts."""
    texts: dict[str, Cells] = {
        n: pa.array(["" if v is None else _word(v) for v in c], pa.string()) for n, c in columns.items()
    }
    return Sheet(texts, place or place_in(path, "item"), name=name)


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def of_records(path: Path, records: Sequence[Mapping[str, Any]], name: str = "") -> Sheet:
    """Return records as a sheet of texts; a key that a record lacks is an empty cell."""
    records = [_flat(r) for r in records]
    names = list(dict.fromkeys(k for r in records for k in r))
    return of_lists(path, {n: [r.get(n) for r in records] for n in names}, place_in(path, "record"), name)


def _flat(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's values; those inside a value are called `outer_inner`, or `outer_1` in a list."""
    values: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, dict):
            values |= {f"{key}_{inner}": v for inner, v in _flat(value).items()}
        elif not isinstance(value, list):
            values[key] = value
        elif len(value) <= MOST_ITEMS and all(isinstance(v, int | float) for v in value):
            values |= {f"{key}_{i}": v for i, v in enumerate(value, 1)}
    return values
