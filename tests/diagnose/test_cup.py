"""Hot water in a cup that cools in a room: one reading, and nobody recorded the room."""

from __future__ import annotations

import numpy as np
import pytest

from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search.beam import search
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

LOSS = "G * (water - room)"
CUP = """
format: thermoctl-plant/1
title: Hot water in a cup
parameters:
  C: {value: 335, unit: J/K}
  G: {value: 0.35, unit: W/K, range: [0.05, 3]}
  room: {value: 28, unit: degC, range: [22, 36]}
nodes:
  water: {unit: degC, storage: C, initial: 82, initial_sigma: 1}
flows:
  loss: {from: water, rate: G * (water - room), unit: W}
outputs:
  reading: {value: water, unit: degC, noise: SIGMA}
"""


def cooled(loss: str, noise: float, samples: int) -> tuple:
    """Return the plant and 100 minutes of a cup with another loss."""
    plant = CUP.replace("SIGMA", str(noise))
    truth = loads(plant.replace(LOSS, loss).replace("initial_sigma: 1", "initial_sigma: 0"))
    t = np.linspace(0.0, 6000.0, samples, endpoint=False)
    return loads(plant), compile_plant(truth).measure(Table("run", "run", t, {}), seed=3)


def test_an_effect_that_a_parameter_of_the_plant_may_replace_is_kept():
    """Its size is 1.9 standard errors from none, because G replaces it; it is 10 nats more probable than none."""
    plant, table = cooled("G * 0.17 * (1 + 0.09 * (water - 20)) * (water - room)", 2.0, 300)
    names = ("temperature_dependent_conductance", "variable_heat_capacity", "hidden_thermal_mass")
    entries = {n: e for n, e in catalogue().items() if n in names}
    found = search(case(plant, [table], entries, Budget(80)))
    assert found.best.fitted.hypothesis.keys == {("temperature_dependent_conductance", "loss")}


def test_one_law_competes_with_two_effects_that_imitate_it():
    """A hidden mass and a second ambient leave only noise, but have three parameters more than the law."""
    plant, table = cooled("G * 1.14 * (water - room) * ((water - room) / 50) ** 2", 0.12, 1200)
    found = diagnose(plant, [table], catalogue(), limits())
    assert found.decision.named == (("law", "water"),)
    assert found.final.plant.parameters["n1_law_water"].value == pytest.approx(3, abs=0.5)
