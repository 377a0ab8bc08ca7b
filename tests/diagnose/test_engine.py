"""Whole diagnoses of a small heater through the command: what was left out, names that carry no meaning, the same bytes twice."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from thermoctl.cli import main
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant

PLANT = """
format: thermoctl-plant/1
title: one block
inputs: {heat: {unit: W}, air: {unit: degC, between_samples: linear}}
parameters:
  C: {value: 40, unit: J/K, range: [20, 80]}
  G: {value: 0.3, unit: W/K, range: [0.1, 1]}
nodes: {block: {unit: degC, storage: C, initial: air, initial_sigma: 0.3}}
flows:
  power: {into: block, rate: heat, unit: W}
  loss: {from: block, rate: G * (block - air), unit: W}
outputs: {reading: {value: block, unit: degC, noise: 0.1}}
"""
LAGGED = (
    PLANT.replace("nodes: {", "nodes: {behind: {unit: degC, storage: 25, initial: air}, ")
    .replace("value: block", "value: behind")
    .replace("flows:", 'flows:\n  follow: {into: behind, rate: "block - behind"}')
)
NEUTRAL = {
    "heat": "q1",
    "air": "q2",
    "block": "q3",
    "power": "q4",
    "loss": "q5",
    "reading": "q6",
    "C": "q7",
    "G": "q8",
}


def _renamed(text: str) -> str:
    return re.sub(r"\b(" + "|".join(NEUTRAL) + r")\b", lambda m: NEUTRAL[m[0]], text).replace(
        "title: one q3", "title: x"
    )


def _write(folder: Path, truth: str, seed: int, names: dict[str, str] | None = None) -> list[str]:
    """Two recordings of a truth, and the plant that is believed."""
    names = names or {k: k for k in NEUTRAL}
    folder.mkdir()
    (folder / "plant.yaml").write_text(_renamed(PLANT) if names is NEUTRAL else PLANT)
    model = compile_plant(loads(truth))
    files = []
    for r in range(2):
        rng = np.random.default_rng(seed + r)
        t = np.arange(0.0, 3000.0, 10.0)
        columns = {
            "heat": np.repeat(rng.choice([0.0, 4.0, 9.0, 14.0], 10), 30),
            "air": 21 + 0.5 * np.sin(t / 900 + r),
        }
        from thermoctl.recording.table import Table

        table = model.measure(Table("run", "run", t, columns), seed + r)
        out = {names[k]: v for k, v in {**columns, "reading": table.columns["reading"]}.items()}
        files.append(folder / f"run_{r + 1}.csv")
        rows = np.column_stack([t, *out.values()])
        np.savetxt(files[-1], rows, delimiter=",", header=",".join(["t", *out]), comments="", fmt="%.6f")
    return [str(f) for f in files]


def _diagnosed(folder: Path, files: list[str]) -> dict:
    assert (
        main(
            [
                "diagnose",
                "--plant",
                str(folder / "plant.yaml"),
                "--out",
                str(folder / "out"),
                *files,
                "--quiet",
            ]
        )
        == 0
    )
    return json.loads((folder / "out" / "diagnosis.json").read_text())


def written(out: Path) -> dict[str, str]:
    """The files of a result, without the seconds that it took."""
    texts = {p.name: p.read_text() for p in sorted(out.iterdir())}
    return {n: re.sub(r'"seconds": [\d.]+|, in \d+ s', "", text) for n, text in texts.items()}


@pytest.fixture(scope="module")
def lagged(tmp_path_factory) -> tuple[dict, Path, list[str]]:
    folder = tmp_path_factory.mktemp("lagged") / "a"
    files = _write(folder, LAGGED, 5)
    return _diagnosed(folder, files), folder, files


def test_nothing_missing_is_consistent(tmp_path):
    folder = tmp_path / "a"
    found = _diagnosed(folder, _write(folder, PLANT, 1))
    assert (found["verdict"], found["findings"], found["remainder"]) == ("consistent", [], None)


def test_a_lag_is_named_with_its_size_and_nothing_beside_it(lagged):
    found = lagged[0]
    assert found["verdict"] == "explained"
    assert [(f["effect"], f["where"]) for f in found["findings"]] == [("sensor_lag", "reading")]
    (tau,) = found["findings"][0]["parameters"].values()
    assert abs(tau["value"] - 25) < 3 * tau["sd"] + 0.5
    assert found["fit"]["after"]["reading"] == pytest.approx(0.1, rel=0.1)
    held_out = [found["fit"][f"held_out_{k}"]["reading"] for k in ("before", "refit_only", "after")]
    assert sorted(held_out, reverse=True) == held_out


def test_names_carry_no_meaning(lagged, tmp_path):
    folder = tmp_path / "a"
    other = _diagnosed(folder, _write(folder, LAGGED, 5, NEUTRAL))
    assert other["verdict"] == lagged[0]["verdict"]
    assert [(f["effect"], f["where"], f["probability"]) for f in other["findings"]] == [
        (f["effect"], NEUTRAL[f["where"]], pytest.approx(f["probability"], abs=0.02))
        for f in lagged[0]["findings"]
    ]


def test_the_same_input_gives_the_same_bytes(lagged):
    _, folder, files = lagged
    first = written(folder / "out")
    _diagnosed(folder, files)
    assert written(folder / "out") == first


def test_explain_retraces_the_verdict_in_a_screen(lagged, capsys):
    assert main(["diagnose", "--explain", str(lagged[1] / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert lines[0].startswith("verdict: explained, because")
    assert any("sensor lag at reading" in line for line in lines)
