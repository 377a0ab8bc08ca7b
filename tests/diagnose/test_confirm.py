"""A name has to predict parts of the recordings that it was not fitted to."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import wilcoxon

from tests.bench.scale import block_plant, recorded
from tests.plants import WIDE_BLOCK
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.run import diagnose_files
from thermoctl.diagnosis.verdict.confirm import Confirm, confirmed, signed_rank
from thermoctl.diagnosis.verdict.decide import Probabilities
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

A, B, DRIFT = ("radiation", "block"), ("sensor_gain", "reading"), ("sensor_drift", "reading")
NONE, ONE, BOTH = frozenset(), frozenset({A}), frozenset({A, B})


@given(st.lists(st.integers(-1000, 1000).filter(bool), min_size=3, max_size=40, unique_by=abs))
def test_the_signed_rank_probability_is_scipys(values):
    d = np.array(values, float)
    expected = 1 - wilcoxon(d, alternative="greater", method="exact").pvalue
    assert signed_rank(d) == pytest.approx(expected, abs=1e-9)


def test_an_effect_that_helps_in_one_part_only_is_not_confirmed():
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 0.02, 8)
    once, always = noise.copy(), noise + 0.3
    once[2] += 5.0
    assert signed_rank(once) < 0.9 < signed_rank(always)


def with_errors(energies, reserve=(), misfit=True, recordings=1, shared=True):
    """The test, on stated errors (parts, outputs) of each hypothesis instead of refits.

    `shared`: are the effects in each recording?"""
    entries = catalogue()

    def tried(keys):
        effects = [
            SimpleNamespace(key=k, candidate=SimpleNamespace(effect=entries[k[0]], shared=shared))
            for k in keys
        ]
        return SimpleNamespace(hypothesis=SimpleNamespace(effects=effects))

    known = SimpleNamespace(tables=range(recordings))
    test = Confirm(known, {keys: tried(keys) for keys in energies}, reserve, misfit)
    logs = {keys: np.log(np.array(e)[:, None]) for keys, e in energies.items()}
    test._known = {(keys, across): e for keys, e in logs.items() for across in (False, True)}
    return test


def test_the_weakest_name_leaves_first_and_the_rest_is_asked_again():
    alone = np.full(8, 2.0)
    beside = alone * np.array([0.1, 1.01, 1.0, 1.02, 1.01, 1.0, 1.03, 1.02])  # it imitates the first part
    test = with_errors({NONE: np.full(8, 50.0) + np.arange(8), ONE: alone, BOTH: beside})
    posterior = Probabilities({BOTH: 1.0}, {A: 1.0, B: 1.0}, 1.0)
    kept, after, asked = confirmed(posterior, BOTH, test, 0.9)
    assert kept == ONE
    assert after.effects[A] > 0.99 and after.effects[B] == asked[B] < 0.9


def test_a_weaker_effect_without_a_name_leaves_before_a_name():
    beside = np.full(8, 1.0) + 0.01 * np.arange(8)
    drift = beside * np.array([1.5, 1.4, 1.3, 0.9, 0.8, 1.01, 1.02, 1.03])  # without A: six parts are worse
    without_b = beside * np.array([1.2, 0.7, 1.1, 0.8, 1.3, 0.9, 1.05, 0.95])
    test = with_errors({NONE: np.full(8, 50.0), ONE: without_b, frozenset({B}): drift, BOTH: beside})
    posterior = Probabilities({BOTH: 0.6}, {A: 1.0, B: 0.6}, 1.0)
    kept, after, asked = confirmed(posterior, BOTH, test, 0.9)
    assert kept == ONE and after.effects[A] == asked[A] > 0.99
    assert after.effects[B] == 0.6 and B not in asked


def test_an_event_beside_a_misfit_is_confirmed_by_another_recording_only():
    """A fan that starts is one course in time; a misfit, too, has some course in time."""
    helps = {NONE: np.full(8, 50.0), frozenset({DRIFT}): np.arange(1.0, 9.0)}
    posterior = Probabilities({frozenset({DRIFT}): 1.0}, {DRIFT: 1.0}, 1.0)
    for test in (with_errors(helps), with_errors(helps, recordings=2, shared=False)):
        kept, after, _ = confirmed(posterior, frozenset({DRIFT}), test, 0.9)
        assert kept == NONE and after.effects[DRIFT] == 0.5
    for test in (
        with_errors(helps, reserve=("run_3",)),
        with_errors(helps, misfit=False),
        with_errors(helps, recordings=2),
    ):
        kept, after, _ = confirmed(posterior, frozenset({DRIFT}), test, 0.9)
        assert kept == frozenset({DRIFT}) and after.effects[DRIFT] > 0.99


def test_a_hypothesis_that_cannot_be_simulated_is_not_confirmed():
    test = with_errors({NONE: np.full(8, 50.0), ONE: np.full(8, 1.0)})
    test._known[ONE, False] = None
    assert test.probability(ONE, A) == 0.0


def test_a_weak_effect_of_many_recordings_needs_no_proof_from_one_of_them(tmp_path):
    """The recording set aside has a sixth of the information: too little for or against the link."""
    plant, size = tmp_path / "plant.yaml", 0.02
    link = f"{{from: block_1, into: block_3, rate: {size} * (block_1 - block_3), unit: W}}"
    for k in range(6):
        recorded(tmp_path / str(k), block_plant(3), link, 300, 10.0, 10.0, seed=300 + k)
        (tmp_path / str(k) / "run_1.csv").rename(tmp_path / f"run_{k}.csv")
    plant.write_text(block_plant(3))
    found = diagnose_files(plant, [tmp_path / f"run_{k}.csv" for k in range(6)], tmp_path / "out")
    assert found["verdict"] == "explained"
    (named,) = found["findings"]
    assert (named["effect"], named["where"]) == ("missing_link", "block_1-block_3")
    g = named["parameters"]["G_missing_link_block_1_block_3"]
    assert abs(g["value"] - size) < 3 * g["sd"]


def test_a_switch_that_is_logged_a_row_early_is_no_heat_from_outside():
    """A source of 1.2 s in rows of 10 s, of 100 +- 210 kW, was named with 1.0 and 'explained'."""
    plant, tables = loads(WIDE_BLOCK), []
    for k in range(2):
        t, rng = np.arange(0.0, 3000.0, 5.0), np.random.default_rng(k)
        heat = np.repeat(rng.permutation([0, 12, 4, 18, 8, 20]), 100)
        table = compile_plant(plant).measure(Table(f"run_{k}", "", t, {"heat": heat, "air": 22 + 0 * t}), k)
        tables.append(table)
    tables[1].columns["heat"][299] = tables[1].columns["heat"][300]
    entries = {"external_heat_source": catalogue()["external_heat_source"]}
    d = diagnose(plant, tables, entries, limits())
    assert not d.shown and d.refused == {("external_heat_source", "one")}
    assert any(
        "a switch that is logged early or late looks the same" in note for note in contract(d)["notes"]
    )
