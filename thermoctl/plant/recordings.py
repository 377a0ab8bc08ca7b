"""Recordings as a plant reads them: its columns, in its units."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.plant.language import Input, Output, Plant
from thermoctl.plant.parts import all_parts
from thermoctl.recording.logger import read_recording
from thermoctl.recording.table import Table
from thermoctl.recording.units import split_unit
from thermoctl.units import conversion
from thermoctl.yamlfile import InputError


def read_recordings(
    plant: Plant,
    paths: Iterable[str | Path],
    time: str | None = None,
    columns: Mapping[str, str] | None = None,
    **how: Any,
) -> list[Table]:
    """Read the recordings of any logger for a plant, in its units. Raises InputError.

    A recording with a gap becomes parts (`plant.parts`).

    `time`: the column of times; `columns`: name that the plant reads: name in the file; `how`: see
    `logger.How`."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the work is Arrow's and numpy's
        read = pool.map(lambda p: in_plant_units(plant, read_recording(p, time, columns, **how)), paths)
        return all_parts(plant, list(read))


def in_plant_units(plant: Plant, table: Table) -> Table:
    """Return a table with the columns that the plant reads in its units; each conversion is a note.

    The plant file's `column` decides (scale and offset, or a unit), else the unit in the file's header. A
    table that is in the plant's units already is returned as it is. Raises InputError for a wrong unit."""
    if not table.recorded:
        return table
    columns, units, notes = dict(table.columns), dict(table.units), list(table.notes)
    done: dict[str, tuple[float, float]] = {}
    for item in plant.readings():
        plain = split_unit(item.column)[0]
        if item.column not in columns and plain in columns:  # the plant names the header with its unit
            columns[item.column], units[item.column] = columns.pop(plain), units.pop(plain, "")
        if item.column not in columns:
            continue
        scale, offset = change = _conversion(plant, table, item, units.get(item.column))
        if done.setdefault(item.column, change) != change:
            raise InputError(
                f"{plant.file}:{item.at}: column '{item.column}' is read in two units; one unit was expected"
            )
        if change == (1.0, 0.0):
            continue
        columns[item.column] = scale * table.columns.get(item.column, columns[item.column]) + offset
        shown = f"{scale:g} * {item.column}" + (f" {offset:+g}" if offset else "")
        given = (item.conversion.unit if item.conversion else None) or units.get(item.column)
        by = f" ({given} to {item.unit})" if given else ""
        notes.append(f"'{item.name}' = {shown}{by}")
    return replace(table, columns=columns, notes=tuple(notes), recorded=False)


def as_recorded(plant: Plant, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return columns in the plant's units as a file holds them that the plant shall read again."""
    found = dict(columns)
    for item in plant.readings():
        if item.conversion and item.column in found:
            scale, offset = _stated(item)
            found[item.column] = (columns[item.column] - offset) / scale
    return found


def _stated(item: Input | Output) -> tuple[float, float]:
    c = item.conversion
    assert c is not None
    return conversion(c.unit, item.unit) if c.unit and item.unit else (c.scale, c.offset)


def _conversion(plant: Plant, table: Table, item: Input | Output, header: str | None) -> tuple[float, float]:
    if item.conversion:
        return _stated(item)
    if not header or not item.unit or header == item.unit:
        return 1.0, 0.0
    try:
        return conversion(header, item.unit)
    except ValueError as e:
        raise InputError(
            f"{table.path}: column '{item.column}' (for '{item.name}' of {plant.file}): {e}; correct the header, "
            f"or state the column's unit in the plant file: column: {{name: {item.column}, unit: ...}}"
        ) from None
