"""The virtual CAN devices: a CiA-402 drive or a DBC sender behind a Lawicel adapter."""

from __future__ import annotations

import re
import time

from hal.binding import Binding
from hal.profile import ERROR_CODE, STATUS_WORD, Cia402, Dbc, DbcSource, Object, typed
from hal.simulated import PlantRig
from hal.virtual.device import PtyDevice
from hal.virtual.drive import Cia402Drive, SlcanAdapter
from hal.wire import EXTENDED, encode_slcan
from thermoctl.yamlfile import InputError


class SlcanDevice(PtyDevice):
    """A Lawicel adapter on a pty with a bus behind it."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig, re.sub(r"^slcan:|@\d+$", "", binding.port))
        self.adapter = SlcanAdapter()

    def plug(self) -> None:
        """Connect the device to its wire (again)."""
        if self.pty.master < 0:
            self.adapter = SlcanAdapter()
        super().plug()


class DriveOnSlcan(SlcanDevice):
    """The CiA-402 amplifier."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self.drive = Cia402Drive(binding.address, typed(binding.profile.bus_spec, Cia402).command.number)
        self.verbs = {
            "heartbeat": self.flag(self.drive, "heartbeat"),
            "power": self._power,
            "fault": self._fault,
            "stop": self._stop,
        }

    def _power(self, argument: str) -> None:
        if argument not in ("on", "off"):
            raise InputError(f"power: on or off was expected, found '{argument}'")
        self.drive.alive = argument == "on"
        self.drive.power_up()

    def _fault(self, argument: str) -> None:
        try:
            self.drive.fault(int(argument, 0) & 0xFFFF)
        except ValueError:
            raise InputError(f"fault: an error code as 0x2310 was expected, found '{argument}'") from None

    def _stop(self, argument: str) -> None:
        """Make the stop input active for this many ms."""
        try:
            self.drive.stop_until_s = time.monotonic() + float(argument) * 1e-3
        except ValueError:
            raise InputError(f"stop: a time in ms as 50 was expected, found '{argument}'") from None

    @property
    def output(self) -> float:
        """Return the drive's output to the plant, in the profile's unit."""
        amplifier = self.binding.profile.amplifier
        return self.drive.command * amplifier.scale if amplifier is not None and self.drive.alive else 0.0

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer the input on `descriptor`."""
        answer, frames = self.adapter.feed(self.pty.receive())
        for frame in frames:
            self.drive.take(frame, now_s)
        self._send(answer, now_s)

    def tick(self, now_s: float, tick: int) -> None:
        """Send the messages that are due at now_s."""
        for b in self.binding.bounds:
            item = typed(b.channel.source, Object)
            if item not in (STATUS_WORD, ERROR_CODE) and (raw := self.reading(b)) is not None:
                self.drive.od[item].value = round(raw)
        self._send(b"", now_s)

    def _send(self, answer: bytes, now_s: float) -> None:
        frames = self.drive.tick(now_s)
        if answer or frames:
            self.pty.send(answer + self.adapter.encode(frames))


class DbcSender(SlcanDevice):
    """A device that sends the messages of a DBC file at the rate of their channels."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self._database = typed(binding.profile.bus_spec, Dbc).database
        self.mute = False
        self.verbs = {"mute": self.flag(self, "mute")}

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer the input on `descriptor`."""
        answer, _ = self.adapter.feed(self.pty.receive())
        self.pty.send(answer)

    def tick(self, now_s: float, tick: int) -> None:
        """Send the messages that are due at now_s."""
        period = max(1, round(1.0 / (self.binding.bounds[0].channel.rate_hz * self.rig.stepper.period_s)))
        if self.mute or tick % period or not self.adapter.open:
            return
        sources = [(typed(b.channel.source, DbcSource), b) for b in self.binding.bounds]
        for name in {source.message for source, _ in sources}:
            message = self._database.get_message_by_name(name)
            values = dict.fromkeys((s.name for s in message.signals), 0.0)
            values |= {s.signal: self.reading(b) or 0.0 for s, b in sources if s.message == name}
            can_id = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
            self.pty.send(encode_slcan(can_id, bytes(message.encode(values, strict=False))))
