"""A rig file with axes: what each axis gets, and the mistakes that are told with their place."""

import json
import os
import signal
import threading
import time
from pathlib import Path

import psutil
import pytest

from tests.daemon.process import wait
from tests.rigs.axes import simulated_axes
from thermoctl import cli
from thermoctl.configuration.settings import load_rig, load_settings
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.lock import holder
from thermoctl.daemon.tick.assemble import shared_name
from thermoctl.files.yamlfile import InputError


def test_an_axis_has_the_settings_of_a_rig_of_its_own(tmp_path):
    path = simulated_axes(tmp_path)
    rig = load_rig(path)
    x, y = rig.axes
    assert [p.axis for p in rig.parts] == ["x", "y"] and rig.of_axis("y") == y == load_settings(path, "y")
    assert load_settings(f"{path}#x") == x and x.parts == (x,)
    assert (x.rig.name, y.rig.name) == ("stage-x", "stage-y") and (x.hal.seed, y.hal.seed) == (1, 2)
    for part in rig.axes:
        assert Path(part.socket.path).name == f"rig-{part.axis}.sock"
        assert part.rig_socket == rig.socket.path and Path(part.recording.directory).name == part.axis
        assert part.protection.low["coil_c"] == 0.0 and part.protection.required[-1] == "coil_c"
    assert x.recording.budget_gb + y.recording.budget_gb == rig.recording.budget_gb
    assert len(rig.channels.names) == len(x.channels.names) + len(y.channels.names)
    assert rig.channels.index["air_c"] == rig.channels.index["x.air_c"]
    assert rig.channels.copies("air_c") == [rig.channels.index["y.air_c"]]
    assert rig.channels.copies("x.coil_c") == []


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("rig: {name: stage}\n", "", "'rig.name' is missing"),
        ("axes:\n", "points: {frame: {role: coil}}\naxes:\n", "frame is a coil: every axis has its own"),
        ("axes:\n", "points: {bench: {}}\naxes:\n", "'bench' is a point of all axes already"),
        ("points: {coil: {role: coil}, bench: {}}", "points: {bench: {}}", "one point with role: coil"),
        ("  x:\n", "  X-1:\n", "small letters and digits"),
        ("hal: {seed: 1}", "loop: {priority: 1}", "'loop'"),
        ("hal: {seed: 1}", "control: {kp: -1}", "control.kp"),
    ],
)
def test_mistakes_of_axes_are_told(tmp_path, old, new, message):
    path = simulated_axes(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as e:
        load_rig(path)
    assert str(e.value).startswith(f"{path}:")


def test_an_axis_must_be_named_and_known(tmp_path):
    path = simulated_axes(tmp_path)
    with pytest.raises(InputError, match="axes x, y; name one by --axis"):
        load_settings(path)
    with pytest.raises(InputError, match="no axis 'z'.*one of x, y"):
        load_settings(path, "z")


@pytest.mark.parametrize(
    "role, message",
    [
        ("position_um", "write x.position_um or y.position_um"),
        ("z.position_um", "'z.position_um' is no role"),
        ("x.bench", "did you mean 'x.bench_c'"),
    ],
)
def test_a_role_needs_its_axis(tmp_path, role, message):
    path = simulated_axes(tmp_path)
    devices = f"  devices: [{{name: encoder, profile: p.yaml, port: /dev/x, roles: {{position: {role}}}}}]\n"
    path.write_text(path.read_text().replace("  backend: simulated\n", f"  backend: simulated\n{devices}"))
    with pytest.raises(InputError, match=message):
        load_rig(path)


def run(command, path, *more):
    """The exit status of a command on this rig."""
    return cli.main([*command.split(), "--config", str(path), *more])


def test_gains_are_proposed_and_written_for_one_axis(tmp_path, capsys):
    path = simulated_axes(tmp_path)
    path.write_text(path.read_text().replace("    hal: {seed: 2}", "    control:\n      kp: 0.002\n"))
    assert run("tune", path, "--axis", "y", "--write") == 0
    assert "rig 'stage-y'" in capsys.readouterr().out
    x, y = load_rig(path).axes
    assert x.control.kp == 0.001 and y.control.kp > 0.002 and y.control.ti_s != x.control.ti_s
    assert run("tune", path, "--axis", "x", "--write") == 0
    x, again = load_rig(path).axes
    assert x.control.kp > 0.002 and again.control == y.control


def test_commands_of_the_whole_rig_take_no_axis(tmp_path, capsys):
    path = simulated_axes(tmp_path)
    for command in ("start", "stop", "restart", "virtual-rig", "service install"):
        with pytest.raises(SystemExit):
            run(command, path, "--axis", "x")
    assert "unrecognized arguments: --axis x" in capsys.readouterr().err
    assert run("run", path, "--axis", "x") == 2 and "--simulated-time" in capsys.readouterr().err
    assert run("arm", path) == 2 and "x, y; name one by --axis" in capsys.readouterr().err


def test_every_command_of_a_daemon_knows_its_axis(tmp_path, capsys):
    path = simulated_axes(tmp_path, more="  late_s: 10\n")
    rig = load_rig(path)
    assert run("start", path) == 0
    try:
        said = capsys.readouterr().out
        assert "READY, READY" in said
        assert run("arm", path, "--axis", "y") == 0 and run("setpoint 5", path, "--axis", "y") == 0
        capsys.readouterr()
        assert run("status", path) == 0
        both = capsys.readouterr().out
        assert both.index("axis x:\nREADY") < both.index("axis y:\nARMED")
        assert run("status", path, "--axis", "y", "--json") == 0
        status = json.loads(capsys.readouterr().out)
        assert (status["axis"], status["state"], status["setpoint_um"]) == ("y", "ARMED", 5.0)
        assert run("monitor", path, "--axis", "y", "--once") == 0 and "ARMED" in capsys.readouterr().out
        assert run("latency", path, "--axis", "x") == run("reload", path, "--axis", "x") == 0
        assert run("disarm", path) == 0
    finally:
        assert run("stop", path) == 0
    left = [*(shared_name(part) for part in rig.parts), shared_name(rig) + "-board"]
    assert not any(Path("/dev/shm", name).exists() for name in left)
    assert run("report", path, "--axis", "x", "--out", str(tmp_path / "r.zip")) == 0
    assert "stage-x-" in capsys.readouterr().out, "the report has this axis' recording"
    assert cli.main(["recordings", "list", str(tmp_path / "recordings"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {f["rig"] for f in found} == {"stage-x", "stage-y"}
    full = next(f["path"] for f in found if f["rig"] == "stage-y" and "10hz" not in f["path"])
    assert cli.main(["replay", full]) == 0 and "bit for bit" in capsys.readouterr().out


@pytest.fixture
def running(tmp_path):
    """The rig file and the settings of a daemon with two axes, y armed."""
    path = simulated_axes(tmp_path, more="  late_s: 10\n")
    path.write_text(path.read_text().replace("    hal: {seed: 2}", "    control: {kp: 0.001}"))
    assert run("start", path) == 0
    assert run("arm", path, "--axis", "y") == 0
    yield path, load_rig(path)
    assert run("stop", path) == 0


def of_axes(rig, key):
    """A number of the status of each axis."""
    return [ask(part.socket.path, {"command": "status"}, 30.0)[key] for part in rig.axes]


def test_a_reload_that_one_axis_refuses_changes_no_axis(running, capsys):
    path, rig = running
    good, log = path.read_text(), path.parent / "rig.log"
    bad = [
        ("kp: 0.001}", "kp: 0.01}", "the output of the armed rig would move"),
        ("kp: 0.001}", "kp: -1}", "control.kp"),
    ]
    for old, new, why in bad:
        path.write_text(good.replace(old, new).replace("kp: 0.001, ti_s", "kp: 0.0012, ti_s"))
        capsys.readouterr()
        assert run("reload", path) == 2
        said = capsys.readouterr().err
        assert why in said and said.count("\n") == 1
        before = log.read_text().count("reload error=")
        os.kill(holder(rig), signal.SIGHUP)
        wait(lambda n=before: log.read_text().count("reload error=") > n, "the refusal")
        assert why in log.read_text().splitlines()[-1]
        assert of_axes(rig, "generation") == [0, 0]
    path.write_text(good.replace("kp: 0.001, ti_s", "kp: 0.0012, ti_s"))
    os.kill(holder(rig), signal.SIGHUP)
    wait(lambda: of_axes(rig, "generation") == [1, 1], "the reload of both")
    assert run("reload", path) == 0 and of_axes(rig, "generation") == [2, 2]


def test_a_disarm_reaches_each_axis_although_one_gives_no_answer(running, capsys):
    path, rig = running
    children = sorted(psutil.Process(holder(rig)).children(), key=lambda p: (p.create_time(), p.pid))
    commands_x = children[2]  # loop, recorder x, commands x
    commands_x.suspend()
    try:
        begin, status = time.monotonic(), []
        thread = threading.Thread(target=lambda: status.append(run("disarm", path)))
        thread.start()
        y = rig.axes[1].socket.path
        wait(lambda: ask(y, {"command": "status"})["state"] != "ARMED", "y is disarmed")
        took_s = time.monotonic() - begin
        thread.join()
        assert status == [2] and took_s < 2.0
        print(f"y disarmed after {took_s:.2f} s")
    finally:
        commands_x.resume()
    assert "no answer within" in capsys.readouterr().err
