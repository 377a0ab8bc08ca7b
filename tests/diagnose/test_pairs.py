"""Two effects that cancel each other nearly: neither promises anything alone, both together do."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plants import TWO_BLOCKS
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.law.forms import LAW
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

SPLIT, GAIN = ("heat_split", "one-two"), ("sensor_gain", "temperature_1")
HEATED = (
    TWO_BLOCKS.replace("noise: 0.1", "noise: 0.2")
    .replace("  heat: {unit: W}\n", "  heat: {unit: W}\n  heat_2: {unit: W}\n")
    .replace("loss_1:", "power_2: {into: two, rate: heat_2, unit: W}\n  loss_1:")
)
TRUTH = (
    HEATED.replace("rate: heat,", "rate: 0.98 * heat,")
    .replace("loss_1:", "split: {into: two, rate: 0.02 * heat, unit: W}\n  loss_1:")
    .replace("value: one,", "value: air + 1.065 * (one - air),")
)


@pytest.mark.slow
def test_a_split_of_heat_that_a_gain_cancels_is_found_with_it():
    """Alone neither pays for its odds, and no pair of such effects was tried: the verdict was `consistent`."""
    t = np.arange(1500) * 4.0
    drive = {
        "heat": np.array([0.0, 2.5, 0.8, 0.0, 1.6, 3.0, 0.0, 2.0])[(t // 750).astype(int)],
        "heat_2": np.array([0.0, 1.0, 2.8, 0.0, 2.6, 0.0, 1.0, 2.0, 0.0, 1.5])[(t // 600).astype(int)],
        "air_temperature": 21.5 + 0.4 * np.sin(t / 700),
    }
    model = compile_plant(loads(TRUTH))
    tables = [model.measure(Table(f"run {k}", f"run_{k}", t, drive), seed=k) for k in (1, 2)]
    found = diagnose(loads(HEATED), tables, catalogue(), limits())
    score = {w.fitted.hypothesis.keys: w.score for w in found.searched.tried}
    alone = [v for keys, v in score.items() if len(keys) == 1 and LAW not in dict(keys)]
    assert max(alone) < score[frozenset()] + 2
    assert found.searched.tried[0].fitted.hypothesis.keys == {SPLIT, GAIN}
    assert found.decision.verdict == "explained" and SPLIT in found.decision.named
