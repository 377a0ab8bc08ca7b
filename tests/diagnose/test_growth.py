"""Physics of a kind that the plant file has none of: growth of a position, a body where no ambient is."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermoctl.diagnosis.run import diagnose
from thermoctl.plant import load, loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

ACTUATOR = """\
format: thermoctl-plant/1
title: An actuator whose reference reads the command; that its shaft grows is not in the model
inputs:
  i: {unit: A}
  cmd: {unit: um, between_samples: linear}
  air: {unit: degC, between_samples: linear, role: ambient}
parameters:
  C: {value: 120, unit: J/K, range: [40, 400]}
  G: {value: 0.08, unit: W/K, range: [0.02, 0.4]}
nodes:
  shaft: {unit: degC, storage: C, initial: air, initial_sigma: 0.2}
flows:
  joule: {into: shaft, rate: 4 * i**2, unit: W}
  loss: {from: shaft, rate: G * (shaft - air), unit: W}
outputs:
  T: {value: shaft, unit: degC, noise: 0.15}
  reference: {value: cmd, unit: um, noise: 0.2}
"""


def test_growth_is_found_where_the_position_depends_on_no_temperature(tmp_path):
    """It had no place then, and a cyclic error of the encoder was named for it, above 0.99."""
    plant, t = loads(ACTUATOR), np.arange(0.0, 5400.0, 9.0)
    drives = {"i": 0.9 * (t % 2700 < 1500), "cmd": 50 * np.sin(t / 75), "air": 22 + t / 1e4}
    table = compile_plant(plant).measure(Table("run", "run", t, drives), 1)
    warm = compile_plant(plant).simulate(table).x[:, 0]
    table.columns["reference"] += 0.55 * (warm - warm[0])
    result = diagnose(plant, [table], tmp_path / "out")
    (found,) = result["findings"]
    assert (found["effect"], found["where"], result["verdict"]) == ("missing_member", "shaft", "explained")
    assert found["parameters"]["A_missing_member_shaft"]["value"] == pytest.approx(0.55, rel=0.02)


CLIMATE = """\
format: thermoctl-plant/1
title: Land and the upper ocean, as distances to their means, a square metre of each
inputs: {forcing: {unit: FLOW, between_samples: linear}}
parameters:
  C_sea: {value: 3e8, unit: FLOW*s/K, range: [1e8, 1.5e9]}
  C_land: {value: 4e7, unit: FLOW*s/K, range: [1e7, 2e8]}
  L: {value: 1.2, unit: FLOW/K, range: [0.4, 3]}
  k: {value: 1.0, unit: FLOW/K, range: [0.1, 4]}
nodes:
  sea: {unit: degC, storage: C_sea, initial: "0", initial_sigma: 0.05}
  land: {unit: degC, storage: C_land, initial: "0", initial_sigma: 0.05}
flows:
  to_sea: {into: sea, rate: forcingSTATED}
  to_land: {into: land, rate: forcingSTATED}
  from_sea: {from: sea, rate: L * (sea - 0)STATED}
  from_land: {from: land, rate: L * (land - 0)STATED}
  wind: {from: land, into: sea, rate: k * (land - sea)STATED}
outputs:
  T_sea: {value: sea, unit: degC, noise: 0.05}
  T_land: {value: land, unit: degC, noise: 0.05}
"""


@pytest.mark.parametrize("stated", [", unit: W/m**2", ""])
def test_a_body_is_found_where_no_ambient_is_and_heat_is_that_of_a_square_metre(stated, tmp_path):
    """No effect of a body was tried without an ambient; with one, its W/K refused the extended plant."""
    t, year = np.arange(150.0), 3.156e7
    forcing = 7.4 + 2 * np.sin(t / 9)

    def rates(at, y):
        f, (sea, land, deep) = np.interp(at, t, forcing), y
        wind, down = 1.3 * (land - sea), 0.75 * (sea - deep)
        into = f - 1.2 * sea + wind - down, f - 1.2 * land - wind, down
        return [year * x / c for x, c in zip(into, (2.5e8, 5e7, 3.2e9), strict=True)]

    x = solve_ivp(rates, (0, 149), (0.0, 0.0, 0.0), t_eval=t, rtol=1e-8, atol=1e-8, max_step=0.5).y
    noise = np.random.default_rng(816).normal(0, 0.05, (2, 150))
    columns = {"forcing": forcing, "T_sea": x[0] + noise[0], "T_land": x[1] + noise[1]}
    plant = loads(CLIMATE.replace("STATED", stated).replace("FLOW", "W/m**2"))
    result = diagnose(plant, [Table("run", "run", t * year, columns)], tmp_path / "out")
    (found,) = result["findings"]
    assert (found["effect"], found["where"]) == ("hidden_thermal_mass", "sea")
    assert found["parameters"]["G_hidden_thermal_mass_sea"]["value"] == pytest.approx(0.75, rel=0.2)
    assert any("units of what was added to the plant do not fit" in note for note in result["notes"]) == (
        not stated
    )
    assert load(tmp_path / "out" / "plant.yaml").nodes.keys() > plant.nodes.keys()
