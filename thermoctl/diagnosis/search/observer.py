"""A plant with an observer that follows its recording, for rigs whose free run drifts away.

    dx/dt = f(x, u, p) + K (y_recorded - g(x)),     K = P C' R^-1 of the stationary Kalman-Bucy filter

An axis integrates every error. After a while the free run of a plant that lacks physics is far off, and
no local refit converges to the right values. An observer keeps the states near the recorded ones. Its
inputs `seen_*` and flows `correct_*` are part of the plant: search and refit need no change for it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_continuous_are

from thermoctl.diagnosis.evidence.where import along
from thermoctl.diagnosis.hypothesis.rig import CORRECT, SEEN
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import name, num
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.whitening import Noise
from thermoctl.plant.language import Flow, Input, Plant
from thermoctl.plant.simulation.simulate import Excitation

LASTING = 20.0  # correlation time of a missing flow in samples: intensity of the noise over its variance
RESTING = 1e-3  # least slope of a state over that of the fastest one, so that every state has process noise
PURE = 1e-6  # factor on the process noise of a state that only integrates another: nearly none
# A mode drifts if it keeps this share of an error to the end of the recordings. In 60 generated cases axes
# keep all of it. The next mode, a coil that cools slowly, keeps 0.38.
KEPT = 0.9
# Values to try of the process noise over the slopes' size; with a larger one the plant follows more closely.
TRUSTS = 0.01, 0.1


@dataclasses.dataclass(frozen=True)
class Linear:
    """dx/dt = a x, y = c x about the fitted trajectories, by medians over time; `rate`: rms of each slope."""

    a: np.ndarray
    c: np.ndarray
    rate: np.ndarray


def linear(fit: Fit, drives: Sequence[Excitation]) -> Linear | None:
    """Linearise a fitted plant about its trajectories; None where a delay or an FMU has no derivative."""
    model, n = fit.model, len(drives)
    states, outputs = model.states, model.plant.outputs.values()
    a, c, rate = np.zeros((len(states),) * 2), np.zeros((len(outputs), len(states))), np.zeros(len(states))
    for values in along(fit, drives):

        def median(e: ex.Expr, values: dict[str, np.ndarray | float] = values) -> float:
            """Return the median of an expression over time."""
            return float(np.median(np.asarray(ex.evaluate(e, values), float)))

        try:
            for i, slope in enumerate(model.code.slopes):
                if not ex.names(slope) <= values.keys():
                    return None
                rate[i] += float(np.sqrt(np.mean(np.asarray(ex.evaluate(slope, values), float) ** 2))) / n
                a[i] += [median(ex.derivative(slope, s)) / n for s in states]
            c += [[median(ex.derivative(o.value, s)) / n for s in states] for o in outputs]
        except ex.ExpressionError:
            return None
    return Linear(a, c, rate)


def drifts(plant: Linear, duration: float) -> bool:
    """Return whether a mode of the plant drifts: it keeps the share KEPT of an error; False if unknown.

    A body that only cools slowly does not drift: it is linear enough for a free run."""
    finite = bool(len(plant.a)) and bool(np.isfinite(plant.a).all())  # the slope of a root may be infinite
    return finite and bool(np.max(np.linalg.eigvals(plant.a).real) > np.log(KEPT) / duration)


def held(plant: Plant, about: Linear, noise: Sequence[Noise], interval: float, trust: float) -> Plant | None:
    """Return the plant with an observer; None where there is no stable gain."""
    rate = np.maximum(about.rate, RESTING * about.rate.max())
    q = (trust * rate) ** 2 * LASTING * interval
    pure = (np.count_nonzero(about.a, axis=1) == 1) & (np.diag(about.a) == 0)
    q[pure] *= PURE  # a position, the integral of a speed, has no process noise of its own
    r = np.array([n.sigma**2 * interval for n in noise])
    try:
        p = solve_continuous_are(about.a.T, about.c.T, np.diag(q), np.diag(r))
    except (np.linalg.LinAlgError, ValueError):
        return None
    gain = p @ about.c.T / r
    inputs, flows = dict(plant.inputs), dict(plant.flows)
    for o in plant.outputs.values():
        inputs[SEEN + o.name] = Input(SEEN + o.name, o.unit, o.column, True)
    for node, row in zip(plant.nodes.values(), gain, strict=True):
        terms = [
            ex.mul(num(float(k)), ex.add(name(SEEN + o.name), ex.neg(o.value)))
            for k, o in zip(row, plant.outputs.values(), strict=True)
            if k
        ]
        for j, term in enumerate(terms):
            key = f"{CORRECT}{node.name}_{j}"
            flows[key] = Flow(key, ex.mul(node.storage, term), None, node.name)
    return dataclasses.replace(plant, inputs=inputs, flows=flows)
