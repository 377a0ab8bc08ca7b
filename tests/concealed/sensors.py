"""What a sensor does to a true value: its faults (part of the concealed physics) and its noise.

Noise of a channel = white + AR(1) + 1/f; `spectrum` is its variance per orthonormal DCT-II bin, which the judge uses to
whiten. The faults are those of the catalogue's table "Sensors".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tests.concealed.compiled import loops


@dataclass(frozen=True)
class Noise:
    """Random error of one channel: standard deviations of the white, AR(1) (lag-one correlation rho) and 1/f part."""

    white: float
    ar: float = 0.0
    rho: float = 0.0
    flicker: float = 0.0

    def spectrum(self, n: int) -> np.ndarray:
        """Variance in each of n DCT bins (n,), in the square of the channel's unit."""
        w = np.pi * np.arange(n) / n
        density = self.white**2 + self.ar**2 * (1 - self.rho**2) / (
            1 - 2 * self.rho * np.cos(w) + self.rho**2
        )
        return density + self.flicker**2 * _flicker_shape(n)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """One realisation (n,)."""
        innovation = rng.standard_normal(n) * self.ar * np.sqrt(1 - self.rho**2)
        innovation[0] = rng.standard_normal() * self.ar
        coloured = lfilter([1.0], [1.0, -self.rho], innovation)
        return (
            self.white * rng.standard_normal(n)
            + coloured
            + self.flicker * _idct(rng.standard_normal(n) * np.sqrt(_flicker_shape(n)))
        )


def _flicker_shape(n: int) -> np.ndarray:
    """1/f density of unit variance over n bins; the constant is left out (an offset would be a sensor fault)."""
    shape = np.zeros(n)
    shape[1:] = 1.0 / np.arange(1, n)
    return shape * n / shape.sum()


def _idct(x: np.ndarray) -> np.ndarray:
    from scipy.fft import idct

    return idct(x, norm="ortho")


def draw_noise(sd: float, rng: np.random.Generator, colour: str) -> Noise:
    """A channel's noise whose whole standard deviation is near the sd that the plant file states."""
    total = sd * rng.uniform(0.92, 1.05)
    share = {"white": 0.0, "ar": rng.uniform(0.1, 0.4), "flicker": rng.uniform(0.1, 0.3)}[colour]
    flicker = rng.uniform(0.005, 0.03) if colour == "flicker" else 0.0
    return Noise(
        white=total * np.sqrt(1 - share - flicker),
        ar=total * np.sqrt(share),
        rho=rng.uniform(0.3, 0.9),
        flicker=total * np.sqrt(flicker),
    )


def lag(t: np.ndarray, y: np.ndarray, tau: float) -> np.ndarray:
    """First-order lag of y (N,) known at t and straight between, starting in equilibrium. Exact for every step."""
    h = np.diff(t)
    e = np.exp(-h / tau)
    return lagged(np.ascontiguousarray(y, float), e, tau / h * (1 - e))


def lag_in_python(y: np.ndarray, e: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """The same as loops.lag: what it is compared with, and what tells how it goes."""
    out = np.empty_like(y)
    out[0] = z = y[0]
    for k in range(len(e)):
        z = z * e[k] + y[k] * (gain[k] - e[k]) + y[k + 1] * (1 - gain[k])
        out[k + 1] = z
    return out


lagged = loops.lag


def apply_fault(
    effect: str,
    p: dict,
    t: np.ndarray,
    y: np.ndarray,
    air: np.ndarray | None,
    x: np.ndarray | None,
    thermal: bool,
) -> np.ndarray:
    """The reading (N,) that a sensor with the named fault gives for the true value y (N,)."""
    s = t - t[0]
    if effect == "sensor_lag":
        return lag(t, y, p["TAU"])
    if effect == "sensor_delay":
        return np.interp(t - p["TD"], t, y)
    if effect == "sensor_gain":
        return air + p["A"] * (y - air) if thermal else p["A"] * y
    if effect == "sensor_offset_step":
        return y + p["A"] * (s >= p["T0"])
    if effect == "sensor_drift":
        return y + p["A"] * s
    if effect == "cold_junction_drift":
        return y + p["A"] * (air - air[0])
    if effect == "sensor_saturation":
        return np.minimum(y, p["YMAX"]) if "YMAX" in p else np.maximum(y, p["YMIN"])
    if effect == "cyclic_error":
        return y + p["A"] * np.sin(2 * np.pi * x / p["P"] + p["PHI"])
    raise KeyError(effect)


SENSOR_FAULTS = (
    "sensor_lag",
    "sensor_delay",
    "sensor_gain",
    "sensor_offset_step",
    "sensor_drift",
    "cold_junction_drift",
    "sensor_saturation",
    "cyclic_error",
)


def record(
    y: np.ndarray, noise: Noise, sd: float, resolution: float, dirt: dict, rng: np.random.Generator
) -> np.ndarray:
    """A recorded column (N,): true reading plus noise, outliers, steps of the converter, gaps (NaN)."""
    n = len(y)
    out = y + noise.draw(n, rng)
    if dirt.get("outliers"):
        k = rng.choice(n, rng.binomial(n, dirt["outliers"]), replace=False)
        out[k] += rng.choice([-1, 1], len(k)) * rng.uniform(8, 20, len(k)) * sd
    if resolution:
        out = np.round(out / resolution) * resolution
    if dirt.get("every", 1) > 1:
        out[np.arange(n) % dirt["every"] != 0] = np.nan
    for _ in range(dirt.get("gaps", 0)):
        start = rng.integers(n // 20, n)
        out[start : start + rng.integers(n // 400 + 2, n // 100 + 4)] = np.nan
    return out
