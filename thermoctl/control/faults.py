"""Every fault the control law can raise: one table, from which the state, the messages and the reference page derive.

A fault has a bit (its place in `fault_bits`; below 2**53 so that the number is exact in a recording), a severity, what
it means and what to do. Severities:

- `warning`  shown and recorded, drives nothing off;
- `fault`    disables the amplifier when armed, and keeps the rig from being armed;
- `critical` disables the amplifier and latches FAULT from every state, armed or not.

A reading's fault belongs to a group of channels and has a kind. It trips when its channel is required
(`protection.required`), otherwise it is a warning. Cause, check and cure stand in remedies.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from thermoctl.control.remedies import REMEDIES

TEMPERATURES = (
    "coil_c",
    "bobbin_c",
    "inner_magnet_c",
    "outer_magnet_c",
    "inner_stator_c",
    "outer_stator_c",
    "stator_connector_c",
    "bobbin_connector_c",
    "shaft_1_c",
    "shaft_2_c",
    "bracket_1_c",
    "bracket_2_c",
)
"""The paper's twelve temperature points, in its order."""

CHANNELS = (
    "position_um",
    "output_reference_um",
    "voltage_v",
    "current_a",
    "air_c",
    *TEMPERATURES,
    "supply_v",
    "amplifier_state",
    "amplifier_fault",
)
"""What the law may be given to read, in the order of its arrays (the back end's roles)."""

GROUPS = ("position", "monitored", "voltage", "current", "air", "coil", "amplifier")
"""Channels that share their fault bits. `monitored`: the output reference and the eleven temperatures other than the
coil's, which the law with one sensor only watches. `amplifier`: what it reports of itself."""

GROUP_OF_CHANNEL = (0, 1, 2, 3, 4, 5, *(1,) * 11, 6, 6, 6)

_KINDS = (
    ("error", "the device is gone or reports an invalid reading"),
    ("stale", "no new reading for longer than its limit"),
    ("range", "the reading is outside protection.low..high, or is not a number"),
    ("rate", "the reading changed faster than protection.rate allows: a jump"),
    ("frozen", "the reading has not changed by one digit for longer than protection.frozen_s"),
)
KINDS = tuple(name for name, _ in _KINDS)

_WORDS = {
    "position": "position encoder",
    "monitored": "output reference or one of the other temperatures",
    "voltage": "coil voltage",
    "current": "coil current",
    "air": "chamber air temperature",
    "coil": "coil temperature",
    "amplifier": "the amplifier's report of itself",
}


@dataclass(frozen=True)
class Fault:
    """One row: `bit` its place in fault_bits, `name`, `severity` and what it `meaning`s."""

    bit: int
    name: str
    severity: str
    meaning: str

    @property
    def remedy(self) -> str:
        """How to check and how to cure, in one line."""
        return f"{REMEDIES[self.name].check}; {REMEDIES[self.name].cure}"


_READINGS = [
    (f"{group}_{kind}", "fault", f"{_WORDS[group]}: {meaning}")
    for group in GROUPS
    for kind, meaning in _KINDS
]
# All 53 bits are taken. What an amplifier reports stands still when all is well: in the place of a fault that it
# cannot have stands the one of its own. The other bits keep their places in older recordings.
_READINGS[-1] = (
    "amplifier_stopped",
    "fault",
    "the amplifier stopped driving without being told: quick stop, or switched off",
)

_OTHERS = [
    (
        "following_error",
        "fault",
        "the compensated position stayed away from the reference for longer than allowed",
    ),
    ("coil_overtemperature", "critical", "the measured coil temperature is above protection.coil_limit_c"),
    (
        "coil_overtemperature_model",
        "critical",
        "the estimated coil temperature is above protection.coil_limit_c",
    ),
    (
        "coil_heating_rate",
        "critical",
        "the measured coil temperature rises faster than protection.coil_rate_k_s",
    ),
    (
        "coil_disagrees",
        "fault",
        "measured coil temperature and the model stay apart: drifted, swapped or frozen sensor",
    ),
    ("power_limit", "critical", "the mean electrical power of the coil is above protection.power_limit_w"),
    (
        "coil_stuck_on",
        "critical",
        "the coil carries current or takes power although the amplifier is disabled",
    ),
    ("compensation_bound", "fault", "the estimated thermal error is beyond compensation.bound_um"),
    (
        "compensation_slewing",
        "warning",
        "the compensation lags its estimate because of compensation.slew_um_s",
    ),
    (
        "drive_saturated",
        "fault",
        "the controller's output stood at its limit for longer than protection.saturation_s",
    ),
    ("amplifier_fault", "critical", "the amplifier reports a fault of its own"),
    (
        "amplifier_not_following",
        "fault",
        "the amplifier does not do what it is told: it was not enabled in time after arming, drives "
        "while disabled, or the coil's current is not the one asked for",
    ),
    (
        "loop_late",
        "fault",
        "the loop did not run for longer than protection.late_s (starved, stopped or suspended)",
    ),
    ("amplifier_write", "critical", "a command could not be handed to the amplifier"),
    (
        "not_finite",
        "critical",
        "a number in the law was not finite: the last gate before the amplifier closed",
    ),
    (
        "electrical_disagrees",
        "fault",
        "coil voltage and current do not fit its resistance: one of the sensors or the coil's lead is bad",
    ),
    (
        "position_disagrees",
        "fault",
        "the position is not where the coil's current holds the stage: the encoder is wrong, or the stage is blocked",
    ),
    (
        "monitored_disagrees",
        "warning",
        "the output reference or a temperature that is only watched stays away from its estimate",
    ),
]

FAULTS = tuple(Fault(bit, *row) for bit, row in enumerate(_READINGS + _OTHERS))
"""The table, ordered by bit."""

BIT = {f.name: f.bit for f in FAULTS}
BY_NAME = {f.name: f for f in FAULTS}


def mask(*severities: str) -> int:
    """The bits of all faults with one of these severities."""
    return sum(1 << f.bit for f in FAULTS if f.severity in severities)


def decode(bits: float) -> tuple[Fault, ...]:
    """The faults whose bits are set in `fault_bits` (a whole number as float or int)."""
    number = int(bits)
    return tuple(f for f in FAULTS if number >> f.bit & 1)
