"""The virtual encoder: binary frames by the profile, and the ways in which they can be wrong."""

from __future__ import annotations

import os

from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.profile import BinaryFrame, typed
from thermoctl_hal.base.wire import Framer
from thermoctl_hal.virtual.device import PtyDevice
from thermoctl_hal.virtual.plants import Readings


class EncoderStream(PtyDevice):
    """An encoder that sends one binary frame each period."""

    def __init__(self, binding: Binding, rig: Readings) -> None:
        super().__init__(binding, rig, binding.port)
        spec = typed(binding.profile.bus_spec, BinaryFrame)
        self._framer, self._spec = Framer(spec), spec
        self._names = [n for n, _ in spec.fields]
        self._sequence = 0
        self.freeze = self.corrupt = self.mute = self.garbage = self.invalid = False
        self.verbs = {v: self.flag(self, v) for v in ("freeze", "corrupt", "mute", "garbage", "invalid")}
        self._held: dict[str, float] = {}

    def ready(self, descriptor: int, now_s: float) -> None:
        """Drop the input on `descriptor`: an encoder takes none."""
        self.pty.receive()

    def tick(self, now_s: float, tick: int) -> None:
        """Send the messages that are due at now_s."""
        if self.mute:
            return
        fields: dict[str, float] = dict.fromkeys(self._names, 0)
        if not self.freeze:
            self._held = {typed(b.channel.source, str): self.reading(b) or 0.0 for b in self.binding.bounds}
            for name, kind in self._spec.fields:
                if name in self._held and not kind.startswith("float"):
                    self._held[name] = round(self._held[name])
        fields.update(self._held)
        if self._spec.sequence:
            self._sequence = (self._sequence + 1) % self._framer.modulus
            fields[self._spec.sequence] = self._sequence
        if self.invalid and self._spec.invalid:
            fields[self._spec.invalid.field] = self._spec.invalid.mask & ~self._spec.invalid.value
        data = self._framer.encode(*(fields[n] for n in self._names))
        if self.corrupt:
            data = data[:-3] + bytes((data[-3] ^ 0x10,)) + data[-2:]
        if self.garbage and tick % 2:
            data = os.urandom(7) + self._spec.sync[:1] + data
        self.pty.send(data)
