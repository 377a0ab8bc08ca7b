"""Residuals of a plant on recordings in the metric of their noise, with gradient and Gauss-Newton matrix.

    cost(z) = sum_k rho((e_k - phi e_(k-1)) / s) + sum (dx0 / initial_sigma)^2
              + w sum (z - z_plant)^2 + sum of priors
    e = y - yhat(p, x0 + dx0),   s^2 = sigma^2 (1 - phi^2)   for each channel

phi is the correlation of a channel's noise over one median sampling interval (AR(1)). rho is Huber's
function, quadratic up to a limit and linear beyond. z is a parameter's coordinate in its range, 0 to 1, on a
log scale where the range spans a factor of three or more. The small weight w keeps a parameter that the data
do not determine at the plant's value.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.cores import each
from thermoctl.plant.fitting.whitening import Noise, Whitening
from thermoctl.plant.language import Parameter
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError

HUGE = 1e100  # outputs from here on count as infinite: the sums of their squares would be
HUBER = 4.0  # residuals beyond this many standard deviations count linearly
PRIOR_WEIGHT = 0.02  # moving a parameter over its whole range costs as much as one residual of 0.02 sigma
EDGE = 1e-6  # share of a parameter's range: closer to an end, the parameter is at its bound
FAR = 8.0  # bound of an uncertain initial state, in its standard deviations
PROBE = 0.1  # share of a step over which the curvature of the residuals is measured
DOWNDATE_SHARE = 0.25  # up to this share of down-weighted rows, their excess is subtracted from J'J
# Unknowns up to which a run with sensitivities costs less than ten without: eight go through the processor at
# once (integrator.h). There a trial step, which succeeds nine times of ten, runs with them at once.
FEW_UNKNOWNS = 16
LOG_RATIO = 3.0  # a range that spans this factor is fitted on a log scale
# Sensitivities of all recordings, up to which they are kept from one pass to the next (160 MB). Of more, each
# recording's are summed and forgotten, and a refit's steps are straight (refit.py).
KEPT = 20_000_000

R = TypeVar("R")


@dataclass(frozen=True)
class Prior:
    """-2 log of a prior density: a convex expression of the parameters' values in `recording`."""

    recording: str
    neg2_log: ex.Expr


class Scale:
    """The coordinate z in [0, 1] of a parameter in its range."""

    def __init__(self, p: Parameter):
        assert p.range is not None
        self.low, self.high = p.range
        self.log = self.low > 0 and self.high >= LOG_RATIO * self.low
        self.span = np.log(self.high / self.low) if self.log else self.high - self.low

    def z(self, value: float) -> float:
        """Return the coordinate z of a value."""
        return float(np.log(value / self.low) / self.span if self.log else (value - self.low) / self.span)

    def value(self, z: float) -> float:
        """Return the value at a coordinate; beyond 0 and 1 the end of the range."""
        inside = min(max(z, 0.0), 1.0)
        raw = self.low * np.exp(inside * self.span) if self.log else self.low + inside * self.span
        return float(min(max(raw, self.low), self.high))

    def slope(self, value: float) -> float:
        """Return d value / d z."""
        return float(value * self.span if self.log else self.span)


@dataclass(frozen=True)
class ResidualRows:
    """Whitened residuals of one output in one recording, and their sensitivities, for one refit step.

    `w` (M,) residuals; `weight` (M,) Huber's weights; `unknowns` (k,) indices in the refit's z.
    -dw/dz = `jac` (M, k) * `slope` (k,)."""

    recording: int
    output: int
    unknowns: np.ndarray
    slope: np.ndarray
    jac: np.ndarray
    w: np.ndarray
    weight: np.ndarray


class Evaluation(NamedTuple):
    """Cost, half its negative gradient, Gauss-Newton matrix, and raw residuals (N, ny) by recording."""

    cost: float
    gradient: np.ndarray
    matrix: np.ndarray
    residuals: list[np.ndarray]


class _Part(NamedTuple):
    """One recording's cost, numbers of its unknowns, half its negative gradient, matrix, residuals, rows."""

    cost: float
    unknowns: np.ndarray
    gradient: np.ndarray
    matrix: np.ndarray
    residual: np.ndarray
    rows: list[ResidualRows]


class Problem:
    """Residuals and Jacobian of a model on several recordings, in the metric of the noise."""

    def __init__(
        self,
        model: Model,
        excitations: Sequence[Excitation],
        noise: Sequence[Noise],
        priors: Sequence[Prior] = (),
    ):
        self.model, self.excitations, self.noise = model, list(excitations), tuple(noise)
        self.priors = tuple(p for p in priors if p.recording in {d.name for d in excitations})
        if not excitations:
            raise InputError("no recording to fit")
        self._number_unknowns()
        self.z_plant = self.start({})
        self.buffers: dict[str, np.ndarray] = {}
        self.kept_buffers: dict[str, np.ndarray] = {}
        self.huber = np.full(len(self.noise), HUBER)
        self.whitening = [[Whitening.of(d, j, n) for j, n in enumerate(self.noise)] for d in excitations]
        # computed in a run without sensitivities; with them, at least as many again
        self.numbers = sum(len(d.t) for d in excitations) * len(model.states) * (len(model.unknowns) + 1)
        slopes = sum(d.y.size for d in excitations) * len(model.unknowns)
        self.keeps = slopes <= KEPT  # may sensitivities be kept?
        self.samples = sum(len(w.index) for outputs in self.whitening for w in outputs)
        if self.samples == 0:
            raise InputError("no recording has a column that an output of the plant reads; nothing to fit")

    def _number_unknowns(self) -> None:
        """Give numbers to the parameters with a range, then to the uncertain initial states."""
        model, parameters = self.model, self.model.plant.parameters
        recordings = range(len(self.excitations))
        self.scales = {q: Scale(parameters[q]) for q in model.active if parameters[q].range}
        self.unknowns: list[tuple[str, int | None]] = []
        self.columns = np.full((len(recordings), len(model.unknowns)), -1)
        for c, q in enumerate(model.active):
            if q not in self.scales:
                continue
            if parameters[q].per_recording:
                for r in (r for r in recordings if self.excitations[r].name not in parameters[q].known):
                    self.columns[r, c] = len(self.unknowns)
                    self.unknowns.append((q, r))
            else:
                self.columns[:, c] = len(self.unknowns)
                self.unknowns.append((q, None))
        self.n_parameters = len(self.unknowns)
        self.sigma0 = []
        for c, s in enumerate(model.uncertain):
            for r in recordings:
                self.columns[r, len(model.active) + c] = len(self.unknowns)
                self.unknowns.append((f"{s} at the start", r))
                self.sigma0.append(model.plant.nodes[s].initial_sigma or 1.0)
        self.at = [model.parameters.index(q) for q in model.active]
        self.fixed = np.array([model.vector(None, d.name) for d in self.excitations])

    def start(self, changes: Mapping[str, float]) -> np.ndarray:
        """Return the unknowns (scaled) at the plant's values, with changes."""
        out = []
        for q, r in self.unknowns:
            if q in self.scales:
                p = self.model.plant.parameters[q]
                own = p.value_in(self.excitations[r].name) if r is not None else p.value
                scale = self.scales[q]
                out.append(scale.z(min(max(changes.get(q, own), scale.low), scale.high)))
            else:
                out.append(0.0)
        return np.array(out)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest values of the unknowns (scaled)."""
        starts = np.arange(len(self.unknowns)) >= self.n_parameters
        return np.where(starts, -FAR, 0.0), np.where(starts, FAR, 1.0)

    def at_bound(self, z: np.ndarray) -> dict[str, str]:
        """Return "low" or "high" for each parameter at an end of its range."""
        return {
            q: "low" if z[k] <= EDGE else "high"
            for k, (q, _) in enumerate(self.unknowns[: self.n_parameters])
            if not EDGE < z[k] < 1 - EDGE
        }

    def with_noise(self, j: int, n: Noise) -> Problem:
        """Return the same problem with another noise of output j."""
        other = copy.copy(self)
        other.noise = (*self.noise[:j], n, *self.noise[j + 1 :])
        other.whitening = [
            [Whitening.of(d, j, n) if k == j else w for k, w in enumerate(outputs)]
            for d, outputs in zip(self.excitations, self.whitening, strict=True)
        ]
        return other

    def unpack(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (recordings, parameters) and shifts of initial states (recordings, states)."""
        n, first = self.n_parameters, len(self.model.active)
        named = (self.scales[q].value(x) for (q, _), x in zip(self.unknowns, z[:n], strict=False))
        own = np.array([*named, *(z[n:] * self.sigma0), np.nan])[self.columns]
        values, known = self.fixed.copy(), self.columns >= 0
        values[:, self.at] = np.where(known[:, :first], own[:, :first], values[:, self.at])
        return values, np.where(known[:, first:], own[:, first:], 0.0)

    def each(
        self, f: Callable[[int, np.ndarray, np.ndarray], R], point: tuple[np.ndarray, np.ndarray], size: int
    ) -> list[R]:
        """Return f(r, values[r], dx0[r]) of each recording r.

        `point`: values and dx0. `size`: cost in runs without sensitivities."""
        values, dx0 = point
        return each(lambda r: f(r, values[r], dx0[r]), range(len(self.excitations)), size * self.numbers)

    def set_outlier_limits(self, residuals: Sequence[np.ndarray]) -> bool:
        """Set Huber's limit of each output from its residuals; True if one changed by more than a half.

        Residuals of missing physics must not count as outliers, nor anything that affects more than one
        sample in fifty."""
        new = np.full(len(self.noise), HUBER)
        for j in range(len(self.noise)):
            w = np.concatenate([self.whitening[r][j].whiten(e[:, j]) for r, e in enumerate(residuals)])
            if len(w):
                middle, high = np.quantile(np.abs(w), [0.5, 0.98])
                new[j] = max(HUBER * max(1.0, 1.4826 * float(middle)), float(high))
        changed = bool(np.any((new > 1.5 * self.huber) | (new < self.huber / 1.5)))
        self.huber = new
        return changed

    @property
    def few(self) -> bool:
        """Whether a trial step should run with sensitivities at once."""
        return len(self.model.unknowns) <= FEW_UNKNOWNS

    def keep(self) -> None:
        """Leave the rows of the newest evaluation as they are until the next call."""
        if self.few:  # else nothing runs with sensitivities before these rows are used up
            self.buffers, self.kept_buffers = self.kept_buffers, self.buffers

    def prior(self) -> np.ndarray:
        """Return the weight of each unknown's default prior (its entry in the Gauss-Newton matrix)."""
        return np.concatenate(
            [np.full(self.n_parameters, PRIOR_WEIGHT**2), np.ones(len(self.unknowns) - self.n_parameters)]
        )

    def jacobian(
        self, r: int, values: np.ndarray, dx0: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return recording r's unknowns (k,), its outputs (N, ny) and their slopes (N, ny, k)."""
        run = self.model.run(self.excitations[r], values, dx0, sensitivities=True, states=False)
        used, k, slope = self.slopes(r, values)
        return k, run.y, run.sensitivities[:, :, used] * slope

    def errors(self, r: int, values: np.ndarray, dx0: np.ndarray) -> np.ndarray:
        """Return recording r's free-run errors (N, ny), NaN where nothing was measured."""
        return self.excitations[r].y - self.model.run(self.excitations[r], values, dx0).y

    def evaluate(self, z: np.ndarray, jacobian: bool, keep: list[ResidualRows] | None = None) -> Evaluation:
        """Evaluate the cost, and with `jacobian` its derivatives. Raises SimulationError.

        The rows that `curvature` needs are appended to `keep`, if they may be kept (`keeps`). The next
        evaluation with derivatives overwrites them, unless `self.keep` is called."""
        cost, gradient, matrix = 0.0, np.zeros(len(z)), np.zeros((len(z), len(z)))
        keeping = self.keeps and keep is not None
        residuals = []
        parts = self.each(partial(self._part, jacobian, keeping), self.unpack(z), jacobian + 1)
        for r, part in enumerate(parts):
            cost += part.cost
            residuals.append(part.residual)
            if keep is not None:
                keep += [dataclasses.replace(rows, recording=r) for rows in part.rows]
            if jacobian:
                np.add.at(gradient, part.unknowns, part.gradient)
                matrix[np.ix_(part.unknowns, part.unknowns)] += part.matrix
        if not np.isfinite(matrix).all():
            raise SimulationError("the simulation grows too fast: its slopes by the unknowns are no numbers")
        prior_cost, prior_gradient, prior_matrix = self.prior_terms(self.unpack(z)[0], jacobian)
        weight, distance = self.prior(), z - self.z_plant
        cost = cost + prior_cost + float(np.sum(weight * distance**2))
        gradient = gradient + prior_gradient - weight * distance
        return Evaluation(cost, gradient, matrix + prior_matrix + np.diag(weight), residuals)

    def _part(self, jacobian: bool, keeping: bool, r: int, values: np.ndarray, dx0: np.ndarray) -> _Part:
        """Return what one recording adds to an evaluation. Raises SimulationError."""
        d, buffers = self.excitations[r], self.buffers if self.keeps else {}
        run = self.model.run(d, values, dx0, sensitivities=jacobian, buffers=buffers, states=False)
        if not np.all(np.abs(run.y) < HUGE):
            raise SimulationError(f"{d.name}: the simulation gives values that are not numbers")
        e, cost, kept = d.y - run.y, 0.0, []
        used, k, slope = self.slopes(r, values)
        gradient, matrix = np.zeros(len(k)), np.zeros((len(k), len(k)))
        for j, whitening in enumerate(self.whitening[r]):
            if not len(whitening.index):
                continue
            w = whitening.whiten(e[:, j])
            size, limit = np.abs(w), self.huber[j]
            cost += float(np.sum(np.where(size <= limit, w * w, 2 * limit * size - limit**2)))
            if run.dy is None:
                continue
            weight = np.where(size <= limit, 1.0, limit / np.maximum(size, limit))
            dy = run.dy[:, j] if len(used) == run.dy.shape[2] else run.dy[:, j, used]
            rows = self._weighted(r, j, k, slope, w, weight, dy)
            if keeping:
                kept.append(rows)
            gradient += rows.slope * (rows.jac.T @ (rows.weight * rows.w))
            matrix += _gram(rows.jac, rows.weight) * np.outer(rows.slope, rows.slope)
        return _Part(cost, k, gradient, matrix, e, kept)

    def prior_terms(self, values: np.ndarray, derivatives: bool) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the priors' cost, half its negative gradient and half its second derivatives."""
        n = len(self.unknowns)
        cost, gradient, matrix = 0.0, np.zeros(n), np.zeros((n, n))
        for prior in self.priors:
            r = next(r for r, d in enumerate(self.excitations) if d.name == prior.recording)
            by_name = dict(zip(self.model.parameters, map(float, values[r]), strict=True))
            cost += float(ex.evaluate(prior.neg2_log, by_name))
            used = [
                (q, self.columns[r, c], self.scales[q].slope(by_name[q]))
                for c, q in enumerate(self.model.active)
                if derivatives and self.columns[r, c] >= 0 and q in ex.names(prior.neg2_log)
            ]
            for q, k, slope in used:
                first = ex.derivative(prior.neg2_log, q)
                gradient[k] -= 0.5 * slope * float(ex.evaluate(first, by_name))
                for q2, k2, slope2 in used:
                    second = float(ex.evaluate(ex.derivative(first, q2), by_name))
                    matrix[k, k2] += 0.5 * slope * slope2 * second
        return cost, gradient, matrix

    def curvature(self, z: np.ndarray, step: np.ndarray, kept: Sequence[ResidualRows]) -> np.ndarray:
        """Return J' d2w/dh2 of the whitened residuals w(z + h step), by one more simulation.

        Raises SimulationError."""
        errors = self.each(self.errors, self.unpack(z + PROBE * step), 1)
        out = np.zeros(len(z))
        for rows in kept:
            r, j = rows.recording, rows.output
            whitening = self.whitening[r][j]
            moved = whitening.spread(whitening.whiten(errors[r][:, j]), len(rows.w))
            second = (moved - rows.w) / PROBE + rows.jac @ (rows.slope * step[rows.unknowns])
            np.add.at(out, rows.unknowns, rows.slope * (rows.jac.T @ (rows.weight * second)))
        return out * (2 / PROBE)

    def slopes(self, r: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the indices of recording r's sensitivities to unknowns, the unknowns' numbers, and dq/dz."""
        used = np.flatnonzero(self.columns[r] >= 0)
        active = self.model.active
        slopes = [
            self.scales[active[c]].slope(values[self.model.parameters.index(active[c])])
            if c < len(active)
            else self.sigma0[self.columns[r, c] - self.n_parameters]
            for c in used
        ]
        return used, self.columns[r, used], np.array(slopes)

    def _weighted(
        self,
        r: int,
        j: int,
        k: np.ndarray,
        slope: np.ndarray,
        w: np.ndarray,
        weight: np.ndarray,
        jac: np.ndarray,
    ) -> ResidualRows:
        """Return output j's rows from its whitened residuals, their weights and sensitivities (N, k).

        White noise of one standard deviation only scales the sensitivities: they are not copied, and a
        missing sample gets weight 0."""
        own, n = self.whitening[r][j], len(jac)
        if not own.white or len(own.index) < (1 - DOWNDATE_SHARE) * n:
            return ResidualRows(r, j, k, slope, own.whiten(jac), w, weight)
        return ResidualRows(r, j, k, slope / own.noise.sigma, jac, own.spread(w, n), own.spread(weight, n))


def _gram(jac: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted normal matrix J'WJ.

    If few rows are down-weighted, compute J'J and subtract their excess."""
    lowered = np.flatnonzero(weight != 1.0)
    if len(lowered) > DOWNDATE_SHARE * len(jac):
        jac = jac * np.sqrt(weight)[:, None]
        lowered = lowered[:0]
    few = jac[lowered] * np.sqrt(1.0 - weight[lowered])[:, None]
    with np.errstate(over="ignore", invalid="ignore"):  # the sensitivities of a run away from the data
        return jac.T @ jac - few.T @ few
