"""`thermoctl plan`: sizes as a refit gives them, parameters that no recording gives, and inputs that excite nothing."""

import dataclasses
import json
import re

import numpy as np
import pytest

from tests.checks.rigs import PLANTS, inputs, rig
from thermoctl.advice.plan import plan
from thermoctl.cli import main
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, loads, save
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.simulation.simulate import compile_plant

EFFECTS = catalogue((CATALOGUE,))


def planned(plant, *tables, limits=None):
    found = plan(plant, tables, EFFECTS, limits or {})
    return found, {v.candidate.key: v for v in found.effects}


def test_a_visible_size_is_five_standard_errors_of_a_refit():
    plant, _ = rig("two blocks")
    _, effects = planned(plant, inputs("two blocks"))
    extended = (
        PLANTS["two blocks"]
        .replace("G_1 * (one - air)", "G_1 * (one - air) * (1 + A * (one - 20))")
        .replace("nodes:", "  A: {value: 0, unit: 1/K, range: [-0.1, 0.1]}\nnodes:")
    )
    model = compile_plant(loads(extended))
    found = fit(model, [model.excitation(model.measure(inputs("two blocks"), 1))])
    k = [q for q, _ in found.unknowns].index("A")
    sd = 0.2 * np.sqrt(np.linalg.inv(found.hessian)[k, k])  # of z, which is 0..1 over the range of 0.2 / K
    assert effects["temperature_dependent_conductance", "loss_1"].smallest == pytest.approx(5 * sd, rel=0.25)
    assert effects["temperature_dependent_conductance", "loss_1"].unit == "1/K"


def test_inputs_that_rest_show_nothing_of_what_they_excite():
    plant, _ = rig("two blocks")
    table = inputs("two blocks")
    rest = dataclasses.replace(table, columns={**table.columns, "heat": np.zeros(len(table))})
    found, effects = planned(plant, rest)
    assert effects["heat_split", "one-two"].reason == "these inputs do not excite it"
    moved, seen = planned(plant, table)
    assert seen["heat_split", "one-two"].reason is None
    assert all(a.sd < b.sd for a, b in zip(moved.parameters, found.parameters, strict=True))
    assert {p.name for p in moved.parameters if p.identified} > {
        p.name for p in found.parameters if p.identified
    }


def test_ratios_are_not_identified_and_a_better_course_is_better():
    ratio = (
        PLANTS["one block"]
        .replace("rate: heat,", "rate: gain * heat,")
        .replace("nodes:", "  gain: {value: 1, range: [0.3, 3]}\nnodes:")
    )
    found, _ = planned(loads(ratio), inputs("one block"))
    assert {p.name: p.identified for p in found.parameters} == {"C": False, "G": False, "gain": False}
    assert all(p.tied in ("C", "G", "gain") for p in found.parameters)
    found, _ = planned(rig("two blocks")[0], inputs("two blocks"))
    better = found.better
    assert better and better.duration_s <= found.duration_s
    assert np.mean([np.log(better.sd[p.name] / p.sd) for p in found.parameters]) < 0


def test_trusted_sensors_have_no_faults(tmp_path):
    text = PLANTS["two blocks"].replace("inputs:", "sensors: trusted\ninputs:", 1)
    plant = loads(text)
    save(plant, tmp_path / "plant.yaml")
    assert load(tmp_path / "plant.yaml").trusted and not loads(PLANTS["two blocks"]).trusted
    _, doubted = planned(rig("two blocks")[0], inputs("two blocks"))
    _, trusted = planned(plant, inputs("two blocks"))
    faults = {key for key in doubted if key[0].startswith("sensor_") or key[0] == "cold_junction_drift"}
    assert len(faults) > 5 and trusted.keys() == doubted.keys() - faults
    with pytest.raises(InputError, match="sensors.*trusted"):
        loads(text.replace("trusted", "right"))


@pytest.mark.parametrize(
    ("reading", "entry"),
    [("heat", "trusted: true"), ("heat", "role: setpoint"), ("temperature_1", "trusted: true")],
)
def test_one_trusted_reading_has_no_faults(reading, entry, tmp_path):
    text = PLANTS["two blocks"]
    plant = loads(re.sub(rf"(  {reading}: {{)", rf"\1{entry}, ", text))
    save(plant, tmp_path / "plant.yaml")
    _, doubted = planned(rig("two blocks")[0], inputs("two blocks"))
    _, trusted = planned(load(tmp_path / "plant.yaml"), inputs("two blocks"))
    faults = {key for key in doubted if key[0].startswith("sensor_") and key[1] == reading}
    assert faults and not faults & trusted.keys()
    assert {key for key in doubted if key[1] != reading} <= trusted.keys()
    with pytest.raises(InputError, match=f"trusted of '{reading}': true or false"):
        loads(re.sub(rf"(  {reading}: {{)", r"\1trusted: 3, ", text))


def test_a_plan_without_a_recording_settles_and_says_it_as_json(tmp_path, capsys):
    path = tmp_path / "plant.yaml"
    path.write_text(PLANTS["one block"])
    assert main(["plan", "--plant", str(path), "--limit", "heat=0:3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (
        told["duration_s"] > 10 * told["slowest_time_constant_s"] and told["visible"] and told["parameters"]
    )
    assert main(["plan", "--plant", str(path), "--limit", "heat=0:3"]) == 0
    printed = capsys.readouterr().out
    shares = [float(x) for x in re.findall(r"([\d.e+-]+) % of", printed)]
    assert len(shares) > 3 and shares == sorted(shares, reverse=True) and "(K)" not in printed
    assert all(
        v["moves"]["share"] > 0 and v["moves"]["output"] in load(path).outputs for v in told["visible"]
    )
    assert main(["plan", "--plant", str(path)]) == 2
    assert "--limit NAME=LOW:HIGH" in capsys.readouterr().err


def test_a_plant_without_inputs_is_planned_by_a_recording(tmp_path, capsys):
    (tmp_path / "p.yaml").write_text(
        "format: thermoctl-plant/1\nparameters: {G: {value: 1}}\nnodes: {T: {storage: 1, initial: first(y)}}\n"
        "flows: {loss: {from: T, rate: G * T}}\noutputs: {y: {value: T}}\n"
    )
    assert main(["plan", "--plant", str(tmp_path / "p.yaml")]) == 2
    assert "has no inputs; a recording of it was expected (--like REC)" in capsys.readouterr().err
    (tmp_path / "a.csv").write_text("t,z\n" + "".join(f"{k},{20 - k}\n" for k in range(20)))
    assert main(["plan", "--plant", str(tmp_path / "p.yaml"), "--like", str(tmp_path / "a.csv")]) == 2
    assert "another one: --columns y=COLUMN" in capsys.readouterr().err


@pytest.mark.parametrize(
    "path", sorted(shipped("config/plants/templates").glob("*.yaml")), ids=lambda p: p.stem
)
def test_every_template_can_be_planned(path):
    plant = load(path)
    driven = next(i.name for i in plant.inputs.values() if i.unit not in ("degC", "K"))
    if path.stem == "tank":  # at rest it is empty, and a square root has no slope there
        with pytest.raises(InputError, match="give --like REC"):
            planned(plant, limits={driven: (0.0, 1.0)})
        return
    found, _ = planned(plant, limits={driven: (0.0, 1.0)})
    assert found.parameters and any(v.reason is None for v in found.effects)
    assert all(v.smallest > 0 for v in found.effects)
