"""Names of the faults in a recording, by bit, from its own table."""

from __future__ import annotations

import json
from collections.abc import Mapping

from thermoctl.control import faults


def table(meta: Mapping[str, str]) -> dict[int, str]:
    """Return bit -> name for a recording with this metadata.

    A recording of another program (a CSV file) has no metadata: the present table applies. Raises ValueError
    when the metadata is damaged."""
    if "faults" not in meta:
        return faults.NAMES
    stored = json.loads(meta["faults"])
    if not isinstance(stored, dict) or not all(isinstance(name, str) for name in stored.values()):
        raise ValueError("its table of faults is damaged: expected bit: name")
    return {int(bit): name for bit, name in stored.items()}


def names(bits: int, table: Mapping[int, str]) -> tuple[str, ...]:
    """Return the names of the bits set, by a recording's own table; `bit N` where it has no name."""
    return tuple(table.get(bit, f"bit {bit}") for bit in range(bits.bit_length()) if bits >> bit & 1)
