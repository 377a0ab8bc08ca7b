"""Draw the random error of a simulated sensor: white noise, and the slow part of its plant file."""

from __future__ import annotations

import math

import numpy as np

from thermoctl.plant.language import SensorNoise


class SlowError:
    """The slow part of a sensor's error, one reading after the other.

    It is a sum of first-order processes of stationary start: dx = -x / tau dt + sd sqrt(2 / tau) dW. A 1/f
    part is one process per half decade of tau from `shortest` to `longest` seconds. Each has half the
    variance of a decade. Their spectrum is near 1 / f, since the integral of 4 tau / (1 + (2 pi f tau)^2)
    over log tau is 1 / f."""

    def __init__(self, noise: SensorNoise, shortest: float, longest: float, rng: np.random.Generator) -> None:
        if noise.flicker is not None:
            count = math.ceil(2 * math.log10(max(longest / shortest, 1.0))) + 1
            self._tau = shortest * 10.0 ** (0.5 * np.arange(count))
            self._sd = np.full(count, noise.flicker * math.sqrt(0.5))
        else:
            count = int(noise.drift is not None)
            self._tau = np.full(count, noise.time or 1.0)
            self._sd = np.full(count, noise.drift or 0.0)
        self._rng, self._t = rng, 0.0
        self._x = self._sd * rng.normal(size=count)

    def at(self, t: float) -> float:
        """Return the error at `t` seconds, not before the last reading."""
        if t > self._t:
            kept = np.exp(-(t - self._t) / self._tau)
            self._x = kept * self._x + self._sd * np.sqrt(1 - kept**2) * self._rng.normal(size=len(self._x))
            self._t = t
        return float(self._x.sum())


def error(noise: float | SensorNoise | None, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the errors (N,) of readings at the times t (N,) in seconds."""
    if not isinstance(noise, SensorNoise):
        return (noise or 0.0) * rng.normal(size=len(t))
    white = noise.white * rng.normal(size=len(t))
    if len(t) < 2:
        return white
    slow = SlowError(noise, float(np.min(np.diff(t))), float(t[-1] - t[0]), rng)
    return white + np.array([slow.at(x) for x in t - t[0]])
