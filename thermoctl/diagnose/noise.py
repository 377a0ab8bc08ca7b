"""Log marginal likelihood of residuals: sensor noise and remainder averaged over their spectra, not chosen.

In band b of an output, with n rows and power P = sum R^2, a row has this variance (coordinates.py).
Bands of an output's recordings at the same frequency count as one.

    V_b = c^2 s^2 + j^2 w^2 + q exp(u_b)
    log p(R | V) = -1/2 sum_b (n_b log 2 pi V_b + P_b / V_b)

s is the noise that the plant file states, c its error, log-normal. Recorded times may be off by j sampling
intervals, log-normal. A reading that changes by w in an interval is then off by j w, at all frequencies as
its noise is. Where slow parts are stated, s^2 follows their spectrum. q exp(u_b) is the remainder and every
slow error of the sensor. u is a random walk over log frequency: smooth, and its size is learnt at each
frequency. So an error of the plant at one frequency says little about another. But a plant with a large
error is not exact at any frequency. So at least the share FLOOR of the remainder's energy lies evenly over
all of them. Errors that nobody will name are small. So the remainder's share of the output's swing has a
half-normal prior of width SMALL, and q = (SMALL swing)^2.

    log p(R) = log [ABSENT p(R | none) + (1 - ABSENT) p(R | remainder)]

Without a remainder the noise has the stated spectrum. Where no slow parts are stated, it has with even odds a
first-order and a 1/f part, whose sizes and time are log-uniform. These, c, j and u are integrated by
Laplace's method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.special import logsumexp

from thermoctl.diagnose.grids import Grid
from thermoctl.diagnose.spectra import STARTS, slow_parts

ABSENT = 0.5  # prior of no remainder at an output
WHITE = 0.5  # prior of no slow part in a noise whose parts nobody stated
FLOOR = 0.1  # least share of the remainder's energy that is spread evenly over all frequencies
STEPS, CLOSE = 1000, 1e-4  # of Newton's method: largest number, and the predicted gain that ends it
LONGEST = 10.0  # step in a logarithm that is tried
DAMPED = 0.01  # first damping of a step, as a share of the curvature
# Nats of one output: up to LITTLE a predicted rise is taken to first order (rms error 0.02). Up to NEAR the
# known maxima are the start.
LITTLE, NEAR = 1.0, 5.0
LEAST = 1e-6  # of the stated noise's variance: a residual of zero has no logarithm
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Averaged:
    """A log marginal likelihood and its by-products.

    - `inverse`: E[1/V] in the bands of each channel
    - `sensor`: the noise's variance, by output
    - `remainder`: the probability that there is a remainder, by output
    - `unsure`: covariance (frequencies, frequencies) of 1/V, by output"""

    log_likelihood: float
    inverse: list[np.ndarray]
    sensor: list[float]
    remainder: list[float]
    unsure: list[np.ndarray]


@dataclass(frozen=True)
class _Output:
    """The same of one output; `inverse` (nodes,): E[1/V] at each of its frequencies.

    `at`: x at the maximum of each density."""

    log_likelihood: float
    inverse: np.ndarray
    sensor: float
    remainder: float
    unsure: np.ndarray
    at: tuple[np.ndarray, ...]


def averaged(grids: Sequence[Grid], powers: Sequence[np.ndarray]) -> Averaged:
    """Average the likelihood of banded `powers` (one a channel) over noise and remainder."""
    found = [_output(g, g.power(powers)) for g in grids]
    return Averaged(
        sum(f.log_likelihood for f in found),
        _by_channel(grids, [f.inverse for f in found], powers),
        [f.sensor for f in found],
        [f.remainder for f in found],
        [f.unsure for f in found],
    )


def _by_channel(
    grids: Sequence[Grid], inverse: Sequence[np.ndarray], powers: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return E[1/V] in the bands of each channel, from its values at the frequencies of each output."""
    out: list[np.ndarray] = [np.zeros(0)] * len(powers)
    for g, of_output in zip(grids, inverse, strict=True):
        parts = np.split(of_output[g.node], np.cumsum([len(powers[k]) for k in g.channels])[:-1])
        for k, part in zip(g.channels, parts, strict=True):
            out[k] = part
    return out


class Around:
    """Other powers beside known ones: by how much their log likelihood is above, and their weights.

    d log p / dP = -E[1/V] / 2. Where that makes less than LITTLE, the output is not averaged again; less than
    NEAR, the maxima are looked for from the known ones."""

    def __init__(self, grids: Sequence[Grid], powers: Sequence[np.ndarray]):
        self.grids = grids
        self.known = [(g, p := g.power(powers), _output(g, p)) for g in grids]

    def rise(self, others: Sequence[np.ndarray]) -> float:
        """Return by how much the log likelihood is above that of the known powers."""
        return sum(rise for rise, _ in self._each(others))

    def weighed(self, others: Sequence[np.ndarray]) -> tuple[float, list[np.ndarray]]:
        """Return this, and E[1/V] in the bands of each channel."""
        found = list(self._each(others))
        return sum(rise for rise, _ in found), _by_channel(self.grids, [v for _, v in found], others)

    def _each(self, others: Sequence[np.ndarray]) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the rise of each output, and E[1/V] at its frequencies."""
        for g, p, f in self.known:
            other = g.power(others)
            first = -0.5 * f.inverse * (other - p)
            size = float(np.abs(first).sum())
            if size < LITTLE:
                yield float(first.sum()), f.inverse
            else:
                again = _output(g, other, f.at if size < NEAR else None)
                yield again.log_likelihood - f.log_likelihood, again.inverse


def _output(g: Grid, power: np.ndarray, near: Sequence[np.ndarray] | None = None) -> _Output:
    """Average the likelihood of an output's power at each frequency (nodes,). `near`: x to start from."""
    power = np.maximum(power, LEAST * g.variance * g.count)
    densities: list[_Noise | _Remainder]
    densities = [_Noise(g, power, slow) for slow in ([False] if g.sensor else [False, True])]
    densities.append(_Remainder(g, power, block_diag(np.diag(g.scales**-2.0), g.rough)))
    starts: list[np.ndarray | None] = [*near] if near else [None] * len(densities)
    found = [_laplace(d, x) for d, x in zip(densities, starts, strict=True)]
    odds = ABSENT * np.array([1.0] if g.sensor else [WHITE, 1 - WHITE])
    scores = np.log(np.append(odds, 1 - ABSENT)) + [f.log_p for f in found]
    whole = float(logsumexp(scores))
    weight = np.exp(scores - whole)
    each = np.array([1 / f.variance for f in found])
    mean = weight @ each
    apart = each - mean
    within = sum(w * f.unsure for w, f in zip(weight, found, strict=True))
    sensor = float(weight @ [f.sensor for f in found])
    unsure = within + (apart.T * weight) @ apart
    return _Output(whole, mean, sensor, float(weight[-1]), unsure, tuple(f.x for f in found))


@dataclass(frozen=True)
class _At:
    """A log density at x, V there, d log V / dx, and slope and curvature of minus the log density."""

    x: np.ndarray
    log_density: float
    variance: np.ndarray
    slope: np.ndarray
    uphill: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True)
class _Noise:
    """The log density of an output's residual without a remainder, and its derivatives.

    x holds log c^2 and, where it may be seen, log j^2 over its median. With `slow` parts that nobody stated
    it holds their sizes and time, too: the standard normal values of the same probability."""

    grid: Grid
    power: np.ndarray
    slow: bool

    @property
    def log_prior(self) -> float:
        """Log of the prior's normalisation, without 2 pi."""
        return -float(np.log(self.grid.scales).sum())

    def start(self) -> np.ndarray:
        """Return the likeliest x of some, the times without an error."""
        g, n = self.grid, self.grid.count.sum()
        shapes = g.slow if self.slow else g.shape[None]
        level = np.log((self.power / shapes).sum(axis=1) / n / g.variance)
        score = -0.5 * (n * level + (level / g.known) ** 2 + np.log(shapes) @ g.count)
        k = int(np.argmax(score))
        other = STARTS[k] if self.slow else np.zeros(0)
        return np.concatenate([[level[k]], np.zeros(len(g.scales) - 1), other])

    def at(self, x: np.ndarray) -> _At:
        """Return the log density, V and their derivatives at x."""
        g, first = self.grid, len(self.grid.scales)
        precision = np.append(g.scales**-2.0, np.ones(len(x) - first))
        shape, change, second = g.shape, np.zeros((0, len(g.count))), np.zeros((0, 0, len(g.count)))
        if self.slow:
            shape, change, second = slow_parts(g.turn, x[first:])
            mean = g.count / g.count.sum()
            whole = shape @ mean
            shape, change, second = shape / whole, change / whole, second / whole
            drift, bend = change @ mean, second @ mean  # the mean over all rows stays 1
            crossed = change[:, None] * drift[None, :, None]
            second = second - crossed - crossed.transpose(1, 0, 2) - shape * bend[..., None]
            second += 2 * shape * np.outer(drift, drift)[..., None]
            change = change - shape * drift[:, None]
        noise = g.variance * np.exp(x[0])
        parts = [noise * shape]
        if first > 1:
            parts.append(np.full(len(shape), g.variance * g.clock * np.exp(x[1])))
        v = np.sum(parts, axis=0)
        slope = np.concatenate([parts, noise * change]) / v
        bends = np.zeros((len(x), *slope.shape))
        for k, part in enumerate(parts):
            bends[k, k] = part / v
        bends[0, first:] = bends[first:, 0] = noise * change / v
        bends[first:, first:] = noise * second / v
        p = self.power / v
        pull = 0.5 * (g.count - p)
        curvature = (slope * (p - 0.5 * g.count)) @ slope.T + bends @ pull + np.diag(precision)
        density = -0.5 * float(g.count @ np.log(v) + p.sum() + precision @ x**2)
        return _At(x, density, v, slope.T, slope @ pull + precision * x, curvature)


@dataclass(frozen=True)
class _Remainder:
    """The log density of an output's residual and of x, and its derivatives.

    x holds log c^2 and, where it may be seen, log j^2 over its median, then u."""

    grid: Grid
    power: np.ndarray
    precision: np.ndarray  # of the Gaussian prior of x

    @property
    def log_prior(self) -> float:
        """Log of the prior's normalisation, without 2 pi."""
        g = self.grid
        return -float(np.log(g.scales).sum()) + 0.5 * g.log_rough - g.log_small

    def at(self, x: np.ndarray) -> _At:
        """Return the log density, V and their derivatives at x.

        The curvature is exact: the expected one (Fisher) misleads where a residual spans many decades."""
        g, first = self.grid, len(self.grid.scales)
        noise, free = g.variance * g.shape * np.exp(x[0]), np.exp(x[first:])
        timing = g.variance * g.clock * np.exp(x[first - 1])
        part = g.count * free / g.count.sum()
        v = noise + g.small * (free + FLOOR * part.sum())
        slope = np.empty((len(free), len(x)))
        slope[:, first:] = g.small * FLOOR * part
        slope[:, 0] = noise
        if first > 1:
            v = v + timing
            slope[:, 1] = timing
        own = np.arange(len(free))
        slope[own, first + own] += g.small * free
        slope /= v[:, None]
        p, prior = self.power / v, self.precision @ x
        density = -0.5 * float(g.count @ np.log(v) + p.sum() + part.sum() + x @ prior)
        pull = 0.5 * (slope.T @ (g.count - p) + np.concatenate([np.zeros(first), part]))
        curvature = (slope.T * (p - 0.5 * g.count)) @ slope + self.precision
        curvature.flat[:: len(x) + 1] += pull
        return _At(x, density, v, slope, pull + prior, curvature)

    def start(self) -> np.ndarray:
        """Return an x near the maximum."""
        g = self.grid
        seen = self.power / g.count / g.small
        none = np.zeros(len(g.scales))
        return np.concatenate([none, np.log(np.minimum(seen, np.sqrt(seen * g.count.sum())))])


@dataclass(frozen=True)
class _Found:
    """One case: x at the maximum, log p(R), the noise's variance, V at each frequency, covariance of 1/V."""

    x: np.ndarray
    log_p: float
    sensor: float
    variance: np.ndarray
    unsure: np.ndarray


def _laplace(d: _Noise | _Remainder, near: np.ndarray | None = None) -> _Found:
    """Integrate a density about its maximum, which Newton's method with damping finds from x `near`."""
    g, at = d.grid, d.at(d.start() if near is None else near)
    damping = 0.0
    for _ in range(STEPS):
        h = at.curvature
        damped = h + damping * np.diag(np.abs(np.diag(h))) if damping else h
        factor, indefinite = dpotrf(damped, lower=1)
        step = dpotrs(factor, at.uphill, lower=1)[0]
        if 0.5 * at.uphill @ step < CLOSE and not indefinite and not (damping and dpotrf(h, lower=1)[1]):
            break
        then = d.at(at.x - step) if not indefinite and np.abs(step).max() < LONGEST else None
        if then and then.log_density >= at.log_density:
            at, damping = then, damping / 4 if damping > DAMPED else 0.0
        else:
            damping = max(4 * damping, DAMPED)
    factor = np.linalg.cholesky(at.curvature)
    score = at.log_density - 0.5 * float(g.count.sum()) * LOG_2PI + d.log_prior
    score -= float(np.log(np.diag(factor)).sum())
    moves = solve_triangular(factor, (at.slope / at.variance[:, None]).T, lower=True)
    timing = g.clock * np.exp(at.x[len(g.scales) - 1])
    return _Found(at.x, score, float(g.variance * (np.exp(at.x[0]) + timing)), at.variance, moves.T @ moves)
