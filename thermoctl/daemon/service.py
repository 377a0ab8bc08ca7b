"""Start, stop and restart the rig of a configuration, known by its lock and socket; install systemd units.

A daemon is found the same way whether `thermoctl run`, `thermoctl start` or systemd started it.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from thermoctl.configuration.settings import Settings, load_rig
from thermoctl.daemon.control_socket import ask, settled
from thermoctl.daemon.lock import holder, started
from thermoctl.daemon.tick.loop import die_with_parent
from thermoctl.files.safe_file import make_folder, write_text
from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError
from thermoctl.interrupt import held

START_S = 90.0  # as TimeoutStartSec= of the unit: devices connect before the first tick
STOP_S = 30.0  # the supervisor gives its processes 3 and 10 s before it kills them
ENDS_S = 15.0  # longest time in which a daemon that does not answer comes up or ends
SILENT = "it does not answer"
SOURCE = shipped("systemd")
UNITS = "etc/systemd/system"
FIRST = "thermoctl.service"  # the unit of the first rig; further ones are thermoctl-RIG.service
SHARED = {  # files that every unit needs
    "thermoctl.sysusers": "etc/sysusers.d/thermoctl.conf",
    "thermoctl.tmpfiles": "etc/tmpfiles.d/thermoctl.conf",
    "99-thermoctl.rules": "etc/udev/rules.d/99-thermoctl.rules",
}
USER = "thermoctl"
STATE, RUN = Path("/var/lib/thermoctl"), Path("/run/thermoctl")
"""The folders that the unit may write (StateDirectory=, RuntimeDirectory=)."""
HIDDEN = tuple(map(Path, ("/home", "/root", "/run/user", "/tmp", "/var/tmp")))
"""Folders that the unit does not see (ProtectHome=, PrivateTmp=)."""
LIVE = Path("/run/systemd/system")  # exists if systemd runs the machine


def _systemctl(*arguments: str) -> int:
    return 3 if subprocess.run(["systemctl", *arguments], check=False).returncode else 0


def units(root: Path = Path("/")) -> dict[str, Path]:
    """Return the installed units below `root`, each with the configuration that it runs."""
    by_name = {}
    for path in sorted((root / UNITS).glob("thermoctl*.service")):
        if config := re.search(r"^ExecStart=.* --config (.+)$", path.read_text(), re.MULTILINE):
            by_name[path.name] = Path(config[1]).resolve()
    return by_name


def _unit_for(settings: Settings) -> str | None:
    """Return the installed unit that runs this configuration, or None."""
    if not LIVE.is_dir():
        return None
    config = Path(settings.path).resolve()
    return next((name for name, runs in units().items() if runs == config), None)


def _unit_of(pid: int) -> str | None:
    """Return the unit of ours in which systemd started this process, or None."""
    try:
        groups = Path(f"/proc/{pid}/cgroup").read_text()
    except OSError:
        return None
    match = re.search(r"/(thermoctl[^/\n]*\.service)$", groups, re.MULTILINE)
    return match[1] if match else None


def journal(settings: Settings, size: int) -> str:
    """Return at most `size` last bytes of the log of this configuration's unit; '' without a unit."""
    unit = _unit_for(settings)
    if unit is None or shutil.which("journalctl") is None:
        return ""
    command = ["journalctl", "-u", unit, "-o", "cat", "--no-pager", "-n", "20000"]
    done = subprocess.run(command, capture_output=True, check=False)
    return done.stdout[-size:].decode(errors="replace")


def start(settings: Settings) -> int:
    """Start the daemon, by its unit where one runs this configuration, and wait until it takes commands.

    Returns 0, or 3 with the daemon's own error. A signal meanwhile ends the daemon, too."""
    if _runs(settings):
        return 0
    unit, process = _unit_for(settings), None
    if unit and _systemctl("start", unit):
        print(f"thermoctl: {unit} did not start; its log: journalctl -u {unit}", file=sys.stderr)
        return 3
    log = f"journalctl -u {unit}" if unit else str(log_path(settings))
    with contextlib.ExitStack() as unless_up:
        if not unit:
            with held():
                process = Background(settings)
                unless_up.callback(process.end)
        if _is_up(settings, process, log):
            unless_up.pop_all()
            return 0
    if process is not None and process.poll() is not None and _runs(settings):
        return 0  # somebody else's start was first
    if process is not None:
        sys.stderr.write(process.said())
    print(f"thermoctl: the daemon did not start; its log: {log}", file=sys.stderr)
    return 3


def _runs(settings: Settings) -> bool:
    """Return whether somebody holds the rig, and say so. One that does not answer begins or ends: wait."""
    deadline = time.monotonic() + ENDS_S
    while (pid := holder(settings)) is not None:
        if (state := _state(settings)) != SILENT or time.monotonic() > deadline:
            print(f"already running (pid {pid}, {state})")
            return True
        time.sleep(0.1)
    return False


def _is_up(settings: Settings, process: Background | None, log: str) -> bool:
    """Wait until the daemon takes commands, and say so; return False if it ends before or needs too long."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and (process is None or process.poll() is None):
        pid = holder(settings)
        with contextlib.suppress(InputError):
            answers = [ask(part.socket.path, {"command": "status"}) for part in settings.parts]
            if all(map(settled, answers)) and pid is not None and (process is None or pid == process.pid):
                print(f"started (pid {pid}, {', '.join(now['state'] for now in answers)}, log {log})")
                return True
        time.sleep(0.1)
    return False


def _state(settings: Settings) -> str:
    """Return the state of the daemon that holds the rig, for a message."""
    try:
        return ", ".join(ask(p.socket.path, {"command": "status"})["state"] for p in settings.parts)
    except InputError:
        return SILENT


def stop(settings: Settings) -> int:
    """Disarm and stop the process that holds the rig; return 0 also when there is none.

    It never asks: stopping is the safe direction. The rig of another configuration is not touched."""
    pid = holder(settings)
    if pid is None:
        print("not running")
        return 0
    for part in settings.parts:
        # A process that does not answer is ended, too; the amplifier is disabled when it ends.
        with contextlib.suppress(InputError):
            ask(part.socket.path, {"command": "disarm"})
    unit = _unit_of(pid)
    if unit:
        if _systemctl("stop", unit):
            return 3
    else:
        try:
            os.kill(pid, signal.SIGTERM)
        except ProcessLookupError:
            pass  # the process is already ending
        except PermissionError:
            print(f"thermoctl: pid {pid} is another user's: stop it as that user or root", file=sys.stderr)
            return 3
    deadline = time.monotonic() + STOP_S
    while holder(settings) == pid:
        if time.monotonic() > deadline:
            print(f"thermoctl: pid {pid} does not end within {STOP_S:g} s", file=sys.stderr)
            return 3
        time.sleep(0.05)
    print(f"stopped (pid {pid})")
    return 0


def restart(settings: Settings) -> int:
    """Stop, then start."""
    return stop(started(settings)) or start(settings)


def log_path(settings: Settings) -> Path:
    """Return the log file of a daemon that `start` put in the background, beside its socket."""
    return Path(settings.rig_socket or settings.socket.path).with_suffix(".log")


class Background(subprocess.Popen[bytes]):
    """`thermoctl run` on a configuration, its log appended to `log_path` from position `began` on.

    dies_with_us: stop it when this process ends, for whatever reason."""

    def __init__(self, settings: Settings, dies_with_us: bool = False):
        log = log_path(settings)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as out:
            self.began = out.tell()
            # -P: a folder `thermoctl` in the working directory must not hide the installed package
            program = [sys.executable, "-P", "-m", "thermoctl.cli", "run", "--config"]
            super().__init__(
                [*program, str(Path(settings.path).absolute())],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
                preexec_fn=die_with_parent if dies_with_us else None,
            )
        self.log = log

    def end(self) -> None:
        """End the daemon, if it runs."""
        self.terminate()
        self.wait(STOP_S)

    def said(self) -> str:
        """Return the lines that the started daemon wrote into its log."""
        with self.log.open("rb") as lines:
            lines.seek(self.began)
            return lines.read().decode(errors="replace")


def _program() -> Path:
    """Return this installation's program: the one that was called, else the interpreter's neighbour."""
    called = Path(sys.argv[0]).absolute()
    return (
        called
        if called.name == "thermoctl" and called.is_file()
        else Path(sys.executable).with_name("thermoctl")
    )


def unseen(settings: Settings) -> list[str]:
    """List the files that the unit could not read or write, each with its path and what to do.

    The unit sees no home and no temporary folder (ProtectHome=, PrivateTmp=), and writes only below
    /var/lib/thermoctl and /run/thermoctl (ProtectSystem=strict)."""
    problems, config = [], Path(settings.path).resolve()
    program = {
        "program": _program(),
        "its Python": Path(sys.base_prefix),
        "its package": Path(__file__).parents[1],
    }
    hidden = [f"{what} {path}" for what, path in program.items() if _is_below(path, HIDDEN)]
    if hidden:
        problems.append(
            f"{', '.join(hidden)}: install it with the system's Python: python3 -m venv /opt/thermoctl, then "
            "/opt/thermoctl/bin/pip install the wheel (`make wheel`) with the extra [rig]"
        )
    if _is_below(config, HIDDEN):
        problems.append(f"configuration {config}: cp -r {config.parent} /etc/thermoctl")
    else:
        problems += [
            f"{path}: cp it to {config.parent} and name it there"
            for path in _files(settings)
            if _is_below(path, HIDDEN)
        ]
        if not config.stat().st_mode & 0o004 and config.stat().st_mode & 0o777:
            problems.append(
                f"configuration {config}: not readable for the user thermoctl: chmod o+r {config}"
            )
    for part in settings.parts:
        for key, path, place in (
            ("recording.directory", part.recording.directory, STATE / "recordings"),
            (
                "socket.path",
                part.rig_socket or part.socket.path,
                RUN / Path(part.rig_socket or part.socket.path).name,
            ),
            (
                "compensation.model",
                part.compensation.model if part.compensation.tune else "",
                STATE / "models",
            ),
        ):
            line = f"{key} {path}: write {key}: {place}"
            if path and not _is_below(Path(path), (STATE, RUN)) and line not in problems:
                problems.append(line)
    return problems


def _files(settings: Settings) -> list[Path]:
    """Return the files beside the configuration that the daemon reads: profiles, models, drawings."""
    folder = Path(settings.path).resolve().parent
    names = [p.compensation.model for p in settings.parts] + [settings.rig.drawing]
    for device in settings.hal.devices:
        profile = device.value.get("profile") if isinstance(device.value, dict) else None
        names.append(str(profile.value) if profile is not None else "")
    return sorted({(folder / name).resolve() for name in names if name})


def _is_below(path: Path, folders: Iterable[Path]) -> bool:
    resolved = path.absolute()
    return any(folder in (p, *p.parents) for folder in folders for p in (resolved, resolved.resolve()))


def install(config: Path, root: Path = Path("/")) -> int:
    """Install the unit of this configuration under `root`, with user, run directory and device rules.

    The first rig's unit is thermoctl.service, a further one's thermoctl-RIG.service; other rigs' units
    stay as they are. systemd is informed where `root` is the running system. Raises InputError where a
    file cannot be written or two rigs collide. It also does where the unit would not see its files; below
    another root that is only a warning."""
    settings = load_rig(config)
    config = config.resolve()
    if hidden := unseen(settings):
        text = (
            "the unit sees no home and no temporary folder, and writes only below /var/lib/thermoctl and /run/thermoctl:"
            + "".join(f"\n  {line}" for line in hidden)
            + "\nthen `sudo /opt/thermoctl/bin/thermoctl service install --config /etc/thermoctl/"
            + f"{config.name}`"
        )
        if root == Path("/"):
            raise InputError(f"{config}: not installed: {text}")
        print(f"warning: {config}: this unit could not start: {text}", file=sys.stderr)
    unit = _unit_name(settings, config, root)
    text = (SOURCE / FIRST).read_text().replace("@PROGRAM@", str(_program())).replace("@CONFIG@", str(config))
    files = {f"{UNITS}/{unit}": text} | {
        target: (SOURCE / name).read_text() for name, target in SHARED.items()
    }
    for target, content in files.items():
        path = root / target
        make_folder(path.parent, "run it as root")
        write_text(path, content, "run it as root")
        print(f"wrote {path}")
    if root == Path("/") and LIVE.is_dir():
        for command in (
            ["systemd-sysusers"],
            ["systemd-tmpfiles", "--create", "/" + SHARED["thermoctl.tmpfiles"]],
            ["udevadm", "control", "--reload"],
            ["systemctl", "daemon-reload"],
        ):
            if shutil.which(command[0]):
                subprocess.run(command, check=False)
        _say_whether_the_user_exists()
        print(f"`systemctl enable --now {unit}` starts rig '{settings.rig.name}' now and at every boot")
    elif root == Path("/"):
        _say_whether_the_user_exists()
        print(
            f"systemd does not run here (a container, WSL or another init): nothing starts {unit}. `thermoctl start --config "
            f"{config}` runs the rig in the background; your own supervisor takes `{_program()} run --config {config}` as "
            "the user thermoctl"
        )
    return 0


def _say_whether_the_user_exists() -> None:
    try:
        pwd.getpwnam(USER)
    except KeyError:
        print(
            f"no user {USER} was made here: `useradd --system --user-group --groups dialout --home-dir {STATE} {USER}` makes it"
        )


def _unit_name(settings: Settings, config: Path, root: Path) -> str:
    """Return the unit that runs this configuration already, else a free name.

    Raises InputError for a collision."""
    installed = units(root)
    for name, other in installed.items():
        if other == config:
            return name
        if _socket_of(other) == settings.socket.path:
            raise InputError(
                f"{config}: socket.path {settings.socket.path} is also that of {other}, which {name} runs; give this rig its own"
            )
    name = "thermoctl-" + re.sub(r"[^A-Za-z0-9_.-]+", "-", settings.rig.name) + ".service"
    if name in installed:
        raise InputError(f"{config}: rig.name '{settings.rig.name}': {name} runs {installed[name]} already")
    return name if FIRST in installed else FIRST


def _socket_of(config: Path) -> str | None:
    try:
        return load_rig(config).socket.path
    except InputError:  # missing or broken: no collision
        return None


def uninstall(config: Path | None, root: Path = Path("/")) -> int:
    """Stop and remove the unit of this configuration (None: the only one).

    With the last unit the shared files are removed, too. User and recordings stay. Returns 1 when no such
    unit is installed."""
    installed = units(root)
    chosen = [n for n, runs in installed.items() if config is None or runs == config.resolve()]
    if len(chosen) != 1:
        there = ", ".join(f"{n} ({c})" for n, c in installed.items()) or "none"
        print(
            f"thermoctl: which unit? Installed: {there}; name its configuration by --config", file=sys.stderr
        )
        return 1
    live = root == Path("/") and LIVE.is_dir()
    if live:
        _systemctl("disable", "--now", chosen[0])
    for target in (f"{UNITS}/{chosen[0]}", *(SHARED.values() if len(installed) == 1 else ())):
        path = root / target
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
