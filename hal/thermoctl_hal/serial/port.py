# cython: annotation_typing=False, cdivision=True
"""Serial devices: framed bytes with a checksum, and lines of text.

line.py opens the port, wire.Framer finds the frames in the bytes. Several devices that answer
requests may share a line (RS-485): shared_line.py opens it once and asks one of them at a time.

A line may send our own messages back: an RS-485 adapter, or a device with its echo on. A command that the
pattern takes would then be read as a measured current, or as the state of an amplifier that is dead. A line
echoes if a message comes back that no answer can be, because the pattern does not take it. From then on each
line equal to one that was sent is passed over, once.
"""

from __future__ import annotations

import contextlib
import os
import re
from array import array
from collections import deque
from typing import Any

from thermoctl_hal.base.backend import Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.line import LineReader, open_port
from thermoctl_hal.base.message import with_address
from thermoctl_hal.base.profile import Assumed, BinaryFrame, TextField, TextLine, typed
from thermoctl_hal.base.wire import Framer, checksum, read_available, wait_readable
from thermoctl_hal.serial.shared_line import SharedLine, join, leave
from thermoctl_hal.serial.text_number import cut_short, number, shown, why_no_match, why_no_number

ECHOES = 64  # lines of ours that may still come back


class SerialDevice(Device):
    """A device that streams (or answers requests with) binary frames or text lines."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        self._port: Any = None  # serial.Serial, or a socket
        self._line: SharedLine | None = None
        self._fd = -1
        spec = binding.profile.bus_spec
        self._framer: Framer | None = None
        self._due_s, self._waited = 0.0, False
        self._sent: deque[str] = deque(maxlen=ECHOES)  # lines of ours that have not come back
        self._echoes = False  # does the line send them back?
        self._unread, self._why = 0, ""  # lines since the last reading, and why the last of them gave none
        if isinstance(spec, BinaryFrame):
            self._framer = Framer(spec)
            self._lines = LineReader()
            names = spec.names
            sources = [b.channel.source for b in binding.bounds]
            self._index = array(
                "i", [-1 if isinstance(s, Assumed) else names.index(typed(s, str)) for s in sources]
            )
            self._flags = names.index(spec.invalid.field) if spec.invalid else -1
            self._flag_mask = spec.invalid.mask if spec.invalid else 0
            self._flag_good = spec.invalid.value if spec.invalid else 0
            self._request, self._request_hz, self.answer_s = spec.request, spec.request_hz, spec.answer_s
        else:
            text = self._text = typed(spec, TextLine)
            self._lines = LineReader(text.end)
            self._fields = [
                (i, typed(b.channel.source, TextField))
                for i, b in enumerate(binding.bounds)
                if not isinstance(b.channel.source, Assumed)
            ]
            self._request, self._request_hz, self.answer_s = text.request, text.request_hz, text.answer_s
        self._request = with_address(self._request, binding.address)

    def connect(self) -> None:
        """Open the port; frames in its buffer are dropped."""
        port, line = self.binding.port, self.binding.profile.line
        if self.binding.shared:
            self._line = join(port, line, self)
        else:
            self._port = open_port(port, line)
            self._fd = self._port.fileno()
        self._lines.reset(not self._request)
        self._sent.clear()
        self._waited, self._unread, self._echoes = False, 0, False
        if self._framer:
            self._framer.reset()

    def disconnect(self) -> None:
        """Close the port."""
        if self._line is not None:
            leave(self._line, self)
            self._line = None
        port, self._port, self._fd = self._port, None, -1
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    def wait_frame(self, until_ns: int) -> bool:
        """Wait for a whole frame, at most until `until_ns` (monotonic clock); True when one came.

        The next `read` stores it."""
        framer = self._framer
        while not self._waited:
            if framer is not None and framer.read(self._fd):
                self._waited = True
            elif not wait_readable(self._fd, until_ns):
                return False
        return True

    def read(self, sample: Sample, now_s: float) -> None:
        """Ask when it is time to, and put the newest frame or line into `sample`."""
        framer = self._framer
        if self._line is not None:
            self._line.serve(now_s)
            if framer is None:
                self._take_lines(sample, self._line.received(self), now_s)
            elif framer.feed(self._line.received(self)):
                self._take_frame(sample, framer, now_s)
            return
        if self._request_hz and now_s >= self._due_s:
            self._due_s = now_s + 1.0 / self._request_hz
            self.ask(self._fd)
        if framer is None:
            self._take_lines(sample, read_available(self._fd), now_s)
        elif framer.read(self._fd) or self._waited:
            self._waited = False
            self._take_frame(sample, framer, now_s)

    def request_due_s(self, now_s: float) -> float:
        """Return when this device of a shared line is to be asked, in seconds of `now_s`."""
        return self._due_s

    def ask(self, fd: int) -> None:
        """Send the request. A half answer to the one before is dropped."""
        if self._framer is not None:
            self._framer.drop()
        else:
            self._lines.drop_half(1.0 / self._request_hz)
        with contextlib.suppress(BlockingIOError):  # the line is full: ask again at the next due time
            os.write(fd, self._request)
        self.sent(self._request)

    def sent(self, data: bytes) -> None:
        """Note a message of ours, which may come back."""
        self._sent.extend(data.decode("ascii", "replace").splitlines())

    def asked(self, now_s: float) -> None:
        """Note that a shared line has asked this device."""
        self._due_s = now_s + 1.0 / self._request_hz

    def answers(self) -> int:
        """Count the answers so far, good and bad ones."""
        if self._framer is not None:
            return self._framer.frames + self._framer.others
        return self.counts["frames"] + self.counts["errors"]

    def _take_frame(self, sample: Sample, framer: Framer, now_s: float) -> None:
        flags = framer.whole(self._flags) & self._flag_mask if self._flags >= 0 else self._flag_good
        if flags != self._flag_good:
            self.fail_all(sample, f"reports an error (status 0x{flags:X}): check the sensor")
            return
        for i in range(len(self._index)):
            if self._index[i] >= 0:
                self.put(sample, i, framer.number(self._index[i]), now_s)

    def counters(self) -> dict[str, int]:
        """Return frames, errors (bad frames), lost (gaps of the sequence), reconnections."""
        if self._framer is not None:
            framer = self._framer
            self.counts.update(frames=framer.frames, errors=framer.bad, lost=framer.lost)
        return self.counts

    def silence(self) -> str:
        """Say what arrives instead of a reading."""
        framer, baud = self._framer, self.binding.profile.line.baud
        if framer is None:
            if self._unread:
                return f"{self._unread} lines gave no reading; {self._why}"
            if self._lines.pending:
                end = "'end' of the profile" if self._text.end else "CR or LF"
                return (
                    f"{self._lines.pending} bytes came and no line end ({end}): check baud {baud} and parity"
                )
            return super().silence()
        if framer.others and not framer.frames:
            return f"{framer.others} frames came with another number in a field that says 'equals': check 'equals'"
        if not framer.quiet_bytes:
            return super().silence()
        came = f"{framer.quiet_bytes} bytes came"
        if framer.quiet_sums > framer.quiet_lengths:
            return (
                f"{came}, {framer.quiet_sums} frames with a wrong CRC: "
                f"check 'crc', 'crc_endian', 'crc_over', 'fields', baud {baud}"
            )
        if framer.quiet_lengths:
            return (
                f"{came}, {framer.quiet_lengths} frames with another length byte than {framer.spec.payload_size}: "
                f"check 'length', 'fields' and baud {baud}"
            )
        sync = framer.spec.sync.hex(" ")
        return f"{came} without a whole frame that begins with {sync}: check 'sync' and baud {baud}"

    def _take_lines(self, sample: Sample, data: bytes, now_s: float) -> None:
        for raw in self._lines.feed(data) if data else ():
            line = raw.decode("ascii", "replace")
            if self._is_echo(line):
                self._unread, self._why = (
                    self._unread + 1,
                    f"received {shown(line)}, which is our own message",
                )
                continue
            problem = self._take_line(sample, line, now_s)
            if problem:
                self.counts["errors"] += 1
                self._unread, self._why = self._unread + 1, problem
            else:
                self.counts["frames"] += 1
                self._unread = 0

    def _is_echo(self, line: str) -> bool:
        """Return whether a line is one that we sent."""
        if line not in self._sent:
            return False
        self._echoes = self._echoes or self._text.pattern.match(line) is None
        if self._echoes:
            self._sent.remove(line)
        return self._echoes

    def _take_line(self, sample: Sample, line: str, now_s: float) -> str:
        """Store the readings of a line; return '', or the reason when it gave none.

        A line with one number that cannot be read gives no reading at all."""
        spec = self._text
        if spec.checksum is not None and (problem := wrong_checksum(line, *spec.checksum)):
            return problem
        match = spec.pattern.match(line)
        if match is None:
            return why_no_match(line, spec.pattern)
        values: list[tuple[int, float]] = []
        for i, field in self._fields:
            if match[field.group] is None:  # a reading of another kind of line
                continue
            value = _value(line, match, field, spec.decimal)
            if isinstance(value, str):
                return value
            values.append((i, value))
        for i, value in values:
            self.put(sample, i, value, now_s)
        return ""


def _value(line: str, match: re.Match[str], field: TextField, decimal: str) -> float | str:
    """Return the number that a field of a line gives, or the reason why it gives none."""
    text = match[field.group]
    value = number(text, field.base, decimal)
    if value is None:
        return why_no_number(text, line, field.base, decimal)
    if cut_short(line, match, field.group):
        return (
            f"received {shown(line)}: the number goes on behind {shown(text)}, where the pattern ends: "
            "end it with $"
        )
    if field.sign and (match[field.sign] or "").strip() == "-":
        value = -value
    if field.unit_field:
        unit = (match[field.unit_field] or "").strip()
        if unit not in field.unit_factors:
            known = ", ".join(field.unit_factors)
            return f"received {shown(line)}: unit '{unit}' is none of 'unit_factors' ({known})"
        value *= field.unit_factors[unit]
    return value


def wrong_checksum(line: str, name: str, pattern: re.Pattern[str]) -> str:
    """Return '' when the checksum of a line of text is right, else the reason."""
    match = pattern.match(line)
    if match is None:
        return f"received {shown(line)}: no checksum where 'checksum' expects it ({pattern.pattern})"
    wanted = checksum(name, match["data"].encode("ascii", "replace"))
    try:
        found = int(match["sum"], 16)
    except ValueError:
        found = -1
    return (
        ""
        if found == wanted
        else f"received {shown(line)}: checksum {match['sum']}, {wanted:02X} was expected"
    )
