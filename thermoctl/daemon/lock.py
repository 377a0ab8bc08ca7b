"""The lock of a rig, beside its socket: held by the daemon, or by a command that drives the rig itself.

The lock ends with its last holder, for whatever reason; the file holds the holder's process id.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from pathlib import Path

from thermoctl.configuration.settings import Settings
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
    os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
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


def holder(settings: Settings) -> int | None:
    """Return the process id that holds the rig, or None.

    Raises InputError when this user may not read the lock."""
    path = lock_path(settings)
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
    text = os.pread(file, 32, 0).strip()
    return int(text) if text.isdigit() else 0
