"""Recordings as a plant reads them: its columns, in its units."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

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

    `time`: the column of times; `columns`: name that the plant reads: name in the file; `how`: see
    `sheet.How`."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the work is Arrow's and numpy's
        read = pool.map(lambda p: in_plant_units(plant, read_recording(p, time, columns, **how)), paths)
        return all_parts(plant, list(read))
