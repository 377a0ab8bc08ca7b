"""Predict a recording some seconds ahead, with the states renewed from its readings by a Kalman filter."""

from __future__ import annotations

import dataclasses

import numpy as np

from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation, Model

RENEWAL = 0.1  # largest error of a state, as a share of its range, allowed at the start of a block
RECENT = 0.25  # share of a block from which its data count in full; older ones fade exponentially


def all_uncertain(plant: Plant) -> Plant:
    """Return the plant with an uncertain initial state at every node."""
    nodes = {
        n.name: dataclasses.replace(n, initial_sigma=n.initial_sigma or 1.0) for n in plant.nodes.values()
    }
    return dataclasses.replace(plant, nodes=nodes)


def ahead(
    model: Model, excitation: Excitation, horizon_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predict states (N, nx) and outputs (N, ny) in blocks of `horizon_s`; also the last state (nx,).

    An extended Kalman filter estimates the states at the start of each block from the data before it. So a
    sample is predicted from data up to `horizon_s` older. The model must have every state uncertain and no
    active parameter."""
    if not model.states:
        run = model.run(excitation)
        return run.x, run.y, run.x[-1] if len(run.x) else np.zeros(0)
    if excitation.scale is None:
        model.prepare(excitation)
    p = model.vector(None, excitation.name)
    noise = np.array(
        [
            np.hypot(o.noise_sd, (o.resolution or 0.0) / 12**0.5)
            or 1e-3 * np.nanstd(excitation.y[:, j])
            or 1e-9
            for j, o in enumerate(model.plant.outputs.values())
        ]
    )
    scale = np.asarray(excitation.scale)
    x, y = (
        np.full((len(excitation.t), len(model.states)), np.nan),
        np.full((len(excitation.t), len(model.outputs)), np.nan),
    )
    state, _ = model.start(excitation, p)
    root = np.array([n.initial_sigma or 1.0 for n in model.plant.nodes.values()])
    information = np.diag(1 / np.minimum(root, np.maximum(scale, 1e-12)) ** 2)
    begin = 0
    while begin < len(excitation.t) - 1:
        stop = min(
            max(int(np.searchsorted(excitation.t, excitation.t[begin] + horizon_s, side="right")), begin + 2),
            len(excitation.t),
        )
        block = excitation.part(begin, stop)
        base, _ = model.start(block, p)
        run = model.run(block, p, state - base, sensitivities=True)
        assert run.dx is not None and run.dy is not None
        new = slice(1 if begin else 0, None)  # the first sample belongs to the block before
        x[begin:stop][new], y[begin:stop][new] = run.x[new], run.y[new]
        recent = np.exp(-(block.t[-1] - block.t) / (2 * RECENT * max(horizon_s, block.t[-1] - block.t[0])))
        matrix, gradient = information.copy(), np.zeros(len(state))
        for j in range(len(model.outputs)):
            e = block.y[:, j] - run.y[:, j]
            seen = np.isfinite(e)
            seen[0] &= begin == 0
            e = e[seen] / noise[j] * recent[seen]
            h = run.dy[seen, j] / noise[j] * recent[seen, None]
            matrix += h.T @ h
            gradient += h.T @ e
        state = state + np.linalg.solve(matrix, gradient)
        end = model.run(block, p, state - base)
        spread = run.dx[-1] @ np.linalg.solve(matrix, run.dx[-1].T) + np.diag((RENEWAL * scale) ** 2)
        information = np.linalg.inv((spread + spread.T) / 2)
        state, begin = end.x[-1], stop - 1
    return x, y, state
