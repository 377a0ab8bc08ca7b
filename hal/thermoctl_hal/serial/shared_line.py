"""A serial line that several devices share (RS-485): opened once, one device asked at a time.

The turn goes to the device whose request is overdue for longest. It ends with the device's answer, or after
its `answer_s`. Bytes that arrive during the turn belong to that device; bytes between turns are dropped.
After a turn without an answer, the late one is waited for as long again: it may not say whose it is.
"""

from __future__ import annotations

import contextlib
import threading
from typing import Protocol

from thermoctl_hal.base.line import QUIET_S, open_port
from thermoctl_hal.base.profile import LineSettings
from thermoctl_hal.base.wire import read_available


class Asked(Protocol):
    """A device of a shared line, as the line sees it (thermoctl_hal.serial.port.SerialDevice)."""

    answer_s: float

    def request_due_s(self, now_s: float) -> float:
        """Return when it is to be asked next, in seconds of `now_s`."""

    def ask(self, fd: int) -> None:
        """Send its request."""

    def asked(self, now_s: float) -> None:
        """Note that it was asked."""

    def answers(self) -> int:
        """Count its answers, good and bad ones."""


class SharedLine:
    """A port with several users, each of which calls `serve` once a tick, all from one thread."""

    def __init__(self, path: str, line: LineSettings) -> None:
        self.path, self._port = path, open_port(path, line)
        self.fd = self._port.fileno()
        self.users: list[Asked] = []
        self.broken = False
        self._data: dict[int, bytes] = {}
        self._turn: Asked | None = None
        self._until_s, self._answers = 0.0, 0
        self._free_s = 0.0  # time of the next turn

    def serve(self, now_s: float) -> None:
        """Take what has arrived, end a turn, begin the next one. Raises OSError when the line is gone."""
        try:
            data, turn = read_available(self.fd), self._turn
            if turn is not None:
                if data:
                    self._data[id(turn)] = self._data.get(id(turn), b"") + data
                silent = turn in self.users and turn.answers() == self._answers
                if silent and now_s < self._until_s:
                    return
                self._turn, self._free_s = None, now_s + (turn.answer_s if silent else 0.0)
            elif data:
                self._free_s = min(self._free_s, now_s + QUIET_S)
            if now_s < self._free_s:
                return
            due = [u for u in self.users if u.request_due_s(now_s) <= now_s]
            if due:
                turn = self._turn = min(due, key=lambda u: u.request_due_s(now_s))
                self._answers, self._until_s = turn.answers(), now_s + turn.answer_s
                turn.asked(now_s)
                turn.ask(self.fd)
        except OSError:
            self.broken = True
            raise

    def received(self, user: Asked) -> bytes:
        """Return what has arrived for this user since the last call."""
        return self._data.pop(id(user), b"")

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(OSError):
            self._port.close()


_LINES: dict[str, SharedLine] = {}
_LOCK = threading.Lock()


def join(path: str, line: LineSettings, user: Asked) -> SharedLine:
    """Return the shared line of this path, opened by its first user. Raises HardwareError."""
    with _LOCK:
        joined = _LINES.get(path)
        if joined is None or joined.broken:
            joined = _LINES[path] = SharedLine(path, line)
        joined.users.append(user)
        return joined


def leave(line: SharedLine, user: Asked) -> None:
    """End the use of a line; its last user closes it."""
    with _LOCK:
        if user in line.users:
            line.users.remove(user)
        if not line.users:
            line.close()
            if _LINES.get(line.path) is line:
                del _LINES[line.path]
