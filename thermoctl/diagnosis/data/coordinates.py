"""Residuals in frequency: the orthonormal DCT-II of each output's measured samples in each recording.

The rows of a stationary noise are nearly independent, with its spectral density as variance (Whittle's
likelihood). So are those of a random walk. Missing samples are left out and the others joined: this is exact
for white noise.

    R = DCT(e),   log p(e | V) = -1/2 sum_k (log 2 pi V_k + R_k^2 / V_k)

Noise models differ only in V, which is smooth. To compare them, the power of R in bands of rows is enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from scipy.fft import dct, idct

from thermoctl.plant.fitting.whitening import measured
from thermoctl.plant.simulation.simulate import Excitation

SINGLE = 6  # lowest rows that are bands of their own
WIDTH = 1.19  # ratio of a band's ends: a quarter of an octave
SHORT = 4_000  # up to so many samples a DCT is fast for any number of them
FEWEST = 8  # an output with fewer measured samples in a recording is not used there


@dataclass(frozen=True)
class Channel:
    """One output in one recording: its measured samples, and the frequency band of each DCT row."""

    recording: int
    output: int
    index: np.ndarray  # indices of the measured samples
    block: int  # samples that are averaged before the transform
    band: np.ndarray  # (rows,) the band of each row
    count: np.ndarray  # (bands,) rows in each
    frequency: np.ndarray  # (bands,) Hz, middle of each band
    interval: float  # s, mean between measured samples

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.band)


@lru_cache(maxsize=256)
def bands(rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges of the bands, the number of rows in each, and the band of each row.

    Edges are the first row of each band, and the number of rows at the end. Channels share these arrays."""
    ends = list(range(min(SINGLE, rows)))
    while ends[-1] < rows:
        ends.append(max(ends[-1] + 1, int(ends[-1] * WIDTH)))
    ends[-1] = rows
    edges = np.array(ends)
    count = np.diff(edges)
    band = np.repeat(np.arange(len(count)), count)
    for shared in (edges, count, band):
        shared.flags.writeable = False
    return edges, count, band


def channel(d: Excitation, r: int, j: int, most: int | None = None) -> Channel | None:
    """Return the channel of output j in recording r; None where too little was measured.

    `most`: about the largest number of rows, the lowest ones."""
    index = measured(d.y[:, j])
    if len(index) < FEWEST:
        return None
    index = index[: quick(len(index))]
    block = max(1, len(index) // (2 * most)) if most else 1
    n = len(index) // block
    rows = min(n, most or n)
    edges, count, band = bands(rows)
    middle = 0.5 * (edges[:-1] + edges[1:] - 1)
    span = float(d.t[index[-1]] - d.t[index[0]]) * n * block / max(len(index) - 1, 1)
    return Channel(r, j, index, block, band, count, np.maximum(middle, 0.5) / (2 * span), span / (n * block))


@cache
def quick(n: int) -> int:
    """Return the largest number up to n without a large prime factor, for a fast DCT."""

    def without_small_primes(m: int) -> int:
        """Return the factor of `m` without primes up to 31."""
        for p in (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31):
            while m % p == 0:
                m //= p
        return m

    return next(m for m in range(n, 0, -1) if without_small_primes(m) == 1) if n > SHORT else n


def transform(c: Channel, e: np.ndarray) -> np.ndarray:
    """Return the DCT rows (rows, ...) of a channel from its output's values (N, ...) at all samples."""
    return _dct(_blocks(c, e), c.rows)


def transforms(channels: Sequence[Channel], e: np.ndarray) -> np.ndarray:
    """Return the rows (rows, ...) of a recording's channels, in turn, from its values (N, outputs, ...)."""
    return np.concatenate(rows_of_each(channels, e))


def rows_of_each(channels: Sequence[Channel], e: np.ndarray) -> list[np.ndarray]:
    """Return the rows (rows, ...) of each of a recording's channels from its values (N, outputs, ...).

    Channels of the same samples are summed over their blocks at once: that is several times faster. Single
    values are transformed at once, too."""
    first = channels[0] if channels else None
    if not first or any(c.block != first.block or not np.array_equal(c.index, first.index) for c in channels):
        return [transform(c, e[:, c.output]) for c in channels]
    sums = _blocks(first, e)
    if sums.ndim == 2:
        return list(np.ascontiguousarray(_dct(sums[:, [c.output for c in channels]], first.rows).T))
    return [_dct(sums[:, c.output], c.rows) for c in channels]


def _dct(e: np.ndarray, rows: int) -> np.ndarray:
    """Return the lowest rows (rows, ...) of the DCT of values (N, ...).

    Values of one output lie apart: a copy side by side takes less time than the transform loses there."""
    return dct(np.array(e, order="C"), axis=0, norm="ortho", overwrite_x=True)[:rows]


def _blocks(c: Channel, e: np.ndarray) -> np.ndarray:
    """Return the sums over blocks of samples (blocks, ...), as large as white noise in one sample."""
    part = e if len(c.index) == len(e) else e[c.index]
    if c.block == 1:
        return part
    n = len(part) // c.block
    each = part[: n * c.block].reshape(n, c.block, -1)
    return np.matmul(np.full(c.block, c.block**-0.5), each).reshape(n, *part.shape[1:])


class Coordinates:
    """The rows of all outputs in all recordings; channels are in the order of the recordings."""

    def __init__(self, drives: Sequence[Excitation], most: int | None = None):
        channels = (channel(d, r, j, most) for r, d in enumerate(drives) for j in range(d.y.shape[1]))
        self.channels = [c for c in channels if c is not None]

    def by_output(self) -> dict[int, tuple[int, ...]]:
        """Return the positions of each measured output's channels, by output."""
        outputs = sorted({c.output for c in self.channels})
        return {j: tuple(k for k, c in enumerate(self.channels) if c.output == j) for j in outputs}

    def of_recording(self, r: int) -> list[Channel]:
        """Return the channels of a recording."""
        return [c for c in self.channels if c.recording == r]

    def transposed(self, c: Channel, rows: np.ndarray, samples: int) -> np.ndarray:
        """Return the transpose of `transform`: rows (rows, k) of a channel as values (samples, k)."""
        n = len(c.index) // c.block
        part = idct(np.concatenate([rows, np.zeros((n - c.rows, rows.shape[1]))]), axis=0, norm="ortho")
        out = np.zeros((samples, rows.shape[1]))
        out[c.index[: n * c.block]] = np.repeat(part, c.block, axis=0) / np.sqrt(c.block)
        return out

    def powers(self, rows: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the sum of squares of each channel's rows (rows,) in each of its bands (bands,)."""
        return [np.bincount(c.band, x * x) for c, x in zip(self.channels, rows, strict=True)]
