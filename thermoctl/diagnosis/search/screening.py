"""Score test of every catalogue entry at every place, given a fitted hypothesis, its noise and remainder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.data.coordinates import Channel, Coordinates, transforms
from thermoctl.diagnosis.data.grids import grid
from thermoctl.diagnosis.evidence.fit import Fitted, as_refitted
from thermoctl.diagnosis.evidence.levels import over_noise
from thermoctl.diagnosis.evidence.noise import Around, Averaged
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.search.again import Known
from thermoctl.diagnosis.search.fine import above, fine
from thermoctl.diagnosis.search.gains import PLACES_EACH, Direction, foremost
from thermoctl.diagnosis.search.metric import Absorbed, Metric, Pushed, without
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import Keep, Norms, Select, ignored, screen
from thermoctl.diagnosis.search.sketch import likeliest
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.simulation.simulate import Simulation

ROWS = 6_000  # largest number of DCT rows, all outputs and recordings together
LOUD = 2.0  # residual's rms over the noise, from which energy is the better guide
FREE = 1e4  # standard deviation that stands for no prior
PROMISED = 30  # number of directions whose gain in log likelihood is predicted
ROOM = 2  # largest number of places of one effect among them, over PLACES_EACH


class Plain:
    """DCT rows of a refitted hypothesis, not whitened: of its residual and of its sensitivities to z."""

    def __init__(self, case: Case, fitted: Fitted, most: int):
        self.case, self.fit, self.model = case, fitted.rough, fitted.rough.model
        self.drives = case.drives(self.model)
        self.problem = Problem(self.model, self.drives, case.noise)
        for d, values in zip(self.drives, self.fit.values, strict=True):
            self.model.prepare(d, values)
        self.coordinates = Coordinates(self.drives, max(most // len(case.coordinates.channels), 32))
        measured = self.coordinates.by_output().values()
        self.grids = [
            grid(self.coordinates, ks, g.sigma, g.swing, g.change, g.sensor, g.block)
            for ks, g in zip(measured, case.grids, strict=True)
        ]
        self.channels = [self.coordinates.of_recording(r) for r in range(len(self.drives))]
        self.point = self.fit.values, self.fit.dx0
        parts = self.problem.each(_sensitive, self.point, lambda r: (self.channels[r],), 2)
        self.runs = [run for run, _, _ in parts]
        self.residual = np.concatenate([residual for _, residual, _ in parts])
        # By recording (rows, k), with respect to `unknowns`.
        self.sensitivities = [rows for *_, rows in parts]

    def unknowns(self, r: int) -> np.ndarray:
        """Return the unknowns of recording r."""
        return self.problem.columns[r, self.problem.columns[r] >= 0]

    def rows(self, r: int, e: np.ndarray) -> np.ndarray:
        """Transform samples (N, outputs, ...) of recording r to the DCT rows of all its channels."""
        return transforms(self.channels[r], e)


def _sensitive(
    problem: Problem, r: int, values: np.ndarray, dx0: np.ndarray, channels: Sequence[Channel]
) -> tuple[Simulation, np.ndarray, np.ndarray]:
    """Return a recording's run, and the DCT rows of its residual and of its sensitivities (rows, k)."""
    d = problem.excitations[r]
    run = problem.model.run(d, values, dx0, sensitivities=True, states=False)
    assert run.dy is not None
    used, _, slope = problem.slopes(r, values)
    rows = transforms(channels, run.dy[:, :, used]) * slope
    return Simulation(run.t, run.x, run.y), transforms(channels, d.y - run.y), rows


def _response(
    problem: Problem,
    r: int,
    values: np.ndarray,
    dx0: np.ndarray,
    channels: Sequence[Channel],
    pushed: Pushed,
    count: int,
) -> np.ndarray:
    """Return the rows of a recording's responses (rows, count) to first-order changes."""
    d, point = problem.excitations[r], (values, dx0)
    model, buffers = problem.model, problem.buffers
    dy = (
        model.respond(d, *point, pushed.forces, pushed.q, count, buffers=buffers)
        if pushed.forces
        else np.zeros((*d.y.shape, count))
    )
    for (j, c), delta in pushed.read.items():
        dy[:, j, c] += delta
    return transforms(channels, dy)


class Rows(Metric):
    """Whitened rows of a refitted hypothesis: DCT rows divided by the rms of their noise.

    `average`: spectra of the refit's residuals. `remainder`: is the remainder part of the noise? If so,
    errors at low frequencies have little weight. If not, the initial states are free, as in the refit in
    white noise."""

    def __init__(self, plain: Plain, average: Averaged, remainder: bool):
        self.plain, self.fit, self.model = plain, plain.fit, plain.model
        self.drives, self.runs = plain.drives, plain.runs
        self.weights = _weights(plain.case, average, plain.coordinates, remainder)
        self.weight = np.concatenate(self.weights)
        self.residual = self.project((plain.residual + self._absorb(remainder)) * self.weight)
        self.around = Around(plain.grids, self._powers(self.residual))

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

    def unweighted(self, r: int, e: np.ndarray) -> np.ndarray:
        """Transform samples (N, outputs, ...) of recording r to rows (rows, ...) that are not whitened."""
        return self.plain.rows(r, e)

    def responses(self, pushed: Callable[[int], Pushed], count: int) -> np.ndarray:
        """Return the rows (rows, count), not whitened, of the responses in all recordings."""
        plain = self.plain
        size = 1 + count // (1 + len(self.model.unknowns))
        return np.concatenate(
            plain.problem.each(_response, plain.point, lambda r: (plain.channels[r], pushed(r), count), size)
        )

    def spread(self, r: int, w: np.ndarray) -> np.ndarray:
        """Apply the transpose of `unweighted` to rows w (rows, k): return (N, outputs, k) of recording r."""
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
        x = self.unweighted(r, e)
        return x * weight.reshape(-1, *([1] * (x.ndim - 1)))

    def rise(self, rows: np.ndarray) -> Callable[[np.ndarray], float]:
        """Return a function of other rows: their log likelihood minus that of these rows.

        Rows are whitened, of all recordings; noise and remainder are averaged."""
        around = Around(self.plain.grids, self._powers(rows))
        return lambda others: around.rise(self._powers(others))

    def weighed(self, rows: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log likelihood of other rows minus that of the residual, and new weights (rows,).

        Rows are whitened; noise and remainder are averaged. The weights whiten in the noise that the other
        rows imply, and are given as multiples of the metric's weights."""
        above, inverse = self.around.weighed(self._powers(rows))
        channels = zip(self.plain.coordinates.channels, inverse, strict=True)
        return above, np.concatenate([np.sqrt(v)[c.band] for c, v in channels]) / self.weight

    def _powers(self, rows: np.ndarray) -> list[np.ndarray]:
        edges = np.cumsum([len(w) for w in self.weights])[:-1]
        plain = [x / w for x, w in zip(np.split(rows, edges), self.weights, strict=True)]
        return self.plain.coordinates.powers(plain)

    def promise(self, d: Direction) -> float:
        """Return the predicted gain in log likelihood of a first-order step along the direction."""
        if d.vector is None or d.gain <= 0:
            return 0.0
        v = d.vector.astype(float)
        return self.around.rise(self._powers(self.residual - v * (v @ self.residual)))


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


@dataclass(frozen=True)
class Screened:
    """The catalogue's best directions; `promises`: predicted gain in log likelihood of each.

    `energy`: the rows whitened by the sensors' noise alone; `by_energy`: all directions, sorted by their
    gain there. Where the plant has a large error, a first-order step predicts the log likelihood badly, and
    this gain in energy is a better guide. Both are empty where the residual is not LOUD. `norms`: of all
    columns; empty where not all were simulated."""

    metric: Rows
    rig: Rig
    directions: list[Direction]
    promises: list[float]
    energy: Rows | None
    by_energy: list[Direction]
    norms: list[Norms]


def screened(case: Case, fitted: Fitted, known: Known | None = None) -> Screened:
    """Screen the catalogue at the places of the original plant. Parts that an effect added are no places.

    Where the residual is far above the noise, screen a second time with that noise alone: by energy.
    `known`: the first screening, which fills it; a later one may simulate few directions (again.py)."""
    refitted = as_refitted(case, fitted)
    plain = Plain(case, fitted, ROWS)
    metric = Rows(plain, refitted.average, True)
    loud = max(over_noise(case, refitted)) > LOUD
    other = Rows(plain, refitted.average, False) if loud else None
    rig = Rig(fitted.rough_plant, metric.drives, [t.columns for t in case.tables])
    added = (fitted.plant.nodes.keys() | fitted.plant.flows.keys()) - (
        case.plant.nodes.keys() | case.plant.flows.keys()
    )
    placed = [
        c
        for c in candidates(rig, case.catalogue)
        if c.key not in fitted.hypothesis.keys and not c.place.parts() & added
    ]
    norms: list[Norms] = []
    metrics = [metric, other] if other else [metric]
    known = known or Known()
    select: Select = likeliest
    if known.count == 0:
        known.outputs = [run.y for run in metric.runs]
    elif other is None and known.like(metric):
        select = known.likeliest
    keep: Keep = ignored if known.count else known.add
    best, *rest = screen(metrics, rig, placed, select=select, norms=norms, keep=keep)
    promised = [(d, metric.promise(d)) for d in foremost(best, ROOM * PLACES_EACH)[:PROMISED]]
    by_energy = rest[0] if rest else []
    if other:
        again = [(d, other.promise(d)) for d in foremost(by_energy, ROOM * PLACES_EACH)[:PROMISED]]
        by_key = {d.candidate.key: promise for d, promise in promised}
        promised = [(d, p) for d, p in promised if p >= 0] + [
            (dataclasses.replace(d, vector=None), p)  # its vector is of another metric
            for d, p in again
            if p > by_key.get(d.candidate.key, 0.0)
        ]
    upper = above(case.coordinates, refitted.average.inverse, plain.coordinates)
    trajectories = [Trajectory(metric, rig, r) for r in range(len(metric.drives))] if upper else []
    picked = (d for c in placed for d in fine(metric, trajectories, c, upper))
    promised += [(d, 0.5 * d.gain - float(np.log(10)) * d.elsewhere) for d in picked]
    promised.sort(key=lambda x: -x[1])
    return Screened(metric, rig, [d for d, _ in promised], [p for _, p in promised], other, by_energy, norms)


def places(case: Case) -> dict[str, set[str]]:
    """Return the places where each effect fits the plant. They share the effect's prior odds."""
    drives = case.drives(case.null.model)
    rig = Rig(case.plant, drives, [t.columns for t in case.tables])
    out: dict[str, set[str]] = {}
    for c in candidates(rig, case.catalogue):
        out.setdefault(c.effect.name, set()).add(c.place.where)
    return out
