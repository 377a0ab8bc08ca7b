"""The frequency grid of an output, and the priors of noise and remainder there (equations in noise.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from thermoctl.diagnosis.data.coordinates import WIDTH, Coordinates
from thermoctl.diagnosis.data.spectra import STARTS, slow_parts, spectrum
from thermoctl.plant.language import SensorNoise

STATED = 1.0  # prior sd of log c^2: in one case of three a stated noise is off by more than 1.6 times
# The error of recorded times in sampling intervals: median, and prior sd of log j^2 (a factor of ten in j).
# A clock in hardware has 1e-4 or less, a program that polls a device on a busy machine 1e-1.
CLOCK, CLOCK_SD = 3e-3, 2 * np.log(10.0)
# A time error is part of the noise model if, two sd above its median, it adds this share of the variance.
SEEN = 0.1
SMALL = 0.02  # width of the prior of the remainder's rms, as a share of the output's swing
# Prior sd of u (noise.py) at the lowest frequency: one sd is a factor of ten in the remainder's rms.
LEVEL = 2 * np.log(10.0)
DRAWS = 400  # random walks drawn for the normalisation of the remainder's prior
# Standard deviation of u's step over an octave. The spectrum of a white force on one storage, 1/f^2, falls by
# this factor of 4 an octave.
WALK = np.log(4.0)


@dataclass(frozen=True)
class Reading:
    """The numbers of an output that its grid depends on, beside its rows."""

    output: str
    sigma: float  # s of noise.py: standard deviation of the stated noise, in the output's unit
    sensor: SensorNoise | None  # the parts of that noise, if stated
    swing: float  # rms of the output about its mean
    change: float  # w of noise.py: rms change in a sampling interval, over the root of `block`
    coarse: bool  # it changes by less than a step in a sample: its error depends on the signal
    # Number of samples whose mean is one row. Such a mean has the spectrum of the samples, divided by their
    # number: slow parts keep their size and time.
    block: int


@dataclass(frozen=True)
class Grid(Reading):
    """The frequency grid of one output, common to its recordings, and the prior of its remainder there.

    `node`: for each band of all recordings, the index of the band's frequency in the grid. `count`: number of
    DCT rows at each frequency."""

    channels: tuple[int, ...]  # positions in Coordinates.channels
    node: np.ndarray
    count: np.ndarray
    turn: np.ndarray  # (nodes,) angle of each frequency in a sampling interval, rad
    shape: np.ndarray  # the stated noise's spectrum, its mean over all rows 1
    slow: np.ndarray  # (starts, nodes) likewise, of a noise with slow parts, at each row of STARTS
    known: float  # prior sd of log c^2
    rough: np.ndarray  # (nodes, nodes) inverse covariance of u
    log_rough: float  # log determinant of `rough`
    log_small: float  # log of the half-normal's mean over the random walk

    def power(self, powers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the power at each frequency (nodes,). `powers`: by band, of all channels of all outputs."""
        return np.bincount(self.node, np.concatenate([powers[k] for k in self.channels]))

    @property
    def variance(self) -> float:
        """Variance of the stated noise, s^2."""
        return self.sigma**2

    @cached_property
    def clock(self) -> float:
        """Variance by the median error of the times, over the stated noise's; 0 if negligible (SEEN)."""
        ratio = (CLOCK * self.change / self.sigma) ** 2
        return ratio if ratio * np.exp(2 * CLOCK_SD) > SEEN else 0.0

    @cached_property
    def scales(self) -> np.ndarray:
        """Prior sd of log c^2 and, if a time error is part of the noise model, of log j^2."""
        return np.array([self.known, CLOCK_SD] if self.clock else [self.known])

    @property
    def timing(self) -> float:
        """Variance that an error of the times adds which is one prior sd above its median."""
        return float(self.variance * self.clock * np.exp(CLOCK_SD))

    @property
    def most(self) -> float:
        """Variance of the noise with all its parts one prior sd above their medians."""
        return self.variance * float(np.exp(self.known)) + self.timing

    @property
    def small(self) -> float:
        """The square of the prior width of the remainder's rms: q of noise.py."""
        return (SMALL * self.swing) ** 2


def grid(coordinates: Coordinates, positions: Sequence[int], reading: Reading) -> Grid:
    """Return the frequency grid of one output. `positions`: of its channels."""
    channels = [coordinates.channels[k] for k in positions]
    octave = np.concatenate([np.log2(c.frequency) for c in channels])
    cells = np.round((octave - octave.min()) / np.log2(WIDTH)).astype(int)
    used, node = np.unique(cells, return_inverse=True)
    count = np.bincount(node, np.concatenate([c.count for c in channels]).astype(float))
    apart = np.diff(used) * np.log2(WIDTH)
    rough = np.zeros((len(used), len(used)))
    rough[0, 0] = LEVEL**-2
    for k, octaves in enumerate(apart):
        rough[k : k + 2, k : k + 2] += np.array([[1, -1], [-1, 1]]) / (WALK**2 * octaves)
    walks = np.linalg.solve(
        np.linalg.cholesky(rough).T, np.random.default_rng(3).standard_normal((len(used), DRAWS))
    )
    log_small = float(logsumexp(-0.5 * count @ np.exp(walks) / count.sum()) - np.log(DRAWS))
    frequency = np.exp2(octave.min()) * WIDTH**used
    interval, sensor = channels[0].interval, reading.sensor
    turn = 2 * np.pi * frequency * interval / reading.block
    shape = spectrum(sensor or SensorNoise(1.0), frequency, interval)
    slow = np.array([slow_parts(turn, x) for x in STARTS])
    return Grid(
        **{f.name: getattr(reading, f.name) for f in fields(Reading)},
        channels=tuple(positions),
        node=node,
        count=count,
        turn=turn,
        shape=shape * count.sum() / (shape @ count),
        slow=slow * count.sum() / (slow @ count)[:, None],
        known=2 * sensor.sd if sensor and sensor.sd else STATED,
        rough=rough,
        log_rough=float(np.linalg.slogdet(rough)[1]),
        log_small=log_small,
    )
