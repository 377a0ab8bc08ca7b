"""Effects of a speed fit whatever unit the speed has: the extended plant passes the unit check when it is read again."""

import numpy as np
import pytest

from tests.plants import TANK, VOICE_COIL
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.plant import load, save
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table
from thermoctl.units import conversion

PLANT = """format: thermoctl-plant/1
title: A motor's housing
inputs: {{heat: {{unit: W}}, speed: {{unit: {unit}}}, air: {{unit: degC, between_samples: linear}}}}
parameters: {{K_e: {{value: 0.1, unit: V/({unit})}}, C: {{value: 300, unit: J/K, range: [100, 900]}}, H: {{value: 1, unit: W/K, range: [0.2, 4]}}}}
nodes: {{housing: {{unit: degC, storage: C, initial: air}}}}
flows: {{joule: {{into: housing, rate: heat, unit: W}}, loss: {{from: housing, rate: H * (housing - air), unit: W}}}}
outputs: {{housing_c: {{value: housing, unit: degC, noise: 0.1}}, tacho: {{value: K_e * speed, unit: V, noise: 0.1}}}}
"""


STIRRED = {"forced_convection"}
MOVED = {"eddy_heating", "hysteresis_heating", *STIRRED}


@pytest.mark.parametrize(
    ("unit", "names"),
    [("rad/s", MOVED), ("m/s", MOVED), ("rpm", MOVED), ("kg/s", STIRRED), ("l/min", STIRRED)],
)
def test_what_a_speed_or_a_flow_does_is_offered_and_keeps_its_units(unit, names, tmp_path):
    (tmp_path / "plant.yaml").write_text(PLANT.format(unit=unit))
    plant = load(tmp_path / "plant.yaml")
    t = np.arange(100.0)
    table = Table(
        "run",
        "run",
        t,
        {"heat": 1 + np.sin(t), "speed": np.cos(t), "air": np.full(100, 20.0), "housing_c": 20 + 0 * t},
    )
    rig = Rig(plant, [compile_plant(plant).excitation(table)], [table.columns])
    found = [c for c in candidates(rig, catalogue()) if c.effect.name in MOVED]
    assert {c.effect.name for c in found} == names
    for c in found:
        save(c.extend({p.name: 0.1 for p in c.effect.parameters}), tmp_path / "extended.yaml")
        assert c.own(c.effect.parameters[0].name) in load(tmp_path / "extended.yaml").parameters


VESSEL = TANK.replace("storage: 1,", "storage: A,").replace(
    "parameters:", 'parameters:\n  A: {value: 1, unit: "1"}'
)
MOTOR = """format: thermoctl-plant/1
title: A motor on a voltage, whose back electromotive force is left out
inputs: {voltage: {unit: V}}
parameters:
  R: {value: 1.6, unit: ohm, range: [0.3, 6]}
  L: {value: 0.005, unit: H, range: [0.0005, 0.05]}
  J: {value: 7.0e-4, unit: kg*m^2, range: [1.0e-4, 1.0e-2]}
  B: {value: 1.0e-4, unit: N*m*s/rad, range: [5.0e-6, 5.0e-3]}
  K_t: {value: 0.082, unit: N*m/A}
nodes: {i: {unit: A, storage: L, initial: 0, initial_sigma: 0.05}, w: {unit: rad/s, storage: J, initial: 0, initial_sigma: 0.5}}
flows:
  source: {into: i, rate: voltage, unit: V}
  copper: {from: i, rate: R * i, unit: V}
  torque: {into: w, rate: K_t * i, unit: N*m}
  bearing: {from: w, rate: B * w, unit: N*m}
outputs: {current: {value: i, unit: A, noise: 0.05}, speed: {value: w, unit: rad/s, noise: 0.5}}
"""
SPINDLE = MOTOR.replace("nodes: {", "nodes: {x: {unit: rad, storage: 1, initial: 0}, ").replace(
    "flows:", "flows:\n  turns: {into: x, rate: w}"
)
RIGS = [
    (SPINDLE, {"back_emf", "cogging", "position_dependent_force_constant"}),
    (VOICE_COIL, {"position_dependent_conductance", "cogging", "cubic_stiffness", "back_emf", "inductance"}),
    (VESSEL, {"overflow", "orifice_exponent"}),
]


@pytest.mark.parametrize(
    "sample", [0.002, 1.0, 2.0]
)  # a factor of one vanishes from a product, with its unit
@pytest.mark.parametrize(("text", "names"), RIGS, ids=["turns", "moves and heats", "flows"])
def test_every_entry_changes_a_rig_and_keeps_its_units_at_any_sampling(text, names, sample, tmp_path):
    (tmp_path / "plant.yaml").write_text(text)
    plant = load(tmp_path / "plant.yaml")
    t = sample * np.arange(1000.0)
    moving = {"current_rate": np.cos(t), "air": 20 + np.sin(t), "pump": 1 + np.sin(t)}
    still = {
        "position_read": 0 * t,
        "voltage": 0 * t,
        "coil_temperature": 20 + 0 * t,
        "level_start": 1 + 0 * t,
        "speed": 0 * t,
    }
    moving["voltage" if text is SPINDLE else "current"] = np.sin(t)
    table = Table("run", "run", t, still | {"current": 0 * t, "level": 1 + 0 * t} | moving)
    rig = Rig(plant, [compile_plant(plant).excitation(table)], [table.columns])
    found = candidates(rig, catalogue())
    assert names < {c.effect.name for c in found}
    for c in found:
        extended = c.extend({p.name: p.null if p.typical is None else p.typical for p in c.effect.parameters})
        assert extended.parameters.keys() > plant.parameters.keys(), (
            c.key
        )  # those that no equation reads are left out
        save(extended, tmp_path / "extended.yaml")
        load(tmp_path / "extended.yaml")


SCALE = """format: thermoctl-plant/1
title: A slide whose linear scale grows; position in mm, its error in um
inputs: {heat: {unit: W}, x: {unit: mm, role: position}, air: {unit: degC, between_samples: linear}}
parameters: {C: {value: 300, unit: J/K}, H: {value: 1, unit: W/K}, A: {value: 2, unit: um/K, range: [0, 9]}}
nodes: {rail: {unit: degC, storage: C, initial: air}}
flows: {joule: {into: rail, rate: heat, unit: W}, loss: {from: rail, rate: H * (rail - air), unit: W}}
outputs: {error: {value: A * (rail - 20), unit: um, noise: 0.1}}
"""


def test_an_expansion_of_the_scale_has_the_units_of_reading_and_position(tmp_path):
    (tmp_path / "plant.yaml").write_text(SCALE)
    plant, t = load(tmp_path / "plant.yaml"), np.arange(100.0)
    table = Table("run", "run", t, {"heat": np.sin(t), "x": np.cos(t), "air": 20 + 0 * t, "error": 0 * t})
    rig = Rig(plant, [compile_plant(plant).excitation(table)], [table.columns])
    (found,) = (c for c in candidates(rig, catalogue()) if c.key == ("scale_expansion", "error"))
    unit = found.extend({"A": 1e-5}).parameters[found.own("A")].unit
    assert conversion(unit, "um/(mm*K)") == (1.0, 0.0)
