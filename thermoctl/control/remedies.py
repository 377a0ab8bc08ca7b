"""What causes each fault, how to check that it is the cause, and how to cure it: the text of `status` and of docs/faults.

One row a fault. `status` shows `check; cure` below the fault; the page of the fault shows all three.
"""

from __future__ import annotations

from typing import NamedTuple


class Remedy(NamedTuple):
    """`cause`: the usual ones, most frequent first. `check`: how to see which it is. `cure`: what to do then."""

    cause: str
    check: str
    cure: str


_BUS_OFF = (
    "On CAN, `bus-off` means that the adapter left the bus after too many transmission errors: "
    "usually a wrong bitrate, a missing terminator or a short between CAN_H and CAN_L."
)

_READINGS = {
    "position": {
        "error": (
            "The encoder's cable or USB adapter is unplugged, it lost its supply, or its frames fail the checksum or "
            "carry its error bit (reading head too far from the scale, dirt on the scale).",
            "read the encoder's own message; look at the head's lamp and the adapter in `ls /dev/serial/by-id`",
            "plug the cable in again or power the encoder; clean the scale and set the head's gap",
        ),
        "stale": (
            "The encoder sends nothing or more slowly than its profile says; its cable is loose; or this machine "
            "was too late to read it.",
            "compare the rate in `thermoctl doctor` with protection.stale_s and the profile's stale_after_s",
            "reseat the cable; set the encoder's output rate; where ticks were late see docs/how-to/real-time.md",
        ),
        "range": (
            "The stage was pushed beyond its travel, the encoder lost its zero, or scale or offset of its profile is wrong.",
            "move the stage by hand between its stops and compare the reading with a ruler or an indicator",
            "home the encoder again; correct `scale` and `offset`; set protection.low and high to the real travel",
        ),
        "rate": (
            "The encoder skipped counts (dirt, loose head), a frame was misread without a checksum, or the stage was hit.",
            "look at the capture of the fault on the dashboard: one tick of jump is a misread, a slope is a motion",
            "fasten head and scale; use a frame with a checksum; set protection.rate above the fastest real motion",
        ),
        "frozen": (
            "The encoder's electronics hang and repeat the last value, or its resolution is so coarse that a stage at "
            "rest gives the same digits.",
            "move the stage by hand and watch the reading in `thermoctl monitor`",
            "cycle the encoder's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "monitored": {
        "error": (
            "An open thermocouple or an unplugged module among the eleven watched points, or the reference encoder is "
            "gone.",
            "read the named channel's own message; measure the sensor's resistance at the module's terminals",
            "replace the sensor or plug it in; remove the role from the configuration where it is not fitted",
        ),
        "stale": (
            "The module answers too slowly or not at all, or the reference encoder stopped sending.",
            "compare the rate in `thermoctl doctor` with protection.stale_s and the profile's stale_after_s",
            "reseat the cable; lower the number of registers polled, or raise stale_s to the module's real rate",
        ),
        "range": (
            "A watched sensor is of another type than its module is set to, or scale or offset of its profile is wrong.",
            "compare the named reading with a second thermometer, or with the air while the rig is cold",
            "set the sensor's type in the module; correct `scale`, `offset` and protection.low and high",
        ),
        "rate": (
            "A loose terminal or interference makes the named reading jump.",
            "look at the capture of the fault: single jumps are a loose contact, a burst is interference",
            "fasten the terminal; ground the shield at one end; set protection.rate above the real rate",
        ),
        "frozen": (
            "The module repeats its last conversion, or its resolution is coarse and the point is at rest.",
            "warm the point with a finger and watch the reading",
            "cycle the module's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "voltage": {
        "error": (
            "The voltage meter is unplugged, without supply, or answers with an exception.",
            "read the meter's own message: an exception names the register, a timeout the line",
            "plug the line in, power the meter; correct its address, baud rate or register in the profile",
        ),
        "stale": (
            "The meter answers more slowly than the limit, or another device on the line keeps it busy.",
            "compare the rate in `thermoctl doctor` with protection.stale_s and the profile's stale_after_s",
            "raise the baud rate or poll fewer registers; else raise stale_s to the meter's real rate",
        ),
        "range": (
            "The amplifier drives more than protection.high allows, or the meter's scale (mV, V) is wrong.",
            "compare with a hand-held voltmeter at the coil's terminals",
            "correct `scale` in the profile; set protection.low and high beyond the amplifier's supply",
        ),
        "rate": (
            "A loose sense lead, or interference of the amplifier's switching.",
            "look at the capture of the fault: does the current jump in the same tick?",
            "fasten the sense leads, twist them; set protection.rate above the amplifier's real slope",
        ),
        "frozen": (
            "The meter repeats its last conversion.",
            "move the stage and watch the reading: it has to follow the current",
            "cycle the meter's supply; where it is slow by design, lengthen protection.frozen_s",
        ),
    },
    "current": {
        "error": (
            "The current sensor is unplugged, without supply, or answers with an exception; where the drive measures "
            "it, the drive is gone.",
            "read the device's own message. " + _BUS_OFF,
            "plug the line in and power the device; on bus-off correct bitrate and termination",
        ),
        "stale": (
            "The sensor sends more slowly than the limit, or its frames are lost on a busy bus.",
            "compare the rate in `thermoctl doctor` with protection.stale_s and the profile's stale_after_s",
            "set the sender's cycle time; else raise stale_s to its real rate",
        ),
        "range": (
            "The coil takes more than protection.high allows (short, wrong gain), or the sensor's scale (mA, A) is wrong.",
            "compare with a clamp meter on the coil's lead",
            "correct `scale` in the profile; check the coil for a short; set protection.low and high",
        ),
        "rate": (
            "A loose lead of the shunt, or interference of the amplifier's switching.",
            "look at the capture of the fault: does the drive ask for the same jump?",
            "fasten the leads; set protection.rate above the amplifier's real slope",
        ),
        "frozen": (
            "The sensor repeats its last conversion.",
            "move the stage and watch the reading: it has to follow the drive",
            "cycle its supply; where it is slow by design, lengthen protection.frozen_s",
        ),
    },
    "air": {
        "error": (
            "The air sensor is open or unplugged, or its module is gone.",
            "read the sensor's own message; measure its resistance at the terminals (Pt100: about 108 ohm at 20 degC)",
            "replace or reconnect the sensor; where none is fitted, remove air_c from protection.required",
        ),
        "stale": (
            "The module answers too slowly or not at all.",
            "compare the rate in `thermoctl doctor` with protection.stale_s and the profile's stale_after_s",
            "reseat the line; else raise stale_s to the module's real rate",
        ),
        "range": (
            "The sensor is of another type than the module is set to, or the chamber really is beyond the limits.",
            "compare with a second thermometer beside it",
            "set the sensor's type in the module; set protection.low and high to the chamber",
        ),
        "rate": (
            "A loose terminal, interference, or a draught over a bare sensor.",
            "look at the capture of the fault: a single jump is a loose contact",
            "fasten the terminal; shield the sensor from draughts; set protection.rate above the chamber's real rate",
        ),
        "frozen": (
            "The module repeats its last conversion, or the chamber is steadier than one digit.",
            "warm the sensor with a finger and watch the reading",
            "cycle the module's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "coil": {
        "error": (
            "The coil's thermocouple is open or unplugged, or its module is gone.",
            "read the sensor's own message; measure its resistance at the module's terminals (a few ohm, not open)",
            "replace or reconnect the thermocouple; check the module's supply and network",
        ),
        "stale": (
            "The thermocouple module answers too slowly or not at all.",
            "compare the rate in `thermoctl doctor` with protection.stale_s and the profile's stale_after_s",
            "reseat the line; poll fewer registers; else raise stale_s to the module's real rate",
        ),
        "range": (
            "The module is set to another type of thermocouple, its polarity is reversed, or the scale is wrong.",
            "compare with the air while the rig is cold: both must agree",
            "set the type in the module; swap the leads; correct `scale` and `offset`",
        ),
        "rate": (
            "A loose terminal or interference makes the coil's reading jump.",
            "look at the capture of the fault: single jumps are a loose contact, a burst is interference",
            "fasten the terminal; ground the shield at one end; set protection.rate above the coil's real rate",
        ),
        "frozen": (
            "The module repeats its last conversion.",
            "let the stage move for a minute and watch the reading: the coil has to warm up",
            "cycle the module's supply; where the digits are coarse, lengthen protection.frozen_s",
        ),
    },
    "amplifier": {
        "error": (
            "The drive lost its supply, restarted, stopped sending its heartbeat, or the bus is gone.",
            "read the drive's own message; look at its lamps. " + _BUS_OFF,
            "power the drive and check both ends of the bus; on bus-off correct bitrate and termination",
        ),
        "stale": (
            "The drive does not answer to SYNC: it left `operational`, its PDO is mapped differently, or this machine "
            "was too late to send SYNC.",
            "look at the drive's NMT state lamp; compare `transmit` of its profile with the drive's TPDO 1",
            "restart the drive; correct the mapping; where ticks were late see docs/how-to/real-time.md",
        ),
        "range": (
            "A value that the drive reports (supply voltage, state) is outside protection.low..high.",
            "measure the drive's supply with a voltmeter",
            "correct the supply, `scale` in the profile, or protection.low and high",
        ),
        "rate": (
            "A value that the drive reports jumped: usually its supply at switching on.",
            "look at the capture of the fault: which of the drive's values jumped?",
            "check the supply's connection; remove the limit of protection.rate where the jump is normal",
        ),
    },
}

_OTHERS = {
    "following_error": (
        "The stage is blocked, the amplifier stands at its limit or does not drive, the controller is badly tuned, "
        "or the machine was late.",
        "move the stage by hand with the amplifier off; look at `drive` and at slips in the capture of the fault",
        "free the stage; `thermoctl tune`; else widen protection.following_um; for late ticks docs/how-to/real-time.md",
    ),
    "coil_overtemperature": (
        "The motion takes more power than the coil can lose, the stage is blocked, or the sensor reads too high.",
        "look at power and coil temperature in the history of the last hour",
        "let it cool; reduce the motion's duty; fasten the coil's sensor",
    ),
    "coil_overtemperature_model": (
        "The model computes a hot coil from the power: too much power, a wrong power reading or a model of another rig.",
        "compare the measured coil with the estimate: if the measured one is cold, the power reading or the model is wrong",
        "let it cool; correct voltage and current scale; calibrate the model again",
    ),
    "coil_heating_rate": (
        "A stalled stage or a shorted coil takes far more power than motion does.",
        "look at current and position in the capture of the fault; measure the coil's resistance when cold",
        "free the stage; replace the coil; lower the amplifier's current limit",
    ),
    "coil_disagrees": (
        "The coil's sensor drifted, came loose, hangs or is swapped, or the model is of another rig.",
        "compare all twelve points with the air while the rig is cold; warm the coil alone and see which point follows",
        "fasten or replace the sensor; correct the order of the channels; calibrate again where the rig was changed",
    ),
    "power_limit": (
        "The motion's duty is too high, or the stage is blocked.",
        "look at power and position in the history",
        "reduce the motion's duty; free the stage; set protection.power_limit_w to what the coil may lose",
    ),
    "coil_stuck_on": (
        "The amplifier's output stage or its enable line is defective, or another master drives it.",
        "measure the coil's current with the amplifier disabled",
        "cut the amplifier's supply now; replace the output stage; remove the second master",
    ),
    "compensation_bound": (
        "The coil's sensor, the power reading or the model is wrong, so that the estimate left what is believable.",
        "compare the measured and the estimated temperatures on the dashboard",
        "correct the sensor or the model before widening compensation.bound_um",
    ),
    "compensation_slewing": (
        "The compensation catches up after a fault that has cleared, or the estimate jumps with the coil's sensor.",
        "look at the innovation: single large values are a bad sensor",
        "wait some seconds after a fault; else fasten the coil's sensor, or raise compensation.slew_um_s",
    ),
    "drive_saturated": (
        "The stage is blocked, the amplifier has no supply, or the setpoint is out of reach.",
        "compare current and drive: without current the amplifier is not powered, with current the stage is blocked",
        "power the amplifier; free the stage; bring the setpoint inside the travel",
    ),
    "amplifier_fault": (
        "The drive detected a fault of its own and switched off; its error code says which.",
        "read the code and its text beside this fault, then the same code in the drive's manual",
        "clear the cause, then `thermoctl disarm` acknowledges it and resets the drive",
    ),
    "amplifier_stopped": (
        "A stop button, limit switch or enable input opened, or the drive lost its supply: it left `operation enabled`.",
        "read the drive's own message: it names the state that the drive went to; look at its stop and enable inputs",
        "release the input or restore the supply; then `thermoctl disarm` and `thermoctl arm`",
    ),
    "amplifier_not_following": (
        "The drive has no supply or its enable input is off, a limit switch or stop button stopped it, or a lead of the coil is broken.",
        "compare amplifier state, current and drive in `thermoctl status`; look at the drive's enable and limit inputs",
        "close the enable or limit input; check the drive's supply, heartbeat and the coil's leads",
    ),
    "loop_late": (
        "Another program burned the processor, the machine swapped or was suspended, or a virtual machine was paused.",
        "`thermoctl latency` shows the histogram, `thermoctl doctor` what of the machine decides it",
        "follow docs/how-to/real-time.md; stop what burns the processor beside the loop",
    ),
    "amplifier_write": (
        "The bus to the amplifier is gone or takes no frames. " + _BUS_OFF,
        "read the drive's own message; look at the adapter's and the drive's lamps",
        "repair the bus; see that the drive's own watchdog disabled it",
    ),
    "not_finite": (
        "A defect of the model file or of the program: a number of the law was infinite or not a number.",
        "`thermoctl replay` of the recording shows the first tick that differs",
        "keep the recording and report it; go on with the model before",
    ),
    "electrical_disagrees": (
        "A sensor of coil voltage or current drifted, hangs, is open or swapped, or a lead of the coil is broken or shorted.",
        "measure voltage and current with a second instrument; measure the coil's resistance when cold",
        "repair the leads; correct the sensor's scale; set protection.resistance_ohm to the measured value at 20 degC",
    ),
    "position_disagrees": (
        "The encoder drifted, hangs, lost its zero or counts backwards, or the stage is blocked.",
        "move the stage by hand and watch the encoder; compare with protection.flexure_um_per_a times the current",
        "home the encoder again; free the stage; correct protection.flexure_um_per_a",
    ),
    "monitored_disagrees": (
        "A watched temperature sensor or the reference encoder drifted or is swapped, or the model is of another rig.",
        "let the rig rest until it is cold: all twelve points must show the air's temperature",
        "correct the order of the sensors; replace the one that is off; calibrate again",
    ),
}

REMEDIES = {
    **{
        f"{group}_{kind}": Remedy(*texts)
        for group, kinds in _READINGS.items()
        for kind, texts in kinds.items()
    },
    **{name: Remedy(*texts) for name, texts in _OTHERS.items()},
}
"""By the fault's name."""
