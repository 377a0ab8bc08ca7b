"""Is a law physics, or the shape of a misfit that nobody will name?

A misfit has the size e in 1 / `alike` directions of a recording (misfit.py), and any size is as likely as
another. So errors of the energy E have the likelihood

    integral of e^-n exp(-n E / (2 e^2)) de / e ~ E^(-n/2),   n = 1 / alike

Another recording is another draw of the misfit. There a law that was fitted elsewhere has no free parameter.
So the odds that it describes the part that it claims are (E without it / E with it)^(n/2). They multiply
those on the data of the fit. The end of the same recording is no other draw, because slow errors go on. It
only shows how much of the energy stays beside the law.

The prior odds bear the cost of the choice. A misfit has as many chances to look like a law as there are
laws."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.special import logit

from thermoctl.diagnose.case import Case, with_tables
from thermoctl.diagnose.fit import Fitted, fitted
from thermoctl.diagnose.held_out import Worth
from thermoctl.diagnose.law.propose import Proposal
from thermoctl.diagnose.limits import Limits
from thermoctl.diagnose.misfit import energies, physics
from thermoctl.diagnose.search import Searched, Weighed
from thermoctl.recording.table import Table

CHOOSES = 2 / 3  # of each recording, where none is set aside; the rest tests the law
CERTAIN = 1e9  # log odds that stand for certainty
TINY = 1e-12  # least share of the energy that stays


def held_back(case: Case, parent: Fitted) -> tuple[Case, Fitted, list[Table]]:
    """Return case and hypothesis without the last part of each recording, and recordings of that part."""
    ends = [t.t[0] + CHOOSES * (t.t[-1] - t.t[0]) for t in case.tables]
    first = [_rows(t, t.t <= end) for t, end in zip(case.tables, ends, strict=True)]
    measured = {o.column for o in case.plant.outputs.values()}
    last = [
        dataclasses.replace(
            t,
            columns={k: np.where(t.t > end, v, np.nan) if k in measured else v for k, v in t.columns.items()},
        )
        for t, end in zip(case.tables, ends, strict=True)
    ]
    short = with_tables(case, first)
    effects = parent.hypothesis.effects
    base = (
        fitted(short, parent.rough_plant, effects) if effects else fitted(short, short.plant, (), short.null)
    )
    return short, base, last


def _rows(t: Table, kept: np.ndarray) -> Table:
    return dataclasses.replace(t, t=t.t[kept], columns={k: v[kept] for k, v in t.columns.items()})


def misfit_odds(
    case: Case,
    parent: Fitted,
    law: Fitted,
    p: Proposal,
    limits: Limits,
    test: Worth | None = None,
    apart: bool = True,
) -> float:
    """Return the log odds that a law is no shape of the misfit.

    `test`: errors on data that it was not fitted to; `apart`: whether these are other recordings."""
    searched = Searched((Weighed(law, 0.0), Weighed(parent, 0.0)), False)
    energy = energies(case, searched, limits)
    mine, rival = energy[law.hypothesis.keys], energy[parent.hypothesis.keys]
    elsewhere = 0.0
    if test:
        stays = _stays(case, test)
        if apart:
            elsewhere = -float(np.log(max(stays, TINY))) / (2 * limits.alike)
        else:
            left = tuple(max(m, e * stays) for m, e in zip(mine.misfit, rival.squares, strict=True))
            mine = dataclasses.replace(mine, misfit=left)
    dims = sum(len(t.form.sizes) + len(t.form.shapes) for t in p.terms)
    sure = physics(rival, mine, 1 - (1 - limits.alike) ** dims)
    return min(float(logit(sure)), CERTAIN) - p.cost + elsewhere


def _stays(case: Case, test: Worth) -> float:
    """Return the share of the energy that stays with a law; infinite where the simulation failed."""
    before, after = _energies(case, test)
    return after / before if before > 0 else 1.0


def closed(case: Case, value: Worth) -> float:
    """Return the share of the misfit's energy beyond the noise that a law closes."""
    before, after = _energies(case, value, 1.0)
    return 1 - after / before if before > 0 and np.isfinite(after) else 0.0


def _energies(case: Case, value: Worth, noise: float = 0.0) -> tuple[float, float]:
    """Return the energies without and with the law: mean squares over the noise's, summed over the outputs.

    `noise`: its own energy, to be taken off. Infinite where the simulation failed."""
    sigma = {o.name: case.noise[j].sigma for j, o in enumerate(case.plant.outputs.values())}

    def energy(rms: Mapping[str, float]) -> float:
        """Return the energy beyond the noise, summed over outputs."""
        return sum(max((rms.get(o, np.inf) / sigma[o]) ** 2 - noise, 0.0) for o in value.refit_only)

    return energy(value.refit_only), energy(value.after)
