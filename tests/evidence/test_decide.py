"""Every row of the table that turns a posterior into a verdict."""

from __future__ import annotations

import pytest

from thermoctl.evidence.decide import Facts, decide, weigh
from thermoctl.evidence.limits import limits

A, B = ("radiation", "block"), ("natural_convection", "block")
NOTHING, ONE, OTHER = frozenset(), frozenset({A}), frozenset({B})


@pytest.mark.parametrize(
    ("scores", "named", "over_noise", "closed", "worth", "verdict"),
    [
        ({NOTHING: 0.0, ONE: -9.0}, (), 1.0, 0.0, 1.0, "consistent"),
        ({NOTHING: 0.0, ONE: -9.0}, (), 3.0, 0.0, 1.0, "unexplained"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 1.0, 0.9, 1.5, "unexplained"),
        ({NOTHING: 0.0, ONE: 40.0, OTHER: 39.5}, (), 1.0, 0.9, 0.3, "ambiguous"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 1.0, 0.9, 0.3, "explained"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 3.0, 0.9, 0.3, "partly_explained"),
        ({NOTHING: 0.0, ONE: 40.0}, (A,), 3.0, 0.2, 0.3, "unexplained"),
    ],
)
def test_each_row_gives_its_verdict(scores, named, over_noise, closed, worth, verdict):
    numbers = limits()
    posterior = weigh(scores, numbers)
    found = decide(posterior, Facts(posterior.something, named, over_noise, closed, worth), numbers)
    assert found.verdict == verdict
    assert (found.named == named) == (verdict in ("explained", "partly_explained") or not named)


def test_alternatives_hold_the_set_and_no_more():
    found = weigh({NOTHING: 0.0, ONE: 40.0, OTHER: 39.5, frozenset({("back_emf", "v")}): 10.0}, limits())
    facts = Facts(found.something, (), 1.0, 0.9, 0.3)
    assert [k for k, _ in decide(found, facts, limits()).alternatives] == [A, B]


def test_an_effect_gathers_the_probability_of_all_hypotheses_that_hold_it():
    found = weigh({NOTHING: -50.0, ONE: 0.0, frozenset({A, B}): 0.0}, limits())
    assert found.effects[A] == pytest.approx(1.0)
    assert found.effects[B] == pytest.approx(0.5)
