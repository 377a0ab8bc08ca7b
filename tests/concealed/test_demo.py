"""The demonstration's own arithmetic: a plant that knows everything compensates; a step that has happened counts."""

from __future__ import annotations

import numpy as np
import pytest

from tests.concealed import demo, generate, sensors
from tests.concealed.thermal import Variant
from thermoctl.plant import load


def test_a_plant_with_the_true_values_compensates_the_true_growth(tmp_path):
    """Finite volumes of the judge, lumped bodies of the plant, nothing concealed: the compensator takes off all but a few percent."""
    for attempt in range(50):
        rng = np.random.default_rng(attempt)
        scene = generate.FAMILIES["actuator"].scene(rng, "designed", True)
        if len(scene.outputs) == 13:
            break
    true = scene.outputs_of(1, [Variant()])[0]
    run = scene.runs[1]
    plant, columns = demo.in_signals(
        scene.plant,
        [
            ("t", run["t"]),
            *((c, run[k]) for c, k in scene.columns.items()),
            *(
                (c, sensors.record(true[:, j], sensors.Noise(scene.sd[j]), scene.sd[j], 0.0, {}, rng))
                for j, c in enumerate(scene.outputs)
            ),
        ],
    )
    for name, value in scene.theta.items():
        plant["parameters"][name]["value"] = value
    generate.write_case(tmp_path, plant, [columns])
    left = demo.compensated(tmp_path / "plant.yaml", tmp_path / "run_1.csv", true[:, -1], 0.0)
    free = true[:, -1] - true[:30, -1].mean()
    assert np.std(left) < 0.1 * np.std(free)


def test_at_time_takes_a_step_that_has_happened(tmp_path):
    plant = tmp_path / "plant.yaml"
    plant.write_text(
        """format: thermoctl-plant/1
title: A body whose joint loosened
inputs: {air: {unit: degC}}
parameters: {C: {value: 5, unit: J/K}, G: {value: 2, unit: W/K}, T0: {value: 100, unit: s}}
nodes: {body: {unit: degC, storage: C, initial: air}}
flows: {loss: {from: body, rate: "G * (1 - 0.75 * step(t - T0)) * (body - air)", unit: W}}
outputs: {y: {value: body, unit: degC}}
"""
    )
    from thermoctl.plant import expression as ex

    late = demo.at_time(load(plant), demo.LATE).flows["loss"].rate
    assert float(ex.evaluate(late, {"G": 2.0, "T0": 100.0, "body": 30.0, "air": 20.0})) == pytest.approx(5.0)


def test_every_story_has_a_place_in_its_family():
    held = generate.holders()
    assert len({s.effect for s in demo.STORIES}) >= 6
    for story in demo.STORIES:
        assert story.family in held[story.effect]
