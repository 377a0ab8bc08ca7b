"""Keyboard input of the user during a test."""

from __future__ import annotations

import contextlib
import select
import signal
import sys
from collections.abc import Iterator


class Keyboard:
    """Pause and end a test from the keyboard.

    Ctrl-C pauses, Enter continues; a second Ctrl-C, SIGTERM or a terminal that closes ends it."""

    def __init__(self, interactive: bool):
        self.interactive, self.paused, self.ended = interactive, False, False

    def interrupt(self, number: int, _: object = None) -> None:
        """Handle a signal."""
        if number == signal.SIGINT and self.interactive and not self.paused:
            self.paused = True
            print(
                "\npaused; the setpoint is held. Enter goes on, Ctrl-C ends (what is recorded is kept)",
                file=sys.stderr,
            )
        else:
            self.ended = True

    def pausing(self) -> bool:
        """Check whether the test is paused; wait up to 0.2 s for Enter."""
        if self.paused and not self.ended and select.select([sys.stdin], [], [], 0.2)[0]:
            sys.stdin.readline()
            self.paused = False
        return self.paused and not self.ended

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Handle the signals within the context; under nohup a terminal may close."""
        ends = [] if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else [signal.SIGHUP]
        handled = [signal.SIGINT, signal.SIGTERM, *ends]
        before = {n: signal.signal(n, self.interrupt) for n in handled}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
