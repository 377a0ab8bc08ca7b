"""The daemon as a whole, its real processes on the simulated rig: commands, reload, and every way of dying."""

import contextlib
import errno
import json
import os
import re
import signal
import socket
import subprocess
import sys
from multiprocessing import Value
from pathlib import Path
from types import SimpleNamespace

import psutil
import pyarrow as pa
import pytest
import yaml

from tests.daemon.process import LIMIT_S, ROOT, Daemon, wait
from thermoctl.cli import main
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon import processes
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.lock import holder, lock_path
from thermoctl.recording.reader import info


@pytest.fixture
def unrecorded(config):
    config.write_text(config.read_text().replace("recording:", "recording:\n  enable: false"))
    return config


@pytest.fixture
def daemon(unrecorded):
    d = Daemon(unrecorded)
    assert d.process.poll() is None, d.log
    yield d
    d.kill()


def test_a_session(daemon, capsys, monkeypatch):
    """Arm, move, reload, read, disarm and stop, as a person would from the command line."""
    monkeypatch.setenv("THERMOCTL_CONFIG", str(daemon.config))
    assert main(["setpoint", "5"]) == 1 and "only when armed" in capsys.readouterr().err
    assert main(["arm"]) == 0 and capsys.readouterr().out.startswith("ARMED, setpoint ")
    assert main(["setpoint", "4"]) == 0
    wait(lambda: abs(daemon.ask("status")["compensated_um"] - 4.0) < 0.2, "the stage at 4 um")
    assert (
        main(["setpoint", "4000"]) == 1
        and "control.setpoint_low_um..setpoint_high_um" in capsys.readouterr().err
    )
    assert main(["status", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {
        "state",
        "ticks",
        "slips",
        "setpoint_um",
        "position_um",
        "compensation_um",
        "faults",
    } <= found.keys()
    assert found["state"] == "ARMED" and found["setpoint_um"] == 4.0 and found["faults"] == []
    assert main(["latency", "--json"]) == 0
    latency = json.loads(capsys.readouterr().out)
    assert latency["lateness"]["count"] > 100 and latency["reference"]["count"] > 100
    assert main(["latency"]) == 0 and "idle loop's lateness" in capsys.readouterr().out
    assert main(["disarm"]) == 0
    wait(lambda: daemon.ask("status")["enable"] == 0.0, "the amplifier disabled")
    daemon.process.terminate()
    assert daemon.process.wait(LIMIT_S) == 0
    assert not Path(daemon.settings.socket.path).exists()
    assert main(["status"]) == 1 and "not running" in capsys.readouterr().err
    assert "stopped" in daemon.log and "was=READY now=ARMED" in daemon.log


def test_reload_applies_whole_files_only(daemon):
    daemon.ask("arm")
    daemon.ask("setpoint", value=3.0)
    text = daemon.config.read_text()
    before = daemon.ask("status")["ticks"]
    daemon.config.write_text(text.replace("kp: 0.01", "kp: 0.008").replace("priority: 80", "priority: 70"))
    answer = daemon.ask("reload")
    assert (
        answer["ok"] and answer["applied"] == ["control.kp"] and answer["needs_restart"] == ["loop.priority"]
    )
    daemon.config.write_text(text.replace("kp: 0.01", "kp: 0.005").replace("ti_s: 0.004", "ti_s: never"))
    answer = daemon.ask("reload")
    line = text[: text.index("ti_s:")].count("\n") + 1
    assert not answer["ok"] and "control.ti_s" in answer["error"] and f":{line}:9:" in answer["error"]
    daemon.config.write_text(text.replace("kp: 0.01", "kp: 0.006"))
    daemon.process.send_signal(signal.SIGHUP)
    wait(lambda: daemon.ask("status")["generation"] == 2, "the reload by SIGHUP")
    now = daemon.ask("status")
    assert now["state"] == "ARMED" and now["ticks"] > before and now["setpoint_um"] == 3.0


def test_the_gains_of_a_reload_are_in_its_recording_and_outlast_the_command_process(config):
    """The new file had the new gains for a replay, and the old ones in its configuration."""
    daemon = Daemon(config)
    try:
        wait(lambda: daemon.ask("status")["recorder"]["rows"] > 0, "the recorder")
        config.write_text(config.read_text().replace("kp: 0.01", "kp: 0.012"))
        assert daemon.ask("reload")["applied"] == ["control.kp"]
        folder = Path(daemon.settings.recording.directory)
        wait(lambda: len([*folder.glob("*Z.arrows")]) == 2, "a new file")
        texts = [
            pa.ipc.open_stream(f).schema.metadata[b"config"].decode()
            for f in sorted(folder.glob("*Z.arrows"))
        ]
        assert [yaml.safe_load(text)["control"]["kp"] for text in texts] == [0.01, 0.012]
        os.kill(daemon.child("commands"), signal.SIGKILL)
        wait(lambda: daemon.ask("gains")["kp"] == 0.012, "the gains from the new command process")
    finally:
        daemon.kill()


JUMPS = (
    ("kp: 0.01", "kp: 1.0", "control.kp 0.01 -> 1"),
    ("kp: 0.01", "kp: 0.001", "control.kp 0.01 -> 0.001"),
    ("ti_s: 0.004", "ti_s: 0.0004", "control.ti_s 0.004 -> 0.0004"),
    ("td_s: 0.001", "td_s: 0", "control.td_s 0.001 -> 0"),
    ("output_limit: 1.5", "output_limit: 0.01", "control.output_limit 1.5 -> 0.01"),
    ("moving_average: 4", "moving_average: 64", "control.moving_average 4 -> 64"),
    (
        "setpoint_rate_um_s: 1 mm/min",
        "setpoint_rate_um_s: 1e6",
        "control.setpoint_rate_um_s 16.6667 -> 1e+06",
    ),
    ("slew_um_s: 1\n", "slew_um_s: 1e4\n", "compensation.slew_um_s 1 -> 10000"),
    ("setpoint_high_um: 250", "setpoint_high_um: 2", "high_um -250..2, the setpoint is 3 now"),
    ("setpoint_low_um: -250", "setpoint_low_um: 4", "high_um 4..250, the setpoint is 3 now"),
    ("enable: true", "enable: false", "compensation.enable true -> false"),
)


def test_a_reload_moves_no_armed_output_by_a_jump(daemon):
    """A gain 100 times larger drove the coil to its limit; now it is refused with the way to it."""
    text = daemon.config.read_text()
    daemon.ask("arm")
    daemon.ask("setpoint", value=3.0)
    wait(lambda: daemon.ask("status")["reference_um"] == 3.0, "the reference at 3 um")
    for old, new, named in JUMPS:
        assert old in text, old
        daemon.config.write_text(text.replace(old, new, 1))
        answer = daemon.ask("reload")
        assert not answer["ok"] and named in answer["error"] and "disarm" in answer["error"], answer
    now = daemon.ask("status")
    assert now["state"] == "ARMED" and now["generation"] == 0 and abs(now["compensated_um"] - 3.0) < 0.5
    daemon.ask("disarm")
    daemon.config.write_text(text.replace("kp: 0.01", "kp: 0.02"))
    assert daemon.ask("reload")["applied"] == ["control.kp"]  # disarmed: nothing to jump


def test_a_reload_takes_no_limit_away(daemon):
    """A file that was cut at the end of a line was valid, and missing limits took their defaults."""
    text = daemon.config.read_text()
    for line in ("drift_limit_c: 4", "current_tolerance_a: 0.02", "setpoint_low_um: -250", "bound_um: 40"):
        daemon.config.write_text(text.replace(f"  {line}\n", "", 1).replace(f"  {line} ", "  # ", 1))
        answer = daemon.ask("reload")
        assert not answer["ok"] and f"{line.split(':')[0]}: in force, and no longer in" in answer["error"]
    daemon.config.write_text(text.replace("stale_s: {position_um: 0.01, ", "stale_s: {"))
    assert "protection.stale_s.position_um: in force" in daemon.ask("reload")["error"]
    daemon.config.write_text(text.replace("coil_limit_c: 80", "coil_limit_c: 85"))
    assert daemon.ask("reload")["applied"] == ["protection.coil_limit_c"]


@pytest.mark.parametrize(
    "old, new, named",
    [
        ("control:", "control:\n  mode: position", "control.mode"),
        ("rig: {name: simulated}", "rig: {name: simulated}\npoints: {coil: {role: coil}, POINTS}", "points"),
    ],
)
def test_an_option_that_needs_a_restart_stays_out_of_the_running_law(daemon, old, new, named):
    """The law took `mode: position` by a reload: the drive became the target in um, at its limit."""
    text = daemon.config.read_text()
    daemon.ask("arm")
    daemon.ask("setpoint", value=3.0)
    wait(lambda: daemon.ask("status")["reference_um"] == 3.0, "the reference at 3 um")
    names = [name for name in daemon.settings.channels.point_names if name != "coil"]
    points = ", ".join(f"{name}: {{}}" for name in (*names, "one_more"))
    daemon.config.write_text(text.replace(old, new.replace("POINTS", points), 1))
    answer = daemon.ask("reload")
    assert not answer["ok"] or named in answer["needs_restart"], answer
    ticks = daemon.ask("status")["ticks"]
    wait(lambda: daemon.ask("status")["ticks"] > ticks + 300, "300 ticks more")
    now = daemon.ask("status")
    assert now["state"] == "ARMED" and abs(now["compensated_um"] - 3.0) < 0.5 and abs(now["drive"]) < 0.5


def test_a_reload_that_takes_long_starves_no_watchdog(unrecorded, tmp_path, monkeypatch):
    """On a loaded machine the answer took longer than systemd's WatchdogSec, which then killed an armed rig."""
    heard = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    heard.bind(str(tmp_path / "notify"))
    heard.settimeout(LIMIT_S)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    daemon = Daemon(unrecorded)
    try:
        commands = daemon.child("commands")
        os.kill(commands, signal.SIGSTOP)  # it answers nothing
        before = len(psutil.Process(daemon.process.pid).children())
        daemon.process.send_signal(signal.SIGHUP)
        wait(lambda: len(psutil.Process(daemon.process.pid).children()) > before, "the reload begins")
        heard.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while heard.recv(100):
                pass
        heard.settimeout(LIMIT_S)
        fed = 0
        while fed < 10:
            fed += heard.recv(100) == b"WATCHDOG=1"
        assert "thermoctl: reload" not in daemon.log
        os.kill(commands, signal.SIGCONT)
        wait(lambda: "thermoctl: reload ok=True" in daemon.log, "the reload")
        daemon.process.terminate()  # the end may take longer, too
        while (said := heard.recv(100)) == b"WATCHDOG=1":
            pass
        assert re.fullmatch(rb"STOPPING=1\nWATCHDOG_USEC=\d{8}", said)
    finally:
        daemon.kill()
        heard.close()


def test_bad_clients_cost_nothing(daemon):
    """Garbage, an endless line, a client that never reads, a flood: answered or dropped, and the loop ticks on."""
    path = daemon.settings.socket.path
    ticks = daemon.ask("status")["ticks"]
    for data in (
        b"\xff\xfe\n",
        b"[]\n",
        b'{"command": 3}\n',
        b'{"command": "fly"}\n',
        b"[" * 5000 + b"\n",
        b'{"command": "setpoint", "value": "NaN"}\n',
        b'{"command": "setpoint", "value": NaN}\n',
    ):
        with socket.socket(socket.AF_UNIX) as s:
            s.connect(path)
            s.settimeout(5)
            s.sendall(data)
            assert json.loads(s.recv(65536))["ok"] is False
    with socket.socket(socket.AF_UNIX) as endless:
        endless.connect(path)
        with pytest.raises(OSError):
            for _ in range(100):
                endless.sendall(b"x" * 65536)
    with socket.socket(socket.AF_UNIX) as deaf:
        deaf.connect(path)
        deaf.setblocking(False)
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            for _ in range(20000):
                deaf.send(b'{"command": "latency"}\n')
        assert daemon.ask("status")["ok"]
    status, _ = wait(lambda: (s := daemon.ask("status"))["ticks"] > ticks + 100 and s, "the loop ticking on")
    assert status["state"] == "READY"


def test_the_socket_is_for_owner_and_group(daemon):
    assert Path(daemon.settings.socket.path).stat().st_mode & 0o777 == 0o660


def test_a_second_daemon_is_refused(daemon, capsys):
    assert main(["run", "--config", str(daemon.config)]) == 2
    assert "another daemon runs" in capsys.readouterr().err
    assert daemon.ask("status")["ok"]


def test_an_armed_daemon_whose_files_were_deleted_is_still_alone_and_obeys(daemon, capsys):
    """A second one took over socket and segment; the first drove on, and no command reached it."""
    daemon.ask("arm")
    lock = lock_path(daemon.settings)
    for path in (lock, Path(daemon.settings.socket.path)):
        path.unlink()
    assert main(["run", "--config", str(daemon.config)]) == 2
    assert "another daemon holds this rig, and may drive it" in capsys.readouterr().err
    lock.unlink(missing_ok=True)
    wait(lambda: daemon.ask("status")["state"] == "ARMED", "a socket")
    wait(lambda: holder(daemon.settings) == daemon.process.pid, "its lock")
    assert "the command socket was deleted" in daemon.log
    assert main(["stop", "--config", str(daemon.config)]) == 0 and daemon.process.wait(LIMIT_S) == 0


@pytest.mark.parametrize("name", ["commands", "reference"])
def test_a_helper_that_is_killed_comes_back_and_the_loop_runs_on(daemon, name):
    daemon.ask("arm")
    pid, ticks = daemon.child(name), daemon.ask("status")["ticks"]
    os.kill(pid, signal.SIGKILL)
    wait(
        lambda: not psutil.pid_exists(pid) and f"{name} ended, started again" in daemon.log,
        "its end is noticed",
    )
    now, _ = wait(lambda: daemon.ask("status"), "an answer")
    assert now["state"] == "ARMED" and now["ticks"] > ticks and daemon.process.poll() is None


def test_a_helper_that_the_system_cannot_start_ends_nothing(monkeypatch):
    """Without a free process the supervisor ended, and with it an armed rig; now it tries again."""
    said, count = [], Value("i", 0)

    def main(_):
        count.value += 1
        return 0

    def log(event, **_):
        said.append(event)

    child = processes.Child("recorder", main, SimpleNamespace(axis=""))
    child.start()
    child.process.join()
    with monkeypatch.context() as m:
        m.setattr(
            os, "fork", lambda: (_ for _ in ()).throw(BlockingIOError(errno.EAGAIN, "no process is left"))
        )
        for now in (1e3, 2e3, 3e3, 4e3):
            processes.restart([child], child.started + now, log)
    assert said.count("recorder cannot be started; the loop runs on") == 2 and count.value == 1
    for now in (5e3, 6e3):
        processes.restart([child], child.started + now, log)
    child.process.join()
    assert count.value == 2


def test_a_service_manager_that_reads_no_message_holds_nothing_up(unrecorded, tmp_path, monkeypatch):
    """As systemd after a crash of its own: the supervisor waited for ever, and no signal ended the daemon."""
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.setblocking(False)
    filler = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    filler.setblocking(False)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    daemon = Daemon(unrecorded)
    try:
        daemon.ask("arm")
        with contextlib.suppress(BlockingIOError):
            while True:
                filler.sendto(b"X=1", str(tmp_path / "notify"))
        ticks = daemon.ask("status")["ticks"]
        wait(lambda: daemon.ask("status")["ticks"] > ticks + 1000, "ticks")
        assert daemon.ask("status")["state"] == "ARMED"
        daemon.process.terminate()
        assert daemon.process.wait(30) == 0
    finally:
        daemon.kill()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGSEGV])
def test_a_loop_that_dies_or_stands_still_ends_the_daemon_with_a_safe_amplifier(daemon, how):
    daemon.ask("arm")
    os.kill(daemon.child("loop"), how)
    assert daemon.process.wait(LIMIT_S) == 1
    assert "the loop" in daemon.log and "could not be disabled" not in daemon.log
    assert not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in daemon.family)


def test_a_supervisor_that_is_killed_takes_all_with_it(daemon):
    daemon.ask("arm")
    daemon.process.kill()
    daemon.process.wait()
    wait(lambda: not any(p.is_running() for p in daemon.family), "all children gone", 10.0)
    again = Daemon(daemon.config)
    try:
        assert again.ask("status")["state"] == "READY"  # never ARMED by itself
    finally:
        again.kill()


def test_the_first_fault_is_logged_with_its_remedy(unrecorded):
    text = unrecorded.read_text().replace("air_c: 45", "air_c: 10")
    unrecorded.write_text(text.replace("air_c: 5,", "air_c: 4,"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-m", "thermoctl.cli", "run", "--config", str(unrecorded)],
        text=True,
        stderr=subprocess.PIPE,
        env=environment,
    ) as process:
        line = next(line for line in process.stderr if "air_range" in line)
        assert "remedy=" in line and "protection.low..high" in line
        path = load_settings(unrecorded).socket.path
        answer, _ = wait(lambda: ask(path, {"command": "arm"}), "an answer")
        assert not answer["ok"] and "air_range" in answer["error"] and answer["state"] == "SAFE"
        process.terminate()
        process.communicate()


def test_start_and_stop_in_the_background(unrecorded, capsys, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    config = ["--config", str(unrecorded)]
    assert main(["stop", *config]) == 0
    assert main(["start", *config]) == 0
    try:
        assert main(["start", *config]) == 0 and "already running" in capsys.readouterr().out
        assert main(["status", *config]) == 0
        assert main(["restart", *config]) == 0
    finally:
        assert main(["stop", *config]) == 0
    assert main(["status", *config]) == 1


def test_start_tells_why_it_failed(unrecorded, capsys, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    plant = Path(unrecorded).with_name("plant.yaml")
    plant.write_text("format: thermoctl-plant/1\ntitle: nothing\n")
    unrecorded.write_text(unrecorded.read_text().replace(f"{ROOT}/config/plants/actuator.yaml", "plant.yaml"))
    assert main(["start", "--config", str(unrecorded)]) == 3
    error = capsys.readouterr().err
    assert "plant.yaml" in error and "Traceback" not in error


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("kp: 0.01", "kpp: 0.01", "control: unknown key 'kpp' (did you mean 'kp'?)"),
        ("kp: 0.01", "kp: -1", "control.kp: -1 is outside 0 .. 1000 1/um"),
        ("period_s: 1 ms", "period_s: 1 kg", "the unit does not fit"),
        ("period_s: 1 ms", "period_s: soon", "a number in s was expected"),
        ("control:", "controll:", "(did you mean 'control'?)"),
        ("backend: simulated", "backend: simulatd", "(did you mean 'simulated'?)"),
        ("kp: 0.01", "kp: 0.01\n  kp: 0.02", "stands twice"),
        ("moving_average: 4", "moving_average: 4.5", "a whole number was expected"),
        ("enable: true", "enable: maybe", "true or false was expected"),
        ("required: [position_um", "required: [postion_um", "(did you mean 'position_um'?)"),
        ("setpoint_high_um: 250", "setpoint_high_um: -300", "must be above"),
        ("  kp: 0.01\n", "", "'control.kp' is missing"),
        ("  plant:", "  roles: 7\n  plant:", "a mapping (key: value) was expected"),
        ("rig: {name: simulated}", "rig: 3", "a mapping (key: value) was expected"),
    ],
)
def test_a_bad_configuration_is_one_good_line(config, old, new, message, capsys):
    assert old in config.read_text()
    config.write_text(config.read_text().replace(old, new, 1))
    assert main(["check", str(config)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and f"{config}:" in error
    place = error.split(f"{config}:")[1].split(":")
    assert int(place[0]) > 0 and int(place[1]) > 0


def test_check_and_doctor_find_the_example_good(config, capsys):
    assert main(["check", str(config)]) == 0 and "good" in capsys.readouterr().out
    assert main(["doctor", str(config), "--seconds", "0.3"]) == 0
    assert "coil_c" in capsys.readouterr().out


def full_rate(daemon):
    """The full-rate recordings, oldest first."""
    return sorted(
        p for p in Path(daemon.settings.recording.directory).glob("*.arrows") if ".10hz" not in p.name
    )


def on_disk(daemon, count):
    """Rows on the disk of the newest recording, once there are `count` of them."""
    files = full_rate(daemon)
    return info(files[-1]).rows if len(files) == count else 0


def test_what_a_session_recorded_replays_to_the_bit(config, capsys):
    """A real-time run with arming, motion, a reload and a recorder that is killed: every file replays to the bit."""
    daemon = Daemon(config)
    try:
        daemon.ask("arm")
        daemon.ask("setpoint", value=3.0)
        wait(lambda: daemon.ask("status")["reference_um"] == 3.0, "the reference at 3 um")
        config.write_text(config.read_text().replace("kp: 0.01", "kp: 0.007"))
        assert daemon.ask("reload")["applied"] == ["control.kp"]
        wait(lambda: on_disk(daemon, 2) > 1000, "the second file's rows on the disk")
        os.kill(daemon.child("recorder"), signal.SIGKILL)
        wait(lambda: "recorder ended, started again" in daemon.log, "its end is noticed")
        wait(lambda: on_disk(daemon, 3) > 2000, "it records again")
        now = daemon.ask("status")
        assert now["state"] == "ARMED", now["faults"]
        daemon.ask("disarm")
        daemon.process.terminate()
        assert daemon.process.wait(LIMIT_S) == 0
    finally:
        daemon.kill()
    files = full_rate(daemon)
    assert len(files) == 3  # the start, after the reload, after the kill
    rows = 0
    for path in files:
        assert main(["replay", str(path)]) == 0
        out = capsys.readouterr().out
        assert "bit for bit" in out and "rig simulated, run 2" in out
        # a recorder that starts while the loop runs has rows of the ring before its stored state
        replayed, skipped = re.search(r": (\d+) ticks replayed in \S+ s(?:, (\d+) before)?", out).groups("0")
        assert int(replayed) > int(skipped)
        rows += int(replayed) + int(skipped)
    assert rows == sum(info(path).rows for path in files) > 2000  # what was seen on the disk of the last two
    assert main(["replay", str(config)]) == 2 and "rig.yaml" in capsys.readouterr().err
