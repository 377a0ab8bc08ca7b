"""Log marginal likelihood of residuals: sensor noise and remainder averaged over their spectra, not chosen.

In band b of an output, with n rows and power P = sum R^2, a row has this variance (coordinates.py).
Bands of an output's recordings at the same frequency count as one.

    V_b = c^2 s^2 + q exp(u_b),   log p(R | V) = -1/2 sum_b (n_b log 2 pi V_b + P_b / V_b)

s is the noise that the plant file states, c its error, log-normal. Where slow parts are stated, s^2 follows
their spectrum. q exp(u_b) is the remainder and every slow error of the sensor. u is a random walk over log
frequency: smooth, and its size is learnt at each frequency. So an error of the plant at one frequency says
little about another. But a plant with a large error is not exact at any frequency. So at least the share
FLOOR of the remainder's energy lies evenly over all of them. Errors that nobody will name are small. So
the remainder's share of the output's swing has a half-normal prior of width SMALL, and q = (SMALL swing)^2.

    log p(R) = log [ABSENT p(R | none) + (1 - ABSENT) p(R | remainder)]

Without a remainder the noise has the stated spectrum. Where no slow parts are stated, it has with even odds a
first-order and a 1/f part. Their shares and time are summed over a grid. c and u are integrated by Laplace's
method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.special import logsumexp

from thermoctl.diagnose.coordinates import WIDTH, Coordinates
from thermoctl.plant.language import SensorNoise

STATED = 1.0  # prior sd of log c^2: in one case of three a stated noise is off by more than 1.6 times
ABSENT = 0.5  # prior of no remainder at an output
WHITE = 0.5  # prior of no slow part in a noise whose parts nobody stated
SMALL = 0.02  # of an output's swing: width of the prior of the remainder's rms
# Prior sd of u (see above) at the lowest frequency: one sd is a factor of ten in the remainder's rms.
LEVEL = 2 * np.log(10.0)
FLOOR = 0.1  # least share of the remainder's energy that is spread evenly over all frequencies
DRAWS = 400  # random walks drawn for the normalisation of the remainder's prior
WALK = np.log(4.0)  # standard deviation of u's step over an octave: 1/f^2, a white force on one storage
STEPS, CLOSE = 100, 1e-4  # of Newton's method: largest number, and the gain that ends it
LONGEST = 10.0  # step in a logarithm that is tried
DAMPED = 0.01  # first damping of a step, as a share of the curvature
LEAST = 1e-6  # of the stated noise's variance: a residual of zero has no logarithm to start from
# Slow parts of a noise that nobody stated: a first-order part and a 1/f part. Their standard deviations (the
# latter's over a decade) are shares of the white part's. Time constants are in sampling intervals. Slower or
# larger errors of a sensor belong to the remainder: as noise they would imitate physics.
SHARES, TIMES, FLICKERS = (1 / 3, 2 / 3, 1.0), (1.0, 3.0, 10.0), (0.0, 0.05)
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Grid:
    """The frequency grid of one output, common to its recordings, and the prior of its remainder there.

    `node`: for each band of all recordings, the index of the band's frequency in the grid. `count`: number of
    DCT rows at each frequency."""

    channels: tuple[int, ...]  # positions in Coordinates.channels
    node: np.ndarray
    count: np.ndarray
    shapes: np.ndarray  # (spectra, nodes) of the noise, the stated one first; their mean over all rows is 1
    log_prior: np.ndarray  # (spectra,) of each
    known: float  # prior sd of log c^2
    rough: np.ndarray  # (nodes, nodes) inverse covariance of u
    log_rough: float  # its log determinant
    log_small: float  # log of the half-normal's mean over the random walk
    sigma: float  # s above: standard deviation of the stated noise, in the output's unit
    swing: float  # rms of the output about its mean
    sensor: SensorNoise | None  # the parts of the stated noise

    @property
    def variance(self) -> float:
        """Variance of the stated noise, s^2."""
        return self.sigma**2

    @property
    def shape(self) -> np.ndarray:
        """Spectrum of the stated noise, its mean over all rows 1."""
        return self.shapes[0]

    @property
    def small(self) -> float:
        """Square of the prior width of the remainder's rms, q."""
        return (SMALL * self.swing) ** 2


def grid(
    coordinates: Coordinates,
    positions: Sequence[int],
    sigma: float,
    swing: float,
    sensor: SensorNoise | None = None,
) -> Grid:
    """Return the frequencies of one output.

    `positions`: of its channels; `sigma`: its stated noise; `swing`: its rms about the mean. `sensor`: the
    parts of the noise, where the plant file states them."""
    channels = [coordinates.channels[k] for k in positions]
    octave = np.concatenate([np.log2(c.frequency) for c in channels])
    cells = np.round((octave - octave.min()) / np.log2(WIDTH)).astype(int)
    known, node = np.unique(cells, return_inverse=True)
    count = np.bincount(node, np.concatenate([c.count for c in channels]).astype(float))
    apart = np.diff(known) * np.log2(WIDTH)
    rough = np.zeros((len(known), len(known)))
    rough[0, 0] = LEVEL**-2
    for k, octaves in enumerate(apart):
        rough[k : k + 2, k : k + 2] += np.array([[1, -1], [-1, 1]]) / (WALK**2 * octaves)
    walks = np.linalg.solve(
        np.linalg.cholesky(rough).T, np.random.default_rng(3).standard_normal((len(known), DRAWS))
    )
    log_small = float(logsumexp(-0.5 * count @ np.exp(walks) / count.sum()) - np.log(DRAWS))
    log_rough = float(np.linalg.slogdet(rough)[1])
    frequency = np.exp2(octave.min()) * WIDTH**known
    interval = channels[0].interval
    slow = [] if sensor else _slow(frequency, interval)
    shapes = np.array([spectrum(sensor or SensorNoise(1.0), frequency, interval), *slow])
    return Grid(
        tuple(positions),
        node,
        count,
        shapes * count.sum() / (shapes @ count)[:, None],
        np.log([WHITE, *np.full(len(slow), (1 - WHITE) / len(slow))]) if slow else np.zeros(1),
        2 * sensor.sd if sensor and sensor.sd else STATED,
        rough,
        log_rough,
        log_small,
        sigma,
        swing,
        sensor,
    )


def spectrum(sensor: SensorNoise, frequency: np.ndarray, interval: float) -> np.ndarray:
    """Return the variance of a DCT row at each frequency: of the white, the first-order and the 1/f part.

    The first-order part has the spectrum of its samples, `interval` apart (an AR(1) process). A 1/f part with
    the standard deviation `flicker` over a decade has the density flicker^2 / (ln 10 f)."""
    out = np.full(len(frequency), sensor.white**2)
    if sensor.drift is not None and sensor.time is not None:
        phi = np.exp(-interval / sensor.time)
        turn = np.cos(2 * np.pi * frequency * interval)
        out += sensor.drift**2 * (1 - phi**2) / (1 - 2 * phi * turn + phi**2)
    if sensor.flicker is not None:
        out += sensor.flicker**2 / (2 * np.log(10.0) * frequency * interval)
    return out


def _slow(frequency: np.ndarray, interval: float) -> list[np.ndarray]:
    """Return spectra of noise with slow parts that nobody stated."""
    first = [(0.0, 1.0), *product(SHARES, TIMES)]
    return [
        spectrum(SensorNoise(1.0, drift=r, time=tau * interval, flicker=f), frequency, interval)
        for (r, tau), f in product(first, FLICKERS)
        if r or f
    ]


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


def averaged(grids: Sequence[Grid], powers: Sequence[np.ndarray]) -> Averaged:
    """Average the likelihood of banded `powers` (one a channel) over noise and remainder."""
    inverse: list[np.ndarray] = [np.zeros(0)] * sum(len(g.channels) for g in grids)
    total, sensor, present, unsure = 0.0, [], [], []
    for g in grids:
        power = np.bincount(g.node, np.concatenate([powers[k] for k in g.channels]))
        scores, owns = _sensor_only(g, power)
        none = float(logsumexp(scores))
        of = np.exp(scores - none)  # (spectra,) probability of each
        some, level, variance, spread = _with_remainder(g, power)
        total += float(np.logaddexp(np.log(ABSENT) + none, np.log(1 - ABSENT) + some))
        p = 1 / (1 + np.exp(np.clip(none - some, -500, 500)) * ABSENT / (1 - ABSENT))
        each = np.vstack([1 / (owns[:, None] * g.shapes), 1 / variance])
        weight = np.append((1 - p) * of, p)
        mean = weight @ each
        at = 0
        for k in g.channels:
            inverse[k] = mean[g.node[at : at + len(powers[k])]]
            at += len(powers[k])
        sensor.append(float(weight @ np.append(owns, level)))
        present.append(float(p))
        apart = each - mean
        unsure.append(p * spread + (apart.T * weight) @ apart)
    return Averaged(total, inverse, sensor, present, unsure)


def _sensor_only(g: Grid, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return log p(R, spectrum | no remainder), and the noise's variance, by spectrum."""
    n, ratio = float(g.count.sum()), (power / g.shapes).sum(axis=1) / g.variance
    v = np.log(np.maximum(ratio / n, LEAST))
    for _ in range(STEPS):
        step = (0.5 * (ratio * np.exp(-v) - n) - v / g.known**2) / (0.5 * n + g.known**-2)
        v += np.clip(step, -LONGEST, LONGEST)
        if np.all(abs(step) < CLOSE):
            break
    own = g.variance * np.exp(v)
    score = -0.5 * (n * (LOG_2PI + np.log(own)) + np.log(g.shapes) @ g.count + ratio * g.variance / own)
    score -= 0.5 * (v / g.known) ** 2
    return g.log_prior + score - np.log(g.known) - 0.5 * np.log(0.5 * n + g.known**-2), own


@dataclass(frozen=True)
class _Remainder:
    """The log density of an output's residual and of x = (log c^2, u), and its derivatives."""

    grid: Grid
    power: np.ndarray
    precision: np.ndarray  # of the Gaussian prior of x

    def spectra(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Return the log density, each frequency's part of the remainder's size, d log V / dx and V."""
        g = self.grid
        noise, free = g.variance * g.shape * np.exp(x[0]), np.exp(x[1:])
        part = g.count * free / g.count.sum()
        v = noise + g.small * (free + FLOOR * part.sum())
        slope = np.tile(g.small * FLOOR * np.concatenate([[0.0], part]), (len(free), 1))
        slope[:, 0] = noise
        slope[:, 1:] += np.diag(g.small * free)
        fit = g.count @ np.log(v) + (self.power / v).sum()
        density = -0.5 * float(fit + part.sum() + x @ self.precision @ x)
        return density, np.concatenate([[0.0], part]), slope / v[:, None], v

    def curvature(self, part: np.ndarray, slope: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and curvature of minus the log density, the gradient without the Gaussian prior.

        The curvature is exact: the expected one (Fisher) misleads where a residual spans many decades."""
        n, p = self.grid.count, self.power / v
        pull = 0.5 * (slope.T @ (n - p) + part)
        return pull, (slope.T * (p - 0.5 * n)) @ slope + self.precision + np.diag(pull)

    def maximum(self) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return log density, x, curvature, slope and V at the maximum, by Newton's method with damping."""
        g = self.grid
        seen = np.maximum(self.power / g.count, LEAST * g.variance) / g.small
        x = np.concatenate([[0.0], np.log(np.minimum(seen, np.sqrt(seen * g.count.sum())))])
        now, part, slope, v = self.spectra(x)
        damping, gain = 0.0, np.inf
        for _ in range(STEPS):
            pull, h = self.curvature(part, slope, v)
            factor, indefinite = dpotrf(h + damping * np.diag(np.abs(np.diag(h))), lower=1)
            if gain < CLOSE and not indefinite and not damping:
                break
            step = dpotrs(factor, pull + self.precision @ x, lower=1)[0]
            then = self.spectra(x - step) if not indefinite and np.abs(step).max() < LONGEST else None
            if then and then[0] >= now:
                gain, x, damping = then[0] - now, x - step, damping / 8 if damping > DAMPED else 0.0
                now, part, slope, v = then
            else:
                damping = max(4 * damping, DAMPED)
        return now, x, h, slope, v


def _with_remainder(g: Grid, power: np.ndarray) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Return log p(R | remainder), the noise's variance, V at each frequency, and the covariance of 1/V."""
    density, x, h, slope, v = _Remainder(g, power, block_diag(g.known**-2, g.rough)).maximum()
    factor = np.linalg.cholesky(h)
    score = density - 0.5 * float(g.count.sum()) * LOG_2PI - np.log(g.known)
    score += 0.5 * g.log_rough - g.log_small - float(np.log(np.diag(factor)).sum())
    moves = solve_triangular(factor, (slope / v[:, None]).T, lower=True)
    return float(score), float(g.variance * np.exp(x[0])), v, moves.T @ moves
