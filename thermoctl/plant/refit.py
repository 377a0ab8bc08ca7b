"""Refit of a plant's own parameters to recordings: bounded, weighted least squares on the free-run error.

    minimise  sum_k rho((e_k - phi e_(k-1)) / s)  +  sum (dx0 / initial_sigma)^2  +  w sum ((z - z_belief) / 1)^2
    e = y - yhat(p, x0 + dx0),  p inside its range,  per channel s^2 = sigma^2 (1 - phi^2) + resolution^2 / 12

phi is the channel's noise colour (AR(1), over one median sampling interval), rho Huber's function (outliers), z the
parameter's place in its range (0..1, on a log scale where the range spans a factor of three or more) and w a weight so
small that it decides only in flat directions; what else is believed of parameters (`Belief`) adds its own -2 log.
Gauss-Newton with Levenberg's damping on the normal equations and half the geodesic acceleration (Transtrum & Sethna 2012),

    (J'J + l D) v = J' r,    (J'J + l D) a = J' d2r/dh2 along v,    z <- z + v + a/2        r = (measured - simulated) / s, J = -dr/dz

a parameter that meets its bound is held there until the gradient leads back inside. Sensitivities are exact (compile.py).
"""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter

from thermoctl.plant import expression as ex
from thermoctl.plant.language import Parameter, Plant
from thermoctl.plant.simulate import Excitation, Model, SimulationError
from thermoctl.yamlfile import InputError

HUBER = 4.0  # residuals beyond this many sigmas count linearly
BELIEF_WEIGHT = 0.02  # a whole range away from the belief costs as much as a fiftieth of a sigma, once
PROBE = 0.1  # of a step, over which the curvature of the residuals is taken
HOPELESS = 20.0  # steps, each like the last three
ODD = 0.25  # share of rows up to which those that weigh less are taken off a product of all rows
BENT = 0.75  # geodesic acceleration over the step up to which it is believed


@dataclass(frozen=True)
class Noise:
    """One channel's noise: standard deviation, and its colour over one median sampling interval. With a filter ar(z)/ma(z)
    that turns it into white noise, `sigma` is that of the innovations."""

    sigma: float
    phi: float = 0.0
    ar: tuple[float, ...] = (1.0,)
    ma: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class Belief:
    """-2 log of how likely parameters' values are, whatever the data: an expression of the plant's parameters (their values in
    the recording of this name) that is nowhere concave."""

    recording: str
    surprise: ex.Expr


@dataclass
class Fit:
    """What a refit found. `values`: (recordings, parameters) in the model's order; `dx0`: (recordings, uncertain states);
    `covariance` by `unknowns` (name, recording index or None); `residuals`: per recording (N, outputs), NaN if missing."""

    model: Model
    values: np.ndarray
    dx0: np.ndarray
    cost: float
    unknowns: list[tuple[str, int | None]]
    z: np.ndarray
    hessian: np.ndarray
    residuals: list[np.ndarray]
    noise: tuple[Noise, ...]
    iterations: int
    samples: int
    at_bound: dict[str, str] = field(default_factory=dict)
    beliefs: tuple[Belief, ...] = ()
    believed: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # their share of the hessian

    def parameters(self, recording: int = 0) -> dict[str, float]:
        """All parameter values of one recording."""
        return dict(zip(self.model.parameters, map(float, self.values[recording]), strict=True))

    def rms(self) -> dict[str, float]:
        """Root-mean-square residual per output over all recordings."""
        stacked = np.concatenate(self.residuals)
        return {
            o: float(np.sqrt(np.nanmean(stacked[:, j] ** 2)))
            if np.isfinite(stacked[:, j]).any()
            else float("nan")
            for j, o in enumerate(self.model.outputs)
        }


class Scale:
    """A parameter's coordinate z in [0, 1] over its range."""

    def __init__(self, p: Parameter):
        assert p.range is not None
        self.low, self.high = p.range
        self.log = self.low > 0 and self.high >= 3 * self.low
        self.span = np.log(self.high / self.low) if self.log else self.high - self.low

    def z(self, value: float) -> float:
        """The fitted coordinate of a value."""
        return float(np.log(value / self.low) / self.span if self.log else (value - self.low) / self.span)

    def value(self, z: float) -> float:
        """The value of a fitted coordinate."""
        inside = min(max(z, 0.0), 1.0)
        raw = self.low * np.exp(inside * self.span) if self.log else self.low + inside * self.span
        return float(min(max(raw, self.low), self.high))

    def slope(self, value: float) -> float:
        """d value / d z."""
        return float(value * self.span if self.log else self.span)


def default_noise(plant: Plant, drives: Sequence[Excitation] = ()) -> tuple[Noise, ...]:
    """The plant's own figures; a channel without any gets its second differences' (white part)."""
    out = []
    for j, o in enumerate(plant.outputs.values()):
        sigma = np.hypot(o.noise or 0.0, (o.resolution or 0.0) / np.sqrt(12))
        if sigma <= 0:
            parts = [d.y[np.isfinite(d.y[:, j]), j] for d in drives]
            second = np.concatenate([np.diff(y, 2) for y in parts if len(y) > 3] or [np.zeros(1)])
            sigma = 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6)
            spread = max((float(np.ptp(y)) for y in parts if len(y)), default=1.0)
            sigma = max(sigma, 1e-4 * spread, 1e-12)
        out.append(Noise(float(sigma)))
    return tuple(out)


def _rows(d: Excitation, j: int, n: Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Output j's measured samples, their correlation with the one before, and what each innovation is uncertain by."""
    dt = float(np.median(np.diff(d.t))) if len(d.t) > 1 else 1.0
    index = np.flatnonzero(np.isfinite(d.y[:, j]))
    gaps = np.diff(d.t[index]) / dt if len(index) > 1 else np.zeros(0)
    phi = n.phi ** np.clip(gaps, 0.0, 1e4) if n.phi > 0 else np.zeros(len(gaps))
    scale = np.full(len(index), n.sigma)
    if len(index):
        scale[1:] = n.sigma * np.sqrt(np.maximum(1 - phi**2, 1e-9))
    return index, phi, scale


class Problem:
    """Residuals and Jacobian of a model on several recordings, in the metric of the noise."""

    def __init__(
        self,
        model: Model,
        drives: Sequence[Excitation],
        noise: Sequence[Noise],
        beliefs: Sequence[Belief] = (),
    ):
        self.model, self.drives, self.noise = model, list(drives), tuple(noise)
        self.beliefs = tuple(b for b in beliefs if b.recording in {d.name for d in drives})
        if not drives:
            raise InputError("no recording to fit")
        parameters = model.plant.parameters
        self.scales = {q: Scale(parameters[q]) for q in model.active if parameters[q].range}
        self.unknowns: list[tuple[str, int | None]] = []
        nq = len(model.unknowns)
        self.columns = np.full((len(drives), nq), -1)
        for c, q in enumerate(model.active):
            if q not in self.scales:
                continue
            if parameters[q].per_recording:
                for r in range(len(drives)):
                    self.columns[r, c] = len(self.unknowns)
                    self.unknowns.append((q, r))
            else:
                self.columns[:, c] = len(self.unknowns)
                self.unknowns.append((q, None))
        self.n_parameters = len(self.unknowns)
        self.sigma0 = []
        for c, s in enumerate(model.uncertain):
            for r in range(len(drives)):
                self.columns[r, len(model.active) + c] = len(self.unknowns)
                self.unknowns.append((f"{s} at the start", r))
                self.sigma0.append(model.plant.nodes[s].initial_sigma or 1.0)
        self.belief = self.start({})
        self.buffers: dict[str, np.ndarray] = {}
        self.huber = np.full(len(self.noise), HUBER)
        self.rows = [[_rows(d, j, n) for j, n in enumerate(self.noise)] for d in drives]
        self.samples = sum(len(e[0]) for entry in self.rows for e in entry)
        if self.samples == 0:
            raise InputError("no recording has a column that an output of the plant reads; nothing to fit")

    def start(self, changes: Mapping[str, float]) -> np.ndarray:
        """Unknowns (scaled) at the plant's values, with changes."""
        out = []
        for q, r in self.unknowns:
            if q in self.scales:
                p = self.model.plant.parameters[q]
                value = changes.get(
                    q, p.values.get(self.drives[r].name, p.value) if r is not None else p.value
                )
                out.append(self.scales[q].z(min(max(value, p.range[0]), p.range[1])))  # type: ignore[index]
            else:
                out.append(0.0)
        return np.array(out)

    def with_noise(self, j: int, n: Noise) -> Problem:
        """The same with another noise of output j."""
        other = copy.copy(self)
        other.noise = (*self.noise[:j], n, *self.noise[j + 1 :])
        other.rows = [
            [_rows(d, j, n) if k == j else q for k, q in enumerate(rows)]
            for d, rows in zip(self.drives, self.rows, strict=True)
        ]
        return other

    def unpack(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (recordings, parameters) and shifts of initial states (recordings, uncertain states)."""
        values = np.array([self.model.vector(None, d.name) for d in self.drives])
        dx0 = np.zeros((len(self.drives), len(self.model.uncertain)))
        for r in range(len(self.drives)):
            for c in range(self.columns.shape[1]):
                k = self.columns[r, c]
                if k < 0:
                    continue
                if c < len(self.model.active):
                    q = self.model.active[c]
                    values[r, self.model.parameters.index(q)] = self.scales[q].value(z[k])
                else:
                    dx0[r, c - len(self.model.active)] = z[k] * self.sigma0[k - self.n_parameters]
        return values, dx0

    def whiten(self, r: int, j: int, e: np.ndarray) -> np.ndarray:
        """(N, ...) errors of output j in recording r to whitened rows (M, ...), missing samples left out."""
        index, phi, scale = self.rows[r][j]
        part = e if len(index) == len(e) else e[index]
        shape = (-1, *([1] * (part.ndim - 1)))
        noise = self.noise[j]
        if len(noise.ar) > 1 and len(index) > 1:
            return lfilter(noise.ar, noise.ma, part, axis=0) / noise.sigma
        if len(index) > 1 and phi.any():
            part = np.concatenate([part[:1], part[1:] - phi.reshape(shape) * part[:-1]])
        return part / scale.reshape(shape)

    def _weighted(
        self,
        r: int,
        j: int,
        k: np.ndarray,
        slope: np.ndarray,
        w: np.ndarray,
        weight: np.ndarray,
        jac: np.ndarray,
    ) -> _Rows:
        """Output j's rows of recording r, from its whitened residuals and their weights (M,) and its slopes (N, k). White noise of
        one size only scales slopes: they are not copied, and what is missing weighs nothing."""
        index, phi, _ = self.rows[r][j]
        noise = self.noise[j]
        if len(noise.ar) > 1 or phi.any() or len(index) < (1 - ODD) * len(jac):
            return _Rows(r, j, k, slope, self.whiten(r, j, jac), w, weight)
        return _Rows(
            r,
            j,
            k,
            slope / noise.sigma,
            jac,
            self._spread(r, j, w, len(jac)),
            self._spread(r, j, weight, len(jac)),
        )

    def _spread(self, r: int, j: int, w: np.ndarray, n: int) -> np.ndarray:
        """Values (M,) of output j's measured samples as `n` rows: as they are, or with a zero for each that is missing."""
        if len(w) == n:
            return w
        out = np.zeros(n)
        out[self.rows[r][j][0]] = w
        return out

    def set_outlier_limits(self, residuals: Sequence[np.ndarray]) -> bool:
        """Huber's limit of each output from the spread of its residuals: what a plant that lacks physics misses is no
        outlier, nor is what happens in more than one sample of fifty. True where a limit changed by more than a half."""
        new = np.full(len(self.noise), HUBER)
        for j in range(len(self.noise)):
            w = np.concatenate([self.whiten(r, j, e[:, j]) for r, e in enumerate(residuals)])
            if len(w):
                middle, high = np.quantile(np.abs(w), [0.5, 0.98])
                new[j] = max(HUBER * max(1.0, 1.4826 * float(middle)), float(high))
        changed = bool(np.any((new > 1.5 * self.huber) | (new < self.huber / 1.5)))
        self.huber = new
        return changed

    def _slopes(self, r: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The columns of recording r's sensitivities that are unknowns, which unknowns, and their slopes d q / d z."""
        used = np.flatnonzero(self.columns[r] >= 0)
        active = self.model.active
        return (
            used,
            self.columns[r, used],
            np.array(
                [
                    self.scales[active[c]].slope(values[self.model.parameters.index(active[c])])
                    if c < len(active)
                    else self.sigma0[self.columns[r, c] - self.n_parameters]
                    for c in used
                ]
            ),
        )

    def prior(self) -> np.ndarray:
        """What each unknown's belief weighs (its entry in the Gauss-Newton matrix)."""
        return np.concatenate(
            [np.full(self.n_parameters, BELIEF_WEIGHT**2), np.ones(len(self.unknowns) - self.n_parameters)]
        )

    def jacobian(self, z: np.ndarray, r: int) -> tuple[np.ndarray, np.ndarray]:
        """Which unknowns recording r feels (k,), and the outputs' slopes by them (N, ny, k)."""
        values, dx0 = self.unpack(z)
        run = self.model.run(self.drives[r], values[r], dx0[r], sensitivities=True)
        used, k, slope = self._slopes(r, values[r])
        assert run.dy is not None
        return k, run.dy[:, :, used] * slope

    def evaluate(
        self, z: np.ndarray, jacobian: bool, keep: list[_Rows] | None = None
    ) -> tuple[float, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Cost, gradient/2 and Gauss-Newton matrix by the unknowns, raw residuals; what `curvature` needs goes to `keep`. Raises
        SimulationError."""
        values, dx0 = self.unpack(z)
        n = len(z)
        gradient, matrix = np.zeros(n), np.zeros((n, n))
        cost = 0.0
        residuals = []
        for r, d in enumerate(self.drives):
            run = self.model.run(d, values[r], dx0[r], sensitivities=jacobian, buffers=self.buffers)
            e = d.y - run.y
            if not np.all(np.isfinite(run.y)):
                raise SimulationError(f"{d.name}: the simulation gives values that are not numbers")
            residuals.append(e)
            used, k, slope = self._slopes(r, values[r])
            part_gradient, part_matrix = np.zeros(len(k)), np.zeros((len(k), len(k)))
            for j in range(len(self.noise)):
                if not len(self.rows[r][j][0]):
                    continue
                w = self.whiten(r, j, e[:, j])
                a = np.abs(w)
                limit = self.huber[j]
                cost += float(np.sum(np.where(a <= limit, w * w, 2 * limit * a - limit**2)))
                if not jacobian or run.dy is None:
                    continue
                dy = run.dy[:, j] if len(used) == run.dy.shape[2] else run.dy[:, j, used]
                rows = self._weighted(
                    r, j, k, slope, w, np.where(a <= limit, 1.0, limit / np.maximum(a, limit)), dy
                )
                if keep is not None:
                    keep.append(rows)
                part_gradient += rows.slope * (rows.jac.T @ (rows.weight * rows.w))
                part_matrix += _gram(rows.jac, rows.weight) * np.outer(rows.slope, rows.slope)
            if jacobian:
                np.add.at(gradient, k, part_gradient)
                matrix[np.ix_(k, k)] += part_matrix
        part, slope, bend = self.believed(values, jacobian)
        cost, gradient, matrix = cost + part, gradient - slope, matrix + bend
        prior = self.prior()
        away = z - self.belief
        cost += float(np.sum(prior * away**2))
        return cost, gradient - prior * away, matrix + np.diag(prior), residuals

    def believed(self, values: np.ndarray, derivatives: bool) -> tuple[float, np.ndarray, np.ndarray]:
        """The beliefs' terms of the cost, and half their first and second derivatives by the unknowns."""
        n = len(self.unknowns)
        cost, gradient, matrix = 0.0, np.zeros(n), np.zeros((n, n))
        for belief in self.beliefs:
            r = next(r for r, d in enumerate(self.drives) if d.name == belief.recording)
            known = dict(zip(self.model.parameters, map(float, values[r]), strict=True))
            cost += float(ex.evaluate(belief.surprise, known))
            felt = [
                (q, self.columns[r, c], self.scales[q].slope(known[q]))
                for c, q in enumerate(self.model.active)
                if derivatives and self.columns[r, c] >= 0 and q in ex.names(belief.surprise)
            ]
            for q, k, slope in felt:
                first = ex.derivative(belief.surprise, q)
                gradient[k] += 0.5 * slope * float(ex.evaluate(first, known))
                for q2, k2, slope2 in felt:
                    matrix[k, k2] += (
                        0.5 * slope * slope2 * float(ex.evaluate(ex.derivative(first, q2), known))
                    )
        return cost, gradient, matrix

    def curvature(self, z: np.ndarray, step: np.ndarray, kept: Sequence[_Rows]) -> np.ndarray:
        """J^T d2w/dh2 of the whitened residuals w(z + h step), from one more simulation. Raises SimulationError."""
        values, dx0 = self.unpack(z + PROBE * step)
        errors = [
            d.y - self.model.run(d, values[r], dx0[r], buffers=self.buffers).y
            for r, d in enumerate(self.drives)
        ]
        out = np.zeros(len(z))
        for rows in kept:
            r, j = rows.recording, rows.output
            moved = self._spread(r, j, self.whiten(r, j, errors[r][:, j]), len(rows.w))
            second = (moved - rows.w) / PROBE + rows.jac @ (rows.slope * step[rows.unknowns])
            np.add.at(out, rows.unknowns, rows.slope * (rows.jac.T @ (rows.weight * second)))
        return out * (2 / PROBE)


@dataclass(frozen=True)
class _Rows:
    """Whitened residuals w (M,) of an output in a recording, what they weigh, and -dw (M, k) by the unknowns over their `slope`."""

    recording: int
    output: int
    unknowns: np.ndarray
    slope: np.ndarray
    jac: np.ndarray
    w: np.ndarray
    weight: np.ndarray


def _gram(jac: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """J^T W J; where few rows weigh less than one, less what they would add if they did not."""
    odd = np.flatnonzero(weight != 1.0)
    if len(odd) > ODD * len(jac):
        jac = jac * np.sqrt(weight)[:, None]
        odd = odd[:0]
    few = jac[odd] * np.sqrt(1.0 - weight[odd])[:, None]
    return jac.T @ jac - few.T @ few


def fit(
    model: Model,
    drives: Sequence[Excitation],
    noise: Sequence[Noise] | None = None,
    start: Mapping[str, float] | np.ndarray | None = None,
    iterations: int = 40,
    tolerance: float = 1e-4,
    tries: int = 0,
    seed: int = 0,
    seconds: float = 600.0,
    goal: float = np.inf,
    beliefs: Sequence[Belief] = (),
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fit the active parameters that have a range (and uncertain initial states) to the drives.

    `seconds` of this thread's CPU time: after which no further iteration is begun. `tries`: how many starts drawn over the ranges are looked at
    besides the given one; the best two are followed. `goal`: a cost that would take HOPELESS more steps like the last ones is not followed.
    Raises SimulationError where no start can be simulated, InputError where there is nothing to compare."""
    for d in drives:
        if d.scale is None:
            model.prepare(d)
    problem = Problem(model, drives, noise or default_noise(model.plant, drives), beliefs)
    z0 = problem.start(start or {}) if not isinstance(start, np.ndarray) else start
    starts = [z0]
    if tries:
        random = np.random.default_rng(seed)
        looked = []
        for _ in range(tries):
            z = z0.copy()
            z[: problem.n_parameters] = random.uniform(0.05, 0.95, problem.n_parameters)
            try:
                looked.append((problem.evaluate(z, False)[0], z))
            except SimulationError:
                continue
        looked.sort(key=lambda item: item[0])
        starts += [z for _, z in looked[:2]]
    best: Fit | None = None
    failure: SimulationError | None = None
    deadline = time.thread_time() + seconds
    for z in starts:
        try:
            problem.set_outlier_limits(problem.evaluate(z, False)[3])
            if best is not None:  # another start is followed to its end only if a few steps bring it below
                z = _descend(problem, z, 12, tolerance, deadline, goal).z
                if _sum_of_squares(problem, problem.evaluate(z, False)[3]) > 0.98 * _sum_of_squares(
                    problem, best.residuals
                ):
                    continue
            for _ in range(4):
                found = _descend(problem, z, iterations, tolerance, deadline, goal)
                z = found.z
                if not problem.set_outlier_limits(found.residuals):
                    break
        except SimulationError as e:
            failure = failure or e
            continue
        if best is None or found.cost < best.cost - 1e-6:
            best = found
        if progress:
            progress(f"cost {found.cost:.1f} after {found.iterations} iterations")
    if best is None:
        raise failure or SimulationError("the plant cannot be simulated")
    return best


def _sum_of_squares(problem: Problem, residuals: Sequence[np.ndarray]) -> float:
    return float(
        sum(
            np.sum(problem.whiten(r, j, e[:, j]) ** 2)
            for r, e in enumerate(residuals)
            for j in range(len(problem.noise))
        )
    )


def _descend(
    problem: Problem, z: np.ndarray, iterations: int, tolerance: float, deadline: float, goal: float
) -> Fit:
    low = np.concatenate([np.zeros(problem.n_parameters), np.full(len(z) - problem.n_parameters, -8.0)])
    high = np.concatenate([np.ones(problem.n_parameters), np.full(len(z) - problem.n_parameters, 8.0)])
    z = np.clip(z, low, high)
    kept: list[_Rows] = []
    cost, gradient, matrix, residuals = problem.evaluate(z, True, kept)
    damping, done, hopeless = 1e-3, 0, 0
    for done in range(1, iterations + 1):  # noqa: B007 the count is reported
        held = ((z <= low) & (gradient < 0)) | ((z >= high) & (gradient > 0))
        free = np.flatnonzero(~held)
        if not len(free) or time.thread_time() > deadline:
            break
        improved = False
        for _ in range(12):
            step = np.zeros_like(z)
            left = free
            for _ in range(len(free) + 1):  # steps that would leave the box stop at its wall
                sub = matrix[np.ix_(left, left)]
                fixed = np.setdiff1d(free, left)
                rhs = gradient[left] - matrix[np.ix_(left, fixed)] @ step[fixed]
                step[left] = np.linalg.solve(sub + damping * np.diag(np.diag(sub)), rhs)
                out = left[
                    (z[left] + step[left] < low[left] - 1e-12) | (z[left] + step[left] > high[left] + 1e-12)
                ]
                if not len(out):
                    break
                step[out] = np.clip(z[out] + step[out], low[out], high[out]) - z[out]
                left = np.setdiff1d(left, out)
                if not len(left):
                    break
            predicted = float(2 * gradient @ step - step @ matrix @ step)
            try:
                trial = np.clip(z + step + _bend(problem, z, step, matrix, damping, left, kept), low, high)
                new_cost = problem.evaluate(trial, False)[0]
            except SimulationError:
                new_cost = np.inf
            if new_cost < cost:
                improved = True
                damping = max(damping * (0.2 if cost - new_cost > 0.5 * predicted else 1.0), 1e-9)
                break
            if predicted < 1e-3 * tolerance * max(cost, 1.0) and np.isfinite(new_cost):
                break
            damping = min(damping * 8, 1e8)
        if not improved:
            break
        gain = cost - new_cost
        z = trial
        kept.clear()
        cost, gradient, matrix, residuals = problem.evaluate(z, True, kept)
        hopeless = hopeless + 1 if HOPELESS * gain < cost - goal else 0
        if gain < tolerance * max(1.0, 1e-3 * cost) or hopeless >= 3:
            break
    values, dx0 = problem.unpack(z)
    at_bound = {}
    for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        if z[k] <= 1e-6:
            at_bound[q] = "low"
        elif z[k] >= 1 - 1e-6:
            at_bound[q] = "high"
    return Fit(
        problem.model,
        values,
        dx0,
        cost,
        problem.unknowns,
        z,
        matrix,
        residuals,
        problem.noise,
        done,
        problem.samples,
        at_bound,
        problem.beliefs,
        problem.believed(values, True)[2],
    )


def _bend(
    problem: Problem,
    z: np.ndarray,
    step: np.ndarray,
    matrix: np.ndarray,
    damping: float,
    free: np.ndarray,
    kept: Sequence[_Rows],
) -> np.ndarray:
    """Half the geodesic acceleration: a plant's parameters trade in valleys that are curved, and a straight step leaves them
    (Transtrum & Sethna 2012, arXiv:1201.5885). Nothing where it is not small beside the step."""
    out = np.zeros_like(step)
    if len(free):
        sub = matrix[np.ix_(free, free)]
        weight = np.diag(sub)
        out[free] = 0.5 * np.linalg.solve(
            sub + damping * np.diag(weight), problem.curvature(z, step, kept)[free]
        )
        if not weight @ out[free] ** 2 <= (0.5 * BENT) ** 2 * (weight @ step[free] ** 2):
            return np.zeros_like(step)
    return out


# ------------------------------------------------------------------------------------------------------------ reports


@dataclass(frozen=True)
class Estimate:
    """One parameter after a refit. `state`: 'ok', 'at bound', 'dead' (the data do not feel it) or 'flat' (only a
    combination with others is felt); `trades_with`: parameters correlated with it above 0.95."""

    name: str
    value: float
    sd: float
    unit: str | None
    state: str
    trades_with: tuple[str, ...] = ()
    recording: str | None = None


def report(found: Fit, drives: Sequence[Excitation] | None = None) -> list[Estimate]:
    """Value, standard error and condition of each parameter, from the Gauss-Newton matrix at the fit."""
    n = sum(1 for q, _ in found.unknowns if q in found.model.active)
    residual = found.cost / max(found.samples - len(found.z), 1)
    inverse = np.linalg.pinv(found.hessian, hermitian=True) * max(residual, 1.0)
    sd = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    corr = inverse / np.maximum(np.outer(sd, sd), 1e-300)
    out = []
    for k, (q, r) in enumerate(found.unknowns[:n]):
        p = found.model.plant.parameters[q]
        value = float(found.values[r or 0, found.model.parameters.index(q)])
        slope = Scale(p).slope(value)
        felt = np.sqrt(max(found.hessian[k, k] - BELIEF_WEIGHT**2, 0.0))
        trades = tuple(found.unknowns[c][0] for c in np.flatnonzero(np.abs(corr[k, :n]) > 0.95) if c != k)
        state = (
            "dead" if felt < 0.1 else "at bound" if q in found.at_bound else "flat" if sd[k] > 0.5 else "ok"
        )
        name = drives[r].name if drives is not None and r is not None else None
        out.append(Estimate(q, value, float(sd[k] * slope), p.unit, state, trades, name))
    return out


def updated(plant: Plant, found: Fit, drives: Sequence[Excitation]) -> Plant:
    """The plant with the fitted values written in (per recording where it says so)."""
    parameters = dict(plant.parameters)
    for q in found.model.active:
        p = parameters[q]
        if not p.range:
            continue
        column = found.values[:, found.model.parameters.index(q)]
        values = (
            {d.name: float(v) for d, v in zip(drives, column, strict=True)} if p.per_recording else p.values
        )
        parameters[q] = dataclasses.replace(p, value=float(np.clip(np.mean(column), *p.range)), values=values)
    return dataclasses.replace(plant, parameters=parameters)
