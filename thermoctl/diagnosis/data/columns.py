"""A case whose recordings are read with other columns, in the same rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import ROUGH, Budget, Case, grids_of
from thermoctl.diagnosis.data.coordinates import Coordinates
from thermoctl.plant.fitting.climb import LEAST
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.residuals import Evaluation, Problem, ResidualRows, robust
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.recording.table import Table


class Columns:
    """A case at its refit, linearised once: so thousands of pairs of columns can be looked at.

    Raises SimulationError."""

    def __init__(self, known: Case):
        self.known, self.model = known, known.null.model
        self.rows: list[ResidualRows] = []
        self.problem = Problem(self.model, known.drives(self.model), known.noise)
        self.base = self.problem.evaluate(known.null.z, True, self.rows)

    def promised(self, change: Callable[[Table], Table]) -> tuple[float, float]:
        """Return the cost with changed columns, and that after a linear step from there.

        Raises SimulationError."""
        at = self._evaluated(self._drives(change))
        ridge = LEAST * np.diag(np.diag(at.matrix))
        return at.cost, at.cost - float(at.gradient @ np.linalg.solve(at.matrix + ridge, at.gradient))

    def changed(self, change: Callable[[Table], Table], goal: float, budget: Budget) -> Case | None:
        """Return the case with changed columns in the same rows, so that log evidences can be compared.

        Nothing is averaged or left out again. None if the cost of the refit stays above `goal`.
        Raises SimulationError."""
        known, drives = self.known, self._drives(change)
        null = fit(self.model, drives, known.noise, iterations=40, tolerance=ROUGH, seconds=np.inf, goal=goal)
        if null.cost > goal:
            return None
        coordinates = Coordinates(drives)
        grids = grids_of(coordinates, drives, null, known.block)
        tables = tuple(map(change, known.tables))
        return dataclasses.replace(
            known, tables=tables, null=null, coordinates=coordinates, grids=grids, budget=budget
        )

    def _drives(self, change: Callable[[Table], Table]) -> list[Excitation]:
        known, model = self.known, self.model
        return [dataclasses.replace(model.excitation(change(t)), rtol=known.rtol) for t in known.tables]

    def _evaluated(self, drives: Sequence[Excitation]) -> Evaluation:
        """Return the evaluation of changed columns; of changed readings without a run."""
        z, noise = self.known.null.z, self.known.noise
        return self._read(drives) or Problem(self.model, drives, noise).evaluate(z, True)

    def _read(self, drives: Sequence[Excitation]) -> Evaluation | None:
        """Return the evaluation of other readings; None where they change a run, or slopes were not kept."""
        values, dx0 = self.problem.unpack(self.known.null.z)
        for old, new, p, shift in zip(self.problem.excitations, drives, values, dx0, strict=True):
            before, after = (self.model.start(d, p, shift)[0] for d in (old, new))
            if not (self.rows and np.array_equal(old.u, new.u) and np.array_equal(before, after)):
                return None
        cost, gradient, matrix, errors = self.base
        gradient, matrix = gradient.copy(), matrix.copy()
        moved = [
            e + np.nan_to_num(new.y - old.y)
            for e, new, old in zip(errors, drives, self.problem.excitations, strict=True)
        ]
        for own in self.rows:
            noise, limit = self.problem.whitening[own.recording][own.output], self.problem.huber[own.output]
            before, after = (noise.whiten(e[own.recording][:, own.output]) for e in (errors, moved))
            if not np.array_equal(before, after):
                more, weight = robust(after, limit)
                weight, w = noise.spread(weight, len(own.w)), noise.spread(after, len(own.w))
                cost += more - robust(before, limit)[0]
                gradient[own.unknowns] += own.slope * (own.jac.T @ (weight * w - own.weight * own.w))
                matrix[np.ix_(own.unknowns, own.unknowns)] += own.gram(weight) - own.gram(own.weight)
        return Evaluation(cost, gradient, matrix, moved)
