"""Ten plants for the export: shipped, extended by an effect, delayed, with tables, jumps and events."""

import numpy as np

from tests.plants import SPRING_STAGE, TWO_BLOCKS
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.files.shipped import shipped
from thermoctl.plant import Plant, load, loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

TABLED = """\
format: thermoctl-plant/1
title: A block with a table, a jump of time and a comparison of an input
inputs:
  heat: {unit: W}
  air: {unit: degC, between_samples: linear}
parameters:
  C: {value: 6, unit: J/K, range: [2, 14]}
  G: {value: 0.05, unit: W/K, range: [0.015, 0.15]}
  T0: {value: 133, unit: s}
nodes:
  block: {unit: degC, storage: "C * table(block, [20, 40, 60], [1, 1.3, 1.2])", initial: air}
flows:
  power: {into: block, rate: heat * (1 + 0.2 * (heat > 1)), unit: W}
  loss: {from: block, rate: "G * (1 + 0.5 * step(t - T0)) * max(block - air, 0)**1.25", unit: W}
outputs:
  temperature: {value: "min(block, 95)", unit: degC}
"""
DELAYED = """\
format: thermoctl-plant/1
title: Delays of a held input, of a linear input and of a reading
inputs:
  heat: {unit: W}
  air: {unit: degC, between_samples: linear}
parameters:
  C: {value: 6, unit: J/K}
  G: {value: 0.05, unit: W/K}
  late: {value: 2.7, unit: s}
  transport: {value: 7.3, unit: s}
  slow: {value: 0.4, unit: s}
nodes:
  block: {unit: degC, storage: C, initial: air}
flows:
  power: {into: block, rate: "delay(heat, transport)", unit: W}
  loss: {from: block, rate: "G * (block - delay(air, slow))", unit: W}
outputs:
  temperature: {value: "delay(block, late)", unit: degC}
  quick: {value: block, unit: degC}
"""
FRICTION = """\
format: thermoctl-plant/1
title: A carriage with dry friction
inputs:
  force: {unit: N}
parameters:
  mass: {value: 2, unit: kg}
  dry: {value: 1.5, unit: N}
  lambda: {value: 10, unit: N*s/m}
nodes:
  velocity: {unit: m/s, storage: mass, initial: 0}
  carriage: {unit: m, storage: 1, initial: first(position), initial_sigma: 1e-4}
flows:
  drive: {into: velocity, rate: force, unit: N}
  friction: {from: velocity, rate: lambda * velocity + dry * sign(velocity), unit: N}
  travel: {into: carriage, rate: velocity, unit: m/s}
outputs:
  position: {value: carriage, unit: m}
"""
STATIC = """\
format: thermoctl-plant/1
title: A static plant
inputs:
  air: {unit: degC, between_samples: linear}
  x: {unit: m}
parameters:
  a: {value: 1.5e-6, unit: m/K}
outputs:
  y: {value: "x + a * (air - 20) + 1e-6 * sin(2 * pi * x * 1e3) * exp(-t / 100) * tanh(x * 1e3)", unit: m}
"""


def recording(plant: Plant, seed: int = 0, n: int = 400, dt: float = 1.0) -> Table:
    """Return inputs that hold in steps or go in random walks, and readings at the first sample where asked for."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(n) + 0.1 * dt * rng.random(n)
    columns = {}
    for i in plant.inputs.values():
        size = {"degC": 2.0, "W": 3.0, "A": 2.0, "N": 10.0, "%": 60.0, "m^3/s": 1e-4, "m": 1e-3}[i.unit]
        steps = size * np.repeat(rng.random(n // 20 + 1), 20)[:n]
        if i.linear:
            columns[i.column] = 21 + size * np.cumsum(rng.normal(size=n)) / 30
        else:
            columns[i.column] = steps - 0.5 * size if i.unit == "N" else steps
    for o in plant.outputs.values():
        start = {"degC": 21.3, "m": 0.1}.get(o.unit, 0.0)
        columns[o.column] = np.full(n, start)
    return Table("made", "made.csv", t, columns)


def extended() -> Plant:
    """Return two blocks with radiation and a slow sensor, as a diagnosis extends them."""
    plant = loads(TWO_BLOCKS)
    table = recording(plant)
    for effect, where, values in (
        ("radiation", "one", {"E": 2e-10}),
        ("sensor_lag", "temperature_2", {"TAU": 8.0}),
    ):
        model = compile_plant(plant)
        rig = Rig(plant, [model.excitation(table)], [table.columns])
        found = next(c for c in candidates(rig, catalogue()) if c.key == (effect, where))
        plant = found.extend(values)
    return plant


def plants() -> dict[str, tuple[Plant, float]]:
    """Return ten plants and the sampling interval of each one's recording, s."""
    templates = shipped("config/plants/templates")
    return {
        "hot-end": (load(templates / "hot-end.yaml"), 1.0),
        "actuator": (load(templates / "actuator.yaml"), 1.0),
        "room": (load(templates / "room.yaml"), 60.0),
        "tank": (load(templates / "tank.yaml"), 1.0),
        "spring_stage": (loads(SPRING_STAGE), 0.002),
        "extended": (extended(), 1.0),
        "tabled": (loads(TABLED), 0.5),
        "delayed": (loads(DELAYED), 0.5),
        "friction": (loads(FRICTION), 0.01),
        "static": (loads(STATIC), 1.0),
    }
