"""From experiment to compensation: tests run and recorded, identified, installed, loaded by the daemon, refused elsewhere, rolled back."""

import dataclasses
import errno
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest

from tests.simulated import QUICK, QUICK_LIMITS, ROOT, quick_plant, rig_file
from thermoctl import cli
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon import tuner
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.daemon.tick.assemble import compensator
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import modelfile
from thermoctl.identify.online import Tuner
from thermoctl.recording import files
from thermoctl.recording.files import read_table
from thermoctl.rig.signals import INDEX

SHORT = """\
format: thermoctl-experiments/1
rate_um_s: 16.6667
experiments:
  test_2: {title: Pulses, parts: [{hold: [[70, 250], [50, 0], [40, 250], [60, 0]]}]}
  test_3: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 250, hold_s: [10, 25], duration_s: 160}}, {hold: [[60, 0]]}]}
  test_4a: {title: Trapezoids, parts: [{trapezoid: {low_um: 0, high_um: 250, hold_s: [20, 15], duration_s: 160}}, {hold: [[60, 0]]}]}
"""


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """A folder with a rig whose heat is QUICK times faster, its experiments, no model."""
    (tmp_path / "plant.yaml").write_text(quick_plant(ROOT / "config/plants/actuator.yaml"))
    rig_file(
        tmp_path,
        *QUICK_LIMITS,
        ("plants/actuator.yaml", "plant.yaml"),
        ("model: models/simulated.yaml", 'model: ""'),
        ("coil_limit_c: 80", "coil_limit_c: 80\n  coil_rate_k_s: 25"),
    )
    (tmp_path / "experiments.yaml").write_text(SHORT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow  # 12 minutes of rig time: make test-identification
def test_from_experiment_to_a_model_in_the_daemon_and_back(quick, capsys):
    (quick / "plant.yaml").write_text(
        (ROOT / "config/plants/actuator.yaml").read_text()
    )  # heat at its own pace
    for name in ("test_2", "test_3", "test_4a"):
        assert cli.main(["experiment", name, "--config", "rig.yaml"]) == 0
    said = capsys.readouterr().out
    assert "faster than real time" in said and "alternating power below f_c" in said
    table = read_table("test_2.parquet")
    assert (
        len(table) == pytest.approx(2200, abs=2)
        and np.ptp(table.columns["output_reference_um"] - table.columns["position_raw_um"]) > 0.5
    )

    tests = ["test_2.parquet", "test_3.parquet", "test_4a.parquet"]
    identify = ["identify", *tests, "--config", "rig.yaml", "--order", "2"]
    assert cli.main(identify) == 0
    one = modelfile.current("models")
    found = modelfile.load_calibration(one)
    assert found.rig == "simulated" and set(found.fingerprints) == {*tests}
    assert found.figures["expansion_rms_um"] < 0.5

    # The daemon's own loader takes it by the folder, and refuses it for a rig of another name.
    (quick / "rig.yaml").write_text((quick / "rig.yaml").read_text().replace('model: ""', "model: models"))
    settings = load_settings("rig.yaml")
    assert np.array_equal(compensator(settings).A_minus_I, found.model.A_minus_I)
    other = dataclasses.replace(settings, rig=dataclasses.replace(settings.rig, name="another"))
    with pytest.raises(InputError, match="of rig 'simulated', this one is 'another'"):
        compensator(other)
    with pytest.raises(InputError, match="of rig 'simulated'"):
        Simulation(other)

    # It compensates: test 4A again, with the model.
    simulation = Simulation(
        dataclasses.replace(
            settings, protection=dataclasses.replace(settings.protection, innovation_limit_c=1e3)
        )
    )
    simulation.arm()
    first = simulation.tick()[INDEX["output_reference_um"]]
    left, grown = [], []
    for k in range(90):
        simulation.command("setpoint", 250.0 if k % 20 < 10 else 0.0)
        row = simulation.tick(1000)
        if row[INDEX["reference_um"]] == row[INDEX["setpoint_um"]]:
            left.append(row[INDEX["output_reference_um"]] - row[INDEX["reference_um"]] - first)
        grown.append(row[INDEX["expansion_um"]])
    simulation.close()
    assert max(grown) > 0.3 and (not left or np.abs(left).max() < 0.5 * max(grown))

    # A second calibration becomes current; the first one comes back.
    assert cli.main(identify) == 0 and modelfile.current("models") != one
    assert cli.main(["model", "rollback"]) == 0 and modelfile.current("models") == one


def test_experiment_refuses_what_the_rig_may_not_do(quick, capsys):
    (quick / "experiments.yaml").write_text(SHORT.replace("[70, 250]", "[70, 300]"))
    assert cli.main(["experiment", "test_2", "--config", "rig.yaml"]) == 2
    assert "setpoint_high_um" in capsys.readouterr().err and not (quick / "test_2.parquet").exists()
    assert (
        cli.main(["experiment", "test_3", "--config", "rig.yaml", "--dry-run"]) == 0
        and not (quick / "test_3.parquet").exists()
    )


def test_tune_names_the_shipped_loops_margins_and_proves_its_proposal(quick, capsys):
    """The margin measured with the shipped gains is where the loop becomes unstable; --write proves each step."""
    assert cli.main(["tune", "--config", "rig.yaml", "--write"]) == 0
    said = capsys.readouterr().out
    gain = float(re.search(r"present: gain margin ([\d.]+)", said)[1])
    settings = load_settings("rig.yaml")
    assert f"kp: {settings.control.kp:g}" in (quick / "rig.yaml").read_text() and settings.control.kp != 0.01
    proven = re.findall(r"step (\d) of (\d) .*phase margin (\d+) \+- \d deg measured", said)
    assert [int(k) for k, _, _ in proven] == list(range(1, int(proven[0][1]) + 1)) and int(
        proven[-1][2]
    ) >= 45

    def trips(kp):
        c = dataclasses.replace(settings.control, kp=kp, ti_s=0.004, td_s=0.001)
        simulation = Simulation(dataclasses.replace(settings, control=c))
        simulation.arm()
        simulation.command("setpoint", 20.0)
        state = simulation.tick(4000)[INDEX["state"]]
        simulation.close()
        return state != 3

    assert not trips(0.01 * gain * 0.9) and trips(0.01 * gain * 1.1)


def test_a_wrong_expansion_is_tuned_while_the_reference_is_there(quick, monkeypatch):
    """In simulated time: the tuner takes the daemon's rows, waits for excitation, and installs a better calibration, which can be undone."""
    from thermoctl.identify.linearise import linearise
    from thermoctl.plant import load

    right = linearise(load(_thermal(quick)), 0.001, 0.1, expansion_period_s=0.05)
    wrong = dataclasses.replace(
        right,
        b1=0.75 * right.b1,
        b2=0.75 * right.b2,
        b_air=0.75 * right.b_air,
        air_filter_s=right.air_filter_s / QUICK,
    )
    monkeypatch.setattr(tuner, "PROPOSE_S", 10.0)
    settings = load_settings("rig.yaml")
    folder = quick / "models"
    first = modelfile.install(folder, wrong, "simulated")
    said: list[str] = []
    learning = tuner.Tuning(
        wrong, "simulated", folder, said.append, Tuner(wrong, (0.5, 2.0, 4.0), 100, 0.4, hold_s=60.0)
    )
    rows: list[np.ndarray] = []
    simulation = Simulation(
        dataclasses.replace(
            settings, protection=dataclasses.replace(settings.protection, innovation_limit_c=1e3)
        ),
        wrong,
    )
    simulation.arm()
    progress = []
    for k in range(260):
        simulation.command("setpoint", 250.0 if k % 100 < 60 else 0.0)
        for _ in range(100):
            rows.append(simulation.tick(10).copy())
        learning.take(np.array(rows))
        rows.clear()
        progress.append(learning.tuner.progress)
        if said:
            break
    simulation.close()
    assert progress[0] < 50 and said, learning.tuner.proposal()
    assert "in use from the next start on" in said[0]
    second = modelfile.current(folder)
    assert second != first
    tuned = modelfile.load_calibration(second)
    g = [((m.b1 + m.b2) / (1 - m.f1)).sum() for m in (right, wrong, tuned.model)]
    assert tuned.model.meta["tuned_online"] and "um against" in tuned.figures["tuned_online"]
    gains = (wrong.b1 + wrong.b2) / (1 - wrong.f1)
    change = (tuned.model.b1 + tuned.model.b2) / (1 - tuned.model.f1) - gains
    assert np.abs(change).max() <= 0.4 * np.abs(gains).max() + 1e-9
    assert abs(g[2] - g[0]) < abs(g[1] - g[0]) or np.abs(change).max() > 0
    assert modelfile.roll_back(folder) == first


def _thermal(folder: Path) -> Path:
    path = folder / "thermal.yaml"
    path.write_text(quick_plant(ROOT / "config/plants/actuator_thermal.yaml"))
    return path


def test_tuning_needs_a_folder_of_calibrations(quick):
    settings = load_settings("rig.yaml")
    settings = dataclasses.replace(
        settings, compensation=dataclasses.replace(settings.compensation, tune=True)
    )
    with pytest.raises(InputError, match="folder of calibrations"):
        tuner.check(settings)


@pytest.mark.slow  # two programs and wires in real time: make test-identification
def test_an_experiment_at_the_wire_is_ended_and_goes_on(tmp_path):
    """`thermoctl experiment` on the daemon that holds the virtual rig over serial, CAN and Modbus: nothing is lost when it is ended."""
    import signal
    import subprocess

    from tests.hal.test_wire_daemon import CLI, Chain

    (tmp_path / "experiments.yaml").write_text(
        "format: thermoctl-experiments/1\nrate_um_s: 16.6667\nexperiments:\n"
        "  short: {title: Up and down, parts: [{hold: [[1, 0], [6, 20], [3, 0]]}]}\n"
    )
    chain = Chain(tmp_path)
    try:
        out = tmp_path / "short.parquet"
        command = (
            f"{' '.join(CLI)} experiment short --config {chain.config} --out {out} --resume --yes".split()
        )
        first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        chain.until(lambda s: s.get("state") == "ARMED" and (s.get("position_um") or 0) > 10, 60)
        first.send_signal(signal.SIGINT)
        said, err = first.communicate(timeout=60)
        assert first.returncode == 130 and "ended after" in err and "daemon at" in said, (said, err)
        kept = read_table(out)
        assert len(kept) > 5 and chain.status()["state"] != "ARMED"
        goes_on, again = "", []
        while len(again) < 6 and (
            not again or again[-1].returncode
        ):  # a busy machine's wires may trip it: acknowledged, it goes on too
            chain.ask("disarm")
            again.append(subprocess.run(command, capture_output=True, text=True, timeout=120, check=False))
            goes_on += again[-1].stdout
        assert again[-1].returncode == 0, [(r.stdout, r.stderr) for r in again]
        assert re.search(r"goes on at \d+ s|starts again", goes_on)
        whole = read_table(out)
        assert (
            np.nanmax(whole.columns["position_um"]) == pytest.approx(20, abs=1)
            and (np.diff(whole.t) > 0).all()
        )
        assert not out.with_name("short.parquet.progress").exists() and chain.status()["state"] != "ARMED"
    finally:
        chain.stop()


BRIEF = "  brief: {title: Brief, parts: [{hold: [[1, 0], [2, 5]]}]}\n"


@pytest.mark.parametrize(
    "out,words", [("none/a.csv", "none/a.csv: cannot be written: No such"), ("a.txt", "not '.txt'")]
)
def test_no_test_moves_a_rig_whose_rows_could_not_be_written(quick, capsys, out, words):
    """A wrong folder or suffix was found after the last move, and the rows of hours were lost."""
    (quick / "experiments.yaml").write_text(SHORT + BRIEF)
    assert cli.main(["experiment", "brief", "--config", "rig.yaml", "--out", out]) == 2
    said = capsys.readouterr()
    assert words in said.err and "moves the output" not in said.out


def test_the_rows_of_a_test_are_kept_where_its_disk_is_full(quick, capsys, monkeypatch):
    write, calls = files.write_arrow, []

    def full_once(path, *arguments):
        calls.append(path)
        if len(calls) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, *arguments)

    monkeypatch.setattr(files, "write_arrow", full_once)
    monkeypatch.setattr(tempfile, "tempdir", str(quick))
    (quick / "experiments.yaml").write_text(SHORT + BRIEF)
    assert cli.main(["experiment", "brief", "--config", "rig.yaml", "--out", "a.csv"]) == 2
    said = re.search(
        r"a\.csv: No space left .* its (\d+) rows are in (\S+a\.csv): move", capsys.readouterr().err
    )
    assert said and len(read_table(said[2])) == int(said[1]) > 20 and not (quick / "a.csv").exists()


@pytest.mark.parametrize("damaged", ["gar\nbage\n", "", "\0\0\0", "nan", "-5"])
def test_a_damaged_note_of_the_time_reached_is_named(quick, capsys, damaged):
    """A power cut can leave it empty; the rows beside it stay as they are."""
    (quick / "short.parquet").write_text("rows")
    (quick / "short.parquet.progress").write_text(damaged)
    command = "experiment test_2 --config rig.yaml --out short.parquet --resume --yes"
    assert cli.main(command.split()) == 2
    assert "short.parquet.progress: " in (said := capsys.readouterr().err) and "start again without" in said
    assert said.count("\n") == 1
    assert (quick / "short.parquet").read_text() == "rows"


@pytest.mark.parametrize("hours", ["0", "-1", "0.0001", "nan", "inf"])
def test_simulated_hours_hold_a_cycle(quick, capsys, hours):
    assert cli.main(["run", "--config", "rig.yaml", "--simulated-time", "--hours", hours]) == 2
    assert "at least 0.021, one cycle, was expected" in capsys.readouterr().err
