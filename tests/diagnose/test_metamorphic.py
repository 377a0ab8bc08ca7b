"""Spelling, order, clock, units, losses, thinning and stated noise do not change a diagnosis: three small cases of the generator."""

from __future__ import annotations

import pytest

from tests.diagnose.changes import (
    cells_lost,
    clock,
    columns_added,
    kelvin,
    milliwatt,
    names,
    noise_stated,
    order,
    rows_lost,
    thinned,
    together,
)
from tests.diagnose.metamorphic import diagnosed, difference, drawn
from tests.proof.score import meant


@pytest.mark.parametrize(
    ("case", "effects", "changes"),
    [
        (("tanks", 1, "one", "open"), [["sensor_delay", "level_lower"]], [together(order, clock, names)]),
        pytest.param(
            ("drive", 1, "one", "open"),
            [["copper_resistance", "joule"]],
            [together(kelvin, milliwatt)],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("heater", 2, "none", "closed"),
            [],
            [together(rows_lost, cells_lost), columns_added, thinned, noise_stated(0.5), noise_stated(2.0)],
            marks=pytest.mark.slow,
        ),
    ],
    ids=["order, clock and names", "units", "losses, unrelated columns, thinning and the stated noise"],
)
def test_a_change_of_form_does_not_change_the_diagnosis(case, effects, changes, tmp_path):
    rig, answer = drawn(*case)
    assert answer["effects"] == effects
    before = diagnosed(rig, tmp_path / "before")
    named = [meant(f) for f in before["findings"]]
    assert all(any(tuple(e) in kinds for kinds in named) for e in effects) and len(named) == len(effects), (
        "a case without its finding shows little"
    )
    for k, change in enumerate(changes):
        changed = change(rig)
        after = diagnosed(changed, tmp_path / str(k))
        assert difference(before, after, changed.back) == ""


def test_an_effect_on_an_input_that_another_replaced_is_no_hypothesis(tmp_path):
    rig, _ = drawn("tanks", 2, "none", "open")
    found = diagnosed(noise_stated(0.5)(rig), tmp_path)
    assert found["hypotheses"]
    both = {
        "sensor_lag at pump",
        "actuator_dead_zone at pumped",
    }  # the lag's state drives, no longer the pump
    assert not any(both <= set(h["effects"]) for h in found["hypotheses"])
