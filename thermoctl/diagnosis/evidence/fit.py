"""A hypothesis refitted, and its log evidence by Laplace's method.

    log p(D | h) ~ log p(D | z^) + log p(z^) + k/2 log 2 pi - 1/2 log |H|

    H = J' E[1/V] J + prior's precision

z: parameters of plant and effects, 0..1 in their ranges, and initial states in their standard deviations.
The scale is logarithmic where a range spans a factor of three. log p(D | z) is averaged over noise and
remainder (noise.py). Its maximum is found in posterior.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import chdtrc, chdtri

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.data.memory import Past, PlacedBefore
from thermoctl.diagnosis.evidence.curvature import deviations, kept, relieved, without_slopes
from thermoctl.diagnosis.evidence.noise import Averaged, averaged
from thermoctl.diagnosis.evidence.onsets import moved
from thermoctl.diagnosis.evidence.posterior import Hypothesis, Posterior, Seen, gaussian
from thermoctl.diagnosis.evidence.posterior import Placed as Placed
from thermoctl.diagnosis.evidence.starts import beside_parent, first_point
from thermoctl.diagnosis.hypothesis.candidates import Keys
from thermoctl.diagnosis.hypothesis.effect import EffectParameter
from thermoctl.plant.fitting import refit
from thermoctl.plant.fitting.climb import Climbed
from thermoctl.plant.fitting.estimate import updated
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import SimulationError

SIGNIFICANT = 2.0  # standard deviations
UNIFORM = 12.0  # precision of a uniform prior over 0..1
PERIODS = 15.0  # range of all possible periods over the range that a refit gives a period (logarithms)
DECADES = 4.0  # width of the log-uniform prior of an effect's size
WHITE, ROUGH = 12, 0.1  # iterations and tolerance of the refit in white noise, from which the climb starts
HOPELESS = 50.0  # a refit ends early if it would stay this many nats below the best hypothesis
MOVES = 4  # largest number of refits after times or levels were moved
TINY = 1e-300
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Fitted:
    """A hypothesis after its refit."""

    hypothesis: Hypothesis
    plant: Plant
    fit: Fit  # its Hessian is that of the parameters, with the initial states eliminated
    log_likelihood: float
    log_prior: float
    volume: float  # k/2 log 2 pi - 1/2 log |H|
    average: Averaged
    powers: tuple[np.ndarray, ...]
    sd: Mapping[str, float]  # standard deviations of the effects' parameters
    rough_plant: Plant
    rough: Fit  # refit in white noise: its free run is closest to the data, and extensions start there
    rough_powers: tuple[np.ndarray, ...]
    curvature: np.ndarray  # H of the unknowns that all recordings share, the others eliminated
    past: Past  # posterior of earlier recordings
    before: tuple[Keys, float] | None  # effects and log likelihood of the hypothesis it extends

    @property
    def absent(self) -> Keys:
        """Return the effects that are not significant."""
        return frozenset(e.key for e in self.hypothesis.effects if _insignificant(self, e, _none_stands))

    @property
    def doubtful(self) -> bool:
        """Return whether a part of an effect is not significant: a simpler hypothesis may replace it."""
        return any(
            _insignificant(self, e, _one_does_not_stand)
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


Amplitudes = Callable[[Fitted, Placed, Sequence[EffectParameter]], bool]


def _insignificant(f: Fitted, e: Placed, which: Amplitudes) -> bool:
    """Return whether one, or none, of the amplitudes of the effect stands out of no effect.

    An effect without an amplitude (lag, delay) is insignificant if a parameter is at its lower bound. So is a
    periodic effect with a period at its upper bound: the period does not repeat in the recordings. So is an
    effect with an `at_zero` parameter at its lower bound: at zero it is a simpler effect."""
    sizes = [p for p in e.candidate.effect.parameters if p.amplitude and p.name in e.own]
    if not set(e.own.values()) <= f.plant.parameters.keys():
        return True  # another effect replaced the equation that it changes
    effect = e.candidate.effect
    for p in effect.parameters:
        bound = f.fit.at_bound.get(e.own.get(p.name, ""))
        if bound == "high" and effect.shapes.get(p.shape or "") == "periods" or bound == "low" and p.at_zero:
            return True
    if e.candidate.effect.prior is not None:
        return False
    if not sizes:
        return any(f.fit.at_bound.get(n) == "low" for n in e.own.values())
    return which(f, e, sizes)


def near_nothing(f: Fitted, e: Placed) -> bool:
    """Return whether each amplitude of an effect is within SIGNIFICANT sd of no effect; False without one."""
    sizes = [p for p in e.candidate.effect.parameters if p.amplitude and e.own.get(p.name) in f.sd]
    return bool(sizes) and all(_near_null(f, e, p) for p in sizes)


def _near_null(f: Fitted, e: Placed, p: EffectParameter) -> bool:
    """Return whether a parameter is within SIGNIFICANT sd of the value at which it changes nothing."""
    return abs(_distance(f, e, p)) < SIGNIFICANT


def _one_does_not_stand(f: Fitted, e: Placed, sizes: Sequence[EffectParameter]) -> bool:
    """Return whether an amplitude is within SIGNIFICANT sd of no effect; those of one direction are one.

    The first one is that of the simpler entry which the effect contains. The plant may have it already."""
    if len(e.candidate.effect.dims) == 1:
        return _none_stands(f, e, sizes)
    own = sizes[1:] if e.candidate.effect.contains and len(sizes) > 1 else sizes
    return any(_near_null(f, e, p) for p in own)


def _none_stands(f: Fitted, e: Placed, sizes: Sequence[EffectParameter]) -> bool:
    """Return whether all amplitudes together are as near to no effect as one within SIGNIFICANT sd of it.

    Where a parameter of the plant replaces a large effect, all are uncertain. Then the likelihood without the
    effect tells, by twice the log of their ratio (Wilks 1938), which does not depend on how the effect is
    parametrised."""
    enough = chdtri(len(sizes), chdtrc(1, SIGNIFICANT**2))
    known, likelihood = f.before or (None, 0.0)
    if known == f.hypothesis.keys - {e.key} and 2 * (f.log_likelihood - likelihood) >= enough:
        return False
    if _is_of_recordings(f, e, sizes):
        return all(_near_null(f, e, p) for p in sizes)
    return _away(f, e, sizes) < enough


def _is_of_recordings(f: Fitted, e: Placed, sizes: Sequence[EffectParameter]) -> bool:
    """Return whether a parameter has a value for each recording."""
    return any((e.own[p.name], None) not in f.fit.unknowns for p in sizes)


def significance(f: Fitted, e: Placed) -> float:
    """Return the square of the distance of an effect from none, in standard deviations of noise."""
    sizes = [p for p in e.candidate.effect.sizes if e.own.get(p.name) in f.sd]
    if _is_of_recordings(f, e, sizes):
        return max(_distance(f, e, p) ** 2 for p in sizes)
    return _away(f, e, sizes)


def _away(f: Fitted, e: Placed, sizes: Sequence[EffectParameter]) -> float:
    """Return the square of the distance of parameters from no effect, in standard deviations.

    Storage and conductance of a hidden mass replace each other: each is uncertain, both are certain together.
    So the distance has the metric of their correlations."""
    columns = [q for q, r in f.fit.unknowns if r is None]
    of_effects = {n for x in f.hypothesis.effects for n in x.own.values()}
    moves = np.array([q not in f.fit.at_bound or q in of_effects for q in columns])
    inverse = np.linalg.pinv(f.curvature[np.ix_(moves, moves)], hermitian=True)
    moving = [q for q, m in zip(columns, moves, strict=True) if m]
    at = [moving.index(e.own[p.name]) for p in sizes]
    spread = inverse[np.ix_(at, at)]
    size = np.sqrt(np.maximum(np.diag(spread), TINY))
    distance = np.array([_distance(f, e, p) for p in sizes])
    return float(distance @ np.linalg.pinv(spread / np.outer(size, size), hermitian=True) @ distance)


def _distance(f: Fitted, e: Placed, p: EffectParameter) -> float:
    """Return how far a parameter is from the value at which it changes nothing, in standard deviations.

    Of one with a value for each recording, the farthest counts."""
    own = e.own[p.name]
    q = f.plant.parameters[own]
    values = [*q.values.values()] if q.per_recording else [q.value]
    return (max(values, key=lambda v: abs(v - p.null)) - p.null) / max(f.sd[own], TINY)


def fitted(
    case: Case,
    plant: Plant,
    effects: Sequence[Placed],
    start: Fit | None = None,
    best: Fitted | None = None,
    parent: Fitted | None = None,
) -> Fitted:
    """Refit a plant that holds these effects and compute its log evidence. Raises SimulationError.

    The refit ends early if it stays far from `best`, the best hypothesis so far. `parent`: the hypothesis
    before the last effect was added."""
    case.budget.spend()
    result = _refitted(case, plant, effects, start, best, parent)
    for _ in range(MOVES):
        behind = best is not None and result.log_likelihood < best.log_likelihood - HOPELESS
        later = None if behind else moved(case, result.rough_plant, effects, result.rough)
        again = later and _refitted(case, later, effects, None, best, parent)
        if not again or again.log_evidence <= result.log_evidence:
            break
        result = again
    return result


def placed_at(case: Case, f: Fitted, parameters: Mapping[str, float]) -> Fitted:
    """Return a hypothesis as it stands at other values of its parameters. Raises SimulationError.

    Extensions start there; its likelihood is still that of its refit."""
    known = {
        q: dataclasses.replace(p, value=parameters.get(q, p.value)) for q, p in f.plant.parameters.items()
    }
    plant = dataclasses.replace(f.plant, parameters=known)
    posterior = Posterior(case, plant, f.hypothesis.effects)
    rough = refit.fit(
        posterior.model, posterior.drives, case.noise, iterations=0, priors=posterior.problem.priors
    )
    powers = case.coordinates.powers(posterior.rows(rough.residuals))
    return dataclasses.replace(f, rough_plant=plant, rough=rough, rough_powers=tuple(powers))


def _refitted(
    case: Case,
    plant: Plant,
    effects: Sequence[Placed],
    start: Fit | None,
    best: Fitted | None,
    parent: Fitted | None,
) -> Fitted:
    """Refit a plant from one starting point; the arguments are those of `fitted`.

    Where times may be held at first, the rough refit is made with and without, and the better one counts.
    A hypothesis contains its parent. A refit that ends with a lower likelihood starts again from the
    parent."""
    posterior = Posterior(case, plant, effects)
    if start is None:
        first, there, held = first_point(posterior, parent.rough.cost if parent else np.inf)
        rough = partial(
            refit.fit,
            posterior.model,
            posterior.drives,
            case.noise,
            start=first,
            there=there,
            iterations=WHITE,
            tolerance=ROUGH,
            goal=best.rough.cost if best else np.inf,
            priors=posterior.problem.priors,
            seconds=np.inf,
        )
        start = min([rough(held=h) for h in dict.fromkeys(((), tuple(held)))], key=lambda f: f.cost)
    goal = best.log_likelihood - HOPELESS if best else -np.inf
    z = start.z.copy()
    z[posterior.shared] = posterior.past.z
    top = posterior.climb(z, goal)
    if parent and top.spot.found.average.log_likelihood < parent.log_likelihood:
        try:
            other = posterior.climb(beside_parent(posterior, parent.hypothesis.keys, parent.fit), goal)
        except SimulationError:
            other = top
        top = max(top, other, key=lambda t: t.spot.height)
    return _weighed(case, posterior, top, start, parent)


def _weighed(
    case: Case, posterior: Posterior, top: Climbed[Seen], rough: Fit, parent: Fitted | None
) -> Fitted:
    """Return the fitted hypothesis at the maximum `top`, with its log evidence by Laplace's method."""
    problem, matrix = posterior.problem, top.matrix
    flat, spot = without_slopes(posterior, top.spot, matrix)
    z, average, powers, errors = spot.z, spot.found.average, spot.found.powers, spot.found.errors
    values, dx0 = problem.unpack(z)
    own, parameters = np.ones(len(z), bool), np.arange(len(z)) < problem.n_parameters
    own[np.concatenate([gaussian(posterior), posterior.believed])] = False
    confined = matrix + np.diag(np.where(own, UNIFORM, 0.0))  # a range has a width
    confined = relieved(confined, posterior.relief(z, spot.found.rows, average))
    confined += np.diag(flat)
    bounds = problem.at_bound(z)
    sd = deviations(posterior, values, confined, bounds)
    volume = 0.5 * len(z) * LOG_2PI - 0.5 * float(np.linalg.slogdet(confined)[1])
    maximum = Fit(
        posterior.model,
        values,
        dx0,
        -2 * average.log_likelihood,
        problem.unknowns,
        z,
        kept(matrix, parameters),
        errors,
        case.noise,
        top.steps,
        problem.samples,
        bounds,
        problem.priors,
        converged=top.converged,
        left=2 * top.left,
    )
    # with hundreds of recordings, the Hessian with all initial states would fill the memory
    rough = dataclasses.replace(rough, hessian=kept(rough.hessian, parameters))
    rough_powers = case.coordinates.powers(posterior.rows(rough.residuals))
    if not problem.keeps:
        maximum, rough = (dataclasses.replace(x, residuals=[], sizes=x.rms()) for x in (maximum, rough))
    return Fitted(
        Hypothesis(tuple(posterior.effects)),
        updated(posterior.plant, maximum, posterior.drives),
        maximum,
        average.log_likelihood,
        log_density(posterior, z, sd),
        volume,
        average,
        tuple(powers),
        sd,
        updated(posterior.plant, rough, posterior.drives),
        rough,
        tuple(rough_powers),
        kept(confined, np.array([r is None for _, r in problem.unknowns], bool)),
        posterior.past,
        (parent.hypothesis.keys, parent.log_likelihood) if parent else None,
    )


def remembered(case: Case, f: Fitted) -> Past:
    """Return the posterior of a hypothesis from all recordings so far."""
    shared = np.array([r is None for _, r in f.fit.unknowns], bool)
    names = tuple(q for q, r in f.fit.unknowns if r is None)
    return Past(
        placed_before(f.hypothesis.effects, f.plant),
        names,
        tuple(f.plant.parameters[q].range or (0.0, 0.0) for q in names),
        f.fit.z[shared],
        f.curvature,
        f.log_evidence,
        {
            g.output: f.past.squares.get(g.output, 0.0) + sum(float(f.powers[k].sum()) for k in g.channels)
            for g in case.grids
        },
        {g.output: f.past.counts.get(g.output, 0.0) + float(g.count.sum()) for g in case.grids},
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


def as_refitted(case: Case, f: Fitted) -> Fitted:
    """Return the hypothesis at its other refit, in white noise: the free run is closest to the data there."""
    average = averaged(case.grids, f.rough_powers)
    return dataclasses.replace(f, plant=f.rough_plant, fit=f.rough, powers=f.rough_powers, average=average)


def closest(case: Case, f: Fitted) -> Fitted:
    """Return the hypothesis at that of its two refits whose free run is closest to the data.

    The refit in white noise does not know earlier recordings."""
    if f.past.unknowns:
        return f

    def far(of: Fitted) -> float:
        """Return the sum over outputs of the mean squares of errors over the noise."""
        rms = of.fit.rms()
        return sum((rms[o] / n.sigma) ** 2 for o, n in zip(rms, case.noise, strict=True) if rms[o] >= 0)

    return min((as_refitted(case, f), f), key=far)


def with_residuals(case: Case, f: Fitted) -> Fitted:
    """Return the fitted hypothesis with its residuals, simulated again if they were too many to keep."""
    if f.fit.residuals:
        return f
    drives, fit = case.drives(f.fit.model), f.fit
    errors = [
        d.y - fit.model.run(d, values, dx0).y
        for d, values, dx0 in zip(drives, fit.values, fit.dx0, strict=True)
    ]
    return dataclasses.replace(f, fit=dataclasses.replace(fit, residuals=errors))


def log_density(posterior: Posterior, z: np.ndarray, sd: Mapping[str, float]) -> float:
    """Return log p(z): Gaussians, uniform shapes, and the effects' sizes with standard deviations `sd`.

    A prior that a catalogue entry states counts as a Gaussian whose precision is the prior's curvature."""
    values, _ = posterior.problem.unpack(z)
    stated = posterior.problem.prior_terms(values, True)[2]
    out = posterior.prior(z)
    for precision, ks in ((posterior.precision, gaussian(posterior)), (stated, posterior.believed)):
        out += 0.5 * float(np.linalg.slogdet(precision[np.ix_(ks, ks)] / (2 * np.pi))[1])
    for k, (_, p) in posterior.sizes.items():
        q, r = posterior.problem.unknowns[k]
        if k not in posterior.shared:
            value = float(values[r or 0, posterior.model.parameters.index(q)])
            out += _size(p, value, sd[q]) + np.log(posterior.problem.scales[q].slope(value))
    new = [e for e in posterior.effects if e.key not in posterior.past.keys]
    periods = sum(kind == "periods" for e in new for kind in e.candidate.effect.shapes.values())
    return out - periods * float(np.log(PERIODS))


def _size(p: EffectParameter, value: float, sd: float) -> float:
    """Return the log prior density of an effect's size: log-uniform over DECADES decades or its bounds.

    For sizes below the standard deviation `sd` the density is nearly constant."""
    low, high = sorted((abs(p.low - p.null), abs(p.high - p.null)))
    one_sided = p.low >= p.null or p.high <= p.null
    decades = min(DECADES, np.log10(high / low)) if one_sided and 0 < low < high < np.inf else DECADES
    return -float(np.log(np.log(10.0) * decades * (1 if one_sided else 2) * np.hypot(value - p.null, sd)))
