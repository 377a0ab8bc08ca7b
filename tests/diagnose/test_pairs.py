"""Two effects of which neither leads alone: they cancel nearly, or one wrong effect imitates both."""

from __future__ import annotations

import numpy as np

from tests.plants import TWO_BLOCKS
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
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
    alone = [v for keys, v in score.items() if len(keys) == 1]
    assert max(alone) < score[frozenset()] + 2
    assert found.searched.tried[0].fitted.hypothesis.keys == {SPLIT, GAIN}
    assert found.decision.verdict == "explained" and SPLIT in found.decision.named


SWING = """
format: thermoctl-plant/1
title: a weight on a spring, let go
parameters:
  mass: {value: 1.0, unit: kg}
  stiffness: {value: 80, unit: N/m, range: [40, 160]}
  damping: {value: 0.1, unit: N*s/m, range: [1.0e-4, 5]}
nodes:
  velocity: {unit: m/s, storage: mass, initial: 0, initial_sigma: 0.3}
  position: {unit: m, storage: 1, initial: first(reading), initial_sigma: 0.02}
flows:
  spring: {from: velocity, rate: stiffness * position, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
outputs:
  reading: {value: position, unit: m, noise: 0.003}
"""


def test_a_softening_spring_with_drag_is_refitted_though_a_hysteresis_leads():
    """The hysteresis alone was 43 nats ahead of the spring alone, so that drag was never tried beside it."""
    truth = (
        SWING.replace("initial: first(reading)", "initial: 0.3")
        .replace("stiffness * position", "stiffness * position - 31 * position**3")
        .replace("damping * velocity", "damping * velocity + 0.09 * velocity * abs(velocity)")
    )
    t = np.arange(1800) * 0.02
    table = compile_plant(loads(truth)).measure(Table("run", "run.csv", t, {}), seed=3)
    found = diagnose(loads(SWING), [table], catalogue(), limits())
    score = {w.fitted.hypothesis.keys: w.score for w in found.searched.tried}
    pair = frozenset({("cubic_stiffness", "velocity"), ("quadratic_drag", "velocity")})
    assert score[pair] == max(score.values())
