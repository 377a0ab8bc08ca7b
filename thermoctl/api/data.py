"""Data frames, arrays and files as recordings."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant.language import Plant
from thermoctl.plant.parts import in_parts
from thermoctl.plant.units import in_plant_units
from thermoctl.recording.foreign.logger import read_recording
from thermoctl.recording.foreign.units import split_unit
from thermoctl.recording.table import Table


class Frame(Protocol):
    """A data frame, as of pandas or polars: columns by name."""

    @property
    def columns(self) -> Any:
        """Names of the columns."""

    def __getitem__(self, key: Any, /) -> Any:
        """Return the column of a name."""


Data = str | Path | Table | Mapping[str, Any] | Frame
_TIMES = ("t", "time", "Time", "timestamp", "t [s]", "time [s]")


def tables_of(
    plant: Plant | None,
    data: Data | Sequence[Data],
    time: str | None = None,
    columns: Mapping[str, str] | None = None,
    **how: Any,
) -> list[Table]:
    """Return one recording or several, in the plant's units; one with a gap in parts, with a warning.

    `how`: see `sheet.How`; of files only. Raises InputError."""
    items: Sequence[Any] = data if isinstance(data, list | tuple) else [data]
    read_tables = [_table(item, f"data_{k + 1}", time, columns, how) for k, item in enumerate(items)]
    return [part for table in read_tables for part in _parts(plant, table)] if plant else read_tables


def _parts(plant: Plant, table: Table) -> list[Table]:
    table = in_plant_units(plant, table)
    parts = in_parts(plant, table)
    for note in parts[0].notes[len(table.notes) :]:
        warnings.warn(f"{table.path}: {note}", stacklevel=5)
    return parts


def _table(
    data: Data, name: str, time: str | None, columns: Mapping[str, str] | None, how: Mapping[str, Any]
) -> Table:
    if isinstance(data, str | Path):
        return read_recording(data, time, columns, **how)
    if how:
        raise InputError(f"{name}: {', '.join(how)}: a file was expected; change the data frame instead")
    return data if isinstance(data, Table) else _of_frame(data, name, time, columns)


def _of_frame(
    data: Mapping[str, Any] | Frame, name: str, time: str | None, columns: Mapping[str, str] | None
) -> Table:
    arrays = {str(c): data[c] for c in (data if isinstance(data, Mapping) else data.columns)}
    for wanted, given in (columns or {}).items():
        if given not in arrays:
            raise InputError(f"{name}: no column '{given}'{suggest(given, arrays)}")
        arrays[wanted] = arrays.pop(given)
    t = _seconds(*_times(data, arrays, time, name))
    if np.any(np.diff(t) <= 0) or not np.isfinite(t).all():
        raise InputError(f"{name}: times must increase and be complete; sort the rows and drop duplicates")
    values, units = {}, {}
    for header, column in arrays.items():
        short, unit = split_unit(header)
        unit = unit or split_unit((columns or {}).get(header, ""))[1]
        try:
            values[short] = np.asarray(column, float)
        except (TypeError, ValueError):
            continue  # leave out a column of texts
        if values[short].shape != t.shape:
            raise InputError(
                f"{name}: column '{header}' has {values[short].shape} values; {t.shape} were expected"
            )
        if unit:
            units[short] = unit
    return Table(name, name, t, values, units=units, recorded=True)


def _times(
    data: Mapping[str, Any] | Frame, arrays: dict[str, Any], time: str | None, name: str
) -> tuple[np.ndarray, str]:
    """Take the column of times out of `arrays`; a pandas frame's index serves without one."""
    key = time or next((k for k in _TIMES if k in arrays), None)
    if key is not None and key not in arrays:
        raise InputError(f"{name}: no column '{key}'{suggest(key, arrays)}")
    if key is not None:
        return np.asarray(arrays.pop(key)), key
    index = getattr(data, "index", None)
    if index is None or callable(index):
        raise InputError(
            f"{name}: no column of times; call it 't' (seconds), or name it: read(data, time=...)"
        )
    return np.asarray(index), "index"


def _seconds(t: np.ndarray, key: str) -> np.ndarray:
    """Return times as seconds from the first; dates and durations are converted."""
    if t.dtype.kind == "M":
        t = t - t[0]
    if t.dtype.kind == "m":
        return np.asarray(t / np.timedelta64(1, "s"), float)
    try:
        return np.ascontiguousarray(t, float)
    except (TypeError, ValueError):
        raise InputError(f"column '{key}' holds no times: seconds or datetimes were expected") from None
