"""Names of the faults in a recording, by bit: from its own table, or from the law version that wrote it."""

from __future__ import annotations

import json
from collections.abc import Mapping

from thermoctl.control import faults

_VERSION_2 = """
position_error position_stale position_range position_rate position_frozen
monitored_error monitored_stale monitored_range monitored_rate monitored_frozen
voltage_error voltage_stale voltage_range voltage_rate voltage_frozen
current_error current_stale current_range current_rate current_frozen
air_error air_stale air_range air_rate air_frozen
coil_error coil_stale coil_range coil_rate coil_frozen
amplifier_error amplifier_stale amplifier_range amplifier_rate amplifier_stopped
following_error coil_overtemperature coil_overtemperature_model coil_heating_rate coil_disagrees
power_limit coil_stuck_on compensation_bound compensation_slewing drive_saturated
amplifier_fault amplifier_not_following loop_late amplifier_write not_finite
electrical_disagrees position_disagrees monitored_disagrees
"""
NAMES_2 = tuple(_VERSION_2.split())
"""The names by bit in recordings of law version 2, which store no table. Data: never changed."""
NAMES_1 = tuple("amplifier_frozen" if name == "amplifier_stopped" else name for name in NAMES_2)
"""The same of law version 1."""


def table(meta: Mapping[str, str]) -> dict[int, str]:
    """Return bit -> name for a recording with this metadata.

    A recording of another program (a CSV file) has no metadata: the present table applies. Raises ValueError
    when the metadata is damaged.
    """
    if "faults" in meta:
        stored = json.loads(meta["faults"])
        if not isinstance(stored, dict) or not all(isinstance(name, str) for name in stored.values()):
            raise ValueError("its table of faults is damaged: expected bit: name")
        return {int(bit): name for bit, name in stored.items()}
    if not meta.get("law"):
        return faults.NAMES
    version = json.loads(meta["law"])["version"]
    return dict(enumerate(NAMES_1 if version == 1 else NAMES_2))


def names(bits: int, table: Mapping[int, str]) -> tuple[str, ...]:
    """Return the names of the bits set, by a recording's own table; `bit N` where it has no name."""
    return tuple(table.get(bit, f"bit {bit}") for bit in range(bits.bit_length()) if bits >> bit & 1)
