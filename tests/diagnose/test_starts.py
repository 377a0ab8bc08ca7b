"""A start that a refit moved far: what happened in the first rows is looked for."""

from __future__ import annotations

import numpy as np

from thermoctl.diagnose.case import Budget, case
from thermoctl.diagnose.catalogue import catalogue
from thermoctl.diagnose.diagnosis import diagnose
from thermoctl.diagnose.limits import limits
from thermoctl.diagnose.screening import screened
from thermoctl.diagnose.search import started
from thermoctl.plant import load
from thermoctl.plant.simulate import compile_plant
from thermoctl.recording.table import Table

TANK = """format: thermoctl-plant/1
title: a tank
inputs:
  pump: {unit: V}
  start: {unit: V}
parameters:
  k_pump: {value: 0.035, unit: 1/s, range: [0.01, 0.1]}
  k_out: {value: 0.04, unit: V**0.5/s, range: [0.015, 0.25]}
nodes:
  tank: {unit: V, storage: 1, initial: start, initial_sigma: 0.03}
flows:
  pumped: {into: tank, rate: k_pump * pump, unit: V/s}
  outflow: {from: tank, rate: "k_out * sqrt(max(tank, 0))", unit: V/s}
outputs:
  level: {value: tank, unit: V, noise: 0.02}
"""
SPILL = 'flows:\n  spill: {from: tank, rate: "0.6 * max(tank - 2.75, 0)", unit: V/s}\n'


def test_a_tank_that_spills_in_its_first_rows_only_has_no_wrong_start(tmp_path):
    """The refit moves the start by 5 standard deviations. Projected out, that hid the rest: 'consistent'."""
    (tmp_path / "plant.yaml").write_text(TANK)
    (tmp_path / "truth.yaml").write_text(TANK.replace("flows:\n", SPILL))
    t, rng = np.arange(1200) * 3.0, np.random.default_rng(4)
    columns = {"pump": np.repeat(np.round(rng.uniform(0.6, 1.3, 60), 2), 20), "start": np.full(1200, 3.2)}
    table = compile_plant(load(tmp_path / "truth.yaml")).measure(Table("run", "run", t, columns), seed=3)
    known = case(load(tmp_path / "plant.yaml"), [table], catalogue(), Budget(80))
    null = started(known, limits()).best.fitted
    assert abs(null.fit.dx0[0, 0]) > 5 * 0.03
    looked = screened(known, null, limits().clean)
    promised = {d.candidate.key: p for d, p in zip(looked.directions, looked.promises, strict=True)}
    assert promised["overflow", "tank"] > 5
    found = diagnose(known.plant, [table], catalogue(), limits())
    assert found.decision.verdict == "ambiguous"  # a gain that is wrong above would do it, too
    assert found.posterior.effects["overflow", "tank"] > 0.4
