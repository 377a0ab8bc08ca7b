"""Signals some seconds earlier: cubic between samples, and without overshoot where a signal jumps."""

from __future__ import annotations

import numpy as np

LEAST = 1e-9  # smaller bends, as a share of the largest, are rounding errors


@np.errstate(over="ignore", invalid="ignore")  # the sensitivities of a run away from the data
def earlier(
    t: np.ndarray, g: np.ndarray, seconds: float, dg: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return a signal g (N,) some seconds earlier, its slope there, and its changes dg (N, k), earlier.

    Between two samples it is Akima's cubic (J. ACM 17 (1970) 589). Outside the recording g is held."""
    at = np.clip(t - seconds, t[0], t[-1])
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = t[k + 1] - t[k]
    s = (at - t[k]) / h
    share = _shares(t, g)
    values = (1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2 * h, s * s * (3 - 2 * s), s * s * (s - 1) * h
    slopes = 6 * s * (s - 1) / h, (1 - s) * (1 - 3 * s), 6 * s * (1 - s) / h, s * (3 * s - 2)
    inside = (t - seconds > t[0]) & (t - seconds <= t[-1])
    rate = np.where(inside, _cubic(t, g, share, k, slopes), 0.0)
    changes = None if dg is None else _cubic(t, dg, share, k, values)
    return _cubic(t, g, share, k, values), rate, changes


def _cubic(
    t: np.ndarray, g: np.ndarray, share: np.ndarray, k: np.ndarray, basis: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Return Hermite's cubics in the intervals k (N,) of signals g (N, ...): their values or their slopes."""
    turned = (slice(None), *[None] * (g.ndim - 1))
    lines, share = _lines(t, g), share[turned]
    rate = share * lines[1:-2] + (1 - share) * lines[2:-1]
    parts = zip(basis, (g[k], rate[k], g[k + 1], rate[k + 1]), strict=True)
    return np.asarray(sum(b[turned] * part for b, part in parts))


def _lines(t: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the slopes (N + 3, ...) of the lines between samples, and of two more at each end."""
    d = (np.diff(g, axis=0).T / np.diff(t)).T
    first, last = d[0] - d[min(1, len(d) - 1)], d[-1] - d[max(len(d) - 2, 0)]
    return np.concatenate([[d[0] + 2 * first, d[0] + first], d, [d[-1] + last, d[-1] + 2 * last]])


def _shares(t: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the share (N,) of the line before a sample in the slope there: the less it bends, the more."""
    bends = np.abs(np.diff(_lines(t, g)))
    both = bends[2:] + bends[:-2]
    return np.divide(bends[2:], both, np.full(len(g), 0.5), where=both > LEAST * both.max())
