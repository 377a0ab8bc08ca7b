"""A fast axis whose recorded times are off: its reading errs, and nothing is missing from its plant."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.plants import SPRING_STAGE
from thermoctl.diagnosis.run import diagnose
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

RATE, SHARE = 200.0, 0.03  # samples a second; error of a time in sampling intervals


@pytest.mark.parametrize("share", [0.0, pytest.param(SHARE, marks=pytest.mark.slow)])
def test_uncertain_times_are_said_and_named_as_no_physics(tmp_path, share):
    path = tmp_path / "plant.yaml"
    path.write_text(SPRING_STAGE)
    plant, rng = load(path), np.random.default_rng(2)
    t = np.arange(3000) / RATE
    (drive,) = plant.inputs.values()
    push = np.round(np.interp(t, t[::100], rng.uniform(-20, 20, 30)), 3)
    run = compile_plant(plant).measure(Table("run", "run", t, {drive.column: push}), seed=3)
    late = dataclasses.replace(run, t=t + share / RATE * rng.standard_normal(len(t)))
    found = diagnose(plant, [late], tmp_path / "out")
    assert not found["findings"]
    said = [n for n in found["notes"] if "of a sampling interval" in n]
    assert bool(said) == (share > 0)
    if said:
        percent = float(said[0].split("off by ")[1].split(" %")[0])
        assert percent == pytest.approx(100 * share, rel=0.3)
