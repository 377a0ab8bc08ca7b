"""Results of earlier commands that were damaged: one line, and nothing is written or driven."""

import json

import pytest

from tests.simulated import ROOT, rig_file
from thermoctl import cli
from thermoctl.calibration import steps
from thermoctl.calibration.wizard import TESTS, Wizard
from thermoctl.configuration.settings import load_settings
from thermoctl.diagnosis.data import memory
from thermoctl.diagnosis.report.trend import earlier_trends
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load

HEATER = ROOT / "docs/examples/heater/plant.yaml"


def damaged(path, change):
    """Change a file in one way, a folder of its name among them."""
    if change == "folder":
        path.unlink(missing_ok=True)
        path.mkdir()
    else:
        path.write_bytes(change(path.read_bytes() if path.exists() else b""))


DAMAGE = {
    "cut": lambda data: data[: len(data) // 2],
    "zeros": lambda data: bytes(100),
    "list": lambda data: b"[1, 2]",
    "deep": lambda data: b"[" * 9999,
    "empty mapping": lambda data: b"{}",
    "folder": "folder",
}


@pytest.mark.parametrize("change", [*DAMAGE, "another gain"])
def test_a_damaged_state_of_a_calibration_drives_nothing_and_writes_no_gains(tmp_path, change, capsys):
    """Before, a gain that one bit had changed was written into the configuration by `calibrate --accept --gains`."""
    (tmp_path / "experiments.yaml").write_bytes((ROOT / "config/experiments.yaml").read_bytes())
    config, out = rig_file(tmp_path), tmp_path / "cal"
    wizard = Wizard(load_settings(config), None, out, dict.fromkeys(TESTS), 2, print)
    gains = {"kp": 0.01, "ti_s": 0.004, "td_s": 0.001, "how": "present"}
    wizard.done = {"pid": steps.Pid("", gains, {**gains, "kp": 0.03125})}
    wizard._save()
    other = {"another gain": lambda data: data.replace(b"0.03125", b"0.03325")}
    damaged(out / "state.json", {**DAMAGE, **other}[change])
    before = config.read_bytes()
    words = ["calibrate", "--config", config, "--out", out, "--accept", "--gains", "--yes"]
    assert cli.main([str(w) for w in words]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"thermoctl: {out}/state.json: ") and "--again" in said
    assert config.read_bytes() == before and [p.name for p in out.iterdir()] == ["state.json"]


@pytest.mark.parametrize("change", DAMAGE)
@pytest.mark.parametrize(
    "words",
    [["diagnose", "--explain", "out"], ["diagnose", "--explain", "out", "--why", "radiation"]]
    + [["effects", "save", "out", "mine"]],
)
def test_a_damaged_diagnosis_is_told_in_one_line(tmp_path, change, words, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    keys = ("decision", "hypotheses", "lost", "refused", "promised", "remainder")
    (tmp_path / "out/diagnosis.json").write_text(json.dumps(dict.fromkeys(keys, 1.0)))
    if change != "empty mapping":
        assert cli.main(words) == 2
        assert "damaged or of another version" in capsys.readouterr().err
    damaged(tmp_path / "out/diagnosis.json", DAMAGE[change])
    assert cli.main(words) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("thermoctl: out/diagnosis.json: ") and said.endswith("diagnose again")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("change", DAMAGE)
def test_a_diagnosis_does_not_go_on_from_a_damaged_one(tmp_path, change):
    damaged(tmp_path / memory.FILE, DAMAGE[change])
    with pytest.raises(InputError, match=rf"{memory.FILE}: .*diagnose all recordings again"):
        memory.read(tmp_path, load(HEATER))
    if change != "empty mapping":  # one without trends
        damaged(tmp_path / "diagnosis.json", DAMAGE[change])
        with pytest.raises(InputError, match=r"diagnosis.json: .*diagnose all recordings again"):
            earlier_trends(tmp_path)
