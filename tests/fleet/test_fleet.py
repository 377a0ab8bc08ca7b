"""Fleet: three rigs over five months, made by a plant: one well, one that drifts, one with a body more."""

import json
import math

import numpy as np
import pytest

from thermoctl.cli import main
from thermoctl.fleet.health import summarise
from thermoctl.fleet.trend import drift, judge
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

PLANT = """
format: thermoctl-plant/1
title: A heated body
inputs:
  power: {unit: W, column: power_w}
  air: {unit: degC, column: air_c}
parameters:
  C: {value: 40, unit: J/K, range: [10, 160]}
  H: {value: 0.5, unit: W/K, range: [0.1, 2]}
nodes:
  body: {unit: degC, storage: C, initial: air}
flows:
  heating: {into: body, rate: power, unit: W}
  loss: {from: body, rate: H * (body - air), unit: W}
outputs:
  body_c: {value: body, unit: degC, noise: 0.05}
"""
MONTH_S = 30 * 86400.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("fleet")
    (root / "plant.yaml").write_text(PLANT)
    model = compile_plant(load(root / "plant.yaml"), ())
    random = np.random.default_rng(3)
    t = np.arange(0.0, 1800.0, 5.0)
    power = np.where((t // 300) % 2 == 0, 3.0, 0.5)
    for rig in ("well", "drifting", "changed"):
        (root / "data" / rig).mkdir(parents=True)
        for month in range(5):
            given = Table("x", "x", t, {"power_w": power, "air_c": np.full(len(t), 22.0)})
            H = 0.5 * (1 - 0.08 * month) if rig == "drifting" else 0.5
            y = model.simulate(given, {"H": H}).y[:, 0] + 0.05 * random.standard_normal(len(t))
            if rig == "changed" and month == 4:
                y += 1.5 * np.sin(t / 90.0)
            columns = {
                **given.columns,
                "body_c": y,
                "wall_s": 1.8e9 + month * MONTH_S + t,
                "state": np.full(len(t), 3.0),
                "fault_bits": np.zeros(len(t)),
            }
            write_table(root / "data" / rig / f"{month}.parquet", Table("x", "x", t, columns))
    return root


def test_what_is_said_of_three_rigs(folder, capsys):
    plant = str(folder / "plant.yaml")
    assert main(["fleet", str(folder / "data"), "--plant", plant, "--parameters", "C,H", "--json"]) == 1
    rigs = {r["name"]: r for r in json.loads(capsys.readouterr().out)}
    assert rigs["well"]["advice"] == []
    assert [s["misfit"] < 1.2 for s in rigs["well"]["summaries"]] == [True] * 5
    H = rigs["drifting"]["drifts"]["H"]
    assert (
        H["drifts"]
        and H["per_month"] == pytest.approx(-0.04, rel=0.1)
        and not rigs["drifting"]["drifts"]["C"]["drifts"]
    )
    said = " ".join(rigs["drifting"]["advice"])
    assert "H drifts by -0.0" in said and "identify again" in said
    said = " ".join(rigs["changed"]["advice"])
    assert "thermoctl diagnose" in said and "4.parquet" in said
    assert (
        main(["fleet", str(folder / "data"), "--plant", plant]) == 1
        and "no longer fits" in capsys.readouterr().out
    )


def test_files_that_are_bad_do_not_stop_the_others(folder, capsys, tmp_path):
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig" / "bad.csv").write_text("t,x\n0,1\n0,2\n")
    (tmp_path / "rig" / "good.csv").write_text("t,state,fault_bits\n0,3,0\n1,3,0\n2,1,0\n")
    assert main(["fleet", str(tmp_path)]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "stands twice" in out and "67 %" in out
    for words in ([str(tmp_path / "none")], [str(folder / "data"), "--parameters", "H"]):
        assert main(["fleet", *words]) == 2
    assert (
        main(["fleet", str(folder / "data"), "--plant", str(folder / "plant.yaml"), "--parameters", "G"]) == 2
    )
    assert "no parameter 'G' with a range" in capsys.readouterr().err
    lost = summarise(str(tmp_path / "none.csv"), None, ())
    assert lost.error and "none.csv" in judge([lost])[0].advice[0]


def test_an_object_store(folder, capsys):
    """The same rigs from a store by its address; each recording is fetched, judged and forgotten."""
    fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed: pip install 'thermoctl[fleet]'")
    store = fsspec.filesystem("memory")
    store.put(str(folder / "data"), "/rigs", recursive=True)
    plant = ["--plant", str(folder / "plant.yaml"), "--parameters", "H", "--json"]
    assert main(["fleet", "memory://rigs", *plant]) == 1
    there = {r["name"]: r for r in json.loads(capsys.readouterr().out)}
    assert main(["fleet", str(folder / "data"), *plant]) == 1
    here = {r["name"]: r for r in json.loads(capsys.readouterr().out)}
    assert set(there) == {"well", "drifting", "changed"}
    for name in there:
        assert there[name]["drifts"] == here[name]["drifts"]
        assert all(s["path"].startswith("memory://") and not s["error"] for s in there[name]["summaries"])
    assert main(["fleet", "memory://nothing"]) == 2 and "no recordings" in capsys.readouterr().err
    assert main(["fleet", "nonsense://x"]) == 2 and "nonsense" in capsys.readouterr().err


@pytest.mark.slow  # Dask's processes take seconds to start: make test-fleet
def test_dask_gives_the_same(folder, capsys):
    plant = ["--plant", str(folder / "plant.yaml"), "--parameters", "C,H", "--json"]
    assert main(["fleet", f"file://{folder}/data", *plant, "--workers", "2"]) == 1
    spread = json.loads(capsys.readouterr().out)
    assert main(["fleet", f"file://{folder}/data", *plant]) == 1
    assert spread == json.loads(capsys.readouterr().out)


def test_drift_needs_evidence():
    times = [k * MONTH_S for k in range(4)]
    assert drift(times, [(1.0, 0.01), (0.9, 0.01), (0.8, 0.01), (0.7, 0.01)]).drifts
    assert drift(times, [(1.0, 0.01), (0.9, 0.01), (0.8, 0.01), (0.7, 0.01)]).per_month == pytest.approx(-0.1)
    assert not drift(times, [(1.0, 0.5), (0.9, 0.5), (0.8, 0.5), (0.7, 0.5)]).drifts, (
        "inside the estimates' errors"
    )
    assert not drift(times, [(1.0, 1e-4), (0.7, 1e-4), (1.1, 1e-4), (0.8, 1e-4)]).drifts, "scatter is no line"
    assert not drift(times[:2], [(1.0, 0.01), (0.5, 0.01)]).drifts
    assert math.isinf(drift([], []).sigma)
