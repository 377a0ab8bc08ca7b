"""How well an explanation fits, in a likelihood that lets the noise have colour.

Each output channel's residual is white noise plus, where the data ask for it, a first-order coloured part: ARMA(1,1)
    e_k = phi e_(k-1) + w_k - theta w_(k-1),    phi = 0 .. 0.9995
fitted anew under every explanation. A white likelihood on coloured residuals would call every long drift a discovery.

    score = sum over channels of N log(s^2) + sum over channels and recordings of h(excess)     (smaller is better)

The second sum is the prior that a sensor's colour is about as large as its white noise: excess = (rms / sigma)^2 - 1 costs
half of itself, and beyond 30 only its logarithm more, since then every explanation is far off. Without it a slow noise
process would swallow any slow physics of a short record.
"""
from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

_PHI = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9995)
_SHARE = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99)       # theta / phi


@dataclass(frozen=True)
class Colour:
    """The noise of one channel under an explanation: innovation's sigma, phi and theta, and its -2 log likelihood."""
    sigma: float
    phi: float
    theta: float
    score: float


def colour(parts: Sequence[np.ndarray], floor: float) -> Colour:
    """Fit ARMA(1,1) to residual sequences (N,) of one channel; NaN are left out. `floor`: a sigma below which the sensor
    does not go, so that an explanation is not paid for fitting noise."""
    parts = [p[np.isfinite(p)] for p in parts]
    parts = [p for p in parts if len(p) > 8]
    n = sum(map(len, parts))
    if not n:
        return Colour(floor, 0.0, 0.0, 0.0)
    best = None
    for phi in _PHI:
        for share in (_SHARE if phi else (0.0,)):
            theta = phi * share
            variance = _variance(parts, phi, theta)
            variance = max(variance, floor ** 2)
            score = n * np.log(variance) + (0.0 if phi == 0 else 2 * np.log(n))
            if best is None or score < best.score - 1e-9:
                best = Colour(float(np.sqrt(variance)), phi, theta, float(score))
    assert best is not None
    return best


def _variance(parts: Sequence[np.ndarray], phi: float, theta: float) -> float:
    """Variance of the innovations, outliers beyond 5 sigmas counted as 5."""
    w = np.concatenate([_innovations(p, phi, theta) for p in parts])
    spread = 1.4826 * float(np.median(np.abs(w))) or float(np.std(w))
    raw = float(np.mean(w ** 2))
    if spread <= 0:
        return raw
    limit = 5 * max(spread, 0.3 * np.sqrt(raw))
    return float(np.mean(np.minimum(np.abs(w), limit) ** 2))


def _innovations(e: np.ndarray, phi: float, theta: float) -> np.ndarray:
    if phi == 0:
        return e
    w = lfilter([1.0, -phi], [1.0, -theta], e)
    w[0] *= np.sqrt(1 - phi ** 2)      # the first sample comes from the stationary distribution
    return w


def white_sigma(parts: Sequence[np.ndarray]) -> float:
    """The white part of a residual, from second differences (robust; slow misfit does not reach them)."""
    second = [np.diff(p[np.isfinite(p)], 2) for p in parts]
    joined = np.concatenate([s for s in second if len(s)] or [np.zeros(1)])
    return float(1.4826 * np.median(np.abs(joined)) / np.sqrt(6))


def channels(residuals: Sequence[np.ndarray], sigmas: Sequence[float]) -> list[Colour]:
    """The colour of every output channel over recordings, the prior's price in the score. residuals: per recording
    (N, outputs); sigmas: white noise per output."""
    out = []
    for j, sigma in enumerate(sigmas):
        found = colour([r[:, j] for r in residuals], 0.6 * sigma)
        price = sum(_price(r[:, j], sigma) for r in residuals)
        out.append(dataclasses.replace(found, score=found.score + price))
    return out


def _price(e: np.ndarray, sigma: float) -> float:
    e = np.abs(e[np.isfinite(e)])
    if not len(e):
        return 0.0
    limit = 8 * max(sigma, 1.5 * float(np.median(e)))
    excess = max(float(np.mean(np.minimum(e, limit) ** 2)) / sigma ** 2 - 1.0, 0.0)
    return 0.5 * (excess if excess <= 30 else 30 * (1 + float(np.log(excess / 30))))
