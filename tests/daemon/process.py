"""The daemon as a process of its own, `thermoctl run` on a configuration, as tests drive it."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.tick.assemble import shared_name
from thermoctl.files.yamlfile import InputError

ROOT = Path(__file__).resolve().parents[2]
for _number in (signal.SIGINT, signal.SIGHUP):
    # a shell's background and nohup ignore them: what a test starts would inherit that
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.SIG_DFL)

LIMIT_S = 120.0


def wait(condition, what, limit_s=LIMIT_S):
    """(the first true value of condition(), seconds until it came)."""
    begin = time.monotonic()
    while time.monotonic() - begin < limit_s:
        with contextlib.suppress(InputError, psutil.Error):
            if found := condition():
                return found, time.monotonic() - begin
        time.sleep(0.01)  # how often we look, not a wait
    raise AssertionError(f"{what}: not within {limit_s} s")


def forget(settings):
    """Remove the shared memory of a daemon that was killed: nobody is left to do it."""
    for name in (*map(shared_name, settings.parts), shared_name(settings) + "-board"):
        Path("/dev/shm", name).unlink(missing_ok=True)


def patient(path):
    """Let a copy of config/simulated.yaml count time in ticks: a stall of the machine stops the rig, too."""
    text = path.read_text()
    assert text.count("loop:\n") == 1
    path.write_text(text.replace("loop:\n", "loop:\n  pace: tick\n"))
    return path


class Daemon:
    """`thermoctl run`, READY unless it ended at once, with its log beside the configuration."""

    def __init__(self, config):
        self.config, self.settings = Path(config), load_settings(config)
        self.log_path = self.config.with_suffix(".log")
        with self.log_path.open("a") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "thermoctl.cli", "run", "--config", str(config)],
                stdout=log,
                stderr=log,
                env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT}/hal", "OPENBLAS_NUM_THREADS": "1"},
            )
        try:
            wait(lambda: self.process.poll() is not None or self.ask("status")["state"] == "READY", "READY")
        except AssertionError:
            self.kill()
            raise
        self.family = (
            psutil.Process(self.process.pid).children(recursive=True) if self.process.poll() is None else []
        )

    def ask(self, command, **more):
        return ask(self.settings.socket.path, {"command": command, **more}, 10.0)

    @property
    def log(self):
        return self.log_path.read_text()

    def child(self, name):
        """The pid of a child, from the order that the supervisor starts them in; restarted ones are the newest."""
        names = ["loop", *["recorder"] * self.settings.recording.enable, "commands", "reference"]
        children = psutil.Process(self.process.pid).children()
        return sorted(children, key=lambda p: (p.create_time(), p.pid))[names.index(name)].pid

    def armed(self):
        """Until it is, and where it records, until that has begun."""
        if self.settings.recording.enable:
            wait(lambda: self.ask("status")["recorder"]["rows"] > 0, "the recorder")
        wait(lambda: self.ask("arm")["ok"] or self.ask("disarm") and False, "armed")

    def stop(self):
        self.process.terminate()
        return self.process.wait(LIMIT_S)

    def kill(self):
        """Every process of it, with the signal that cannot be refused."""
        for process in [*getattr(self, "family", []), self.process]:
            with contextlib.suppress(psutil.Error, OSError):
                process.kill()
        self.process.wait()
        forget(self.settings)
