"""A whole diagnosis of a small heater through the command: what was left out, and why it was named."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.plants import HEATER
from thermoctl.cli import main
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

PLANT = HEATER.replace("air: {unit: degC}", "air: {unit: degC, between_samples: linear}")
LAGGED = (
    PLANT.replace("nodes: {", "nodes: {behind: {unit: degC, storage: 25, initial: air}, ")
    .replace("value: block", "value: behind")
    .replace("flows:", 'flows:\n  follow: {into: behind, rate: "block - behind"}')
)


def _write(folder: Path, truth: str, seed: int) -> list[str]:
    """Two recordings of a truth, and the plant that is believed."""
    folder.mkdir()
    (folder / "plant.yaml").write_text(PLANT)
    model = compile_plant(loads(truth))
    files = []
    for r in range(2):
        rng = np.random.default_rng(seed + r)
        t = np.arange(0.0, 3000.0, 10.0)
        columns = {
            "heat": np.repeat(rng.choice([0.0, 4.0, 9.0, 14.0], 10), 30),
            "air": 21 + 0.5 * np.sin(t / 900 + r),
        }
        columns = model.measure(Table("run", "run", t, columns), seed + r).columns
        files.append(folder / f"run_{r + 1}.csv")
        rows = np.column_stack([t, *(columns[k] for k in ("heat", "air", "reading"))])
        np.savetxt(files[-1], rows, delimiter=",", header="t,heat,air,reading", comments="", fmt="%.6f")
    return [str(f) for f in files]


def _diagnosed(folder: Path, files: list[str]) -> dict:
    plant, out = str(folder / "plant.yaml"), str(folder / "out")
    assert main(["diagnose", "--plant", plant, "--out", out, *files, "--quiet"]) == 0
    return json.loads((folder / "out" / "diagnosis.json").read_text())


def written(out: Path) -> dict[str, str]:
    """The files of a result, without the seconds that it took."""
    texts = {p.name: p.read_text() for p in sorted(out.iterdir())}
    return {n: re.sub(r'"seconds": [\d.]+|, in \d+ s', "", text) for n, text in texts.items()}


@pytest.fixture(scope="module")
def lagged(tmp_path_factory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("lagged") / "a"
    return _diagnosed(folder, _write(folder, LAGGED, 5)), folder


def test_a_lag_is_named_with_its_size_and_nothing_beside_it(lagged):
    found = lagged[0]
    assert found["verdict"] == "explained"
    assert [(f["effect"], f["where"]) for f in found["findings"]] == [("sensor_lag", "reading")]
    (tau,) = found["findings"][0]["parameters"].values()
    assert abs(tau["value"] - 25) < 3 * tau["sd"] + 0.5
    assert found["fit"]["after"]["reading"] == pytest.approx(0.1, rel=0.1)
    held_out = [found["fit"][f"held_out_{k}"]["reading"] for k in ("before", "refit_only", "after")]
    assert sorted(held_out, reverse=True) == held_out


def test_explain_retraces_the_verdict_in_a_screen(lagged, capsys):
    assert main(["diagnose", "--explain", str(lagged[1] / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert lines[0].startswith("verdict: explained, because")
    assert any("sensor lag at reading" in line for line in lines)
