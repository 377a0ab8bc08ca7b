"""The notebooks run from the first cell to the last, in a folder as they stand in."""

import ast
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[2] / "docs"


def run(name, folder, monkeypatch):
    """Run the code cells; return their names and the value of each cell's last expression."""
    shutil.copytree(DOCS / "examples", folder / "examples")
    (folder / "notebooks").mkdir()
    monkeypatch.chdir(folder / "notebooks")
    names, shown = {}, []
    for cell in json.loads((DOCS / f"notebooks/{name}.ipynb").read_text())["cells"]:
        assert not cell.get("outputs"), "notebooks are kept without outputs"
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = ast.Expression(tree.body.pop().value) if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, name, "exec"), names)
        shown.append(eval(compile(last, name, "eval"), names) if last else None)
    return names, shown


@pytest.mark.slow
def test_own_data(tmp_path, monkeypatch):
    names, _ = run("own_data", tmp_path, monkeypatch)
    assert names["result"].verdict == "explained"
    assert [f.effect for f in names["result"].findings] == ["external_heat_source"]
    assert Path("extended.yaml").exists() and Path("extended.py").exists()


@pytest.mark.slow
def test_new_effect(tmp_path, monkeypatch):
    names, _ = run("new_effect", tmp_path, monkeypatch)
    (finding,) = names["result"].findings
    assert finding.effect == "fan_heating"
    (value,) = finding.parameters.values()
    assert value["value"] == pytest.approx(2e-5, abs=3 * value["sd"])


def test_compensation(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    names, _ = run("compensation", tmp_path, monkeypatch)
    on, off = (np.abs(e[t > t[-1] / 2]).mean() for t, e in (names["errors"][k] for k in ("on", "off")))
    assert off > 0.5 and on < 0.1 * off
