"""`diagnose --live`: the daemon's own recordings, and the alarm that its model no longer fits."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.simulated import ROOT, rig_file, run_simulated
from thermoctl.cli import main
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.misfit import BLOCK_S, Misfit
from thermoctl.daemon.tick.assemble import compensator
from thermoctl.recording.writer import RecordingWriter
from thermoctl.rig.signals import INDEX


def rig(folder, heat=None):
    """Settings of the simulated rig that records into `folder`; `heat`: watts into its coil that no model knows of."""
    changes = []
    if heat:
        plant = (ROOT / "config" / "plants" / "actuator.yaml").read_text()
        (folder / "changed.yaml").write_text(
            plant.replace("\nflows:\n", f"\nflows:\n  outside: {{into: coil, rate: {heat}, unit: W}}\n", 1)
        )
        changes.append(("plants/actuator.yaml", "changed.yaml"))
    path = rig_file(folder, *changes)
    return path, load_settings(path)


def recorded(settings, minutes):
    """Run the rig in trapezoids, in simulated time, and write its rows as the recorder does."""
    moves = [(0.5, "arm", 0.0)] + [
        (2.0 + 40.0 * k, "setpoint", 200.0 if k % 2 else -200.0) for k in range(int(minutes * 1.5))
    ]
    rows = run_simulated(settings, moves, minutes * 60.0, every=100)
    Path(settings.recording.directory).mkdir(parents=True, exist_ok=True)
    writer = RecordingWriter(
        settings.recording, {"rig": settings.rig.name}, settings.rig.name, lambda text: None
    )
    writer.write(rows)
    writer.close()
    return rows


def test_a_filter_that_fits_raises_nothing_and_a_lasting_shift_its_onset():
    model = compensator(load_settings(ROOT / "config" / "simulated.yaml"))
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 20_000.0, 0.1)
    k = np.zeros(len(t))
    e = rng.normal(0.0, np.sqrt(model.R_v), len(t))
    watch = Misfit(model)
    assert watch.add(t, e, k) is None
    watch = Misfit(model)
    alarm = watch.add(t, e + 1.0 * np.sqrt(model.R_v) * (t > 12_000), k)
    assert (
        alarm is not None
        and abs(alarm.begin_s - 12_000) < 3 * BLOCK_S
        and alarm.end_s < 12_000 + 15 * BLOCK_S
    )
    assert alarm.mean_c == pytest.approx(np.sqrt(model.R_v), rel=0.3)


def test_live_says_that_the_model_fits(tmp_path, capsys):
    path, settings = rig(tmp_path)
    recorded(settings, 10)
    plant = ROOT / "config" / "plants" / "actuator_thermal.yaml"
    assert main(f"diagnose --live --config {path} --plant {plant} --out {tmp_path / 'out'}".split()) == 0
    assert "The model fits" in capsys.readouterr().out and not (tmp_path / "out").exists()


def test_live_without_recordings_is_one_line(tmp_path, capsys):
    path, _ = rig(tmp_path)
    plant = ROOT / "config" / "plants" / "actuator_thermal.yaml"
    assert main(f"diagnose --live --config {path} --plant {plant} --out {tmp_path / 'out'}".split()) == 2
    assert "no recording of the rig 'simulated'" in capsys.readouterr().err


@pytest.mark.slow
def test_live_diagnoses_the_stretch_that_the_model_does_not_fit(tmp_path):
    path, settings = rig(tmp_path, "1.2 * step(t - 1500)")
    rows = recorded(settings, 45)
    plant = ROOT / "config" / "plants" / "actuator_thermal.yaml"
    assert main(f"diagnose --live --config {path} --plant {plant} --out {tmp_path / 'out'}".split()) == 0
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    (finding,) = [f for f in found["findings"] if f["where"] == "coil"]
    assert finding["effect"] == "external_heat_source" and finding["when"][0][0] == pytest.approx(
        1500, abs=60
    )
    assert np.isfinite(rows[:, INDEX["innovation_c"]]).any()
