"""An input is what a sensor read at each row: late after its sensor's lag, and between rows on its way."""

import numpy as np
import pytest

from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

SHED = """\
format: thermoctl-plant/1
title: Shed with a heater
inputs:
  heater: {unit: W}
  outside: {unit: degC, role: ambient, between_samples: linear}
parameters:
  C: {value: 90000, unit: J/K, range: [30000, 300000]}
  G: {value: 40, unit: W/K, range: [12, 120]}
nodes:
  room: {unit: degC, storage: C, initial: first(inside), initial_sigma: 0.1}
flows:
  heat: {into: room, rate: heater, unit: W}
  loss: {from: room, rate: G * (room - outside), unit: W}
outputs:
  inside: {value: room, unit: degC, noise: 0.1}
"""
SUNNY = SHED.replace("inputs:", "inputs:\n  sun: {unit: W/m^2, between_samples: linear}").replace(
    "outputs:", "  window: {into: room, rate: 1.5 * sun}\noutputs:"
)


def driven(plant: str, seed: int, hours: float, row: float) -> Table:
    """A recording of the shed: half-hour steps of the heater, an outside that walks, a day's sun."""
    rng, t = np.random.default_rng(seed), np.arange(0, hours * 3600, row)
    fine = np.arange(0, hours * 3600, 60.0)
    walk = np.cumsum(rng.normal(0, 0.15, len(fine)))
    columns = {
        "heater": np.repeat(rng.choice([0.0, 500, 1000, 1500], len(t)), max(int(1800 / row), 1))[: len(t)],
        "outside": 8 + np.interp(t, fine, walk) + 3 * np.sin(t / 5000),
        "sun": 600 * np.maximum(np.sin(2 * np.pi * t / 86400), 0),
        "inside": np.full(len(t), 18.0),
    }
    y = compile_plant(loads(plant)).simulate(Table("run", "run", t, columns), {"C": 110000.0, "G": 33.0}).y
    columns["inside"] = y[:, 0] + rng.normal(0, loads(plant).outputs["inside"].noise_sd, len(t))
    return Table(f"run_{seed}", "run", t, columns)


@pytest.mark.parametrize("tau", [600.0, 1500.0])
def test_a_slow_thermometer_at_an_input_is_named_with_its_time_constant(tau):
    """Reading again late what is late already fits nothing: a gain, a step and laws had 0.99 and more."""
    table = driven(SHED, 3, 20, 60)
    slow = [table.columns["outside"][0]]
    for true in table.columns["outside"][1:]:
        slow.append(slow[-1] + (true - slow[-1]) * (1 - np.exp(-60 / tau)))
    table.columns["outside"] = np.array(slow) + np.random.default_rng(1).normal(0, 0.02, len(slow))
    del table.columns["sun"]
    result = contract(diagnose(loads(SHED), [table], catalogue(), limits()))
    (found,) = result["findings"]
    assert (found["effect"], found["where"]) == ("sensor_lag", "outside")
    (lag,) = found["parameters"].values()
    assert lag["value"] == pytest.approx(tau, rel=0.1)


def test_an_unread_column_that_moves_smoothly_is_not_half_a_row_late():
    """Held between rows, the sun was right in a law and half an hour late above 0.99."""
    table = driven(SUNNY, 4, 96, 1800)
    late = {n: catalogue()[n] for n in ("sensor_delay", "sensor_lag")}
    result = contract(diagnose(loads(SHED), [table], late, limits()))
    law = result["remainder"]["law"]
    assert (law["where"], law["of"]) == ("room", ["sun"])
    assert result["findings"] == []


def test_noise_of_an_ambients_reading_is_no_shift():
    """A lag and an advance of 210 s, which together smooth a reading, had above 0.99 each."""
    plant = SHED.replace("noise: 0.1", "noise: 0.02")
    table = driven(plant, 3, 20, 60)
    del table.columns["sun"]
    table.columns["outside"] += np.random.default_rng(1).normal(0, 0.6, len(table.t))
    result = contract(diagnose(loads(plant), [table], catalogue(), limits()))
    assert result["findings"] == []
    assert any("noise of outside (0.63), smoothed" in note for note in result["notes"])
