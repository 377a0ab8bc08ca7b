"""Messages that we send: text or bytes with the device's address and, for an amplifier, the command in it."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from thermoctl_hal.base.key import whole_range
from thermoctl_hal.base.profile import (
    BusSpec,
    CanMessage,
    Dbc,
    FrameMessage,
    Message,
    Register,
    RegisterMessage,
    TextMessage,
    typed,
)
from thermoctl_hal.base.wire import Framer

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Message as DbcMessage
    from cantools.database.can.signal import Signal

_ADDRESS = re.compile(rb"\{address(:[^{}]*)?\}")
_COMMAND = re.compile(rb"\{command(:[^{}]*)?\}")
_WHOLE = (b"d}", b"x}", b"X}")


def with_address(data: bytes, address: int) -> bytes:
    """Return `data` with the address in place of `{address}`, or of a format as `{address:02d}`."""
    return _ADDRESS.sub(lambda m: m[0].decode().format(address=address).encode(), data)


def serial_bytes(message: Message, command: float, address: int) -> bytes:
    """Return a message to a serial device. command: counts."""
    if isinstance(message, TextMessage):

        def number(m: re.Match[bytes]) -> bytes:
            """Return the command in the placeholder's format; the formats d, x and X round it."""
            value = round(command) if m[0].endswith(_WHOLE) else command
            return m[0].decode().format(command=value).encode()

        return _COMMAND.sub(number, with_address(message.template, address))
    if not isinstance(message, FrameMessage):
        raise TypeError(f"{type(message).__name__} is no message of a serial line")
    values = []
    for value, (_, kind) in zip(message.values, message.frame.fields, strict=True):
        number_ = float(address) if isinstance(value, str) else command if value is None else value
        values.append(number_ if kind.startswith("float") else round(number_))
    return Framer(message.frame).encode(*values)


def can_frame(message: Message, spec: Dbc, command: float, address: int) -> tuple[int, bytes]:
    """Return a message of the DBC file as (identifier, data). command: value of the signal."""
    if not isinstance(message, CanMessage):
        raise TypeError(f"{type(message).__name__} is no CAN message")
    definition = spec.database.get_message_by_name(message.name)
    given = _values(message, definition.signals, command)
    # Raw numbers, because cantools selects a page by the number that it is given.
    raws = {s.name: _raw(s, given[s.name]) for s in definition.signals}
    return spec.can_id(message.name, address), bytes(definition.encode(raws, scaling=False, strict=False))


def _values(message: CanMessage, signals: Iterable[Signal], command: float) -> dict[str, float]:
    given = {name: command if value is None else value for name, value in message.values.items()}
    return {s.name: 0.0 for s in signals} | given


def _raw(signal: Signal, value: float) -> float:
    """Return the number that a signal carries; a signal without a factor cannot be sent."""
    exact = (value - signal.offset) / signal.scale if signal.scale else 0.0
    return exact if signal.is_float else round(exact)


def multiplexers(message: DbcMessage, name: str) -> Iterator[str]:
    """Yield the multiplexer that selects the page of a signal, then that of its own page, and so on."""
    by_name = {s.name: s.multiplexer_signal for s in message.signals}
    for _ in by_name:  # a faulty file may let two of them select each other
        if not (name := by_name.get(name) or ""):
            return
        yield name


def clipped(value: float, register: Register) -> float:
    """Return a number inside the range of a register's type, rounded for whole types."""
    if register.type.startswith("float"):
        return value
    low, high = whole_range(16 * register.words, not register.type.startswith("u"))
    return float(min(max(round(value), low), high))


def misfit(message: Message, spec: BusSpec, command: float) -> str:
    """Return why a message cannot carry its numbers, '' where it can. command: counts."""
    try:
        if isinstance(message, RegisterMessage):
            value = command if message.value is None else message.value
            if message.register.type != "bit" and abs(clipped(value, message.register) - value) > 0.5:
                low, high = whole_range(16 * message.register.words, message.register.type[0] != "u")
                return f"{value:g} does not fit {message.register.type}, {low} .. {high}"
        elif isinstance(message, FrameMessage):
            zeros = FrameMessage(message.frame, (0.0,) * len(message.values))
            if len(serial_bytes(message, command, 0)) != len(serial_bytes(zeros, 0.0, 0)):
                return "a number has more digits than its field"
        elif isinstance(message, CanMessage):
            return _misfit_of_signals(message, typed(spec, Dbc), command)
    except (ArithmeticError, ValueError, struct.error) as e:
        return f"a number does not fit its field: {e}"
    return ""


def _misfit_of_signals(message: CanMessage, spec: Dbc, command: float) -> str:
    definition = spec.database.get_message_by_name(message.name)
    signals = {s.name: s for s in definition.signals}
    values = _values(message, definition.signals, command)

    def is_sent(name: str) -> bool:
        """Return whether the frame's page holds the signal."""
        ids, by = signals[name].multiplexer_ids, signals[name].multiplexer_signal
        return not ids or by is None or (is_sent(by) and _raw(signals[by], values[by]) in ids)

    for name, s in signals.items():
        if not is_sent(name):
            if name in message.values:
                return f"{name} is not sent: {s.multiplexer_signal} selects it: give its number in 'values'"
            continue
        if not s.scale:
            return f"{name} has the factor 0 in the DBC file"
        low, high = whole_range(s.length, s.is_signed)
        if not s.is_float and not low <= _raw(s, values[name]) <= high:
            first, last = sorted(x * s.scale + s.offset for x in (low, high))
            return f"{name} cannot be {values[name]:g}: it holds {first:g} .. {last:g}" + (
                "" if name in message.values else "; give its value in 'values'"
            )
    try:
        sent: Any = definition.decode_simple(can_frame(message, spec, command, 0)[1], False, False)
    except Exception as e:  # the DBC file decides what is raised: overlapping signals, a page without any
        return f"{message.name} cannot be sent ({e}): its signals must not overlap, its page must have one"
    for name in message.values:
        if not signals[name].is_float and sent[name] != _raw(signals[name], values[name]):
            return f"{name} cannot be sent: another signal of {message.name} has some of its bits"
    return ""
