"""A key of a device profile: a row of the tables in each keys.py; `take` reads a mapping by such a table."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from thermoctl.yamlfile import Section, suggest

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


def bits_of(of: str) -> tuple[Key, ...]:
    """Return the keys of a value that is some bits of another one."""
    return (
        Key("low_bit", "integer", f"lowest bit of the value inside {of}", 0, "", 0, 63, example="4"),
        Key("bits", "integer", f"number of bits of the value; 0: all of {of}", 0, "", 0, 64, example="19"),
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
