"""Every row of the table that turns a posterior into a verdict; effects that do not stand out of what stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.verdict.decide import Facts, decide, weigh
from thermoctl.diagnosis.verdict.misfit import Energy, physics, standing, supported

A, B = ("radiation", "block"), ("natural_convection", "block")
NOTHING, ONE, OTHER, BOTH = frozenset(), frozenset({A}), frozenset({B}), frozenset({A, B})


def weighed(scores):
    return weigh(scores, {keys: dict.fromkeys(keys, 1.0) for keys in scores})


def test_a_small_remainder_that_is_certain_is_not_nothing():
    found = weighed({NOTHING: 0.0, ONE: -9.0})
    assert (
        decide(found, Facts(found.something, found.something, (), 1.04, remains=0.99), limits()).verdict
        == "unexplained"
    )
    found = weighed({NOTHING: 0.0, ONE: 40.0})
    beside = decide(found, Facts(found.something, found.something, (A,), 1.04, remains=0.99), limits())
    assert (beside.verdict, beside.named) == ("partly_explained", (A,))


@pytest.mark.parametrize(
    ("scores", "named", "over_noise", "worse", "verdict"),
    [
        ({NOTHING: 0.0, ONE: -9.0}, (), 1.0, 0.0, "consistent"),
        ({NOTHING: 0.0, ONE: -9.0}, (), 3.0, 0.0, "unexplained"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 1.0, 0.95, "unexplained"),
        ({NOTHING: 0.0, ONE: 40.0, OTHER: 39.5}, (), 1.0, 0.0, "ambiguous"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 1.0, 0.6, "explained"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 3.0, 0.0, "partly_explained"),
    ],
)
def test_each_row_gives_its_verdict(scores, named, over_noise, worse, verdict):
    posterior = weighed(scores)
    found = decide(
        posterior, Facts(posterior.something, posterior.something, named, over_noise, worse), limits()
    )
    assert found.verdict == verdict
    assert (found.named == named) == (verdict in ("explained", "partly_explained") or not named)


def test_what_does_not_follow_a_recording_set_aside_explains_a_part_only():
    """The findings bring the error there down to 1.8 times the noise: the fit knew the other recordings' rooms."""
    found = weighed({NOTHING: 0.0, ONE: 40.0})
    facts = [Facts(found.something, found.something, (A,), 1.0, apart=x) for x in (0.0, 1.2, 1.8)]
    verdicts = [decide(found, f, limits()).verdict for f in facts]
    assert verdicts == ["explained", "explained", "partly_explained"]


def test_what_nothing_else_confirms_is_missing_and_has_no_name():
    found = weighed({NOTHING: 0.0, ONE: 40.0})
    assert decide(found, Facts(found.something, 0.0, (), 3.0), limits()).verdict == "unexplained"


def test_alternatives_hold_the_set_and_no_more():
    found = weighed({NOTHING: 0.0, ONE: 40.0, OTHER: 39.5, frozenset({("back_emf", "v")}): 10.0})
    facts = Facts(found.something, found.something, (), 1.0)
    assert [k for k, _ in decide(found, facts, limits()).alternatives] == [A, B]


def test_an_effect_gathers_the_probability_of_all_hypotheses_that_hold_it():
    found = weighed({NOTHING: -50.0, ONE: 0.0, BOTH: 0.0})
    assert found.effects[A] == pytest.approx(1.0)
    assert found.effects[B] == pytest.approx(0.5)


def test_a_likely_effect_that_may_be_a_misfit_is_no_certainty():
    found = weigh({NOTHING: 0.0, ONE: 40.0}, {NOTHING: {}, ONE: {A: 0.7}})
    assert found.effects[A] == pytest.approx(0.7)
    assert found.something == pytest.approx(0.7)


def test_half_the_evidence_is_worth_the_root_of_its_odds():
    p = weigh({NOTHING: 0.0, ONE: 3.0}, {NOTHING: {}, ONE: {A: 1.0}}, 2.0).effects[A]
    assert p / (1 - p) == pytest.approx(np.exp(3.0) ** 0.5)


def one(square: float, misfit: float) -> Energy:
    """Energies of a single output with so many rows that noise moves nothing."""
    return Energy((square,), (misfit,), (1e15,))


def test_a_second_effect_that_removes_less_than_stays_does_not_stand():
    energy = {NOTHING: one(100.0, 98.4), ONE: one(10.0, 8.4), OTHER: one(90.0, 88.4), BOTH: one(9.5, 7.9)}
    found = standing(energy, {A: 1, B: 1}, {}, limits())
    assert set(found) == {NOTHING, ONE, BOTH}
    assert found[ONE][A] > 0.99
    # beside the first the second is part of the misfit, and takes nothing from it
    assert found[BOTH][A] == found[ONE][A] and found[BOTH][B] < 0.5


def test_an_effect_is_the_simpler_one_that_it_contains_unless_it_stands_out_against_it():
    a, b, c = ("backlash_hysteresis", "v"), ("coulomb_friction", "v"), ("creep", "v")
    energy = {NOTHING: one(100.0, 98.4), frozenset({a}): one(9.5, 7.9), frozenset({b}): one(10.0, 8.4)}
    energy[frozenset({a, c})] = one(9.2, 7.6)  # the second is part of the misfit, so the first stands alone
    dims, contains = {a: 2, b: 2, c: 2}, {a[0]: b[0]}
    assert set(standing(energy, dims, contains, limits())) == {NOTHING, frozenset({b})}
    assert frozenset({a}) in standing(energy, dims, {}, limits())
    energy[frozenset({a})] = one(2.0, 0.4)
    assert frozenset({a}) in standing(energy, dims, contains, limits())


def test_of_two_effects_that_explain_the_same_the_stronger_one_is_supported():
    c = ("sensor_lag", "block")
    found = {
        frozenset({A, B, c}): {A: 0.49, B: 0.21, c: 0.99},
        frozenset({A, c}): {A: 0.99, c: 0.99},
        frozenset({c}): {c: 0.65},
    }
    assert supported(frozenset({A, B, c}), found) == {A, c}
    del found[frozenset({A, c})]  # it was not tried
    assert supported(frozenset({A, B, c}), found) == {c}
    assert supported(frozenset({c}), found) == {c}


def test_without_a_misfit_every_effect_stands():
    energy = {NOTHING: one(1.02, 0.0), ONE: one(1.0, 0.0)}
    assert standing(energy, {A: 7}, {}, limits())[ONE][A] == 1.0


def test_the_odds_of_physics_are_a_log_uniform_size_against_a_normal_one():
    from scipy.stats import loguniform, norm

    r = 3.0  # sizes in standard deviations of the misfit, over four decades about it
    expected = loguniform(1e-2, 1e2).pdf(r) / norm.pdf(r)
    p = physics(one(6.0 + r**2 * 0.1 * 5.0, 0.0), one(6.0, 5.0), 0.1)
    assert p / (1 - p) == pytest.approx(expected, rel=1e-9)
    assert np.all(
        np.diff([physics(one(2.0 + x, 0.0), one(2.0, 1.0), 0.1) for x in np.linspace(0.2, 3.0, 30)]) > 0
    )


def test_a_misfit_in_one_reading_hides_no_effect_in_another():
    """A position's misfit of ten times its noise is nine; of a temperature's 20 000 rows an effect removes 0.5 %."""
    beside = Energy((10.0, 1.0), (9.0, 0.0), (20_000.0, 20_000.0))
    assert physics(dataclasses.replace(beside, squares=(10.0, 1.005)), beside, 0.1) > 0.99
    assert physics(dataclasses.replace(beside, squares=(10.005, 1.0)), beside, 0.1) < 0.5
    assert (
        physics(dataclasses.replace(beside, squares=(10.0, 1.0001)), beside, 0.1) < 0.5
    )  # two squares of noise
    both = Energy(
        (1e4, 2.5), (1e4, 1.5), (20_000.0, 20_000.0)
    )  # a current's 1.5 beside the position's 10 000
    assert physics(dataclasses.replace(both, squares=(1e4, 100.0)), both, 0.1) > 0.99
