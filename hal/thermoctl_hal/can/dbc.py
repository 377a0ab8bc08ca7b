"""CAN devices that a DBC file describes: sensors, which are only listened to, and amplifiers."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.amplifier import Commanded
from thermoctl_hal.base.backend import HardwareError, Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.message import can_frame, multiplexers
from thermoctl_hal.base.profile import Amplifier, Assumed, CanMessage, Dbc, DbcSource, Message, typed
from thermoctl_hal.base.wire import EXTENDED
from thermoctl_hal.can.bus import BY_PGN, AnyPort, open_can, pgn_of

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Message as DbcMessage

_Entry = tuple["DbcMessage", list[tuple[int, DbcSource]], list[str]]
CLASSIC_BYTES = 8  # longest data of a frame that is not CAN FD
ECHOES = 64  # own frames that may still come back from an adapter


class DbcDevice(Device):
    """A sensor whose messages a DBC file describes; nothing is sent to it."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        spec = self._spec = typed(binding.profile.bus_spec, Dbc)
        self._port: AnyPort | None = None
        self._messages: dict[int, _Entry] = {}
        """CAN id, or parameter group of J1939 -> the message, its bound channels, and the names of signals
        that say whether they are good."""
        self._sender: dict[int, int] = {}  # parameter group -> the source address that it is taken from
        self._fd_ignored = 0
        self._others: set[int] = set()  # source addresses of J1939 whose messages were not taken
        # Number of frames since the last reading; why the newest of them gave no reading.
        self._quiet, self._why = 0, ""
        self._commands: dict[int, str] = {}  # CAN id -> message of ours, that nobody else may send
        for i, b in enumerate(binding.bounds):
            if isinstance(b.channel.source, Assumed):
                continue
            source = typed(b.channel.source, DbcSource)
            message = spec.database.get_message_by_name(source.message)
            can_id = spec.can_id(source.message, binding.address)
            if spec.is_j1939(source.message, binding.address):
                can_id = pgn_of(can_id)
                if message.length > CLASSIC_BYTES:
                    raise InputError(
                        f"{b.channel.place}: message: {message.name} has {message.length} bytes: J1939 sends it in "
                        f"parts (transport protocol), which are not put together; bind a message of up to "
                        f"{CLASSIC_BYTES} bytes, or let a gateway send the signal in one"
                    )
            entry = self._messages.setdefault(can_id, (message, [], []))
            if entry[0] is not message:
                raise InputError(
                    f"{b.channel.place}: message: {message.name} and {entry[0].name} have the same identifier, "
                    f"{_shown(can_id)}: a frame cannot tell them apart; give this channel a device of its own in "
                    "the rig file (of J1939 with its 'address')"
                )
            entry[1].append((i, source))
            if source.invalid is not None:
                entry[2].append(source.invalid.field)

    def connect(self) -> None:
        """Open the port."""
        self._port = open_can(self.binding.port, (*self._messages, *self._commands), self.binding.shared)
        self._quiet = 0

    def disconnect(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def read(self, sample: Sample, now_s: float) -> None:
        """Decode the frames that have arrived. `silence` reports those that do not decode."""
        port = self._port
        if port is None:
            raise HardwareError("not connected")
        for can_id, data in port.receive():
            self._take(sample, can_id, data, now_s)
        for can_id, data in port.long_frames():
            entry = self._entry(can_id)
            is_long = entry is not None and (entry[0].is_fd or entry[0].length > CLASSIC_BYTES)
            if is_long or can_id in self._commands:
                self._take(sample, can_id, data, now_s)
            else:
                self._fd_ignored += 1

    def _entry(self, can_id: int) -> _Entry | None:
        """Return the message of an identifier, or of its parameter group.

        A group is taken from its first sender only. A second sender is another device; `address` of the
        binding selects it."""
        entry = self._messages.get(can_id)
        group = pgn_of(can_id)
        if entry is not None or group not in self._messages:
            return entry
        address = can_id & 0xFF
        wanted = self.binding.address
        if address == (wanted if wanted >= 0 else self._sender.setdefault(group, address)):
            return self._messages[group]
        self._others.add(address)
        return None

    def _take(self, sample: Sample, can_id: int, data: bytes, now_s: float) -> None:
        """Store the readings of a frame."""
        entry = self._entry(can_id)
        if entry is None:
            self._quiet += 1
            if self._others:
                wanted = ", ".join(str(a) for a in sorted(self._others))
                self._why = f"source addresses {wanted} send it, too: give the wanted one as 'address'"
            elif can_id ^ EXTENDED in self._messages:
                here, there = (29, 11) if can_id & EXTENDED else (11, 29)
                self._why = f"0x{can_id & ~EXTENDED:X} came as {here}-bit id, the DBC file says {there} bits"
            elif can_id & EXTENDED and pgn_of(can_id) in map(pgn_of, self._messages):
                self._why = (
                    f"0x{can_id & ~EXTENDED:X} came, the same message of J1939 from source address {can_id & 0xFF}: "
                    f"say address: {can_id & 0xFF}"
                )
            return
        message, sources, tests = entry
        try:
            raws = _decoded(message, data, (*(s.signal for _, s in sources), *tests))
        except Exception as e:  # foreign bytes may raise anything in the library
            self.counts["errors"] += 1
            self._quiet += 1
            self._why = f"{message.name} came with {len(data)} bytes and does not decode ({e})"
            return
        readings = [(i, s) for i, s in sources if s.signal in raws]
        if not readings:
            self._without_signal(message, data, raws)
            return
        self.counts["frames"] += 1
        self._quiet, self._why = 0, ""
        for i, source in readings:
            self._store(sample, i, message, source, raws, now_s)

    def _store(
        self,
        sample: Sample,
        i: int,
        message: DbcMessage,
        source: DbcSource,
        raws: Mapping[str, float],
        now_s: float,
    ) -> None:
        """Store one reading of a frame, unless the frame says that it is none."""
        signal, raw, test = message.get_signal_by_name(source.signal), raws[source.signal], source.invalid
        value = float(raw * signal.scale + signal.offset)
        if raw in source.sentinels or raw in source.absent:
            self.fail(sample, i, f"{source.signal} is {value:g}: no reading")
        elif test is None:
            self.put(sample, i, value, now_s)
        elif test.field not in raws:
            self.miss(i, f"{message.name} came without {test.field}, which says whether it is good")
        elif int(raws[test.field]) & test.mask != test.value:
            self.fail(sample, i, f"{test.field} is 0x{int(raws[test.field]):X}: the device reports a fault")
        else:
            self.put(sample, i, value, now_s)

    def _without_signal(self, message: DbcMessage, data: bytes, raws: Mapping[str, float]) -> None:
        """Note a frame without any signal of the profile: it is short, or of another page."""
        self._quiet += 1
        if len(data) < message.length:
            self.counts["errors"] += 1
            self._why = f"{message.name} came with {len(data)} of {message.length} bytes, without the signal"
            return
        self.counts["frames"] += 1
        pages = ", ".join(f"{s.name} {raws.get(s.name)}" for s in message.signals if s.is_multiplexer)
        self._why = f"{message.name} came with {pages}, a page without the signal"

    def silence(self) -> str:
        """Say what arrives instead of a reading."""
        wanted = ", ".join(map(_shown, self._messages))
        if self._quiet:
            return f"{self._quiet} frames came and gave no reading: {self._why or f'none is {wanted}'}"
        ignored = self.counters().get("ignored", 0)
        if ignored:
            return f"{ignored} remote or CAN FD frames came, {wanted} as classic data frame is wanted"
        return f"{super().silence()}, the bitrate, and who sends {wanted}"

    def counters(self) -> dict[str, int]:
        """Return frames, errors (frames that did not decode), ignored frames, reconnections."""
        if self._port is not None:
            self.counts["ignored"] = self._port.ignored + self._fd_ignored
        return self.counts


def _decoded(message: DbcMessage, data: bytes, wanted: Iterable[str]) -> Mapping[str, float]:
    """Return the raw numbers of a frame's signals.

    cantools selects a page by the number that it returns for the multiplexer, and pages are counted in raw
    numbers. Of a page that the file does not describe, those of every page and the wanted ones."""
    message = _long_enough(message)
    try:
        found: Any = message.decode_simple(data, False, False, True)
    except Exception:  # foreign bytes may raise anything in the library
        if not message.is_multiplexed():
            raise
        found = _alone(message, "").decode_simple(data, False, False, True)
        for name in wanted:
            with suppress(Exception):  # it is on another page
                found |= _alone(message, name).decode_simple(data, False, False, True)
    return cast(Mapping[str, float], found)


@lru_cache(maxsize=256)
def _long_enough(message: DbcMessage) -> DbcMessage:
    """Return a message as long as its signals: with a shorter length cantools decodes none of them."""
    ends = (
        s.length + (s.start if s.byte_order == "little_endian" else s.start // 8 * 8 + 7 - s.start % 8)
        for s in message.signals
    )
    needed = -(-max(ends, default=0) // 8)
    if needed <= message.length:
        return message
    return type(message)(message.frame_id, message.name, needed, message.signals, strict=False)


@lru_cache(maxsize=256)
def _alone(message: DbcMessage, name: str) -> DbcMessage:
    """Return a multiplexed message with the signals of every page, and one with its multiplexers."""
    chain = {name, *multiplexers(message, name)}
    signals = [s for s in message.signals if not s.multiplexer_ids or s.name in chain]
    return type(message)(message.frame_id, message.name, message.length, signals, strict=False)


def _shown(can_id: int) -> str:
    """Return an identifier or a parameter group for messages."""
    if can_id & BY_PGN:
        return f"PGN {can_id & ~BY_PGN} of J1939"
    return f"0x{can_id & ~EXTENDED:X} ({29 if can_id & EXTENDED else 11} bits)"


class DbcDrive(Commanded, DbcDevice):
    """An amplifier that takes messages of a DBC file.

    A frame with the identifier of a message of ours is another master's, unless it is the echo of one that
    we sent. A message of which a channel is bound comes from the amplifier, too, and is not checked."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        a = typed(binding.profile.amplifier, Amplifier)
        names = {typed(m, CanMessage).name for m in (a.command, *a.set_up, *a.enable, *a.disable, *a.reset)}
        ids = {self._spec.can_id(name, binding.address): name for name in names}
        self._commands = {i: n for i, n in ids.items() if not {i, pgn_of(i)} & self._messages.keys()}
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=ECHOES)

    def _take(self, sample: Sample, can_id: int, data: bytes, now_s: float) -> None:
        """Store the readings of a frame. Raises HardwareError for a command of another master."""
        if can_id not in self._commands:
            super()._take(sample, can_id, data, now_s)
        elif (can_id, data) in self._sent:
            self._sent.remove((can_id, data))
        else:
            raise HardwareError(
                f"another device on {self.binding.port} sends {self._commands[can_id]}, {_shown(can_id)}, which "
                "commands this drive: two masters would drive one axis; switch the other one off. If the drive itself "
                "answers with this message, bind a channel of it"
            )

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send the messages that are due; those that a full queue refused come again in the next tick."""
        refused = 0 if self._port is None else self._port.bad
        super().write(drive, enable, now_s)
        if self._port is not None and self._port.bad != refused:
            self.sequencer.send_again()

    def send_message(self, message: Message, command: float) -> None:
        """Send one message. Raises OSError."""
        if self._port is None:
            raise HardwareError("not connected")
        can_id, data = can_frame(message, self._spec, command, self.binding.address)
        self._sent.append((can_id, data))
        if len(data) > CLASSIC_BYTES:
            self._port.send_long(can_id, data)
        else:
            self._port.send((can_id, data))
