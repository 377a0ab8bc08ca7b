"""Noise of an output, and its errors in units of that noise.

    w_k = (e_k - phi e_(k-1)) / s,   s^2 = sigma^2 (1 - phi^2)

phi is the correlation of the noise over one median sampling interval (AR(1)). Over a gap it is a power of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation

MIN_DIFFERENCED = 4  # fewest samples of a recording for second differences


@dataclass(frozen=True)
class Noise:
    """One output's noise: standard deviation, and correlation `phi` over one sampling interval.

    With a whitening filter ar(z)/ma(z), `sigma` is the standard deviation of the innovations."""

    sigma: float
    phi: float = 0.0
    ar: tuple[float, ...] = (1.0,)
    ma: tuple[float, ...] = (1.0,)


def default_noise(plant: Plant, excitations: Sequence[Excitation] = ()) -> tuple[Noise, ...]:
    """Return the noise of the plant file, else the white part of the second differences."""
    out = []
    for j, o in enumerate(plant.outputs.values()):
        sigma = np.hypot(o.noise_sd, (o.resolution or 0.0) / np.sqrt(12))
        if sigma <= 0:
            parts = [d.y[np.isfinite(d.y[:, j]), j] for d in excitations]
            second = np.concatenate(
                [np.diff(y, 2) for y in parts if len(y) >= MIN_DIFFERENCED] or [np.zeros(1)]
            )
            sigma = 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6)
            spread = max((float(np.ptp(y)) for y in parts if len(y)), default=1.0)
            sigma = max(sigma, 1e-4 * spread, 1e-12)
        out.append(Noise(float(sigma)))
    return tuple(out)


def measured(y: np.ndarray) -> np.ndarray:
    """Return the indices of the measured samples of an output (N,)."""
    index = np.flatnonzero(np.isfinite(y))
    return _all(len(y)) if len(index) == len(y) else index


@lru_cache(maxsize=64)
def _all(n: int) -> np.ndarray:
    """Return 0..n-1, the same read-only array each time: outputs of long recordings share it."""
    index = np.arange(n)
    index.flags.writeable = False
    return index


@dataclass(frozen=True)
class Whitening:
    """Whitens the errors of one output in one recording.

    `index` (M,): measured samples. `phi` (M - 1,): correlation with the sample before. `scale` (M,): s."""

    noise: Noise
    index: np.ndarray
    phi: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, d: Excitation, j: int, noise: Noise) -> Whitening:
        """Return the whitening of output j in a recording."""
        index = measured(d.y[:, j])
        if noise.phi <= 0:  # phi and sigma are one number each, not one for each sample
            phi = np.broadcast_to(0.0, max(len(index) - 1, 0))
            return cls(noise, index, phi, np.broadcast_to(noise.sigma, len(index)))
        dt = float(np.median(np.diff(d.t))) if len(d.t) > 1 else 1.0
        gaps = np.diff(d.t[index]) / dt if len(index) > 1 else np.zeros(0)
        phi = noise.phi ** np.clip(gaps, 0.0, 1e4)
        scale = np.full(len(index), noise.sigma)
        if len(index):
            scale[1:] = noise.sigma * np.sqrt(np.maximum(1 - phi**2, 1e-9))
        return cls(noise, index, phi, scale)

    @property
    def white(self) -> bool:
        """Whether the noise is white and of one standard deviation: whitening divides by it."""
        return len(self.noise.ar) == 1 and not self.phi.any()

    def whiten(self, e: np.ndarray) -> np.ndarray:
        """Return whitened rows (M, ...) of errors (N, ...); missing samples are dropped."""
        part = e if len(self.index) == len(e) else e[self.index]
        shape = (-1, *([1] * (part.ndim - 1)))
        if len(self.noise.ar) > 1 and len(self.index) > 1:
            from scipy.signal import lfilter  # importing scipy.signal takes longer than most simulations

            return lfilter(self.noise.ar, self.noise.ma, part, axis=0) / self.noise.sigma
        if len(self.index) > 1 and self.phi.any():
            part = np.concatenate([part[:1], part[1:] - self.phi.reshape(shape) * part[:-1]])
        return part / self.scale.reshape(shape)

    def spread(self, w: np.ndarray, n: int) -> np.ndarray:
        """Spread values (M,) of the measured samples over `n` rows, 0 for a missing sample."""
        if len(w) == n:
            return w
        out = np.zeros(n)
        out[self.index] = w
        return out
