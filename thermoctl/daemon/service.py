"""start, stop, restart: through systemd where the unit is installed, else in the background with a pid file; and the
unit's installation."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from thermoctl.daemon.socket import ask, settled
from thermoctl.shipped import shipped
from thermoctl.yamlfile import InputError

UNIT = "thermoctl.service"
START_S, STOP_S = 60.0, 10.0
SOURCE = shipped("systemd")
FILES = {  # what `service install` puts where
    "thermoctl.service": "/etc/systemd/system/thermoctl.service",
    "thermoctl.sysusers": "/etc/sysusers.d/thermoctl.conf",
    "thermoctl.tmpfiles": "/etc/tmpfiles.d/thermoctl.conf",
    "99-thermoctl.rules": "/etc/udev/rules.d/99-thermoctl.rules",
}


def _systemd(root: str = "/") -> bool:
    return Path("/run/systemd/system").is_dir() and Path(root, FILES[UNIT].lstrip("/")).exists()


def _systemctl(*arguments: str) -> int:
    return subprocess.run(["systemctl", *arguments], check=False).returncode


def pid_file(settings: Any) -> Path:
    """Where the pid of a daemon in the background stands."""
    return Path(settings.socket.path).with_suffix(".pid")


def _running(settings: Any) -> int | None:
    """The pid of the daemon that the pid file names, when it is alive and ours."""
    try:
        pid = int(pid_file(settings).read_text())
        line = Path(f"/proc/{pid}/cmdline").read_bytes()
    except (OSError, ValueError):
        return None
    return pid if b"thermoctl" in line else None


def start(settings: Any) -> int:
    """Start the daemon and wait until it has warmed up and takes commands; 0, or 3 with the end of its log."""
    if _systemd():
        return 3 if _systemctl("start", UNIT) else 0
    if _running(settings):
        print("already running")
        return 0
    pid_file(settings).parent.mkdir(parents=True, exist_ok=True)
    log = Path(settings.socket.path).with_suffix(".log")
    with log.open("ab") as out:
        begin = out.tell()
        process = subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", "run", "--config", str(Path(settings.path).absolute())],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
    pid_file(settings).write_text(f"{process.pid}\n")
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        with contextlib.suppress(InputError):
            if settled(ask(settings.socket.path, {"command": "status"})):
                print(f"started (pid {process.pid}, log {log})")
                return 0
        time.sleep(0.1)
    pid_file(settings).unlink(missing_ok=True)
    with log.open("rb") as lines:
        lines.seek(begin)
        sys.stderr.write(lines.read().decode(errors="replace"))
    if process.poll() is None:
        process.terminate()
        process.wait(STOP_S)
    print(f"thermoctl: the daemon did not start within {START_S:g} s; its log is {log}", file=sys.stderr)
    return 3


def stop(settings: Any) -> int:
    """Stop it and wait until it is gone; 0 also when none runs."""
    if _systemd():
        return 3 if _systemctl("stop", UNIT) else 0
    pid = _running(settings)
    if pid is None:
        print("not running")
        return 0
    os.kill(pid, signal.SIGTERM)
    deadline = time.monotonic() + STOP_S
    while _running(settings) == pid:
        if time.monotonic() > deadline:
            print(f"thermoctl: pid {pid} does not stop within {STOP_S:g} s", file=sys.stderr)
            return 3
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, os.WNOHANG)
        time.sleep(0.05)
    pid_file(settings).unlink(missing_ok=True)
    print("stopped")
    return 0


def restart(settings: Any) -> int:
    """Stop, then start."""
    return stop(settings) or start(settings)


def _program() -> Path:
    """This installation's program: the one that was called, else the one beside the interpreter."""
    called = Path(sys.argv[0]).absolute()
    return (
        called
        if called.name == "thermoctl" and called.is_file()
        else Path(sys.executable).with_name("thermoctl")
    )


def install(config: Path, root: Path = Path("/"), prefix: Path | None = None) -> int:
    """Install unit, user, run directory and device rules under `root`, with this installation's program in the unit.

    Tells systemd about it when `root` is the running system. Raises InputError where a file cannot be written.
    """
    program = prefix or _program()
    try:
        for name, target in FILES.items():
            text = (SOURCE / name).read_text()
            text = text.replace("@PROGRAM@", str(program)).replace("@CONFIG@", str(config.absolute()))
            path = root / target.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
            print(f"wrote {path}")
    except OSError as e:
        raise InputError(f"{e.filename}: cannot be written: {e.strerror}; run it as root") from None
    if root == Path("/") and Path("/run/systemd/system").is_dir():
        for command in (
            ["systemd-sysusers"],
            ["systemd-tmpfiles", "--create", FILES["thermoctl.tmpfiles"]],
            ["udevadm", "control", "--reload"],
            ["systemctl", "daemon-reload"],
        ):
            if shutil.which(command[0]):
                subprocess.run(command, check=False)
        print("`systemctl enable --now thermoctl` starts it now and at every boot")
    return 0


def uninstall(root: Path = Path("/")) -> int:
    """Stop the unit and remove what `install` wrote; user and recordings stay."""
    live = root == Path("/") and Path("/run/systemd/system").is_dir()
    if live and _systemd():
        _systemctl("disable", "--now", UNIT)
    for target in FILES.values():
        path = root / target.lstrip("/")
        try:
            path.unlink()
            print(f"removed {path}")
        except FileNotFoundError:
            pass
        except OSError as e:
            raise InputError(f"{path}: cannot be removed: {e.strerror}; run it as root") from None
    if live:
        _systemctl("daemon-reload")
    return 0
