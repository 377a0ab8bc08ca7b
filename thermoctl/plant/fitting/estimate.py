"""The result of a refit for each parameter (value, standard error, state) and the plant with these values."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import PRIOR_WEIGHT, Scale
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation

DEAD = 0.1  # `dead`: a parameter's whole range changes the residuals by fewer standard deviations
FLAT = 0.5  # `flat`: a parameter's standard error exceeds this share of its range
CORRELATED = 0.95


@dataclass(frozen=True)
class Estimate:
    """One parameter after a refit.

    `state`: 'ok', 'at bound', 'dead' (the data are not sensitive to it) or 'flat' (they determine only a
    combination of it with others). `trades_with`: the parameters whose estimates correlate with it above
    CORRELATED."""

    name: str
    value: float
    sd: float
    unit: str | None
    state: str
    trades_with: tuple[str, ...] = ()
    recording: str | None = None


def report(found: Fit, excitations: Sequence[Excitation] | None = None) -> list[Estimate]:
    """Return value, standard error and state of each parameter, from the Gauss-Newton matrix at the fit."""
    n = sum(1 for q, _ in found.unknowns if q in found.model.active)
    sd, corr = correlations(found)
    out = []
    for k, (q, r) in enumerate(found.unknowns[:n]):
        p = found.model.plant.parameters[q]
        value = float(found.values[r or 0, found.model.parameters.index(q)])
        slope = Scale(p).slope(value)
        sensitivity = np.sqrt(max(found.hessian[k, k] - PRIOR_WEIGHT**2, 0.0))
        trades = tuple(
            found.unknowns[c][0] for c in np.flatnonzero(np.abs(corr[k, :n]) > CORRELATED) if c != k
        )
        state = (
            "dead"
            if sensitivity < DEAD
            else "at bound"
            if q in found.at_bound
            else "flat"
            if sd[k] > FLAT
            else "ok"
        )
        name = excitations[r].name if excitations is not None and r is not None else None
        out.append(Estimate(q, value, float(sd[k] * slope), p.unit, state, trades, name))
    return out


def correlations(found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard errors of a fit's unknowns, as they are scaled there, and their correlations."""
    residual = found.cost / max(found.samples - len(found.z), 1)
    inverse = np.linalg.pinv(found.hessian, hermitian=True) * max(residual, 1.0)
    sd = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    return sd, inverse / np.maximum(np.outer(sd, sd), 1e-300)


def updated(plant: Plant, found: Fit, excitations: Sequence[Excitation]) -> Plant:
    """Return the plant with the fitted values, by recording for parameters with `per_recording`."""
    parameters = dict(plant.parameters)
    for q in found.model.active:
        p = parameters[q]
        if not p.range:
            continue
        column = found.values[:, found.model.parameters.index(q)]
        values = (
            {d.name: float(v) for d, v in zip(excitations, column, strict=True)}
            if p.per_recording
            else p.values
        )
        parameters[q] = dataclasses.replace(p, value=float(np.clip(np.mean(column), *p.range)), values=values)
    return dataclasses.replace(plant, parameters=parameters)


def starts(found: Fit, excitations: Sequence[Excitation]) -> dict[str, dict[str, float]]:
    """Return the fitted initial values by recording and node; empty where no initial value is uncertain."""
    model, out = found.model, dict[str, dict[str, float]]()
    for d, values, dx0 in zip(excitations, found.values, found.dx0, strict=True):
        states = dict(zip(model.states, model.start(d, values, dx0)[0], strict=True))
        out[d.name] = {n: float(states[n]) for n in model.uncertain}
    return out if model.uncertain else {}
