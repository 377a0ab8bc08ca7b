"""The log posterior of one hypothesis' parameters, and its maximum.

    log p(z | D) = log p(D | z) + log p(z) + constant

log p(D | z) is averaged over noise and remainder (noise.py). climb.py finds its maximum; with the
weights E[1/V] the gradient is exact. Gradient and curvature are sums over recordings: one recording at a time
is simulated, and its sums are added.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.data.coordinates import Channel, rows_of_each, transform
from thermoctl.diagnosis.evidence.noise import Averaged, averaged
from thermoctl.diagnosis.hypothesis.candidates import Candidate, Key, Keys
from thermoctl.diagnosis.hypothesis.effect import EffectParameter
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.climb import Climbed, Spot, climb
from thermoctl.plant.fitting.residuals import HUGE, PROBE, Problem
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant

BELIEF = 0.3  # prior sd of a plant parameter about its value in the file, as a share of its range
ROUNDS = 40  # largest number of steps
ENOUGH = 0.05  # nats: the climb ends when a step promises a smaller rise of the log posterior


@dataclass(frozen=True)
class Placed:
    """An effect at a place, and the parameters that it adds to the plant."""

    candidate: Candidate
    own: Mapping[str, str]  # by parameter of the effect, its name in the plant

    @property
    def key(self) -> Key:
        """Return (name of the effect, name of its place): the key of the placed effect."""
        return self.candidate.key

    @property
    def log_odds(self) -> float | None:
        """Return its log prior odds where it is not of the catalogue (a law), else None."""
        return None


@dataclass(frozen=True)
class Hypothesis:
    """The placed effects that are assumed to be missing. Every hypothesis holds a remainder besides."""

    effects: tuple[Placed, ...] = ()

    @property
    def keys(self) -> Keys:
        """The key (effect, place) of each effect."""
        return frozenset(e.key for e in self.effects)


# z; and for each recording its unknowns (k,) and its channels' slopes (rows, k) at z
Slopes = tuple[np.ndarray, list[tuple[np.ndarray, list[np.ndarray]]]]


@dataclass(frozen=True)
class Seen:
    """A point: free-run errors, their DCT rows, likelihood and powers, and slopes if they were computed."""

    errors: list[np.ndarray]
    rows: list[np.ndarray]
    average: Averaged
    powers: list[np.ndarray]
    slopes: Slopes | None


@dataclass(frozen=True)
class Sums:
    """One recording's share of gradient and curvature of the log likelihood, by its unknowns (k,).

    - `gradient` (k,), `matrix` (k, k): J' E[1/V] R and J' E[1/V] J
    - `by_band`: for each channel, J' R in each band (bands, k); empty unless `relief` asks for it"""

    unknowns: np.ndarray
    gradient: np.ndarray
    matrix: np.ndarray
    by_band: list[np.ndarray]


def _slope_rows(c: Channel, dy: np.ndarray, used: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return a channel's slopes (rows, k) by its unknowns, from those of all outputs (N, outputs, q)."""
    own = dy[:, c.output]
    rows = transform(c, own if len(used) == own.shape[1] else own[:, used])
    rows *= slope
    return rows


def _sums(
    channels: Sequence[Channel],
    unknowns: np.ndarray,
    slopes: Iterable[np.ndarray],
    rows: Sequence[np.ndarray],
    inverse: Sequence[np.ndarray],
    bands: bool,
) -> Sums:
    """Return a recording's sums from its channels' slopes, residuals' rows and weights of bands.

    `bands`: are sums by band needed, too?"""
    k = len(unknowns)
    gradient, matrix, by_band = np.zeros(k), np.zeros((k, k)), []
    for c, jac, row, weight in zip(channels, slopes, rows, inverse, strict=True):
        w = np.sqrt(weight[c.band])
        j = jac * w[:, None]
        gradient += j.T @ (w * row)
        with np.errstate(over="ignore", invalid="ignore"):  # the sensitivities of a run away from the data
            matrix += j.T @ j
        if bands:
            starts = np.cumsum(c.count) - c.count
            by_band.append(np.add.reduceat(jac * row[:, None], starts, axis=0))
    return Sums(unknowns, gradient, matrix, by_band)


class Posterior:
    """The log posterior of one hypothesis' parameters, and its Gauss-Newton steps."""

    def __init__(self, case: Case, plant: Plant, effects: Sequence[Placed]):
        self.case, self.plant, self.effects = case, plant, effects
        self.model = compile_plant(plant)
        self.drives = case.drives(self.model)
        for d in self.drives:
            self.model.prepare(d)
        self.problem = Problem(self.model, self.drives, case.noise)
        self.few = self.problem.few
        self.bounds = self.problem.bounds
        self.sizes, self.mean, precision = _priors(case, self.problem, effects)
        self.past = case.memory.of(frozenset(e.key for e in effects), plant)
        place = {q: k for k, (q, r) in enumerate(self.problem.unknowns) if r is None}
        self.shared = np.array([place[q] for q in self.past.unknowns], int)
        self.mean[self.shared], precision[self.shared] = self.past.z, 0.0
        self.precision = np.diag(precision)
        for k, behind in _behind(case, self.problem, plant):
            self.precision += np.outer(behind, behind)
            self.precision[k, k] -= 1.0
        self.precision[np.ix_(self.shared, self.shared)] = self.past.precision
        beliefs = [b for e in effects for b in e.candidate.beliefs(plant)]
        self.problem.priors = tuple(beliefs)
        # the unknowns (k,) that the catalogue gives a prior of their own
        stated = self.problem.prior_terms(self.problem.unpack(self.problem.z_plant)[0], True)[2]
        self.believed = np.setdiff1d(np.flatnonzero(stated.any(axis=0)), self.shared)
        coordinates = case.coordinates
        self.channels = [coordinates.of_recording(r) for r in range(len(self.drives))]
        self.kept: Slopes | None = None

    def rows(self, e: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Transform samples (N, outputs, ...) of each recording to DCT rows (rows, ...) of each channel."""
        return [
            x for channels, part in zip(self.channels, e, strict=True) for x in rows_of_each(channels, part)
        ]

    def likelihood(self, rows: Sequence[np.ndarray]) -> tuple[Averaged, list[np.ndarray]]:
        """Return the averaged likelihood of the residuals' DCT rows, and their powers by band."""
        powers = self.case.coordinates.powers(rows)
        return averaged(self.case.grids, powers), powers

    def errors(self, z: np.ndarray) -> list[np.ndarray]:
        """Return the free-run errors at z (N, outputs) by recording. Raises SimulationError."""
        return self._checked(self.problem.each(self.problem.errors, self.problem.unpack(z), 1))

    def _checked(self, errors: list[np.ndarray]) -> list[np.ndarray]:
        if not all((abs(e[np.isfinite(d.y)]) < HUGE).all() for e, d in zip(errors, self.drives, strict=True)):
            raise SimulationError("the simulation gives values that are not numbers")
        return errors

    def prior(self, z: np.ndarray) -> float:
        """Return the log prior of the unknowns `z`, without the Gaussians' normalisation.

        It is the sum of the Gaussian priors and of the priors that the catalogue's entries state."""
        values, _ = self.problem.unpack(z)
        return (
            -0.5 * float((z - self.mean) @ self.precision @ (z - self.mean))
            - 0.5 * self.problem.prior_terms(values, False)[0]
        )

    def errors_and_slopes(self, z: np.ndarray) -> list[np.ndarray]:
        """Return the free-run errors, and keep the slopes for `sums` if they are not too many.

        One run for both costs less than two. Raises SimulationError."""
        if not self.problem.keeps:
            return self.errors(z)
        parts = self.problem.each(self._slopes, self.problem.unpack(z), 2)
        errors = self._checked([e for e, _, _ in parts])
        self.kept = z.copy(), [(unknowns, slopes) for _, unknowns, slopes in parts]
        return errors

    def _slopes(
        self, r: int, values: np.ndarray, dx0: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return a recording's free-run errors, its unknowns (k,) and its channels' slopes (rows, k)."""
        d, buffers = self.drives[r], self.problem.buffers
        run = self.model.run(d, values, dx0, sensitivities=True, buffers=buffers, states=False)
        used, unknowns, slope = self.problem.slopes(r, values)
        rows = [_slope_rows(c, run.sensitivities, used, slope) for c in self.channels[r]]
        return d.y - run.y, unknowns, rows

    def sums(
        self, z: np.ndarray, rows: Sequence[np.ndarray], inverse: Sequence[np.ndarray], bands: bool = False
    ) -> Sequence[Sums]:
        """Return each recording's share of gradient and curvature.

        `rows`, `inverse`: the residuals' rows at z and the weights of their bands, by channel. `bands`: with
        the sums by band."""
        data, begin = [], 0
        for channels in self.channels:
            end = begin + len(channels)
            data.append((rows[begin:end], inverse[begin:end]))
            begin = end
        if not self.problem.keeps:

            def simulated(r: int, values: np.ndarray, dx0: np.ndarray) -> Sums:
                """Return the sums of a recording whose slopes are not kept."""
                run = self.model.run(self.drives[r], values, dx0, sensitivities=True, states=False)
                used, unknowns, slope = self.problem.slopes(r, values)
                dy = run.sensitivities  # copied one channel at a time: a recording has megabytes
                slopes = (_slope_rows(c, dy, used, slope) for c in self.channels[r])
                return _sums(self.channels[r], unknowns, slopes, *data[r], bands)

            return self.problem.each(simulated, self.problem.unpack(z), 2)
        if self.kept is None or not np.array_equal(self.kept[0], z):
            self.errors_and_slopes(z)
        assert self.kept is not None
        parts = zip(self.channels, self.kept[1], data, strict=True)
        return [_sums(c, *slopes, *d, bands) for c, slopes, d in parts]

    def slope(
        self, z: np.ndarray, rows: Sequence[np.ndarray], inverse: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradient (k,) of the log posterior at z, and minus its second derivative (k, k)."""
        n = len(z)
        gradient, matrix = np.zeros(n), np.zeros((n, n))
        for s in self.sums(z, rows, inverse):
            gradient[s.unknowns] += s.gradient
            matrix[np.ix_(s.unknowns, s.unknowns)] += s.matrix
        values, _ = self.problem.unpack(z)
        _, push, bend = self.problem.prior_terms(values, True)
        return gradient - self.precision @ (z - self.mean) - push, matrix + self.precision + bend

    def relief(self, z: np.ndarray, rows: Sequence[np.ndarray], average: Averaged) -> np.ndarray:
        """Return the curvature that is lost because V is not known: the gradient's variance (Louis 1982)."""
        out = np.zeros((len(z), len(z)))
        sums = self.sums(z, rows, average.inverse, True)
        by_band = [(s.unknowns, x) for s in sums for x in s.by_band]
        powers = self.case.coordinates.powers(rows)
        for g, unsure in zip(self.case.grids, averaged(self.case.grids, powers, True).unsure, strict=True):
            pull = np.zeros((len(unsure), len(z)))
            begin = 0
            for k in g.channels:
                unknowns, x = by_band[k]
                nodes = g.node[begin : begin + len(x)]
                np.add.at(pull, np.ix_(nodes, unknowns), x)  # two bands may share a node
                begin += len(x)
            out += pull.T @ unsure @ pull
        return out

    def look(self, z: np.ndarray, slopes: bool) -> Spot[Seen]:
        """Return the point z with its log posterior, and with slopes if asked for."""
        kept = self.kept
        errors = self.errors_and_slopes(z) if slopes else self.errors(z)
        slopes_here, self.kept = self.kept if slopes else None, kept
        rows = self.rows(errors)
        average, powers = self.likelihood(rows)
        return Spot(
            z, average.log_likelihood + self.prior(z), Seen(errors, rows, average, powers, slopes_here)
        )

    def stand(self, spot: Spot[Seen]) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and minus the second derivative of the log posterior."""
        self.kept = spot.found.slopes
        return self.slope(spot.z, spot.found.rows, spot.found.average.inverse)

    def bend(self, spot: Spot[Seen], step: np.ndarray) -> np.ndarray:
        """Return the second-order change of the residuals along a step, projected on their slopes (k,).

        The weights are E[1/V] of the spot. Zeros if slopes are too many to keep."""
        out = np.zeros_like(step)
        if self.kept is None:
            return out
        moved = self.rows(self.errors(spot.z + PROBE * step))
        channels, seen, position = self.case.coordinates.channels, spot.found, 0
        for unknowns, slopes in self.kept[1]:
            for jac in slopes:
                second = (moved[position] - seen.rows[position]) / PROBE + jac @ step[unknowns]
                np.add.at(
                    out, unknowns, jac.T @ (seen.average.inverse[position][channels[position].band] * second)
                )
                position += 1
        return out * (2 / PROBE)

    def climb(self, z: np.ndarray, goal: float) -> Climbed[Seen]:
        """Return the maximum near z. Stop early if `goal`, a log likelihood, is out of reach."""
        return climb(self, z, ROUNDS, lambda height: ENOUGH, goal)


def _priors(
    case: Case, problem: Problem, effects: Sequence[Placed]
) -> tuple[dict[int, tuple[Candidate, EffectParameter]], np.ndarray, np.ndarray]:
    """Return the unknowns that are sizes of effects, and the mean and precision of every Gaussian prior.

    The delay of an effect is a size, too."""
    mean, precision = problem.z_plant.copy(), np.ones(len(problem.unknowns))
    own = {
        e.own[p.name]: (e.candidate, p)
        for e in effects
        for p in e.candidate.effect.parameters
        if p.name in e.own
    }
    sizes = {}
    for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        precision[k] = BELIEF**-2
        if q in own:
            c, p = own[q]
            stated = c.effect.prior is not None and p.name in ex.names(c.effect.prior)
            precision[k] = 1e-6 if stated else 1e-4  # about where the refit starts
            if (p.amplitude or c.effect.shapes.get(p.shape or "") == "delays") and not stated:
                sizes[k] = own[q]
        elif q in case.plant.parameters:
            mean[k] = problem.scales[q].z(case.plant.parameters[q].value)
    return sizes, mean, precision


def _behind(case: Case, problem: Problem, plant: Plant) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the start of each slow sensor that an effect added, and by how much it is behind at the start.

    The first is an unknown. The second is a row (unknowns,): the true value less the reading, over its
    standard deviation. In the sensor's time constant the true value changes by about that time times its
    typical slope."""
    place = {u: k for k, u in enumerate(problem.unknowns)}
    values = {q: p.value for q, p in plant.parameters.items()}
    interval = float(np.median(np.diff(problem.excitations[0].t)))
    for g in case.grids:
        read = ex.names(plant.outputs[g.output].value) & plant.nodes.keys()
        sensor = min(read - case.plant.nodes.keys(), default="")
        rates = [ex.undelayed(f.rate) for f in plant.flows.values() if f.target == sensor]
        if len(read) != 1 or len(rates) != 1:
            continue
        storage = plant.nodes[sensor].storage
        slopes = {n: ex.derivative(rates[0], n) for n in ex.names(rates[0]) & plant.nodes.keys()}
        if not all(ex.names(s) <= values.keys() for s in (storage, *slopes.values())):
            continue
        change = g.change * g.block**1.5 / interval * float(ex.evaluate(storage, values))
        if change <= 0:  # a true value at rest says nothing about how far the sensor is behind
            continue
        for r in range(len(problem.excitations)):
            row = np.zeros(len(place))
            for n, slope in slopes.items():
                if (k := place.get((f"{n} at the start", r))) is not None:
                    sigma = problem.sigma0[k - problem.n_parameters]
                    row[k] = float(ex.evaluate(slope, values)) * sigma / change
            if (k := place.get((f"{sensor} at the start", r))) is not None:
                yield k, row


def gaussian(posterior: Posterior) -> np.ndarray:
    """Return the unknowns with a Gaussian prior: the plant's, and those from earlier recordings."""
    names = {n for e in posterior.effects for n in e.own.values()}
    return np.array(
        [k for k, (q, _) in enumerate(posterior.problem.unknowns) if q not in names or k in posterior.shared],
        int,
    )
