"""The Python interface: plants, simulation, refit and diagnosis on data frames, arrays or files.

Every function takes a plant as a `Plant` or a path. Data are a path, a data frame (pandas, polars), a mapping
of names to arrays, or a `Table`. Errors in the input are `thermoctl.files.yamlfile.InputError`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoctl.api.data import Data, tables_of
from thermoctl.api.fits import Refit
from thermoctl.api.plants import Plant, plant_of
from thermoctl.api.results import Simulation, joined
from thermoctl.checks import Finding, checks
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import from_plain, load
from thermoctl.plant.fitting.refit import fit_by_first_parts
from thermoctl.plant.simulation.initial import last_state, with_start
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.table import Table

if TYPE_CHECKING:
    from thermoctl.api.diagnosing import Diagnosis, diagnose


def load_plant(source: str | Path | Mapping[str, Any], map: str | Path | None = None) -> Plant:
    """Return the plant of a file, of an FMU, or of plain dicts with the file's keys. Raises InputError.

    `map`: with an FMU, the file of its variables' columns, roles, units, noise and ranges."""
    return Plant(from_plain(source) if isinstance(source, Mapping) else load(source, map))


def read(
    data: Data,
    time: str | None = None,
    columns: Mapping[str, str] | None = None,
    *,
    sheet: str | None = None,
    missing: Sequence[str] = (),
    decimal: str | None = None,
) -> Table:
    """Return a recording of any kind of data: `t` (N,) in seconds, `columns` (N,) each, `units`, `notes`.

    `time`: the column of times; `columns`: name that a plant reads: name in the data. Raises InputError.

    Of a file only (`time` may then also be the time from row to row, such as "10 ms"):

    - `sheet`: sheet of Excel, group of TDMS, variable of MATLAB
    - `missing`: further words and numbers for "no value"
    - `decimal`: the decimal sign"""
    how = {"sheet": sheet, "missing": tuple(map(str, missing)), "decimal": decimal}
    return tables_of(None, data, time, columns, **{k: v for k, v in how.items() if v})[0]


def simulate(
    plant: Plant | str | Path,
    data: Data,
    parameters: Mapping[str, float] | None = None,
    x0: Mapping[str, float] | Data | None = None,
) -> Simulation:
    """Simulate freely on the inputs in `data`; outputs in `data` are compared. Raises InputError.

    `parameters`: values that replace the plant's. `x0`: initial values by node, "steady" for the steady state
    of the first inputs, or a recording, whose last state is estimated. By default the plant file decides, and
    the steady state where it needs readings that `data` lacks. After a gap a run starts from its readings."""
    own = plant_of(plant)
    model = compile_plant(own.description, ())
    parts, start = tables_of(own.description, data), _start(own, x0)
    drives, runs = [], []
    try:
        for part in parts:
            drives.append(model.excitation(part))
            with_start(model, drives[-1], start, parameters)
            runs.append(model.run(drives[-1], parameters))
        return joined(own, drives, runs, [float(p.t[0] - parts[0].t[0]) for p in parts])
    except SimulationError as e:
        raise InputError(f"{own.description.file}: {e}") from None


def _start(plant: Plant, x0: Mapping[str, float] | Data | None) -> Mapping[str, float] | str | None:
    """Return initial values by node, "steady" or None; a recording's last state by node."""
    if (
        x0 is None
        or x0 == "steady"
        or (isinstance(x0, Mapping) and all(np.ndim(v) == 0 for v in x0.values()))
    ):
        return x0
    return last_state(plant.description, tables_of(plant.description, x0)[-1])


def refit(plant: Plant | str | Path, data: Data | Sequence[Data], tries: int = 0) -> Refit:
    """Fit the parameters that have a range to recordings, inside their ranges. Raises InputError.

    `tries`: further starting points, random in the ranges."""
    own = plant_of(plant)
    if not any(p.range for p in own.description.parameters.values()):
        raise InputError(f"{own.description.file}: no parameter has a 'range', so there is nothing to refit")
    model = compile_plant(own.description)
    excitations = [model.excitation(t) for t in tables_of(own.description, data)]
    try:
        return Refit(own, fit_by_first_parts(model, excitations, tries=tries), tuple(excitations))
    except SimulationError as e:
        raise InputError(f"{own.description.file}: {e}") from None


def check(plant: Plant | str | Path, data: Data | Sequence[Data]) -> list[Finding]:
    """Return wrong labels, units, clocks and signs, severe ones first; takes seconds. Raises InputError."""
    own = plant_of(plant)
    return checks(own.description, tables_of(own.description, data))


def __getattr__(name: str) -> Any:
    """Return `diagnose` or `Diagnosis`, which load the diagnosis. Raises AttributeError for other names."""
    if name not in ("Diagnosis", "diagnose"):
        raise AttributeError(f"module 'thermoctl.api' has no attribute '{name}'")
    return getattr(importlib.import_module("thermoctl.api.diagnosing"), name)


__all__ = [
    "Diagnosis",
    "Finding",
    "Plant",
    "Refit",
    "Simulation",
    "check",
    "diagnose",
    "load_plant",
    "read",
    "refit",
    "simulate",
]
