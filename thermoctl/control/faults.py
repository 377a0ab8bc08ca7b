"""Every fault the control law can raise: one table, from which the state, the messages and the reference page derive.

A fault has a bit (its place in `fault_bits`; below 2**53 so that the number is exact in a recording), a severity, what
it means and what to do. Severities:

- `warning`  shown and recorded, drives nothing off;
- `fault`    disables the amplifier when armed, and keeps the rig from being armed;
- `critical` disables the amplifier and latches FAULT from every state, armed or not.

A reading's fault belongs to a group of channels and has a kind. It trips when its channel is required
(`protection.required`), otherwise it is a warning.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    (
        "error",
        "the device is gone or says that its reading is invalid (open thermocouple, CRC, disconnected)",
        "look at `thermoctl status` for the device's own message; check cable, port and supply",
    ),
    (
        "stale",
        "no new reading for longer than its limit",
        "check the cable and the device's sending rate against protection.stale_s and the profile's stale_after_s",
    ),
    (
        "range",
        "the reading is outside protection.low..high, or is not a number",
        "compare the reading with a second instrument; check scale and offset in the device's profile",
    ),
    (
        "rate",
        "the reading changed faster than protection.rate allows: a jump",
        "look for a loose connection or interference on the cable; check protection.rate against the real motion",
    ),
    (
        "frozen",
        "the reading has not changed by one digit for longer than protection.frozen_s",
        "the sensor or its converter hangs: cycle its supply; check protection.frozen_s against its noise",
    ),
)
KINDS = tuple(name for name, _, _ in _KINDS)

_WORDS = {
    "position": "position encoder",
    "monitored": "output reference or one of the other temperatures",
    "voltage": "coil voltage",
    "current": "coil current",
    "air": "chamber air temperature",
    "coil": "coil temperature",
    "amplifier": "what the amplifier reports of itself",
}


@dataclass(frozen=True)
class Fault:
    """One row: `bit` its place in fault_bits, `name`, `severity`, what it `meaning`s, and the `remedy`."""

    bit: int
    name: str
    severity: str
    meaning: str
    remedy: str


_READINGS = [
    (f"{group}_{kind}", "fault", f"{_WORDS[group]}: {meaning}", remedy)
    for group in GROUPS
    for kind, meaning, remedy in _KINDS
]
# All 53 bits are taken. What an amplifier reports stands still when all is well: in the place of a fault that it
# cannot have stands the one of its own. The other bits keep their places in older recordings.
_READINGS[-1] = (
    "amplifier_stopped",
    "fault",
    "the amplifier stopped driving without being told: quick stop, or switched off",
    "release the stop or limit input, check its supply and enable input; then `thermoctl disarm` and `thermoctl arm`",
)

_OTHERS = [
    (
        "following_error",
        "fault",
        "the compensated position stayed away from the reference for longer than allowed",
        "see whether the stage is blocked or the amplifier at its limit; then tune, or widen protection.following_um",
    ),
    (
        "coil_overtemperature",
        "critical",
        "the measured coil temperature is above protection.coil_limit_c",
        "let it cool; reduce the motion's duty; check that the coil's sensor is not loose",
    ),
    (
        "coil_overtemperature_model",
        "critical",
        "the estimated coil temperature is above protection.coil_limit_c",
        "let it cool; if the measured coil is cold, check the power reading and the model file",
    ),
    (
        "coil_heating_rate",
        "critical",
        "the measured coil temperature rises faster than protection.coil_rate_k_s",
        "look for a stalled stage or a short in the coil; check the amplifier's current limit",
    ),
    (
        "coil_disagrees",
        "fault",
        "measured coil temperature and the model stay apart: drifted, swapped or frozen sensor",
        "compare the coil sensor with a second one; check wiring order; identify the model again if the rig was changed",
    ),
    (
        "power_limit",
        "critical",
        "the mean electrical power of the coil is above protection.power_limit_w",
        "reduce the motion's duty; check for a blocked stage",
    ),
    (
        "coil_stuck_on",
        "critical",
        "the coil carries current or takes power although the amplifier is disabled",
        "cut the amplifier's supply now; the output stage or the enable line is defective",
    ),
    (
        "compensation_bound",
        "fault",
        "the estimated thermal error is beyond compensation.bound_um",
        "the estimate is not believable: check coil sensor, power reading and model file before widening the bound",
    ),
    (
        "compensation_slewing",
        "warning",
        "the compensation lags its estimate because of compensation.slew_um_s",
        "expected after a fault has cleared; otherwise the estimate is jumping: check the coil sensor",
    ),
    (
        "drive_saturated",
        "fault",
        "the controller's output stood at its limit for longer than protection.saturation_s",
        "see whether the stage is blocked, the amplifier unpowered or the setpoint out of reach",
    ),
    (
        "amplifier_fault",
        "critical",
        "the amplifier reports a fault of its own",
        "read its code in `thermoctl status`, clear the cause, then `thermoctl disarm` to acknowledge",
    ),
    (
        "amplifier_not_following",
        "fault",
        "the amplifier does not do what it is told: it was not enabled in time after arming, drives "
        "while disabled, or the coil's current is not the one asked for",
        "check its supply, its enable input, its heartbeat and the coil's leads; see `thermoctl status` for its state",
    ),
    (
        "loop_late",
        "fault",
        "the loop did not run for longer than protection.late_s (starved, stopped or suspended)",
        "see `thermoctl latency` and the tuning page; stop what burns the processor beside the loop",
    ),
    (
        "amplifier_write",
        "critical",
        "a command could not be handed to the amplifier",
        "check the amplifier's bus; the amplifier's own watchdog must have disabled it",
    ),
    (
        "not_finite",
        "critical",
        "a number in the law was not finite: the last gate before the amplifier closed",
        "a defect of the model file or the program: keep the recording and report it",
    ),
    (
        "electrical_disagrees",
        "fault",
        "coil voltage and current do not fit its resistance: a sensor of the two drifted, "
        "hangs, is open, shorted or swapped, or the coil's lead is broken",
        "measure both with a second instrument; check their leads, the coil's, and protection.resistance_ohm",
    ),
    (
        "position_disagrees",
        "fault",
        "the position is not where the coil's current holds the stage: encoder drifted, "
        "hangs, lost its zero or counts backwards, or the stage is blocked",
        "move the stage by hand and watch the encoder; home it again; check protection.flexure_um_per_a",
    ),
    (
        "monitored_disagrees",
        "warning",
        "the output reference or a temperature that is only watched stays away from its "
        "estimate: drifted or swapped sensor, or a model of another rig",
        "compare the twelve readings with the rig at rest: all must show the air; check the order of the sensors",
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
