"""The noise that a residual is compared with, and their ratio."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.data.grids import Grid
from thermoctl.diagnosis.evidence.fit import Fitted

PRESENT = 0.5  # probability of a remainder from which the output's noise is not estimated from its residual
RARE = 0.05  # an octave contradicts a noise if the chance of so small a power is below this


def floor(g: Grid, powers: Sequence[np.ndarray], absorbed: int) -> float:
    """Return the largest variance of a noise that the power of no octave contradicts, up to `Grid.most`.

    Errors of a plant fall with frequency, so power at all frequencies is noise. `absorbed`: number of
    unknowns of a refit. They may have absorbed as many DCT rows, in the worst case all of one octave."""
    power = g.power(powers) / g.shape
    octave = np.cumsum(np.append(0.0, np.diff(np.log2(g.turn)))).astype(int)
    rows = np.bincount(octave, g.count) - absorbed
    filled = rows > 0
    allowed = np.bincount(octave, power)[filled] / chdtri(rows[filled], 1 - RARE)
    return float(min(allowed.min(initial=g.most), g.most))


def timing(case: Case, f: Fitted) -> list[float]:
    """Return the variance above each output's stated noise, at most what uncertain times may add."""
    beyond = [floor(g, f.powers, len(f.fit.unknowns)) - g.variance for g in case.grids]
    return [float(np.clip(v, 0.0, g.timing)) for v, g in zip(beyond, case.grids, strict=True)]


def late(case: Case, f: Fitted) -> list[str]:
    """Return a sentence for each output whose uncertain times add more error than the stated noise."""
    out = []
    for g, v in zip(case.grids, timing(case, f), strict=True):
        if v > g.variance:
            unit = case.plant.outputs[g.output].unit or ""
            out.append(
                f"{g.output} errs by {np.sqrt(v):.2g} {unit} beside its noise, at all frequencies: recorded times that are off by "
                f"{100 * np.sqrt(v) / g.change:.2g} % of a sampling interval would do that"
            )
    return out


def rounded(case: Case) -> list[bool]:
    """Return for each output whether it is coarsely rounded: a remainder there proves nothing."""
    return [g.coarse for g in case.grids]


def remainder(case: Case, f: Fitted) -> float:
    """Return the largest probability of a remainder at an output that is not coarsely rounded."""
    probabilities = zip(f.average.remainder, rounded(case), strict=True)
    return max((p for p, coarse in probabilities if not coarse), default=0.0)


def levels(case: Case, f: Fitted) -> list[float]:
    """Return the standard deviation of each output's noise.

    Without a likely remainder it is estimated from the residual, within two standard deviations of the prior
    of the stated noise. With one it is the stated noise, plus the variance that uncertain times add."""
    out = []
    for g, late, sensor, p in zip(
        case.grids, timing(case, f), f.average.sensor, f.average.remainder, strict=True
    ):
        wrong = np.exp(2 * g.known)
        learnt = float(np.clip(sensor, g.variance / wrong, max(g.variance * wrong, g.variance + late)))
        out.append(float(np.sqrt(learnt if p < PRESENT else g.variance + late)))
    return out


def over_noise(case: Case, f: Fitted) -> list[float]:
    """Return the rms of each output's residuals over its noise (`levels`)."""
    squares = (sum(f.powers[k].sum() for k in g.channels) / g.count.sum() for g in case.grids)
    return [float(np.sqrt(q)) / level for q, level in zip(squares, levels(case, f), strict=True)]


def only_noise(case: Case, f: Fitted) -> bool:
    """Is the residual about as large as the noise, and no remainder in it certain?"""
    return max(over_noise(case, f)) <= case.limits.clean and remainder(case, f) < case.limits.name
