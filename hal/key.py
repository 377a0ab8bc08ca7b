"""A key of a device profile: the row of the tables in keys.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

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
