"""A number that the plant file fixes wrongly is found as such, and hides no true effect when it is right."""

import dataclasses

import pytest

from tests.checks.rigs import PLANTS, rig
from thermoctl.checks import checks
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.result import contract
from thermoctl.diagnosis.search.mistakes import MISTAKES
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant

BLOCK = "one block"


def fixed(plant, name, factor=1.0):
    """The plant with a parameter that a refit cannot move."""
    p = plant.parameters[name]
    changed = dataclasses.replace(p, value=factor * p.value, range=None)
    return dataclasses.replace(plant, parameters={**plant.parameters, name: changed})


def places(plant):
    drives = [compile_plant(plant).excitation(rig(BLOCK)[1])]
    found = candidates(Rig(plant, drives, [rig(BLOCK)[1].columns]), catalogue((MISTAKES,)))
    return {c.key for c in found if c.effect.where != "sensor"}


def test_only_what_a_refit_cannot_move_may_be_off():
    plant = loads(PLANTS[BLOCK])
    assert places(plant) == set()
    assert places(fixed(plant, "C")) == {("wrong_storage", "block")}
    assert places(fixed(plant, "G")) == {("wrong_rate", "loss")}
    defined = dataclasses.replace(
        plant,
        nodes={
            "block": dataclasses.replace(
                plant.nodes["block"], storage=loads(PLANTS["stage"]).nodes["position"].storage
            )
        },
    )
    assert places(defined) == set()  # a storage of 1 is a definition


@pytest.mark.parametrize(
    ("name", "factor", "effect"), [("C", 1e-3, "wrong_storage"), ("G", 0.1, "wrong_rate")]
)
def test_a_wrong_fixed_number_is_named_as_such(name, factor, effect):
    plant, _ = rig(BLOCK)
    true = fixed(plant, name)
    table = compile_plant(true).measure(rig(BLOCK)[1], 3)
    found = contract(diagnose(fixed(plant, name, factor), [table], catalogue((CATALOGUE,)), limits()))
    (finding,) = found["findings"]
    assert found["verdict"] == "explained" and finding["effect"] == effect and finding["probability"] > 0.9
    (p,) = finding["parameters"].values()
    assert p["value"] * factor == pytest.approx(1.0, abs=max(4 * p["sd"] * factor, 0.02))
    assert any("plant file" in note for note in found["notes"])


def test_a_right_fixed_number_leaves_the_name_to_the_effect():
    plant, _ = rig(BLOCK)
    plant = fixed(plant, "C")
    source = "  sun: {into: block, rate: 0.6 * step(t - 500), unit: W}\noutputs:"
    real = fixed(loads(PLANTS[BLOCK].replace("outputs:", source)), "C")
    table = compile_plant(real).measure(rig(BLOCK)[1], 3)
    found = contract(diagnose(plant, [table], catalogue((CATALOGUE,)), limits()))
    assert [f["effect"] for f in found["findings"]] == ["external_heat_source"]


def test_a_link_of_the_wrong_sign_is_found_before_a_refit():
    _, table = rig("two blocks")
    wrong = loads(PLANTS["two blocks"].replace("G_12 * (one - two)", "G_12 * (two - one)"), "wrong.yaml")
    found = checks(wrong, [table])
    assert [(f.kind, f.severe) for f in found] == [("sign", True)]
    assert "'between'" in found[0].what and "wrong.yaml:" in found[0].suggestion
