"""Messages that we send: text or bytes with the device's address and, for an amplifier, the command in it."""

from __future__ import annotations

import re

from thermoctl_hal.base.profile import CanMessage, Dbc, FrameMessage, Message, Register, TextMessage
from thermoctl_hal.base.wire import Framer

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
    values = {s.name: 0.0 for s in definition.signals}
    values |= {name: command if value is None else value for name, value in message.values.items()}
    return spec.can_id(message.name, address), bytes(definition.encode(values, strict=False))


def clipped(value: float, register: Register) -> float:
    """Return a number inside the range of a register's type, rounded for whole types."""
    if register.type.startswith("float"):
        return value
    bits = 16 * register.words
    low, high = (
        (0, 2**bits - 1) if register.type.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    )
    return float(min(max(round(value), low), high))
