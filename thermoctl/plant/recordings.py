"""Recordings as a plant reads them: its columns, in its units."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from thermoctl.files.yamlfile import InputError
from thermoctl.plant.language import Plant
from thermoctl.plant.parts import all_parts
from thermoctl.plant.units import in_plant_units
from thermoctl.recording.foreign.logger import read_recording
from thermoctl.recording.table import Table


def read_recordings(
    plant: Plant,
    paths: Iterable[str | Path],
    time: str | None = None,
    columns: Mapping[str, str] | None = None,
    **how: Any,
) -> list[Table]:
    """Read the recordings of any logger for a plant, in its units. Raises InputError.

    A recording with a gap becomes parts (`plant.parts`).

    `columns`: name that the plant reads: name in the file; `time`, `how`: see `sheet.How`."""
    columns = _by_column(plant, columns or {})
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the work is Arrow's and numpy's
        read = pool.map(lambda p: in_plant_units(plant, read_recording(p, time, columns, **how)), paths)
        return all_parts(plant, list(read))


def _by_column(plant: Plant, columns: Mapping[str, str]) -> dict[str, str]:
    """Return `columns` with the plant's column as key in place of the name of an input or output."""
    read = {r.column: r.column for r in plant.readings()}
    own = {r.name: r.column for r in plant.readings()} | read
    chosen: dict[str, str] = {}
    for wanted, name in columns.items():
        if (column := own.get(wanted, wanted)) in chosen:
            raise InputError(
                f"--columns {wanted}: {plant.file} reads column '{column}' for it, which is given already"
            )
        chosen[column] = name
    return chosen
