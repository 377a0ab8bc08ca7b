"""Laws of several rigs side by side."""

import io

from rich.console import Console

from thermoctl.fleet.laws import comparisons, shared, side_by_side


def law(n, sd, form="power"):
    """What diagnosis.json holds of a law over the velocity."""
    return {
        "expression": "A1 * velocity**n1",
        "where": "velocity",
        "share_closed": 0.74,
        "forms": [{"form": form, "variables": ["velocity"], "sizes": {"A": "A1"}, "shapes": {"n": "n1"}}],
        "parameters": {
            "A1": {"value": -2.0, "sd": 0.1, "unit": "N"},
            "n1": {"value": n, "sd": sd, "unit": None},
        },
    }


def test_an_exponent_that_repeats_is_one_value_with_a_smaller_error():
    (s,) = shared({"one": law(1.96, 0.03), "two": law(2.02, 0.03), "three": law(2.0, 0.03, "even_power")})
    assert s.same and s.values.keys() == {"one", "two"}
    assert abs(s.mean - 1.99) < 1e-9 and s.sd < 0.03


def test_exponents_that_differ_by_more_than_their_errors_are_not_one():
    laws = {"one": law(1.5, 0.03), "two": law(2.02, 0.03)}
    assert not shared(laws)[0].same
    (text,) = comparisons(laws)
    assert "not the same in 2 rigs (one 1.5 ± 0.059, two 2.02 ± 0.059)" in text


def test_the_table_has_one_row_for_each_rig():
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(side_by_side({"one": law(1.96, 0.03), "two": law(2.02, 0.03)}))
    lines = console.export_text().splitlines()
    assert "n1 1.96 ± 0.059" in lines[1] and "74 %" in lines[1]
    assert lines[2].split()[0] == "two"
