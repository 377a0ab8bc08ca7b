"""A case whose recordings are read with other columns, in the same rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import ROUGH, Budget, Case, grids_of
from thermoctl.diagnosis.data.coordinates import Coordinates
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.residuals import Evaluation, Problem, ResidualRows, robust
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.recording.table import Table

# Predicted cost with other columns, over that as recorded. In six concealed cases it was 0.00 to 0.93 for 16
# pairs of columns that were swapped. For those that were not it was 14 and more.
FAR_WORSE = 5.0


class Columns:
    """A case at its refit, linearised once: so thousands of pairs of columns can be looked at.

    Raises SimulationError."""

    def __init__(self, known: Case):
        self.known, self.model = known, known.null.model
        self.rows: list[ResidualRows] = []
        self.problem = Problem(self.model, known.drives(self.model), known.noise)
        self.base = self.problem.evaluate(known.null.z, True, self.rows)

    def changed(self, change: Callable[[Table], Table], budget: Budget) -> Case | None:
        """Return the case with changed columns in the same rows, so that log evidences can be compared.

        Nothing is averaged or left out again. None if the refit stays worse than that of the case. A linear
        step from there predicts most such refits, which are not made. Raises SimulationError."""
        known, model = self.known, self.model
        tables = tuple(change(t) for t in known.tables)
        drives = [dataclasses.replace(model.excitation(t), rtol=known.rtol) for t in tables]
        at = self._read(drives) or Problem(model, drives, known.noise).evaluate(known.null.z, True)
        step = np.linalg.lstsq(at.matrix, at.gradient, rcond=None)[0]
        if at.cost - at.gradient @ step > FAR_WORSE * known.null.cost:
            return None
        null = fit(
            model, drives, known.noise, iterations=40, tolerance=ROUGH, seconds=np.inf, goal=known.null.cost
        )
        if null.cost > known.null.cost:
            return None
        coordinates = Coordinates(drives)
        grids = grids_of(coordinates, drives, null, known.block)
        return dataclasses.replace(
            known, tables=tables, null=null, coordinates=coordinates, grids=grids, budget=budget
        )

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
