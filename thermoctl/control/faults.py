"""Every fault that the control law can raise: bit, name, severity, meaning. One table.

The state machine, messages, `status`, recordings and reference pages derive from it. Severities:

- `warning`  is shown and recorded, and disables nothing;
- `fault`    disables the amplifier when armed, and keeps the rig from being armed;
- `critical` disables the amplifier and latches FAULT from every state, armed or not.

A reading's fault belongs to a group of channels and has a kind. It trips when its channel is required
(`protection.required`), otherwise it is a warning. Cause, check and cure stand in remedies.py.

Bits are part of the recording format: a bit is never given to another fault. A new fault takes the next free bit, at
most 63. Each recording stores its own table, so that it stays readable after this one has grown.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

from thermoctl.channels import GROUPS, TABLE
from thermoctl.control.remedies import REMEDIES

_KINDS = {
    "error": "the device is gone or reports an invalid reading",
    "stale": "no new reading for longer than its limit",
    "range": "the reading is outside protection.low..high, or is not a number",
    "rate": "the reading changed faster than protection.rate allows: a jump",
    "frozen": "the reading has not changed by one digit for longer than protection.frozen_s",
}
KINDS = tuple(_KINDS)
"""What can be wrong with a reading."""

READING_BITS = {
    "position": (0, 1, 2, 3, 4),
    "monitored": (5, 6, 7, 8, 9),
    "voltage": (10, 11, 12, 13, 14),
    "current": (15, 16, 17, 18, 19),
    "air": (20, 21, 22, 23, 24),
    "coil": (25, 26, 27, 28, 29),
    "amplifier": (30, 31, 32, 33, 31),  # an amplifier that repeats an old answer gives no new one: stale
}
"""Group of channels -> the bits of its readings' faults, in the order of KINDS."""


@dataclass(frozen=True)
class Fault:
    """One row. A fault of a reading names its `group` of channels and its `kind`."""

    bit: int
    name: str
    severity: str
    meaning: str
    group: str = ""
    kind: str = ""

    @property
    def remedy(self) -> str:
        """How to check and how to cure, in one line."""
        return f"{REMEDIES[self.name].check}; {REMEDIES[self.name].cure}"


_READINGS = {  # by bit: of kinds that share a bit the first one gives the name
    bit: Fault(bit, f"{group}_{kind}", "fault", f"{GROUPS[group]}: {_KINDS[kind]}", group, kind)
    for group, bits in READING_BITS.items()
    for bit, kind in reversed(list(zip(bits, KINDS, strict=True)))
}

_OTHERS = (
    Fault(
        34,
        "amplifier_stopped",
        "fault",
        "the amplifier stopped driving without being told: quick stop, or switched off",
    ),
    Fault(
        35,
        "following_error",
        "fault",
        "the compensated position stayed away from the reference for longer than allowed",
    ),
    Fault(
        36,
        "coil_overtemperature",
        "critical",
        "the measured coil temperature is above protection.coil_limit_c",
    ),
    Fault(
        37,
        "coil_overtemperature_model",
        "critical",
        "the estimated coil temperature is above protection.coil_limit_c",
    ),
    Fault(
        38,
        "coil_heating_rate",
        "critical",
        "the measured coil temperature rises faster than protection.coil_rate_k_s",
    ),
    Fault(
        39,
        "coil_disagrees",
        "fault",
        "measured coil temperature and the model stay apart: drifted, swapped or frozen sensor",
    ),
    Fault(
        40,
        "power_limit",
        "critical",
        "the mean electrical power of the coil is above protection.power_limit_w",
    ),
    Fault(
        41,
        "coil_stuck_on",
        "critical",
        "the coil carries current or takes power although the amplifier is disabled",
    ),
    Fault(42, "compensation_bound", "fault", "the estimated thermal error is beyond compensation.bound_um"),
    Fault(
        43,
        "compensation_slewing",
        "warning",
        "the compensation lags its estimate because of compensation.slew_um_s",
    ),
    Fault(
        44,
        "drive_saturated",
        "fault",
        "the controller's output stood at its limit for longer than protection.saturation_s",
    ),
    Fault(45, "amplifier_fault", "critical", "the amplifier reports a fault of its own"),
    Fault(
        46,
        "amplifier_not_following",
        "fault",
        "the amplifier does not do what it is told: it was not enabled in time after arming, drives "
        "while disabled, or the coil's current is not the one asked for",
    ),
    Fault(
        47,
        "loop_late",
        "fault",
        "the loop did not run for longer than protection.late_s (starved, stopped or suspended)",
    ),
    Fault(48, "amplifier_write", "critical", "a command could not be handed to the amplifier"),
    Fault(
        49,
        "not_finite",
        "critical",
        "a number in the law was not finite: the last gate before the amplifier closed",
    ),
    Fault(
        50,
        "electrical_disagrees",
        "fault",
        "coil voltage and current do not fit its resistance: one of the sensors or the coil's lead is bad",
    ),
    Fault(
        51,
        "position_disagrees",
        "fault",
        "the position is not where the coil's current holds the stage: the encoder is wrong, or the stage is blocked",
    ),
    Fault(
        52,
        "monitored_disagrees",
        "warning",
        "the output reference or a temperature that is only watched stays away from its estimate",
    ),
)

FAULTS = tuple(sorted((*_READINGS.values(), *_OTHERS), key=lambda f: f.bit))
"""The table, ordered by bit."""

BIT = {f.name: f.bit for f in FAULTS}
BY_NAME = {f.name: f for f in FAULTS}
NAMES = {f.bit: f.name for f in FAULTS}
"""Bit -> name, as a recording stores it."""

READING_BIT = bytes(bit for c in TABLE for bit in READING_BITS[c.group])
"""Bits of the readings' faults, channel by channel in the order of KINDS: how the compiled tick asks."""

NAMES_2 = (
    "position_error",
    "position_stale",
    "position_range",
    "position_rate",
    "position_frozen",
    "monitored_error",
    "monitored_stale",
    "monitored_range",
    "monitored_rate",
    "monitored_frozen",
    "voltage_error",
    "voltage_stale",
    "voltage_range",
    "voltage_rate",
    "voltage_frozen",
    "current_error",
    "current_stale",
    "current_range",
    "current_rate",
    "current_frozen",
    "air_error",
    "air_stale",
    "air_range",
    "air_rate",
    "air_frozen",
    "coil_error",
    "coil_stale",
    "coil_range",
    "coil_rate",
    "coil_frozen",
    "amplifier_error",
    "amplifier_stale",
    "amplifier_range",
    "amplifier_rate",
    "amplifier_stopped",
    "following_error",
    "coil_overtemperature",
    "coil_overtemperature_model",
    "coil_heating_rate",
    "coil_disagrees",
    "power_limit",
    "coil_stuck_on",
    "compensation_bound",
    "compensation_slewing",
    "drive_saturated",
    "amplifier_fault",
    "amplifier_not_following",
    "loop_late",
    "amplifier_write",
    "not_finite",
    "electrical_disagrees",
    "position_disagrees",
    "monitored_disagrees",
)
"""The names by bit in recordings of law version 2, which store no table. Data: never changed."""
NAMES_1 = tuple("amplifier_frozen" if name == "amplifier_stopped" else name for name in NAMES_2)
"""The same of law version 1."""


def mask(*severities: str, readings: bool = True) -> int:
    """Return the bits of all faults with one of these severities; without those of readings if not `readings`."""
    return sum(1 << f.bit for f in FAULTS if f.severity in severities and (readings or not f.group))


def decode(bits: float) -> tuple[Fault, ...]:
    """Return the faults whose bits are set in a word of fault bits (a whole number, as float or int)."""
    number = int(bits)
    return tuple(f for f in FAULTS if number >> f.bit & 1)


def recorded_names(meta: Mapping[str, str]) -> dict[int, str]:
    """Return bit -> name for a recording with this metadata.

    Without any metadata of ours (a CSV file) the present table holds. Raises ValueError when the metadata is damaged.
    """
    if "faults" in meta:
        table = json.loads(meta["faults"])
        if not isinstance(table, dict) or not all(isinstance(name, str) for name in table.values()):
            raise ValueError("its table of faults is damaged: expected bit: name")
        return {int(bit): name for bit, name in table.items()}
    if not meta.get("law"):
        return NAMES
    version = json.loads(meta["law"])["version"]
    return dict(enumerate(NAMES_1 if version == 1 else NAMES_2))


def names(bits: int, table: Mapping[int, str]) -> tuple[str, ...]:
    """Return the names of the bits set, by a recording's own table; `bit N` where it has no name."""
    return tuple(table.get(bit, f"bit {bit}") for bit in range(bits.bit_length()) if bits >> bit & 1)
