"""Ctrl-C, SIGTERM and a closed terminal end a command by one exception: one line and one exit status."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
from collections.abc import Iterator

STATUS = 130
"""Exit status of a command that was ended by a signal."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


_held: list[list[str]] = []  # signals that came within each `held`


class Interrupted(KeyboardInterrupt):
    """A signal that ends the command; its text is the line for the user.

    A KeyboardInterrupt may leave code that is executed from a string: so data classes are made in an import.
    Python remembers that, and ends by SIGINT, though the exception was caught."""


def raise_on_signals() -> None:
    """Let each of SIGNALS raise Interrupted; processes forked later end as usual.

    nohup and a shell's background ignore SIGHUP and SIGINT; they stay ignored. After the last exit handler
    all are ignored: Python would end by the signal then, though the command has done its work."""
    atexit.register(_ignore)
    pid = os.getpid()

    def end(number: int, _: object) -> None:
        """Raise Interrupted, in this process only."""
        if os.getpid() == pid:
            text = f"ended by {signal.Signals(number).name}"
            if not _held:
                raise Interrupted(text)
            _held[-1].append(text)
            return
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)

    for number in SIGNALS:
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)


def _ignore() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Let signals wait until the block has ended: one in it would lose a process that it starts."""
    _held.append([])
    try:
        yield
    finally:
        came = _held.pop()
    if came:
        raise Interrupted(came[0])
