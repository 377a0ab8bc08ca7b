"""The curve that is drawn beside a law."""

from __future__ import annotations

from types import SimpleNamespace as Part

from thermoctl.diagnosis.law.find import curve
from thermoctl.plant.expression import mul, name, num


def test_a_law_of_a_signal_that_only_another_finding_makes_is_not_drawn():
    """A lag of a current sensor, found beside a law of the current, makes the true current a state."""
    linear = Part(metric=Part(signals=[{"velocity": 1.0, "current": 2.0}]))
    law = Part(terms=[Part(signals=[Part()], form=Part(memory=None))], place=Part(part="flow"))
    rate = mul(num(3.0), name("lagged_current"))
    assert curve(linear, law, rate, Part(parameters={})) is None
