"""No sentence of a result contradicts a number: properties over made-up results of every verdict."""

import math
import re
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermoctl.diagnosis.commands import summary
from thermoctl.diagnosis.contract import CONTRADICTED, UNCONFIRMED
from thermoctl.diagnosis.curves import Curve
from thermoctl.diagnosis.data.case import Budget
from thermoctl.diagnosis.data.outliers import outlier_note
from thermoctl.diagnosis.report.explain import explain
from thermoctl.diagnosis.report.figures import (
    chance,
    error_rows,
    lost_rows,
    merged,
    number,
    outputs,
    remainder_rows,
    short,
    with_interval,
)
from thermoctl.diagnosis.report.notes import unfinished
from thermoctl.diagnosis.report.words import name, sentences, what_next, words

sizes = st.floats(-7, 5).map(lambda power: 10.0**power)
chances = st.floats(0, 1)
LOADED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # on a busy machine, too
NUMBER = r"(-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)"


@st.composite
def effects(draw, doubted=False):
    """A finding, or an alternative that may lack confirmation."""
    start = draw(st.floats(0, 1e4))
    when = draw(st.sampled_from([None, [[start, start + draw(sizes)]]]))
    unit = draw(st.sampled_from(["s", "W", "1", None]))
    value, sd = draw(sizes) * draw(st.sampled_from([1, -1])), draw(st.none() | st.just(0.0) | sizes)
    entry = {
        "effect": draw(st.sampled_from(["radiation", "sensor_lag", "dry_friction"])),
        "where": draw(st.sampled_from(["block", "a-b", "reading"])),
        "probability": draw(chances),
        "confirmed": draw(chances),
        "when": when,
        "equation": "k * T",
        "parameters": {"k_x": {"value": value, "sd": sd, "unit": unit}},
    }
    if doubted and draw(st.booleans()):
        entry["why_not"] = draw(st.sampled_from([UNCONFIRMED, CONTRADICTED]))
    return entry


@st.composite
def laws(draw, alone=False):
    """The law of a remainder."""
    k = {"value": draw(sizes), "sd": draw(st.none() | sizes), "unit": "W"}
    return {
        "from": None,
        "into": "block",
        "part": "flow",
        "expression": "k * T**2",
        "parameters": {"k": k},
        "of": ["T"],
        "where": "block",
        "probability": draw(chances),
        "share_closed": draw(chances),
        "beside": [] if alone else draw(st.lists(laws(alone=True), max_size=1)),
    }


@st.composite
def results(draw):
    """A result as diagnosis.json holds it, with numbers of any size beside any verdict."""
    verdict = draw(
        st.sampled_from(["consistent", "explained", "ambiguous", "partly_explained", "unexplained"])
    )
    named = verdict in ("explained", "partly_explained")
    law = draw(st.none() | laws()) if named else None
    least = 1 if named and not law else 0
    findings = (
        draw(st.lists(effects(), min_size=least, max_size=3)) if named or verdict == "ambiguous" else []
    )
    names = ["reading", "current"][: draw(st.integers(1, 2))]
    noise = {o: draw(sizes) for o in names}
    over = {o: draw(st.floats(0.3, 30)) for o in names}
    left = {o: noise[o] * math.sqrt(max(over[o] ** 2 - 1, 0.0)) for o in names}
    keys = ("before", "refit_only", "after", "held_out_before", "held_out_refit_only", "held_out_after")
    fit = {
        k: {o: draw(sizes if k in ("refit_only", "after") else st.none() | sizes) for o in names}
        for k in keys
    }
    stays = verdict not in ("consistent", "explained") or law
    times = draw(st.lists(st.just([10.0, 20.0]), max_size=4))
    return {
        "verdict": verdict,
        "mismatch": [{"channel": o, "recording": "run_1", "when": times} for o in names],
        "findings": findings,
        "alternatives": draw(st.lists(effects(doubted=True), max_size=4)),
        "remainder": {
            "rms": left,
            "over_noise": over,
            "node": "block",
            "follows": [],
            "law": law,
            "share_closed": draw(chances),
        }
        if stays
        else None,
        "fit": {**fit, "held_out": draw(st.sampled_from(["recordings run_3", "cross-validated: too few"]))},
        "next_experiment": None,
        "decision": {
            "row": "a rule",
            "something": draw(chances),
            "remains": draw(chances),
            "over_noise": 1.0,
        },
        "hypotheses": [],
        "lost": [],
        "refused": [],
        "promised": {},
        "truncated": draw(st.booleans()),
        "outputs": {
            o: {
                "unit": draw(st.sampled_from(["degC", "V", None])),
                "noise": noise[o],
                "step": draw(st.none() | sizes),
            }
            for o in names
        },
        "notes": [],
        "seconds": 1.0,
    }


@LOADED
@given(results())
def test_an_error_falls_or_rises_as_its_numbers_do(found):
    text = " ".join(sentences(found))
    for word, first, second in re.findall(rf"(falls|rises) from {NUMBER}[^;]*? to {NUMBER}", text):
        assert (float(first) > float(second)) is (word == "falls"), text
    assert not re.search(rf"from ({NUMBER}\S*) to \1(?=[ ;]|\.( |$))", text), text
    assert " %" not in text, "a share of energy beside an error says the same twice, or contradicts it"


@LOADED
@given(results())
def test_a_remainder_has_a_size_and_its_measure_beside_it(found):
    text = " ".join(sentences(found))
    rows = {o.name: o for o in outputs(found)}
    for size, output in re.findall(rf"{NUMBER}(?: \w+)? of (\w+) remains that nothing known explains", text):
        assert float(size) > 0 and f"beside {number(rows[output].noise)}" in text
        assert ("and steps of" in text) is (rows[output].left < rows[output].step)
    if "no larger than its noise" in text:
        assert all((o.over_noise or 0) <= 1 for o in rows.values()) and found["decision"]["remains"] >= 0.5
    if "most of it is in run_1 from 10 to 20 s" in text:
        assert found["verdict"] == "unexplained" and 1 <= len(found["mismatch"][0]["when"]) <= 2
    elif found["verdict"] == "unexplained" and " enters at " in text:
        assert len(found["mismatch"][0]["when"]) not in (1, 2)
    if found["verdict"] in ("explained", "consistent"):
        assert "remains" not in text and "Something is missing" not in text
    if "A small systematic error" in text:
        assert all(o.left <= o.noise or o.left < o.step for o in rows.values())
    assert "0" not in {row[3] for row in remainder_rows(found)[1]}


@LOADED
@given(results())
def test_nothing_is_missing_only_where_nothing_is_likely(found):
    text = words(found)
    likely = [a for a in found["alternatives"] if a["probability"] >= 0.05]
    if "nothing is missing" in text or "Nothing has to be done" in text:
        assert found["verdict"] == "consistent" and not likely
    if "may be missing" in text:
        assert likely and "below 0.01" not in text
    ordered = re.search(r"the likeliest first: (.*?)\.(?: |$)", text)
    told = [float(p) for p in re.findall(r"(?<!below )\b(0\.\d\d)\b(?=[;)])", ordered[1])] if ordered else []
    assert told == sorted(told, reverse=True), text
    assert not re.search(r"(probability |\()(1\.00|0\.00)\b", text), "no probability is certain"


@LOADED
@given(results())
def test_terminal_report_and_reasons_show_the_same_digits(found):
    rows = error_rows(found)[1]
    every = {cell for row in rows for cell in row[1:]} | {number(o.step) for o in outputs(found)}
    every |= {number(o.left) for o in outputs(found)}
    told = [
        text
        for text in sentences(found)
        if text.startswith(("With ", "What remains of")) or " remains " in text
    ]
    for text in told:
        plain = re.sub(r"enters at.*", "", text)
        for digits in re.findall(rf"(?<![\w.]){NUMBER}(?= K\b| V\b| of | after|[ ;),]|\.(?!\d))", plain):
            assert digits.rstrip(".") in every, (digits, text, every)


@given(sizes, st.sampled_from([1, -1]), sizes)
def test_a_value_is_rounded_to_its_interval(size, sign, sd):
    text = with_interval(sign * size, sd)
    inner, _, power = text.strip("(").partition(")e")
    value, half = (float(v) * 10.0 ** int(power or 0) for v in inner.split(" ± "))
    assert half == pytest.approx(1.96 * sd, rel=0.06) and half > 0
    assert abs(value - sign * size) <= 0.051 * half + 1e-12 * size
    assert len(re.sub(r"\D", "", inner.split(" ± ")[1]).lstrip("0")) <= 6, text


@given(sizes, sizes)
@LOADED
def test_the_interval_of_a_time_ends_at_zero(value, sd):
    shown = with_interval(value, sd, "s")
    assert (" (0 .. " in shown) == (1.96 * sd > value) and ("±" in shown) != ("(0 .." in shown)
    assert with_interval(value, sd, "W") == with_interval(value, sd)


def test_values_without_an_interval_have_none():
    assert with_interval(0.00393, None) == with_interval(0.00393, 0.0) == "0.00393"
    assert with_interval(0.00392967, 1.8e-7) == "0.00392967 ± 0.00000035"
    assert with_interval(1.2e-9, 1e-10) == "(1.20 ± 0.20)e-9"
    assert with_interval(205.4, 31.0) == "205 ± 61"


@given(st.integers(0, 300), st.integers(1, 200))
def test_refits_are_never_more_than_their_limit(done, most):
    for text in progress(done, most):
        for a, b in re.findall(r"(\d+) of (?:at most )?(\d+)", text):
            assert int(a) <= int(b), text
        assert str(done) in text


def progress(done, most):
    """The line of a search's progress at its last refit."""
    said = []
    budget = Budget(most, said.append, fits_done=max(done - 1, 0))
    if done:
        budget.spend()
    return said


def test_a_refit_below_its_maximum_by_nothing_worries_nobody():
    def fit(left):
        return SimpleNamespace(
            hypothesis=SimpleNamespace(keys=frozenset()),
            fit=SimpleNamespace(converged=False, iterations=9, left=left),
        )

    assert "too small" in unfinished(fit(2.0))[0] and "too small" not in unfinished(fit(1e-4))[0]


def test_what_lost_says_why_and_on_which_side_of_the_result():
    found = {
        "lost": [
            {
                "effect": "creep",
                "where": "v",
                "beside": [],
                "probability": 0.2,
                "below_best": -3.0,
                "reason": "fits better, but",
            },
            {
                "effect": "radiation",
                "where": "b",
                "beside": ["creep at v"],
                "probability": 0.0,
                "below_best": 5.0,
                "reason": "less",
            },
        ],
        "findings": [],
        "refused": [{"effects": ["stick_slip at v"], "reason": "not significant"}],
        "promised": {"creep at v": 9.0, "hysteresis at v": 2.5},
    }
    creep, radiation, stick, promised = lost_rows(found)[1]
    assert (
        creep[3] == "3.0 above the result"
        and radiation[3] == "5.0 below the result"
        and radiation[2] == "below 0.01"
    )
    assert "best beside creep at v" in radiation[1] and stick[1] == "not significant"
    assert promised[0] == "hysteresis at v" and "2.5 nats" in promised[1]


def test_a_note_is_told_once_and_outliers_with_their_places():
    assert merged(["a", "b", "a", "a"]) == ["a (3 times)", "b"]
    text = outlier_note((("run_1", "T", (1.0, 2.5)), ("run_2", "T", tuple(range(9)))))
    assert (
        text
        == "11 single outliers were left out: T in run_1 at 1, 2.5 s; T in run_2 at 0, 1, 2, 3, 4, 5 and 3 more s"
    )
    assert outlier_note((("run_1", "T", (1.0,)),)).startswith("1 single outlier was left out")


def test_a_parameter_is_shown_without_its_place():
    assert short("ALPHA_copper_resistance_a_b", {"effect": "copper_resistance", "where": "a-b"}) == "ALPHA"
    assert short("G_12", {"effect": "copper_resistance", "where": "a-b"}) == "G_12"
    spill = {
        "effect": "overflow",
        "where": "top",
        "equation": "max(top - HMAX_overflow_top, 0) * A * A_overflow_top",
    }
    assert [short(f"{n}_overflow_top", spill) for n in ("HMAX", "A")] == ["HMAX", "A_overflow_top"]


@given(st.lists(st.floats(-50, 50), min_size=5, max_size=30), st.floats(0.01, 3))
def test_the_fit_in_percent_is_that_of_matlab(y, off):
    import numpy as np

    y = np.array(y)
    e = off * np.cos(np.arange(len(y)))
    c = Curve("r", "o", "degC", False, np.arange(len(y)), y, {"after": e})
    spread = np.linalg.norm(y - y.mean())
    if spread == 0:
        assert c.fit_percent("after") is None
    else:
        yhat = y - e
        assert c.fit_percent("after") == pytest.approx(
            100 * (1 - np.linalg.norm(y - yhat) / spread), rel=1e-9, abs=1e-9
        )
    assert c.fit_percent("before") is None


@LOADED
@given(results())
def test_every_result_is_printed(found):
    import contextlib
    import io

    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        summary(found, "out")
    assert what_next(found)[:30] in out.getvalue().replace("\n", " ") and explain(found)
    assert all(chance(a["probability"]) in out.getvalue() for a in found["alternatives"])


@pytest.mark.parametrize(("end", "text"), [(899.5, "from 499.5 s to 899.5 s"), (1600.0, "from 499.5 s on")])
def test_an_effect_that_ends_says_when(end, text):
    times = {"T0": {"value": 499.5, "sd": 1.0, "unit": "s"}, "T1": {"value": 899.5, "sd": 1.0, "unit": "s"}}
    lamp = {"effect": "heat_source", "where": "two", "when": [[499.5, end]], "parameters": times}
    assert name(lamp) == f"heat source {text} at two"
    assert name({**lamp, "recording": "day2", "lasts": False}) == f"heat source in day2 {text} at two"
    stays = text.replace(" s on", " s of day2 on") if " on" in text else f"in day2 {text}"
    assert name({**lamp, "recording": "day2", "lasts": True}) == f"heat source {stays} at two"
