"""The board: newest readings of slow devices, written by their poller processes and read by the loop without a wait.

Shared memory holds one row per role: sequence, value, time, status and a line of text on what is wrong. A row has one
writer. The sequence is odd while a row is being written (a seqlock): a reader that meets an odd or changed sequence
takes the row at its next tick.
"""
from __future__ import annotations

import os
import signal
import threading
import time
from multiprocessing import shared_memory
from typing import Any

import numpy as np

from hal.backend import ABSENT, ERROR, ROLES, HardwareError, Sample
from hal.devices import RECONNECT_S, Device, make_devices

_ROW = np.dtype([("sequence", "u8"), ("value", "f8"), ("time_s", "f8"), ("status", "u8"), ("text", "S200")])


class Board:
    """Newest readings by role. Make it with `create`, `attach` (another process) or `private` (threads of one)."""

    def __init__(self, buffer: Any, memory: shared_memory.SharedMemory | None, owner: bool) -> None:
        self._memory, self._owner = memory, owner          # the memory object must live as long as the array
        self.rows: Any = np.ndarray(len(ROLES), _ROW, buffer)
        self._sequence, self._status = self.rows["sequence"], self.rows["status"]
        self._value, self._time_s = self.rows["value"], self.rows["time_s"]

    @classmethod
    def create(cls, name: str | None = None) -> Board:
        """A new board in shared memory; `board.name` is what `attach` takes. A board left over is replaced."""
        size = _ROW.itemsize * len(ROLES)
        try:
            memory = shared_memory.SharedMemory(name, create=True, size=size)
        except FileExistsError:
            old = shared_memory.SharedMemory(name)
            old.close()
            old.unlink()
            memory = shared_memory.SharedMemory(name, create=True, size=size)
        board = cls(memory.buf, memory, True)
        board._clear()
        return board

    @classmethod
    def attach(cls, name: str) -> Board:
        """The board that another process created. Raises HardwareError where there is none."""
        try:
            memory = shared_memory.SharedMemory(name)
        except FileNotFoundError:
            raise HardwareError(f"board '{name}': not there; the supervisor creates it before any poller") from None
        # The resource tracker of an attaching process would unlink the segment at exit (CPython issue 82300).
        from multiprocessing import resource_tracker
        resource_tracker.unregister(memory._name, "shared_memory")      # type: ignore[attr-defined]
        return cls(memory.buf, memory, False)

    @classmethod
    def private(cls) -> Board:
        """A board for threads of this process only."""
        board = cls(bytearray(_ROW.itemsize * len(ROLES)), None, True)
        board._clear()
        return board

    @property
    def name(self) -> str:
        return self._memory.name if self._memory else ""

    def _clear(self) -> None:
        self.rows["sequence"] = 0
        self.rows["value"], self.rows["time_s"], self.rows["status"] = np.nan, -np.inf, ABSENT

    def post(self, sample: Sample, device: Device) -> None:
        """Write the device's roles from `sample`."""
        for role in device.roles:
            row = self.rows[role]
            row["sequence"] += 1
            row["value"], row["time_s"], row["status"] = sample.value[role], sample.time_s[role], sample.status[role]
            row["text"] = device.problems.get(role, "").encode()[:200] if sample.status[role] == ERROR else b""
            row["sequence"] += 1

    def merge(self, sample: Sample, taken: dict[int, float]) -> None:
        """Take rows into `sample`; `taken` holds the time of the newest reading shown so far for each role wanted."""
        for role, shown in taken.items():
            before = self._sequence[role]
            if before & 1 or before == 0:
                continue
            status, value, time_s = self._status[role], self._value[role], self._time_s[role]
            if self._sequence[role] != before:
                continue
            sample.status[role] = status
            if time_s > shown:
                taken[role] = time_s
                sample.value[role], sample.time_s[role], sample.fresh[role] = value, time_s, True

    def problem(self, role: int) -> str:
        """The text a poller left on this role."""
        return bytes(self.rows[role]["text"]).decode("utf-8", "replace")

    def close(self) -> None:
        """Let go of the memory; the creator also removes it."""
        del self.rows, self._sequence, self._status, self._value, self._time_s
        if self._memory is not None:
            self._memory.close()
            if self._owner:
                self._memory.unlink()


def poll_until(device: Device, board: Board, stop: threading.Event) -> None:
    """Poll a slow device at its fastest channel's rate, posting to the board, until `stop` is set. A device that is
    gone is posted as ERROR and connected again."""
    period_s = 1.0 / max(b.channel.rate_hz for b in device.binding.bounds)
    sample = Sample()
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
            device.fail_all(sample, f"{e}; reconnecting")
        board.post(sample, device)
        due += period_s if device.up else RECONNECT_S
        now = time.monotonic()
        if due < now:                  # a slow answer: keep the phase, drop the polls that were missed
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)           # Ctrl-C goes to the group; the supervisor stops us
    parent = os.getppid()

    def watch_parent() -> None:
        while not stop.wait(0.5):
            if os.getppid() != parent:
                stop.set()
    threading.Thread(target=watch_parent, daemon=True).start()
    poll_until(device, board, stop)
