"""A start that a refit moved far: what happened in the first rows is looked for."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plants import TANK
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search.beam import started
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

SPILL = 'flows:\n  spill: {from: tank, rate: "0.6 * max(tank - 2.75, 0)", unit: V/s}\n'


def spilled(tmp_path, odd: int | None = None) -> tuple:
    """Return the plant, and a recording of a tank that spills for its first 3 s; one cell may be `odd`."""
    (tmp_path / "plant.yaml").write_text(TANK)
    (tmp_path / "truth.yaml").write_text(TANK.replace("flows:\n", SPILL))
    t, rng = np.arange(1200) * 3.0, np.random.default_rng(4)
    pump = np.repeat(np.round(rng.uniform(0.6, 1.3, 60), 2), 20)
    columns = {"pump": pump, "level_start": np.full(1200, 3.2)}
    table = compile_plant(load(tmp_path / "truth.yaml")).measure(Table("run", "run", t, columns), seed=3)
    if odd is not None:
        table.columns["level"][odd] += 1.0
    return load(tmp_path / "plant.yaml"), table


def test_a_tank_that_spills_in_its_first_rows_only_has_no_wrong_start(tmp_path):
    """The refit moves the start by 5 standard deviations, and leaves the first reading far behind.

    Taken for an outlier, that reading was lost, and the rest named a sensor's gain with 0.998."""
    plant, table = spilled(tmp_path)
    null = started(case(plant, [table], catalogue(), Budget(80)), limits()).best.fitted
    assert abs(null.fit.dx0[0, 0]) > 4 * 0.05
    found = diagnose(plant, [table], catalogue(), limits())
    assert found.decision.verdict == "explained" and found.decision.named == (("overflow", "tank"),)
    best = found.searched.tried[0].fitted  # it acts in the first rows only, and leaves only noise
    assert best.plant.parameters["HMAX_overflow_tank"].value == pytest.approx(2.75, abs=0.05)


@pytest.mark.parametrize("odd", [0, 1, 700])
def test_a_wild_reading_is_left_out_wherever_it_is(tmp_path, odd):
    plant, table = spilled(tmp_path, odd)
    kept = case(plant, [table], catalogue(), Budget(80))
    assert np.flatnonzero(np.isnan(kept.tables[0].columns["level"])).tolist() == [odd]
    assert any(n.startswith("1 single outlier was left out: level in run at") for n in kept.notes)
