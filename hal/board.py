"""The board: newest readings of slow devices, written by their poller processes and read by the loop without a wait.

Shared memory holds one row per role: sequence, value, time, status and a line of text on what is wrong. The rows of a
device have one writer, and the sequence of its first row guards them: it is odd while they are being written (a seqlock).
A reader that meets an odd or changed sequence takes the rows at its next tick; an unchanged one costs it a look.
"""

from __future__ import annotations

import mmap
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from hal.backend import ABSENT, ROLES, STALE, HardwareError, Sample
from hal.devices import RECONNECT_S, Device, make_devices

COUNTED = ("frames", "errors", "lost", "reconnections")
"""What a poller posts of its device's counters, in the row of the device's first role."""
_ROW = np.dtype(
    [
        ("sequence", "u8"),
        ("value", "f8"),
        ("time_s", "f8"),
        ("status", "u8"),
        ("text", "S400"),
        ("counts", "u8", len(COUNTED)),
    ]
)
_SIZE = _ROW.itemsize * len(ROLES)
SHARED_MEMORY = Path("/dev/shm")


class Board:
    """Newest readings by role. Make it with `create`, `attach` (another process) or `private` (threads of one)."""

    def __init__(self, buffer: Any, path: Path | None, owner: bool) -> None:
        self._path, self._owner, self._buffer = path, owner, buffer
        self.rows: Any = np.ndarray(len(ROLES), _ROW, buffer)
        self._sequence = self.rows["sequence"]
        if owner:
            self.rows["sequence"] = 0
            self.rows["value"], self.rows["time_s"], self.rows["status"] = np.nan, -np.inf, ABSENT

    @classmethod
    def create(cls, name: str) -> Board:
        """A new board in shared memory, for this user only; one left over under the same name is replaced."""
        path = SHARED_MEMORY / name
        path.unlink(missing_ok=True)
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.ftruncate(fd, _SIZE)
            return cls(mmap.mmap(fd, _SIZE), path, True)
        finally:
            os.close(fd)

    @classmethod
    def attach(cls, name: str) -> Board:
        """The board that another process created. Raises HardwareError where there is none."""
        path = SHARED_MEMORY / name
        try:
            fd = os.open(path, os.O_RDWR)
        except OSError as e:
            raise HardwareError(
                f"board '{name}': {e.strerror}; the supervisor creates it before any poller"
            ) from None
        try:
            return cls(mmap.mmap(fd, _SIZE), path, False)
        except ValueError:
            raise HardwareError(f"board '{name}': of another version; restart the daemon") from None
        finally:
            os.close(fd)

    @classmethod
    def private(cls) -> Board:
        """A board for threads of this process only."""
        return cls(bytearray(_SIZE), None, True)

    @property
    def name(self) -> str:
        """What `attach` takes."""
        return self._path.name if self._path else ""

    def post(self, sample: Sample, device: Device) -> None:
        """Write the device's roles from `sample`. A device has one writer."""
        first = device.roles[0]
        writing = int(self._sequence[first]) | 1  # also after a writer that was killed while it wrote
        self._sequence[first] = writing
        for role in device.roles:
            row = self.rows[role]
            row["value"], row["time_s"], row["status"] = (
                sample.value[role],
                sample.time_s[role],
                sample.status[role],
            )
            row["text"] = device.problems.get(role, "").encode()[:400]
        counts = device.counters()
        self.rows["counts"][first] = [counts.get(name, 0) for name in COUNTED]
        self._sequence[first] = writing + 1

    def merge(self, sample: Sample, roles: list[int], seen: int) -> int:
        """Take one device's rows into `sample` when they are newer than `seen` (what the merge before returned)."""
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
                sample.value[role], sample.time_s[role], sample.fresh[role] = (
                    row["value"],
                    row["time_s"],
                    True,
                )
        return int(before)

    def beat(self, roles: list[int]) -> int:
        """Grows with every post of the device with these roles: a poller that hangs is seen by it."""
        return int(self._sequence[roles[0]])

    def problem(self, role: int) -> str:
        """The text a poller left on this role."""
        return bytes(self.rows[role]["text"]).decode("utf-8", "replace")

    def counts(self, device: Device) -> dict[str, int]:
        """The device's counters as its poller posted them, by name."""
        return dict(zip(COUNTED, self.rows["counts"][device.roles[0]].tolist(), strict=True))

    def close(self) -> None:
        """The creator removes the name; the memory goes with its last user."""
        if self._path is not None and self._owner:
            self._path.unlink(missing_ok=True)


def poll_until(device: Device, board: Board, stop: threading.Event) -> None:
    """Poll a slow device at its fastest channel's rate, posting to the board, until `stop` is set. A device that is
    gone is connected again; its last values stand, and their age tells."""
    period_s = 1.0 / max(b.channel.rate_hz for b in device.binding.bounds)
    sample = Sample()
    sample.status[device.roles] = STALE
    due = time.monotonic()
    while not stop.is_set():
        try:
            if not device.up:
                device.connect()
                device.up = True
            device.poll(sample)
        except (HardwareError, OSError) as e:
            if device.up:
                device.counts["reconnections"] += 1
            device.up = False
            device.disconnect()
            device.miss_all(f"{e}; reconnecting")
        board.post(sample, device)
        due += period_s if device.up else RECONNECT_S
        now = time.monotonic()
        if due < now:  # a slow answer: keep the phase, drop the polls that were missed
            due = now
        stop.wait(due - now)
    device.up = False
    device.disconnect()


def run_poller(settings: Any, device_name: str, board_name: str) -> None:
    """Main of a poller process: polls the slow device `device_name` until SIGTERM or until the parent is gone."""
    device = next(d for d in make_devices(settings) if d.slow and d.name == device_name)
    board = Board.attach(board_name)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the group; the supervisor stops us
    parent = os.getppid()

    def watch_parent() -> None:
        while not stop.wait(0.5):
            if os.getppid() != parent:
                stop.set()

    threading.Thread(target=watch_parent, daemon=True).start()
    poll_until(device, board, stop)
