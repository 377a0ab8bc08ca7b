"""Plant files, and one rig with recordings, that several tests use."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thermoctl.plant import load
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

TWO_BLOCKS = """\
format: thermoctl-plant/1
title: Two heated blocks
inputs:
  heat: {unit: W}
  air: {unit: degC, column: air_temperature, between_samples: linear}
parameters:
  C_1: {value: 6, unit: J/K, range: [2, 14]}
  C_2: {value: 6, unit: J/K, range: [2, 14]}
  G_1: {value: 0.05, unit: W/K, range: [0.015, 0.15]}
  G_2: {value: 0.05, unit: W/K, range: [0.015, 0.15]}
  G_12: {value: 0.02, unit: W/K, range: [0.004, 0.08]}
nodes:
  one: {unit: degC, storage: C_1, initial: air, initial_sigma: 0.5}
  two: {unit: degC, storage: C_2, initial: air, initial_sigma: 0.5}
flows:
  power: {into: one, rate: heat, unit: W}
  between: {from: one, into: two, rate: G_12 * (one - two), unit: W}
  loss_1: {from: one, rate: G_1 * (one - air), unit: W}
  loss_2: {from: two, rate: G_2 * (two - air), unit: W}
outputs:
  temperature_1: {value: one, unit: degC, noise: 0.1}
  temperature_2: {value: two, unit: degC, noise: 0.1}
"""

SPRING_STAGE = """\
format: thermoctl-plant/1
title: Spring-guided stage
inputs:
  force: {unit: N}
parameters:
  stiffness: {value: 600, unit: N/m, range: [200, 1500]}
  damping: {value: 30, unit: N*s/m, range: [8, 90]}
nodes:
  velocity: {unit: m/s, storage: 1.3, initial: 0}
  position: {unit: m, storage: 1, initial: 0, initial_sigma: 0.001}
flows:
  drive: {into: velocity, rate: force, unit: N}
  spring: {from: velocity, rate: stiffness * position, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
outputs:
  encoder: {value: position, unit: m, noise: 2e-6}
"""

ONE_BLOCK = """\
format: thermoctl-plant/1
title: A heated block
inputs:
  heat: {unit: W}
  air: {unit: degC, between_samples: linear}
parameters:
  C: {value: 6, unit: J/K, range: [2, 14]}
  G: {value: 0.05, unit: W/K, range: [0.015, 0.15]}
nodes:
  block: {unit: degC, storage: C, initial: air, initial_sigma: 0.5}
flows:
  power: {into: block, rate: heat, unit: W}
  loss: {from: block, rate: G * (block - air), unit: W}
outputs:
  temperature: {value: block, unit: degC, noise: 0.1}
"""

FREE_CARRIAGE = """\
format: thermoctl-plant/1
title: Linear stage with a free carriage
inputs:
  force: {unit: N}
parameters:
  mass: {value: 59, unit: kg, range: [26, 106]}
  damping: {value: 132, unit: N*s/m, range: [13, 528]}
nodes:
  velocity: {unit: m/s, storage: mass, initial: 0}
  position: {unit: m, storage: 1, initial: 0, initial_sigma: 0.001}
flows:
  motor: {into: velocity, rate: force, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
outputs:
  encoder: {value: position, unit: m, noise: 5e-6, resolution: 1e-5}
"""

VOICE_COIL = """\
format: thermoctl-plant/1
title: A voice coil that heats itself
inputs: {current: {unit: A}, current_rate: {unit: A/s}, air: {unit: degC, between_samples: linear}}
parameters:
  gain: {value: 9, unit: N/A}
  mass: {value: 0.6, unit: kg, range: [0.3, 1.2]}
  stiffness: {value: 900, unit: N/m, range: [300, 2500]}
  damping: {value: 7, unit: N*s/m, range: [1.5, 30]}
  R: {value: 4, unit: ohm, range: [2.5, 6.5]}
  L: {value: 0.004, unit: H, range: [0.001, 0.012]}
  K_e: {value: 9, unit: V*s/m, range: [4, 18]}
  C_coil: {value: 9, unit: J/K, range: [4, 20]}
  C_core: {value: 40, unit: J/K, range: [20, 90]}
  G_coil: {value: 0.35, unit: W/K, range: [0.12, 1]}
  G_core: {value: 0.5, unit: W/K, range: [0.12, 2]}
nodes:
  velocity: {unit: m/s, storage: mass, initial: 0}
  position: {unit: m, storage: 1, initial: 0}
  coil: {unit: degC, storage: C_coil, initial: air}
  core: {unit: degC, storage: C_core, initial: air}
flows:
  motor: {into: velocity, rate: gain * current, unit: N}
  spring: {from: velocity, rate: stiffness * position, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
  joule: {into: coil, rate: R * current**2, unit: W}
  coil_to_core: {from: coil, into: core, rate: G_coil * (coil - core), unit: W}
  core_to_air: {from: core, rate: G_core * (core - air), unit: W}
outputs:
  position_read: {value: position, unit: m, noise: 1e-6}
  voltage: {value: R * current + L * current_rate + K_e * velocity, unit: V, noise: 0.01}
  coil_temperature: {value: coil, unit: degC, noise: 0.1}
"""

TANK = """\
format: thermoctl-plant/1
title: A pumped tank
inputs:
  pump: {unit: V}
  level_start: {unit: V}
parameters:
  k_pump: {value: 0.05, unit: 1/s, range: [0.02, 0.12]}
  k_out: {value: 0.06, unit: V**0.5/s, range: [0.02, 0.2]}
nodes:
  tank: {unit: V, storage: 1, initial: level_start, initial_sigma: 0.05}
flows:
  pumped: {into: tank, rate: k_pump * pump, unit: V/s}
  outflow: {from: tank, rate: "k_out * sqrt(max(tank, 0))", unit: V/s}
outputs:
  level: {value: tank, unit: V, noise: 0.02}
"""

HEATER = """
format: thermoctl-plant/1
title: one block
inputs: {heat: {unit: W}, air: {unit: degC}}
parameters:
  C: {value: 40, unit: J/K, range: [20, 80]}
  G: {value: 0.3, unit: W/K, range: [0.1, 1]}
nodes: {block: {unit: degC, storage: C, initial: air, initial_sigma: 0.3}}
flows:
  power: {into: block, rate: heat, unit: W}
  loss: {from: block, rate: G * (block - air), unit: W}
outputs: {reading: {value: block, unit: degC, noise: 0.1}}
"""

WIDE_BLOCK = """\
format: thermoctl-plant/1
inputs:
  heat: {unit: W}
  air: {unit: degC, between_samples: linear}
parameters:
  C: {value: 80, unit: J/K, range: [20, 300]}
  G: {value: 0.3, unit: W/K, range: [0.05, 2]}
nodes:
  one: {unit: degC, storage: C, initial: air, initial_sigma: 0.5}
flows:
  power: {into: one, rate: heat, unit: W}
  loss: {from: one, rate: G * (one - air), unit: W}
outputs:
  T: {value: one, unit: degC, noise: 0.05}
"""

HEATED_BLOCK = """format: thermoctl-plant/1
title: Heated block
inputs: {heat: {unit: W}, air: {unit: degC}}
parameters: {C: {value: 40, unit: J/K, range: [20, 80]}, G: {value: 0.25, unit: W/K, range: [0.05, 1]}}
nodes: {T: {unit: degC, storage: C, initial: air, initial_sigma: 0.05}}
flows: {power: {into: T, rate: heat, unit: W}, loss: {from: T, rate: G * (T - air), unit: W}}
outputs: {T_block: {value: T, unit: degC, noise: 0.05}}
"""
HEATED_RADIATES = HEATED_BLOCK.replace(
    "flows: {", "flows: {missing: {from: T, rate: 2.5e-9 * ((T + 273.15)**4 - (air + 273.15)**4), unit: W}, "
)

RADIATED = "{from: block, rate: 3e-9 * ((block + 273.15)**4 - (air + 273.15)**4), unit: W}"


def radiating(folder: Path, rows: int = 400, recordings: int = 2) -> tuple[Plant, list[Table]]:
    """Return the plant of one block, and recordings of it with radiation."""
    path = folder / "plant.yaml"
    path.write_text(ONE_BLOCK.replace("flows:\n", f"flows:\n  concealed: {RADIATED}\n"))
    model, t, tables = compile_plant(load(path)), np.arange(float(rows)), []
    for k in range(recordings):
        heat = 12.0 * np.random.default_rng(k).integers(0, 2, 8)[(8 * t // rows).astype(int)]
        tables.append(
            model.measure(Table(f"run_{k}", f"run_{k}", t, {"heat": heat, "air": 20 + 0 * t}), seed=k)
        )
    path.write_text(ONE_BLOCK)
    return load(path), tables
