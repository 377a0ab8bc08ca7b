"""A plant that follows its recording: the innovations form, for rigs whose free run forgets where it started.

    dx/dt = f(x, u, p) + K (y_recorded - g(x)),     K = P C^T R^-1 of the stationary Kalman-Bucy filter

Where an axis integrates every error, the free-run residual of a plant that lacks physics is chaotic in its parameters: no
local fit finds them. Held to the recording by an observer, each stretch is compared near where it happened; effects are
looked for there, and then proved in the free run. The observer is written in the plant language (inputs `seen_*`, flows
`correct_*`), so that everything else works on it unchanged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import solve_continuous_are

from thermoctl.plant import expression as ex
from thermoctl.plant.expression import name, num
from thermoctl.plant.language import Flow, Input, Plant
from thermoctl.plant.refit import Noise
from thermoctl.plant.simulate import Excitation, Model

SEEN, CORRECT = "seen_", "correct_"


def follows(
    plant: Plant, model: Model, drives: Sequence[Excitation], noise: Sequence[Noise], trust: float
) -> Plant | None:
    """The plant with an observer. `trust`: process noise as a share of the slopes' own size (a larger one follows the
    recording more closely). None where the recordings do not suffice for one (an output is missing, no stable gain)."""
    nx = len(model.states)
    if not nx or any(not np.isfinite(d.y).any(axis=0).all() for d in drives):
        return None
    runs = [model.run(d) for d in drives]
    a, c, rate = np.zeros((nx, nx)), np.zeros((len(model.outputs), nx)), np.zeros(nx)
    for d, run in zip(drives, runs, strict=True):
        values = {
            **dict(zip(model.inputs, d.u.T, strict=False)),
            **dict(zip(model.states, run.x.T, strict=True)),
            "t": d.t,
            **{p.name: p.values.get(d.name, p.value) for p in plant.parameters.values()},
        }

        def mean(e: ex.Expr, values: dict[str, Any] = values) -> float:
            return float(np.median(np.asarray(ex.evaluate(e, values), float)))

        for i, slope in enumerate(model.code.slopes):
            if ex.names(slope) - set(values):
                return None  # a delayed input
            rate[i] += float(
                np.sqrt(np.mean(np.square(np.asarray(ex.evaluate(slope, values), float))))
            ) / len(drives)
            for k, s in enumerate(model.states):
                a[i, k] += mean(ex.derivative(slope, s)) / len(drives)
        for j, o in enumerate(plant.outputs.values()):
            for k, s in enumerate(model.states):
                c[j, k] += mean(ex.derivative(o.value, s)) / len(drives)
    dt = float(np.median(np.diff(drives[0].t)))
    q = np.diag((trust * np.maximum(rate, 1e-3 * rate.max())) ** 2 * 20 * dt)
    for i, slope in enumerate(
        model.code.slopes
    ):  # a pure integral (position of a speed) has no noise of its own
        if (
            len(ex.names(slope) & set(model.states)) == 1
            and not ex.names(slope) - set(model.states)
            and model.states[i] not in ex.names(slope)
        ):
            q[i, i] *= 1e-6
    r = np.diag([n.sigma**2 * dt for n in noise])
    try:
        p = solve_continuous_are(a.T, c.T, q, r)
    except (np.linalg.LinAlgError, ValueError):
        return None
    gain = p @ c.T @ np.linalg.inv(r)
    if not np.all(np.isfinite(gain)):
        return None
    inputs, flows = dict(plant.inputs), dict(plant.flows)
    for o in plant.outputs.values():
        inputs[SEEN + o.name] = Input(SEEN + o.name, o.unit, o.column, True)
    for i, n in enumerate(plant.nodes.values()):
        total: ex.Expr = ex.ZERO
        for j, o in enumerate(plant.outputs.values()):
            if gain[i, j]:
                total = ex.add(
                    total, ex.mul(num(float(gain[i, j])), ex.add(name(SEEN + o.name), ex.neg(o.value)))
                )
        flows[CORRECT + n.name] = Flow(CORRECT + n.name, ex.mul(n.storage, total), None, n.name, None)
    return dataclasses.replace(plant, inputs=inputs, flows=flows)


def without(plant: Plant) -> Plant:
    """The plant with the observer taken out again."""
    return dataclasses.replace(
        plant,
        inputs={k: v for k, v in plant.inputs.items() if not k.startswith(SEEN)},
        flows={k: v for k, v in plant.flows.items() if not k.startswith(CORRECT)},
    )
