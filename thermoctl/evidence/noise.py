"""Log marginal likelihood of residuals: sensor noise and remainder averaged over a grid of spectra, not chosen.

In band b of an output's rows (coordinates.py), with n rows and power P = sum R^2, the variance is

    V_b = c^2 s^2 (1 + a S_b(tau)) + eta^2 F_b(tau')
    log p(R | V) = -1/2 sum_b (n_b log 2 pi V_b + P_b / V_b)

s: what the plant file states, c: how wrong that is (log-normal, Laplace's method), a and S: a slow part of the sensor's noise,
first order or 1/f; F: the output's response to small random forces at the plant's nodes (remainder.py), eta their size. A slow
part is one sensor's own; eta and tau' are common to all outputs:

    log p(R) = logsumexp_(eta, tau') [log w + sum over outputs of logsumexp_(a, tau) [log w + log p(R | V)]]
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from thermoctl.evidence.coordinates import Channel

STATED = 1.0  # standard deviation of log c^2: a stated noise is wrong by a factor of 1.6 in one case of three
STEPS, CLOSE = 15, 3e-3  # of Newton's method for log c^2, and the step that ends it
SIZES = 10.0 ** np.arange(-0.9, 3.7, 0.65)  # a: variance of the slow part over that of the white part
CORNERS = 4  # tau: from one sampling interval to a quarter of the recording
RARE = 0.7  # nats that a slow part's standard deviation costs in units of the white part's: most are no larger than that
PLAIN, FIRST_ORDER = (
    0.4,
    0.45,
)  # prior of white noise, and of white noise with a first-order part; the rest is 1/f
UNLIKELY = 1e-4  # posterior of a cell that a small step need not look at
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Grid:
    """Spectra of one output over the bands of all its recordings. `slow`: (cells, bands) 1 + a S; `weight`: (cells,) log prior."""

    channels: tuple[int, ...]  # positions in Coordinates.channels
    count: np.ndarray
    slow: np.ndarray
    weight: np.ndarray
    variance: float  # s^2


def first_order(frequency: np.ndarray, interval: float, tau: float) -> np.ndarray:
    """Variance in the rows at these frequencies of a first-order process of unit variance, sampled at an interval."""
    rho = np.exp(-interval / tau)
    return (1 - rho**2) / (1 - 2 * rho * np.cos(2 * np.pi * frequency * interval) + rho**2)


def flicker(c: Channel) -> np.ndarray:
    """Variance in the bands of a 1/f process of unit variance over the channel's rows."""
    n = c.rows * c.block
    k = np.maximum(2 * c.frequency * c.interval * n, 0.5)
    return n / (k * (np.log(n) + 0.58))


def grid(channels: Sequence[Channel], positions: Sequence[int], sigma: float) -> Grid:
    """The spectra of one output with a stated noise of `sigma`, `channels` its recordings."""
    interval = float(np.median([c.interval for c in channels]))
    span = max(c.interval * c.rows * c.block for c in channels)
    shapes = [
        np.concatenate([first_order(c.frequency, c.interval, tau) for c in channels])
        for tau in np.geomspace(interval, 0.25 * span, CORNERS)
    ]
    rare = -RARE * np.sqrt(SIZES)
    rare -= logsumexp(rare)
    slow, weight = [np.ones(len(shapes[0]))], [np.log(PLAIN)]
    for shape in shapes:
        slow += [1 + a * shape for a in SIZES]
        weight += list(np.log(FIRST_ORDER / CORNERS) + rare)
    one_over_f = np.concatenate([flicker(c) for c in channels])
    slow += [1 + a * one_over_f for a in SIZES]
    weight += list(np.log(1 - PLAIN - FIRST_ORDER) + rare)
    count = np.concatenate([c.count for c in channels]).astype(float)
    return Grid(tuple(positions), count, np.array(slow), np.array(weight), sigma**2)


@dataclass(frozen=True)
class Likely:
    """The grid's cells that hold nearly all of its posterior: of the remainder, and per output of the noise."""

    remainder: np.ndarray
    noise: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Averaged:
    """A log marginal likelihood, and what follows from the grid's posterior. `inverse`: per channel E[1/V] in its bands;
    `cells`: posterior of the remainder's cells; `sensor`: per output E[variance of its noise] in its bands."""

    log_likelihood: float
    inverse: list[np.ndarray]
    cells: np.ndarray
    sensor: list[np.ndarray]
    likely: Likely


def averaged(
    grids: Sequence[Grid],
    powers: Sequence[np.ndarray],
    remainder: Sequence[np.ndarray],
    prior: np.ndarray,
    likely: Likely | None = None,
) -> Averaged:
    """Average the likelihood of banded `powers` (one a channel) over noise and remainder. `remainder`: per output (cells, bands)
    variance by cell; `prior`: (cells,) log weights of these cells; `likely`: only these cells count, a lower bound."""
    if likely is not None:
        remainder, prior = [q[likely.remainder] for q in remainder], prior[likely.remainder]
        grids = [
            dataclasses.replace(g, slow=g.slow[c], weight=g.weight[c])
            for g, c in zip(grids, likely.noise, strict=True)
        ]
    parts = [
        _output(g, np.concatenate([powers[k] for k in g.channels]), q)
        for g, q in zip(grids, remainder, strict=True)
    ]
    by_cell = prior + sum(logsumexp(score, axis=1) for score, _, _ in parts)
    total = float(logsumexp(by_cell))
    cells = np.exp(by_cell - total)
    inverse: list[np.ndarray] = [np.zeros(0)] * sum(len(g.channels) for g in grids)
    sensor, noise = [], []
    for g, (score, variance, own) in zip(grids, parts, strict=True):
        p = cells[:, None] * np.exp(score - logsumexp(score, axis=1)[:, None])
        mean = np.einsum("gc,gcb->b", p, 1 / variance)
        at = 0
        for k in g.channels:
            inverse[k] = mean[at : at + len(powers[k])]
            at += len(powers[k])
        sensor.append(np.einsum("gc,gcb->b", p, own))
        noise.append(np.flatnonzero(p.sum(axis=0) > UNLIKELY))
    if likely is not None:
        return Averaged(total, inverse, cells, sensor, likely)
    return Averaged(total, inverse, cells, sensor, Likely(np.flatnonzero(cells > UNLIKELY), tuple(noise)))


def _output(g: Grid, power: np.ndarray, remainder: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log (prior x likelihood) of one output by (remainder's cell, noise's cell), the variances and the noise's share of them."""
    slow, extra = g.variance * g.slow[None], remainder[:, None, :]
    fast = slice(len(g.count) // 2, None)  # most rows, and least of what is slow
    rows = g.count[fast].sum()
    level = max(float(power[fast].sum()) / rows / g.variance, 1e-9) / (
        (g.slow[:, fast] * g.count[fast]).sum(axis=1) / rows
    )
    u = np.tile(np.log(level), (extra.shape[0], 1))
    for _ in range(STEPS):
        own = np.exp(u)[:, :, None] * slow
        share = own / (own + extra)
        slope = -0.5 * (share * (g.count - power * share / own)).sum(axis=2) - u / STATED**2
        step = slope / (0.5 * (g.count * share**2).sum(axis=2) + 1 / STATED**2)
        u = u + np.clip(step, -1.0, 1.0)
        if np.max(np.abs(step)) < CLOSE:
            break
    own = np.exp(u)[:, :, None] * slow
    variance = own + extra
    share = own / variance
    bend = 0.5 * (g.count * share**2).sum(axis=2) + 1 / STATED**2
    score = (
        -0.5 * (g.count * np.log(variance) + power / variance).sum(axis=2)
        - 0.5 * g.count.sum() * LOG_2PI
        - 0.5 * (u / STATED) ** 2
        - np.log(STATED)
        - 0.5 * np.log(bend)
        + g.weight
    )
    return score, variance, own
