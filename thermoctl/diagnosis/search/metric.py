"""Whitened rows of a refitted hypothesis, and the part of them that its own unknowns absorb.

Unknowns with a Gaussian prior of covariance P and sensitivities J add J P J' to the rows' covariance. Let
J sqrt(P) be U s W'. Multiplying by the inverse root of that covariance removes the share
1 - 1 / sqrt(1 + s^2) of each direction of U. That is nearly all where the data determine the unknowns, and
little where the prior does. Below, this is called the projection."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.data.coordinates import Coordinates, transforms
from thermoctl.diagnosis.data.grids import grid
from thermoctl.diagnosis.evidence.noise import Around, Averaged
from thermoctl.diagnosis.evidence.where import signals
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.simulation.simulate import Simulation

ROWS = 6_000  # largest number of DCT rows, all outputs and recordings together
FREE = 1e4  # standard deviation that stands for no prior


@dataclass(frozen=True)
class Pushed:
    """First-order changes that columns cause in one recording.

    - `forces`: (state, column) of each change of a slope dx/dt, with values q (N, forces) (`Model.respond`)
    - `read`: (output, column) of each direct change of an output, with values (N,)"""

    forces: list[tuple[int, int]]
    q: np.ndarray
    read: dict[tuple[int, int], np.ndarray]


@dataclass(frozen=True)
class Absorbed:
    """Orthonormal directions (rows, k), and the share (k,) of each that unknowns absorb."""

    directions: np.ndarray
    share: np.ndarray

    @classmethod
    def by(cls, columns: np.ndarray) -> Absorbed:
        """Return the directions that unknowns absorb.

        `columns` (rows, k): changes by independent prior deviations."""
        u, s, _ = np.linalg.svd(columns, full_matrices=False)
        return cls(u, 1 - 1 / np.sqrt(1 + s**2))

    def without(self, x: np.ndarray) -> np.ndarray:
        """Return rows (rows, ...) less the absorbed share of each direction."""
        return x - (self.directions * self.share) @ (self.directions.T @ x)


def without(own: Sequence[Absorbed], d: np.ndarray) -> np.ndarray:
    """Return rows (rows, ...) of all recordings without the part that each one's own unknowns absorb."""
    parts = np.split(d, np.cumsum([len(q.directions) for q in own])[:-1])
    return np.concatenate([q.without(x) for q, x in zip(own, parts, strict=True)])


class Plain:
    """DCT rows of a fit, not whitened: of its residual and of its sensitivities to z."""

    def __init__(self, case: Case, fit: Fit):
        self.case, self.fit, self.model = case, fit, fit.model
        self.drives = case.drives(self.model)
        self.problem = Problem(self.model, self.drives, case.noise)
        for d, values in zip(self.drives, self.fit.values, strict=True):
            self.model.prepare(d, values)
        self.coordinates = Coordinates(self.drives, max(ROWS // len(case.coordinates.channels), 32))
        measured = self.coordinates.by_output().values()
        self.grids = [grid(self.coordinates, ks, g) for ks, g in zip(measured, case.grids, strict=True)]
        self.channels = [self.coordinates.of_recording(r) for r in range(len(self.drives))]
        self.point = self.fit.values, self.fit.dx0
        parts = self.problem.each(self._sensitive, self.point, 2)
        self.runs = [run for run, _, _ in parts]
        self.residual = np.concatenate([residual for _, residual, _ in parts])
        # By recording (rows, k), with respect to `unknowns`.
        self.sensitivities = [rows for *_, rows in parts]

    def unknowns(self, r: int) -> np.ndarray:
        """Return the unknowns of recording r."""
        return self.problem.columns[r, self.problem.columns[r] >= 0]

    def _sensitive(
        self, r: int, values: np.ndarray, dx0: np.ndarray
    ) -> tuple[Simulation, np.ndarray, np.ndarray]:
        """Return a recording's run, and the DCT rows of its residual and of its sensitivities (rows, k)."""
        d, channels = self.drives[r], self.channels[r]
        run = self.model.run(d, values, dx0, sensitivities=True, states=False)
        used, _, slope = self.problem.slopes(r, values)
        rows = transforms(channels, run.sensitivities[:, :, used]) * slope
        return Simulation(run.t, run.x, run.y), transforms(channels, d.y - run.y), rows


class Metric:
    """Whitened rows of a refitted hypothesis: DCT rows divided by the rms of their noise.

    - `weight` (rows,): the factor that whitens each row
    - `residual` (rows,): after projection, with initial states at the means of their priors
    - `own`: by recording, the directions that its own unknowns absorb (its initial states)
    - `shared`: the further directions that the unknowns common to all recordings absorb

    `average`: spectra of the refit's residuals. `remainder`: is the remainder part of the noise? If so,
    errors at low frequencies have little weight. If not, the initial states are free, as in the refit in
    white noise."""

    def __init__(self, plain: Plain, average: Averaged, remainder: bool):
        self.plain, self.fit, self.model = plain, plain.fit, plain.model
        self.drives, self.runs = plain.drives, plain.runs
        self.weights = _weights(plain.case, average, plain.coordinates, remainder)
        self.weight = np.concatenate(self.weights)
        self.residual = self.project((plain.residual + self._absorb(remainder)) * self.weight)
        self.around = Around(plain.grids, self.powers(self.residual))

    def _absorb(self, held: bool) -> np.ndarray:
        """Set the directions that the unknowns absorb.

        Parameters are free; those at an end of their range absorb nothing. Initial states are bound by their
        priors if `held`, else they are free. Each acts in its own recording only, so that its directions are
        few. Returns the change of the outputs by the fitted initial states, not whitened (rows,)."""
        unknowns, plain = self.plain.problem.unknowns, self.plain
        free = np.array([q not in self.fit.at_bound for q, _ in unknowns], bool)
        of_one = np.array([of is not None for _, of in unknowns], bool)
        shared = np.flatnonzero(free & ~of_one)
        sd, moved = np.full(len(unknowns), FREE), np.zeros(len(unknowns))
        if held:  # in units of z the priors of initial states are standard normal
            starts = slice(plain.problem.n_parameters, None)
            sd[starts], moved[starts] = 1.0, self.fit.z[starts]
        self.own, common, out = [], [], []
        edges = np.cumsum([len(s) for s in plain.sensitivities])[:-1]
        for r, weight in enumerate(np.split(self.weight, edges)):
            rows, ks = plain.sensitivities[r] * weight[:, None], plain.unknowns(r)
            out.append(plain.sensitivities[r] @ moved[ks])
            mine = free[ks] & of_one[ks]
            self.own.append(Absorbed.by(rows[:, mine] * sd[ks[mine]]))
            place = np.full(len(unknowns), -1)
            place[ks] = np.arange(len(ks))
            common.append(np.where(place[shared] >= 0, rows[:, place[shared]], 0.0))
        self.shared = Absorbed.by(without(self.own, np.concatenate(common)) * FREE)
        return np.concatenate(out)

    @cached_property
    def signals(self) -> list[dict[str, np.ndarray | float]]:
        """Return by recording every name with its value or its values (N,) along the run.

        The names are those of the plant, and of columns that it does not read."""
        runs = zip(self.plain.case.columns, self.drives, self.fit.values, self.runs, strict=True)
        return [{**columns, **signals(self.model, d, values, run.x)} for columns, d, values, run in runs]

    def project(self, d: np.ndarray) -> np.ndarray:
        """Return directions (rows, ...) without the part that the plant's own unknowns absorb."""
        return self.shared.without(without(self.own, d))

    def pulled(self, w: np.ndarray) -> np.ndarray:
        """Return the transpose of `project`, applied to rows w (rows, ...): w' project(d) = pulled(w)' d."""
        return without(self.own, self.shared.without(w))

    def responses(self, pushed: Callable[[int], Pushed], count: int) -> np.ndarray:
        """Return the rows (rows, count), not whitened, of the responses in all recordings.

        `pushed`: returns the first-order changes in recording r. `count`: number of columns."""
        plain = self.plain

        def response(r: int, values: np.ndarray, dx0: np.ndarray) -> np.ndarray:
            """Return the rows of one recording."""
            d, changes, buffers = self.drives[r], pushed(r), plain.problem.buffers
            dy = (
                self.model.respond(d, values, dx0, changes.forces, changes.q, count, buffers=buffers)
                if changes.forces
                else np.zeros((*d.y.shape, count))
            )
            for (j, c), delta in changes.read.items():
                dy[:, j, c] += delta
            return transforms(plain.channels[r], dy)

        size = 1 + count // (1 + len(self.model.unknowns))
        return np.concatenate(plain.problem.each(response, plain.point, size))

    def spread(self, r: int, w: np.ndarray) -> np.ndarray:
        """Apply the transpose of `transforms` to rows w (rows, k): return (N, outputs, k) of recording r."""
        d, begin = self.drives[r], 0
        out = np.zeros((*d.y.shape, w.shape[1]))
        for c in self.plain.coordinates.channels:
            if c.recording == r:
                out[:, c.output] += self.plain.coordinates.transposed(c, w[begin : begin + c.rows], len(d.t))
            begin += c.rows
        return out

    def rows(self, r: int, e: np.ndarray) -> np.ndarray:
        """Transform samples (N, outputs, ...) of recording r to whitened rows (rows, ...)."""
        channels = zip(self.plain.coordinates.channels, self.weights, strict=True)
        weight = np.concatenate([w for c, w in channels if c.recording == r])
        x = transforms(self.plain.channels[r], e)
        return x * weight.reshape(-1, *([1] * (x.ndim - 1)))

    def weighed(self, rows: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log likelihood of other rows minus that of the residual, and new weights (rows,).

        Rows are whitened; noise and remainder are averaged. The weights whiten in the noise that the other
        rows imply, and are given as multiples of the metric's weights."""
        above, inverse = self.around.weighed(self.powers(rows))
        channels = zip(self.plain.coordinates.channels, inverse, strict=True)
        return above, np.concatenate([np.sqrt(v)[c.band] for c, v in channels]) / self.weight

    def powers(self, rows: np.ndarray) -> list[np.ndarray]:
        """Return the powers, not whitened, of whitened rows (rows,) by channel."""
        edges = np.cumsum([len(w) for w in self.weights])[:-1]
        plain = [x / w for x, w in zip(np.split(rows, edges), self.weights, strict=True)]
        return self.plain.coordinates.powers(plain)


def _weights(case: Case, average: Averaged, coordinates: Coordinates, remainder: bool) -> list[np.ndarray]:
    """Return one over the standard deviation of each row (rows,), by channel."""
    inverse = average.inverse
    if not remainder:
        own = {k: v for g, v in zip(case.grids, average.sensor, strict=True) for k in g.channels}
        inverse = [np.full_like(v, 1 / own[k]) for k, v in enumerate(inverse)]
    positions = {(c.recording, c.output): k for k, c in enumerate(case.coordinates.channels)}
    out = []
    for c in coordinates.channels:
        k = positions[c.recording, c.output]
        v = np.interp(np.log(c.frequency), np.log(case.coordinates.channels[k].frequency), np.log(inverse[k]))
        out.append(np.exp(0.5 * v)[c.band])
    return out
