"""Refit of a plant's own parameters to recordings: bounded, weighted least squares on the free-run error.

The cost is in residuals.py, its steps are in climb.py. Sensitivities are exact (compile.py).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.plant.fitting.climb import Climbed, Spot, climb
from thermoctl.plant.fitting.residuals import Evaluation, Prior, Problem, ResidualRows
from thermoctl.plant.fitting.whitening import Noise, default_noise
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError

KEPT_STARTS = 2  # number of random starts that are refined
PREVIEW = 12  # iterations of a further start before its cost is compared with PREVIEW_SHARE of the best
PREVIEW_SHARE = 0.98
RELIMITS = 4  # largest number of times that the outlier limits are updated
FIRST_PARTS = (0.25, 0.5)  # shares of each recording, fitted one after the other (tests.bench.first_parts)
SHORTEST = 8  # least number of rows of a first part
MISFIT = 2.0  # ratio of a residual to its noise, above which a fit is tried by first parts, too
LESS = 0.9  # largest cost of that fit, over the first one's, with which it counts


@dataclass
class Fit:
    """The result of a refit.

    - `values` (recordings, parameters) in the model's order; `dx0` (recordings, uncertain states)
    - `unknowns`: (name, recording index or None) of each free parameter and initial state
    - `z`: their scaled values: a parameter's is 0..1 in its range, an initial state's in standard deviations
    - `hessian`: Gauss-Newton matrix, the inverse covariance of `z`
    - `residuals`: (N, outputs) by recording, NaN where missing
    - `sizes`: rms of each output's residuals, where these were not kept
    - `converged`: False where a limit of steps or time ended the refit; `left`: the fall of the cost that
      another step promised"""

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
    sizes: dict[str, float] = field(default_factory=dict)
    converged: bool = True
    left: float = 0.0

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
    reach."""

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
    there: Evaluation | None = None,
    held: Sequence[int] = (),
) -> Fit:
    """Fit the active parameters that have a range, and the uncertain initial states, to the recordings.

    `there`: the evaluation at `start`, where it is known. `held`: unknowns that stay until the others are
    fitted. `tries`: random starts over the ranges besides
    `start`; the best KEPT_STARTS are followed. `seconds`: no iteration begins after so much CPU time of this
    thread. `goal`: stop where this cost is out of reach.
    Raises SimulationError if no start can be simulated, InputError if there is nothing to compare."""
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
            followed = _follow(problem, z, limits, best, there if z is z0 else None, held)
        except SimulationError as e:
            failure = failure or e
            continue
        if followed is None:
            continue
        if best is None or followed.cost < best.cost - 1e-6:
            best = followed
        if progress:
            progress(f"cost {followed.cost:.1f} after {followed.iterations} iterations")
    if best is None:
        raise failure or SimulationError("the plant cannot be simulated")
    return best


def fit_by_first_parts(
    model: Model,
    excitations: Sequence[Excitation],
    noise: Sequence[Noise] | None = None,
    start: Mapping[str, float] | np.ndarray | None = None,
    tolerance: float = 1e-4,
    tries: int = 0,
    seconds: float = 600.0,
) -> Fit:
    """Fit as `fit` does; where a misfit stays, a second time from fits of the recordings' first parts.

    A rig that oscillates has a wrong optimum for each period that a free run gains or loses. A first
    part is too short for that. So it may be for a stock that the file's values use up before the end, which
    ends a free run. Raises as `fit` does."""
    first: Fit | SimulationError
    try:
        first = fit(model, excitations, noise, start, tolerance=tolerance, tries=tries, seconds=seconds)
    except SimulationError as e:
        first = e
    if isinstance(first, Fit):
        over = [first.rms()[o] / n.sigma for o, n in zip(model.outputs, first.noise, strict=True)]
        if not any(ratio > MISFIT for ratio in over):  # an output that was not measured has NaN
            return first
    try:
        z = start
        for share in FIRST_PARTS:
            some = [d.part(0, max(int(share * len(d.t)), SHORTEST)) for d in excitations]
            z = fit(model, some, noise, z, tolerance=tolerance, seconds=seconds).z
        second = fit(model, excitations, noise, z, tolerance=tolerance, seconds=seconds)
    except (SimulationError, InputError):  # a first part may hold no reading at all
        if isinstance(first, Fit):
            return first
        raise first from None
    return first if isinstance(first, Fit) and second.cost >= LESS * first.cost else second


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


def _follow(
    problem: Problem,
    z: np.ndarray,
    limits: _Limits,
    best: Fit | None,
    there: Evaluation | None,
    held: Sequence[int],
) -> Fit | None:
    """Descend from a start, updating the outlier limits; None if it does not soon come below `best`."""
    problem.set_outlier_limits((there or problem.evaluate(z, False)).residuals)
    if held:
        z = _descend(problem, z, limits, held).z
    if best is not None:
        z = _descend(problem, z, dataclasses.replace(limits, iterations=PREVIEW)).z
        squares = _sum_of_squares(problem, problem.evaluate(z, False).residuals)
        if squares > PREVIEW_SHARE * _sum_of_squares(problem, best.residuals):
            return None
    for _ in range(RELIMITS):
        descended = _descend(problem, z, limits)
        z = descended.z
        if not problem.set_outlier_limits(descended.residuals):
            break
    return descended


def _sum_of_squares(problem: Problem, residuals: Sequence[np.ndarray]) -> float:
    return float(
        sum(
            np.sum(problem.whitening[r][j].whiten(e[:, j]) ** 2)
            for r, e in enumerate(residuals)
            for j in range(len(problem.noise))
        )
    )


Found = tuple[Evaluation, list[ResidualRows] | None]  # an evaluation, and its rows if slopes were computed


class _Misfit:
    """Minus half the cost of a problem, as a height to climb."""

    def __init__(self, problem: Problem, z: np.ndarray, held: Sequence[int]):
        self.problem, self.few = problem, problem.few
        self.bounds = problem.bounds
        for bound in self.bounds:
            bound[list(held)] = z[list(held)]
        self.rows: list[ResidualRows] = []  # where the climb stands

    def look(self, z: np.ndarray, slopes: bool) -> Spot[Found]:
        """Evaluate the cost."""
        rows: list[ResidualRows] = []
        evaluation = self.problem.evaluate(z, slopes, rows)
        return Spot(z, -0.5 * evaluation.cost, (evaluation, rows if slopes else None))

    def stand(self, spot: Spot[Found]) -> tuple[np.ndarray, np.ndarray]:
        """Return half the cost's negative gradient, and the Gauss-Newton matrix."""
        evaluation, rows = spot.found
        if rows is None:
            evaluation, rows = self.look(spot.z, True).found
        self.rows = rows or []
        self.problem.keep()
        return evaluation.gradient, evaluation.matrix

    def bend(self, spot: Spot[Found], step: np.ndarray) -> np.ndarray:
        """Return zeros where the sensitivities of all recordings are too many to be kept."""
        if not self.problem.keeps:
            return np.zeros_like(step)
        return self.problem.curvature(spot.z, step, self.rows)


def _descend(problem: Problem, z: np.ndarray, limits: _Limits, held: Sequence[int] = ()) -> Fit:
    """Descend inside the bounds from z, until `limits` are reached; unknowns that are `held` stay."""

    def enough(height: float) -> float:
        """Return half of the tolerance at a height."""
        return 0.5 * limits.tolerance * max(1.0, -2e-3 * height)

    top = climb(_Misfit(problem, z, held), z, limits.iterations, enough, -0.5 * limits.goal, limits.deadline)
    return _result(problem, top)


def _result(problem: Problem, top: Climbed[Found]) -> Fit:
    z, now = top.spot.z, top.spot.found[0]
    values, dx0 = problem.unpack(z)
    return Fit(
        problem.model,
        values,
        dx0,
        now.cost,
        problem.unknowns,
        z,
        top.matrix,
        now.residuals,
        problem.noise,
        top.steps,
        problem.samples,
        problem.at_bound(z),
        problem.priors,
        converged=top.converged,
        left=2 * top.left,
    )
