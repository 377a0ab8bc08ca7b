"""Every fault that the control law can raise: bit, name, severity, meaning, cause, check and cure. One table.

The state machine, messages, `status`, recordings and reference pages derive from it.
Severities:

- `warning`  is shown and recorded, and disables nothing;
- `fault`    disables the amplifier when armed, and keeps the rig from being armed;
- `critical` disables the amplifier and latches FAULT from every state, armed or not.

A reading's fault belongs to a group of channels and has a kind. It trips when its channel is required
(`protection.required`), otherwise it is a warning.

Bits are part of the recording format: a bit is never given to another fault. A new fault takes the next free
bit, at most 63. Each recording stores its own table, so that it stays readable after this one has grown.
"""

from __future__ import annotations

from dataclasses import dataclass

from thermoctl.rig.channels import FIXED, GROUPS


@dataclass(frozen=True)
class Fault:
    """One row. A fault of a reading names its `group` of channels and its `kind`.

    cause: the usual causes, most frequent first; check: how to find out which it is; cure: the repair."""

    bit: int
    name: str
    severity: str
    meaning: str
    cause: str
    check: str
    cure: str
    group: str = ""
    kind: str = ""

    @property
    def remedy(self) -> str:
        """How to check and how to cure, in one line."""
        return f"{self.check.rstrip('.')}; {self.cure}"


_KINDS = {
    "error": "the device is gone or reports an invalid reading",
    "stale": "no new reading for longer than its limit",
    "range": "the reading is outside protection.low..high, or is not a number",
    "rate": "the reading changed faster than protection.rate allows: a jump",
    "frozen": "the reading has not changed by one digit for longer than protection.frozen_s",
}
KINDS = tuple(_KINDS)
"""Kinds of a reading's faults."""

_BUS_OFF = (
    "On CAN, `bus-off` means that the adapter left the bus after too many transmission errors: "
    "usually a wrong bitrate, a missing terminator or a short between CAN_H and CAN_L. SocketCAN, gs_usb, PCAN and "
    "interfaces that report a state tell it; an `slcan` adapter has no message for it: there the device is only silent."
)

_READINGS = {
    "position": {
        "error": (
            0,
            (
                "The encoder's cable or USB adapter is unplugged, it lost its supply, or its frames fail the "
                "checksum or carry its error bit (reading head too far from the scale, dirt on the scale)."
            ),
            "read the encoder's own message; look at the head's lamp and the adapter in `ls /dev/serial/by-id`",
            "plug the cable in again or power the encoder; clean the scale and set the head's gap",
        ),
        "stale": (
            1,
            "The encoder sends nothing or more slowly than its profile says; its cable is loose; or this machine was too late to read it.",
            "the device's message says whether it is gone, silent or slow; `thermoctl status` names a slow reading with its rate",
            "reseat the cable; set the encoder's output rate; where ticks were late see docs/how-to/real-time.md",
        ),
        "range": (
            2,
            "The stage was pushed beyond its travel, the encoder lost its zero, or scale or offset of its profile is wrong.",
            "move the stage by hand between its stops and compare the reading with a ruler or an indicator",
            "home the encoder again; correct `scale` and `offset`; set protection.low and high to the real travel",
        ),
        "rate": (
            3,
            "The encoder skipped counts (dirt, loose head), a frame was misread without a checksum, or the stage was hit.",
            "look at the capture of the fault on the dashboard: one tick of jump is a misread, a slope is a motion",
            "fasten head and scale; use a frame with a checksum; set protection.rate above the fastest real motion",
        ),
        "frozen": (
            4,
            (
                "The encoder's electronics hang and repeat the last value, or its resolution is so coarse that "
                "a stage at rest gives the same digits."
            ),
            "move the stage by hand and watch the reading in `thermoctl monitor`",
            "cycle the encoder's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "monitored": {
        "error": (
            5,
            "An open thermocouple or an unplugged module among the eleven watched points, or the reference encoder is gone.",
            "read the named channel's own message; measure the sensor's resistance at the module's terminals",
            "replace the sensor or plug it in; remove the role from the configuration where it is not fitted",
        ),
        "stale": (
            6,
            "The module answers too slowly or not at all, or the reference encoder stopped sending.",
            "the device's message says whether it is gone, silent or slow; `thermoctl status` names a slow reading with its rate",
            "reseat the cable; lower the number of registers polled, or raise stale_s to the module's real rate",
        ),
        "range": (
            7,
            "A watched sensor is of another type than its module is set to, or scale or offset of its profile is wrong.",
            "compare the named reading with a second thermometer, or with the air while the rig is cold",
            "set the sensor's type in the module; correct `scale`, `offset` and protection.low and high",
        ),
        "rate": (
            8,
            "A loose terminal or interference makes the named reading jump.",
            "look at the capture of the fault: single jumps are a loose contact, a burst is interference",
            "fasten the terminal; ground the shield at one end; set protection.rate above the real rate",
        ),
        "frozen": (
            9,
            "The module repeats its last conversion, or its resolution is coarse and the point is at rest.",
            "warm the point with a finger and watch the reading",
            "cycle the module's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "voltage": {
        "error": (
            10,
            "The voltage meter is unplugged, without supply, or answers with an exception.",
            "read the meter's own message: an exception names the register, a timeout the line",
            "plug the line in, power the meter; correct its address, baud rate or register in the profile",
        ),
        "stale": (
            11,
            "The meter answers more slowly than the limit, or another device on the line keeps it busy.",
            "the device's message says whether it is gone, silent or slow; `thermoctl status` names a slow reading with its rate",
            "raise the baud rate or poll fewer registers; else raise stale_s to the meter's real rate",
        ),
        "range": (
            12,
            "The amplifier drives more than protection.high allows, or the meter's scale (mV, V) is wrong.",
            "compare with a hand-held voltmeter at the coil's terminals",
            "correct `scale` in the profile; set protection.low and high beyond the amplifier's supply",
        ),
        "rate": (
            13,
            "A loose sense lead, or interference of the amplifier's switching.",
            "look at the capture of the fault: does the current jump in the same tick?",
            "fasten the sense leads, twist them; set protection.rate above the amplifier's real slope",
        ),
        "frozen": (
            14,
            "The meter repeats its last conversion.",
            "move the stage and watch the reading: it has to follow the current",
            "cycle the meter's supply; where it is slow by design, lengthen protection.frozen_s",
        ),
    },
    "current": {
        "error": (
            15,
            "The current sensor is unplugged, without supply, or answers with an exception; where the drive measures it, the drive is gone.",
            "read the device's own message. " + _BUS_OFF,
            "plug the line in and power the device; on bus-off correct bitrate and termination",
        ),
        "stale": (
            16,
            "The sensor sends more slowly than the limit, or its frames are lost on a busy bus.",
            "the device's message says whether it is gone, silent or slow; `thermoctl status` names a slow reading with its rate",
            "set the sender's cycle time; else raise stale_s to its real rate",
        ),
        "range": (
            17,
            "The coil takes more than protection.high allows (short, wrong gain), or the sensor's scale (mA, A) is wrong.",
            "compare with a clamp meter on the coil's lead",
            "correct `scale` in the profile; check the coil for a short; set protection.low and high",
        ),
        "rate": (
            18,
            "A loose lead of the shunt, or interference of the amplifier's switching.",
            "look at the capture of the fault: does the drive ask for the same jump?",
            "fasten the leads; set protection.rate above the amplifier's real slope",
        ),
        "frozen": (
            19,
            "The sensor repeats its last conversion.",
            "move the stage and watch the reading: it has to follow the drive",
            "cycle its supply; where it is slow by design, lengthen protection.frozen_s",
        ),
    },
    "air": {
        "error": (
            20,
            "The air sensor is open or unplugged, or its module is gone.",
            "read the sensor's own message; measure its resistance at the terminals (Pt100: about 108 ohm at 20 degC)",
            "replace or reconnect the sensor; where none is fitted, remove air_c from protection.required",
        ),
        "stale": (
            21,
            "The module answers too slowly or not at all.",
            "the device's message says whether it is gone, silent or slow; `thermoctl status` names a slow reading with its rate",
            "reseat the line; else raise stale_s to the module's real rate",
        ),
        "range": (
            22,
            "The sensor is of another type than the module is set to, or the chamber really is beyond the limits.",
            "compare with a second thermometer beside it",
            "set the sensor's type in the module; set protection.low and high to the chamber",
        ),
        "rate": (
            23,
            "A loose terminal, interference, or a draught over a bare sensor.",
            "look at the capture of the fault: a single jump is a loose contact",
            "fasten the terminal; shield the sensor from draughts; set protection.rate above the chamber's real rate",
        ),
        "frozen": (
            24,
            "The module repeats its last conversion, or the chamber is steadier than one digit.",
            "warm the sensor with a finger and watch the reading",
            "cycle the module's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "coil": {
        "error": (
            25,
            "The coil's thermocouple is open or unplugged, or its module is gone.",
            "read the sensor's own message; measure its resistance at the module's terminals (a few ohm, not open)",
            "replace or reconnect the thermocouple; check the module's supply and network",
        ),
        "stale": (
            26,
            "The thermocouple module answers too slowly or not at all.",
            "the device's message says whether it is gone, silent or slow; `thermoctl status` names a slow reading with its rate",
            "reseat the line; poll fewer registers; else raise stale_s to the module's real rate",
        ),
        "range": (
            27,
            "The module is set to another type of thermocouple, its polarity is reversed, or the scale is wrong.",
            "compare with the air while the rig is cold: both must agree",
            "set the type in the module; swap the leads; correct `scale` and `offset`",
        ),
        "rate": (
            28,
            "A loose terminal or interference makes the coil's reading jump.",
            "look at the capture of the fault: single jumps are a loose contact, a burst is interference",
            "fasten the terminal; ground the shield at one end; set protection.rate above the coil's real rate",
        ),
        "frozen": (
            29,
            "The module repeats its last conversion.",
            "let the stage move for a minute and watch the reading: the coil has to warm up",
            "cycle the module's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "amplifier": {
        "error": (
            30,
            "The drive lost its supply, restarted, stopped sending its heartbeat, or the bus is gone.",
            "read the drive's own message; look at its lamps. " + _BUS_OFF,
            "power the drive and check both ends of the bus; on bus-off correct bitrate and termination",
        ),
        "stale": (
            31,
            (
                "The drive does not answer to SYNC: it left `operational`, its PDO is mapped differently, or "
                "this machine was too late to send SYNC."
            ),
            "look at the drive's NMT state lamp; compare `transmit` of its profile with the drive's TPDO 1",
            "restart the drive; correct the mapping; where ticks were late see docs/how-to/real-time.md",
        ),
        "range": (
            32,
            "A value that the drive reports (supply voltage, state) is outside protection.low..high.",
            "measure the drive's supply with a voltmeter",
            "correct the supply, `scale` in the profile, or protection.low and high",
        ),
        "rate": (
            33,
            "A value that the drive reports jumped: usually its supply at switching on.",
            "look at the capture of the fault: which of the drive's values jumped?",
            "check the supply's connection; remove the limit of protection.rate where the jump is normal",
        ),
    },
}
"""Group of channels -> kind of fault -> bit, cause, check, cure."""

READING_BITS = {
    group: tuple(kinds.get(kind, kinds["stale"])[0] for kind in KINDS) for group, kinds in _READINGS.items()
}
"""Group of channels -> the bits of its readings' faults, in the order of KINDS.

Only the amplifier has no `frozen`: when it repeats an old answer it gives no new one, which is `stale`.
"""

_ROWS = (
    *(
        Fault(bit, f"{g}_{kind}", "fault", f"{GROUPS[g]}: {_KINDS[kind]}", cause, check, cure, g, kind)
        for g, kinds in _READINGS.items()
        for kind, (bit, cause, check, cure) in kinds.items()
    ),
    Fault(
        34,
        "amplifier_stopped",
        "fault",
        "the amplifier stopped driving without a command: quick stop, or switched off",
        "A stop button, limit switch or enable input opened, or the drive lost its supply: it left `operation enabled`.",
        "read the drive's own message: it names the state that the drive went to; look at its stop and enable inputs",
        "release the input or restore the supply; then `thermoctl disarm` and `thermoctl arm`",
    ),
    Fault(
        35,
        "following_error",
        "fault",
        "the compensated position stayed away from the reference for longer than allowed",
        "The stage is blocked, the amplifier stands at its limit or does not drive, the controller is badly tuned, or the machine was late.",
        "move the stage by hand with the amplifier off; look at `drive` and at slips in the capture of the fault",
        "free the stage; `thermoctl tune`; else widen protection.following_um; for late ticks docs/how-to/real-time.md",
    ),
    Fault(
        36,
        "coil_overtemperature",
        "critical",
        "the measured coil temperature is above protection.coil_limit_c",
        "The motion takes more power than the coil can lose, the stage is blocked, or the sensor reads too high.",
        "look at power and coil temperature in the history of the last hour",
        "let it cool; reduce the motion's duty; fasten the coil's sensor",
    ),
    Fault(
        37,
        "coil_overtemperature_model",
        "critical",
        "the estimated coil temperature is above protection.coil_limit_c",
        "The model computes a hot coil from the power: too much power, a wrong power reading or a model of another rig.",
        "compare the measured coil with the estimate: if the measured one is cold, the power reading or the model is wrong",
        "let it cool; correct voltage and current scale; calibrate the model again",
    ),
    Fault(
        38,
        "coil_heating_rate",
        "critical",
        "the measured coil temperature rises faster than protection.coil_rate_k_s",
        "A stalled stage or a shorted coil takes far more power than motion does.",
        "look at current and position in the capture of the fault; measure the coil's resistance when cold",
        "free the stage; replace the coil; lower the amplifier's current limit",
    ),
    Fault(
        39,
        "coil_disagrees",
        "fault",
        "measured coil temperature and the model stay apart: drifted, swapped or frozen sensor",
        "The coil's sensor drifted, came loose, hangs or is swapped, or the model is of another rig.",
        "compare all points with the air while the rig is cold; warm the coil alone and see which point follows",
        "fasten or replace the sensor; correct the order of the channels; calibrate again where the rig was changed",
    ),
    Fault(
        40,
        "power_limit",
        "critical",
        "the mean electrical power of the coil is above protection.power_limit_w",
        "The motion's duty is too high, or the stage is blocked.",
        "look at power and position in the history",
        "reduce the motion's duty; free the stage; set protection.power_limit_w to what the coil may lose",
    ),
    Fault(
        41,
        "coil_stuck_on",
        "critical",
        "the coil carries current or takes power although the amplifier is disabled",
        "The amplifier's output stage or its enable line is defective, or another master drives it.",
        "measure the coil's current with the amplifier disabled",
        "cut the amplifier's supply now; replace the output stage; remove the second master",
    ),
    Fault(
        42,
        "compensation_bound",
        "fault",
        "the estimated thermal error is beyond compensation.bound_um",
        "The coil's sensor, the power reading or the model is wrong, so that the estimate left its plausible range.",
        "compare the measured and the estimated temperatures on the dashboard",
        "correct the sensor or the model before widening compensation.bound_um",
    ),
    Fault(
        43,
        "compensation_slewing",
        "warning",
        "the compensation lags its estimate because of compensation.slew_um_s",
        "The compensation catches up after a fault that has cleared, or the estimate jumps with the coil's sensor.",
        "look at the innovation: single large values are a bad sensor",
        "wait some seconds after a fault; else fasten the coil's sensor, or raise compensation.slew_um_s",
    ),
    Fault(
        44,
        "drive_saturated",
        "fault",
        "the controller's output stood at its limit for longer than protection.saturation_s",
        "The stage is blocked, the amplifier has no supply, or the setpoint is out of reach.",
        "compare current and drive: without current the amplifier is not powered, with current the stage is blocked",
        "power the amplifier; free the stage; bring the setpoint inside the travel",
    ),
    Fault(
        45,
        "amplifier_fault",
        "critical",
        "the amplifier reports a fault of its own",
        "The drive detected a fault of its own and switched off; its error code says which.",
        "read the code and its text beside this fault, then the same code in the drive's manual",
        "clear the cause, then `thermoctl disarm` acknowledges it and resets the drive",
    ),
    Fault(
        46,
        "amplifier_not_following",
        "fault",
        (
            "the amplifier does not follow its commands: it was not enabled in time after arming, drives "
            "while disabled, or the coil's current is not the one asked for"
        ),
        "The drive has no supply or its enable input is off, a limit switch or stop button stopped it, or a lead of the coil is broken.",
        "compare amplifier state, current and drive in `thermoctl status`; look at the drive's enable and limit inputs",
        "close the enable or limit input; check the drive's supply, heartbeat and the coil's leads",
    ),
    Fault(
        47,
        "loop_late",
        "fault",
        "the loop did not run for longer than protection.late_s (starved, stopped or suspended)",
        "Another program took the processor, the machine swapped or was suspended, or a virtual machine was paused.",
        "`thermoctl latency` shows the histogram; after `thermoctl stop`, `thermoctl doctor` shows which settings of the machine cause it",
        "follow docs/how-to/real-time.md; stop the programs that take the loop's processor",
    ),
    Fault(
        48,
        "amplifier_write",
        "critical",
        "a command could not be handed to the amplifier",
        "The bus to the amplifier is gone or takes no frames. " + _BUS_OFF,
        "read the drive's own message; look at the adapter's and the drive's lamps",
        "repair the bus; see that the drive's own watchdog disabled it",
    ),
    Fault(
        49,
        "not_finite",
        "critical",
        "a number in the law was not finite: the last gate before the amplifier closed",
        "A defect of the model file or of the program: a number of the law was infinite or not a number.",
        "`thermoctl replay` of the recording shows the first tick that differs",
        "keep the recording and report it; go on with the previous model",
    ),
    Fault(
        50,
        "electrical_disagrees",
        "fault",
        "coil voltage and current do not fit its resistance: one of the sensors or the coil's lead is bad",
        "A sensor of coil voltage or current drifted, hangs, is open or swapped, or a lead of the coil is broken or shorted.",
        "measure voltage and current with a second instrument; measure the coil's resistance when cold",
        "repair the leads; correct the sensor's scale; set protection.resistance_ohm to the measured value at 20 degC",
    ),
    Fault(
        51,
        "position_disagrees",
        "fault",
        "the position is not where the coil's current holds the stage: the encoder is wrong, or the stage is blocked",
        "The encoder drifted, hangs, lost its zero or counts backwards, or the stage is blocked.",
        "move the stage by hand and watch the encoder; compare with protection.flexure_um_per_a times the current",
        "home the encoder again; free the stage; correct protection.flexure_um_per_a",
    ),
    Fault(
        52,
        "monitored_disagrees",
        "warning",
        "the output reference or a temperature that is only watched stays away from its estimate",
        "A watched temperature sensor or the reference encoder drifted or is swapped, or the model is of another rig.",
        "let the rig rest until it is cold: all points must show the air's temperature",
        "correct the order of the sensors; replace the one that is off; calibrate again",
    ),
    Fault(
        53,
        "other_axis",
        "fault",
        "another axis of this rig is in FAULT",
        "The other axis tripped; protection.on_other_axis_fault: disarm then disarms this one, too.",
        "`thermoctl status` without --axis shows every axis, and which one is in FAULT",
        "repair the cause on that axis; `thermoctl disarm` acknowledges all axes",
    ),
)

FAULTS = tuple(sorted(_ROWS, key=lambda f: f.bit))
"""The table, ordered by bit."""

BIT = {f.name: f.bit for f in FAULTS}
BY_NAME = {f.name: f for f in FAULTS}
NAMES = {f.bit: f.name for f in FAULTS}
"""Bit -> name, as a recording stores it."""

READING_BIT = bytes(
    bit for group in (*(c.group for c in FIXED), "coil", "monitored") for bit in READING_BITS[group]
)
"""Fault bit of each channel and kind, for the compiled law: index = channel * len(KINDS) + kind.

The channels that every rig has, then the coil, then any other point."""


def mask(*severities: str, readings: bool = True) -> int:
    """Return the bits of all faults of these severities; without readings' faults if not `readings`."""
    return sum(1 << f.bit for f in FAULTS if f.severity in severities and (readings or not f.group))


def decode(bits: float) -> tuple[Fault, ...]:
    """Return the faults whose bits are set in a word of fault bits (a whole number, as float or int)."""
    number = int(bits)
    return tuple(f for f in FAULTS if number >> f.bit & 1)
