"""start, stop, restart and status know a daemon by its lock and socket; the systemd units, installed below a directory."""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.daemon.process import ROOT, Daemon
from thermoctl.cli import main
from thermoctl.cli.completion import PLACES
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon import lock, service
from thermoctl.files.yamlfile import InputError


# ------------------------------------------------------------------------------------------------ lock and socket
@pytest.fixture
def unrecorded(config):
    config.write_text(config.read_text().replace("recording:", "recording:\n  enable: false"))
    yield config
    with contextlib.suppress(InputError):  # what a test that failed left running
        service.stop(load_settings(config))


@pytest.fixture
def daemon(unrecorded):
    """As `thermoctl run` in another terminal starts it."""
    d = Daemon(unrecorded)
    yield d
    d.kill()


def another(config, tmp_path):
    """The configuration of a second rig."""
    other = tmp_path / "other.yaml"
    text = (
        config.read_text().replace("simulated.sock", "other.sock").replace("name: simulated", "name: axis 2")
    )
    other.write_text(re.sub(r"(?m)^  model: .*$", "  model: ''", text))
    return other


def test_a_daemon_of_run_is_found_restarted_and_stopped(daemon, unrecorded, capsys):
    """Before: start said 'started', restart restarted nothing, stop said 'not running' with status 0 (review_wire B7)."""
    flag, pid = ["--config", str(unrecorded)], daemon.process.pid
    assert lock.holder(daemon.settings) == pid
    assert main(["start", *flag]) == 0
    assert capsys.readouterr().out == f"already running (pid {pid}, READY)\n"
    assert daemon.ask("arm")["ok"]
    assert main(["restart", *flag]) == 0
    out = capsys.readouterr().out
    assert daemon.process.wait(30) == 0
    assert out.startswith(f"stopped (pid {pid})\nstarted (pid ")
    log = daemon.log
    assert log.index("was=ARMED now=") < log.index("thermoctl: stopped"), "disarmed before its end"
    now = lock.holder(daemon.settings)
    assert now not in (None, pid) and f"(pid {now}, READY" in out
    assert main(["stop", *flag]) == 0 and capsys.readouterr().out == f"stopped (pid {now})\n"
    assert lock.holder(daemon.settings) is None
    assert main(["stop", *flag]) == 0 and capsys.readouterr().out == "not running\n"


@pytest.mark.parametrize("harm", ["cut off", "gone", "another socket"])
def test_an_armed_rig_whose_file_names_its_socket_no_more(daemon, unrecorded, capsys, harm):
    """`disarm` and `stop` said 'not running', and `restart` began a second daemon beside the armed one."""
    text, flag = unrecorded.read_text(), ["--config", str(unrecorded)]
    assert daemon.ask("arm")["ok"]
    if harm == "gone":
        unrecorded.unlink()
    else:
        cut = text[: text.index("protection:")] + "prot"
        unrecorded.write_text(cut if harm == "cut off" else text.replace("simulated.sock", "other.sock"))
        assert main(["run", *flag]) == 2 and "not running" not in capsys.readouterr().err
    assert main(["disarm", *flag]) == 0
    assert daemon.ask("status")["state"] == "READY"
    assert main(["stop", *flag]) == 0 and daemon.process.wait(30) == 0
    assert capsys.readouterr().out.endswith(f"stopped (pid {daemon.process.pid})\n")
    unrecorded.write_text(text)


def test_stop_leaves_the_rig_of_another_configuration_alone(daemon, unrecorded, tmp_path, capsys):
    assert daemon.ask("arm")["ok"]
    assert main(["stop", "--config", str(another(unrecorded, tmp_path))]) == 0
    assert capsys.readouterr().out == "not running\n"
    assert daemon.ask("status")["state"] == "ARMED"


def test_two_operators_start_one_rig(unrecorded):
    """The second one was told that the daemon did not start, below a line of the first one's log."""

    def command(word):
        return subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", word, "--config", str(unrecorded)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT}/hal"},
        )

    both = [command("start"), command("start")]
    said = sorted(p.communicate(timeout=90)[0] for p in both)
    assert [p.returncode for p in both] == [0, 0], said
    assert said[0].startswith("already running (pid ") and said[1].startswith("started (pid "), said
    ends = command("stop")
    while (
        lock.holder(load_settings(unrecorded)) and service._state(load_settings(unrecorded)) != service.SILENT
    ):
        assert ends.poll() is None or lock.holder(load_settings(unrecorded)) is None
    begins = command("start")  # while the old daemon still ends
    assert ends.wait(60) == 0 and begins.communicate(timeout=90)[0].startswith("started (pid ")


def test_start_gives_the_daemons_own_error(unrecorded, capsys):
    text = unrecorded.read_text()
    unrecorded.write_text(re.sub(r"plant: \S+", "plant: gone.yaml", text))
    assert main(["start", "--config", str(unrecorded)]) == 3
    said = capsys.readouterr()
    assert "started" not in said.out and "gone.yaml" in said.err and "the daemon did not start" in said.err
    assert lock.holder(load_settings(unrecorded)) is None


def test_status_and_doctor_of_a_rig_that_is_held_without_a_socket(unrecorded, capsys):
    """As by `tune`, or a daemon that is starting."""
    file = lock.hold(load_settings(unrecorded))
    try:
        assert main(["status", "--config", str(unrecorded)]) == 1
        assert f"pid {os.getpid()} holds the rig" in capsys.readouterr().err
        assert main(["doctor", "--config", str(unrecorded)]) == 2
        assert f"pid {os.getpid()} holds the rig" in capsys.readouterr().err
        assert main(["run", "--config", str(unrecorded)]) == 2
        assert f"pid {os.getpid()}" in capsys.readouterr().err
    finally:
        os.close(file)
    assert lock.holder(load_settings(unrecorded)) is None


def test_looking_at_the_lock_never_keeps_a_daemon_from_taking_it(settings):
    looking = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys; from thermoctl.daemon.lock import holder; from thermoctl.configuration.settings import load_settings\n"
            "s = load_settings(sys.argv[1]); print('on', flush=True)\nwhile True: holder(s)",
            settings.path,
        ],
        stdout=subprocess.PIPE,
        cwd=ROOT,
    )
    try:
        looking.stdout.readline()
        for _ in range(200):
            os.close(lock.hold(settings))
    finally:
        looking.kill()
        looking.wait()


def test_start_from_a_folder_that_holds_a_folder_thermoctl(unrecorded, tmp_path, monkeypatch, capsys):
    """As beside a clone, with the program installed elsewhere: the folder shadowed the package (review_user A7)."""
    (tmp_path / "here/thermoctl").mkdir(parents=True)
    (tmp_path / "here/thermoctl/__init__.py").write_text("raise SystemExit('the wrong package')\n")
    monkeypatch.chdir(tmp_path / "here")
    assert main(["start", "--config", str(unrecorded)]) == 0, capsys.readouterr().err
    assert main(["stop", "--config", str(unrecorded)]) == 0


# ---------------------------------------------------------------------------------------------------------- units
@pytest.fixture
def installed(config, tmp_path):
    root = tmp_path / "root"
    assert main(["service", "install", "--config", str(config), "--root", str(root)]) == 0
    return root


def test_install_and_uninstall_leave_nothing(installed, config):
    unit = (installed / "etc/systemd/system/thermoctl.service").read_text()
    assert "@PROGRAM@" not in unit and f"run --config {config}" in unit
    for line in ("Type=notify", "WatchdogSec=2", "MemoryDenyWriteExecute=yes", "LimitMEMLOCK=infinity"):
        assert line in unit
    assert len([p for p in installed.rglob("*") if p.is_file()]) == 4 + len(PLACES)
    assert main(["service", "uninstall", "--root", str(installed)]) == 0
    assert not [p for p in installed.rglob("*") if p.is_file()]


def test_a_second_rig_gets_a_unit_of_its_own(installed, config, tmp_path, capsys):
    """Before, it overwrote the first one's without a word (review_wire B13)."""
    first = installed / "etc/systemd/system/thermoctl.service"
    before, other = first.read_text(), another(config, tmp_path)
    root = ["--root", str(installed)]
    assert main(["service", "install", "--config", str(other), *root]) == 0
    assert "thermoctl-axis-2.service" in capsys.readouterr().out
    assert first.read_text() == before
    assert main(["service", "install", "--config", str(other), *root]) == 0  # again: the same unit
    assert service.units(installed) == {"thermoctl.service": config, "thermoctl-axis-2.service": other}
    third = tmp_path / "third.yaml"
    third.write_text(other.read_text())
    capsys.readouterr()
    assert main(["service", "install", "--config", str(third), *root]) == 2
    assert "socket.path" in capsys.readouterr().err
    third.write_text(other.read_text().replace("other.sock", "third.sock"))
    assert main(["service", "install", "--config", str(third), *root]) == 2
    assert "rig.name 'axis 2'" in capsys.readouterr().err
    assert main(["service", "uninstall", *root]) == 1 and "which unit?" in capsys.readouterr().err
    assert main(["service", "uninstall", "--config", str(other), *root]) == 0
    assert first.read_text() == before and (installed / PLACES["bash"]).exists()
    assert main(["service", "uninstall", "--config", str(config), *root]) == 0
    assert not [p for p in installed.rglob("*") if p.is_file()]


def home_rig(folder, **more):
    """A rig as in a clone in a home folder: program, configuration, recordings and socket lie there."""
    folder.mkdir(parents=True)
    path = folder / "rig.yaml"
    path.write_text(
        (ROOT / "config/simulated.yaml").read_text()
        .replace("plants/", f"{ROOT}/config/plants/").replace("models/", f"{ROOT}/config/models/")
    )  # fmt: skip
    return path


def test_the_running_system_gets_no_unit_that_cannot_see_its_files(tmp_path, monkeypatch, capsys):
    """Before, seven lines `wrote ...` and exit 0 (review_user_3 A3)."""
    rig = home_rig(tmp_path / "pi/rig/config")
    monkeypatch.setattr(service, "HIDDEN", (tmp_path,))
    monkeypatch.setattr(service, "_program", lambda: tmp_path / "pi/.venv/bin/thermoctl")
    monkeypatch.setattr(Path, "write_text", lambda *a, **k: pytest.fail("something was written"))
    assert main(["service", "install", "--config", str(rig)]) == 2
    said = capsys.readouterr().err
    for words in (
        f"program {tmp_path}/pi/.venv/bin/thermoctl", "/opt/thermoctl",
        f"configuration {rig}", "/etc/thermoctl",
        f"recording.directory {tmp_path}/pi/rig/recordings: write recording.directory: /var/lib/thermoctl/recordings",
        f"socket.path {tmp_path}/pi/rig/run/", "write socket.path: /run/thermoctl/",
    ):  # fmt: skip
        assert words in said, (words, said)


def test_below_another_root_the_same_is_a_warning(installed, config, capsys):
    assert (installed / "etc/systemd/system/thermoctl.service").exists()
    main(["service", "install", "--config", str(config), "--root", str(installed)])
    assert "this unit could not start" in capsys.readouterr().err


def test_files_in_system_folders_are_seen(tmp_path, monkeypatch):
    rig = home_rig(tmp_path / "etc/thermoctl")
    rig.write_text(
        re.sub(
            r"path: .*",
            "path: /run/thermoctl/rig.sock",
            rig.read_text().replace("../recordings", "/var/lib/thermoctl/rec"),
        )
    )
    monkeypatch.setattr(service, "HIDDEN", (tmp_path / "home",))
    assert service.unseen(load_settings(rig)) == []
    rig.chmod(0o600)
    assert ["chmod o+r" in line for line in service.unseen(load_settings(rig))] == [True]


@pytest.fixture
def systemd(installed, monkeypatch, tmp_path):
    """systemd as far as the commands use it: units below `installed`, and what systemctl was asked to do."""
    asked = []
    monkeypatch.setattr(service, "LIVE", tmp_path)
    monkeypatch.setattr(service, "units", lambda root=installed, of=service.units: of(root))
    monkeypatch.setattr(service, "_systemctl", lambda *a: asked.append(a) or 3)
    return asked


def test_only_the_unit_of_this_configuration_is_started(systemd, config, tmp_path, capsys):
    assert main(["start", "--config", str(config)]) == 3
    assert systemd == [("start", "thermoctl.service")] and "journalctl -u" in capsys.readouterr().err
    assert main(["stop", "--config", str(config)]) == 0 and len(systemd) == 1  # nobody holds it
    assert service._unit_for(load_settings(another(config, tmp_path))) is None


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze (package systemd)")
def test_exposure_is_at_most_two(installed):
    unit: Path = installed / "etc/systemd/system/thermoctl.service"
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)],
        text=True,
        capture_output=True,
        check=False,
    )
    exposure = re.search(r"Overall exposure level for thermoctl.service: ([\d.]+)", done.stdout)
    assert exposure and float(exposure[1]) <= 2.0, done.stdout + done.stderr
