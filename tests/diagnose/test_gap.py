"""A recording with a gap is read in parts; hypotheses with further states start each part from its readings, too."""

import numpy as np

import thermoctl as tc
from tests.plants import WIDE_BLOCK
from thermoctl.plant.files import loads

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
    found = tc.diagnose(tc.Plant(loads(WIDE_BLOCK, "plant.yaml")), recording())
    assert [f.effect for f in found.findings] == ["sensor_lag"]
