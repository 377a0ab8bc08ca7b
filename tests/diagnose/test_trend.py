"""Sizes of an effect by recording, and their change with the recordings' dates."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.run import diagnose
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.dates import line
from thermoctl.recording.table import Table

DAYS = 86_400.0


def test_a_line_through_sizes():
    slope, error = line([0, 30 * DAYS, 60 * DAYS], [(1.0, 0.1), (2.0, 0.1), (3.0, 0.1)])
    assert slope == pytest.approx(1.0) and error == pytest.approx(0.1 / np.sqrt(2))
    assert np.isinf(line([0, 0, 0], [(1.0, 0.1)] * 3)[1])


@pytest.mark.slow
@pytest.mark.parametrize("growth", [0.0, 1e-11], ids=["constant", "grows"])
def test_an_effect_that_grows_has_a_trend(tmp_path, growth):
    """Radiation, whose factor grows from week to week; four recordings of 400 s."""
    path = tmp_path / "plant.yaml"
    path.write_text(ONE_BLOCK)
    plant = load(path)
    t, rng = np.arange(400.0), np.random.default_rng(4)
    tables, sizes = [], []
    for week in range(4):
        sizes.append(2e-9 + growth * week)
        lost = f"{{from: block, rate: {sizes[-1]} * ((block + 273.15)**4 - (air + 273.15)**4), unit: W}}"
        path.write_text(ONE_BLOCK.replace("flows:\n", f"flows:\n  concealed: {lost}\n"))
        heat = 12 * rng.integers(0, 2, 8)[(t // 50).astype(int)]
        name = f"week_{week}"
        start = str(np.datetime64("2026-03-01T00:00:00.000") + np.timedelta64(7 * week, "D"))
        table = Table(name, name, t, {"heat": heat.astype(float), "air": 20 + 0 * t}, {"start": start})
        made = compile_plant(load(path)).measure(table, seed=week)
        tables.append(dataclasses.replace(made, meta=table.meta))
    found = diagnose(plant, tables, tmp_path / "out", held_out=[dataclasses.replace(tables[0], name="again")])
    (trend,) = found["trends"]
    assert trend["effect"] == "radiation"
    assert trend["changes"] == (growth > 0)
    assert any("changes with the recordings' dates" in n for n in found["notes"]) == (growth > 0)
    assert [r["recording"] for r in trend["recordings"]] == [t.name for t in tables]
    for r, size in zip(trend["recordings"], sizes, strict=True):
        assert r["value"] == pytest.approx(size, abs=4 * r["sd"] + 0.02 * max(sizes))
