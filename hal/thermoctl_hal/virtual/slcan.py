"""The virtual CAN devices: CiA-402 drives, amplifiers and senders of a DBC file, behind a Lawicel adapter."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.binding import Binding, Bound
from thermoctl_hal.base.message import can_frame, multiplexers
from thermoctl_hal.base.profile import (
    ERROR_CODE,
    POSITION_MODES,
    STATUS_WORD,
    Amplifier,
    CanMessage,
    Cia402,
    Dbc,
    DbcSource,
    Message,
    Object,
    typed,
)
from thermoctl_hal.base.wire import encode_slcan
from thermoctl_hal.virtual.device import Pty, PtyDevice
from thermoctl_hal.virtual.drive import ENABLED, Cia402Drive, Frame, SlcanAdapter
from thermoctl_hal.virtual.plants import Readings

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Message as DbcMessage


class SlcanLine(Pty):
    """A Lawicel adapter on a pty, and the nodes of the bus behind it."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.adapter, self.nodes = SlcanAdapter(), list[SlcanDevice]()

    def plug(self) -> None:
        """Connect the adapter (again)."""
        if self.master < 0:
            self.adapter = SlcanAdapter()
        super().plug()

    def ready(self, now_s: float) -> None:
        """Give the frames that have arrived to every node, and send what they answer."""
        answer, frames = self.adapter.feed(self.receive())
        for node in self.nodes:
            for frame in frames:
                node.take(frame, now_s)
        answer += b"".join(self.adapter.encode(node.due(now_s)) for node in self.nodes)
        if answer:
            self.send(answer)


class SlcanDevice(PtyDevice):
    """A node of the bus behind a Lawicel adapter."""

    def __init__(self, binding: Binding, rig: Readings, line: SlcanLine) -> None:
        super().__init__(binding, rig, line)
        self.line = line
        line.nodes.append(self)

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer the input on `descriptor`."""
        self.line.ready(now_s)

    def take(self, frame: Frame, now_s: float) -> None:
        """Take one frame from the bus."""

    def due(self, now_s: float) -> list[Frame]:
        """Return the frames to send now."""
        return []

    def send(self, now_s: float) -> None:
        """Send the frames that are due."""
        if frames := self.due(now_s):
            self.pty.send(self.line.adapter.encode(frames))


class DriveOnSlcan(SlcanDevice):
    """The CiA-402 amplifier."""

    def __init__(self, binding: Binding, rig: Readings, line: SlcanLine) -> None:
        super().__init__(binding, rig, line)
        spec = typed(binding.profile.bus_spec, Cia402)
        self.drive = Cia402Drive(binding.address, spec.command.number)
        # The drive's own encoder sees the stage.
        role = f"{binding.axis}.position_um" if binding.axis else "position_um"
        self._position = role if spec.mode in POSITION_MODES else ""
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
    def enabled(self) -> bool:
        """Return whether the drive drives."""
        return self.drive.state == ENABLED

    @property
    def output(self) -> float:
        """Return the drive's output to the plant, in the profile's unit."""
        amplifier = self.binding.profile.amplifier
        return self.drive.command * amplifier.scale if amplifier is not None and self.drive.alive else 0.0

    def take(self, frame: Frame, now_s: float) -> None:
        """Take one frame from the bus."""
        self.drive.take(frame, now_s)

    def due(self, now_s: float) -> list[Frame]:
        """Return the drive's messages since the last call."""
        return self.drive.tick(now_s)

    def tick(self, now_s: float, tick: int) -> None:
        """Take the readings, and send the messages that are due at now_s."""
        for b in self.binding.bounds:
            item = typed(b.channel.source, Object)
            if item not in (STATUS_WORD, ERROR_CODE) and (raw := self.reading(b)) is not None:
                self.drive.od[item].value = round(raw)
        if self._position and (amplifier := self.binding.profile.amplifier) is not None:
            self.drive.od[0x6064, 0].value = round(self.rig.true(self._position) / amplifier.scale)
        self.send(now_s)


class DbcSender(SlcanDevice):
    """A device that sends the messages of a DBC file at the rate of their channels."""

    def __init__(self, binding: Binding, rig: Readings, line: SlcanLine) -> None:
        super().__init__(binding, rig, line)
        self._spec = typed(binding.profile.bus_spec, Dbc)
        self.mute = False
        self.verbs = {"mute": self.flag(self, "mute")}
        rates: dict[str, float] = {}
        for b in binding.bounds:
            name = typed(b.channel.source, DbcSource).message
            rates[name] = max(rates.get(name, 0.0), b.channel.rate_hz)
        self._every = {n: max(1, round(1.0 / (hz * rig.stepper.period_s))) for n, hz in rates.items()}

    def tick(self, now_s: float, tick: int) -> None:
        """Send the messages that are due at now_s."""
        if not self.mute and self.line.adapter.open:
            due = [f for name, every in self._every.items() if tick % every == 0 for f in self.frames(name)]
            self.pty.send(b"".join(encode_slcan(*frame) for frame in due))

    def frames(self, name: str) -> list[Frame]:
        """Return a message with the present readings: a frame for each page that has one of them."""
        spec, address, signals = self._spec, self.binding.address, dict[str, float | None]()
        for b in self.binding.bounds:
            source = typed(b.channel.source, DbcSource)
            if source.message == name:
                signals[source.signal] = self.reading(b) or 0.0
        message = spec.database.get_message_by_name(name)
        every = {s.name: tuple(page_of(message, s.name)) for s in message.signals}
        pages = {every[n] for n in signals if every[n]} or {max(every.values(), key=len)}
        frames = []
        for page in pages:
            can_id, data = can_frame(CanMessage(name, signals | dict(page)), spec, 0.0, address)
            is_asked = address >= 0 and spec.is_j1939(name, address)
            frames.append((can_id & ~0xFF | address if is_asked else can_id, data))
        return frames


def page_of(message: DbcMessage, name: str) -> Iterator[tuple[str, float]]:
    """Yield the multiplexers of a signal's page, each with a value that selects it."""
    signal = message.get_signal_by_name(name)
    for by in multiplexers(message, name):
        ids, signal = signal.multiplexer_ids or [0], message.get_signal_by_name(by)
        yield by, ids[0] * signal.scale + signal.offset


class DbcAmplifier(DbcSender):
    """An amplifier that obeys the messages of its profile. Its watchdog stops it when they cease."""

    def __init__(self, binding: Binding, rig: Readings, line: SlcanLine) -> None:
        super().__init__(binding, rig, line)
        self._amplifier = a = typed(binding.profile.amplifier, Amplifier)
        self.enabled, self.error = False, 0.0
        self._command, self._heard_s = 0.0, -math.inf
        self.verbs["fault"] = self._fault
        acts: list[tuple[tuple[Message, ...], Callable[[float], None]]] = [
            ((a.command,) if a.command is not None else (), self._obey),
            (a.enable, self._enable),
            (a.disable, self._disable),
            (a.reset, self._reset),
        ]
        self._obeyed = [(typed(m, CanMessage), act) for messages, act in acts for m in messages]

    def _fault(self, argument: str) -> None:
        """Stop with this error code."""
        try:
            self.error = float(int(argument, 0))
        except ValueError:
            raise InputError(f"fault: an error code as 0x40 was expected, found '{argument}'") from None
        self._disable(0.0)

    def _obey(self, command: float) -> None:
        self._command = command * self._amplifier.scale

    def _enable(self, _: float) -> None:
        self.enabled = self.error == 0.0

    def _disable(self, _: float) -> None:
        self.enabled, self._command = False, 0.0

    def _reset(self, _: float) -> None:
        self.error = 0.0

    def take(self, frame: Frame, now_s: float) -> None:
        """Obey a message of the profile's `drive`."""
        can_id, data = frame
        for message, act in self._obeyed:
            if can_id != self._spec.can_id(message.name, self.binding.address):
                continue
            decoded = self._spec.database.decode_message(message.name, data, decode_choices=False)
            assert isinstance(decoded, dict)  # a message without containers
            numbers = {n: float(v) for n, v in decoded.items() if isinstance(v, int | float)}
            if all(v is None or numbers[n] == v for n, v in message.values.items()):
                act(next((numbers[n] for n, v in message.values.items() if v is None), 0.0))
                self._heard_s = now_s

    def tick(self, now_s: float, tick: int) -> None:
        """Watch the commands, and send the messages that are due at now_s."""
        limit_s = self._amplifier.watchdog_s
        if self.enabled and limit_s is not None and now_s - self._heard_s > limit_s:
            self._disable(0.0)
        super().tick(now_s, tick)

    def reading(self, bound: Bound) -> float | None:
        """Return a reading; state and fault are the amplifier's own."""
        a = self._amplifier
        if a.state is not None and bound.channel.name == a.state.channel:
            return (a.state.enabled if self.enabled else a.state.disabled)[0]
        return self.error if bound.channel.name == a.fault else super().reading(bound)

    @property
    def output(self) -> float:
        """Return the amplifier's output to the plant, in the profile's unit."""
        return self._command if self.enabled else 0.0
