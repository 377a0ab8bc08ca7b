"""An output that jumps by a delayed and a present signal: its trial run ended in a KeyError."""

import numpy as np
from scipy.integrate import solve_ivp

from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

LAGGED = """
format: thermoctl-plant/1
title: A body whose reading jumps with the sign of its change
inputs: {u: {between_samples: linear}}
nodes: {x: {storage: 1, initial: 0}}
flows: {f: {into: x, rate: u - x}}
outputs: {y: {value: "delay(x, 0.3) + 0.1 * sign(delay(x, 0.3) - x)", noise: 0.1}}
"""


def test_an_output_that_jumps_by_a_delayed_and_a_present_signal():
    t = np.arange(0, 20, 0.1)
    u = np.sin(t)
    y = compile_plant(loads(LAGGED)).simulate(Table("run", "", t, {"u": u, "y": 0 * t})).y[:, 0]
    right = solve_ivp(
        lambda at, x: np.interp(at, t, u) - x, (0, 20), [0.0], rtol=1e-9, max_step=0.05, dense_output=True
    )
    now, then = (right.sol(np.maximum(t - delay, 0))[0] for delay in (0, 0.3))
    error = np.abs(y - then - 0.1 * np.sign(then - now))
    assert np.sort(error)[-8] < 1e-3  # but for samples at a jump
