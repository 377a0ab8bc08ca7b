"""Held-out data speak against findings only where their errors are larger by more than chance."""

from __future__ import annotations

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from tests.plants import WIDE_BLOCK
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.evidence.fit import fitted
from thermoctl.diagnosis.evidence.held_out import Worth, worse, worth
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report import notes
from thermoctl.diagnosis.verdict.confirm import Confirm
from thermoctl.plant import expression as ex
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def errors(seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return two recordings' errors of two outputs, coloured, and the pattern of an effect that is not there."""
    rng = np.random.default_rng(seed)
    coloured = lfilter([1.0], [1.0, -0.9], rng.standard_normal((2, 2000, 2)), axis=1)
    return list(coloured * [1.0, 50.0]), np.sin(np.arange(2000) / 60.0)[:, None] * [1.0, 50.0]


@pytest.mark.parametrize("effect", [0.02, 0.1])
def test_two_predictions_that_err_alike_are_told_apart_by_chance_only(effect):
    """Both err by half of an effect. By the ratio of the errors alone, the findings lost half of the cases."""
    found = []
    for seed in range(300):
        noise, pattern = errors(seed)
        found.append(
            worse([e + effect * pattern / 2 for e in noise], [e - effect * pattern / 2 for e in noise])
        )
    assert 0.03 < np.mean(np.array(found) >= 0.9) < 0.17
    assert 0.4 < np.mean(found) < 0.6


@pytest.mark.parametrize("effect", [1.0, 3.0])
def test_an_effect_that_is_not_there_makes_a_prediction_worse(effect):
    noise, pattern = errors(3)
    added = [e + effect * pattern for e in noise]
    assert worse(noise, added) > 0.95
    assert worse(added, noise) < 0.05


def test_a_simulation_that_fails_is_worse_and_a_cell_that_is_missing_is_not():
    noise, pattern = errors(3)
    cells = [np.where(np.arange(2000)[:, None] % 7 == 0, np.nan, e) for e in noise]
    assert worse([e + pattern for e in cells], cells) < 0.1
    assert worse(noise, [np.full_like(noise[0], np.nan), noise[1]]) == 1.0


def test_an_output_that_no_recording_measured_says_nothing():
    noise, pattern = errors(3)
    unseen = [np.column_stack([e, np.full(len(e), np.nan)]) for e in noise]
    after = [np.column_stack([e + pattern, np.full(len(e), np.nan)]) for e in noise]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert worse(unseen, after) == worse(noise, [e + pattern for e in noise])
        assert worse(unseen, unseen) == 0.0


SWING = """
format: thermoctl-plant/1
title: a stiffening spring
parameters:
  c: {value: 0.05, range: [0.005, 0.5]}
  k: {value: 12, range: [3, 50]}
  b: {value: 2, range: [0.2, 20]}
nodes:
  v: {storage: 1, initial: 0, initial_sigma: 3}
  x: {storage: 1, initial: first(angle), initial_sigma: 0.01}
flows:
  damping: {from: v, rate: c * v}
  spring: {from: v, rate: k * x + b * x**3}
  travel: {into: x, rate: v}
outputs:
  angle: {value: x, noise: 0.007}
"""


def swing(start, seed):
    """A free swing that starts fast, by SciPy."""
    t = np.arange(0, 20, 0.04)
    right = solve_ivp(
        lambda t, y: [y[1], -0.05 * y[1] - 12 * y[0] - 2 * y[0] ** 3], (0, 20), start, t_eval=t, rtol=1e-9
    )
    noise = 0.007 * np.random.default_rng(seed).standard_normal(len(t))
    return Table(f"run_{seed}", f"run_{seed}.csv", t, {"angle": right.y[0] + noise})


@pytest.mark.parametrize("reserve", [(), (swing((0.5, -4), 2),)])
def test_the_start_of_a_swing_is_fitted_before_its_error_is_measured(reserve):
    """One linear step from a start at rest left 0.6 rad of a pendulum that the plant follows to 0.009 rad."""
    known = case(loads(SWING), [swing((0.2, 5), 1)], {}, Budget(9))
    null = fitted(known, known.plant, (), known.null)
    found = worth(known, null, null, reserve)
    assert found.after["angle"] == pytest.approx(0.007, rel=0.1)


def test_a_recording_set_aside_that_is_not_followed_is_told_where_nothing_is_missing():
    """A patient with a volume of his own: 'consistent' stood beside an error of 3.8 times the noise, without a word."""
    worth = Worth({}, {"y": 2.3}, {}, reserved=True, names=("pat_5",), noise={"y": 0.6})
    d = SimpleNamespace(worth=worth, decision=SimpleNamespace(verdict="consistent"))
    (note,) = notes._differ(d)
    assert note == "the error of y is 3.8 times the noise in pat_5, set aside, which differs from the others"
    d.worth = replace(worth, refit_only={"y": 0.7})
    assert not notes._differ(d)


def test_wild_readings_in_a_recording_set_aside_are_left_out_there_too():
    """Errors of it were 30 times the noise, and "they differ from the others": they stayed in these rows only."""
    plant, tables = loads(WIDE_BLOCK), []
    for k in range(3):
        t, rng = np.arange(0.0, 3000.0, 5.0), np.random.default_rng(k)
        heat = np.repeat(rng.uniform(0, 20, 20), 30)
        table = compile_plant(plant).measure(Table(f"r{k}", "", t, {"heat": heat, "air": 22 + 0 * t}), k)
        table.columns["T"][[77, 191, 333, 406, 555]] += 20.0
        tables.append(table)
    found = diagnose(plant, tables, {}, limits())
    assert found.decision.verdict == "consistent" and found.worth.reserved
    assert found.worth.refit_only["T"] < 1.3 * found.worth.noise["T"]
    assert [name for name, *_ in found.case.outliers] == ["r0", "r1", "r2"]
    assert any("T in r2 at 385" in note for note in found.case.notes)


@pytest.mark.parametrize(("confirmed", "verdict"), [(0.02, "unexplained"), (0.4, "explained")])
def test_beside_noise_alone_recordings_set_aside_may_know_little_but_not_speak_against(
    monkeypatch, confirmed, verdict
):
    """A heat source with which they were predicted worse, with 0.973, was named and 'confirmed' with 1."""
    plant, tables = loads(WIDE_BLOCK), []
    sun = "  sun: {into: one, rate: 0.6 * (step(t - 900) - step(t - 1300)), unit: W}\noutputs:"
    for k in range(3):
        t, rng = np.arange(0.0, 2400.0, 4.0), np.random.default_rng(k)
        real = loads(WIDE_BLOCK.replace("outputs:", sun)) if k == 0 else plant
        columns = {"heat": np.repeat(rng.uniform(0, 20, 8), 75), "air": 22 + 0 * t}
        tables.append(compile_plant(real).measure(Table(f"r{k}", "", t, columns), k))
    monkeypatch.setattr(Confirm, "probability", lambda self, home, key: confirmed)
    found = diagnose(plant, tables, catalogue(), limits())
    assert found.decision.verdict == verdict
    assert bool(found.shown) == (verdict == "explained")


SWINGS = np.random.default_rng(1).uniform((-0.6, -6.0), (0.6, 6.0), (12, 2))


@pytest.mark.parametrize("k", range(12))
def test_fast_swings_set_aside_do_not_end_in_a_wrong_optimum_of_their_start(k):
    """Six of 24 such starts ended 0.5 to 0.9 rad off, where the refitted plant follows to 0.007 rad."""
    known = case(loads(SWING), [swing((0.2, 5), 1)], {}, Budget(9))
    null = fitted(known, known.plant, (), known.null)
    found = worth(known, null, null, [swing(SWINGS[k], 10 + k)])
    assert found.after["angle"] == pytest.approx(0.007, rel=0.15)


@pytest.mark.parametrize("k", range(4))
def test_a_missing_spring_is_named_though_swings_set_aside_start_fast(k):
    """Their first reading was left out as an outlier; the plant reads its start there."""
    linear = SWING.replace(" + b * x**3", "").replace("  b: {value: 2, range: [0.2, 20]}\n", "")
    linear = linear.replace("noise: 0.007", "noise: 0.007, unit: rad").replace("x: {", "x: {unit: rad, ")
    entries = {k: e for k, e in catalogue().items() if k in ("cubic_stiffness", "quadratic_drag")}
    tables = [swing((0.2, 5), 1), swing((0.5, -4), 2)]
    found = diagnose(loads(linear), tables, entries, limits(), [swing(SWINGS[k], 10 + k)])
    assert [e.key[0] for e in found.shown] == ["cubic_stiffness"]
    assert found.decision.verdict == "explained" and not found.case.outliers


WINDER = """\
format: thermoctl-plant/1
title: A winder that turns one way
inputs: {volts: {unit: V}}
parameters:
  k: {value: 0.08, unit: N*m/V, range: [0.02, 0.3]}
  b: {value: 0.003, unit: N*m*s/rad, range: [0.0008, 0.01]}
  J: {value: 0.01, unit: kg*m**2}
nodes: {w: {unit: rad/s, storage: J, initial: first(tacho), initial_sigma: 0.5, role: velocity}}
flows:
  motor: {into: w, rate: k * volts, unit: N*m}
  drag: {from: w, rate: b * w, unit: N*m}
outputs: {tacho: {value: w, unit: rad/s, noise: 0.5}}
"""


def test_a_recording_that_was_set_aside_decides_where_the_others_do_not():
    """The recording of the proposed experiment was the third one, took no part, and the answer stayed ambiguous."""
    plant, t, runs = loads(WINDER), np.arange(0, 40, 0.05), []
    rubs = plant.flows["drag"]
    rubs = replace(rubs, rate=ex.parse("b * w + 0.15 * tanh(w / 0.5)"))
    truth = compile_plant(replace(plant, flows={**plant.flows, "drag": rubs}))
    for seed, sign in ((1, 1), (2, 1), (3, -1)):
        levels = np.repeat(np.random.default_rng(seed).uniform(5, 20, 10), 80)
        drive = {"volts": np.where(t < 20, levels, sign * levels), "tacho": np.full(len(t), 100.0)}
        runs.append(truth.measure(Table(f"run_{seed}", "", t, drive), seed))
    friction = {"coulomb_friction", "constant_load"}
    entries = {k: e for k, e in catalogue().items() if k in friction}
    first = diagnose(plant, runs[:2], entries, limits())
    assert first.decision.verdict == "ambiguous"
    found = diagnose(plant, runs, entries, limits())
    assert found.decision.named == (("coulomb_friction", "w"),) and not found.worth.reserved
    aside = diagnose(plant, runs[:2], entries, limits(), runs[2:])
    assert aside.worth.reserved, "a recording that --held-out names stays aside"
