"""Families: what is sure of effects that imitate each other where none of them is."""

import pytest

from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.verdict.decide import weigh
from thermoctl.diagnosis.verdict.families import families

ENTRIES = catalogue((CATALOGUE,))
DRY, STRIBECK = ("coulomb_friction", "v"), ("stribeck_friction", "v")
DRAG, LAG = ("quadratic_drag", "v"), ("sensor_lag", "v")


def of(scores, named=(), physics=1.0, asked=None):
    scores = {frozenset(k): s for k, s in scores}
    sure = {keys: dict.fromkeys(keys, physics) for keys in scores}
    return families(weigh(scores, sure), sure, named, ENTRIES, asked or {}, 0.9)


def test_two_frictions_are_one_sure_friction():
    (family,) = of([((DRY,), 0.0), ((STRIBECK,), 0.2), ((), -40.0)])
    assert family.members == (STRIBECK, DRY) and family.probability == pytest.approx(1.0, abs=1e-6)


def test_strangers_are_no_family():
    assert of([((DRY,), 0.0), ((LAG,), 0.0)]) == ()


def test_one_alone_is_no_family():
    assert of([((DRY,), 0.0), ((), -3.0)]) == ()


def test_beside_the_plant_alone_nothing_is_sure():
    assert of([((DRY,), 0.0), ((STRIBECK,), 0.0), ((), 0.0)]) == ()


def test_a_misfit_is_no_family():
    assert of([((DRY,), 0.0), ((STRIBECK,), 0.2)], physics=0.5) == ()


def test_beside_a_name_its_relatives_are_none():
    assert of([((DRY,), 5.0), ((DRY, STRIBECK), 4.0)], named=[DRY]) == ()


def test_a_relative_that_is_named_at_another_place_hides_no_family():
    """Two readings are late, one by a lag for sure, the other by a lag or a delay."""
    lag, delay = ("sensor_lag", "w"), ("sensor_delay", "w")
    (family,) = of([((LAG, lag), 0.0), ((LAG, delay), -0.4)], named=[LAG])
    assert set(family.members) == {lag, delay}


def test_two_hypotheses_that_share_a_name_and_differ_in_a_relative():
    (family,) = of([((LAG, DRY), 0.0), ((LAG, STRIBECK), 0.0)], named=[LAG])
    assert set(family.members) == {DRY, STRIBECK}


def test_what_nothing_else_confirms_is_no_family():
    scores = [((DRY,), 0.0), ((STRIBECK,), 0.2), ((), -40.0)]
    assert of(scores, asked={STRIBECK: 0.6}) == () and len(of(scores, asked={STRIBECK: 0.95})) == 1
