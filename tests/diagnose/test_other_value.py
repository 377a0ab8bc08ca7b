"""A parameter that differs between recordings of one rig: a load, a fill, cold grease (a law of 0.91 before)."""

import dataclasses

import pytest

from tests.checks.rigs import inputs
from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report import words as text
from thermoctl.diagnosis.run import diagnose as diagnosed
from thermoctl.plant import load, loads
from thermoctl.plant.simulation.simulate import compile_plant


def days(factors, parameter="C"):
    """Recordings of a block whose parameter is multiplied by each factor in turn."""
    plant, tables = loads(ONE_BLOCK), []
    for k, factor in enumerate(factors):
        p = plant.parameters[parameter]
        changed = dataclasses.replace(p, value=p.value * factor)
        real = dataclasses.replace(plant, parameters={**plant.parameters, parameter: changed})
        table = compile_plant(real).measure(inputs("one block"), 3 + k)
        tables.append(dataclasses.replace(table, name=f"day_{k + 1}"))
    return tables


def found(factors):
    """The result of diagnosing such recordings with the plant of the first one."""
    return contract(diagnose(loads(ONE_BLOCK), days(factors), catalogue(), limits()))


@pytest.mark.parametrize(
    ("factors", "where"),
    [
        ((1, 1.2), "day_2"),
        ((1, 1.2, 1), "day_2"),
        ((1, 1, 1.2), "day_3"),
        ((1, 1.2, 1, 1), "day_2"),
        ((1, 1.2, 0.8, 1), "day_2 and day_3"),
        ((1, 1.2, 0.8), "day_2 and day_3"),
    ],
)
def test_a_load_that_differs_is_named_with_its_recordings(factors, where):
    result = found(factors)
    (finding,) = result["findings"]
    assert (result["verdict"], finding["effect"], finding["where"]) == ("explained", "other_value", "C")
    (a,) = finding["parameters"].values()
    assert a["sd"] < 0.02
    for k, factor in enumerate(factors):
        assert a["values"][f"day_{k + 1}"] == pytest.approx(factor - 1, abs=4 * a["sd"])
    assert f"other value in {where} at C" in text.words(result)
    assert any("per_recording: true" in note for note in result["notes"])


def test_a_value_of_earlier_recordings_has_another_one_in_a_new_one(tmp_path):
    """A new recording alone has no other one to differ from: the hypothesis was lost with its evidence."""
    (tmp_path / "plant.yaml").write_text(ONE_BLOCK)
    plant, tables = load(tmp_path / "plant.yaml"), days((1, 1.2, 0.8))
    diagnosed(plant, tables[:2], tmp_path / "0")
    then = diagnosed(plant, tables[2:], tmp_path / "1", earlier=tmp_path / "0")
    (finding,) = then["findings"]
    (a,) = finding["parameters"].values()
    assert finding["effect"] == "other_value" and a["value"] == pytest.approx(-0.2, abs=4 * a["sd"])


def test_recordings_of_one_rig_have_no_other_value():
    assert found((1, 1))["verdict"] == "consistent"


def test_the_last_recording_has_its_own_value_of_what_the_plant_file_frees():
    """It was judged with the mean of the others, and what they showed was refused."""
    plant = loads(ONE_BLOCK)
    c = dataclasses.replace(plant.parameters["C"], per_recording=True)
    freed = dataclasses.replace(plant, parameters={**plant.parameters, "C": c})
    result = contract(diagnose(freed, days((1, 1.3, 0.8)), catalogue(), limits()))
    assert result["verdict"] == "consistent" and not any("set aside" in note for note in result["notes"])
