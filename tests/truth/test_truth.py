"""How `make truth` judges: hand-made cases, results and changes."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import yaml

from tests.proof.recordings import VARIABLE
from tests.truth import __main__ as truth
from tests.truth import ablate, judge, run
from tests.truth import cases as made
from tests.truth.ablate import RULES, left_out, part_of
from tests.truth.forms import changed
from thermoctl.diagnosis.limits import limits


def result(verdict: str, *names: tuple[str, str, float]) -> dict:
    findings = [
        {"effect": e, "where": w, "probability": p, "when": None, "parameters": {}} for e, w, p in names
    ]
    return {"verdict": verdict, "findings": findings, "alternatives": [], "fit": {}}


def a_case(folder, answer: dict, kind=made._foreign):
    folder.mkdir(parents=True)
    (folder / "plant.yaml").write_text("title: none\n")
    for run_file in ("run_1.csv", "run_2.csv"):
        (folder / run_file).write_text("t,y\n0,1\n")
    (folder / "answer.yaml").write_text(yaml.safe_dump(answer))
    return kind(folder)


def test_names_of_other_peoples_systems_are_right_at_their_place_only(tmp_path):
    answer = {
        "verdict": ["explained"],
        "named": [[["a", "b"], "x"], ["missing_link", "p-q"]],
        "held_out": "run_2.csv",
    }
    case = a_case(tmp_path / "two", answer)
    assert [case.judge(n) for n in (("b", "x"), ("b", "y"), ("missing_link", "q-p"))] == [
        "right",
        "stray",
        "right",
    ]
    assert [p.rsplit("/")[-1] for p in (*case.job.recordings, *case.job.held_out)] == [
        "run_1.csv",
        "run_2.csv",
    ]


def test_a_generated_case_takes_an_equivalent_name_and_is_a_trap_without_an_effect(tmp_path):
    answer = {
        "verdict": "explained",
        "effects": [["radiation", "a"]],
        "nearly_the_same": ["natural_convection"],
        "kind": "one",
    }
    case = a_case(tmp_path / "0001", answer, lambda f: made._generated("closed", f"closed-{f.name}", f))
    assert [case.judge(n) for n in (("natural_convection", "a"), ("radiation", "b"))] == ["right", "stray"]
    strange = {"verdict": "unexplained", "effects": [["?", "a"]], "nearly_the_same": [], "kind": "unknown"}
    trap = a_case(tmp_path / "0002", strange, lambda f: made._generated("closed", f"closed-{f.name}", f))
    assert not trap.wanted and trap.judge(("radiation", "a")) == "stray"


def test_other_forms_of_a_case_are_coarse_or_late_and_keep_the_answer(tmp_path):
    """A ramp of 1 V/s every 0.1 s, with one reading lost."""
    case = a_case(tmp_path / "closed" / "0001", {}, lambda folder: folder)
    (case / "run_2.csv").unlink()
    outputs = {"ramp": {"value": "x", "column": "V", "noise": 0.05, "resolution": 0.03}}
    (case / "plant.yaml").write_text(yaml.safe_dump({"outputs": outputs}))
    t = np.arange(50) / 10
    lines = [f"{a},{'' if k == 7 else a}" for k, a in enumerate(t)]
    (case / "run_1.csv").write_text("\n".join(["t,V", *lines]) + "\n")
    read = {}
    for form in ("coarse", "late"):
        folder = changed(case, form)
        assert folder == tmp_path / f"closed-{form}" / "0001" and (folder / "answer.yaml").exists()
        read[form] = np.genfromtxt(folder / "run_1.csv", delimiter=",", skip_header=1)
        assert np.array_equal(read[form][:, 0], t) and np.flatnonzero(np.isnan(read[form][:, 1])) == [7]
    step = yaml.safe_load((tmp_path / "closed-coarse/0001/plant.yaml").read_text())["outputs"]["ramp"][
        "resolution"
    ]
    assert step == pytest.approx(0.21)  # the least multiple of 0.03 from four times 0.05
    seen = np.delete(read["coarse"], 7, axis=0)
    assert (
        np.allclose(seen[:, 1] / step, np.round(seen[:, 1] / step))
        and np.abs(seen[:, 1] - seen[:, 0]).max() <= 0.105
    )
    after = np.delete(read["late"][:-1], 7, axis=0)
    ahead = after[:, 1] - after[:, 0]
    assert 0 <= ahead.min() < 0.005 and 0.015 < ahead.max() <= 0.02


def test_a_case_whose_input_is_logged_a_row_late_wants_that_to_be_named(tmp_path):
    answer = {"verdict": "explained", "effects": [["radiation", "a"]], "nearly_the_same": [], "kind": "one"}
    case = a_case(tmp_path / "closed" / "0001", answer, lambda folder: folder)
    (case / "run_2.csv").unlink()
    inputs = {"air": {"unit": "degC", "between_samples": "linear"}, "power": {"unit": "W", "column": "P"}}
    (case / "plant.yaml").write_text(yaml.safe_dump({"inputs": inputs, "outputs": {"y": {"noise": 1}}}))
    (case / "run_1.csv").write_text("t,P,air,y\n" + "".join(f"{k},{k}.5,{k},{k}\n" for k in range(5)))
    folder = changed(case, "row")
    rows = np.genfromtxt(folder / "run_1.csv", delimiter=",", skip_header=1)
    k = np.arange(5.0)
    assert np.array_equal(rows, np.column_stack([k, [0.5, 0.5, 1.5, 2.5, 3.5], k, k]))
    late = made._generated("closed", "closed-row-0001", folder)
    names = [("radiation", "a"), ("sensor_advance", "power"), ("sensor_advance", "air")]
    assert [late.judge(n) for n in names] == ["right", "right", "stray"] and len(late.wanted) == 2


def test_figures_of_a_hand_made_group(tmp_path):
    one = a_case(tmp_path / "one", {"named": [["a", "x"]]})
    trap = a_case(tmp_path / "trap", {"named": []})
    rows = [
        judge.row(one, result("explained", ("a", "x", 0.995), ("b", "x", 0.95)), 4.0, None),
        judge.row(one, result("ambiguous", ("a", "x", 0.6)), 2.0, None),
        judge.row(trap, result("explained", ("c", "x", 0.97)), 3.0, None),
        judge.row(trap, result("explained", ("c", "x", 0.5)), 1.0, None),
        judge.row(trap, None, 0.0, "ValueError: no"),
    ]
    told = judge.figures(rows)
    assert told["right names"].startswith("1/2 ") and told["traps refused"].startswith("2/3 ")
    assert (told["strays at 0.9"], told["strays"], told["failed"]) == ("2", "3", "1")
    assert told["not wrong at 0.99"].startswith("1/1 ") and told["not wrong at 0.9"].startswith("1/3 ")
    assert (told["CPU s, mean"], told["longest"]) == ("2.00", "4.0")
    assert float(told["log score"]) == pytest.approx(-1.54, abs=0.006)  # of 0.995, 0.05, 0.6, 0.03, 0.5


def test_what_changed_is_told_by_case(tmp_path):
    case = a_case(tmp_path / "one", {"named": [["a", "x"], ["d", "x"]]})

    def rows(verdict, *names):
        return {"one": judge.row(case, result(verdict, *names), 1.0, None)}

    old = rows("explained", ("a", "x", 0.95), ("b", "x", 0.99))
    new = rows("ambiguous", ("d", "x", 0.9), ("c", "x", 0.9), ("b", "x", 0.5))
    assert [(kind, what.split()[0]) for _, kind, what in judge.changes(old, new)] == [
        ("named", "d"),
        ("lost", "a"),
        ("false", "c"),
        ("cleared", "b"),
        ("verdict", "explained"),
    ]
    assert list(judge.changes(old, old)) == []


def test_the_command_compares_with_the_older_result(tmp_path, monkeypatch, capsys):
    """Folders that are missing are said; a stored result and the new one stand side by side."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv(made.FOREIGN, str(tmp_path / "systems"))
    case = a_case(tmp_path / "systems" / "one", {"named": [["a", "x"]]})

    def diagnosed(jobs, out, task, **how):
        for job in jobs:
            folder = out / job.name
            folder.mkdir(parents=True, exist_ok=True)
            run._write(folder / "diagnosis.json", result("explained", ("a", "x", 0.97)))
            run._write(folder / "run.json", {"name": job.name, "error": None, "cpu_s": 3.0})

    monkeypatch.setattr(truth, "run_all", diagnosed)
    before = judge.row(case, result("consistent"), 6.0, None)
    (tmp_path / "old.json").write_text(
        json.dumps({"commit": "abc", "date": "2026-01-01", "cases": {"one": before}})
    )
    words = ["--only", "home,foreign", "--out", str(tmp_path / "out"), "--old", str(tmp_path / "old.json")]
    assert truth.main(words) == 0
    printed = capsys.readouterr()
    assert f"without real rigs: {VARIABLE}" in printed.err
    assert "- one: *named* a at x (0.970)" in printed.out and "consistent -> explained" in printed.out
    assert printed.out.count("| other people's systems |") == 2


@pytest.mark.parametrize("name", RULES)
def test_a_rule_names_a_part_of_the_program_and_comes_back(name):
    rule = RULES[name]
    assert rule.without or rule.limits
    dataclasses.replace(limits(), **rule.limits)
    with left_out(rule):
        inside = [part_of(path) for path in rule.without]
    assert inside == [*rule.without.values()]
    assert all(part_of(path) != other for path, other in rule.without.items())


def test_rules_can_be_left_out_by_a_command_of_the_same_words_as_make_truth(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv(made.FOREIGN, raising=False)
    assert ablate.main(["--only", "foreign", "--number", "2", "--out", str(tmp_path)]) == 2
    assert "run make truth first" in capsys.readouterr().err
