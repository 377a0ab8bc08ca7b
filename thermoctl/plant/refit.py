"""Refit of a plant's own parameters to recordings: bounded, weighted least squares on the free-run error.

The cost is in residuals.py. Each step is Gauss-Newton with Levenberg's damping on the normal equations, plus
half the geodesic acceleration (Transtrum & Sethna 2012, arXiv:1201.5885):

    (J'J + l D) v = J' r,    (J'J + l D) a = J' d2r/dh2 along v,    z <- z + v + a/2
    r = (measured - simulated) / s,    J = -dr/dz

A parameter that meets its bound is held there until the gradient leads back inside. Sensitivities are exact
(compile.py).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from thermoctl.plant.residuals import Evaluation, Prior, Problem, Rows
from thermoctl.plant.simulate import Excitation, Model, SimulationError
from thermoctl.plant.whitening import Noise, default_noise

STEPS_TO_GOAL = 20.0  # a step is slow if the `goal` is more than this many such steps away
SLOW_STEPS = 3  # give up after so many slow steps in a row
AT_BOUND = 1e-6  # a parameter counts as at its bound within this share of its range
MAX_ACCELERATION = 0.75  # use the geodesic acceleration only up to this share of the step
MAX_SHIFT = 8.0  # largest shift of an uncertain initial state, in its standard deviations
KEPT_STARTS = 2  # number of random starts that are refined
PREVIEW = (
    12  # iterations of a further start; it continues if its sum of squares is below PREVIEW_SHARE of the best
)
PREVIEW_SHARE = 0.98
RELIMITS = 4  # number of times that the outlier limits are set anew


@dataclass
class Fit:
    """The result of a refit.

    - `values` (recordings, parameters) in the model's order; `dx0` (recordings, uncertain states)
    - `unknowns`: (name, recording index or None) of each free parameter and initial state
    - `z`: their scaled values: a parameter's is 0..1 in its range, an initial state's in standard deviations
    - `hessian`: Gauss-Newton matrix, the inverse covariance of `z`; `prior_hessian`: the priors' share
    - `residuals`: (N, outputs) by recording, NaN where missing
    - `sizes`: rms of each output's residuals, where these were not kept"""

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
    priors: tuple[Prior, ...] = ()
    prior_hessian: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    sizes: dict[str, float] = field(default_factory=dict)

    def parameters(self, recording: int = 0) -> dict[str, float]:
        """Return all parameter values of one recording."""
        return dict(zip(self.model.parameters, map(float, self.values[recording]), strict=True))

    def rms(self) -> dict[str, float]:
        """Return the root-mean-square residual of each output over all recordings."""
        if not self.residuals:
            return self.sizes
        stacked = np.concatenate(self.residuals)
        return {
            o: float(np.sqrt(np.nanmean(stacked[:, j] ** 2)))
            if np.isfinite(stacked[:, j]).any()
            else float("nan")
            for j, o in enumerate(self.model.outputs)
        }


@dataclass(frozen=True)
class _Limits:
    """Limits of a descent.

    `tolerance`: least gain in cost; `deadline`: clock of the thread, s; `goal`: a cost that must stay in
    reach.
    """

    iterations: int
    tolerance: float
    deadline: float
    goal: float


def fit(
    model: Model,
    excitations: Sequence[Excitation],
    noise: Sequence[Noise] | None = None,
    start: Mapping[str, float] | np.ndarray | None = None,
    iterations: int = 40,
    tolerance: float = 1e-4,
    tries: int = 0,
    seed: int = 0,
    seconds: float = 600.0,
    goal: float = np.inf,
    priors: Sequence[Prior] = (),
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Fit the active parameters that have a range, and the uncertain initial states, to the recordings.

    `tries`: random starts over the ranges besides `start`; the best KEPT_STARTS are followed. `seconds`: no
    iteration begins after so much CPU time of this thread. `goal`: stop where this cost is more than
    STEPS_TO_GOAL steps away. Raises SimulationError if no start can be simulated, InputError if there is
    nothing to compare."""
    for d in excitations:
        if d.scale is None:
            model.prepare(d)
    problem = Problem(model, excitations, noise or default_noise(model.plant, excitations), priors)
    z0 = problem.start(start or {}) if not isinstance(start, np.ndarray) else start
    limits = _Limits(iterations, tolerance, time.thread_time() + seconds, goal)
    best: Fit | None = None
    failure: SimulationError | None = None
    for z in [z0, *_random_starts(problem, z0, tries, seed)]:
        try:
            found = _follow(problem, z, limits, best)
        except SimulationError as e:
            failure = failure or e
            continue
        if found is None:
            continue
        if best is None or found.cost < best.cost - 1e-6:
            best = found
        if progress:
            progress(f"cost {found.cost:.1f} after {found.iterations} iterations")
    if best is None:
        raise failure or SimulationError("the plant cannot be simulated")
    return best


def _random_starts(problem: Problem, z0: np.ndarray, tries: int, seed: int) -> list[np.ndarray]:
    """Return the starts of least cost among `tries` random ones within the ranges."""
    random = np.random.default_rng(seed)
    tried = []
    for _ in range(tries):
        z = z0.copy()
        z[: problem.n_parameters] = random.uniform(0.05, 0.95, problem.n_parameters)
        try:
            tried.append((problem.evaluate(z, False).cost, z))
        except SimulationError:
            continue
    return [z for _, z in sorted(tried, key=lambda item: item[0])[:KEPT_STARTS]]


def _follow(problem: Problem, z: np.ndarray, limits: _Limits, best: Fit | None) -> Fit | None:
    """Descend from a start, setting the outlier limits anew; None if it is soon not below `best`."""
    problem.set_outlier_limits(problem.evaluate(z, False).residuals)
    if best is not None:
        z = _descend(problem, z, dataclasses.replace(limits, iterations=PREVIEW)).z
        squares = _sum_of_squares(problem, problem.evaluate(z, False).residuals)
        if squares > PREVIEW_SHARE * _sum_of_squares(problem, best.residuals):
            return None
    for _ in range(RELIMITS):
        found = _descend(problem, z, limits)
        z = found.z
        if not problem.set_outlier_limits(found.residuals):
            break
    return found


def _sum_of_squares(problem: Problem, residuals: Sequence[np.ndarray]) -> float:
    return float(
        sum(
            np.sum(problem.whitening[r][j].whiten(e[:, j]) ** 2)
            for r, e in enumerate(residuals)
            for j in range(len(problem.noise))
        )
    )


def _descend(problem: Problem, z: np.ndarray, limits: _Limits) -> Fit:
    """Do Gauss-Newton steps with Levenberg's damping inside the bounds, from z until `limits` are reached."""
    n_states = len(z) - problem.n_parameters
    low = np.concatenate([np.zeros(problem.n_parameters), np.full(n_states, -MAX_SHIFT)])
    high = np.concatenate([np.ones(problem.n_parameters), np.full(n_states, MAX_SHIFT)])
    z = np.clip(z, low, high)
    kept: list[Rows] = []
    now = problem.evaluate(z, True, kept)
    problem.keep()
    damping, done, out_of_reach = 1e-3, 0, 0
    for done in range(1, limits.iterations + 1):  # noqa: B007 the count is reported
        held = ((z <= low) & (now.gradient < 0)) | ((z >= high) & (now.gradient > 0))
        free = np.flatnonzero(~held)
        if not len(free) or time.thread_time() > limits.deadline:
            break
        better = _improve(problem, z, now, free, damping, (low, high), kept, limits.tolerance)
        if better is None:
            break
        z, then, damping, kept = better
        gain, now = now.cost - then.cost, then
        out_of_reach = out_of_reach + 1 if STEPS_TO_GOAL * gain < now.cost - limits.goal else 0
        if gain < limits.tolerance * max(1.0, 1e-3 * now.cost) or out_of_reach >= SLOW_STEPS:
            break
    return _result(problem, z, now, done)


def _improve(
    problem: Problem,
    z: np.ndarray,
    now: Evaluation,
    free: np.ndarray,
    damping: float,
    bounds: tuple[np.ndarray, np.ndarray],
    kept: Sequence[Rows],
    tolerance: float,
) -> tuple[np.ndarray, Evaluation, float, list[Rows]] | None:
    """Return a point of less cost, its evaluation with derivatives, the next damping, and its rows.

    None if no damping up to the twelfth gives one."""
    for tries in range(12):
        step, left = _bounded_step(z, now, free, damping, bounds)
        predicted = float(2 * now.gradient @ step - step @ now.matrix @ step)
        rows: list[Rows] = []
        try:
            bend = _acceleration(problem, z, step, now.matrix, damping, left, kept)
            trial = np.clip(z + step + bend, *bounds)
            at_once = problem.few and not tries
            then = problem.evaluate(trial, at_once, rows)
        except SimulationError:
            damping = min(damping * 8, 1e8)
            continue
        if then.cost < now.cost:
            if not at_once:
                then = problem.evaluate(trial, True, rows)
            problem.keep()
            half = now.cost - then.cost > 0.5 * predicted
            return trial, then, max(damping * (0.2 if half else 1.0), 1e-9), rows
        if predicted < 1e-3 * tolerance * max(now.cost, 1.0):
            return None
        damping = min(damping * 8, 1e8)
    return None


def _bounded_step(
    z: np.ndarray, now: Evaluation, free: np.ndarray, damping: float, bounds: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped Gauss-Newton step within the bounds, and the unknowns that stay inside."""
    low, high = bounds
    step, left = np.zeros_like(z), free
    for _ in range(
        len(free) + 1
    ):  # an unknown whose step crosses its bound stops there; solve for the others again
        sub = now.matrix[np.ix_(left, left)]
        fixed = np.setdiff1d(free, left)
        rhs = now.gradient[left] - now.matrix[np.ix_(left, fixed)] @ step[fixed]
        step[left] = np.linalg.solve(sub + damping * np.diag(np.diag(sub)), rhs)
        out = left[(z[left] + step[left] < low[left] - 1e-12) | (z[left] + step[left] > high[left] + 1e-12)]
        if not len(out):
            break
        step[out] = np.clip(z[out] + step[out], low[out], high[out]) - z[out]
        left = np.setdiff1d(left, out)
        if not len(left):
            break
    return step, left


def _acceleration(
    problem: Problem,
    z: np.ndarray,
    step: np.ndarray,
    matrix: np.ndarray,
    damping: float,
    free: np.ndarray,
    kept: Sequence[Rows],
) -> np.ndarray:
    """Return half the geodesic acceleration, or zeros if it is not small beside the step.

    The cost's valleys are curved, and a straight step leaves them (Transtrum & Sethna 2012, arXiv:1201.5885).
    It needs the sensitivities of all recordings: zeros where they are too many to be kept.
    """
    out = np.zeros_like(step)
    if len(free) and problem.keeps:
        sub = matrix[np.ix_(free, free)]
        weight = np.diag(sub)
        curvature = problem.curvature(z, step, kept)[free]
        out[free] = 0.5 * np.linalg.solve(sub + damping * np.diag(weight), curvature)
        if not weight @ out[free] ** 2 <= (0.5 * MAX_ACCELERATION) ** 2 * (weight @ step[free] ** 2):
            return np.zeros_like(step)
    return out


def _result(problem: Problem, z: np.ndarray, now: Evaluation, iterations: int) -> Fit:
    values, dx0 = problem.unpack(z)
    at_bound = {}
    for k, (q, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        if z[k] <= AT_BOUND:
            at_bound[q] = "low"
        elif z[k] >= 1 - AT_BOUND:
            at_bound[q] = "high"
    return Fit(
        problem.model,
        values,
        dx0,
        now.cost,
        problem.unknowns,
        z,
        now.matrix,
        now.residuals,
        problem.noise,
        iterations,
        problem.samples,
        at_bound,
        problem.priors,
        problem.prior_terms(values, True)[2],
    )


# --------------------------------------------------------------------------------------------------- reports
