"""The lock of a rig, beside its socket: held by the daemon, or by a command that drives the rig itself.

The lock ends with its last holder, for whatever reason. The file holds the holder's process id, the path of
its configuration, its socket and its axes, a line each.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from pathlib import Path

from thermoctl.configuration.settings import Settings, for_stopping
from thermoctl.files.safe_file import long_socket
from thermoctl.files.yamlfile import InputError

# `hold` retries for this time. To test the lock, `holder` in another process takes it for a shorter time.
PROBE_S = 0.2


def lock_path(settings: Settings) -> Path:
    """Return the lock's file, beside the rig's socket: one for all its axes."""
    return Path(settings.rig_socket or settings.socket.path).with_suffix(".lock")


def socket_too_long(settings: Settings) -> str:
    """Return a sentence where the path of the rig's socket, or of an axis', is too long; '' else."""
    paths = (part.socket.path for part in (settings, *settings.axes))
    return next(filter(None, (long_socket(path, "socket.path") for path in paths)), "")


def hold(settings: Settings) -> int:
    """Take the rig's lock; return the open file that keeps it.

    Raises InputError when another process holds the rig."""
    path = lock_path(settings)
    if long := socket_too_long(settings):
        raise InputError(long)
    if (other := started(settings)) is not settings:
        raise InputError(
            f"{settings.path}: its daemon runs on {other.socket.path}; stop it with `thermoctl stop`"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as e:
        raise InputError(f"{path}: cannot be made: {e.strerror}; check socket.path") from None
    deadline = time.monotonic() + PROBE_S
    while not _locked(file, fcntl.LOCK_EX):
        if time.monotonic() > deadline:
            pid = _written(file)
            os.close(file)
            raise InputError(
                f"{path}: another daemon runs on this socket (pid {pid}) and holds the rig; "
                "look with `thermoctl status`, stop it with `thermoctl stop`"
            )
        time.sleep(0.01)
    os.ftruncate(file, 0)
    axes = [part.axis for part in settings.axes]
    own = (os.getpid(), os.path.abspath(settings.path), settings.socket.path, *axes)
    os.pwrite(file, os.fsencode("\n".join(map(str, own))), 0)
    return file


def is_retaken(settings: Settings, file: int) -> bool:
    """Take the lock again, with the same open file, where someone deleted or replaced it in its folder.

    Raises InputError where another process took it meanwhile."""
    with contextlib.suppress(OSError):
        if os.path.samestat(os.stat(lock_path(settings)), os.fstat(file)):
            return False
    again = hold(settings)
    os.dup2(again, file, inheritable=False)
    os.close(again)
    return True


def started(settings: Settings) -> Settings:
    """Return settings to stop the daemon of this file, where it runs on other sockets than the settings have.

    The file may have been edited, cut off or deleted since. Else the settings themselves are returned."""
    file = os.path.abspath(settings.path)
    above = Path(file).parents
    folders = {lock_path(settings).parent, above[0], *(p / "run" for p in above), Path("/run/thermoctl")}
    for path in (path for folder in folders for path in folder.glob("*.lock") if path.is_file()):
        with contextlib.suppress(OSError):  # deleted meanwhile, or another user's
            lines = os.fsdecode(path.read_bytes()).splitlines()
            if lines[1:2] == [file] and _holder(path) is not None:
                named = f"{settings.path}#{settings.axis}" if settings.axis else settings.path
                other = for_stopping(named, lines[2], lines[3:])
                if [p.socket.path for p in other.parts] != [p.socket.path for p in settings.parts]:
                    return other
    return settings


def holder(settings: Settings) -> int | None:
    """Return the process id that holds the rig, or None.

    Raises InputError when this user may not read the lock."""
    return _holder(lock_path(settings))


def _holder(path: Path) -> int | None:
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except PermissionError:
        raise InputError(f"{path}: not allowed; the rig is for its group (see socket.group)") from None
    try:
        while not _locked(file, fcntl.LOCK_SH):
            if pid := _written(file):
                return pid
            time.sleep(0.01)  # locked a moment ago, not yet written
        return None
    finally:
        os.close(file)


def _locked(file: int, kind: int) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _written(file: int) -> int:
    text = os.pread(file, 32, 0).partition(b"\n")[0]
    return int(text) if text.isdigit() else 0
