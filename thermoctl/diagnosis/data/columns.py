"""A case whose recordings are read with other columns, in the same rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.data.case import ROUGH, Budget, Case, grids_of
from thermoctl.diagnosis.data.coordinates import Coordinates
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.simulation.simulate import Excitation, SimulationError
from thermoctl.recording.table import Table


def unfitted_cost(known: Case, tables: Sequence[Table]) -> float:
    """Return the cost of recordings at the plant file's own values; infinite where there is no simulation."""
    try:
        problem = Problem(known.null.model, _drives(known, tables), known.noise)
        return problem.evaluate(problem.start({}), False).cost
    except (SimulationError, InputError):
        return np.inf


def changed(known: Case, tables: Sequence[Table], goal: float, budget: Budget) -> Case | None:
    """Return the case with changed columns in the same rows, so that log evidences can be compared.

    Nothing is averaged or left out again. None if the cost of the refit stays above `goal`.
    Raises SimulationError."""
    drives = _drives(known, tables)
    null = fit(
        known.null.model, drives, known.noise, iterations=40, tolerance=ROUGH, seconds=np.inf, goal=goal
    )
    if null.cost > goal:
        return None
    coordinates = Coordinates(drives)
    grids = grids_of(coordinates, drives, null, known.block)
    return dataclasses.replace(
        known, tables=tuple(tables), null=null, coordinates=coordinates, grids=grids, budget=budget
    )


def _drives(known: Case, tables: Sequence[Table]) -> list[Excitation]:
    return [dataclasses.replace(known.null.model.excitation(t), rtol=known.rtol) for t in tables]
