"""An effect with many places leaves room for the others."""

from types import SimpleNamespace
from typing import Any

import pytest

from tests.plants import TWO_BLOCKS
from thermoctl.advice.effect_files import made_rig
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.search.gains import PLACES_EACH, Direction, foremost, once
from thermoctl.diagnosis.search.shortlist import relabels
from thermoctl.plant import loads


def _direction(effect: str, where: str, gain: float) -> Direction:
    candidate: Any = SimpleNamespace(key=(effect, where))
    return Direction(candidate, {}, gain, 1, {})


def test_an_effect_with_many_places_does_not_crowd_another_out() -> None:
    bending = [_direction("bending", f"pair_{k}", 100 - k) for k in range(50)]
    lag = _direction("expansion_lag", "z", 1.0)
    assert foremost([*bending, lag], PLACES_EACH) == [*bending[:PLACES_EACH], lag]


def test_more_shapes_at_one_place_count_as_one_place() -> None:
    shapes = [_direction("sensor_offset_step", "bed", 10 - k) for k in range(6)]
    other = _direction("sensor_offset_step", "nozzle", 1.0)
    assert foremost([*shapes, other], 2) == [*shapes, other]
    assert once([*shapes, other]) == [shapes[0], other]


@pytest.mark.parametrize(("growth", "known"), [("a * one", True), ("a * (one - air)", False)])
def test_a_bend_is_in_the_plant_only_if_one_side_may_grow_by_itself(growth: str, known: bool) -> None:
    """A nose that grows with its distance to the air was named as two missing members, 12 nats below the bend."""
    text = TWO_BLOCKS.replace("parameters:", "parameters:\n  a: {value: 5, unit: um/K, range: [0, 20]}")
    plant = loads(text + f"  nose: {{value: '{growth}', unit: um, noise: 0.4}}\n")
    bends = candidates(made_rig(plant), {"bending": catalogue()["bending"]})
    (ours,) = (c for c in bends if c.place.where in ("one-two", "two-one"))
    assert relabels(ours) == known
