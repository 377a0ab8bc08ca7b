"""CAN devices that a DBC file describes; they are only listened to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hal.backend import HardwareError, Sample
from hal.binding import Binding
from hal.can_bus import LibraryPort, SlcanPort, open_can
from hal.device import Device
from hal.profile import Dbc, DbcSource, typed
from hal.wire import EXTENDED

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Message


class DbcDevice(Device):
    """A device whose messages a DBC file describes; nothing is sent to it."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        database = typed(binding.profile.bus_spec, Dbc).database
        self._port: SlcanPort | LibraryPort | None = None
        self._messages: dict[int, tuple[Message, list[tuple[int, str]]]] = {}
        self._quiet, self._why = 0, ""  # frames since the last reading, and why the last of them gave none
        for i, b in enumerate(binding.bounds):
            source = typed(b.channel.source, DbcSource)
            message = database.get_message_by_name(source.message)
            can_id = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
            self._messages.setdefault(can_id, (message, []))[1].append((i, source.signal))

    def connect(self) -> None:
        """Open the port."""
        self._port = open_can(self.binding.port, tuple(self._messages))
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
            entry = self._messages.get(can_id)
            if entry is None:
                self._quiet += 1
                if can_id ^ EXTENDED in self._messages:
                    here, there = (29, 11) if can_id & EXTENDED else (11, 29)
                    self._why = (
                        f"0x{can_id & ~EXTENDED:X} came as {here}-bit id, the DBC file says {there} bits"
                    )
                continue
            try:
                values: Mapping[str, Any] = entry[0].decode_simple(data, decode_choices=False)
                readings = [(i, float(values[signal])) for i, signal in entry[1] if signal in values]
            except Exception as e:  # foreign bytes may raise anything in the library
                self.counts["errors"] += 1
                self._quiet += 1
                self._why = f"{entry[0].name} came with {len(data)} bytes and does not decode ({e})"
                continue
            self.counts["frames"] += 1
            for i, value in readings:
                self._quiet, self._why = 0, ""
                self.put(sample, i, value, now_s)

    def silence(self) -> str:
        """Say what arrives instead of a reading."""
        wanted = ", ".join(f"0x{i & ~EXTENDED:X} ({29 if i & EXTENDED else 11} bits)" for i in self._messages)
        if self._quiet:
            return f"{self._quiet} frames came and gave no reading: {self._why or f'none is {wanted}'}"
        if self._port is not None and self._port.ignored:
            return (
                f"{self._port.ignored} remote or CAN FD frames came, {wanted} as classic data frame is wanted"
            )
        return f"{super().silence()}, the bitrate, and who sends {wanted}"

    def counters(self) -> dict[str, int]:
        """Return frames, errors (frames that did not decode), ignored frames, reconnections."""
        if self._port is not None:
            self.counts["ignored"] = self._port.ignored
        return self.counts
