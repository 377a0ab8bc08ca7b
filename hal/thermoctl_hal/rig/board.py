"""The board: newest readings of slow devices, from their pollers to the loop, without a wait.

Shared memory holds one row per role: sequence, value, time, status and the problem in one line of text. The
rows of a device have one writer. The sequence of their first row is a seqlock: it is odd during a write. A
reader that finds it odd or changed takes the rows at its next tick.
"""

from __future__ import annotations

import math
import mmap
import os
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl_hal.base.backend import ABSENT, ROLES, HardwareError, Sample
from thermoctl_hal.base.device import Device

COUNTED = ("frames", "errors", "lost", "reconnections")
"""The counters that a poller posts, in the row of the device's first role."""
_TEXT_BYTES = 400
_ROW = np.dtype(
    [
        ("sequence", "u8"),
        ("value", "f8"),
        ("time_s", "f8"),
        ("status", "u8"),
        ("text", f"S{_TEXT_BYTES}"),
        ("command_sequence", "u8"),
        ("command", "f8"),
        ("command_enable", "u8"),
        ("command_s", "f8"),
        ("counts", "u8", len(COUNTED)),
    ]
)
SHARED_MEMORY = Path("/dev/shm")


class Board:
    """Newest readings by role; made by `create`, `attach` (another process) or `private` (threads)."""

    def __init__(self, buffer: mmap.mmap | bytearray, path: Path | None, owner: bool) -> None:
        self._path, self._owner, self._buffer = path, owner, buffer
        self.rows: Any = np.ndarray(len(buffer) // _ROW.itemsize, _ROW, buffer)
        self._sequence = self.rows["sequence"]
        self._commands: dict[Device, tuple[float, bool, float]] = {}  # the last that was read whole
        if owner:
            self.rows["sequence"] = self.rows["command_sequence"] = 0
            self.rows["value"], self.rows["time_s"], self.rows["status"] = np.nan, -np.inf, ABSENT

    @classmethod
    def create(cls, name: str, count: int = len(ROLES)) -> Board:
        """Make a board of `count` channels in shared memory, for this user only; replace an old one."""
        size = _ROW.itemsize * count
        path = SHARED_MEMORY / name
        path.unlink(missing_ok=True)
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.posix_fallocate(fd, 0, size)  # reserve the memory now: an error here instead of SIGBUS later
            return cls(mmap.mmap(fd, size), path, True)
        finally:
            os.close(fd)

    @classmethod
    def attach(cls, name: str) -> Board:
        """Open the board that another process created. Raises HardwareError where there is none."""
        path = SHARED_MEMORY / name
        try:
            fd = os.open(path, os.O_RDWR)
        except OSError as e:
            raise HardwareError(
                f"board '{name}': {e.strerror}; the supervisor creates it before any poller"
            ) from None
        try:
            return cls(mmap.mmap(fd, 0), path, False)
        except ValueError:
            raise HardwareError(f"board '{name}': of another version; restart the daemon") from None
        finally:
            os.close(fd)

    @classmethod
    def private(cls, count: int = len(ROLES)) -> Board:
        """Make a board for threads of this process only."""
        return cls(bytearray(_ROW.itemsize * count), None, True)

    @property
    def name(self) -> str:
        """Return the name for `attach`."""
        return self._path.name if self._path else ""

    def post(self, sample: Sample, device: Device) -> None:
        """Write the device's rows from `sample`; only the one writer of the device may call it."""
        first = device.roles[0]
        writing = int(self._sequence[first]) | 1  # odd, also if the last writer was killed while it wrote
        self._sequence[first] = writing
        for role in device.roles:
            row = self.rows[role]
            row["value"], row["time_s"] = sample.value[role], sample.time_s[role]
            row["status"] = sample.status[role]
            row["text"] = device.problems.get(role, "").encode()[:_TEXT_BYTES]
        counts = device.counters()
        self.rows["counts"][first] = [counts.get(name, 0) for name in COUNTED]
        self._sequence[first] = writing + 1

    def merge(self, sample: Sample, roles: list[int], seen: int) -> int:
        """Take one device's rows into `sample` when they are newer than `seen`, the last merge's result."""
        first = roles[0]
        before = self._sequence[first]
        if before == seen or before & 1:
            return seen
        rows = self.rows[roles]
        if self._sequence[first] != before:
            return seen
        for role, row in zip(roles, rows, strict=True):
            sample.status[role] = row["status"]
            if row["time_s"] > sample.time_s[role]:
                sample.value[role], sample.time_s[role] = row["value"], row["time_s"]
                sample.fresh[role] = True
        return int(before)

    def send(self, device: Device, drive: float, enable: bool, now_s: float) -> None:
        """Write the command of a slow amplifier for its poller; only the loop may call it."""
        row = self.rows[device.roles[0]]
        writing = int(row["command_sequence"]) | 1
        row["command_sequence"] = writing
        row["command"], row["command_enable"], row["command_s"] = drive, enable, now_s
        row["command_sequence"] = writing + 1

    def command(self, device: Device) -> tuple[float, bool, float]:
        """Return the last command of a slow amplifier, whether it is enabled, and when it was sent (s).

        While the loop writes it is the one before; before the first it is disabled, from -inf."""
        row = self.rows[device.roles[0]]
        before = int(row["command_sequence"])
        command = float(row["command"]), bool(row["command_enable"]), float(row["command_s"])
        if before and not before & 1 and int(row["command_sequence"]) == before:
            self._commands[device] = command
        return self._commands.get(device, (0.0, False, -math.inf))

    def beat(self, roles: list[int]) -> int:
        """Return the number of posts of the device with these roles, to detect a hung poller."""
        return int(self._sequence[roles[0]])

    def problem(self, role: int) -> str:
        """Return the problem that a poller posted for this role."""
        return bytes(self.rows[role]["text"]).decode("utf-8", "replace")

    def counts(self, device: Device) -> dict[str, int]:
        """Return the device's counters, as its poller posted them, by name."""
        return dict(zip(COUNTED, self.rows["counts"][device.roles[0]].tolist(), strict=True))

    def close(self) -> None:
        """Remove the name, if we created the board; the memory is freed when its last user closes it."""
        if self._path is not None and self._owner:
            self._path.unlink(missing_ok=True)
