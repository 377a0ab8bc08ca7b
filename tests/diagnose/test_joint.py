"""An effect whose parameters replace each other: each is uncertain, both together are certain."""

from __future__ import annotations

import numpy as np

from tests.plants import TWO_BLOCKS
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

BLOCKS = TWO_BLOCKS.replace("noise: 0.1", "noise: 0.03")
HIDDEN = (
    BLOCKS.replace("nodes:", "  C_3: {value: 0.4, unit: J/K}\n  G_3: {value: 0.03, unit: W/K}\nnodes:", 1)
    .replace("flows:", "  hidden: {unit: degC, storage: C_3, initial: air}\nflows:", 1)
    .replace(
        "outputs:", "  third: {from: two, into: hidden, rate: G_3 * (two - hidden), unit: W}\noutputs:", 1
    )
)


def test_a_hidden_mass_of_uncertain_conductance_is_a_rival_of_what_imitates_it():
    """Its conductance is not two standard deviations above zero, so it was refused: a heat split had 1.000."""
    t = np.arange(0.0, 1600.0)
    heat = np.array([0.0, 2.5, 0.8, 0.0, 1.6, 3.0, 0.0, 2.0])[(t // 200).astype(int)]
    drive = {"heat": heat, "air_temperature": 21.5 + 0.4 * np.sin(t / 700)}
    model = compile_plant(loads(HIDDEN))
    tables = [model.measure(Table(f"run {k}", f"run_{k}", t, drive), seed=k) for k in (1, 2)]
    found = diagnose(loads(BLOCKS), tables, catalogue((CATALOGUE,)), limits())
    hidden = next(
        w.fitted for w in found.searched.tried if ("hidden_thermal_mass", "two") in w.fitted.hypothesis.keys
    )
    assert min(hidden.plant.parameters[n].value / sd for n, sd in hidden.sd.items()) < 2
    assert found.decision.verdict == "ambiguous"
    assert found.posterior.effects["hidden_thermal_mass", "two"] > 0.4
