"""Log marginal likelihood of residuals: sensor noise and remainder averaged over their spectra, not chosen.

In band b of an output, with n rows and power P = sum R^2, a row has this variance (coordinates.py).
Bands of an output's recordings at the same frequency count as one.

    V_b = c^2 s^2 + j^2 w^2 + q exp(u_b)
    log p(R | V) = -1/2 sum_b (n_b log 2 pi V_b + P_b / V_b)

s is the noise that the plant file states, c the factor by which it is wrong, log-normal. Recorded times may
be off by j sampling intervals, log-normal. A reading that changes by w in an interval is then off by j w,
with the same power at all frequencies. Where slow parts are stated, s^2 follows their spectrum. q exp(u_b) is
the remainder and every slow error of the sensor. u is a random walk over log frequency: it is smooth, and an
error of the plant at one frequency says little about another. But a plant with a large error is not exact at
any frequency. So at least the share FLOOR of the remainder's energy is spread evenly over all frequencies.
Errors that nobody will name are small. So the rms of the remainder has a half-normal prior whose width is the
share SMALL of the output's swing: q = (SMALL swing)^2.

    log p(R) = log [ABSENT p(R | none) + (1 - ABSENT) p(R | remainder)]

Without a remainder the noise has the stated spectrum. Where no slow parts are stated, it has with even odds a
first-order and a 1/f part, whose sizes and time are log-uniform. These, c, j and u are integrated by
Laplace's method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from thermoctl.diagnosis.data.grids import Grid
from thermoctl.diagnosis.data.spectra import SLOW as SLOW_PARTS
from thermoctl.diagnosis.data.spectra import STARTS
from thermoctl.diagnosis.evidence.densities import NOISE, REMAINDER, SLOW, Density, Spot

ABSENT = 0.5  # prior of no remainder at an output
WHITE = 0.5  # prior of no slow part in a noise whose parts nobody stated
FLOOR = 0.1  # least share of the remainder's energy that is spread evenly over all frequencies
# Change of one output's log likelihood, nats. Below LITTLE its first-order value is used (rms error 0.02).
# Below NEAR the maxima are searched again from the known ones.
LITTLE, NEAR = 1.0, 5.0
LEAST = 1e-6  # least power, over the stated noise's: a residual of zero has no logarithm
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Averaged:
    """A log marginal likelihood and its by-products.

    - `inverse`: E[1/V] in the bands of each channel
    - `sensor`: the noise's variance, by output
    - `remainder`: the probability that there is a remainder, by output
    - `unsure`: covariance (frequencies, frequencies) of 1/V, by output, where it was asked for"""

    log_likelihood: float
    inverse: list[np.ndarray]
    sensor: list[float]
    remainder: list[float]
    unsure: list[np.ndarray]


@dataclass(frozen=True)
class _Output:
    """`Averaged` of one output. `inverse` (nodes,): E[1/V] at each of its frequencies.

    `at`: the variables x at the maximum of each density (densities.pyx)."""

    log_likelihood: float
    inverse: np.ndarray
    sensor: float
    remainder: float
    unsure: np.ndarray
    at: tuple[np.ndarray, ...]


def averaged(grids: Sequence[Grid], powers: Sequence[np.ndarray], unsure: bool = False) -> Averaged:
    """Average the likelihood of banded `powers` (one a channel) over noise and remainder."""
    outputs = [_output(g, g.power(powers), None, unsure) for g in grids]
    return Averaged(
        sum(f.log_likelihood for f in outputs),
        _by_channel(grids, [f.inverse for f in outputs], powers),
        [f.sensor for f in outputs],
        [f.remainder for f in outputs],
        [f.unsure for f in outputs],
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
    """The log likelihood of other powers, as a rise above that of known powers, and their weights.

    To first order the rise of an output is -E[1/V] / 2 times the change of its power. If this is below
    LITTLE, it is used. If it is below NEAR, the maxima are searched from the known ones."""

    def __init__(self, grids: Sequence[Grid], powers: Sequence[np.ndarray]):
        self.grids = grids
        self.known = [(g, p := g.power(powers), _output(g, p)) for g in grids]

    def rise(self, others: Sequence[np.ndarray]) -> float:
        """Return the log likelihood of other powers minus that of the known powers."""
        return sum(rise for rise, _ in self._each(others))

    def weighed(self, others: Sequence[np.ndarray]) -> tuple[float, list[np.ndarray]]:
        """Return the rise, and E[1/V] in the bands of each channel."""
        changes = list(self._each(others))
        return sum(rise for rise, _ in changes), _by_channel(self.grids, [v for _, v in changes], others)

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


def _output(
    g: Grid, power: np.ndarray, near: Sequence[np.ndarray] | None = None, unsure: bool = False
) -> _Output:
    """Average the likelihood of one output over noise and remainder.

    `power` (nodes,): at each frequency. `near`: by density, the x from which its maximum is searched."""
    power = np.maximum(power, LEAST * g.variance * g.count)
    kinds = (NOISE, REMAINDER) if g.sensor else (NOISE, SLOW, REMAINDER)
    densities = [density(g, kind) for kind in kinds]
    starts: list[np.ndarray | None] = [*near] if near else [None] * len(kinds)
    maxima = [d.top(power, x) for d, x in zip(densities, starts, strict=True)]
    odds = ABSENT * np.array([1.0] if g.sensor else [WHITE, 1 - WHITE])
    scores = np.log(np.append(odds, 1 - ABSENT)) + [
        log_p(g, kind, *f) for kind, f in zip(kinds, maxima, strict=True)
    ]
    whole = float(scores.max() + np.log(np.exp(scores - scores.max()).sum()))
    weight = np.exp(scores - whole)
    each = np.array([1 / spot.variance for spot, _ in maxima])
    mean = weight @ each
    spread = np.zeros((0, 0))
    if unsure:
        apart = each - mean
        within = sum(w * _unsure(*f) for w, f in zip(weight, maxima, strict=True))
        spread = within + (apart.T * weight) @ apart
    sensor = g.variance * float(
        weight @ [np.exp(spot.x[0]) + g.clock * np.exp(spot.x[len(g.scales) - 1]) for spot, _ in maxima]
    )
    return _Output(whole, mean, sensor, float(weight[-1]), spread, tuple(spot.x for spot, _ in maxima))


def density(g: Grid, kind: int) -> Density:
    """Return one of an output's three densities, made once."""
    made: dict[int, Density] = g.__dict__.setdefault("densities", {})
    if kind not in made:
        made[kind] = Density(
            kind,
            g.count,
            g.shape,
            g.turn,
            g.scales,
            g.variance,
            g.clock,
            g.small,
            FLOOR,
            SLOW_PARTS,
            np.diag(g.rough).copy(),
            np.diag(g.rough, 1).copy(),
            STARTS,
            g.slow,
        )
    return made[kind]


def log_p(g: Grid, kind: int, spot: Spot, root: np.ndarray) -> float:
    """Return log p(R) of a density by Laplace's method, from its maximum and its curvature's root there."""
    score = spot.log_density - 0.5 * float(g.count.sum()) * LOG_2PI - float(np.log(g.scales).sum())
    if kind == REMAINDER:
        score += 0.5 * g.log_rough - g.log_small
    return score - float(np.log(root.diagonal()).sum())


def _unsure(spot: Spot, root: np.ndarray) -> np.ndarray:
    """Return the covariance (nodes, nodes) of 1/V under one density, to first order."""
    moves = solve_triangular(root, (spot.slope / spot.variance[:, None]).T, lower=True)
    return np.asarray(moves.T @ moves)
