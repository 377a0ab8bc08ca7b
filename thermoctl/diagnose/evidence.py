"""How well an explanation fits, in a likelihood that lets the noise have colour.

Each output channel's residual is white noise plus, where the data ask for it, a coloured part: first order, ARMA(1,1)
    e_k = phi e_(k-1) + w_k - theta w_(k-1),    phi = 0 .. 0.9995
or flicker noise (1/f^a, as a sum of first-order parts a factor of eight apart), or flicker noise beside a first-order part, fitted
anew under every explanation. A white likelihood on coloured residuals would call every long drift a discovery; so would a
first-order one where an amplifier's filter colours what is fast and its flicker what is slow.

    score = sum over channels of N log(s^2) + sum over channels and recordings of h(excess)     (smaller is better)

The second sum is the prior that a sensor's colour is about as large as its white noise: excess = (rms / sigma)^2 - 1 costs
half of itself, and beyond 30 only its logarithm more, since then every explanation is far off. Without it a slow noise
process would swallow any slow physics of a short record. Where the residual is larger than a sensor's colour can be (rms
above LARGE sigmas), something is still missing, its part of the residual is no stationary noise, and its energy counts, too:
WEIGHT * N * log(rms^2 / (LARGE sigma)^2). Innovations alone would let what is fast decide over what is large.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import brentq

from thermoctl.diagnose.innovations import variances

LARGE = 1.6  # coloured residual beyond this many sigmas of white noise is physics, not a sensor's colour
WEIGHT = 0.1  # of the residual's energy beside its innovations, where it is larger than that

AS_LIKELY = 8.0  # colours whose scores differ by less are both possible (95 % region of three parameters)

_PHI = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9995)
_SHARE = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99)  # theta / phi
_FLICKER = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # variance of the fastest first-order part over the white one's
_SLOPES = (0.5, 0.75, 1.0, 1.3)  # 1/f^slope
_TIMES = 2.0 * 8.0 ** np.arange(5)  # their time constants in samples
_BESIDE = (0.3, 0.5, 0.7, 0.85, 0.93)  # phi of a first-order part beside flicker noise
_LARGE = (0.1, 0.25, 0.5)  # its variance over the white one's
_SMALL = (0.003, 0.01, 0.03)  # the flicker's there, slope 1


_Filter = tuple[tuple[float, ...], tuple[float, ...], int]


@dataclass(frozen=True)
class Colour:
    """The noise model of one channel under a hypothesis.

    The filter ar(z)/ma(z) whitens the residual; `sigma` is the innovation's; `score` is -2 log likelihood."""

    sigma: float
    ar: tuple[float, ...]
    ma: tuple[float, ...]
    score: float


@cache
def _filters() -> tuple[_Filter, ...]:
    """(ar, ma, parameters) of white noise, first-order colours and flicker noise."""
    arma = [((1.0, -phi), (1.0, -phi * share), 2) for phi in _PHI for share in (_SHARE if phi else (0.0,))]
    return ((1.0,), (1.0,), 0), *arma[1:], *((*flicker(v, slope), 2) for v in _FLICKER for slope in _SLOPES)


@cache
def _mixed() -> tuple[_Filter, ...]:
    """Return (ar, ma, number of parameters) for each grid point of flicker noise plus a first-order part."""
    return tuple((*flicker(v, 1.0, phi, large), 3) for phi in _BESIDE for large in _LARGE for v in _SMALL)


def flicker(
    variance: float, slope: float = 1.0, beside: float | None = None, large: float = 0.0
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(ar, ma) of white noise of variance 1 beside first-order parts, the fastest of `variance`: the spectrum
    1 + sum q / |1 - phi e^(-iw)|^2 in factors. With y = cos(w) - 1 its zeros are real and lie between its poles. `beside`: phi
    of one more first-order part, of variance `large`."""
    phi = np.exp(-1 / _TIMES[::-1])  # the slowest part's pole comes first in y
    q = variance * (_TIMES[::-1] / _TIMES[0]) ** (slope - 1) * (1 - phi**2)
    if beside is not None:
        at = int(np.searchsorted(-phi, -beside))
        phi, q = np.insert(phi, at, beside), np.insert(q, at, large * (1 - beside**2))
    edge = (1 - phi) ** 2 / (2 * phi)

    def spectrum(y: float) -> float:
        return 1 + float(np.sum(q / ((1 - phi) ** 2 - 2 * phi * y)))

    zeros = []
    for low, high in zip(edge, [*edge[1:], 1e6], strict=True):
        y = brentq(spectrum, low * (1 + 1e-12), high * (1 - 1e-12), xtol=1e-18, rtol=1e-14)
        zeros.append(1 + y - np.sqrt(y * (y + 2)))
    return tuple(map(float, np.poly(phi))), tuple(map(float, np.poly(zeros)))


def colour(parts: Sequence[np.ndarray], floor: float) -> Colour:
    """Fit every colour to residual sequences (N,) of one channel; NaN are left out. `floor`: a sigma below which the sensor
    does not go, so that an explanation is not paid for fitting noise."""
    return min(_kinds(parts, floor), key=lambda c: c.score)


def _tried(parts: Sequence[np.ndarray], floor: float) -> list[Colour]:
    """Every colour, white first; none where there is no data."""
    parts = [p[np.isfinite(p)] for p in parts]
    parts = [p for p in parts if len(p) > 8]
    n = sum(map(len, parts))

    if not n:
        return []
    e, ends = np.concatenate(parts), np.cumsum([len(p) for p in parts], dtype=np.intp)

    def tried(filters: Sequence[_Filter]) -> list[Colour]:
        found = np.maximum(variances(e, ends, *_arrays(filters)), floor**2)
        return [
            Colour(float(np.sqrt(v)), ar, ma, n * float(np.log(v)) + parameters * float(np.log(n)))
            for v, (ar, ma, parameters) in zip(found, filters, strict=True)
        ]

    found = tried(_filters())
    if (
        found[0].score - min(c.score for c in found) > AS_LIKELY
    ):  # not white, so a first-order part and flicker may both be there
        found += tried(_mixed())
    return found


@cache
def _arrays(filters: Sequence[_Filter]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ar and ma (F, K), filled up with zeros, and orders (F,)."""
    orders = np.array([len(ar) - 1 for ar, _, _ in filters], dtype=np.intp)
    ar, ma = (np.zeros((len(filters), int(orders.max()) + 1)) for _ in range(2))
    for k, f in enumerate(filters):
        ar[k, : orders[k] + 1], ma[k, : orders[k] + 1] = f[0], f[1]
    return ar, ma, orders


def _kinds(parts: Sequence[np.ndarray], floor: float) -> tuple[Colour, Colour]:
    """The best white or first-order colour, and the best with flicker noise (or none)."""
    found = _tried(parts, floor) or [Colour(floor, (1.0,), (1.0,), 0.0)]
    plain = min((c for c in found if len(c.ar) <= 2), key=lambda c: c.score)
    return plain, min((c for c in found if len(c.ar) > 2), key=lambda c: c.score, default=plain)


def least_gain(before: Sequence[np.ndarray], after: Sequence[np.ndarray], sigmas: Sequence[float]) -> float:
    """By how much the score falls from one explanation's residuals to another's when every channel has, of the colours that
    are as likely before, the one that is paid least: a short record does not tell flicker noise from first-order noise, and
    the slowest patterns are unlikely in one and nothing special in the other. A channel that is white afterwards had no
    colour of its own, nor has one whose residual is larger than a sensor's colour can be."""
    total = 0.0
    for j, sigma in enumerate(sigmas):
        old, new = ([r[:, j] for r in residuals] for residuals in (before, after))
        was, now = _tried(old, 0.6 * sigma), _tried(new, 0.6 * sigma)
        if was and now:
            first, best = min(c.score for c in was), min(now, key=lambda c: c.score)
            if len(best.ar) == 1 or max(_power(r, sigma) for r in old) > LARGE**2:
                total += first - best.score
            else:
                same = {(c.ar, c.ma): c.score for c in now}
                total += min(
                    c.score - same.get((c.ar, c.ma), best.score) for c in was if c.score <= first + AS_LIKELY
                )
        total += sum(_price(a, sigma) - _price(b, sigma) for a, b in zip(old, new, strict=True))
    return total


def white_sigma(parts: Sequence[np.ndarray]) -> float:
    """The white part of a residual, from second differences (robust; slow misfit does not reach them)."""
    second = [np.diff(p[np.isfinite(p)], 2) for p in parts]
    joined = np.concatenate([s for s in second if len(s)] or [np.zeros(1)])
    return float(1.4826 * np.median(np.abs(joined)) / np.sqrt(6))


def channels(residuals: Sequence[np.ndarray], sigmas: Sequence[float]) -> list[Colour]:
    """Return the noise model of every output, over all recordings; its score includes the prior.

    residuals: per recording (N, outputs); sigmas: white noise per output."""
    out = []
    for j, sigma in enumerate(sigmas):
        found = colour([r[:, j] for r in residuals], 0.6 * sigma)
        price = sum(_price(r[:, j], sigma) for r in residuals)
        out.append(dataclasses.replace(found, score=found.score + price))
    return out


def possible(residuals: Sequence[np.ndarray], sigmas: Sequence[float]) -> list[list[Colour]]:
    """Colours of all channels, as `channels` finds them and, where channels have another kind as likely, with that one."""
    pairs = [_kinds([r[:, j] for r in residuals], 0.6 * sigma) for j, sigma in enumerate(sigmas)]
    best = [min(kinds, key=lambda c: c.score) for kinds in pairs]
    other = [max(kinds, key=lambda c: c.score) for kinds in pairs]
    other = [o if o.score < b.score + AS_LIKELY else b for b, o in zip(best, other, strict=True)]
    return [best] if other == best else [best, other]


def _power(e: np.ndarray, sigma: float) -> float:
    """Mean square in units of the white noise's, outliers cut; 0 where there is no data."""
    e = np.abs(e[np.isfinite(e)])
    limit = 8 * max(sigma, 1.5 * float(np.median(e))) if len(e) else 0.0
    return float(np.mean(np.minimum(e, limit) ** 2)) / sigma**2 if len(e) else 0.0


def _price(e: np.ndarray, sigma: float) -> float:
    e = e[np.isfinite(e)]
    power = _power(e, sigma)
    excess = max(power - 1.0, 0.0)
    return 0.5 * (excess if excess <= 30 else 30 * (1 + float(np.log(excess / 30)))) + WEIGHT * len(e) * max(
        float(np.log(max(power, 1e-9) / LARGE**2)), 0.0
    )
