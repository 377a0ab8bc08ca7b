"""An effect with many places leaves room for the others."""

from types import SimpleNamespace
from typing import Any

from thermoctl.diagnosis.search.gains import PLACES_EACH, Direction, foremost, once


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
