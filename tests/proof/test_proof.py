"""The proof's own machinery: figures checked by hand, sealed answers, resuming, a worker that dies."""

from __future__ import annotations

import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.proof import score, statistics, summary, tables
from tests.proof.cases import find_jobs, read_answers
from tests.proof.prove import prove
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.batch import run_all, run_one
from thermoctl.fleet.jobs import program_files


def finding(effect: str, where: str, probability: float, **more) -> dict:
    return {
        "effect": effect,
        "where": where,
        "probability": probability,
        "when": None,
        "parameters": {},
    } | more


def result(verdict: str, findings=(), alternatives=(), **fit) -> dict:
    return {"verdict": verdict, "findings": list(findings), "alternatives": list(alternatives), "fit": fit}


def answer(*effects, **more) -> dict:
    verdict = "consistent" if not effects else "unexplained" if effects[0][0] == "?" else "explained"
    return {"verdict": verdict, "effects": [list(e) for e in effects], "nearly_the_same": []} | more


NONE = result("consistent")


def test_wilson_interval_is_the_textbook_one():
    """Newcombe (1998), table I: 81/263 -> 0.2553..0.3662, 0/20 -> 0..0.1611, 15/148 -> 0.0624..0.1605."""
    assert statistics.Share(81, 263).interval() == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert statistics.Share(0, 20).interval() == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert statistics.Share(15, 148).interval() == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert statistics.Share(0, 0).value is None


def test_reliability_by_hand():
    """Bins 0.9: (0.9 + 0.98)/2 given, 1 of 2 right; 0.2: 0.2 given, 0 of 1; 1.0 goes into the last bin."""
    table, ece = statistics.reliability([(0.92, True), (0.98, False), (0.2, False), (1.0, True)])
    assert [b["n"] for b in table] == [1, 3]
    assert table[1]["probability"] == pytest.approx((0.92 + 0.98 + 1) / 3) and table[1][
        "right"
    ] == pytest.approx(2 / 3)
    assert ece == pytest.approx((1 * 0.2 + 3 * (2.9 / 3 - 2 / 3)) / 4)


def test_exact_name_at_the_right_place():
    row = score.score(
        "1", answer(("radiation", "a"), band="large"), result("explained", [finding("radiation", "a", 0.97)])
    )
    assert (
        row.detected
        and row.named
        and row.exact
        and row.alike
        and row.placed
        and row.inside
        and row.called == "radiation"
    )
    row = score.score("1", answer(("radiation", "a")), result("explained", [finding("radiation", "b", 0.97)]))
    assert row.exact and row.placed is False and row.calibration == [(0.97, False)]


def test_links_may_be_named_in_either_order_but_not_heat_splits():
    for effect, right in (("missing_link", True), ("bending", True), ("heat_split", False)):
        row = score.score("1", answer((effect, "a-b")), result("explained", [finding(effect, "b-a", 0.9)]))
        assert row.placed is right


def test_a_name_that_the_data_cannot_tell_counts_as_its_class_only():
    told = answer(("radiation", "a")) | {"nearly_the_same": ["natural_convection"]}
    row = score.score("1", told, result("explained", [finding("natural_convection", "a", 0.8)]))
    assert not row.exact and row.alike and row.placed and row.inside and not row.inside_exact
    assert row.calibration == [(0.8, False)]  # of explanations that exclude each other one is true


def test_the_true_name_among_the_alternatives_is_inside_the_set():
    row = score.score(
        "1",
        answer(("radiation", "a")),
        result(
            "ambiguous",
            [finding("sensor_gain", "y", 0.6)],
            [finding("radiation", "a", 0.3), finding("sensor_gain", "z", 0.1)],
        ),
    )
    assert row.inside and not row.alike and row.placed is None and row.set_size == 2
    assert row.calibration == [(0.6, False), (0.3, True), (0.1, False)]


def test_pairs_need_both():
    told = answer(("a", "x"), ("b", "y"))
    both = score.score("1", told, result("explained", [finding("b", "y", 0.9), finding("a", "x", 0.9)]))
    one = score.score("1", told, result("explained", [finding("a", "x", 0.9)]))
    double = score.score("1", told, result("explained", [finding("a", "x", 0.9), finding("a", "y", 0.9)]))
    assert both.exact and both.inside and not one.exact and not one.inside and not double.alike
    assert both.kind == "pair"


def test_a_small_misfit_of_the_open_world_that_the_catalogue_has_is_no_stray():
    told = answer(("radiation", "a")) | {"world": "open", "misfits": [["slow reference", "y"], ["bend", "z"]]}
    found = [finding(*n, 0.95) for n in (("radiation", "a"), ("sensor_lag", "y"), ("sensor_lag", "z"))]
    both, wrong = (score.score("1", told, result("partly_explained", found[:n])) for n in (2, 3))
    assert (both.strays, both.of_misfits, both.alike) == (0, 1, True)
    assert (wrong.strays, wrong.of_misfits, wrong.alike) == (1, 1, False)
    none = score.score("2", told | {"effects": []}, result("explained", found[1:2]))
    content = summary.summary([both, wrong, none])["open_world"]
    assert content["shares"]["nothing_named_where_nothing_is"]["share"] == 1.0
    assert content["figures"]["names_of_misfits"] == 3


def test_in_the_open_world_strays_count_and_a_partly_explained_name_is_a_name():
    told = answer(("radiation", "a"), band="large") | {"world": "open"}
    found = [finding("radiation", "a", 0.97), finding("sensor_drift", "y", 0.7)]
    rows = [
        score.score("1", told, result("partly_explained", found[:1])),
        score.score("2", told, result("partly_explained", found)),
        score.score("3", answer() | {"world": "open"}, result("unexplained")),
        score.score("4", answer(), result("consistent")),
    ]
    content = summary.summary(rows)
    assert content["figures"]["cases"] == 1 and content["open_world"]["cases"] == 3
    shares = content["open_world"]["shares"]
    assert (shares["named_and_placed"]["k"], shares["named_and_placed"]["n"]) == (1, 2)
    assert shares["nothing_named_where_nothing_is"]["share"] == 1.0
    assert content["open_world"]["figures"]["strays_per_diagnosis"] == pytest.approx(1 / 3)
    goals = content["open_world"]["goals"]
    assert not goals["strays_per_diagnosis"]["reached"] and goals["nothing_named_where_nothing_is"]["reached"]
    told_as = {line[0]: line[1:] for line in tables.lines(content)}
    assert told_as["open world: strays per diagnosis"] == ("0.333", "", "3", "≤ 0.1", False)
    assert told_as["open world: named and placed"][2:] == ("1/2", "≥ 90 %", False)


def test_unknown_and_failed():
    assert score.score("1", answer(("?", "a")), result("unexplained")).called == "unknown"
    row = score.score("1", answer(("?", "a")), result("explained", [finding("radiation", "a", 0.95)]))
    assert row.confident and row.verdict == "explained" and row.kind == "unknown"
    row = score.score("1", answer(("radiation", "a")), None, error="boom")
    assert row.called == "failed" and not row.detected and row.inside is False


def test_onset_gain_and_parameters_by_hand():
    told = answer(
        ("conductance_step", "f"),
        onset=1000.0,
        oracle_rms={"y": 0.1, "z": 1.0},
        parameters=[{"A": -0.5, "T0": 1000.0}],
    )
    row = score.score(
        "1",
        told,
        result(
            "explained",
            [
                finding(
                    "conductance_step",
                    "f",
                    0.9,
                    when=[[1040.0, 2000.0]],
                    parameters={"A_f": {"value": -0.45, "sd": 0.02}, "T0_f": {"value": 1040.0, "sd": 30.0}},
                )
            ],
            held_out_refit_only={"y": 0.3, "z": 1.0},
            held_out_after={"y": 0.2, "z": 1.0},
        ),
        duration_s=2000.0,
    )
    assert row.onset_error == pytest.approx(0.02)
    assert row.gain == pytest.approx((5.0 - 2.5) / (5.0 - 1.0))  # mean of (3^2, 1) and of (2^2, 1)
    assert [(p["parameter"], round(p["error"], 6), p["covered"]) for p in row.parameters] == [
        ("A", 0.1, False),
        ("T0", 0.04, True),
    ]


def test_summary_of_a_hand_made_set():
    rows = [
        score.score(str(i), a, r, 10.0 * (i + 1))
        for i, (a, r) in enumerate(
            [
                (answer(kind="none"), NONE),
                (
                    answer(kind="none"),
                    result("explained", [finding("sensor_drift", "y", 0.9)]),
                ),  # false alarm
                (
                    answer(("radiation", "a"), kind="one", band="large"),
                    result("explained", [finding("radiation", "a", 0.9)]),
                ),
                (answer(("radiation", "a"), kind="one", band="large"), NONE),  # missed
                (
                    answer(("sensor_lag", "y"), kind="one", band="small"),
                    result("explained", [finding("sensor_gain", "y", 0.9)]),
                ),
                (answer(("?", "a"), kind="unknown"), result("unexplained")),
                (answer(("?", "a"), kind="unknown"), result("explained", [finding("radiation", "a", 0.95)])),
            ]
        )
    ]
    s = summary.summary(rows)
    assert s["shares"]["false_alarms"] == {
        "k": 1,
        "n": 2,
        "share": 0.5,
        "low": pytest.approx(0.0945, abs=1e-4),
        "high": pytest.approx(0.9055, abs=1e-4),
    }
    assert s["figures"]["detected_large"] == 0.5 and s["figures"]["detected_small"] == 1.0
    assert s["figures"]["detected_middle"] is None and s["goals"]["detected_middle"]["reached"] is None
    assert s["shares"]["right_when_named"]["k"] == 1 and s["shares"]["right_when_named"]["n"] == 4
    assert s["figures"]["unknown_called_unknown"] == 0.5 and s["figures"]["confidently_misnamed"] == 0.5
    assert s["figures"]["inside_the_set"] == 0.5 and s["figures"]["cpu_s_longest"] == 70.0
    assert s["goals"]["cpu_s_longest"]["reached"] is True and s["goals"]["false_alarms"]["reached"] is False
    assert s["confusion"]["radiation"] == {"radiation": 1, "none": 1} and s["confusion"]["unknown"] == {
        "unknown": 1,
        "radiation": 1,
    }
    assert s["by_effect"]["radiation"]["exact"] == 1
    assert s["found_by_size"] == dict.fromkeys(("all", "white", "coloured", "learnt"))


def test_the_size_found_half_of_the_time_is_that_of_scipy_and_its_interval_holds_the_truth():
    from scipy.optimize import minimize

    rng, held = np.random.default_rng(3), 0
    for _ in range(60):
        sizes = np.exp(rng.uniform(np.log(3), np.log(40), 120))
        found = rng.random(120) < 1 / (1 + (6 / sizes) ** 4)
        curve = statistics.found_by_size(sizes.tolist(), found.tolist())
        assert curve is not None
        held += curve["low"] <= 6 <= curve["high"]

        def against(v, sizes=sizes, found=found):
            odds = v[1] * (np.log(sizes) - v[0])
            return np.logaddexp(0, np.where(found, -odds, odds)).sum()

        best = minimize(against, [np.log(6), 4], method="Nelder-Mead")
        assert curve["half"] == pytest.approx(np.exp(best.x[0]), rel=0.03)
    assert held >= 52  # of 57 in the mean
    assert (
        statistics.found_by_size([5.0] * 20, [True] * 20) is None
        and statistics.found_by_size([3.0, 9.0], [False, True]) is None
    )


def test_a_kept_result_is_of_the_integrator_too_and_not_of_what_scores_it():
    names = {f.name for f in program_files()}
    assert {"integrator.h", "refit.py", "beam.py", "radiation.yaml"} <= names
    assert "score.py" not in names


# --- running -------------------------------------------------------------------------------------------------------------
def a_set(folder: Path, names=("a", "b", "c", "d")) -> Path:
    for name in names:
        (folder / name).mkdir(parents=True)
        (folder / name / "plant.yaml").write_text(f"title: {name}\n")
        (folder / name / "run_1.csv").write_text("t,y\n0,1\n")
    return folder


def fake(job, out: str) -> dict:
    """A stand-in for the diagnosis of `job`: writes what run_one writes. The worker of case `b` is killed once."""
    marker = Path(out).parent / "died"
    if job.name == "b" and not marker.exists():
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.write_text("once")
        os.kill(os.getpid(), signal.SIGKILL)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder.parent / "log", "a") as f:
        f.write(job.name + "\n")
    told = {"name": job.name, "fingerprint": job.fingerprint(), "cpu_s": 1.0, "error": None}
    (folder / "diagnosis.json").write_text(json.dumps(result("consistent")))
    (folder / "run.json").write_text(json.dumps(told))
    return told


@pytest.mark.slow
def test_a_killed_worker_loses_nothing_and_done_cases_are_not_run_again(tmp_path):
    import cloudpickle

    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the workers need not find this file
    jobs = find_jobs(a_set(tmp_path / "cases"))
    seen = []
    assert (
        run_all(jobs, tmp_path / "out/cases", workers=2, task=fake, progress=lambda *x: seen.append(x[:2]))
        == 4
    )
    assert (tmp_path / "out/cases/died").exists()
    assert sorted(set((tmp_path / "out/cases/log").read_text().split())) == ["a", "b", "c", "d"]
    assert [count for count, _ in seen] == [1, 2, 3, 4]
    assert run_all(jobs, tmp_path / "out/cases", workers=1, task=fake) == 0
    Path(jobs[2].recordings[0]).write_text("t,y\n0,2\n")  # other data: only this one again
    assert run_all(jobs, tmp_path / "out/cases", workers=1, task=fake) == 1


def dies_once(job, out: str) -> dict:
    """The real diagnosis, in a worker that is killed in the middle of its first case."""
    marker = Path(out).parent / "died"
    if not marker.exists():
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return run_one(job, out)


@contextmanager
def a_dask_by_hand(folder: Path):
    """A scheduler and two workers as one starts them on three machines: (address, worker processes)."""
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "env": {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    }  # the task of this file must be found there
    file = folder / "scheduler.json"
    command = f"{sys.executable} -m dask scheduler --host 127.0.0.1 --port 0 --no-dashboard --scheduler-file {file}".split()
    started = [subprocess.Popen(command, **quiet)]
    try:
        limit = time.monotonic() + 120
        while not file.exists() or not file.read_text():
            assert time.monotonic() < limit and started[0].poll() is None, "no scheduler"
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        worker = f"{sys.executable} -m dask worker {address} --no-nanny --nthreads 1 --no-dashboard".split()
        started += [subprocess.Popen([*worker, "--local-directory", str(folder)], **quiet) for _ in range(2)]
        yield address, started[1:]
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.wait(30)


@pytest.mark.slow
def test_a_remote_scheduler_loses_nothing_when_one_of_two_workers_is_killed(tmp_path):
    """tcp:// scheduler, two workers started by hand, one killed during a case: every case is diagnosed, by the other worker."""
    from distributed import Client

    from tests.concealed import generate

    generate.main(f"--out {tmp_path / 'cases'} --number 3 --families tanks --kind none --smoke".split())
    jobs = find_jobs(tmp_path / "cases")
    with a_dask_by_hand(tmp_path) as (address, workers):
        with Client(address) as client:
            client.wait_for_workers(2, timeout=120)
        told = []
        assert (
            run_all(
                jobs,
                tmp_path / "out/cases",
                scheduler=address,
                task=dies_once,
                progress=lambda *x: told.append(x[2]),
            )
            == 3
        )
        assert [x["error"] for x in told] == [None] * 3
        assert sorted(w.poll() for w in workers if w.poll() is not None) == [
            -signal.SIGKILL
        ]  # one is dead, one lives
    assert (tmp_path / "out/cases/died").exists()
    content = prove(
        tmp_path / "cases", tmp_path / "out", tmp_path / "cases_answers", workers=1
    )  # nothing is run again
    assert content["figures"]["cases"] == 3 and content["figures"]["failed"] == 0


@pytest.mark.slow
def test_diagnose_over_a_folder_of_rigs(tmp_path, capsys):
    """Two rigs of one plant, one file that cannot be read: each rig by itself, through Dask, the bad one told."""
    from tests.concealed import generate
    from thermoctl.cli import main

    generate.main(f"--out {tmp_path / 'c'} --number 1 --families tanks --kind none --smoke --seed 4".split())
    case = tmp_path / "c" / "0001"
    for rig in ("north", "south"):
        (tmp_path / "fleet" / rig).mkdir(parents=True)
        for run in ("run_1.csv", "run_2.csv"):
            (tmp_path / "fleet" / rig / run).write_bytes((case / run).read_bytes())
    (tmp_path / "fleet" / "east").mkdir()
    (tmp_path / "fleet" / "east" / "bad.csv").write_text("t,pump\n0,1\n0,2\n")
    words = f"diagnose {tmp_path / 'fleet'} --plant {case / 'plant.yaml'} --out {tmp_path / 'out'}".split()
    with a_dask_by_hand(tmp_path) as (address, _):
        assert main([*words, "--scheduler", address, "--json"]) == 0
    told = {x["rig"]: x for x in json.loads(capsys.readouterr().out)}
    assert set(told) == {"north", "south", "east"}
    assert told["east"]["verdict"] is None and "bad.csv" in told["east"]["error"]
    assert (
        told["north"]["verdict"]
        == told["south"]["verdict"]
        == json.loads((tmp_path / "out/north/diagnosis.json").read_text())["verdict"]
    )
    assert len(told["north"]["recordings"]) == 2 and (tmp_path / "out/south/report.html").exists()
    before = (tmp_path / "out/north/run.json").stat().st_mtime_ns
    assert main([*words, "--workers", "2", "--quiet"]) == 0
    assert (tmp_path / "out/north/run.json").stat().st_mtime_ns == before  # done rigs are not run again


def test_answers_apart_must_be_the_sealed_ones(tmp_path):
    jobs = find_jobs(a_set(tmp_path / "cases", ("a",)))
    answers = tmp_path / "answers"
    answers.mkdir()
    with pytest.raises(InputError, match="no answer for case a"):
        read_answers(jobs, answers)
    text = "verdict: consistent\neffects: []\nnearly_the_same: []\n"
    (answers / "a.yaml").write_text(text)
    (answers / "manifest.sha256").write_text(f"{hashlib.sha256(text.encode()).hexdigest()}  a.yaml\n")
    assert read_answers(jobs, answers)["a"]["verdict"] == "consistent"
    (answers / "a.yaml").write_text(text.replace("consistent", "explained"))
    with pytest.raises(InputError, match="not the one that was sealed"):
        read_answers(jobs, answers)


def test_folders_without_cases_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        find_jobs(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no case in it"):
        find_jobs(tmp_path)
    (tmp_path / "x").mkdir()
    (tmp_path / "x/plant.yaml").write_text("")
    with pytest.raises(InputError, match="without a recording"):
        find_jobs(tmp_path)


def test_the_table_holds_the_figures():
    rows = [
        score.score(
            "case<1>",
            answer(("radiation", "a"), kind="one", band="large", family="heater"),
            result("explained", [finding("sensor_gain", "y", 0.9)]),
            12.0,
        )
    ]
    content = {"version": "0", "commit": "abc", **summary.summary(rows)}
    from rich.console import Console

    console = Console(record=True, width=160, file=io.StringIO())
    console.print(tables.table(content))
    assert "100.0 %" in console.export_text()


def test_smoke_set_is_diagnosed_and_scored(tmp_path):
    """A few concealed cases through the real diagnosis: no failure, nothing-missing is not alarmed, the rest detected."""
    from tests.concealed import generate

    for kind, first, family in (("none", 1, "tanks"), ("one", 0, "heater")):
        generate.main(
            (
                f"--out {tmp_path / 'cases'} --answers {tmp_path / 'answers'} --first {first} --number 1 "
                f"--seed 33 --smoke --families {family} --kind {kind}"
            ).split()
        )
    content = prove(tmp_path / "cases", tmp_path / "out", tmp_path / "answers", workers=1)
    assert content["figures"]["failed"] == 0 and content["figures"]["cases"] == 2
    assert content["figures"]["false_alarms"] == 0
    assert content["figures"]["detected"] == 1
    assert json.loads((tmp_path / "out/proof.json").read_text())["rows"][0]["case"]
    assert prove(tmp_path / "cases", tmp_path / "out", tmp_path / "answers")["rows"] == content["rows"]


@pytest.mark.slow
def test_bench_counts_a_peer_by_the_same_scoring(tmp_path, capsys):
    """A peer on two cases with nothing missing: what it says is scored, kept, and not computed again."""
    import importlib.util

    path = Path(__file__).parents[1] / "bench" / "diagnosis.py"
    spec = importlib.util.spec_from_file_location("bench_diagnosis", path)
    bench = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bench)
    from tests.concealed import generate

    cases = str(tmp_path / "cases")
    generate.main(
        f"--out {cases} --answers inside --number 2 --families tanks,heater --kind none --smoke".split()
    )
    argv = [cases, "--methods", "bic", "--out", str(tmp_path)]
    assert bench.main(argv) == 0
    found = json.loads((tmp_path / "figures.json").read_text())["bic"]
    assert found["cases"] == 2 and found["failed"] == 0
    assert found["detected"] == [0, 0] and found["false_alarms"][1] == 2
    kept = sorted((tmp_path / "bic").glob("*.json"))
    told = json.loads(kept[0].read_text())
    assert (told["result"]["verdict"] == "explained") == bool(told["result"]["findings"])
    kept[0].write_text(json.dumps(told | {"cpu_s": 123.0}))
    assert bench.main(argv) == 0  # kept results are taken
    assert json.loads((tmp_path / "figures.json").read_text())["bic"]["cpu_s_longest"] == 123.0
