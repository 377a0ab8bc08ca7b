"""Small rigs with known truth for the checks: a plant, and recordings that a rig slightly unlike it made."""

from __future__ import annotations

import dataclasses

import numpy as np

from tests.plants import FREE_CARRIAGE, ONE_BLOCK, SPRING_STAGE, TWO_BLOCKS
from thermoctl.plant import Plant, loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

PENDULUM = """\
format: thermoctl-plant/1
title: Driven pendulum
inputs: {torque: {unit: N*m}}
parameters:
  inertia: {value: 0.02, unit: kg*m^2, range: [0.01, 0.04]}
  weight: {value: 0.6, unit: N*m, range: [0.3, 1.2]}
  damping: {value: 0.01, unit: N*m*s, range: [0.003, 0.03]}
nodes:
  speed: {unit: 1/s, storage: inertia, initial: 0}
  angle: {unit: rad, storage: 1, initial: 0}
flows:
  drive: {into: speed, rate: torque, unit: N*m}
  gravity: {from: speed, rate: weight * sin(angle), unit: N*m}
  friction: {from: speed, rate: damping * speed, unit: N*m}
  turning: {into: angle, rate: speed, unit: 1/s}
outputs:
  encoder: {value: angle, unit: rad, noise: 0.002}
"""
TANK = """\
format: thermoctl-plant/1
title: Tank with an orifice
inputs: {pump: {unit: m^3/s}}
parameters:
  area: {value: 0.02, unit: m^2, range: [0.01, 0.04]}
  orifice: {value: 2e-4, unit: m^2.5/s, range: [1e-4, 4e-4]}
nodes:
  level: {unit: m, storage: area, initial: 0.1, initial_sigma: 0.01}
flows:
  inflow: {into: level, rate: pump, unit: m^3/s}
  outflow: {from: level, rate: "orifice * sqrt(max(level, 0))", unit: m^3/s}
outputs:
  gauge: {value: level, unit: m, noise: 0.001}
"""
PLANTS = {
    "two blocks": TWO_BLOCKS,
    "one block": ONE_BLOCK,
    "stage": SPRING_STAGE,
    "carriage": FREE_CARRIAGE,
    "pendulum": PENDULUM,
    "tank": TANK,
}


def levels(t: np.ndarray, hold: float, values: tuple[float, ...]) -> np.ndarray:
    """Steps through `values`, each held for `hold` seconds."""
    return np.asarray(values)[(t // hold).astype(int) % len(values)]


def inputs(name: str) -> Table:
    """A recording's time and inputs, before any reading."""
    if "block" in name:
        t = np.arange(0.0, 1600.0, 2.0)
        columns = {"heat": levels(t, 200.0, (0.0, 3.0, 1.0, 2.0)), "air": 22 + 0.4 * np.sin(t / 400)}
        if name == "two blocks":
            columns["air_temperature"] = columns.pop("air")
    elif name == "stage":
        t = np.arange(0.0, 8.0, 0.01)
        columns = {"force": levels(t, 0.7, (0.0, 10.0, -6.0, 3.0))}
    elif name == "carriage":
        t = np.arange(0.0, 10.0, 0.01)
        columns = {"force": levels(t, 0.8, (40.0, -40.0, 20.0, 0.0, -30.0, 10.0))}
    elif name == "pendulum":
        t = np.arange(0.0, 12.0, 0.01)
        columns = {"torque": levels(t, 1.3, (0.0, 0.2, -0.1, 0.1))}
    else:
        t = np.arange(0.0, 1200.0, 2.0)
        columns = {"pump": levels(t, 150.0, (1e-4, 5e-5, 8e-5, 2e-5))}
    return Table("run_1", "run_1.csv", t, columns)


def truth(plant: Plant, seed: int) -> Plant:
    """The rig itself: parameters elsewhere in their ranges, by up to 40 %."""
    rng = np.random.default_rng(seed)
    moved = {
        n: dataclasses.replace(p, value=float(np.clip(p.value * np.exp(rng.uniform(-0.35, 0.35)), *p.range)))
        if p.range
        else p
        for n, p in plant.parameters.items()
    }
    return dataclasses.replace(plant, parameters=moved)


def rig(name: str, seed: int = 1, text: str | None = None) -> tuple[Plant, Table]:
    """A plant file's plant and a recording of the rig that it describes; `text`: the rig's own plant instead."""
    plant = loads(PLANTS[name], f"{name}.yaml")
    real = loads(text, "real.yaml") if text else plant
    table = compile_plant(truth(real, seed)).measure(inputs(name), seed)
    return plant, dataclasses.replace(table, columns={n: np.round(v, 9) for n, v in table.columns.items()})
