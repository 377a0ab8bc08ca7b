"""Log marginal likelihood of residuals: sensor noise and remainder averaged over their spectra, not chosen.

In band b of an output, with n rows and power P = sum R^2, a row has this variance (coordinates.py).
Bands of an output's recordings at the same frequency count as one.

    V_b = c^2 s^2 + q exp(u_b),   log p(R | V) = -1/2 sum_b (n_b log 2 pi V_b + P_b / V_b)

s is the noise that the plant file states, c its error, log-normal. Where slow parts are stated, s^2 follows
their spectrum. q exp(u_b) is the remainder and every slow error of the sensor. u is a random walk over log
frequency: smooth, and its size is learnt at each frequency. So an error of the plant at one frequency says
little about another. But a plant with a large error is not exact at any frequency: at least the share FLOOR
of the remainder's energy lies evenly over all of them. Errors that nobody will name are small:
q = (SMALL swing)^2, and the remainder's share of the output's swing has a half-normal prior of width SMALL.

    log p(R) = log [ABSENT p(R | none) + (1 - ABSENT) p(R | remainder)]

Both parts are integrated over c and u by Laplace's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.special import logsumexp

from thermoctl.diagnose.coordinates import WIDTH, Coordinates
from thermoctl.plant.language import SensorNoise

STATED = 1.0  # prior sd of log c^2: in one case of three a stated noise is off by more than 1.6 times
ABSENT = 0.5  # prior of no remainder at an output
SMALL = 0.02  # of an output's swing: width of the prior of the remainder's rms
# Prior sd of u (see above) at the lowest frequency: one sd is a factor of ten in the remainder's rms.
LEVEL = 2 * np.log(10.0)
FLOOR = 0.1  # least share of the remainder's energy that is spread evenly over all frequencies
DRAWS = 400  # random walks drawn for the normalisation of the remainder's prior
WALK = np.log(4.0)  # standard deviation of u's step over an octave: 1/f^2, a white force on one storage
STEPS, CLOSE, LONGEST = 40, 1e-4, 2.0  # of Newton's method: their number, the step that ends it, the longest
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Grid:
    """The frequency grid of one output, common to its recordings, and the prior of its remainder there.

    `node`: for each band of all recordings, the index of the band's frequency in the grid. `count`: number of
    DCT rows at each frequency."""

    channels: tuple[int, ...]  # positions in Coordinates.channels
    node: np.ndarray
    count: np.ndarray
    shape: np.ndarray  # of the stated noise's spectrum, its mean over all rows 1
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
    shape = spectrum(sensor, frequency, channels[0].interval) if sensor else np.ones(len(known))
    return Grid(
        tuple(positions),
        node,
        count,
        shape * count.sum() / (count @ shape),
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
        none, own = _sensor_only(g, power)
        some, level, variance, spread = _with_remainder(g, power, own)
        total += float(np.logaddexp(np.log(ABSENT) + none, np.log(1 - ABSENT) + some))
        p = 1 / (1 + np.exp(np.clip(none - some, -500, 500)) * ABSENT / (1 - ABSENT))
        mean = ((1 - p) / (own * g.shape) + p / variance)[g.node]
        at = 0
        for k in g.channels:
            inverse[k] = mean[at : at + len(powers[k])]
            at += len(powers[k])
        sensor.append((1 - p) * own + p * level)
        present.append(float(p))
        apart = 1 / (own * g.shape) - 1 / variance
        unsure.append(p * spread + p * (1 - p) * np.outer(apart, apart))
    return Averaged(total, inverse, sensor, present, unsure)


def _sensor_only(g: Grid, power: np.ndarray) -> tuple[float, float]:
    """Log p(R | no remainder), and the noise's variance."""
    n, ratio = float(g.count.sum()), float((power / g.shape).sum()) / g.variance
    v = np.log(max(ratio / n, 1e-6))
    for _ in range(STEPS):
        step = (0.5 * (ratio * np.exp(-v) - n) - v / g.known**2) / (0.5 * n + g.known**-2)
        v += np.clip(step, -LONGEST, LONGEST)
        if abs(step) < CLOSE:
            break
    own = g.variance * np.exp(v)
    score = -0.5 * (n * (LOG_2PI + np.log(own)) + g.count @ np.log(g.shape) + ratio * g.variance / own)
    score -= 0.5 * (v / g.known) ** 2
    return float(score - np.log(g.known) - 0.5 * np.log(0.5 * n + g.known**-2)), float(own)


def _with_remainder(g: Grid, power: np.ndarray, own: float) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Return log p(R | remainder), the noise's variance, V at each frequency, and the covariance of 1/V.

    Laplace's method over (log c^2, u); Fisher's scoring finds the maximum."""
    n, rows, size = g.count, float(g.count.sum()), len(g.count) + 1
    x = np.concatenate([[0.0], np.log(np.maximum(power / n - own * g.shape, 0.05 * own) / g.small)])

    def spectra(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        noise, free = g.variance * g.shape * np.exp(x[0]), np.exp(x[1:])
        mean = float(n @ free) / rows
        v = noise + g.small * (free + FLOOR * mean)
        log_p = -0.5 * float(n @ np.log(v) + (power / v).sum()) - 0.5 * mean - 0.5 * (x[0] / g.known) ** 2
        return log_p - 0.5 * float(x[1:] @ (g.rough @ x[1:])), noise, free, v

    def slopes(noise: np.ndarray, free: np.ndarray, v: np.ndarray) -> np.ndarray:
        out = np.empty((size - 1, size))  # d log V / d (log c^2, u)
        out[:, 0] = noise
        out[:, 1:] = g.small * FLOOR / rows * n * free
        out[inside, 1 + inside] += g.small * free
        return out / v[:, None]

    now, noise, free, v = spectra(x)
    inside = np.arange(size - 1)
    for _ in range(STEPS):
        parts, slope = n * free / rows, slopes(noise, free, v)
        gradient = slope.T @ (0.5 * (power / v - n))
        gradient -= np.concatenate([[x[0] / g.known**2], g.rough @ x[1:] + 0.5 * parts])
        h = slope.T @ (0.5 * n[:, None] * slope)
        h[0, 0] += g.known**-2
        h[1:, 1:] += g.rough
        h[1 + inside, 1 + inside] += 0.5 * parts
        factor = dpotrf(h, lower=1)[0]
        step = np.clip(dpotrs(factor, gradient, lower=1)[0], -LONGEST, LONGEST)
        for _ in range(8):
            then = spectra(x + step)
            if then[0] >= now:
                break
            step *= 0.5
        else:
            break
        gain = then[0] - now
        x, (now, noise, free, v) = x + step, then
        if gain < CLOSE:
            break
    score = now - 0.5 * rows * LOG_2PI - np.log(g.known) + 0.5 * g.log_rough - g.log_small
    score -= float(np.sum(np.log(np.diag(factor))))
    moves = slopes(noise, free, v).T / v  # -d(1/V) / d(log c^2, u)
    return (float(score), float(g.variance * np.exp(x[0])), v, moves.T @ dpotrs(factor, moves, lower=1)[0])
