"""Spectra of a sensor's noise: the variance of a DCT row at each frequency.

`turn` is the angle in a sampling interval, 2 pi f dt.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.special import ndtr, ndtri

from thermoctl.plant.language import SensorNoise

# Slow parts of a noise, if the plant file states none. The rows are [least, largest] size and time constant
# of a first-order part, and size of a 1/f part. Sizes are standard deviations (of the 1/f part over a
# decade), as shares of the white part's. The time constant is in sampling intervals. Slower or larger errors
# belong to the remainder: as noise they would hide physics.
SLOW = np.log([[0.1, 1.0], [0.5, 15.0], [0.01, 0.1]])
# Points x of `slow_parts` with equal prior probability. The search for a maximum starts at the likeliest one.
STARTS = np.array([*product(*(ndtri((np.arange(n) + 0.5) / n) for n in (3, 5, 3)))])


def spectrum(sensor: SensorNoise, frequency: np.ndarray, interval: float) -> np.ndarray:
    """Return the variance of a DCT row at each frequency: of the white, the first-order and the 1/f part.

    The first-order part has the spectrum of its samples, `interval` apart (an AR(1) process). A 1/f part with
    the standard deviation `flicker` over a decade has the density flicker^2 / (ln 10 f)."""
    out = np.full(len(frequency), sensor.white**2)
    if sensor.drift is not None and sensor.time is not None:
        out += sensor.drift**2 * first_order(sensor.time / interval, 2 * np.pi * frequency * interval)
    if sensor.flicker is not None:
        out += sensor.flicker**2 * flicker_part(2 * np.pi * frequency * interval)
    return out


def first_order(time: float | np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the row variances of a sampled first-order process of unit variance; `time` in samples."""
    phi = np.exp(-1 / time)
    return (1 - phi**2) / (1 - 2 * phi * np.cos(turn) + phi**2)


def flicker_part(turn: np.ndarray) -> np.ndarray:
    """Return the row variances of 1/f noise whose standard deviation over a decade is 1."""
    return np.pi / (np.log(10.0) * turn)


def slow_parts(turn: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the spectrum (nodes,) of a noise whose white part is 1 (densities.pyx has its derivatives).

    `x` (3,) has a standard normal prior: the normal scores of the first-order part's size and time constant,
    and of the 1/f part's size."""
    size, time, flicker = np.exp(SLOW[:, 0] + (SLOW[:, 1] - SLOW[:, 0]) * ndtr(x))
    return np.asarray(1 + size**2 * first_order(time, turn) + flicker**2 * flicker_part(turn))
