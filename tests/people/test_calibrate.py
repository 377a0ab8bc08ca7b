"""The calibration wizard: the whole way on the simulated rig with shortened tests, and a test by the socket of a daemon."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from browser import PICTURES, Browser, find

from thermoctl import cli
from thermoctl.calibration import daemon_rig
from thermoctl.calibration.daemon_rig import DaemonRig, at_rest
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.recorded import as_table
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.answers.snapshot import status
from thermoctl.identify import modelfile
from thermoctl.identify.experiments import Aborted, load_experiments
from thermoctl.recording.files import read_table
from thermoctl.recording.writer import RecordingWriter
from thermoctl.rig.signals import INDEX

ROOT = Path(__file__).resolve().parents[2]
SHORT = """\
format: thermoctl-experiments/1
rate_um_s: 16.6667
experiments:
  test_1: {title: Step of power, parts: [{hold: [[5, 0], [25, 246]]}]}
  test_2: {title: Pulses, parts: [{hold: [[90, 250], [50, 0], [40, 250], [60, 0]]}]}
  test_3: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 250, hold_s: [10, 25], duration_s: 160}}, {hold: [[60, 0]]}]}
  test_4a: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 250, hold_s: [20, 15], duration_s: 160}}, {hold: [[60, 0]]}]}
  test_4b: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 250, hold_s: [22.5], duration_s: 160}}]}
"""


@pytest.mark.slow  # 14 minutes of rig time: make test-wizard
def test_from_doctor_to_proof_with_an_end_in_between(settings, capsys, monkeypatch):
    config = Path(settings.path)
    folder, before = config.parent, config.read_bytes()
    (folder / "experiments.yaml").write_text(SHORT)
    command = ["calibrate", "--config", "rig.yaml", "--order", "2"]

    # Ended by a signal in test 2.
    with (folder / "err").open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", *command],
            cwd=folder,
            stderr=err,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
    said = ""
    for line in process.stdout:
        said += line
        if "test_2" in line:
            process.send_signal(signal.SIGINT)
            break
    said += process.stdout.read()
    assert process.wait(60) == 130 and "test_2 ended at" in said and "on request" in said
    out = folder / "calibration/simulated"
    kept = len(read_table(out / "test_2.part.parquet"))
    assert kept >= 1000 and (out / "test_1.parquet").exists() and not (out / "test_2.parquet").exists()
    assert "left of this test" in (folder / "err").read_text(), "the time that is left"

    # Called again, it goes on, and leaves everything as it was.
    monkeypatch.chdir(folder)
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert (
        re.search(r"test_1: done before", said)
        and "test_2: done before" not in said
        and "nothing was changed" in said
    )
    assert not (folder / "models").exists() and config.read_bytes() == before
    assert (
        len(read_table(out / "test_2.parquet")) == pytest.approx(2400, abs=2)
        and not (out / "test_2.part.parquet").exists()
    )
    report = (out / "report.html").read_text()
    if PICTURES and find():
        browser = Browser(find(), folder / "browser", 1100, 900)
        browser.open(f"file://{out}/report.html")
        browser.until("document.readyState === 'complete'")
        browser.keep("report-calibration", height=1250)
        browser.close()
    assert (
        "Proof: before and after" in report and report.count("<svg") >= 3 and "without compensation" in report
    )

    # Only now: accepted.
    assert cli.main([*command, "--accept", "--gains"]) == 0
    installed = modelfile.load_calibration(folder / "models", "simulated")
    (m0, s0), (m1, s1) = installed.figures["proof_before_um"], installed.figures["proof_after_um"]
    assert abs(m1) + s1 < 0.15 * (abs(m0) + s0), "the model takes the growth away"
    assert set(installed.fingerprints) == {"test_2.parquet", "test_3.parquet", "test_4a.parquet"}
    said = capsys.readouterr().out
    order = len(installed.model.A_minus_I)
    assert f"order {order} (" in report and "set compensation.model in rig.yaml to models" in said
    assert cli.main(["model", "list"]) == 0 and f"order {order}" in capsys.readouterr().out
    assert Path(load_settings(config).compensation.model).resolve() == (folder / "models").resolve()
    assert cli.main(["check", "rig.yaml"]) == 0
    (folder / "experiments.yaml").write_text(SHORT.replace("[90, 250]", "[91, 250]"))
    assert cli.main(command) == 2 and "--again" in capsys.readouterr().err


def test_a_test_on_a_daemon_is_ended_and_goes_on(settings, running, tmp_path, monkeypatch):
    """The heat does not wait: what happened in between comes from the daemon's own recording, or the test begins anew."""
    (tmp_path / "experiments.yaml").write_text(
        "format: thermoctl-experiments/1\nrate_um_s: 16.6667\nexperiments:\n"
        "  short: {title: A short one, parts: [{hold: [[0.3, 0], [1.5, 5]]}]}\n"
    )
    schedule = load_experiments(tmp_path / "experiments.yaml")["short"]
    recorded = []
    running.rig.wall_s = time.time
    running.record = lambda row: recorded.append(row.copy())
    running.until(lambda row: row[INDEX["state"]] == 2, "READY")
    running.run()
    rig, control, rows = DaemonRig(settings), Keyboard(False), []

    def end_late(p):
        control.ended = p.done_s > 0.8

    with pytest.raises(Aborted, match="on request") as ended:
        for block in rig.run(schedule, end_late, control):
            rows.append(block)
    assert 0.8 < ended.value.done_s < schedule.duration_s and status(running.shared)["state"] != "ARMED"
    part = as_table(np.vstack(rows), tmp_path / "short.part.parquet", settings.row)
    with monkeypatch.context() as m:
        m.setattr(daemon_rig, "GAP_S", 0.0)
        assert rig.meanwhile(part) is None, "nothing was recorded since, and now is later"
    Path(settings.recording.directory).mkdir()
    monkeypatch.setattr(daemon_rig, "GAP_S", 60.0)  # this machine may be slow to write
    with running.lock:
        writer = RecordingWriter(
            settings.recording, {}, "simulated", clock=lambda: 0.0, wall=lambda: recorded[0][INDEX["wall_s"]]
        )
        writer.write(np.array(recorded))
        writer.close()
        whole = rig.meanwhile(part)
    assert whole is not None and len(whole) >= len(part) and np.diff(whole.t).max() < 0.5, (
        "ten rows a second of rig time"
    )
    control.ended = False
    rows = np.vstack(list(rig.run(schedule, lambda p: None, control, whole, 0.8)))
    assert (np.diff(rows[:, INDEX["t_s"]]) > 0).all() and np.nanmax(rows[:, INDEX["setpoint_um"]]) == 5.0
    assert len(rows) > len(whole) and status(running.shared)["state"] != "ARMED"


def test_a_rig_is_at_rest_when_its_points_are_alike_or_none_moves():
    alike, warm, offsets = np.full(12, 22.0), np.linspace(22, 27, 12), np.linspace(21, 23, 12)
    assert at_rest([(0.0, alike + np.linspace(0, 0.25, 12))]) and not at_rest([(0.0, warm)])
    cooling = [(60.0 * k, alike + 5.0 * np.exp(-k / 15) * np.linspace(0, 1, 12)) for k in range(40)]
    rested = [at_rest(cooling[: k + 1]) for k in range(40)]
    assert not any(rested[:30]) and rested[-1], "5 K with a time constant of a quarter of an hour"
    steady = [(60.0 * k, offsets) for k in range(12)]
    assert not at_rest(steady[:9]) and at_rest(steady), "thermocouples that differ, all still"
    missing = np.where(np.arange(12) == 3, np.nan, alike)
    assert at_rest([(0.0, missing)])


def test_a_rig_that_cannot_be_calibrated_is_told_so(settings, capsys):
    config = Path(settings.path)
    (config.parent / "experiments.yaml").write_text(SHORT)
    text = config.read_text()
    out = ["--out", str(config.parent / "cal")]
    config.write_text(
        text.replace(
            "backend: simulated",
            f"backend: devices\n  devices: [{{name: encoder, port: /dev/null, "
            f"profile: {ROOT}/config/devices/encoder-serial.yaml, roles: {{position: position_um}}}}]",
        )
    )
    assert cli.main(["calibrate", "--config", str(config), *out]) == 3
    assert "no daemon holds this rig" in capsys.readouterr().err
    config.write_text(text)
    (config.parent / "experiments.yaml").write_text(SHORT.replace("test_4b", "test_9"))
    assert cli.main(["calibrate", "--config", str(config), *out]) == 2
    assert "no experiment 'test_4b'" in capsys.readouterr().err
    assert not os.path.exists(config.parent / "cal")


def test_pause_and_end_by_the_keyboard(monkeypatch):
    """Ctrl-C pauses, Enter goes on, two end; without a terminal the first one ends."""
    read, write = os.pipe()
    with os.fdopen(read) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        control = Keyboard(True)
        with control.listening():
            os.kill(os.getpid(), signal.SIGINT)
            assert control.pausing() and not control.ended
            os.write(write, b"\n")
            assert not control.pausing()
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            assert control.ended and not control.pausing()
    os.close(write)
    control = Keyboard(False)
    control.interrupt(signal.SIGINT)
    assert control.ended
