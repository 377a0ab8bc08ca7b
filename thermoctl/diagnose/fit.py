"""A hypothesis refitted, and its log evidence by Laplace's method.

    log p(D | h) ~ log p(D | z^) + log p(z^) + k/2 log 2 pi - 1/2 log |H|

    H = J' E[1/V] J + prior's precision

z: parameters of plant and effects, 0..1 in their ranges, and initial states in their standard deviations.
The scale is logarithmic where a range spans a factor of three. log p(D | z) is averaged over noise and
remainder (noise.py). Gauss-Newton steps find its maximum; with the weights E[1/V] their gradient is exact.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from thermoctl.diagnose.candidates import Candidate
from thermoctl.diagnose.case import Case
from thermoctl.diagnose.catalogue import EffectParameter
from thermoctl.diagnose.coordinates import Coordinates
from thermoctl.diagnose.memory import Past, PlacedBefore
from thermoctl.diagnose.noise import Averaged, Grid, averaged
from thermoctl.plant import refit
from thermoctl.plant.cores import each
from thermoctl.plant.language import Plant
from thermoctl.plant.refit import Fit, Problem
from thermoctl.plant.residuals import HUGE, Evaluation
from thermoctl.plant.simulate import SimulationError, compile_plant

SIGNIFICANT = 2.0  # standard deviations
BELIEF = 0.3  # prior sd of a plant parameter about its value in the file, as a share of its range
UNIFORM = 12.0  # precision of a uniform prior over 0..1
PERIODS = 15.0  # times the range that a refit gives a period that it could have had (logarithms)
DECADES = 4.0  # width of the log-uniform prior of an effect's size
WHITE, ROUGH = 12, 0.1  # iterations and tolerance of the refit in white noise that the climb starts from
ROUNDS = 15  # largest number of Gauss-Newton steps
LENGTHS = 1.0, 0.3, 0.1  # shares of a Newton step that are tried, in this order
SHARE = 0.01  # of an effect's size, from which the first step towards it is taken
FAR = 8.0  # standard deviations that a start may be off
HOPELESS = 50.0  # a refit ends early if it would stay this many nats below the best hypothesis
MOST = 0.9  # of a curvature that not knowing the spectrum may take
ENOUGH = 0.05  # gain in the log posterior, below which no further step is taken
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Placed:
    """An effect at a place, and the parameters that it adds to the plant."""

    candidate: Candidate
    own: Mapping[str, str]  # its parameter: the plant's name

    @property
    def key(self) -> tuple[str, str]:
        """Return (name of the effect, name of its place): the key of the placed effect."""
        return self.candidate.key


@dataclass(frozen=True)
class Hypothesis:
    """The placed effects that are assumed to be missing. Every hypothesis holds a remainder besides."""

    effects: tuple[Placed, ...] = ()

    @property
    def keys(self) -> frozenset[tuple[str, str]]:
        """The (effect, where) of each."""
        return frozenset(e.key for e in self.effects)


@dataclass(frozen=True)
class Fitted:
    """A hypothesis after its refit."""

    hypothesis: Hypothesis
    plant: Plant
    fit: Fit
    log_likelihood: float
    log_prior: float
    volume: float  # k/2 log 2 pi - 1/2 log |H|
    average: Averaged
    powers: tuple[np.ndarray, ...]
    sd: Mapping[str, float]  # of the effects' parameters
    rough_plant: Plant
    rough: Fit  # refit in white noise, whose free run is closest to the data: extensions start there
    curvature: np.ndarray  # H
    past: Past  # of earlier recordings

    @property
    def absent(self) -> bool:
        """Return whether a whole effect is not significant."""
        return any(_insignificant(self, e, all) for e in self.hypothesis.effects)

    @property
    def doubtful(self) -> bool:
        """Return whether a part of an effect is not significant: a simpler hypothesis may replace it."""
        return any(
            _insignificant(self, e, any)
            or any(
                p.at_zero and p.name in e.own and _near_null(self, e, p)
                for p in e.candidate.effect.parameters
            )
            for e in self.hypothesis.effects
        )

    @property
    def log_evidence(self) -> float:
        """Log p(D | h)"""
        return self.log_likelihood + self.log_prior + self.volume + self.past.log_evidence


def _insignificant(f: Fitted, e: Placed, which: Callable[[Iterable[bool]], bool]) -> bool:
    """Return whether any, or all, amplitudes of the effect are within SIGNIFICANT sd of no effect.

    For an effect without an amplitude (lag, delay): whether a parameter is at its lower bound.
    A period at its upper bound does not repeat in the recordings: that is no periodic effect."""
    sizes = [p for p in e.candidate.effect.parameters if p.amplitude and p.name in e.own]
    if not set(e.own.values()) <= f.plant.parameters.keys():
        return True  # another effect took its place
    effect = e.candidate.effect
    periods = (e.own[p.name] for p in effect.parameters if effect.shapes.get(p.shape or "") == "periods")
    if any(f.fit.at_bound.get(n) == "high" for n in periods):
        return True
    if e.candidate.effect.prior is not None:
        return False
    if not sizes:
        return any(f.fit.at_bound.get(n) == "low" for n in e.own.values())
    return which(_near_null(f, e, p) for p in sizes)


def _near_null(f: Fitted, e: Placed, p: EffectParameter) -> bool:
    """Return whether a parameter is within SIGNIFICANT sd of the value at which it changes nothing."""
    own = e.own[p.name]
    return abs(f.plant.parameters[own].value - p.null) < SIGNIFICANT * f.sd[own]


class Posterior:
    """The log posterior of one hypothesis' parameters, and its Gauss-Newton steps."""

    def __init__(self, case: Case, plant: Plant, effects: Sequence[Placed]):
        self.case, self.plant, self.effects = case, plant, effects
        self.model = compile_plant(plant)
        self.drives = case.drives(self.model)
        for d in self.drives:
            self.model.prepare(d)
        self.problem = Problem(self.model, self.drives, case.noise)
        self.amplitudes, self.mean, precision = _priors(case, self.problem, effects)
        self.past = case.memory.of(frozenset(e.key for e in effects), plant)
        place = {q: k for k, (q, r) in enumerate(self.problem.unknowns) if r is None}
        self.shared = np.array([place[q] for q in self.past.unknowns], int)
        self.mean[self.shared], precision[self.shared] = self.past.z, 0.0
        self.precision = np.diag(precision)
        self.precision[np.ix_(self.shared, self.shared)] = self.past.precision
        beliefs = [b for e in effects for b in e.candidate.beliefs(plant)]
        self.problem.priors = tuple(beliefs)
        self.kept: tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]] | None = None

    def rows(self, e: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(N, outputs, ...) of each recording as rows of each channel."""
        c: Coordinates = self.case.coordinates
        return [c.transform(k, e[k.recording][:, k.output]) for k in c.channels]

    def likelihood(self, rows: Sequence[np.ndarray]) -> tuple[Averaged, list[np.ndarray]]:
        """The averaged likelihood of residuals' rows, and their powers."""
        powers = self.case.coordinates.powers(rows)
        return averaged(self.case.grids, powers), powers

    def errors(self, z: np.ndarray) -> list[np.ndarray]:
        """Free-run errors. Raises SimulationError."""
        values, dx0 = self.problem.unpack(z)
        out = each(
            lambda r: self.drives[r].y - self.model.run(self.drives[r], values[r], dx0[r]).y,
            range(len(self.drives)),
            self.problem.numbers,
        )
        self._check(out)
        return out

    def _check(self, errors: Sequence[np.ndarray]) -> None:
        if not all((abs(e[np.isfinite(d.y)]) < HUGE).all() for e, d in zip(errors, self.drives, strict=True)):
            raise SimulationError("the simulation gives values that are not numbers")

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Between which the unknowns lie."""
        n, m = self.problem.n_parameters, len(self.problem.unknowns)
        return np.concatenate([np.zeros(n), np.full(m - n, -FAR)]), np.concatenate(
            [np.ones(n), np.full(m - n, FAR)]
        )

    def prior(self, z: np.ndarray) -> float:
        """Return the log prior of the unknowns `z`, without the Gaussians' normalisation.

        It is the sum of the Gaussian priors and of the priors that the catalogue's entries state."""
        values, _ = self.problem.unpack(z)
        return (
            -0.5 * float((z - self.mean) @ self.precision @ (z - self.mean))
            - 0.5 * self.problem.prior_terms(values, False)[0]
        )

    def slopes(self, z: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return each channel's unknowns (k,), and the slopes of its rows by them (rows, k).

        The result is kept for the next call with the same z."""
        if self.kept is None or not np.array_equal(self.kept[0], z):
            self.errors_and_slopes(z)
        assert self.kept is not None
        return self.kept[1]

    def errors_and_slopes(self, z: np.ndarray) -> list[np.ndarray]:
        """Free-run errors; `slopes` are kept. One run costs less than two. Raises SimulationError."""
        by_recording = {
            r: list(channels)
            for r, channels in groupby(self.case.coordinates.channels, lambda c: c.recording)
        }

        def part(r: int) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
            unknown, y, jac = self.problem.jacobian(z, r)
            rows = [self.case.coordinates.transform(c, jac[:, c.output]) for c in by_recording.get(r, ())]
            return self.drives[r].y - y, [(unknown, x) for x in rows]

        parts = each(part, range(len(self.drives)), 2 * self.problem.numbers)
        errors, found = [e for e, _ in parts], [x for _, rows in parts for x in rows]
        self._check(errors)
        self.kept = z.copy(), found
        return errors

    def slope(
        self, z: np.ndarray, rows: Sequence[np.ndarray], inverse: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient of the log posterior, and minus its second derivative."""
        n = len(z)
        gradient, matrix = np.zeros(n), np.zeros((n, n))
        for c, (unknown, jac), weight, row in zip(
            self.case.coordinates.channels, self.slopes(z), inverse, rows, strict=True
        ):
            w = np.sqrt(weight[c.band])
            j = jac * w[:, None]
            gradient[unknown] += j.T @ (w * row)
            matrix[np.ix_(unknown, unknown)] += j.T @ j
        values, _ = self.problem.unpack(z)
        _, push, bend = self.problem.prior_terms(values, True)
        return gradient - self.precision @ (z - self.mean) - push, matrix + self.precision + bend

    def relief(self, z: np.ndarray, rows: Sequence[np.ndarray], average: Averaged) -> np.ndarray:
        """Return E[1/V] J'J minus the curvature: the gradient's variance over the unknown V (Louis 1982)."""
        out = np.zeros((len(z), len(z)))
        jacobians = self.slopes(z)
        for g, unsure in zip(self.case.grids, average.unsure, strict=True):
            pull = np.zeros((len(unsure), len(z)))
            at = 0
            for k in g.channels:
                c = self.case.coordinates.channels[k]
                unknown, jac = jacobians[k]
                node = g.node[at : at + len(c.count)]
                at += len(c.count)
                starts = np.cumsum(c.count) - c.count
                by_band = np.add.reduceat(jac * rows[k][:, None], starts, axis=0)
                np.add.at(pull, np.ix_(node, unknown), by_band)  # two bands may share a node
            out += pull.T @ unsure @ pull
        return out

    def climb(
        self, z: np.ndarray, goal: float
    ) -> tuple[np.ndarray, Averaged, list[np.ndarray], np.ndarray, list[np.ndarray]]:
        """Return z, likelihood, powers, H and errors at the maximum near z.

        Stop early if `goal` is out of reach."""
        low, high = self.bounds()
        errors = self.errors_and_slopes(z)
        rows = self.rows(errors)
        now, powers = self.likelihood(rows)
        gradient, matrix = self.slope(z, rows, now.inverse)
        for left in range(ROUNDS, 0, -1):
            base = now.log_likelihood + self.prior(z)
            step, gained, here = _step(z, gradient, matrix, low, high), 0.0, self.kept
            for length in LENGTHS:
                trial = np.clip(z + length * step, low, high)
                try:
                    at_once = self.problem.few and length == LENGTHS[0]
                    e = self.errors_and_slopes(trial) if at_once else self.errors(trial)
                except SimulationError:
                    continue
                trial_rows = self.rows(e)
                then, trial_powers = self.likelihood(trial_rows)
                gained = then.log_likelihood + self.prior(trial) - base
                if gained > 0:
                    z, errors, rows, now, powers = trial, e, trial_rows, then, trial_powers
                    gradient, matrix = self.slope(z, rows, now.inverse)
                    break
                self.kept = here
            if gained < ENOUGH or now.log_likelihood + left * gained < goal:
                break
        return z, now, powers, matrix, errors


def _step(
    z: np.ndarray, gradient: np.ndarray, matrix: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return Newton's step inside the bounds; a coordinate that reaches its bound stays there."""
    free = ~(((z <= low) & (gradient < 0)) | ((z >= high) & (gradient > 0)))
    step = np.zeros_like(z)
    for _ in range(len(z)):
        index = np.flatnonzero(free)
        if not len(index):
            break
        rest = np.flatnonzero(~free)
        right = gradient[index] - matrix[np.ix_(index, rest)] @ step[rest]
        step[index] = np.linalg.solve(
            matrix[np.ix_(index, index)] + 1e-9 * np.diag(np.diag(matrix)[index]), right
        )
        out = index[
            (z[index] + step[index] < low[index] - 1e-12) | (z[index] + step[index] > high[index] + 1e-12)
        ]
        if not len(out):
            break
        step[out] = np.clip(z[out] + step[out], low[out], high[out]) - z[out]
        free[out] = False
    return step


def _priors(
    case: Case, problem: Problem, effects: Sequence[Placed]
) -> tuple[dict[int, tuple[Candidate, EffectParameter]], np.ndarray, np.ndarray]:
    """Which unknowns are sizes of effects, and every unknown's prior mean and precision as a Gaussian."""
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
            mean[k], precision[k] = 0.5, 1e-6 if c.effect.prior is not None else 1e-4
            if p.amplitude:
                sizes[k] = own[q]
        elif q in case.plant.parameters:
            mean[k] = problem.scales[q].z(case.plant.parameters[q].value)
    return sizes, mean, precision


def fitted(
    case: Case,
    plant: Plant,
    effects: Sequence[Placed],
    start: Fit | None = None,
    best: Fitted | None = None,
    parent: float = np.inf,
) -> Fitted:
    """Refit a plant that holds these effects and compute its log evidence. Raises SimulationError.

    The refit ends early if it stays far from `best`, the best hypothesis so far. `parent`: the cost before
    the last effect was added."""
    case.budget.spend()
    posterior = Posterior(case, plant, effects)
    if start is None:
        start = refit.fit(
            posterior.model,
            posterior.drives,
            case.noise,
            start=_led(posterior, parent),
            iterations=WHITE,
            tolerance=ROUGH,
            goal=best.rough.cost if best else np.inf,
            priors=posterior.problem.priors,
            seconds=np.inf,
        )
    goal = best.log_likelihood - HOPELESS if best else -np.inf
    z = start.z.copy()
    z[posterior.shared] = posterior.past.z
    z, average, powers, matrix, errors = posterior.climb(z, goal)
    return _weighed(case, posterior, z, average, powers, matrix, errors, start)


def _led(posterior: Posterior, parent: float) -> np.ndarray:
    """Return the unknowns from which a refit starts: the effects at full size, if these improve the fit.

    The plant's own parameters may have imitated the effect. Then its full size gives a cost above `parent`,
    that of the refit without it. In that case one Gauss-Newton step is taken from a small share of the
    effect. Sizes and the plant's parameters change in this step, shapes do not. Of the three points the one
    with the least cost is the start."""
    problem = posterior.problem
    full = problem.start({})
    costs = [_cost(problem, full)]
    plant = posterior.plant.parameters
    names = {problem.unknowns[k][0]: p for k, (_, p) in posterior.amplitudes.items()}
    if costs[0] < parent or not names:
        return full
    small = problem.start({q: p.null + SHARE * (plant[q].value - p.null) for q, p in names.items()})
    own = {n for e in posterior.effects for n in e.own.values()}
    free = np.array([k for k, (q, _) in enumerate(problem.unknowns) if q not in own or q in names])
    try:
        led = _along_values(posterior, small, problem.evaluate(small, True), free)
    except SimulationError:
        return full
    starts = [full, small, led]
    costs += [_cost(problem, small), _cost(problem, led)]
    return starts[int(np.argmin(costs))]


def _cost(problem: Problem, z: np.ndarray) -> float:
    try:
        return problem.evaluate(z, False).cost
    except SimulationError:
        return float("inf")


def _along_values(posterior: Posterior, z: np.ndarray, now: Evaluation, free: np.ndarray) -> np.ndarray:
    """Return z after one Gauss-Newton step of the unknowns `free`, straight in the values of the parameters.

    A parameter that an effect replaces goes towards zero. Its logarithmic scale would bend that path."""
    problem = posterior.problem
    values, _ = problem.unpack(z)
    low, high = (bound - z for bound in posterior.bounds())
    at, slope = z.copy(), np.ones(len(z))
    for k, (q, r) in enumerate(problem.unknowns[: problem.n_parameters]):
        scale = problem.scales[q]
        at[k] = float(values[r or 0, posterior.model.parameters.index(q)])
        slope[k] = scale.slope(at[k])
        low[k], high[k] = (scale.low - at[k]) / slope[k], (scale.high - at[k]) / slope[k]
    zero = np.zeros(len(free))
    step = _step(zero, now.gradient[free], now.matrix[np.ix_(free, free)], low[free], high[free])
    out = z.copy()
    for k, change in zip(free, step, strict=True):
        if k < problem.n_parameters:
            scale = problem.scales[problem.unknowns[k][0]]
            out[k] = scale.z(float(np.clip(at[k] + slope[k] * change, scale.low, scale.high)))
        else:
            out[k] = z[k] + change
    return out


def _weighed(
    case: Case,
    posterior: Posterior,
    z: np.ndarray,
    average: Averaged,
    powers: list[np.ndarray],
    matrix: np.ndarray,
    errors: list[np.ndarray],
    rough: Fit,
) -> Fitted:
    """Laplace's evidence at the maximum."""
    problem = posterior.problem
    values, dx0 = problem.unpack(z)
    own = np.ones(len(z), bool)
    own[_gaussian(posterior)] = False
    confined = matrix + np.diag(np.where(own, UNIFORM, 0.0))  # a range has a width
    confined = _relieved(confined, posterior.relief(z, posterior.rows(errors), average))
    inverse = np.linalg.pinv(confined, hermitian=True)
    sd = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    names: dict[str, float] = {}
    for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        slope = problem.scales[q].slope(float(values[0, posterior.model.parameters.index(q)]))
        if q not in case.plant.parameters:
            names[q] = max(names.get(q, 0.0), float(sd[k] * slope))
    log_prior = log_density(posterior, z, names)
    volume = 0.5 * len(z) * LOG_2PI - 0.5 * float(np.linalg.slogdet(confined)[1])
    at_bound = {
        q: "low" if z[k] <= 1e-6 else "high"
        for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters])
        if z[k] <= 1e-6 or z[k] >= 1 - 1e-6
    }
    found = Fit(
        posterior.model,
        values,
        dx0,
        -2 * average.log_likelihood,
        problem.unknowns,
        z,
        matrix,
        errors,
        case.noise,
        0,
        problem.samples,
        at_bound,
        problem.priors,
    )
    plant = refit.updated(posterior.plant, found, posterior.drives)
    return Fitted(
        Hypothesis(tuple(posterior.effects)),
        plant,
        found,
        average.log_likelihood,
        float(log_prior),
        volume,
        average,
        tuple(powers),
        names,
        refit.updated(posterior.plant, rough, posterior.drives),
        rough,
        confined,
        posterior.past,
    )


def _relieved(matrix: np.ndarray, relief: np.ndarray) -> np.ndarray:
    """matrix - relief, where no direction loses more than MOST of its curvature."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    w, q = np.linalg.eigh(matrix / np.outer(size, size))
    root = q * np.sqrt(np.maximum(w, 1e-12))  # matrix = size root root' size
    inner = np.linalg.solve(root, (relief / np.outer(size, size))) @ np.linalg.inv(root).T
    share, p = np.linalg.eigh(0.5 * (inner + inner.T))
    left = root @ (p * (1 - np.clip(share, 0.0, MOST))) @ p.T @ root.T
    return left * np.outer(size, size)


def remembered(case: Case, f: Fitted) -> Past:
    """Return what all recordings so far say of a hypothesis. Own initial states are eliminated."""
    unknowns, h = f.fit.unknowns, f.curvature
    shared = np.array([k for k, (_, r) in enumerate(unknowns) if r is None], int)
    own = np.array([k for k, (_, r) in enumerate(unknowns) if r is not None], int)
    absorbed = (
        h[np.ix_(shared, own)] @ np.linalg.pinv(h[np.ix_(own, own)], hermitian=True) @ h[np.ix_(own, shared)]
    )
    names = tuple(unknowns[k][0] for k in shared)
    at = [(case.null.model.outputs[case.coordinates.channels[g.channels[0]].output], g) for g in case.grids]
    return Past(
        placed_before(f.hypothesis.effects, f.plant),
        names,
        tuple(f.plant.parameters[q].range or (0.0, 0.0) for q in names),
        f.fit.z[shared],
        h[np.ix_(shared, shared)] - absorbed,
        f.log_evidence,
        {o: f.past.squares.get(o, 0.0) + sum(float(f.powers[k].sum()) for k in g.channels) for o, g in at},
        {o: f.past.counts.get(o, 0.0) + float(g.count.sum()) for o, g in at},
    )


def placed_before(effects: Sequence[Placed], plant: Plant) -> tuple[PlacedBefore, ...]:
    """Return the effects with the values and ranges that the plant has for them."""
    return tuple(
        PlacedBefore(
            e.key,
            e.candidate.label,
            {p: plant.parameters[n].value for p, n in e.own.items()},
            {p: r for p, n in e.own.items() if (r := plant.parameters[n].range)},
        )
        for e in effects
    )


def levels(case: Case, f: Fitted, clean: float) -> list[float]:
    """Return the standard deviation of each output's noise: the stated one, or more if that explains all.

    A stated noise may be wrong by one standard deviation of its prior. So variance that is present at all
    frequencies counts as noise up to there. The residual must then be within `clean` times this noise."""
    out = []
    for g in case.grids:
        lowest, at = np.inf, 0
        for k in g.channels:
            inverse = f.average.inverse[k]
            stated = g.variance * g.shape[g.node[at : at + len(inverse)]]
            lowest = min(lowest, float(np.min(1 / (inverse * stated))))
            at += len(inverse)
        level = g.sigma * float(np.sqrt(np.clip(lowest, 1.0, np.exp(g.known))))
        out.append(level if _rms(f, g) <= clean * level else g.sigma)
    return out


def over_noise(case: Case, f: Fitted, clean: float) -> list[float]:
    """Return the rms of each output's residuals over its noise (`levels`)."""
    return [_rms(f, g) / level for g, level in zip(case.grids, levels(case, f, clean), strict=True)]


def _rms(f: Fitted, g: Grid) -> float:
    return float(np.sqrt(sum(f.powers[k].sum() for k in g.channels) / g.count.sum()))


def as_refitted(case: Case, f: Fitted) -> Fitted:
    """The hypothesis as an ordinary refit in white noise leaves it, for comparison."""
    rows = [
        case.coordinates.transform(c, f.rough.residuals[c.recording][:, c.output])
        for c in case.coordinates.channels
    ]
    powers = case.coordinates.powers(rows)
    average = averaged(case.grids, powers)
    return dataclasses.replace(f, plant=f.rough_plant, fit=f.rough, powers=tuple(powers), average=average)


def log_density(posterior: Posterior, z: np.ndarray, sd: Mapping[str, float]) -> float:
    """Return log p(z): Gaussians, uniform shapes, and the effects' sizes with standard deviations `sd`."""
    values, _ = posterior.problem.unpack(z)
    normal = _gaussian(posterior)
    out = posterior.prior(z) + 0.5 * float(
        np.linalg.slogdet(posterior.precision[np.ix_(normal, normal)] / (2 * np.pi))[1]
    )
    for k, (c, p) in posterior.amplitudes.items():
        q = posterior.problem.unknowns[k][0]
        if c.effect.prior is None and k not in posterior.shared:
            value = float(values[0, posterior.model.parameters.index(q)])
            out += _size(p, value, sd[q]) + np.log(posterior.problem.scales[q].slope(value))
    new = [e for e in posterior.effects if e.key not in posterior.past.keys]
    periods = sum(kind == "periods" for e in new for kind in e.candidate.effect.shapes.values())
    return out - periods * float(np.log(PERIODS))


def evidence_at(posterior: Posterior, z: np.ndarray, found: Fitted) -> float:
    """Return log p(D | z) + log p(z), the integrand of `log_evidence`; sizes' sd are those of `found`."""
    return posterior.likelihood(posterior.rows(posterior.errors(z)))[0].log_likelihood + log_density(
        posterior, z, found.sd
    )


def _gaussian(posterior: Posterior) -> np.ndarray:
    """The unknowns whose prior is a Gaussian (those of effects have their own until recordings were seen)."""
    names = {n for e in posterior.effects for n in e.own.values()}
    return np.array(
        [k for k, (q, _) in enumerate(posterior.problem.unknowns) if q not in names or k in posterior.shared],
        int,
    )


def _size(p: EffectParameter, value: float, sd: float) -> float:
    """Return the log prior density of an effect's size: log-uniform over DECADES decades.

    Below its standard deviation the density is nearly constant."""
    one_sided = p.low >= p.null or p.high <= p.null
    return -float(np.log(np.log(10.0) * DECADES * (1 if one_sided else 2) * np.hypot(value - p.null, sd)))
