"""`thermoctl demo`: a rig of its own, ended safely by every signal, patient with a machine that stalls."""

import os
import pty
import select
import signal
import subprocess
import sys
import time

import psutil
import pytest

from tests.daemon.process import LIMIT_S, ROOT, wait
from thermoctl.cli import main
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon import lock
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.views import demo as view


class Shown:
    """A demo as a process of its own; `own` is the configuration that it wrote."""

    def __init__(self, config, **more):
        self.config = config
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "thermoctl.cli", "demo", "--config", str(config)],
            env={**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm", "COLUMNS": "100", "LINES": "40"},
            **{"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, **more},
        )
        self.folder = view.demo_folder(load_settings(config))

    @property
    def own(self):
        return load_settings(self.folder / "rig.yaml")

    def holder(self):
        return lock.holder(self.own) if (self.folder / "rig.yaml").exists() else None

    def until(self, state):
        return wait(
            lambda: (
                self.holder()
                and (s := ask(self.own.socket.path, {"command": "status"}))["state"] == state
                and s
            ),
            state,
        )[0]

    def close(self):
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(LIMIT_S)


@pytest.fixture
def shown(config):
    demo = Shown(config)
    yield demo
    demo.close()


def test_a_real_rig_is_refused(tmp_path, capsys):
    """Before, `THERMOCTL_CONFIG=config/wire.yaml thermoctl demo` armed it and drove 40 um (review_user S1)."""
    assert main(["demo", "--config", str(ROOT / "config/wire.yaml")]) == 2
    said = capsys.readouterr().err
    assert "simulated rig only" in said and "'devices'" in said and "thermoctl arm" in said
    assert not list(tmp_path.rglob("demo"))


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_every_signal_ends_it_with_the_amplifier_disabled(shown, how):
    assert shown.until("ARMED")["enable"] == 1.0
    shown.process.send_signal(how)
    code = shown.process.wait(LIMIT_S)
    wait(lambda: shown.holder() is None, "its daemon gone")
    log = (shown.folder / "rig.log").read_text()
    assert "thermoctl: stopped" in log.rstrip().splitlines()[-1]
    if how == signal.SIGKILL:
        return
    assert code == 0 and "the amplifier is disabled" in shown.process.stdout.read()
    assert log.index("was=ARMED now=") < log.rindex("thermoctl: stopped")


def test_a_signal_while_a_module_is_imported_still_ends_it_with_status_0():
    """Before, a demo that got SIGTERM while a data class was made ended with SIGINT (seen once in CI)."""
    code = (
        "import contextlib\nfrom thermoctl.interrupt import raise_on_signals\n"
        "raise_on_signals()\n"
        "with contextlib.suppress(KeyboardInterrupt):\n"
        "    exec('import os, signal; os.kill(os.getpid(), signal.SIGTERM)')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert done.returncode == 0


def test_a_second_demo_is_refused_and_disturbs_nothing(shown, capsys):
    shown.until("ARMED")
    log = (shown.folder / "rig.log").read_text()
    assert main(["demo", "--config", str(shown.config), "--seconds", "1"]) == 2
    assert "another demo runs here" in capsys.readouterr().err
    assert shown.until("ARMED") and (shown.folder / "rig.log").read_text().startswith(log)


def test_a_machine_that_stalls_slows_the_rig_down_and_trips_nothing(shown):
    """Before, 27 ms of lateness gave position_stale or following_error, with a remedy that led astray (review_user A2)."""
    before = shown.until("ARMED")
    pid = min(
        p.pid for p in psutil.Process(shown.holder()).children()
    )  # the supervisor starts the loop first
    for _ in range(3):
        os.kill(pid, signal.SIGSTOP)
        stopped = time.monotonic()
        wait(lambda since=stopped: time.monotonic() - since > 0.4, "0.4 s without a tick")
        os.kill(pid, signal.SIGCONT)
        at = ask(shown.own.socket.path, {"command": "status"})["ticks"]
        wait(lambda n=at: ask(shown.own.socket.path, {"command": "status"})["ticks"] > n + 50, "ticking on")
    now = ask(shown.own.socket.path, {"command": "status"})
    assert now["state"] == "ARMED" and now["faults"] == [] and now["slips"] > before["slips"] + 1000
    assert now["uptime_s"] == pytest.approx(now["ticks"] * 1e-3, abs=1e-6), "the rig's time counts ticks"


def test_a_fault_says_which_key_arms_again(config):
    config.write_text(
        config.read_text().replace(
            "  backend: simulated\n",
            "  backend: simulated\n  faults: [{kind: error, role: coil_c, at_s: 3, for_s: 1}]\n",
        )
    )
    ours, theirs = pty.openpty()
    demo = Shown(config, stdin=theirs, stdout=theirs, stderr=theirs, text=False)
    said = b""

    def shows(words):
        nonlocal said
        while select.select([ours], [], [], 0.0)[0]:
            said += os.read(ours, 65536)
        return words in said

    try:
        wait(lambda: shows(b"press a to acknowledge"), "the fault with its key")
        assert b"coil_error" in said
        wait(
            lambda: ask(demo.own.socket.path, {"command": "status"})["uptime_s"] > 4.2 and shows(b""),
            "mended",
        )
        said = b""
        os.write(ours, b"a")
        wait(lambda: shows(b" ARMED "), "armed again")
        os.write(ours, b"q")
        wait(lambda: shows(b"amplifier is disabled") or demo.process.poll() is not None, "the end")
        assert demo.process.wait(LIMIT_S) == 0
    finally:
        demo.close()
        os.close(ours)
        os.close(theirs)


def test_the_motion_repeats():
    assert [view.corner(t)[1] for t in (0.0, 69.9, 70.0, 89.9, 90.0, 161.0)] == [240, 240, 200, 200, 240, 200]
    assert view.corner(161.0)[0] == 160.0
