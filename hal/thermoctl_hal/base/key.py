"""A key of a device profile: a row of the tables in each keys.py; `take` reads a mapping by such a table."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

from thermoctl.files.yamlfile import Node, Section, number_of, suggest

REQUIRED: Any = ...


@dataclass(frozen=True)
class Key:
    """A key of a profile.

    kind: text, number, integer, flag, interval, list, section, or node (several of these). `default` is
    REQUIRED, or the value where the key is missing. low, high: limits of a number."""

    name: str
    kind: str
    meaning: str
    default: Any = REQUIRED
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    example: str = ""


def _key(kind: str, name: str, meaning: str, default: Any = REQUIRED, **more: Any) -> Key:
    return Key(name, kind, meaning, default, **more)


def _ranged(
    kind: str,
    name: str,
    meaning: str,
    low: float = -math.inf,
    high: float = math.inf,
    unit: str = "",
    default: Any = REQUIRED,
    example: str = "",
) -> Key:
    return Key(name, kind, meaning, default, unit, low, high, example=example)


text, flag, node = partial(_key, "text"), partial(_key, "flag"), partial(_key, "node")
listed, section = partial(_key, "list"), partial(_key, "section")
whole, number = partial(_ranged, "integer"), partial(_ranged, "number")
"""Make a key of a kind: name, meaning, then its default, or the limits of a number."""


def bits_of(of: str) -> tuple[Key, ...]:
    """Return the keys of a value that consists of some bits of another value."""
    return (
        whole("low_bit", f"lowest bit of the value inside {of}", 0, 63, default=0, example="4"),
        whole("bits", f"number of bits of the value; 0: all of {of}", 0, 64, default=0, example="19"),
    )


def check_bits(s: Section, k: dict[str, Any], width: int, of: str) -> None:
    """Raise InputError where the keys of `bits_of` and `signed` are not some bits of a whole number.

    width: its bits, 0 for another number. Without 'bits' the other two would have no effect."""
    if (k["bits"] or k["low_bit"] or k["signed"]) and not 1 <= k["bits"] <= width - k["low_bit"]:
        raise s.node.error(
            f"{s.what}: {k['bits']} bits from bit {k['low_bit']} are not inside {of}; "
            "'low_bit', 'bits' and 'signed' say which bits of a whole number hold the value"
        )


def whole_range(bits: int, is_signed: bool) -> tuple[int, int]:
    """Return the least and the largest whole number of so many bits."""
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if is_signed else (0, (1 << bits) - 1)


def sentinel_of(node: Node, bits: int, is_signed: bool, letter: str = "") -> float:
    """Return a sentinel as the raw number that it is read as. letter: f, d of a float type, else ''.

    Hexadecimal text is the bits of the number: 0x8000 of 16 bits with sign is -32768. Raises InputError where
    the type cannot hold it."""
    value = number_of(node, "sentinels")
    is_text = isinstance(node.value, str)
    if not letter and value % 1 == 0:  # exactly: a float has 53 bits
        value = int(node.value, 16) if is_text else int(node.value)
    if letter:
        whole = int(value).to_bytes(bits // 8, "big") if is_text and 0 <= value < 1 << bits else b""
        try:
            return float(struct.unpack(f">{letter}", whole or struct.pack(f">{letter}", value))[0])
        except OverflowError:
            raise node.error(f"sentinels: {value:g} is no float of {bits} bits") from None
    low, high = whole_range(bits, is_signed)
    if is_text and high < value < 1 << bits:
        return float(value - (1 << bits))
    if low <= value <= high and value == int(value):
        return float(value)
    kind = f"{bits} bits {'with' if is_signed else 'without'} sign"
    same = int(value) & (1 << bits) - 1
    hint = f"; its bits 0x{same:X} are read as {same - (1 << bits) * (is_signed and same > high)}"
    raise node.error(
        f"sentinels: {value:g} cannot come: {kind} hold {low} .. {high}"
        + (hint if value == int(value) and -(1 << bits - 1) <= value < 1 << bits else "")
    )


def named(s: Section, key: str, known: Iterable[str]) -> str:
    """Return the text of `key`, one of `known`. Raises InputError with a suggestion."""
    known = list(known)
    value = s.text(key)
    if value not in known:
        raise s.get(key).error(f"{key}: '{value}' is not one of {', '.join(known)}{suggest(value, known)}")
    return value


def take(s: Section, keys: Iterable[Key]) -> dict[str, Any]:
    """Read the keys of a table from `s`; values are checked, sections and nodes are left to the caller.

    A missing optional key has its default. Raises InputError. The caller calls `s.end()`."""
    return {key.name: _value(s, key) for key in keys}


def _value(s: Section, key: Key) -> Any:
    given = s.get(key.name, key.default is REQUIRED)
    if given is None:
        return key.default
    if key.kind == "text":
        return s.text(key.name, choices=key.choices)
    if key.kind == "number":
        return s.number(key.name, low=key.low, high=key.high)
    if key.kind == "integer":
        low, high = (int(v) if math.isfinite(v) else d for v, d in ((key.low, 0), (key.high, 2**32)))
        return s.integer(key.name, low=low, high=high)
    if key.kind == "flag":
        return s.flag(key.name, False)
    if key.kind == "interval":
        return s.interval(key.name)
    if key.kind == "list":
        return s.list(key.name)
    return s.section(key.name) if key.kind == "section" else given
