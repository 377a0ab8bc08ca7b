"""The fault scenarios as data: what is injected at the wire, and what must happen behind it.

`within_s` is the longest time from the injection until the coil is no longer driven. It is made of times that the rig files
configure (rigs.py) and of SLACK_S, which covers the ways there and back: the adapter, two ticks, the coil's own decay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tests.scenarios.canbus import SHORT_CIRCUIT, WARM
from tests.scenarios.rigs import (
    DRIVE_FROZEN_S,
    DRIVE_STALE_S,
    METER_FROZEN_S,
    METER_HZ,
    METER_STALE_S,
    POSITION_FROZEN_S,
    POSITION_STALE_S,
    TC_HZ,
    TC_STALE_S,
    WATCHDOG_S,
)

SLACK_S = 0.15
AGREE_S, SATURATION_S, FOLLOWING_S, SUPERVISOR_S = (
    0.5,
    0.5,
    0.05,
    1.0,
)  # protection's defaults; supervisor.STALL_S
METER_S, TC_S = 1.0 / METER_HZ, 1.0 / TC_HZ

TRIPS, RIDES, WARNS, SAYS = "coil off", "rides through", "warning, rides through", "said"


@dataclass(frozen=True)
class Scenario:
    """`steps`: for bench's `inject`. expect: TRIPS (the coil off within_s, and it stays off through mending), RIDES or WARNS
    (driven without a pause for `watch_s`), SAYS (`words` stand in what `command` prints; nothing is driven).
    faults: one of them is shown. setpoint_um: where the stage is held; then_um: where it is asked to go after the
    injection. kill: ('loop' or 'supervisor', signal). `bad`: the bug of the review that it stands for."""

    name: str
    rig: str
    steps: tuple[Any, ...] = ()
    expect: str = TRIPS
    within_s: float = 0.0
    faults: tuple[str, ...] = ()
    setpoint_um: float = 40.0
    then_um: float | None = None
    watch_s: float = 1.0
    hold_s: float = 0.3
    kill: tuple[str, str] | None = None
    also: str = ""
    command: str = ""
    words: str = ""
    bad: str = ""
    quick: bool = False


def _call(path: str, *arguments: Any) -> tuple[Any, ...]:
    return path, list(arguments)


def _away(port: str, seconds: float) -> tuple[Any, ...]:
    return _call(f"{port}.unplug"), (f"{port}.plug", [], seconds)


_POSITION = ("position_error", "position_stale")
_COIL = ("coil_error", "coil_stale")
_METER = ("voltage_error", "voltage_stale", "current_error", "current_stale")
_AMPLIFIER = (
    "amplifier_error",
    "amplifier_stopped",
    "amplifier_stale",
    "amplifier_not_following",
    "amplifier_fault",
)
_EXTENDED = tuple(
    _call("frame", can_id, True, data)
    for can_id, data in ((0x185, "080200000000"), (0x705, "00"), (0x085, "1032010000000000"))
)

# fmt: off
GOOD = (
    Scenario("coil thermocouple open", "A", (("A.module.open", [0]),), TRIPS, 2 * TC_S + SLACK_S, ("coil_error",), quick=True),
    Scenario("thermocouple module mute", "A", (("A.tc.lose", -1),), TRIPS, TC_STALE_S + TC_S + SLACK_S, _COIL),
    Scenario("thermocouple module: garbage", "A", (("A.tc.shape", "garbage"),), TRIPS, TC_STALE_S + TC_S + SLACK_S, _COIL),
    Scenario("thermocouple module: cut answers", "A", (("A.tc.shape", "truncated"),), TRIPS, TC_STALE_S + TC_S + SLACK_S,
             _COIL),
    Scenario("thermocouple module: another unit answers", "A", (("A.tc.shape", "foreign"),), TRIPS,
             TC_STALE_S + TC_S + SLACK_S, _COIL),
    Scenario("a watched thermocouple open", "A", (("A.module.open", [1]),), WARNS, faults=("monitored_error",)),
    Scenario("meter unplugged", "A", (_call("A.meter_line.unplug"),), TRIPS, METER_STALE_S + METER_S + SLACK_S, _METER),
    Scenario("meter frozen", "A", (("A.power.frozen", True),), TRIPS, METER_FROZEN_S + METER_S + SLACK_S,
             ("voltage_frozen", "current_frozen")),
    Scenario("meter reads NaN", "A", (("A.power.nan", True),), TRIPS, 2 * METER_S + SLACK_S, _METER),
    Scenario("encoder unplugged", "A", (_call("A.line.unplug"),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION, quick=True),
    Scenario("encoder mute", "A", (("A.sensor.mute", True),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("encoder frozen", "A", (("A.sensor.frozen", True),), TRIPS, POSITION_FROZEN_S + SLACK_S,
             ("position_frozen", "position_disagrees")),
    Scenario("encoder: every checksum wrong", "A", (("A.sensor.shape", "crc"),), TRIPS, POSITION_STALE_S + SLACK_S,
             _POSITION),
    Scenario("encoder: half frames", "A", (("A.sensor.shape", "half"),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("encoder says invalid", "A", (("A.sensor.shape", "invalid"),), TRIPS, SLACK_S, _POSITION),
    Scenario("encoder jumps by 60 um", "A", (("A.sensor.offset_um", 60.0),), TRIPS, FOLLOWING_S + SLACK_S,
             ("position_rate", "following_error", "position_disagrees")),
    Scenario("encoder counts backwards", "A", (("A.sensor.sign", -1.0),), TRIPS, FOLLOWING_S + SLACK_S,
             ("position_rate", "following_error", "position_disagrees")),
    Scenario("40 bytes of garbage before each frame", "A", (("A.sensor.shape", "rubbish"),), RIDES, quick=True),
    Scenario("drive: fault with an emergency", "A", (_call("A.drive.fault", SHORT_CIRCUIT),), TRIPS, SLACK_S,
             ("amplifier_fault",), quick=True),
    Scenario("drive: warning by an emergency", "A", (_call("A.drive.emergency", WARM),), RIDES),
    Scenario("drive: its heartbeat is missing", "A", (("A.drive.heartbeat", False),), TRIPS, WATCHDOG_S + SLACK_S,
             _AMPLIFIER),
    Scenario("drive: power off", "A", (("A.drive.power", False),), TRIPS, SLACK_S, _AMPLIFIER),
    Scenario("drive restarts", "A", (_call("A.drive.restart"),), TRIPS, SLACK_S, _AMPLIFIER),
    Scenario("drive: no TPDO", "A", (("A.drive.tpdo", "missing"),), TRIPS, DRIVE_STALE_S + SLACK_S, _AMPLIFIER),
    Scenario("CAN adapter unplugged", "A", (_call("A.can.unplug"),), TRIPS, WATCHDOG_S + SLACK_S, _AMPLIFIER),
    Scenario("CAN adapter off the bus", "A", (("A.adapter.bus_off", True),), TRIPS, WATCHDOG_S + SLACK_S, _AMPLIFIER),
    Scenario("coil open", "A", (("A.drive.coil_open", True),), TRIPS, SATURATION_S + AGREE_S + METER_S + SLACK_S,
             ("amplifier_not_following", "drive_saturated", "following_error", "electrical_disagrees", "position_disagrees")),
    Scenario("supply collapses", "A", (("A.drive.supply_v", 5.0),), TRIPS, SLACK_S, ("amplifier_fault",)),
    Scenario("loop killed", "A", kill=("loop", "SIGKILL"), within_s=WATCHDOG_S + SLACK_S),
    Scenario("supervisor killed", "A", kill=("supervisor", "SIGKILL"), within_s=WATCHDOG_S + SLACK_S),
    Scenario("loop stopped", "A", kill=("loop", "SIGSTOP"), within_s=WATCHDOG_S + SLACK_S),
)

BAD = (
    Scenario("drive's stop input, a pulse of 20 ms", "A", (("A.drive.quick_stop", True, 0.02),), TRIPS, SLACK_S, _AMPLIFIER,
             hold_s=1.0, bad="B1", quick=True),
    Scenario("drive's stop input, held for 0.55 s", "A", (("A.drive.quick_stop", True, 0.55),), TRIPS, SLACK_S, _AMPLIFIER,
             hold_s=1.2, bad="B1"),
    Scenario("CAN adapter unplugged, another axis on the bus", "A", (_call("A.can.unplug"),), TRIPS, WATCHDOG_S + SLACK_S,
             _AMPLIFIER, also="B", bad="B2"),
    Scenario("one busy answer of the thermocouples", "A", (("A.tc.busy", 1),), RIDES, bad="B3"),
    Scenario("one lost answer of the thermocouples", "A", (("A.tc.lose", 1),), RIDES, bad="B3", quick=True),
    Scenario("one wrong answer of the thermocouples", "A", (("A.tc.corrupt", 1),), RIDES, bad="B3"),
    Scenario("thermocouples' connection cut once", "A", (_call("A.tc_line.drop"),), RIDES, bad="B3"),
    Scenario("thermocouples' connection gone for 0.4 s", "A", _away("A.tc_line", 0.4 * TC_STALE_S), RIDES, bad="B3"),
    Scenario("one lost answer of the meter", "A", (("A.meter.lose", 1),), RIDES, bad="B3"),
    Scenario("one wrong checksum of the meter", "A", (("A.meter.corrupt", 1),), RIDES, bad="B3"),
    Scenario("a slow answer, then a prompt one, twenty times", "A", (("A.tc.delays_s", [0.25, 0, 0], 4.0),), RIDES,
             watch_s=4.0, bad="B4"),
    Scenario("29-bit frames with the drive's numbers", "A", _EXTENDED, RIDES, bad="B8", quick=True),
)

UNNOTICED = (
    Scenario("drive's TPDO frozen", "A", (("A.drive.tpdo", "frozen"),), WARNS, faults=("amplifier_stale",),
             watch_s=DRIVE_FROZEN_S + 0.5, bad="not noticed"),
    Scenario("half the current at 20 um", "A", (("A.drive.gain", 0.5),), TRIPS, 2 * AGREE_S + METER_S + SLACK_S,
             ("amplifier_not_following",), setpoint_um=20.0, bad="not noticed"),
    Scenario("stage jammed, then asked for 20 um more", "A", (("A.plant.jam", True),), TRIPS, AGREE_S + SATURATION_S + SLACK_S,
             ("position_disagrees", "following_error", "drive_saturated"), then_um=60.0, bad="not noticed"),
    Scenario("encoder at a tenth of its rate", "A", (("A.sensor.divider", 10),), SAYS, command="status",
             words=r"position_um.*slow, (?:[5-9]\d(?:\.\d)?|1\d\d) of 1000 Hz", bad="not noticed", quick=True),
    Scenario("encoder at a tenth of its rate, doctor", "A", (("A.sensor.divider", 10),), SAYS, command="doctor",
             words=r"position_um.*slow, \d+ of 1000 Hz", bad="not noticed"),
    Scenario("meter asked for 50 Hz", "A", (), SAYS, command="doctor-50", words=r"voltage_v.*slow, [\d.]+ of 50 Hz",
             bad="not noticed"),
    Scenario("two drives with one address, doctor", "A", (_call("twin", 5),), SAYS, command="doctor",
             words=r"two devices answer as node 5", bad="not noticed"),
    Scenario("two drives with one address, while armed", "A", (_call("twin", 5),), TRIPS, SLACK_S, _AMPLIFIER,
             bad="not noticed"),
)

RIG_B = (
    Scenario("text gauge mute", "B", (("B.sensor.mute", True),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("text gauge unplugged", "B", (_call("B.line.unplug"),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("text gauge: garbage", "B", (("B.sensor.shape", "garbage"),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("text gauge: no line ends", "B", (("B.sensor.shape", "cut"),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("text gauge says an error", "B", (("B.sensor.shape", "error"),), TRIPS, POSITION_STALE_S + SLACK_S, _POSITION),
    Scenario("text gauge frozen", "B", (("B.sensor.frozen", True),), TRIPS, POSITION_FROZEN_S + SLACK_S,
             ("position_frozen",)),
    Scenario("coil thermocouple open, rig B", "B", (("B.module.open", [0]),), TRIPS, 2 * TC_S + SLACK_S, ("coil_error",)),
    Scenario("thermocouple module mute, rig B", "B", (("B.tc.lose", -1),), TRIPS, TC_STALE_S + TC_S + SLACK_S, _COIL),
    Scenario("one busy answer, rig B", "B", (("B.tc.busy", 1),), RIDES, bad="B3"),
    Scenario("a slow answer, then a prompt one, rig B", "B", (("B.tc.delays_s", [0.25, 0, 0], 4.0),), RIDES, watch_s=4.0,
             bad="B4"),
    Scenario("drive: power off, rig B", "B", (("B.drive.power", False),), TRIPS, SLACK_S, _AMPLIFIER),
    Scenario("drive's stop input held for 0.55 s, rig B", "B", (("B.drive.quick_stop", True, 0.55),), TRIPS, SLACK_S,
             _AMPLIFIER, hold_s=1.2, bad="B1"),
    Scenario("drive's stop input, rig B", "B", (("B.drive.quick_stop", True, 0.02),), TRIPS, SLACK_S, _AMPLIFIER, hold_s=1.0,
             bad="B1"),
)

SCENARIOS = GOOD + BAD + UNNOTICED + RIG_B
