"""Every command that can move, arm, disarm or stop a rig, beside a daemon that somebody else runs in READY, ARMED and FAULT.

The table is tests/acts.py; docs/reference/commands-that-act.md is written from it.
"""

import io
import re
from pathlib import Path

import numpy as np
import pytest

from tests.acts import ACTS
from tests.daemon.process import ROOT, Daemon, patient, wait
from tests.plants import HEATED_BLOCK, HEATED_RADIATES
from tests.simulated import rig_file
from thermoctl import cli
from thermoctl.cli import command_line
from thermoctl.configuration.which_rig import ACTING
from thermoctl.daemon import lock
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

OTHER = ["--config", "{other}"]  # a rig that nobody runs
BESIDE = {  # command: (arguments, exit status) by which a person who means something else could hurt the daemon's rig
    "run": (["--config", "{own}"], 2),
    "demo": (["--config", "{own}", "--seconds", "1"], 0),
    "start": (["--config", "{own}"], 0),
    "stop": (OTHER, 0),
    "restart": (OTHER, 3),
    "arm": (OTHER, 2),
    "disarm": (OTHER, 2),
    "setpoint": (["5", *OTHER], 2),
    "reload": (OTHER, 2),
    "dashboard": (["--config", "{own}", "--commands", "--listen", "nowhere"], 2),
    "virtual-rig": (["--config", "{own}"], 2),
    "service": (["install", "--config", "{own}", "--root", "{root}"], 0),
    "tune": (["--config", "{own}"], 2),
    "experiment": (["test_1", "--config", "{own}", "--out", "{root}.parquet"], 2),
    "calibrate": (["--config", "{own}", "--out", "{root}.calibration"], 2),
    "diagnose": (
        ["--resolve", "--plant", "{plant}", "--out", "{root}.result", "--config", "{own}", "--limit", "heat=0:20",
         "--limit", "T_body=0:200", "{recording}"], 2
    ),
}  # fmt: skip
MOVES_IT = {"tune", "experiment", "calibrate", "diagnose"}
"""Commands that drive the daemon's rig: without a `go` status 2 where it is READY; else 3, also with --yes."""
PLANT, RADIATES = (
    plant.replace("heat: {unit: W}", "heat: {unit: W, column: power_w}").replace(
        "T_block: {value: T,", "T_body: {value: T, column: bobbin_c,"
    )
    for plant in (HEATED_BLOCK, HEATED_RADIATES)
)


def own_rig(folder, name, faults=""):
    """config/simulated.yaml with its files in `folder`."""
    path = rig_file(
        folder,
        ("simulated.sock", f"{name}.sock"),
        ("../recordings", f"{folder}/{name}-recordings"),
        ("  backend: simulated\n", f"  backend: simulated\n{faults}"),
        name=name,
    )
    (folder / "experiments.yaml").write_text((ROOT / "config/experiments.yaml").read_text())
    return patient(path)


@pytest.fixture(scope="module", params=["READY", "ARMED", "FAULT"])
def foreign(request, tmp_path_factory):
    """A daemon in this state, as `thermoctl run` in another terminal."""
    folder = tmp_path_factory.mktemp(request.param.lower())
    broken = "  faults: [{kind: error, role: coil_c, at_s: 8}]\n" if request.param == "FAULT" else ""
    daemon = Daemon(own_rig(folder, "own", broken))
    daemon.other, daemon.state = own_rig(folder, "other"), request.param
    if request.param != "READY":
        daemon.armed()
        assert daemon.ask("setpoint", value=3.0)["ok"]
    wait(lambda: daemon.ask("status")["state"] == request.param, request.param)
    wait(lambda: len(recordings(daemon)) == 2, "both tiers of its recording")
    yield daemon
    daemon.kill()


@pytest.fixture(scope="module")
def ambiguous(tmp_path_factory):
    """(plant file, recording) of a heated body whose diagnosis proposes an experiment of the setpoint.

    25 K above the air, radiation and a conductance that rises with temperature look the same.
    """
    folder = tmp_path_factory.mktemp("ambiguous")
    (folder / "plant.yaml").write_text(PLANT)
    (folder / "truth.yaml").write_text(RADIATES)
    t = np.arange(240) * 5.0
    heat = np.where((np.abs(t - 156) < 36) | (np.abs(t - 636) < 36), 20.0, 0.0)
    inputs = Table("run", "run", t, {"power_w": heat, "air": np.full(len(t), 22.0)})
    measured = compile_plant(load(folder / "truth.yaml"), ()).measure(inputs, seed=1)
    columns = {**measured.columns, "setpoint_um": 2.0 * heat}
    write_table(folder / "run.csv", Table("run", "run", measured.t, columns))
    return folder / "plant.yaml", folder / "run.csv"


def seen(daemon):
    """What must not change: state, setpoint, parameters, process, log, and the recordings that were there."""
    status = daemon.ask("status")
    return (
        [status[k] for k in ("state", "enable", "generation")],
        status["setpoint_um"] if status["state"] == "ARMED" else None,  # else it follows the position
        lock.holder(daemon.settings),
        {p.name: p.stat().st_ino for p in recordings(daemon)},
        daemon.log,
    )


def recordings(daemon):
    return list(Path(daemon.settings.recording.directory).iterdir())


def unchanged(daemon, before, recorded, ticks):
    """Nothing of `before` has changed; the daemon ticks on, and its log and recordings have only grown by its own rows."""
    *after, log = seen(daemon)
    assert after == list(before[:-1])
    assert log.startswith(before[-1]) and "command name=" not in log[len(before[-1]) :]
    assert daemon.ask("status")["ticks"] > ticks
    for path, content in recorded.items():
        assert path.read_bytes().startswith(content), path.name


@pytest.mark.parametrize("command", [act.command for act in ACTS])
def test_a_daemon_that_is_not_meant_is_left_alone(command, foreign, ambiguous, tmp_path, monkeypatch, capsys):
    arguments, status = BESIDE[command]
    names = {
        "own": foreign.config,
        "other": foreign.other,
        "root": tmp_path / "root",
        "plant": ambiguous[0],
        "recording": ambiguous[1],
    }
    line = [command, *(a.format(**names) for a in arguments)]
    if command in MOVES_IT and foreign.state != "READY":
        line, status = [*line, "--yes"], 3  # somebody uses it, or has to read its fault first
    if command == "restart":  # of a rig that cannot start: its stop is what could hurt
        foreign.other.write_text(foreign.other.read_text().replace("actuator.yaml", "gone.yaml"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())  # nobody to ask
    before, ticks = seen(foreign), foreign.ask("status")["ticks"]
    recorded = {path: path.read_bytes() for path in recordings(foreign)}
    code = cli.main(line)
    out, err = capsys.readouterr()
    assert code == status, out + err
    assert str(code) in re.findall(r"\d", next(act.status for act in ACTS if act.command == command))
    if command in MOVES_IT:
        assert ("--yes" if foreign.state == "READY" else f"is {foreign.state}") in err.splitlines()[-1]
    if command == "diagnose":
        assert (tmp_path / "root.result/next_experiment.yaml").exists(), "it came as far as the experiment"
    unchanged(foreign, before, recorded, ticks)


def test_a_command_that_is_meant_is_refused_where_the_table_says_so(foreign, capsys):
    """`setpoint` unless ARMED, and in FAULT `arm` and, while the fault is active, `disarm`: status 1, nothing changed."""
    for line in {"READY": ["setpoint 5"], "ARMED": [], "FAULT": ["arm", "setpoint 5", "disarm"]}[
        foreign.state
    ]:
        before = seen(foreign)[:-1]
        assert cli.main([*line.split(), "--config", str(foreign.config)]) == 1
        assert foreign.state in capsys.readouterr().err
        assert seen(foreign)[:-1] == before


def test_every_command_of_the_table_is_tried_and_exists():
    assert set(BESIDE) == {act.command for act in ACTS} == ACTING
    for act in ACTS:
        command_line.parser().parse_args([act.command, *BESIDE[act.command][0]])
