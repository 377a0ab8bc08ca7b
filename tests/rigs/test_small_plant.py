"""The believed plant of the small rig follows rows of a ramp as they are recorded, from a start that is not quite at rest."""

from pathlib import Path

import numpy as np

from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

PLANT = Path(__file__).resolve().parents[2] / "config/examples/small.thermal.yaml"
ROW_S, FINE_S = 0.134, 0.002  # the rows of a test at the wire, on a loaded machine


def test_rows_of_a_ramp_leave_no_residual():
    t = np.arange(0.0, 60.0, FINE_S)
    current = np.interp(t, [2, 4.4, 32, 34.4], [0, 0.8, 0.8, 0])  # 240 um at 100 um/s
    plant = load(PLANT)
    model = compile_plant(plant, ())
    truth = model.simulate(Table("fine", "fine.csv", t, {"power_w": 5 * current**2, "air_c": 22 + 0 * t})).y
    rows = np.round(np.arange(0.0, 60.0, ROW_S) / FINE_S).astype(int)
    kept = Table("rows", "rows.csv", t[rows], {"power_w": 5 * current[rows] ** 2, "air_c": 22 + 0 * rows})
    assert np.max(np.abs(model.simulate(kept).y - truth[rows])[:, 0]) < 0.01  # K; held rows: 0.05
    assert (plant.nodes["coil"].initial_sigma or 0) >= 0.5
