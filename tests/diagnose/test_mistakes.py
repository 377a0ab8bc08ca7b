"""A number that the plant file fixes wrongly is found as such, and hides no true effect when it is right."""

import dataclasses

import numpy as np
import pytest

from tests.checks.rigs import PLANTS, rig
from thermoctl.checks import checks
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search.mistakes import MISTAKES
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

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


def test_a_fixed_heat_and_a_fixed_storage_that_fit_alike_are_both_told():
    """With all conductances free, only heat over storage is seen: the storage alone had 0.97."""
    plant, bare = rig(BLOCK)
    text = (
        PLANTS[BLOCK]
        .replace("parameters:", "parameters:\n  P: {value: 1}")
        .replace("rate: heat,", "rate: P * heat,")
    )
    true = fixed(loads(text), "C")
    table = compile_plant(true).measure(bare, 3)
    found = contract(diagnose(fixed(true, "P", 0.85), [table], catalogue((CATALOGUE,)), limits()))
    assert found["verdict"] == "ambiguous"
    (first,), (second, *_) = found["findings"], found["alternatives"]
    assert {first["effect"], second["effect"]} == {"wrong_rate", "wrong_storage"}


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


DECAY = """
format: thermoctl-plant/1
title: A level that falls with a power of itself
inputs: {u: {between_samples: hold}}
parameters: {k: {value: 0.5, range: [0.05, 5]}}
nodes: {x: {storage: 1, initial: first(x_m), initial_sigma: 0.05}}
flows:
  drive: {into: x, rate: u}
  loss: {from: x, rate: k * x**3}
outputs: {x_m: {value: x, noise: 0.01}}
"""


@pytest.mark.parametrize("true", [3, 5])
def test_a_wrong_exponent_is_named_as_such(true):
    """Both odd: the flow keeps its sign where the state is below zero."""
    t, random = np.arange(0, 100, 0.5), np.random.default_rng(3)
    u, x = np.repeat(random.uniform(-1.5, 2, 10), 20), np.zeros(len(t))
    for k in range(1, len(t)):
        # Heun's method in small steps, independent of the product
        x[k] = x[k - 1]
        for _ in range(100):
            first = u[k - 1] - 0.8 * x[k] ** true
            x[k] += 0.005 * 0.5 * (first + u[k - 1] - 0.8 * (x[k] + 0.005 * first) ** true)
    table = Table("run", "", t, {"u": u, "x_m": x + random.normal(0, 0.01, len(t))})
    found = contract(diagnose(loads(DECAY), [table], catalogue((CATALOGUE,)), limits()))
    names = [(f["effect"], f["where"]) for f in found["findings"]]
    assert names == ([] if true == 3 else [("wrong_exponent", "loss")])
    if names:
        (value,) = found["findings"][0]["parameters"].values()
        assert value["value"] == pytest.approx(true, abs=0.1)


def test_a_weir_where_the_plant_has_a_pipe():
    """A notch lets out h**2.5; the largest exponent of an outlet had been 1."""
    weir = """
format: thermoctl-plant/1
title: A basin with an overfall
inputs: {inflow: {unit: m**3/s, between_samples: hold}}
parameters:
  area: {value: 12, unit: m**2}
  c: {value: 2, range: [0.1, 30]}
nodes: {h: {unit: m, storage: area, initial: first(gauge), initial_sigma: 0.01}}
flows:
  fill: {into: h, rate: inflow}
  over: {from: h, rate: c * h}
outputs: {gauge: {value: h, unit: m, noise: 0.004}}
"""
    t = np.arange(0, 400.0, 2)
    inflow = np.repeat(np.random.default_rng(8).uniform(0.1, 2.5, 10), 20)
    truth = compile_plant(loads(weir.replace("value: 2,", "value: 1.9,").replace("c * h}", "c * h**2.5}")))
    table = truth.measure(Table("run", "", t, {"inflow": inflow, "gauge": np.full(len(t), 0.8)}), 8)
    found = contract(diagnose(loads(weir), [table], catalogue((CATALOGUE,)), limits()))
    (finding,) = found["findings"]
    assert (finding["effect"], finding["where"]) == ("orifice_exponent", "over")
    (value,) = finding["parameters"].values()
    assert value["value"] == pytest.approx(2.5, abs=0.05)


def test_a_parameter_that_ends_at_a_bound_is_noted():
    """What is found may stand for a value beyond the bound. A bound of zero is no news: the flow is not there."""
    t = np.arange(0, 100.0, 0.5)
    u = np.repeat(np.random.default_rng(4).uniform(-1.5, 2, 10), 20)
    truth = compile_plant(loads(DECAY.replace("0.5, range", "0.8, range")))
    table = truth.measure(Table("run", "", t, {"u": u, "x_m": np.zeros(len(t))}), 4)

    def notes(low):
        plant = loads(DECAY.replace("0.5, range: [0.05, 5]", f"2, range: [{low}, 5]"))
        return contract(diagnose(plant, [table], {}, limits()))["notes"]

    assert any("at a bound of the range in the plant file: k (1);" in n for n in notes(1))
    assert not any("bound" in n for n in notes(0.05))
