"""How the search goes on from a first choice that another missing effect led astray, and which rivals are kept."""

import dataclasses

import numpy as np
import pytest

from tests.plants import FREE_CARRIAGE, ONE_BLOCK
from thermoctl.diagnose import run, screen, search
from thermoctl.diagnose.effects import Rig, candidates, catalogue, shape_grid
from thermoctl.diagnose.explain import Case
from thermoctl.diagnose.locate import Suspect
from thermoctl.plant import loads
from thermoctl.plant.simulate import compile_plant
from thermoctl.recording.table import Table


def stage(seeds=(1, 2), idle=0.0, cogging=0.02, strength=0.006):
    """A stage of 44 kg and 82 N s/m with cogging of 39 mm and a hysteresis before sliding, by small steps of Euler's method; `idle`: of
    a force below which there is none."""
    h, every = 0.0005, 4
    tables = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        t = np.arange(4000) * h * every
        force = np.interp(t, np.arange(0, 9, 0.4), rng.uniform(-8, 8, 23))
        v = x = strain = 0.0
        y = np.empty(len(t))
        for k, f in enumerate(np.where(np.abs(force) < idle, 0.0, force)):
            y[k] = x
            for _ in range(every):
                push = f - 82 * v + cogging * np.sin(2 * np.pi * x / 0.039 + 0.7) - strength * strain
                strain += (v - abs(v) * strain) / 0.0006 * h
                v += push / 44 * h
                x += v * h
        y = np.round((y + rng.normal(0, 5e-6, len(t))) / 1e-5) * 1e-5
        tables.append(Table(f"run_{seed}", f"run_{seed}", t, {"force": force, "encoder": y}))
    return tables


def entries(*names):
    return {n: catalogue()[n] for n in names}


@pytest.fixture(scope="module")
def looked():
    """The stage's case, its refit and a first look in which hysteresis, cogging and a reading that steps competed."""
    case = Case(loads(FREE_CARRIAGE), stage())
    base = case.explain(case.plant, [], [])
    seen = search.look(case, base, entries("cogging", "backlash_hysteresis", "sensor_offset_step"))
    seen.finalists = search.compete(case, seen, search.finalists(seen.directions))
    return case, base, seen


def names(explanation):
    return {c.effect.name for c in explanation.effects}


def test_a_wrong_first_choice_is_mended_by_the_second_effects_of_those_that_came_near(looked):
    case, _, seen = looked
    wrong = next(e for e in seen.finalists if names(e) == {"sensor_offset_step"})
    found = search.otherwise(case, seen, search.look(case, wrong, seen.entries, draws=0))
    assert names(found[0]) == {"cogging", "backlash_hysteresis"}
    assert {
        q: found[0].plant.parameters[q].value for q in found[0].plant.parameters if q[:2] in ("P_", "A_")
    } == pytest.approx({"P_cogging_velocity": 0.039, "A_cogging_velocity": 0.02}, rel=0.02)
    case.begun -= 2 * search.PATIENCE_S  # later than it has patience for
    assert search.otherwise(case, seen, search.look(case, wrong, seen.entries, draws=0)) == []
    case.begun += 2 * search.PATIENCE_S


def test_an_effect_that_is_left_by_itself_keeps_those_that_competed_with_it(looked, monkeypatch):
    case, base, seen = looked
    best, *others = seen.finalists
    second = next(e for e in others if names(e) != names(best))
    beside = search.compete(
        case,
        search.look(case, best, entries(*names(second)), draws=0),
        search.look(case, best, entries(*names(second)), draws=0).directions[:1],
    )[0]
    monkeypatch.setattr(search, "leave_out", lambda case, base, current, k: best)
    beside.score = best.score  # no better than without
    kept, rivals = search._backward(case, base, beside, [], seen.entries, seen.finalists)
    assert kept is best and rivals and all(r in others and names(r) != names(best) for r in rivals)


def test_a_threshold_at_which_a_drive_jumps_is_found_from_a_start_far_away():
    """The cost has steps there and no slope: from 0.5 N a refit by slopes alone stays at 0.5 N."""
    case = Case(loads(FREE_CARRIAGE), stage(idle=0.8, cogging=0.0, strength=0.0))
    base = case.explain(case.plant, [], [])
    seen = search.look(case, base, entries("actuator_dead_zone"), draws=0)
    jump = next(d for d in seen.directions if d.candidate.variant)
    far = dataclasses.replace(jump, start={"U": 0.5})
    found = search.compete(case, seen, [far])[0]
    assert found.plant.parameters["U_actuator_dead_zone_motor"].value == pytest.approx(0.8, rel=0.02)


def test_a_period_that_has_not_come_once_is_not_offered():
    """What bends once over the travel is no cogging, whatever it is."""
    case = Case(loads(FREE_CARRIAGE), stage())
    base = case.explain(case.plant, [], [])
    rig = Rig(base.plant, case.drives, [t.columns for t in case.tables])
    runs = [case.model.run(d) for d in case.drives]
    travel = np.ptp(np.concatenate([r.x[:, 1] for r in runs]))
    found = next(iter(candidates(rig, entries("cogging"))))
    offered = [s["period"] for s in shape_grid("periods", found, runs)]
    assert max(offered) == pytest.approx(travel) and min(offered) < travel / 50
    seen = search.look(case, base, entries("cogging"), draws=0)
    longest = max(search.ranges_of(d, 8.0)["P"][1] for d in seen.directions)
    assert longest <= 1.001 * np.ptp(np.concatenate([r.x[:, 1] for r in seen.metric.runs]))


def test_three_effects_at_once_are_not_said_to_explain(looked, monkeypatch):
    case, base, seen = looked
    best = seen.finalists[0]
    three = dataclasses.replace(best, effects=best.effects * 3, own=best.own * 3)
    monkeypatch.setattr(run, "search", lambda *a, **k: (three, [], [seen]))
    monkeypatch.setattr(run, "following", lambda *a: None)
    monkeypatch.setattr(run, "prune", lambda case, base, current, notes: current)
    monkeypatch.setattr(run, "remains", lambda case, e: None)
    monkeypatch.setattr(run, "CLEAN", 1e9)
    said = run.examine(Case(case.plant, case.tables), entries("cogging"))
    assert said.verdict == "unexplained" and any(
        n.startswith("3 entries of the catalogue") for n in said.notes
    )


def test_what_leaves_something_gives_way_to_what_fits_alike_and_leaves_nothing(monkeypatch):
    """Natural convection and radiation from a block fit alike; which of them leaves something is said by the test."""
    case = heated()
    left = {}
    for spoilt in ("natural_convection", "radiation"):

        def remains(case, e, spoilt=spoilt):
            return Suspect("node", "block", 60.0, 3) if spoilt in names(e) else None

        monkeypatch.setattr(run, "remains", remains)
        left[spoilt] = names(run.examine(case, entries("natural_convection", "radiation")).final)
    assert left == {"natural_convection": {"radiation"}, "radiation": {"natural_convection"}}


def test_an_unknown_function_of_time_that_leaves_much_gives_way_to_constant_physics_that_fits_alike(
    monkeypatch,
):
    case = heated()
    base = case.explain(case.plant, [], [])
    seen = search.look(case, base, entries("natural_convection", "radiation", "second_ambient"), draws=0)
    done = {next(iter(names(e))): e for e in search.compete(case, seen, search.finalists(seen.directions))}
    soaking, constant = done["second_ambient"], done["radiation"]
    soaking.score = min(e.score for e in done.values()) - 50
    assert search._ordered(case, [constant, soaking])[0] is soaking  # nothing remains beside it
    monkeypatch.setattr(case, "excess", lambda e: {"temperature": 9.0})
    assert search._ordered(case, [constant, soaking]) == [constant, soaking]
    constant.fit.cost = 2 * soaking.fit.cost
    assert search._ordered(case, [constant, soaking])[0] is soaking  # it fits much better
    assert search._ordered(case, []) == []


def test_other_missing_physics_is_no_inflated_noise(monkeypatch):
    """Where much remains beside an effect, the gains of the rest of the catalogue say nothing of noise."""
    case = heated()
    base = case.explain(case.plant, [], [])
    seen = search.look(case, base, entries("natural_convection"))
    found = search.compete(case, seen, search.finalists(seen.directions))[0]
    seen.inflation[1] = 1e9
    monkeypatch.setattr(
        search, "MARGINAL", 1e9
    )  # both ways by which a gain as large as this one counts anyway
    monkeypatch.setattr(search, "NO_COLOUR", ())
    assert found.white and search.counts(case, seen, found, seen.entries)  # what is left has its own chance
    monkeypatch.setattr(type(found), "white", False)
    assert not search.counts(case, seen, found, seen.entries)
    monkeypatch.setattr(case, "excess", lambda e: {"temperature": 9.0})
    assert search.counts(case, seen, found, seen.entries)


def heated():
    """Two recordings of a block that natural convection cools, too."""
    tables = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 1600.0, 2.0)
        heat = rng.permutation([0.0, 2.5, 0.8, 0.0, 1.6, 3.0, 0.0, 2.0])[(t // 200).astype(int)]
        air, x = 21.5 + 0.4 * np.sin(t / 700 + seed), np.empty(len(t))
        x[0] = air[0]
        for k in range(len(t) - 1):  # a hundredth of the time constant a step
            over = x[k] - air[k]
            x[k + 1] = x[k] + 2.0 * (heat[k] - 0.04 * over - 0.0008 * over * abs(over) ** 0.25) / 5.2
        tables.append(
            Table(
                f"run_{seed}",
                f"run_{seed}",
                t,
                {"heat": heat, "air": air, "temperature": x + rng.normal(0, 0.1, len(t))},
            )
        )
    return Case(loads(ONE_BLOCK), tables)


def test_an_error_faster_than_a_block_of_rows_is_seen(monkeypatch):
    """A reading with an error of a fifth of its noise every half millimetre, which the stage passes in three samples."""
    truth = compile_plant(
        loads(
            FREE_CARRIAGE.replace("value: 59", "value: 44")
            .replace("value: 132", "value: 82")
            .replace("{value: position,", "{value: position + 1e-6 * sin(2 * pi * position / 0.0005),")
        ),
        (),
    )
    tables = []
    for seed in (1, 2):
        t = np.arange(12000) * 0.002
        force = np.interp(t, np.arange(0, 25, 0.4), np.random.default_rng(seed).uniform(-8, 8, 63))
        tables.append(
            truth.measure(
                Table(f"run_{seed}", f"run_{seed}", t, {"force": force, "encoder": np.zeros(len(t))}),
                seed=seed,
            )
        )
    case = Case(loads(FREE_CARRIAGE), tables)
    base = case.explain(case.plant, [], [])
    fine = search.look(case, base, entries("cyclic_error"))
    best = fine.directions[0]
    variance = (5e-6) ** 2 + (1e-5) ** 2 / 12
    assert best.gain == pytest.approx(24000 * (1e-6) ** 2 / 2 / variance, rel=0.3)
    assert best.start["P"] == pytest.approx(0.0005, rel=0.01)
    monkeypatch.setattr(search, "FINE_ROWS", 1000)
    assert not any(
        d.gain > 0.3 * best.gain for d in search.look(case, base, entries("cyclic_error")).directions
    )


def test_a_sketch_keeps_what_directions_have_in_common():
    case = Case(loads(FREE_CARRIAGE), stage())
    metric = search.look(case, case.explain(case.plant, [], []), entries("constant_load"), draws=0).metric
    rows = np.random.default_rng(4).standard_normal((40 * screen.ROWS, 3))
    rows[:, 1] += 0.5 * rows[:, 0]
    short = metric.sketch(rows)
    assert len(short) <= screen.ROWS
    assert np.allclose(short.T @ short / len(rows), rows.T @ rows / len(rows), atol=0.05)


MOTOR = """format: thermoctl-plant/1
title: A motor on a frame that grows
inputs: {current: {unit: A}, speed: {unit: rad/s}, air: {unit: degC, between_samples: linear}}
parameters:
  C_winding: {value: 60, unit: J/K, range: [20, 200]}
  C_housing: {value: 300, unit: J/K, range: [100, 900]}
  G: {value: 1.2, unit: W/K, range: [0.3, 4]}
  H: {value: 0.8, unit: W/K, range: [0.2, 3]}
  fan: {value: 0.001, unit: W/K/(rad/s)}
  R: {value: 1.2, unit: ohm, range: [0.6, 2.4]}
  growth: {value: 2.0, unit: um/K, range: [0.5, 8]}
nodes: {winding: {unit: degC, storage: C_winding, initial: air}, housing: {unit: degC, storage: C_housing, initial: air}}
flows:
  joule: {into: winding, rate: R * current**2 * (1 + 0.00393 * (winding - 20)), unit: W}
  link: {from: winding, into: housing, rate: G * (winding - housing), unit: W}
  draught: {into: housing, rate: (H + fan * abs(speed)) * (air - housing), unit: W}
outputs:
  winding_c: {value: winding, unit: degC, noise: 0.1}
  housing_c: {value: housing, unit: degC, noise: 0.1}
  error: {value: growth * (housing - 20), unit: um, noise: 0.05}
"""


@pytest.fixture(scope="module")
def motor():
    t = np.arange(0.0, 3000.0, 10.0)
    plant = loads(MOTOR)
    table = Table(
        "run",
        "run",
        t,
        {
            "current": 3.0 * (np.sin(t / 200) > 0),
            "speed": 50 + 50 * np.cos(t / 150),
            "air": 21 + np.sin(t / 700),
        },
    )
    return Case(plant, [compile_plant(plant).measure(table)])


def offered(case, plant, name):
    rig = Rig(
        plant, [compile_plant(plant).excitation(t) for t in case.tables], [t.columns for t in case.tables]
    )
    return {c.place.where: c for c in candidates(rig, entries(name))}


def test_heat_that_copper_makes_may_go_elsewhere_and_what_a_draught_carries_off_may_not(motor):
    assert set(offered(motor, motor.plant, "heat_split")) == {"winding-housing"}


def test_a_reading_of_growth_may_follow_the_air_as_a_temperature_does(motor):
    assert set(offered(motor, motor.plant, "cold_junction_drift")) == {"winding_c", "housing_c", "error"}


def test_what_was_left_out_is_not_looked_for_in_what_another_effect_assumed(motor):
    mass = offered(motor, motor.plant, "hidden_thermal_mass")["housing"]
    plant = mass.extend(
        {"G": 0.5, "C": 100.0, **{p.name: p.null for p in mass.effect.parameters if p.name not in "GC"}}
    )
    hidden = set(plant.nodes) - set(motor.plant.nodes)
    assert len(hidden) == 1 and any(
        hidden & c.place.parts() for c in offered(motor, plant, "missing_link").values()
    )
    e = motor.explain(
        plant, [mass], [{p.name: mass.own(p.name) for p in mass.effect.parameters}], iterations=2
    )
    seen = search.look(
        motor, e, entries("missing_link", "natural_convection", "conductance_step", "sensor_gain"), draws=0
    )
    assert {d.candidate.effect.name for d in seen.directions} >= {
        "natural_convection",
        "conductance_step",
        "sensor_gain",
    }
    assert not any("hidden" in d.candidate.place.where for d in seen.directions)
