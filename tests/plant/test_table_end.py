"""A finding that is a function of time holds its last value beyond the recording it was found in; simulate says so."""

from __future__ import annotations

import numpy as np
import pytest

from thermoctl.cli import main
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

PLANT = """format: thermoctl-plant/1
title: A block beside a stove that nobody recorded
inputs:
  air: {unit: degC}
parameters:
  C: {value: 200.0, unit: J/K}
  G: {value: 1.0, unit: W/K}
  S: {value: 3.0, unit: W}
nodes:
  block: {unit: degC, storage: C, initial: 20.0}
flows:
  loss: {from: block, rate: "G * (block - air)", unit: W}
  stove: {into: block, rate: "table(t, [0, 50, 100], [0, S, S])", unit: W}
outputs:
  temperature: {value: block, unit: degC, noise: 0.1}
"""


@pytest.mark.parametrize(("seconds", "warned"), [(90.0, False), (400.0, True)])
def test_simulate_warns_where_a_table_over_time_has_ended(tmp_path, capsys, seconds, warned):
    (tmp_path / "plant.yaml").write_text(PLANT)
    t = np.linspace(0.0, seconds, 50)
    path = tmp_path / "run.csv"
    write_table(
        path, Table("run", str(path), t, {"air": np.full(50, 20.0), "temperature": np.full(50, 20.0)})
    )
    assert main(["simulate", "--plant", str(tmp_path / "plant.yaml"), str(path)]) == 0
    said = capsys.readouterr().err
    assert ("'stove' holds a table over time that ends at 100 s" in said) == warned
