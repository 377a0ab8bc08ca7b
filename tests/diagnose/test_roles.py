"""What a quantity is follows from roles, units and structure; a form of the catalogue means the same in any unit."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.diagnose.changes import Given, kelvin, milliwatt, names, order
from tests.plants import ONE_BLOCK
from thermoctl.cli import main
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.evidence.where import signals
from thermoctl.diagnosis.hypothesis.candidates import Candidate, candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.search.overlay import Overlay, Trajectory
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant import from_plain, load, loads
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

OSCILLATOR = """
format: thermoctl-plant/1
title: an electronic oscillator
inputs: {drive: {unit: V}}
parameters: {m: {value: 0.01, unit: s**2, range: [0.001, 0.1]}, d: {value: 0.1, unit: s, range: [0, 1]}, k: {value: 1, range: [0.1, 9]}}
nodes:
  out: {unit: V, storage: 1, initial: 0}
  slope: {unit: V/s, storage: m, initial: 0}
flows:
  rate: {into: out, rate: slope}
  drives: {into: slope, rate: drive}
  damps: {from: slope, rate: d * slope}
  pulls: {from: slope, rate: k * out}
outputs: {reading: {value: out, unit: V, noise: 0.001}}
"""
BLOCKS = """
format: thermoctl-plant/1
title: two blocks and a rod
inputs:
  current: {unit: A}
  heat: {unit: W}
  speed: {unit: m/s}
  stroke: {unit: m, between_samples: linear}
  air: {unit: degC, between_samples: linear}
  wall: {unit: degC, between_samples: linear}
parameters:
  C: {value: 40, unit: J/K, range: [20, 80]}
  G: {value: 0.3, unit: W/K, range: [0.1, 1]}
  R: {value: 2, unit: ohm, range: [1, 4]}
  K: {value: 1, unit: N*s/m, range: [0.5, 2]}
  A: {value: 2.0e-5, unit: m/K, range: [1.0e-6, 1.0e-4]}
nodes:
  near: {unit: degC, storage: C, initial: air, initial_sigma: 0.3}
  far: {unit: degC, storage: C, initial: air, initial_sigma: 0.3}
flows:
  joule: {into: near, rate: R * current**2, unit: W}
  heater: {into: near, rate: heat, unit: W}
  rub: {into: far, rate: K * speed**2, unit: W}
  between: {from: near, into: far, rate: G * (near - far), unit: W}
  loss: {from: near, rate: G * (near - air), unit: W}
  far_loss: {from: far, rate: G * (far - air), unit: W}
  to_wall: {from: far, rate: 0.1 * G * (far - wall), unit: W}
outputs:
  near_c: {value: near, unit: degC, noise: 0.1}
  far_c: {value: far, unit: degC, noise: 0.1}
  volts: {value: R * current, unit: V, noise: 0.01}
  length: {value: A * (near - 20) + stroke, unit: m, noise: 1.0e-6}
"""


def blocks() -> Given:
    """Two heated blocks and a rod, with a column that nothing reads."""
    t = np.arange(0.0, 600.0, 10.0)
    columns = {
        "t": t,
        "current": np.repeat([0.0, 2.0, 1.0], 20),
        "heat": np.repeat([8.0, 0.0, 4.0, 0.0], 15),
        "speed": np.repeat([0.0, 0.5, -0.2, 0.1, 0.0, 0.3], 10),
        "stroke": 0.02 * np.sin(t / 90),
        "air": 21 + np.sin(t / 200),
        "wall": 23 + np.cos(t / 200),
        "oil": 30 + 5 * np.sin(t / 100),
    }
    return Given(yaml.safe_load(BLOCKS), {"run": columns})


def _read(rig: Given) -> tuple[Plant, Rig, Table]:
    plant = from_plain(rig.plant)
    columns = dict(rig.recordings["run"])
    table = Table("run", "run", columns.pop("t"), columns)
    drive = compile_plant(plant).excitation(table)
    return plant, Rig(plant, [drive], [columns]), table


def _places(rig: Given) -> set[tuple[str, str, int, tuple[str, ...]]]:
    _, structure, _ = _read(rig)
    return {
        (
            c.effect.name,
            "-".join(rig.back.get(w, w) for w in c.place.where.split("-")),
            c.variant,
            tuple(sorted(rig.back.get(str(s), str(s)) for s in c.symbols.values())),
        )
        for c in candidates(structure, catalogue())
    }


@pytest.mark.parametrize("other", [names, kelvin, milliwatt])
def test_every_effect_has_the_same_places_whatever_the_names_and_units(other):
    rig = blocks()
    assert _places(other(rig)) == _places(rig)


@pytest.mark.parametrize("between", ["hold", "linear"])
def test_the_air_stays_the_ambient_beside_every_effect(between):
    """A drift with the air was placed before a slow thermometer, and could then not be added: KeyError 'air'."""
    rig = blocks()
    rig.plant["inputs"]["air"]["between_samples"] = between
    _, structure, table = _read(rig)
    for c in {c.effect.name: c for c in candidates(structure, catalogue())}.values():
        plant = c.extend({})
        beside = Rig(plant, [compile_plant(plant).excitation(table)], [dict(table.columns)])
        assert beside.air == structure.air == "air", c.key


def test_the_order_of_keys_decides_nothing_but_the_order_of_pairs():
    def unordered(rig: Given) -> set:
        return {(e, frozenset(w.split("-")), v, s) for e, w, v, s in _places(rig)}

    assert unordered(order(blocks())) == unordered(blocks())


def _values(c: Candidate) -> dict[str, float]:
    """Values of an effect's parameters that are felt."""
    special = {
        "T0": 100.0,
        "T1": 300.0,
        "TAU": 40.0,
        "TD": 15.0,
        "N": 0.4,
        "E": 1.0e-9,
        "P": 0.01,
        "YMAX": 25.0,
    }
    special |= {f"B{k}": 22.0 + k for k in range(5)}
    return {p.name: special.get(p.name, 0.02 + p.null) for p in c.effect.parameters}


def _changes(rig: Given) -> dict[tuple, tuple[dict, dict]]:
    """What each effect at each place changes along the plant's own trajectory: slopes and readings."""
    plant, structure, table = _read(rig)
    model = compile_plant(plant)
    drive = dataclasses.replace(
        model.prepare(model.excitation(table)), rtol=1e-11
    )  # the trajectories are one
    run = model.run(drive)
    along = {**table.columns, **signals(model, drive, model.vector(None), run.x)}
    metric = SimpleNamespace(drives=[drive], runs=[run], signals=[along])
    at, out = Trajectory(metric, structure, 0), {}
    for c in candidates(structure, catalogue()):
        if not c.place.input:  # an input's fault is in the input's own unit
            values = _values(c)
            if rig.plant["outputs"].get(c.place.where, {}).get("unit") == "K":
                values = {k: v + 273.15 * (k == "YMAX") for k, v in values.items()}  # a level of that reading
            own = {c.own(k): v for k, v in values.items()}
            out[c.key, c.variant, c.label] = Overlay(plant, c.extend(values)).changes(own, at)
    return out


def test_an_effect_changes_a_plant_alike_in_degc_and_in_kelvin():
    celsius, absolute = _changes(blocks()), _changes(kelvin(blocks()))
    assert celsius.keys() == absolute.keys() and len(celsius) > 40
    for key, parts in celsius.items():
        for one, other in zip(parts, absolute[key], strict=True):
            assert one.keys() == other.keys()
            for k in one:
                np.testing.assert_allclose(other[k], one[k], rtol=1e-6, atol=1e-9, err_msg=str(key))


def test_an_effect_of_heat_has_the_unit_of_the_plants_heat_flows():
    for change, unit, capacity in ((lambda r: r, "W/K", "J/K"), (milliwatt, "mW/K", "mJ/K")):
        _, rig, _ = _read(change(blocks()))
        mass = next(c for c in candidates(rig, catalogue()) if c.key == ("hidden_thermal_mass", "near"))
        parameters = mass.extend({"G": 0.1, "C": 5.0}).parameters
        assert [parameters[mass.own(p)].unit for p in ("G", "C")] == [unit, capacity]


def test_a_rate_and_its_integral_are_a_motion_in_any_unit():
    plain = yaml.safe_load(OSCILLATOR)
    for change in (lambda p: p, lambda p: p["flows"]["rate"].update(rate="1000 * slope") or p):
        rig = Rig(from_plain(change(plain)), [], [])
        assert (rig.velocities, rig.position_of) == (["slope"], {"slope": "out"})
        assert any(c.key == ("cubic_stiffness", "slope") for c in candidates(rig, catalogue()))
        assert any("'slope' is its rate" in note for note in rig.guesses())


@pytest.mark.parametrize(
    "rate", ["slope + 1", "abs(slope)", "min(slope, 5)", "slope * step(drive)", "slope * step(out)"]
)
def test_what_is_not_the_plain_rate_is_no_motion(rate):
    plain = yaml.safe_load(OSCILLATOR)
    plain["flows"]["rate"]["rate"] = rate
    assert not Rig(from_plain(plain), [], []).velocities


def test_a_role_stands_above_unit_and_structure():
    plain = yaml.safe_load(BLOCKS)
    plain["inputs"]["wall"]["role"] = "ambient"
    assert Rig(from_plain(plain), [], []).air == "wall"
    del plain["inputs"]["speed"]["unit"]
    plain["inputs"]["speed"]["role"] = "velocity"
    plain["inputs"]["stroke"]["role"] = "setpoint"
    rig = Rig(from_plain(plain), [], [])
    assert (rig.signals("v"), rig.signals("x")) == (["speed"], [])
    tank = yaml.safe_load(OSCILLATOR)
    tank["nodes"]["out"]["role"] = "level"
    assert not Rig(from_plain(tank), [], []).velocities


def test_an_input_with_a_role_that_nothing_reads_serves_effects_and_has_no_faults():
    rig = blocks()
    rig.plant["inputs"]["oil"] = {"role": "temperature"}
    rig.recordings["run"]["fan"] = rig.recordings["run"]["speed"]
    rig.plant["inputs"]["fan"] = {"role": "velocity"}
    structure = _read(rig)[1]
    assert "oil" in structure.signals("T")
    assert set(structure.signals("v")) == {"speed", "fan"}
    assert not {"oil", "fan"} & {c.place.input for c in candidates(structure, catalogue())}


def test_the_ambient_that_most_losses_are_counted_from_is_taken_and_said():
    for rig in (blocks(), order(blocks())):
        structure = _read(rig)[1]
        assert structure.air == "air"
        assert any(n.startswith("'air' is taken as the ambient") and "wall" in n for n in structure.guesses())


def test_what_an_unread_column_sounds_like_is_a_guess_that_is_said():
    plant = loads(OSCILLATOR)
    columns = {
        n: np.arange(5.0) ** 2 for n in ("drive", "motor_speed", "position", "current", "x", "v", "c7")
    }
    drive = compile_plant(plant).excitation(Table("run", "run", np.arange(5.0), columns))
    structure = Rig(plant, [drive], [columns])
    assert structure.signals("v") == ["slope"], "the plant's own motion comes first"
    assert structure.signals("x") == ["out"]
    assert structure.signals("i") == ["current"]
    notes = structure.guesses()
    assert any("as a current: 'current'; " in n for n in notes)
    assert any("as a temperature: 'c7'; " in n for n in notes)
    units = {"pos_mm": "position", "gap_um": "position", "spindle_rpm": "velocity", "i_d": "current"}
    units |= dict.fromkeys(("possible", "ch1", "ch2"), "temperature")
    columns = {n: np.arange(5.0) ** 2 for n in ("drive", *units)} | {"t_ms": 1000 * np.arange(5.0) + 7}
    drive = compile_plant(plant).excitation(Table("run", "run", np.arange(5.0), columns))
    notes = Rig(plant, [drive], [columns]).guesses()
    unread = [n for n in notes if n.startswith("columns that")]
    assert len(unread) == len({*units.values()}), "one note for all columns of a kind"
    assert all(
        any(f"as a {kind}: " in note and f"'{n}'" in note for note in notes) for n, kind in units.items()
    )
    assert not any("t_ms" in note for note in notes), "the time in another unit is no quantity of the rig"


AXIS = """\
format: thermoctl-plant/1
title: Axis in its position loop
inputs:
  target: {unit: mm, role: setpoint, between_samples: hold}
parameters:
  kp: {value: 30, unit: 1/s, range: [5, 200]}
nodes:
  x: {unit: mm, storage: 1, initial: 0}
flows:
  follow: {into: x, rate: kp * (target - x), unit: mm/s}
outputs:
  position: {value: x, unit: mm, noise: 0.01}
"""


@pytest.mark.parametrize(
    ("effect", "limited", "level"),
    [
        ("actuator_saturation", "min(max(40 * (target - x), -50), 50)", 50.0),
        ("actuator_dead_zone", "max(40 * (target - x) - 8, 0) + min(40 * (target - x) + 8, 0)", 8.0),
    ],
)
def test_what_is_made_of_a_set_point_is_limited_and_not_the_set_point(effect, limited, level):
    """A screw axis that moves at 45 mm/s at most got a law of eleven parameters: its target was clipped."""
    plant, t = loads(AXIS), np.arange(0, 12, 0.01)
    follow = dataclasses.replace(plant.flows["follow"], rate=ex.parse(limited))
    truth = compile_plant(dataclasses.replace(plant, flows={"follow": follow}))
    target = np.random.default_rng(4).uniform(-10, 10, 24)[(t / 0.5).astype(int)]
    table = truth.measure(Table("run", "", t, {"target": target}), 1)
    (found,) = contract(diagnose(plant, [table], catalogue(), limits()))["findings"]
    assert (found["effect"], found["where"]) == (effect, "follow")
    (u,) = found["parameters"].values()
    assert abs(u["value"] - level) < 0.03 * level and u["unit"] == "mm/s"


@pytest.mark.parametrize("unit", ["degF", "mK"])
def test_a_plant_in_other_degrees_is_refused_by_its_check_and_by_a_diagnosis(tmp_path, capsys, unit):
    """Radiation at a node in degF was (block + 273.15)**4 with the block in degF, without a word."""
    path, t = tmp_path / "plant.yaml", np.arange(100.0)
    path.write_text(ONE_BLOCK.replace("degC", unit))
    table = Table("run", "run", t, {"heat": 0 * t, "air": 70 + 0 * t, "temperature": 70 + 0.1 * np.sin(t)})
    with pytest.raises(InputError, match=f"'air' is in {unit}, .* degC or K only"):
        diagnose(load(path), [table], catalogue(), limits(), ())
    assert main(["plant", "check", str(path)]) == 1
    assert f"'block' is in {unit}, and effects know temperatures in degC or K only" in capsys.readouterr().out
