"""The project's log: structlog events on stderr, each with time, rig, axis and run.

A terminal and a log file get readable lines, journald gets JSON. Nothing stops when a line cannot be
written: lost lines are counted, and the next one that can be written says how many. `take_over` makes events
of libraries' warnings and of errors that nothing caught.
"""

from __future__ import annotations

import json
import logging
import os
import select
import sys
import threading
import time
import traceback
from collections.abc import MutableMapping
from typing import Any

import structlog

_bound: dict[str, Any] = {}
WAIT_S = 0.1
SLOW_S, PAUSE_S = 0.5, 10.0  # after a write that took so long, none is tried for PAUSE_S
_LAST = ("rig", "axis", "run")  # fields at a line's end


def bind(**fields: Any) -> None:
    """Add fields to all further events of this process and of those that it forks.

    Empty ones are left out.
    """
    _bound.update({name: value for name, value in fields.items() if value})


def console_log(event: str, **fields: Any) -> None:
    """Log an event; fields that are None are left out."""
    _logger.info(event, **fields)


def failed(what: str, error: BaseException) -> None:
    """Log an error that nothing caught, with its traceback."""
    console_log(f"{what} failed", error=repr(error), traceback="".join(traceback.format_exception(error)))


class _OfLibraries(logging.Handler):
    """Makes events of what libraries report through `logging`."""

    def emit(self, record: logging.LogRecord) -> None:
        """Log a record."""
        console_log("library", name=record.name, level=record.levelname.lower(), message=record.getMessage())


def take_over() -> None:
    """Let libraries' warnings, and errors that end a thread of this process or of its forks, be events."""
    root = logging.getLogger()
    if not any(isinstance(handler, _OfLibraries) for handler in root.handlers):
        root.addHandler(_OfLibraries(logging.WARNING))
    logging.captureWarnings(True)
    threading.excepthook = lambda hook: failed(
        hook.thread.name if hook.thread else "thread", hook.exc_value or hook.exc_type()
    )


def _add_bound(_: Any, __: str, fields: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    given = {name: value for name, value in fields.items() if value is not None}
    last = {**_bound, **given}
    return {k: v for k, v in given.items() if k not in _LAST} | {k: last[k] for k in _LAST if k in last}


def _to_journal() -> bool:
    """Return whether systemd connected stderr with journald (JOURNAL_STREAM of systemd.exec(5))."""
    try:
        status = os.fstat(2)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def _render(_: Any, __: str, fields: MutableMapping[str, Any]) -> str:
    time_, event = fields.pop("time"), fields.pop("event")
    if _to_journal():
        return json.dumps({"time": time_, "event": event, **fields}, default=str)
    return " ".join([f"{time_} thermoctl: {event}", *(f"{k}={_text(v)}" for k, v in fields.items())])


def _text(value: Any) -> str:
    text = str(value)
    return repr(text) if not text or any(c in text for c in " \n\"'=") else text


class _Stderr:
    """Writes whole lines on stderr; never raises for a full disk or a closed pipe."""

    lost = 0
    torn = False
    again_s = 0.0  # until this time no line is written

    def _write(self, data: bytes) -> None:
        """Write on stderr; raise BlockingIOError where a pipe or a terminal takes nothing for WAIT_S.

        Nobody reads it, or Ctrl-S stopped it: a command such as disarm would wait for this line. A disk that
        hangs holds up one line every PAUSE_S."""
        if (start_s := time.monotonic()) < self.again_s:
            raise BlockingIOError
        wait_s = 0.0 if self.lost else WAIT_S
        for at in range(0, len(data), select.PIPE_BUF):
            if not select.select([], [2], [], wait_s)[1]:
                raise BlockingIOError
            part = data[at : at + select.PIPE_BUF]
            done = os.write(2, part)
            self.torn = at + done < len(data)
        if (end_s := time.monotonic()) - start_s > SLOW_S:
            self.again_s = end_s + PAUSE_S

    def info(self, line: str) -> None:
        """Write one line."""
        head = "\n" if self.torn else ""
        if self.lost:
            stamp = line.split(" ", 1)[0] + " " if not line.startswith("{") else ""
            head += f"{stamp}thermoctl: the log could not be written, {self.lost} lines are lost\n"
        data = f"{head}{line}\n".encode(errors="backslashreplace")
        try:
            if sys.stderr is sys.__stderr__:
                self._write(data)
            else:  # replaced, in a test or a notebook
                sys.stderr.write(data.decode())
            self.lost = 0
        except (OSError, ValueError, AttributeError):
            self.lost += 1


_logger = structlog.wrap_logger(
    _Stderr(),
    processors=[_add_bound, structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"), _render],
    wrapper_class=structlog.BoundLogger,
)
