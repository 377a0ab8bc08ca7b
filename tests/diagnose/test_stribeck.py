"""Friction that falls with speed, in a plant that has dry friction already."""

import numpy as np
import pytest

from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant.files import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

SLIDER = """
format: thermoctl-plant/1
title: A slider on a rail with dry friction
inputs:
  current: {unit: A}
parameters:
  Kt: {value: 18, unit: N/A}
  m: {value: 2.2, unit: kg, range: [0.8, 8]}
  b: {value: 12, unit: N*s/m, range: [0, 60]}
  Fc: {value: 4.0, unit: N, range: [0, 15]}
nodes:
  speed: {unit: m/s, storage: m, initial: 0}
  place: {unit: m, storage: 1, initial: 0}
flows:
  motor: {into: speed, rate: Kt * current, unit: N}
  viscous: {from: speed, rate: b * speed, unit: N}
  dry: {from: speed, rate: Fc * tanh(speed / 0.001), unit: N}
  travel: {into: place, rate: speed, unit: m/s}
outputs:
  scale: {value: place, unit: m, noise: 3.0e-6}
  tacho: {value: speed, unit: m/s, noise: 0.003}
"""


def test_friction_that_falls_with_speed_beside_dry_friction_of_the_plant():
    """Its constant part is zero there, as the plant has it: the refit was refused, and a false law named."""
    text = SLIDER.replace("value: 12", "value: 9").replace("value: 4.0", "value: 3.1")
    true = loads(
        text.replace("rate: Fc * tanh(", 'rate: "(Fc + 1.9 * exp(-(speed / 0.03)**2)) * tanh(').replace(
            "0.001), unit: N", '0.001)", unit: N'
        )
    )
    t, rng = np.arange(0.0, 7.0, 0.005), np.random.default_rng(7)
    current = np.repeat(rng.uniform(-0.7, 0.7, 28), 50) + 0.05 * np.sin(9 * t)
    table = compile_plant(true).measure(Table("r", "r.csv", t, {"current": current}), 2)
    found = diagnose(loads(SLIDER), [table], catalogue(), limits())
    assert found.decision.named == (("stribeck_friction", "speed"),)
    q = {k: found.final.plant.parameters[f"{k}_stribeck_friction_speed"].value for k in ("FS", "VS")}
    assert q == pytest.approx({"FS": 1.9, "VS": 0.03}, rel=0.03)
