"""The words of a result state sizes with units; `diagnose --explain` and missing options give one clear line."""

from __future__ import annotations

import json

import pytest

from thermoctl.cli import main
from thermoctl.diagnosis.contract import CONTRADICTED
from thermoctl.diagnosis.report.explain import explain, why
from thermoctl.diagnosis.report.words import sentences, what_next, words
from thermoctl.diagnosis.verdict import OVERRULED

LAG = {
    "confirmed": 0.996,
    "effect": "sensor_lag",
    "where": "reading",
    "when": None,
    "probability": 0.98,
    "parameters": {"TAU_sensor_lag_reading": {"value": 4.21, "sd": 0.1, "unit": "s"}},
}
RADIATION = {
    "effect": "radiation",
    "where": "block",
    "when": None,
    "probability": 1.0,
    "confirmed": 0.99,
    "parameters": {},
}
FOUND = {
    "verdict": "partly_explained",
    "findings": [RADIATION, LAG],
    "alternatives": [],
    "remainder": {
        "share_closed": 0.9,
        "rms": {"reading": 0.03},
        "over_noise": {"reading": 1.5},
        "node": "block",
        "follows": ["heat"],
    },
    "fit": {
        "before": {"reading": 40.9},
        "refit_only": {"reading": 3.2},
        "after": {"reading": 0.252},
        "held_out_refit_only": {"reading": 3.4},
        "held_out_after": {"reading": 0.26},
        "held_out": "recordings run_3",
    },
    "next_experiment": None,
    "decision": {"row": "findings are supported and a remainder stays beside them", "over_noise": 1.5},
    "hypotheses": [],
    "lost": [],
    "refused": [{"effects": ["creep at v"], "reason": "refitted, and it or a part of it is not significant"}],
    "placeless": ["orifice_exponent"],
    "promised": {"radiation at block": 3.21, "cogging at v": 1.25},
    "truncated": True,
    "outputs": {"reading": {"unit": "degC", "noise": 0.02}},
}


@pytest.mark.parametrize(("probability", "told"), [(0.87, True), (0.4, False)])
def test_what_is_rather_likely_is_told_where_nothing_is_named(probability, told):
    eddy = {
        "effect": "eddy_heating",
        "where": "stator",
        "when": None,
        "probability": probability,
        "parameters": {},
    }
    text = sentences({**FOUND, "verdict": "unexplained", "findings": [], "alternatives": [eddy]})[0]
    assert text.startswith("Something is missing")
    assert ("Rather likely, but no sure name: eddy heating at stator (0.87)." in text) == told


def test_findings_are_told_by_size_with_units():
    first, gain, rest = sentences(FOUND)
    assert (
        first
        == "Found: radiation at block (probability above 0.99) and sensor lag of 4.21 s at reading (probability 0.98)."
    )
    assert gain == (
        "With them the error of reading falls from 3.2 K after a refit alone (40.9 K as the plant came) to 0.252 K; "
        "on recordings set aside it falls from 3.4 K to 0.26 K."
    )
    assert rest == (
        "0.03 K of reading remains that nothing known explains, beside 0.02 K of noise; "
        "it enters at block and follows heat."
    )


def test_effects_that_imitate_each_other_are_told_together():
    two = [RADIATION | {"probability": 0.5}, LAG | {"probability": 0.46, "parameters": {}}]
    family = RADIATION | {"effect": "radiation or sensor_lag", "probability": 0.97, "members": two}
    found = FOUND | {"verdict": "ambiguous", "findings": [family], "alternatives": two}
    assert words(found).startswith(
        "One of these is there (probability 0.97), and these recordings do not tell which: "
        "radiation at block (0.50), sensor lag at reading (0.46)."
    )
    told = words(found | {"alternatives": [*two, LAG | {"effect": "creep", "probability": 0.3}]})
    assert "Candidates, the likeliest first: radiation" in told
    one = "One of these is there (probability 0.97): radiation at block or sensor lag at reading."
    assert one in told and one in words(FOUND | {"families": [{"members": two, "probability": 0.97}]})
    told = words(FOUND | {"findings": [LAG, family]})
    assert told.startswith("Found: sensor lag of 4.21 s at reading (probability 0.98). " + one)


@pytest.mark.parametrize(
    ("verdict", "start"),
    [("consistent", "The recordings agree"), ("unexplained", "Something is missing that no effect")],
)
def test_without_findings_every_verdict_says_what_next(verdict, start):
    found = FOUND | {"verdict": verdict, "findings": [], "remainder": None}
    assert words(found).startswith(start) and "What next: " in words(found)
    assert "budget of refits ended the search" in words(found)


def test_an_unsure_law_is_told_with_its_expression():
    law = LAG | {"effect": "law", "expression": "0.2 * max(reading - 3, 0)", "parameters": {}}
    told = words(
        FOUND | {"verdict": "ambiguous", "findings": [], "alternatives": [law | {"probability": 0.6}]}
    )
    assert "law 0.2 * max(reading - 3, 0) at reading (0.60)" in told


def test_agreement_with_a_likely_effect_is_not_called_nothing_missing():
    found = FOUND | {"verdict": "consistent", "findings": [], "remainder": None, "truncated": False}
    assert "nothing is missing" in words(found) and "Nothing has to be done" in words(found)
    perhaps = words(found | {"alternatives": [RADIATION | {"probability": 0.72}]})
    assert "and yet something may be missing: radiation at block (0.72)." in perhaps
    assert "Record more, with wider steps" in perhaps and "nothing is missing" not in perhaps.lower()


def test_the_best_experiment_is_named_beside_what_would_help_more():
    """After a sentence on a sensor stood "The best one inside them", as if it had told of limits."""
    helpful = "A sensor of its own at block would tell more (1.20 bits with the same experiment)."
    proposed = {"profile": "heat in slow trapezoids, 20 min", "also_helpful": helpful}
    next_step = what_next(FOUND | {"verdict": "ambiguous", "next_experiment": proposed})
    assert next_step == f"{helpful} The best experiment of those tried: {proposed['profile']}."


def test_the_reasons_of_a_folder_without_a_diagnosis_are_refused(tmp_path, capsys):
    assert main(["diagnose", "--explain", str(tmp_path)]) == 2
    assert "No such file" in capsys.readouterr().err
    (tmp_path / "diagnosis.json").write_text(json.dumps({"verdict": "explained"}))
    assert main(["diagnose", "--explain", str(tmp_path)]) == 2
    assert "older version" in capsys.readouterr().err
    (tmp_path / "diagnosis.json").write_text(json.dumps(FOUND))
    assert main(["diagnose", "--explain", str(tmp_path)]) == 0
    assert capsys.readouterr().out.rstrip("\n") == explain(FOUND)


def test_a_name_that_is_no_effect_is_an_error_and_not_an_effect_that_promised_nothing(tmp_path, capsys):
    (tmp_path / "diagnosis.json").write_text(json.dumps(FOUND))
    assert main(["diagnose", "--explain", str(tmp_path), "--why", "radation at block"]) == 2
    assert "'radation' is no effect of the catalogue (did you mean 'radiation'?)" in capsys.readouterr().err
    assert main(["diagnose", "--explain", str(tmp_path), "--why", "sensor delay"]) == 0
    assert "it promised nothing" in capsys.readouterr().out


def test_the_columns_of_the_reasons_stay_apart():
    h = {"log_evidence": 626.4, "log_prior_odds": -15.1, "posterior": 0.99, "remainder": 1.0}
    text = explain(
        FOUND | {"hypotheses": [h | {"effects": ["creep at v", "a at b"], "physics": [0.73, 1.0]}]}
    )
    row = next(line for line in text.splitlines() if "creep at v + a at b" in line)
    cells = [cell.strip() for cell in row.split("  ") if cell.strip()]
    assert cells == ["626.4", "-15.1", "0.99", "0.73, above 0.99", "above 0.99", "creep at v + a at b"]


def test_an_extended_plant_that_held_out_data_contradict_is_not_recommended():
    fit = FOUND["fit"] | {"held_out_after": {"reading": 18.1}}
    assert "it rises from 3.4 K to 18.1 K" in words(FOUND | {"fit": fit})
    assert "Do not predict with the extended plant yet: it misses reading" in words(FOUND | {"fit": fit})
    assert "Use the extended plant" in words(FOUND)


def test_a_diagnosis_needs_its_plant_and_its_folder(tmp_path, capsys):
    assert main(["diagnose", "run.csv", "--out", str(tmp_path)]) == 2
    assert "--plant FILE is missing" in capsys.readouterr().err
    assert main(["diagnose", "run.csv", "--plant", "plant.yaml"]) == 2
    assert "--out DIR is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        (
            "sensor_lag",
            "sensor_lag at reading: a finding, probability 0.98; that other data confirm it above 0.99",
        ),
        ("creep", "creep at v: refitted, and it or a part of it is not significant"),
        ("sensor lag", "sensor_lag at reading: a finding"),
        ("sensor lag at reading", "sensor_lag at reading: a finding"),
        ("creep at w", "creep at w: it promised nothing in any screening"),
        ("orifice exponent", "orifice exponent: it has no place in this plant; `thermoctl effects show "),
        ("cogging", "cogging at v: not refitted; to first order it gains at most 1.2 nats"),
    ],
)
def test_one_line_says_why_an_effect_is_a_finding_or_none(asked, answer):
    assert why(FOUND, asked).startswith(answer)


def test_one_line_says_why_of_a_law_that_is_the_result():
    other = {"where": "other", "probability": 0.93, "confirmed": 0.95}
    law = {"where": "block", "probability": 0.97, "confirmed": 0.99, "beside": [other]}
    both = FOUND | {"remainder": FOUND["remainder"] | {"law": law}}
    assert why(both, "law") == "law at block: a finding, probability 0.97; that other data confirm it 0.99"
    assert why(both, "law at other").startswith("law at other: a finding, probability 0.93; ")


def test_errors_that_may_be_the_sensors_own_are_not_told_as_something_missing():
    """Noise of 2.3 times the stated one, nothing else: "something is missing that no effect explains"."""
    numbers = {"row": "nothing is supported for sure and a remainder stays", "over_noise": 2.29}
    numbers |= {"something": 0.0, "known": 0.0, "remains": 0.0, "flow": 0.01}
    plain = FOUND | {"verdict": "unexplained", "findings": [], "decision": numbers}
    assert "2.3 times the noise" in words(plain) and "noisier than stated" in words(plain)
    assert "Something is missing" not in words(plain)
    assert "Something is missing" in words(plain | {"decision": numbers | {"remains": 0.99}})


def test_what_recordings_set_aside_contradict_is_said_to_be_that():
    """It was "rather likely, but no sure name", and the advice was to add it to the catalogue."""
    lag = {
        "effect": "sensor_lag",
        "where": "voltage",
        "when": None,
        "probability": 0.9999,
        "parameters": {},
        "why_not": CONTRADICTED,
    }
    decision = {**FOUND["decision"], "row": OVERRULED, "worse": 0.999}
    result = {**FOUND, "verdict": "unexplained", "findings": [], "alternatives": [lag], "decision": decision}
    assert "though recordings set aside contradict it: sensor lag at voltage." in sentences(result)[0]
    assert "set aside" in what_next(result) and "catalogue" not in what_next(result)
