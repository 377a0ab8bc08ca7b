"""The noise that a residual is compared with, and their ratio."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from thermoctl.diagnose.case import Case
from thermoctl.diagnose.fit import Fitted
from thermoctl.diagnose.noise import Grid

RARE = 0.05  # chance of a power as small as that of an octave, below which it contradicts a noise


def floor(g: Grid, powers: Sequence[np.ndarray], absorbed: int) -> float:
    """Return the largest variance of a noise that the power of no octave contradicts, up to `Grid.most`.

    Errors of a plant fall with frequency. Power that is there at all frequencies is noise. `absorbed`: number
    of unknowns of a refit, which may have absorbed that many rows, all of them in one octave."""
    power = g.power(powers) / g.shape
    octave = np.cumsum(np.append(0.0, np.diff(np.log2(g.turn)))).astype(int)
    rows = np.bincount(octave, g.count) - absorbed
    told = rows > 0
    allowed = np.bincount(octave, power)[told] / chi2.ppf(RARE, rows[told])
    return float(min(allowed.min(initial=g.most), g.most))


def timing(case: Case, f: Fitted) -> list[float]:
    """Return each output's variance beyond its stated noise at all frequencies, as far as uncertain times may
    add it."""
    beyond = [floor(g, f.powers, len(f.fit.unknowns)) - g.variance for g in case.grids]
    return [float(np.clip(v, 0.0, g.timing)) for v, g in zip(beyond, case.grids, strict=True)]


def late(case: Case, f: Fitted) -> list[str]:
    """Return sentences about outputs that uncertain times make more wrong than the stated noise."""
    out = []
    for g, v in zip(case.grids, timing(case, f), strict=True):
        if v > g.variance:
            name = f.fit.model.outputs[case.coordinates.channels[g.channels[0]].output]
            unit = case.plant.outputs[name].unit or ""
            out.append(
                f"{name} errs by {np.sqrt(v):.2g} {unit} beside its noise, at all frequencies: recorded times that are off by "
                f"{100 * np.sqrt(v) / g.change:.2g} % of a sampling interval would do that"
            )
    return out


def levels(case: Case, f: Fitted, clean: float) -> list[float]:
    """Return the standard deviation of each output's noise: the stated one, or more if that explains all.

    A stated noise and the recorded times may be wrong by one standard deviation of their priors. So variance
    that is present at all frequencies counts as noise up to there. The residual must then be within `clean`
    times this noise."""
    out = []
    for g, late in zip(case.grids, timing(case, f), strict=True):
        lowest, at = np.inf, 0
        for k in g.channels:
            inverse = f.average.inverse[k]
            stated = g.variance * g.shape[g.node[at : at + len(inverse)]]
            lowest = min(lowest, float(np.min(1 / (inverse * stated))))
            at += len(inverse)
        own = g.variance * float(np.clip(lowest, 1.0, np.exp(g.known)))
        level = float(np.sqrt(max(own, g.variance + late)))
        out.append(level if _rms(f, g) <= clean * level else g.sigma)
    return out


def over_noise(case: Case, f: Fitted, clean: float) -> list[float]:
    """Return the rms of each output's residuals over its noise (`levels`)."""
    return [_rms(f, g) / level for g, level in zip(case.grids, levels(case, f, clean), strict=True)]


def _rms(f: Fitted, g: Grid) -> float:
    return float(np.sqrt(sum(f.powers[k].sum() for k in g.channels) / g.count.sum()))
