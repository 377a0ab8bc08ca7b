"""Progress of a diagnosis counts what was planned; an output folder that cannot be written ends it at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from thermoctl import shipped
from thermoctl.diagnose.case import Budget
from thermoctl.diagnose.run import diagnose
from thermoctl.plant import load
from thermoctl.recording.table import Table
from thermoctl.yamlfile import InputError

PLANT = Path(shipped.__file__).parents[1] / "config" / "plants" / "actuator_thermal.yaml"


def test_a_refit_is_reported_of_those_planned():
    said: list[str] = []
    budget = Budget(5, said.append)
    for planned in (1, 3, 9):
        budget.planned = planned
        budget.spend()
    assert [text.split("refit ")[1].split(" planned")[0] for text in said] == ["1 of 1", "2 of 3", "3 of 5"]


@pytest.mark.parametrize("inside", ["", "result"])
def test_a_file_in_place_of_the_folder_is_refused_before_the_work(tmp_path, inside):
    taken = tmp_path / "taken"
    taken.write_text("")
    plant = load(PLANT)
    with pytest.raises(InputError, match="--out"):
        diagnose(plant, [Table("none", "none", None, {})], taken / inside)  # type: ignore[arg-type]
    assert taken.read_text() == ""
