"""The noise that a residual is compared with, and their ratio."""

from __future__ import annotations

import numpy as np

from thermoctl.diagnose.case import Case
from thermoctl.diagnose.fit import Fitted
from thermoctl.diagnose.noise import Grid, floor


def levels(case: Case, f: Fitted, clean: float) -> list[float]:
    """Return the standard deviation of each output's noise: the stated one, or more if that explains all.

    A stated noise and the recorded times may be wrong by one standard deviation of their priors. So variance
    that is present at all frequencies counts as noise up to there. The residual must then be within `clean`
    times this noise."""
    out = []
    for g in case.grids:
        level = float(np.sqrt(max(floor(g, f.powers, len(f.fit.unknowns)), g.variance)))
        out.append(level if _rms(f, g) <= clean * level else g.sigma)
    return out


def over_noise(case: Case, f: Fitted, clean: float) -> list[float]:
    """Return the rms of each output's residuals over its noise (`levels`)."""
    return [_rms(f, g) / level for g, level in zip(case.grids, levels(case, f, clean), strict=True)]


def _rms(f: Fitted, g: Grid) -> float:
    return float(np.sqrt(sum(f.powers[k].sum() for k in g.channels) / g.count.sum()))
