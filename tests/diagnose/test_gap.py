"""A recording with a gap is read in parts; hypotheses with further states start each part from its readings, too."""

import numpy as np

import thermoctl as tc
from thermoctl.plant.files import loads

PLANT = """format: thermoctl-plant/1
inputs:
  heat: {unit: W}
  air: {unit: degC}
parameters:
  C: {value: 80, unit: J/K, range: [20, 300]}
  G: {value: 0.3, unit: W/K, range: [0.05, 2]}
nodes:
  one: {unit: degC, storage: C, initial: 22, initial_sigma: 0.5}
flows:
  power: {into: one, rate: heat, unit: W}
  loss: {from: one, rate: G * (one - air), unit: W}
outputs:
  T: {value: one, unit: degC, noise: 0.05}
"""
LAG_S = 30.0


def recording():
    """Return 3000 s of a block whose sensor lags; from 1200 to 1800 s, at rest, nothing was recorded."""
    t = np.arange(0.0, 3000.0, 1.0)
    heat = np.where((t > 900) & (t < 1900), 0.0, 20.0 * ((t // 150) % 2))
    one, lagged = np.full(len(t), 22.0), np.full(len(t), 22.0)
    for k in range(len(t) - 1):
        one[k + 1] = one[k] + (heat[k] - 1.0 * (one[k] - 22.0)) / 100.0
        lagged[k + 1] = lagged[k] + (one[k] - lagged[k]) / LAG_S
    read = lagged + 0.05 * np.random.default_rng(1).standard_normal(len(t))
    keep = (t % 10 == 0) & ((t <= 1200) | (t >= 1800))
    return {"t": t[keep], "heat": heat[keep], "air": np.full(keep.sum(), 22.0), "T": read[keep]}


def test_a_state_that_an_effect_adds_is_found_across_a_gap():
    found = tc.diagnose(tc.Plant(loads(PLANT, "plant.yaml")), recording())
    assert [f.effect for f in found.findings] == ["sensor_lag"]
