"""The virtual meter that answers in lines of text."""

from __future__ import annotations

import re

from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.line import LineReader
from thermoctl_hal.base.profile import TextField, TextLine, typed
from thermoctl_hal.virtual.device import PtyDevice
from thermoctl_hal.virtual.plants import Readings


class TextMeter(PtyDevice):
    """A meter that answers each request with a line that the profile's own pattern accepts."""

    def __init__(self, binding: Binding, rig: Readings) -> None:
        super().__init__(binding, rig, binding.port)
        self._lines, self._text = LineReader(), typed(binding.profile.bus_spec, TextLine)
        self.mute = self.half = False
        self.verbs = {v: self.flag(self, v) for v in ("mute", "half")}

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer the input on `descriptor`."""
        for _ in self._lines.feed(self.pty.receive()):
            if not self.mute:
                line = self._line()
                self.pty.send(line[: len(line) // 2] if self.half else line)

    def _line(self) -> bytes:
        values = {
            typed(b.channel.source, TextField).group: self.reading(b) or 0.0 for b in self.binding.bounds
        }
        pattern = self._text.pattern.pattern
        filled = re.sub(r"\(\?P<(\w+)>[^)]*\)", lambda m: f"{values.get(m[1], 0.0):+.5f}", pattern)
        return filled.strip("^$").encode() + b"\r\n"
