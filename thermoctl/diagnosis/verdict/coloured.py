"""Is a remainder nothing but the coloured noise of a sensor?

The noise of such a reading has the variance s^2 [1 - a + a A(tau)], with A the spectrum of a first-order
process. a and tau are the likeliest of a grid, and s follows from them. A state that random flows move has
such an error, too, but the white noise that the plant file states stays beside it. So the stated noise itself
has to be coloured. Its white part is below the stated noise by a standard deviation of that one's prior. The
whole is above it by one at most. The residual over the root of this spectrum has to be white. It follows no
signal of the plant and no other reading, and it is as large in each part of a recording.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.fft import idct
from scipy.special import chdtrc, fdtrc

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.data.coordinates import transform
from thermoctl.diagnosis.data.grids import Grid
from thermoctl.diagnosis.data.spectra import first_order
from thermoctl.diagnosis.evidence.fit import Fitted
from thermoctl.diagnosis.evidence.where import along

SHARES = 1 - np.array([0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9])  # a
TIMES = 20  # correlation times in all recordings together, at least: of fewer, no spectrum is known
CHANCE = 0.01  # chance of a test below which the residual is no such noise
PARTS = 8  # number of parts of a recording, none of which may have too large a power
LAGS = (0, 1, 2, 4, 8, 16, 32, 64)  # rows by which a signal may be earlier


def coloured(case: Case, f: Fitted) -> list[str]:
    """Return a sentence for each output with a certain remainder; none if one is not its noise alone."""
    out = []
    for g, p in zip(case.grids, f.average.remainder, strict=True):
        if p < case.limits.name:
            continue
        interval = case.coordinates.channels[g.channels[0]].interval
        size, share, time = _likeliest(g, g.power(f.powers))
        least, most = g.variance * np.exp([-g.known, g.known])
        small = (1 - share) * size**2 <= least and size**2 <= most
        if (
            not small
            or time >= g.count.sum() / TIMES
            or min(_chances(case, f, g, size, share, time)) < CHANCE
        ):
            return []
        white, drift = size * np.sqrt(1 - share), size * np.sqrt(share)
        unit = case.plant.outputs[g.output].unit or ""
        out.append(
            f"the noise of {g.output} is coloured: {size:.2g} {unit}, correlated over {time * interval:.2g} s ({time:.2g} rows). State "
            f"it in the plant file, noise: {{white: {white:.2g}, drift: {drift:.2g}, time: {time * interval:.2g}}}, and diagnose again"
        )
    return out


def _likeliest(g: Grid, power: np.ndarray) -> tuple[float, float, float]:
    """Return the size s, the share a of its variance that is correlated, and the time in rows."""
    rows, best = g.count.sum(), (np.inf, 0.0, 0.0, 0.0)
    for time in np.geomspace(1.0, rows / TIMES, 60):
        for share in SHARES:
            shape = 1 - share + share * first_order(time, g.turn)
            variance = float((power / shape).sum() / rows)
            cost = float(g.count @ np.log(variance * shape))
            best = min(best, (cost, np.sqrt(variance), float(share), float(time)))
    return best[1:]


def _chances(case: Case, f: Fitted, g: Grid, size: float, share: float, time: float) -> Iterator[float]:
    """Yield the chance of residuals that follow the signals as well (F test), and of parts as large."""
    names = [*along(f.fit, case.drives(f.fit.model))]
    residuals, others = [], []
    for c in (case.coordinates.channels[k] for k in g.channels):
        r, rows = c.recording, np.arange(c.rows)
        root = size * np.sqrt(1 - share + share * first_order(time, np.pi * (rows + 0.5) / c.rows))
        e = f.fit.residuals[r]
        moving = [x - np.mean(x) for x in names[r].values() if np.ndim(x) and np.ptp(x) > 0]
        beside = [np.nan_to_num(e[:, j]) for j in range(e.shape[1]) if j != c.output]
        every = [*moving, *(x**2 for x in moving), *(x * np.abs(x) for x in moving), *beside]
        late = [np.append(np.full(lag, x[0]), x)[: len(x)] for x in every for lag in LAGS]
        others.append(transform(c, np.array(late).T) / root[:, None])
        residuals.append(transform(c, e[:, c.output]) / root)
        parts = np.array_split(idct(residuals[-1], norm="ortho"), PARTS)
        yield min(chdtrc(len(part), float(part @ part)) for part in parts) * PARTS * len(g.channels)
    z, x = np.concatenate(residuals), np.concatenate(others)
    if 2 * x.shape[1] > len(z):
        yield 0.0  # too few rows to tell
        return
    shapes, sizes, _ = np.linalg.svd(x / np.linalg.norm(x, axis=0), full_matrices=False)
    shapes = shapes[:, sizes > 1e-3 * sizes[0]]
    followed, n = float(np.sum((shapes.T @ z) ** 2)), shapes.shape[1]
    yield float(fdtrc(n, len(z) - n, followed / n / ((z @ z - followed) / (len(z) - n))))
