"""What the protection and the arming machine must do, limit by limit and to the last bit of each limit.

A scenario is a function of a law module: compiled or interpreted it must hold (test_protection.py), interpreted it covers every
branch, and it must fail for every mutant of the source (`make mutants`, tests/control/mutants.py). Time steps are powers of two,
so that sums of them are exact and a limit can be met exactly: at the limit nothing trips, one bit or one tick beyond it does.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from tests.limits import OFF, channels
from thermoctl.control import arming, faults
from thermoctl.control.model import CompensatorModel, Parameters
from thermoctl.rig.channels import CHANNELS, DEFAULT, GROUPS, INDEX, TEMPERATURES
from thermoctl.rig.signals import FAULT_WORD_BITS, OUTPUT

P = 2.0**-10  # period, s
AIR = 22.0
AT = INDEX
REQUIRED = ("position_um", "voltage_v", "current_a", "air_c", "coil_c")
SCENARIOS: list[Callable[[Any], None]] = []


def scenario(function):
    SCENARIOS.append(function)
    return function


def model(gain=0.0, slow=0.0):
    """Two bodies that keep their heat, coil and bobbin; no expansion; corrections by `gain`."""
    C = np.zeros((12, 2))
    C[0, 0] = C[1, 1] = 1.0
    return CompensatorModel(
        "kalman",
        P,
        -np.eye(2) * slow,
        np.zeros((2, 2)),
        C,
        np.array([gain, 0.0]),
        0.0,
        1.0,
        0.0,
        np.zeros(12),
        np.zeros(12),
        1.0,
        air_filter_s=1.0,
    )


class Bench:
    """A law on arrays that a scenario changes."""

    def __init__(self, module, model_=None, **changes):
        required = channels(0, **dict.fromkeys(REQUIRED, 1))
        self.parameters = replace(
            Parameters(kp=0.0, ti_s=1.0, td_s=0.0, output_limit=4.0, required=required, **OFF), **changes
        )
        self.module, self.law = module, module.Law(model_ or model(), self.parameters, P)
        self.value = channels(np.nan, position_um=8.0, voltage_v=0.0, current_a=0.0, air_c=AIR, coil_c=AIR)
        self.status = np.where(np.isnan(self.value), 3, 0).astype(np.uint8)
        self.fresh = (self.status == 0).astype(np.uint8)
        self.delay = np.zeros(len(CHANNELS), dtype=np.uint8)
        self.law.bind(self.value, self.fresh, self.status, self.delay)

    def set(self, **values):
        for name, number in values.items():
            self.value[AT[name]], self.status[AT[name]], self.fresh[AT[name]] = number, 0, 1
        return self

    def say(self, status, *names):
        for name in names:
            self.status[AT[name]], self.fresh[AT[name]] = status, 0
        return self

    def silent(self, *names):
        for name in names:
            self.fresh[AT[name]] = 0
        return self

    def tick(self, count=1, command=arming.NONE, value=0.0, dt=P, external=0):
        for k in range(count):
            self.law.step(dt, command if k == 0 else arming.NONE, value, external)
        return self

    def warm(self):
        return self.tick(self.module.WARM_UP_TICKS + 3)

    def armed(self):
        self.warm().tick(command=arming.ARM)
        assert self.state == arming.ARMED and self.law.enable == 1.0 and self.law.drive == 0.0
        return self

    @property
    def state(self):
        return int(self.law.outputs[0])

    @property
    def shown(self):
        words = self.law.outputs[OUTPUT["fault_bits"]], self.law.outputs[OUTPUT["fault_bits_2"]]
        return {f.name for f in faults.decode(int(words[0]) | int(words[1]) << FAULT_WORD_BITS)}

    def safe(self, *names):
        """In FAULT with exactly these faults shown, amplifier off, controller empty."""
        assert self.state == arming.FAULT and self.shown == set(names), (self.state, self.shown)
        assert self.law.enable == 0.0 and self.law.drive == 0.0 and self.law.control_v == 0.0
        return self

    def well(self, *names):
        """ARMED and driving, with these warnings and no others."""
        assert self.state == arming.ARMED and self.shown == set(names) and self.law.enable == 1.0, (
            self.state,
            self.shown,
        )
        return self


# ---- readings ---------------------------------------------------------------------------------------------------------------
GROUP = {c.role: c.group for c in DEFAULT.table}


@scenario
def each_channel_has_its_bits(module):
    """error, stale, range of each channel in its own group's bit; required ones trip, others warn."""
    for name in CHANNELS:
        for kind, status in (("error", 2), ("stale", 1), ("range", 0)):
            bench = Bench(module, high=channels(1e3)).armed().set(**{name: 2e3})
            bench.status[AT[name]], bench.fresh[AT[name]] = status, status == 0
            bench.tick()
            (bench.safe if name in REQUIRED else bench.well)(f"{GROUP[name]}_{kind}")


@scenario
def absent(module):
    """A channel that no device has is no fault, unless it is required: then it is an error."""
    Bench(module, monitored_limit_c=4.0, innovation_time_s=P).armed().well()
    bench = Bench(module, required=channels(0, shaft_1_c=1)).warm()
    assert bench.state == arming.SAFE and bench.shown == {"monitored_error"}
    bench = Bench(module).armed().say(3, "coil_c").tick()
    bench.safe("coil_error")


@scenario
def range_to_the_bit(module):
    for name in ("position_um", "coil_c"):
        for edge, beyond in ((30.0, math.inf), (-30.0, -math.inf)):
            bench = Bench(module, low=channels(-30.0), high=channels(30.0)).armed()
            bench.set(**{name: edge}).tick().well()
            bench.set(**{name: math.nextafter(edge, beyond)}).tick().safe(f"{GROUP[name]}_range")
    for value in (math.nan, math.inf, -math.inf):
        Bench(module).armed().set(current_a=value).tick().safe("current_range")


@scenario
def rate_to_the_bit(module):
    """The first reading may be anything; then the change counts over the time since the last one, up and down."""
    for sign in (1.0, -1.0):
        bench = Bench(module, rate=channels(math.inf, position_um=1024.0)).armed()
        bench.set(position_um=8.0 + sign).tick().well()  # 1 um in one period
        bench.set(position_um=math.nextafter(8.0 + 2 * sign, sign * math.inf)).tick().safe("position_rate")
        bench = Bench(module, rate=channels(math.inf, position_um=1024.0)).armed()
        bench.silent("position_um").tick(3).well()
        bench.set(position_um=8.0 + sign * 4.0).tick().well()  # 4 um in four periods
        bench.silent("position_um").tick(3)
        bench.set(position_um=8.0 + sign * 8.25).tick().safe("position_rate")
        bench.tick().tick(command=arming.DISARM)  # the new level is believed
        assert bench.state == arming.SAFE and bench.shown == set()
    bench = Bench(
        module, rate=channels(math.inf, position_um=1024.0)
    ).armed()  # a tick without time: one period
    bench.set(position_um=9.0).tick(dt=0.0).well()
    bench.set(position_um=10.5).tick(dt=0.0).safe("position_rate")


THERMAL = ("air_c", *TEMPERATURES)


@scenario
def a_temperature_exceeds_its_rate_twice(module):
    """Twice in a row, counted from the last one believed; until then the last one stays. Other readings trip at once."""
    required = channels(0, **dict.fromkeys((*REQUIRED, "supply_v", *THERMAL), 1))
    for name in (*THERMAL, "current_a", "supply_v"):
        for sign in (1.0, -1.0):
            changes = {"rate": channels(math.inf, **{name: 10.0}), "required": required}
            bench = Bench(module, **changes).set(**dict.fromkeys(THERMAL, AIR), supply_v=24.0).armed()
            bench.set(current_a=0.0).tick(9)
            start = bench.value[AT[name]]
            if name not in THERMAL:
                bench.set(**{name: start + sign}).tick().safe(f"{GROUP[name]}_rate")
                continue
            bench.set(**{name: start + sign}).tick().well()  # 10 K/s x 0.1 s, in one period
            beyond = math.nextafter(start + 2 * sign, sign * math.inf)
            bench.set(**{name: beyond}).tick().well()
            assert bench.law.last[AT[name]] == start + sign
            bench.set(**{name: start + sign}).tick().well()  # an outlier
            bench.set(**{name: beyond}).tick().well().tick().safe(f"{GROUP[name]}_rate")
            bench.tick().tick(command=arming.DISARM)  # the new level is believed
            assert bench.state == arming.SAFE and bench.shown == set()


@scenario
def a_suspect_temperature_is_not_used(module):
    """It moves no estimate, corrects nothing, and is no reading of the same again."""
    for name, gain in (("coil_c", [[0.5], [0.0]]), ("bobbin_c", [[0.5, 0.0], [0.0, 0.5]])):
        m = replace(model(), gain=np.array(gain), sensors=(0,) if name == "coil_c" else (0, 1))
        bench = Bench(module, m, rate=channels(10.0), innovation_limit_c=2.0, innovation_time_s=P)
        bench.set(bobbin_c=AIR).armed().set(**{name: AIR + 30.0}).tick().well()
        assert list(bench.law.x) == [0.0, 0.0] and bench.law.innovation_c == 0.0
        bench.set(**{name: AIR + 0.5}).tick().well()
        assert bench.law.x[0 if name == "coil_c" else 1] == 0.25
    bench = Bench(module, rate=channels(10.0), frozen_s=channels(math.inf, coil_c=4 * P)).set(
        coil_c=AIR + 0.25
    )
    bench.tick(3).set(coil_c=AIR + 30.0).tick()
    assert bench.law.same_s[AT["coil_c"]] == 2 * P and bench.shown == set()
    bench.tick()
    assert bench.law.same_s[AT["coil_c"]] == 0.0 and bench.shown == {"coil_rate"}


@scenario
def a_rate_is_over_the_samples_own_times(module):
    """Two samples 0.25 s apart by arrival: their delays, 25 ms each, come off and on."""
    for before, late, seconds in ((0, 0, 0.25), (0, 4, 0.15), (4, 0, 0.35), (2, 2, 0.25), (0, 10, 0.1)):
        for beyond in (False, True):
            bench = Bench(module, rate=channels(math.inf, coil_c=10.0)).armed()
            bench.delay[AT["coil_c"]] = before
            bench.tick().silent("coil_c").tick(255).well()
            bench.delay[AT["coil_c"]] = late
            edge = AIR + 10.0 * seconds
            bench.set(coil_c=edge + 1e-9 if beyond else edge - 1e-9).tick().well()
            assert bench.law.suspect[AT["coil_c"]] == float(beyond), (before, late, beyond)
    bench = Bench(module, frozen_s=channels(math.inf, coil_c=4 * P)).tick(2)
    bench.delay[AT["coil_c"]] = 15  # sampled before the last one was: as if one period had passed
    bench.tick()
    assert bench.law.same_s[AT["coil_c"]] == 2 * P


@scenario
def stale_to_the_tick(module):
    bench = Bench(module, stale_s=channels(math.inf, position_um=4 * P)).armed()
    bench.silent("position_um").tick(4).well()
    bench.tick().safe("position_stale")
    bench.set(position_um=8.0).tick()
    assert bench.shown == {"position_stale"} and bench.state == arming.FAULT  # latched, the cause is gone
    bench.tick(command=arming.DISARM).tick(2).tick(command=arming.ARM).well()
    bench.silent("position_um").tick(4).well().set(position_um=8.0).tick().silent("position_um").tick(
        4
    ).well()


@scenario
def never_seen_is_stale_at_once(module):
    bench = Bench(module).silent("coil_c").tick(1)
    assert bench.shown == {"coil_stale"}
    bench.warm()
    assert bench.state == arming.SAFE and bench.shown == {"coil_stale"}
    bench.set(coil_c=AIR).tick(3)
    assert bench.state == arming.READY and bench.shown == set()


@scenario
def a_fault_stands_until_a_good_reading(module):
    bench = Bench(module, high=channels(math.inf, position_um=10.0)).armed()
    bench.set(position_um=11.0).tick().safe("position_range")
    bench.silent("position_um").tick(5, command=arming.DISARM).safe("position_range")
    bench.set(position_um=10.0).tick(command=arming.DISARM)
    assert bench.state == arming.SAFE and bench.shown == set()


@scenario
def a_reading_that_was_refused_is_not_seen(module):
    """Out of range from the first one on: then the first good one is no jump."""
    bench = Bench(module, high=channels(math.inf, coil_c=50.0), rate=channels(1.0)).set(coil_c=99.0).tick(3)
    assert bench.shown == {"coil_range"}
    bench.set(coil_c=AIR).tick()
    assert bench.shown == set()


@scenario
def frozen_to_the_tick(module):
    bench = Bench(module, frozen_s=channels(math.inf, voltage_v=4 * P)).warm()
    assert bench.state == arming.SAFE and bench.shown == {"voltage_frozen"}
    bench.set(voltage_v=0.25).tick(3).tick(command=arming.ARM).well()  # three times the same since
    bench.tick().well().tick().safe("voltage_frozen")
    bench.set(voltage_v=0.5).tick(command=arming.DISARM)
    assert bench.shown == set()
    bench.tick(3).silent("voltage_v").tick(9)
    assert bench.shown == set()  # nothing new is not the same again
    bench.set(voltage_v=0.5).tick()
    assert bench.shown == {"voltage_frozen"}  # ten periods later, still the same


@scenario
def the_first_reading_is_not_the_same_as_nothing(module):
    """Also where it is 0: frozen counts from the second on."""
    bench = Bench(module, frozen_s=channels(math.inf, voltage_v=4 * P)).tick(5)
    assert bench.shown == set()
    bench.tick()
    assert bench.shown == {"voltage_frozen"}


@scenario
def the_compensation_waits_for_what_it_needs(module):
    """Voltage, current, air or coil at fault freeze it; the position and what is only watched do not."""
    warm = replace(model(), b2=np.ones(12), C=np.eye(12, 2), expansion_period_s=P)
    for name in ("voltage_v", "current_a", "air_c", "coil_c", "position_um", "shaft_1_c"):
        bench = Bench(module, replace(warm, gain=np.array([1.0, 0.0]))).set(coil_c=AIR + 1).warm()
        assert bench.law.compensation_um == 1.0
        bench.law.x[1] = 3.0
        bench.say(2, name).tick(3)
        held = name in ("voltage_v", "current_a", "air_c", "coil_c")
        assert (bench.law.compensation_um == 1.0) == held, name
    bench = Bench(module, replace(warm, gain=np.array([1.0, 0.0]))).set(coil_c=AIR + 1).warm()
    bench.law.x[1] = 3.0
    bench.say(2, "air_c").tick(3).set(air_c=AIR).tick(3)
    assert bench.law.compensation_um != 1.0  # and goes on when it is back
    bench = (
        Bench(module, replace(warm, gain=np.array([1.0, 0.0])), required=channels(0))
        .set(coil_c=AIR + 1)
        .warm()
    )
    bench.law.x[1] = 3.0
    bench.say(2, "air_c").tick(3)
    assert bench.law.compensation_um != 1.0  # not required: used without it


@scenario
def late_to_the_bit(module):
    Bench(module, late_s=64 * P).armed().tick(dt=64 * P).well()
    Bench(module, late_s=64 * P).armed().tick(dt=math.nextafter(64 * P, 1.0)).safe("loop_late")
    Bench(module, late_s=0.5).armed().tick(dt=math.nan).well()
    Bench(module, late_s=0.5).armed().tick(dt=-1.0).well()
    bench = Bench(module, late_s=0.5).armed().tick(dt=math.inf)
    bench.safe("loop_late")


# ---- limits -----------------------------------------------------------------------------------------------------------------
@scenario
def following_to_the_tick(module):
    def away(distance, **changes):
        bench = Bench(module, following_um=2.0, following_s=4 * P, **changes).armed()
        return bench.set(position_um=8.0 + distance)

    for sign in (1.0, -1.0):
        away(sign * 2.0).tick(20).well()
        away(sign * 2.25).tick(4).well().tick().safe("following_error")
        away(sign * 4.0).tick(4).well()
        away(sign * 4.25).tick().safe("following_error")  # twice the limit: at once
    bench = away(2.25).tick(4).set(position_um=8.0).tick().set(position_um=10.25).tick(3).well()
    bench.tick(command=arming.DISARM)
    assert bench.state == arming.SAFE
    bench.tick(20)
    assert bench.shown == set() and bench.state == arming.READY  # not armed: nothing to follow
    bench.tick(command=arming.ARM).tick(3).well()


@scenario
def saturation_to_the_tick(module):
    bench = Bench(module, saturation_s=4 * P).armed()
    for v in (4.0, -4.0):
        bench.law.v = v
        bench.tick(4).well()
        assert bench.law.drive == v
        bench.law.v = math.nextafter(v, 0.0)
        bench.tick(9).well()
    bench.law.v = 4.0
    bench.tick(5).safe("drive_saturated")


@scenario
def amplifier_to_the_tick(module):
    for state in (0.0, 1.0, 4.0):  # the enable sequence after arming has this time
        bench = Bench(module, amplifier_s=4 * P).armed().set(amplifier_state=state).tick(4).well()
        bench.tick().safe("amplifier_not_following")
        bench = Bench(module, amplifier_s=4 * P).armed().set(amplifier_state=state).tick(4).well()
        bench.set(amplifier_state=2.0).tick(9).well()
    bench = Bench(module, amplifier_s=4 * P).armed().set(amplifier_state=2.0).tick(9).well()
    bench.set(amplifier_state=1.0).say(1, "amplifier_state").tick(9).well("amplifier_stale")
    bench = Bench(module, amplifier_s=4 * P).set(amplifier_state=1.0).armed().tick(4, command=arming.DISARM)
    assert bench.shown == set()
    Bench(module).armed().set(amplifier_state=3.0).tick().safe("amplifier_fault")
    Bench(module).warm().set(amplifier_state=3.0).tick().safe("amplifier_fault")
    bench = (
        Bench(module)
        .armed()
        .set(amplifier_state=3.0)
        .say(1, "amplifier_state")
        .tick()
        .well("amplifier_stale")
    )


@scenario
def an_amplifier_that_stops_by_itself(module):
    """Once enabled after arming, another state trips in the same tick; only DISARM and ARM drive again."""
    for state in (0.0, 1.0, 4.0):
        bench = Bench(module, amplifier_s=1.0, kp=1.0).set(amplifier_state=1.0).armed()
        bench.tick(3).well().set(amplifier_state=2.0).tick().well()
        bench.set(amplifier_state=state).tick().safe("amplifier_stopped")
        bench.set(amplifier_state=2.0).tick(3, command=arming.ARM).safe("amplifier_stopped")
        bench.tick(command=arming.DISARM).tick(9, command=arming.ARM)  # it drives: not READY
        assert bench.state == arming.SAFE and bench.shown == set()
        bench.set(amplifier_state=1.0).tick(2).tick(command=arming.ARM).tick(9).well()  # the sequence anew
    for state in (0.0, 1.0, 2.0, 4.0):  # told to stop: no fault
        bench = Bench(module, amplifier_s=1.0).armed().set(amplifier_state=2.0).tick(3)
        bench.tick(command=arming.DISARM).set(amplifier_state=state).tick(9)
        assert bench.shown == set() and bench.state == (arming.SAFE if state == 2.0 else arming.READY)
    bench = Bench(module).armed().set(amplifier_state=2.0).tick().set(amplifier_state=3.0).tick()
    bench.safe("amplifier_fault")
    bench = Bench(module).armed().set(amplifier_state=2.0).tick()
    bench.set(amplifier_state=1.0).say(1, "amplifier_state").tick(9).well("amplifier_stale")  # not known
    bench.set(amplifier_state=1.0).tick().safe("amplifier_stopped")
    # No reading that stands still has its bit; a supply that does is one that the amplifier no longer sends anew.
    for name, shown in (("supply_v", {"amplifier_stale"}), ("amplifier_state", set())):
        bench = Bench(module, frozen_s=channels(math.inf, **{name: 0.0})).set(**{name: 2.0}).tick(9)
        assert bench.shown == shown


@scenario
def an_amplifier_that_drives_while_disabled(module):
    bench = Bench(module, amplifier_s=4 * P).set(amplifier_state=2.0).warm()
    assert bench.state == arming.SAFE and bench.shown == {"amplifier_not_following"}
    bench.set(amplifier_state=1.0).tick(2)
    assert bench.state == arming.READY and bench.shown == set()
    bench.set(amplifier_state=2.0).tick(command=arming.ARM)
    assert bench.state == arming.SAFE and bench.shown == set()
    bench.tick(3)
    assert bench.shown == set()
    bench.tick()
    assert bench.shown == {"amplifier_not_following"}


@scenario
def nothing_integrates_against_a_drive_that_is_off(module):
    """Reference at the stage and v = 0 until it reports enabled; the setpoint given meanwhile counts."""
    bench = Bench(
        module, kp=0.125, ti_s=0.25, setpoint_rate_um_s=1024.0, setpoint_high_um=15.0, amplifier_s=1.0
    )
    bench.set(amplifier_state=1.0).armed().tick(command=arming.SETPOINT, value=20.0)
    for k in range(9):
        bench.set(position_um=8.0 + k).tick().well()
        assert (bench.law.v, bench.law.drive, bench.law.eps1, bench.law.d1) == (0.0, 0.0, 0.0, 0.0)
        assert bench.law.reference_um == 8.0 + k and bench.law.setpoint_um == 15.0
    bench.set(amplifier_state=2.0, position_um=8.0).tick().well()
    assert bench.law.reference_um == 15.0 and bench.law.v > 0.0  # from the stage, 1 um a period, downwards
    bench.tick(9)
    v = bench.law.v
    assert v != 0.0 and bench.law.reference_um == 15.0
    bench.set(amplifier_state=4.0).tick().safe("amplifier_stopped")
    bench = Bench(module, kp=0.125, ti_s=0.25).armed().set(position_um=7.0)
    bench.set(amplifier_state=1.0).say(2, "amplifier_state").tick(3)
    assert bench.law.v != 0.0  # an amplifier that reports nothing is believed to drive


@scenario
def power_without_a_voltage_meter(module):
    """R I^2 at the coil's temperature; not a number where neither voltage nor resistance is known."""

    def bench(m=None, **changes):
        b = Bench(module, m, required=channels(0), **{"resistance_ohm": 4.0, **changes})
        return b.say(3, "voltage_v")

    b = bench(replace(model(), C=np.zeros((12, 2)))).set(coil_c=120.0).armed().set(current_a=1.5).tick()
    assert (
        b.law.outputs[OUTPUT["power_w"]] == 4.0 * (1.0 + 0.00393 * 100.0) * 1.5 * 1.5
    )  # by the coil's reading
    b.set(current_a=-1.5).tick()
    assert b.law.outputs[OUTPUT["power_w"]] == 4.0 * (1.0 + 0.00393 * 100.0) * 1.5 * 1.5
    b.say(2, "current_a").tick()
    assert b.law.outputs[OUTPUT["power_w"]] == 4.0 * (1.0 + 0.00393 * 100.0) * 1.5 * 1.5  # the last good one
    b.say(2, "coil_c").set(current_a=1.5).tick()
    assert b.law.outputs[OUTPUT["power_w"]] == 9.0  # at 20 degC
    b = bench().set(air_c=20.0, coil_c=20.0).armed()
    b.law.x[0] = 100.0
    b.set(current_a=1.5).tick(2)
    assert b.law.outputs[OUTPUT["power_w"]] == 4.0 * (1.0 + 0.00393 * 100.0) * 1.5 * 1.5  # by the estimate
    b = bench().say(2, "air_c", "coil_c").tick()
    b.law.T[0] = 50.0
    b.set(current_a=1.5).tick()
    assert b.law.outputs[OUTPUT["power_w"]] == 9.0  # an estimate above no air says nothing
    b = bench(power_limit_w=8.0, power_time_s=P).set(air_c=20.0, coil_c=20.0).armed().set(current_a=1.5)
    b.tick(2).safe("power_limit")
    b = bench(resistance_ohm=0.0).armed().set(current_a=1.5).tick(2).well()
    assert math.isnan(b.law.outputs[OUTPUT["power_w"]]) and b.law.power_w == 0.0
    b = bench().say(3, "current_a").armed().tick(2).well()
    assert math.isnan(b.law.outputs[OUTPUT["power_w"]])
    b = Bench(module, required=channels(0), resistance_ohm=4.0).set(voltage_v=2.0, current_a=1.0).armed()
    assert b.law.outputs[OUTPUT["power_w"]] == 2.0  # with a meter: its own
    b.say(2, "voltage_v").set(current_a=3.0).tick()
    assert b.law.outputs[OUTPUT["power_w"]] == 2.0  # at fault: the last good one
    b = Bench(module, required=channels(0)).set(voltage_v=2.0, current_a=1.0).armed()
    assert b.law.outputs[OUTPUT["power_w"]] == 2.0


@scenario
def idle_to_the_tick(module):
    for readings, trips in (
        ({"current_a": 0.5}, False),
        ({"current_a": 0.75}, True),
        ({"current_a": -0.75}, True),
        ({"voltage_v": 4.0, "current_a": 0.5}, False),
        ({"voltage_v": 5.0, "current_a": 0.5}, True),
        ({"voltage_v": -5.0, "current_a": 0.5}, True),
    ):
        bench = (
            Bench(module, idle_current_a=0.5, idle_power_w=2.0, idle_s=4 * P).warm().set(**readings).tick(4)
        )
        assert bench.state == arming.READY and bench.shown == set()
        bench.tick()
        assert (bench.state == arming.FAULT) == trips and bench.shown == (
            {"coil_stuck_on"} if trips else set()
        )
        bench = (
            Bench(module, idle_current_a=0.5, idle_power_w=2.0, idle_s=4 * P)
            .armed()
            .set(**readings)
            .tick(20)
            .well()
        )
        bench.tick(command=arming.DISARM).tick(3)
        assert bench.shown == set()  # the time counts from disarming
        bench = (
            Bench(module, idle_current_a=0.5, idle_power_w=2.0, idle_s=4 * P).warm().set(**readings).tick(2)
        )
        bench.tick(command=arming.ARM).tick().tick(command=arming.DISARM).tick(3)
        assert bench.shown == set()
    bench = Bench(module, idle_current_a=0.5, idle_s=4 * P).warm().set(current_a=0.75).tick(3)
    bench.set(current_a=0.5).tick(4)  # counts down at a quarter
    bench.set(current_a=0.75).tick(2)
    assert bench.shown == set()
    bench.tick().safe("coil_stuck_on")
    bench.tick(20).set(current_a=0.5).tick()  # however long it was
    bench.tick(command=arming.DISARM).tick(15)
    assert bench.state == arming.READY and bench.shown == set()
    bench.set(current_a=0.75).tick(4)
    assert bench.shown == set()
    bench = Bench(module, idle_current_a=0.5, idle_s=4 * P).warm().tick(20)
    for _ in range(20):
        bench.set(current_a=0.75).tick().set(current_a=0.5).tick(4)
    assert bench.state == arming.READY and bench.shown == set()
    for _ in range(13):  # more than a fifth of the time: 1/4 of a tick stays of each round
        bench.set(current_a=0.75).tick().set(current_a=0.5).tick(3)
    assert bench.state == arming.READY and bench.shown == set()
    bench.set(current_a=0.75).tick().safe("coil_stuck_on")
    bench = Bench(
        module, required=channels(0), idle_current_a=0.5, idle_s=4 * P, high=channels(math.inf, current_a=9.0)
    ).warm()
    bench.set(current_a=10.0).tick(9)
    assert bench.shown == {"current_range"}  # a reading at fault proves nothing


@scenario
def current_from_before_disarming(module):
    """A slow meter's last reading of the drive, and one sampled before DISARM that arrives after it, prove nothing."""
    for readings in ({"current_a": 0.75}, {"voltage_v": 5.0, "current_a": 0.5}):
        bench = Bench(module, idle_current_a=0.5, idle_power_w=2.0, idle_s=4 * P).armed()
        bench.set(**readings).tick().silent("current_a").tick().tick(command=arming.DISARM).tick(20)
        assert bench.state == arming.READY and bench.shown == set()
        bench.set(**readings).tick().silent("current_a").tick(20)
        assert bench.state == arming.READY and bench.shown == set()
        bench.set(**readings).tick().silent("current_a").tick(3)
        assert bench.state == arming.READY and bench.shown == set()
        bench.tick().safe("coil_stuck_on")
        bench.set(current_a=0.0).tick().tick(command=arming.DISARM).tick()
        bench.tick(command=arming.ARM).tick(3).well()
        bench.silent("current_a").tick(command=arming.DISARM).set(**readings).tick().silent("current_a").tick(
            9
        )
        assert bench.shown == set()  # counted from the newest DISARM


@scenario
def times_count_from_arming(module):
    """What lasted for a while before DISARM does not count after the next ARM."""

    def again(bench):
        return bench.tick(3).well().tick(command=arming.DISARM).tick(2).tick(command=arming.ARM)

    again(Bench(module, amplifier_s=4 * P).armed().set(amplifier_state=1.0)).tick(4).well().tick().safe(
        "amplifier_not_following"
    )
    bench = again(Bench(module, following_um=2.5, following_s=4 * P).armed().set(position_um=11.0))
    bench.set(position_um=14.0).tick(4).well().tick().safe("following_error")
    bench = Bench(module, saturation_s=4 * P).armed()
    bench.law.v = 4.0
    again(bench)
    bench.law.v = 4.0
    bench.tick(4).well().tick().safe("drive_saturated")


@scenario
def all_at_once(module):
    """Faults add up: none hides another."""
    bench = Bench(
        module,
        following_um=1.0,
        following_s=0.0,
        saturation_s=0.0,
        amplifier_s=0.0,
        coil_limit_c=30.0,
        coil_rate_k_s=0.5,
        coil_rate_time_s=1.0,
        innovation_limit_c=2.0,
        innovation_time_s=P,
        power_limit_w=1.0,
        power_time_s=P,
        late_s=P / 2,
        bound_um=1.0,
        resistance_ohm=4.0,
        agree_time_s=P,
        current_per_drive=1.0,
        current_tolerance_a=0.5,
        flexure_um_per_a=1.0,
        position_tolerance_um=1.0,
        monitored_limit_c=2.0,
    )
    bench.set(bobbin_c=AIR)
    bench.law.configure(replace(bench.parameters, late_s=1.0))
    bench.armed()
    bench.law.configure(bench.parameters)
    bench.law.v, bench.law.x[0] = 4.0, 99.0
    bench.set(
        position_um=20.0, voltage_v=-30.0, current_a=-2.5, coil_c=40.0, bobbin_c=60.0, amplifier_fault=1.0
    ).say(2, "shaft_1_c")
    bench.tick(external=1 << faults.BIT["amplifier_write"])
    bench.safe(
        "amplifier_write",
        "following_error",
        "drive_saturated",
        "amplifier_not_following",
        "coil_overtemperature",
        "coil_overtemperature_model",
        "coil_heating_rate",
        "coil_disagrees",
        "power_limit",
        "loop_late",
        "electrical_disagrees",
        "position_disagrees",
        "monitored_disagrees",
        "monitored_error",
    )
    bench = Bench(module, amplifier_s=0.0).armed().set(amplifier_state=3.0).say(2, "shaft_1_c").tick()
    bench.safe("amplifier_fault", "amplifier_not_following", "monitored_error")
    bench = Bench(module).armed().set(amplifier_state=2.0).tick().set(amplifier_state=1.0)
    bench.say(2, "shaft_1_c").tick(external=1 << faults.BIT["amplifier_write"])
    bench.safe("amplifier_stopped", "monitored_error", "amplifier_write")
    bench = Bench(module, idle_current_a=0.5, idle_s=0.0, power_limit_w=1.0, power_time_s=P).warm()
    bench.law.x[0] = math.nan
    bench.set(voltage_v=9.0, current_a=1.0).tick(external=1 << faults.BIT["amplifier_write"])
    bench.safe("amplifier_write", "coil_stuck_on", "power_limit", "not_finite")


@scenario
def coil_to_the_bit(module):
    Bench(module, coil_limit_c=60.0).armed().set(coil_c=60.0).tick().well()
    for bench in (Bench(module, coil_limit_c=60.0).armed(), Bench(module, coil_limit_c=60.0).warm()):
        bench.set(coil_c=math.nextafter(60.0, 61.0)).tick().safe("coil_overtemperature")
    Bench(module, coil_limit_c=60.0, high=channels(100.0)).armed().set(coil_c=101.0).tick().safe("coil_range")
    bench = Bench(module, coil_limit_c=60.0).armed()
    bench.law.x[0] = 60.0 - AIR
    bench.tick().well()
    bench.law.x[0] = 60.25 - AIR
    bench.tick().safe("coil_overtemperature_model")


@scenario
def heating_rate(module):
    """A ramp of r K/s reads as r (1 - exp(-t/tau)): far below its temperature limit it trips."""
    bench = Bench(module, coil_rate_k_s=1.0, coil_rate_time_s=64 * P).armed()
    exact = (
        Bench(module, coil_rate_k_s=1.0, coil_rate_time_s=0.25).armed().set(coil_c=AIR + 0.25).tick().well()
    )
    assert exact.law.coil_rate_k_s == 1.0
    Bench(module, coil_rate_k_s=1.0, coil_rate_time_s=0.25).armed().set(coil_c=AIR + 0.28125).tick().safe(
        "coil_heating_rate"
    )
    for k in range(1, 800):
        bench.set(coil_c=AIR + k * P).tick()
    bench.well()
    assert abs(bench.law.coil_rate_k_s - 1.0) < 1e-3
    for k in range(1, 200):
        bench.set(coil_c=AIR + 800 * P + 1.25 * k * P).tick()
        if bench.state != arming.ARMED:
            break
    bench.safe("coil_heating_rate")
    assert k < 64 * math.log(5) + 5 and bench.law.coil_rate_k_s > 1.0


@scenario
def the_coil_and_the_model(module):
    """Innovation in the mean, and the reading against the model alone; up and down; not where the model says nothing."""
    for sign in (1.0, -1.0):
        bench = Bench(module, innovation_limit_c=2.0, innovation_time_s=P).armed()
        bench.set(coil_c=AIR + sign * 2.0).tick(3).well()
        bench.set(coil_c=AIR + sign * 2.25).tick().safe("coil_disagrees")
        # A filter that follows its sensor: innovations stay small, the corrections add up to the drift.
        bench = Bench(module, model(gain=0.5), innovation_limit_c=2.0, drift_limit_c=4.0).armed()
        for k in range(65):
            assert bench.state == arming.ARMED, k
            bench.set(coil_c=AIR + sign * k / 16).tick()
        assert bench.state == arming.ARMED and abs(bench.law.model_error_c - sign * 4.0) < 1e-6
        bench.set(coil_c=AIR + sign * 4.25).tick().safe("coil_disagrees")
    for row, trips in ((0, True), (1, False)):  # a model of the coil alone, of the bobbin alone
        C = np.zeros((12, 2))
        C[row, row] = 1.0
        bench = (
            Bench(module, replace(model(), C=C), innovation_limit_c=2.0, innovation_time_s=P)
            .armed()
            .set(coil_c=AIR + 9)
            .tick(2)
        )
        (bench.safe if trips else bench.well)(*["coil_disagrees"] * trips)
    mute = replace(model(), C=np.zeros((12, 2)))
    bench = (
        Bench(module, mute, innovation_limit_c=2.0, innovation_time_s=P, drift_limit_c=2.0)
        .armed()
        .set(coil_c=AIR + 9)
    )
    bench.tick(3).well()


@scenario
def power_limit(module):
    bench = (
        Bench(module, power_limit_w=8.0, power_time_s=P)
        .armed()
        .set(voltage_v=4.0, current_a=2.0)
        .tick(3)
        .well()
    )
    bench.set(voltage_v=math.nextafter(4.0, 5.0)).tick().safe("power_limit")
    bench = (
        Bench(module, power_limit_w=8.0, power_time_s=4 * P)
        .armed()
        .set(voltage_v=8.0, current_a=2.0)
        .tick(2)
        .well()
    )
    assert bench.law.outputs[OUTPUT["power_w"]] == 16.0
    bench.tick().safe("power_limit")  # 4, 7, 9.25 W in the mean


@scenario
def nothing_that_is_not_finite_is_driven(module):
    for name in ("v", "expansion_before_um", "air_c", "eps1"):
        for value in (math.nan, math.inf)[: 1 if name == "v" else 2]:  # an infinite v is clipped
            bench = Bench(module).armed()
            assert bench.law.primed == 1.0  # before, the expansion is made anew in every tick
            setattr(bench.law, name, value)
            bench.tick()
            assert bench.state == arming.FAULT and bench.law.enable == 0.0 and bench.law.drive == 0.0, name
            assert "not_finite" in bench.shown, name
    bench = Bench(module, setpoint_rate_um_s=math.inf).armed()
    bench.law.setpoint_um = math.nan
    bench.tick()
    assert "not_finite" in bench.shown and bench.law.enable == 0.0
    bench = Bench(module).armed()
    bench.law.x[0] = math.nan
    bench.tick()
    assert "not_finite" in bench.shown and bench.law.enable == 0.0
    bench = Bench(module).armed()
    bench.law.compensation_um = math.nan
    bench.set(position_um=9.0).say(1, "voltage_v").tick()
    assert "not_finite" in bench.shown and bench.law.enable == 0.0
    bench = (
        Bench(module, low=channels(-math.inf), high=channels(math.inf))
        .armed()
        .set(voltage_v=1e200, current_a=1e200)
        .tick()
    )
    assert "not_finite" in bench.shown and bench.law.enable == 0.0
    C = np.zeros((12, 2))
    C[0, 0], C[1, 1] = 1e300, 1.0
    bench = Bench(module, replace(model(), C=C)).armed()  # the coil's estimate alone overflows
    bench.law.x[0] = 1e10
    bench.silent("coil_c").tick().safe("not_finite")


@scenario
def outside_faults(module):
    for name in ("amplifier_write", "loop_late"):
        Bench(module).armed().tick(external=1 << faults.BIT[name]).safe(name)
    bench = Bench(module).warm().tick(external=1 << faults.BIT["amplifier_write"]).safe("amplifier_write")
    bench = Bench(module).warm().tick(external=1 << faults.BIT["loop_late"])
    assert bench.state == arming.SAFE
    Bench(module).armed().tick(external=1 << faults.BIT["compensation_slewing"]).well("compensation_slewing")


# ---- readings against each other --------------------------------------------------------------------------------------------
@scenario
def voltage_and_current(module):
    def bench(**changes):
        return (
            Bench(
                module,
                **{
                    "resistance_ohm": 4.0,
                    "resistance_tolerance": 0.25,
                    "resistance_v": 0.5,
                    "agree_time_s": P,
                    **changes,
                },
            )
            .set(air_c=20.0, coil_c=20.0)
            .armed()
        )

    for sign in (1.0, -1.0):
        bench().set(current_a=sign, voltage_v=sign * 4.0).tick(2).well()
        bench().set(current_a=sign, voltage_v=sign * 6.0).tick(2).well()  # 2 = 0.25 x 6 + 0.5
        bench().set(current_a=sign, voltage_v=sign * 6.25).tick().safe("electrical_disagrees")
        bench().set(current_a=sign, voltage_v=sign * 2.5).tick(2).well()  # 1.5 = 0.25 x 4 + 0.5
        bench().set(current_a=sign, voltage_v=sign * 2.25).tick().safe("electrical_disagrees")
    bench().set(current_a=1.0, voltage_v=6.0).tick(dt=2 * P).well()  # a longer tick: the reading itself
    bench(agree_time_s=4 * P).set(current_a=1.0, voltage_v=20.0).tick().safe("electrical_disagrees")
    bench(agree_time_s=4 * P, resistance_tolerance=1.0, resistance_v=3.0).set(
        current_a=0.0, voltage_v=16.0
    ).tick(9).well()
    b = (
        bench(agree_time_s=4 * P, resistance_tolerance=0.0, resistance_v=6.0)
        .set(voltage_v=8.0)
        .tick(4)
        .well()
    )  # 2, 3.5, 4.6, 5.5
    b.tick().safe("electrical_disagrees")
    bench(resistance_ohm=0.0).set(current_a=1.0, voltage_v=20.0).tick(3).well()
    bench(resistance_ohm=0.5).set(current_a=1.0, voltage_v=20.0).tick().safe("electrical_disagrees")
    b = bench().set(current_a=1.0, voltage_v=4.0).tick(9).well()  # the scale settles, it does not add up
    b.set(voltage_v=7.0).tick().safe("electrical_disagrees")
    # The coil's own temperature counts: 100 K more are 39.3 %.
    hot = Bench(module, resistance_ohm=4.0, resistance_tolerance=0.0, resistance_v=0.5, agree_time_s=P).set(
        air_c=20.0, coil_c=120.0
    )
    hot.law.x[0] = 0.0
    hot = replace_gain(module, hot).warm()
    hot.tick(command=arming.ARM).set(current_a=1.0, voltage_v=4.0 * 1.393).tick(2).well()
    hot.set(voltage_v=4.0).tick().safe("electrical_disagrees")
    b = bench(resistance_tolerance=0.0)  # the estimate's temperature, not the reading's
    b.law.x[0] = 100.0
    b.set(current_a=1.0, voltage_v=4.0 * 1.393).tick(2).well()
    b.set(voltage_v=4.0).tick().safe("electrical_disagrees")
    # A model that says nothing of the coil: its own reading counts; one at fault does not.
    C = np.zeros((12, 2))
    C[1, 1] = 1.0
    mute = (
        Bench(
            module,
            replace(model(), C=C),
            resistance_ohm=4.0,
            resistance_tolerance=0.0,
            resistance_v=0.5,
            agree_time_s=P,
            required=channels(0),
        )
        .set(air_c=20.0, coil_c=120.0)
        .armed()
    )
    mute.set(current_a=1.0, voltage_v=4.0 * 1.393).tick(2).well()
    mute.set(voltage_v=4.0).tick().safe("electrical_disagrees")
    mute = (
        Bench(
            module,
            replace(model(), C=C),
            resistance_ohm=4.0,
            resistance_tolerance=0.0,
            resistance_v=0.5,
            agree_time_s=P,
            required=channels(0),
        )
        .set(air_c=20.0)
        .say(2, "coil_c")
        .armed()
    )
    mute.set(current_a=1.0, voltage_v=9.0).tick(9).well("coil_error")  # no temperature at all: not compared
    # No comparison with a reading at fault, here of channels that need not be there.
    for name in ("voltage_v", "current_a"):
        b = bench(required=channels(0)).set(current_a=1.0, voltage_v=4.0).tick()
        b.say(2, name).set(**{"voltage_v" if name == "current_a" else "current_a": 20.0}).tick(3)
        assert "electrical_disagrees" not in b.shown
    b = Bench(
        module,
        required=channels(0),
        resistance_ohm=4.0,
        agree_time_s=P,
        resistance_tolerance=0.0,
        resistance_v=0.5,
    )
    b.law.configure(replace(b.parameters, resistance_v=0.25))
    b.say(2, "air_c", "coil_c").set(current_a=1.0, voltage_v=9.0).tick(5)
    assert b.shown == {"air_error", "coil_error"}  # no temperature: not compared
    b = bench(required=channels(0), resistance_tolerance=0.0).say(2, "coil_c")
    b.set(current_a=1.0, voltage_v=9.0).tick()
    assert b.shown == {"coil_error", "electrical_disagrees"}  # the estimate's temperature


def replace_gain(module, bench):
    """The same bench with a filter that starts on the coil's first reading."""
    other = Bench(
        module,
        model(gain=0.5),
        **{
            f: getattr(bench.parameters, f)
            for f in ("resistance_ohm", "resistance_tolerance", "resistance_v", "agree_time_s")
        },
    )
    other.value[:], other.status[:], other.fresh[:] = bench.value, bench.status, bench.fresh
    return other


@scenario
def current_and_drive(module):
    def bench(**changes):
        b = Bench(
            module, **{"current_per_drive": 0.5, "current_tolerance_a": 0.25, "agree_time_s": P, **changes}
        ).armed()
        b.law.v = 2.0
        return b.set(current_a=1.0).tick()

    for off in (0.25, -0.25):
        bench(current_tolerance_a=1.0).set(current_a=1.0 + off).tick(3).well()
        b = bench(current_tolerance_a=1.0)
        b.law.configure(replace(b.parameters, current_tolerance_a=0.25))
        b.tick(2).well().set(current_a=1.0 + off).tick(3).well().set(current_a=1.0 + 1.25 * off).tick().safe(
            "amplifier_not_following"
        )
    b = (
        Bench(module, current_per_drive=0.5, current_tolerance_a=0.25, agree_time_s=P)
        .warm()
        .set(current_a=9.0)
        .tick(3)
    )
    assert b.shown == set()  # idle: another fault's business
    b = (
        Bench(module, current_per_drive=0.5, current_tolerance_a=0.25, agree_time_s=4 * P)
        .armed()
        .set(current_a=0.5)
        .tick(2)
        .well()
    )
    b.tick().safe("amplifier_not_following")  # 0.125, 0.219, 0.289 A
    b.set(current_a=0.0).tick(command=arming.DISARM).tick(2).tick(command=arming.ARM).set(current_a=0.5).tick(
        2
    ).well()

    # A slow meter: its reading is older than its arrival, and may be any drive since the reading before the last.
    def changing(sign):
        b = bench(current_tolerance_a=1.0).tick(2)
        b.law.configure(replace(b.parameters, current_tolerance_a=0.25))
        b.tick(2).silent("current_a").law.v = 2.0 + 2.0 * sign
        return b.tick(3).well()

    for sign in (1.0, -1.0):
        b = changing(sign).set(current_a=1.0).tick().well().tick().well()
        b.tick().safe("amplifier_not_following")
        changing(sign).set(current_a=1.0 + sign).tick().well()  # the newest drive
        b = changing(sign).set(current_a=1.0 - 0.25 * sign).tick().well()
        b.set(current_a=1.0 - 0.375 * sign).tick().safe("amplifier_not_following")
    bench(current_per_drive=-0.5, current_tolerance_a=1.0).tick(4).safe("amplifier_not_following")
    bench(current_per_drive=1.0, current_tolerance_a=0.5).safe("amplifier_not_following")
    Bench(module, current_per_drive=0.0, current_tolerance_a=0.25, agree_time_s=P).armed().set(
        current_a=9.0
    ).tick(3).well()
    b = Bench(
        module, required=channels(0), current_per_drive=0.5, current_tolerance_a=0.25, agree_time_s=P
    ).armed()
    b.say(2, "current_a")
    b.value[AT["current_a"]] = 9.0
    b.tick(3).well("current_error")


@scenario
def position_and_current(module):
    def bench(**changes):
        return Bench(
            module, **{"flexure_um_per_a": 8.0, "position_tolerance_um": 4.0, "agree_time_s": P, **changes}
        ).armed()

    for sign in (1.0, -1.0):
        bench().set(position_um=8.0 + sign * 8.0, current_a=sign).tick(3).well()
        bench().set(position_um=8.0 + sign * 4.0).tick(4).well()
        b = (
            bench().set(position_um=8.0 + sign * 4.25).tick(2).well()
        )  # as far as the current may be that of 8 um
        b.tick().safe("position_disagrees")
        bench().set(current_a=sign * 0.5).tick().well()
        bench().set(current_a=sign).tick().safe("position_disagrees")
    b = bench(agree_time_s=4 * P).set(current_a=1.0).tick(2).well()  # 2, 3.5, 4.6 um
    b.tick().safe("position_disagrees")
    bench(flexure_um_per_a=0.0).set(position_um=99.0).tick(3).well()

    # A slow meter: its reading is older than its arrival, and the stage may have been anywhere since the reading before the last.
    def moving(sign):
        b = bench().tick(2).silent("current_a").set(position_um=8.0 + sign * 8.0).tick(5)
        return b.set(position_um=8.0 + sign * 16.0).tick(5).well()

    for sign in (1.0, -1.0):
        for at in (0.0, 1.0, 2.0, 2.5):  # 8, 16, 24 um, and 4 um beyond
            moving(sign).set(current_a=sign * at).tick().well()
        moving(sign).set(current_a=sign * 2.625).tick().safe("position_disagrees")
        moving(sign).set(current_a=sign * -0.5).tick().well()
        moving(sign).set(current_a=sign * -0.625).tick().safe("position_disagrees")
        b = moving(sign).set(current_a=0.0).tick().silent("current_a").tick(5).well()
        b.set(current_a=0.0).tick().well().silent("current_a").tick(5).well()  # one more interval
        b.set(current_a=0.0).tick().safe("position_disagrees")
    # The zero is where the stage stands, with the current that holds it there, until OFF is left; not later.
    b = Bench(
        module,
        flexure_um_per_a=8.0,
        position_tolerance_um=4.0,
        agree_time_s=P,
        idle_current_a=9.0,
        idle_power_w=99.0,
    )
    b.set(position_um=40.0, current_a=3.0).tick(module.WARM_UP_TICKS // 2).set(position_um=60.0).warm()
    assert b.law.position_zero_um == 60.0 - 24.0 and b.shown == set()
    b.set(position_um=65.0).tick(4)
    assert b.shown == {"position_disagrees"} and b.state == arming.SAFE
    for name in ("position_um", "current_a"):
        b = bench(required=channels(0)).say(2, name)
        b.set(**{"current_a" if name == "position_um" else "position_um": 99.0}).tick(3)
        assert b.shown == {f"{GROUP[name]}_error"}


@scenario
def watched_temperatures(module):
    def bench(**changes):
        return (
            Bench(module, **{"monitored_limit_c": 4.0, "innovation_time_s": P, **changes})
            .set(bobbin_c=AIR, shaft_1_c=AIR)
            .armed()
        )

    for sign in (1.0, -1.0):
        bench().set(bobbin_c=AIR + sign * 4.0).tick(2).well()
        bench().set(bobbin_c=AIR + sign * 4.0).tick(dt=2 * P).well()
        bench().set(bobbin_c=AIR + sign * 4.25).tick().well("monitored_disagrees")
    bench().set(shaft_1_c=AIR + 50).tick(3).well()  # of which the model says nothing
    bench(innovation_time_s=4 * P).set(bobbin_c=AIR + 8).tick(2).well().tick().well(
        "monitored_disagrees"
    )  # 2, 3.5, 4.6 K
    bench().set(bobbin_c=AIR + 8).say(2, "bobbin_c").tick(3).well("monitored_error")
    b = (
        Bench(module, required=channels(0), monitored_limit_c=4.0, innovation_time_s=P)
        .say(1, "coil_c")
        .set(bobbin_c=99.0)
        .warm()
    )
    assert b.shown == {"coil_stale"}  # before the first reading of the coil
    b = (
        bench(innovation_limit_c=99.0).set(coil_c=AIR + 9.0).tick(3).well()
    )  # the coil's own has its own limits


@scenario
def exchanged_sensors(module):
    def bench(coil, bobbin, estimates=(4.0, 0.0), **changes):
        b = (
            Bench(module, **{"order_limit_c": 2.0, "innovation_time_s": P, **changes})
            .set(bobbin_c=AIR)
            .armed()
        )
        b.law.x[0], b.law.x[1] = estimates
        return b.set(coil_c=AIR + coil, bobbin_c=AIR + bobbin).tick(2)

    bench(4.0, 0.0).well()
    bench(0.0, 4.0).well("monitored_disagrees").say(2, "shaft_1_c").tick().well(
        "monitored_disagrees", "monitored_error"
    )
    bench(0.0, 1.0).well()  # 4 x -1 = -4: at the limit
    bench(0.0, 1.25).well("monitored_disagrees")
    bench(4.0, 0.0, (0.0, 4.0)).well("monitored_disagrees")
    b = bench(0.0, 4.0)
    b.set(coil_c=AIR + 4.0, bobbin_c=AIR).tick(2).well()  # exchanged back
    b = (
        bench(0.0, 4.0).silent("coil_c").tick(3).well("monitored_disagrees")
    )  # between two readings of the coil
    b = bench(0.0, 4.0).say(2, "bobbin_c").tick(2).well("monitored_error")
    b = bench(0.0, 4.0, required=channels(0)).say(2, "coil_c").tick(2)
    assert "coil_error" in b.shown
    C = np.zeros((12, 2))
    C[0, 0] = 1.0
    b = Bench(module, replace(model(), C=C), order_limit_c=2.0, innovation_time_s=P).set(bobbin_c=AIR).armed()
    b.law.x[0] = 4.0
    b.set(bobbin_c=AIR + 9.0).tick(2).well()  # no estimate of the bobbin
    C[:, :] = 0.0
    C[1, 1] = C[3, 0] = 1.0
    b = (
        Bench(module, replace(model(), C=C), order_limit_c=2.0, innovation_time_s=P)
        .set(bobbin_c=AIR, outer_magnet_c=AIR)
        .armed()
    )
    b.law.x[0], b.law.x[1] = 4.0, 0.0
    b.set(bobbin_c=AIR + 4.0, outer_magnet_c=AIR).tick(2).well("monitored_disagrees")
    b.say(2, "bobbin_c").tick(2).well("monitored_error")  # the other one's own fault counts


@scenario
def reference_and_estimate(module):
    growing = replace(model(), b2=np.r_[np.ones(2), np.zeros(10)], expansion_period_s=P)

    def bench(**changes):
        return (
            Bench(
                module,
                changes.pop("model_", growing),
                **{"reference_tolerance_um": 4.0, "agree_time_s": P, **changes},
            )
            .set(output_reference_um=108.0)
            .armed()
        )

    for sign in (1.0, -1.0):
        bench().set(position_um=8.0 + sign * 50, output_reference_um=108.0 + sign * 50).tick(2).well()
        bench().set(output_reference_um=108.0 + sign * 4.0).tick(2).well()
        bench().set(output_reference_um=108.0 + sign * 4.0).tick(dt=2 * P).well()
        bench().set(output_reference_um=108.0 + sign * 4.25).tick().well("monitored_disagrees")
        bench().set(output_reference_um=108.0 + sign * 4.25).say(2, "shaft_1_c").tick().well(
            "monitored_disagrees", "monitored_error"
        )
        b = bench()
        b.law.x[0] = sign * 9.0
        b.tick(3).well("monitored_disagrees")  # the expansion that was estimated is not there
        b.set(output_reference_um=108.0 + sign * 9.0).tick(2).well()
    bench(agree_time_s=4 * P).set(output_reference_um=116.0).tick(2).well().tick().well("monitored_disagrees")
    bench(model_=model()).set(output_reference_um=999.0).tick(3).well()  # a model without expansion
    for say in ((2, "output_reference_um"), (2, "position_um")):
        b = bench(required=channels(0))
        b.set(output_reference_um=999.0 if say[1] == "position_um" else 108.0).say(*say).tick(3)
        assert "monitored_disagrees" not in b.shown
    b = (
        Bench(module, growing, reference_tolerance_um=4.0, agree_time_s=P)
        .set(output_reference_um=1.0)
        .tick(module.WARM_UP_TICKS // 2)
    )
    b.set(output_reference_um=50.0).warm()
    assert b.law.reference_zero_um == 42.0 and b.shown == set()


@scenario
def each_way_a_model_expands(module):
    for change in ({"b1": np.ones(12)}, {"b2": np.ones(12)}, {"b_air": 1.0}):
        b = (
            Bench(module, replace(model(), **change), reference_tolerance_um=4.0, agree_time_s=P)
            .set(output_reference_um=0.0)
            .armed()
        )
        b.set(output_reference_um=9.0).tick(2).well("monitored_disagrees")


# ---- arming -----------------------------------------------------------------------------------------------------------------
@scenario
def the_way_up(module):
    bench = Bench(module).tick(module.WARM_UP_TICKS, command=arming.ARM)
    assert bench.state == arming.OFF
    bench.tick(command=arming.ARM)
    assert bench.state == arming.SAFE
    bench.tick(command=arming.ARM)
    assert bench.state == arming.READY  # a command given earlier is not remembered
    bench.tick()
    assert bench.state == arming.READY
    bench.tick(command=arming.SETPOINT, value=99.0)
    assert bench.state == arming.READY and bench.law.setpoint_um == 8.0
    bench.tick(command=arming.ARM).well().tick(5).well()
    bench.tick(command=arming.DISARM)
    assert bench.state == arming.SAFE and bench.law.enable == 0.0


@scenario
def no_state_but_ready_arms(module):
    bench = Bench(module).armed().say(2, "coil_c").tick().safe("coil_error").set(coil_c=AIR)
    bench.tick(3, command=arming.ARM).safe("coil_error")
    bench.tick(command=arming.DISARM)
    assert bench.state == arming.SAFE and bench.shown == set()
    bench = Bench(module).warm().say(2, "coil_c").tick(command=arming.ARM)
    assert bench.state == arming.SAFE and bench.shown == {"coil_error"}  # a fault, not critical: SAFE
    bench.tick(command=arming.ARM)
    assert bench.state == arming.SAFE
    bench = Bench(module).armed().say(2, "coil_c").tick().tick(command=arming.DISARM)
    bench.safe("coil_error")  # its cause stands: not acknowledged


@scenario
def a_command_that_is_none_does_nothing(module):
    for command in (-1, -3, 4, 5, 6, 7, 8, 99, 2**31 - 1, -(2**31)):
        bench = Bench(module).tick(command=command)
        assert bench.state == arming.OFF
        bench.warm().tick(command=command)
        assert bench.state == arming.READY and bench.law.enable == 0.0
        bench.armed().tick(command=command).well()
        bench.say(2, "coil_c").tick().set(coil_c=AIR).tick(3, command=command).safe("coil_error")


@scenario
def what_led_to_the_fault_stays_shown(module):
    bench = (
        Bench(module)
        .armed()
        .say(2, "coil_c")
        .tick()
        .set(coil_c=AIR)
        .say(2, "air_c")
        .tick()
        .safe("coil_error", "air_error")
    )
    bench.set(air_c=AIR).tick(9).safe("coil_error", "air_error")
    assert bench.law.fault_bits == int(bench.law.outputs[1])
    bench.tick(command=arming.DISARM)
    assert bench.shown == set() and bench.law.latched == 0
    bench = (
        Bench(module)
        .armed()
        .say(2, "shaft_1_c", "coil_c")
        .tick()
        .set(shaft_1_c=AIR, coil_c=AIR)
        .tick()
        .safe("coil_error")
    )
    bench = (
        Bench(module)
        .armed()
        .say(2, "coil_c", "air_c")
        .tick()
        .set(coil_c=AIR, air_c=AIR)
        .tick()
        .safe("coil_error", "air_error")
    )


@scenario
def a_critical_fault_latches_from_every_state(module):
    for critical in (f.name for f in faults.FAULTS if f.severity == "critical"):
        for bench in (
            Bench(module).warm(),
            Bench(module).armed(),
            Bench(module).tick(module.WARM_UP_TICKS + 1),
        ):
            bench.tick(external=1 << faults.BIT[critical]).safe(critical).tick(3).safe(critical)
    bench = Bench(module).tick(external=1 << faults.BIT["power_limit"])
    assert bench.state == arming.OFF


@scenario
def leaving_armed_empties_the_controller(module):
    for leave in (dict(command=arming.DISARM), dict(external=1 << faults.BIT["loop_late"])):
        bench = Bench(module, kp=0.125, td_s=0.5).armed()
        bench.set(position_um=7.0).tick(3)
        assert bench.law.v != 0.0 and bench.law.eps1 != 0.0
        drive = bench.law.drive
        assert drive == bench.law.v and abs(drive) <= 4.0
        bench.set(position_um=7.5).tick(**leave)
        assert (bench.law.v, bench.law.eps1, bench.law.d1, bench.law.drive, bench.law.control_v) == (
            0.0,
            0.0,
            0.0,
            0.0,
            0.0,
        )


@scenario
def outputs_say_what_is(module):
    growing = replace(model(0.5), b2=np.ones(12), expansion_period_s=P)
    bench = Bench(module, growing, kp=0.125, slew_um_s=1.0).set(bobbin_c=AIR).armed()
    bench.set(position_um=7.0, voltage_v=3.0, current_a=0.5, coil_c=AIR + 2, air_c=AIR + 1).tick(
        2, command=arming.SETPOINT, value=20.0
    )
    bench.silent("position_um", "coil_c").tick(2)
    law, out = bench.law, dict(zip(module.OUTPUTS, bench.law.outputs, strict=False))
    for name in (
        "setpoint_um",
        "reference_um",
        "position_um",
        "compensated_um",
        "compensation_um",
        "expansion_um",
        "control_v",
        "drive",
        "enable",
        "power_w",
        "air_rate_k_s",
        "innovation_c",
        "kalman_gain",
    ):
        assert out[name] == getattr(law, name), name
    assert all(
        out[n] != 0.0
        for n in (
            "compensation_um",
            "expansion_um",
            "air_rate_k_s",
            "innovation_c",
            "position_age_s",
            "coil_age_s",
        )
    )
    assert (
        out["state"] == arming.ARMED
        and out["fault_bits"] == 1 << faults.BIT["compensation_slewing"]
        and out["power_w"] == 1.5
    )
    assert out["position_age_s"] == law.age[0] and out["coil_age_s"] == law.age[AT["coil_c"]]
    assert list(bench.law.outputs[len(module.OUTPUTS) :]) == [law.T[m] + law.air_c for m in range(12)]
    law.v = 9.0
    law.protect(arming.NONE, 0)
    assert law.drive == 4.0 and law.control_v == 9.0
    law.v = -9.0
    law.protect(arming.NONE, 0)
    assert law.drive == -4.0


@scenario
def the_second_word_holds_the_later_bits(module):
    """Faults from bit 53 on are shown in the second word, and only there; no table names bits 54 and 60 yet."""
    bench = Bench(module).armed().tick(external=1 << 60 | 1 << 54 | 1 << faults.BIT["compensation_slewing"])
    words = OUTPUT["fault_bits"], OUTPUT["fault_bits_2"]
    assert [bench.law.outputs[w] for w in words] == [1 << faults.BIT["compensation_slewing"], 1 << 7 | 1 << 1]
    assert [bench.tick().law.outputs[w] for w in words] == [0, 0]


# ---- the table --------------------------------------------------------------------------------------------------------------
@scenario
def the_state_machine(module):
    """next_state against its table, written out: (state, command, tripped, critical) once started."""
    next_state = module.arming.next_state
    OFF, SAFE, READY, ARMED, FAULT = range(5)
    for state in range(5):
        for command in range(4):
            for tripped, critical in itertools.product((False, True), repeat=2):
                assert next_state(state, command, False, tripped, critical) == OFF
                if state == OFF:
                    expected = SAFE
                elif critical:
                    expected = FAULT
                elif state == ARMED:
                    expected = FAULT if tripped else SAFE if command == arming.DISARM else ARMED
                elif state == FAULT:
                    expected = SAFE if command == arming.DISARM and not tripped else FAULT
                elif tripped:
                    expected = SAFE
                else:
                    expected = ARMED if state == READY and command == arming.ARM else READY
                assert next_state(state, command, True, tripped, critical) == expected
    assert (module.arming.STATES[ARMED], module.arming.STATES[FAULT]) == ("ARMED", "FAULT")
    assert module.arming.COMMANDS == ("none", "arm", "disarm", "setpoint") and len(module.arming.STATES) == 5


@scenario
def the_fault_table(module):
    table = module.faults
    assert [f.bit for f in table.FAULTS] == list(range(len(table.FAULTS)))  # no bit twice, none left out
    assert table.FAULTS[0].name == "position_error" and len({f.name for f in table.FAULTS}) == len(
        table.FAULTS
    )
    assert all(
        f.meaning and f.remedy and f.severity in ("warning", "fault", "critical") for f in table.FAULTS
    )
    assert [table.FAULTS[5 * g + k].name for g in range(7) for k in range(5)] == [
        f"{g}_{k}" for g in GROUPS for k in table.KINDS
    ][:-1] + ["amplifier_stopped"]
    severity = {f.name: f.severity for f in table.FAULTS}
    assert table.mask("critical") == sum(1 << table.BIT[n] for n, s in severity.items() if s == "critical")
    assert (
        table.mask("critical", "warning") == table.mask("critical") + table.mask("warning")
        and table.mask() == 0
    )
    assert [f.name for f in table.decode(5.0)] == ["position_error", "position_range"] and table.decode(
        0
    ) == ()
    assert (
        table.decode(float(2**52))[0].bit == 52 and table.BY_NAME["not_finite"].bit == table.BIT["not_finite"]
    )
    assert {f.bit: f.name for f in table.FAULTS} == table.NAMES and table.NAMES[34] == "amplifier_stopped"
    groups = [0, 1, 2, 3, 6, 6, 6, 4, 5, 1]
    same = [*(5 * g + k for g in groups for k in range(5))]
    assert [31 if bit == 34 else bit for bit in same] == list(
        table.READING_BIT
    )  # a frozen amplifier is stale
    assert table.mask("fault", "critical", readings=False) == (table.mask("fault", "critical") >> 34 << 34)
    assert (CHANNELS[8:], TEMPERATURES[0], len(CHANNELS)) == (TEMPERATURES, "coil_c", 20)


def by_resistance(module, model_=None, current=0.5, coil_c=60.0, **changes):
    """A rig with voltage, current and resistance_ohm, and no thermometer at the coil."""
    required = channels(0, position_um=1, voltage_v=1, current_a=1, air_c=1)
    settings = {"resistance_ohm": 4.0, "resistance_current_a": 0.125, "required": required, **changes}
    bench = Bench(module, model_, **settings).say(3, "coil_c")
    return bench.set(current_a=current, voltage_v=4.0 * (1.0 + 0.00393 * (coil_c - 20.0)) * current)


@scenario
def the_coils_resistance_is_its_thermometer(module):
    """R = V I / I^2 gives the reading once a second; a small current, or a missing meter, gives none."""
    second = round(1.0 / P)
    b = by_resistance(module, model(1.0), coil_limit_c=80.0).tick(3 * second)
    assert b.law.verdict[AT["coil_c"]] == 0.0 and abs(b.law.last[AT["coil_c"]] - 60.0) < 0.5
    assert (
        abs(b.law.T[0] + AIR - 60.0) < 0.5 and b.law.age[AT["coil_c"]] < 1.5 and not b.shown & {"coil_stale"}
    )
    b.set(voltage_v=4.0 * (1.0 + 0.00393 * 70.0) * 0.5).tick(8 * second)  # 90 degC
    assert "coil_overtemperature" in b.shown
    idle = by_resistance(module, model(1.0), current=0.0625).tick(3 * second)
    assert idle.law.verdict[AT["coil_c"]] == 1.0 and idle.law.T[0] == 0.0 and not idle.shown
    b = by_resistance(module, model(1.0)).tick(3 * second).set(current_a=0.0, voltage_v=0.0).tick(8 * second)
    assert b.law.verdict[AT["coil_c"]] == 0.0
    assert b.tick(8 * second).law.verdict[AT["coil_c"]] == 1.0 and not b.shown  # too long ago
    for role in ("voltage_v", "current_a"):
        lost = by_resistance(module, model(1.0), required=channels(0)).say(3, role).tick(3 * second)
        assert lost.law.verdict[AT["coil_c"]] == 1.0 and not lost.law.by_resistance
        lost = by_resistance(module, model(1.0), required=channels(0)).say(2, role).tick(3 * second)
        assert lost.law.verdict[AT["coil_c"]] == 1.0 and lost.law.by_resistance
    unknown = by_resistance(module, model(1.0), resistance_ohm=0.0).tick(3 * second)
    assert unknown.law.verdict[AT["coil_c"]] == 1.0
    b = by_resistance(module, required=channels(0, coil_c=1)).tick(3 * second)
    assert (
        "coil_error" in b.shown and not b.law.by_resistance
    )  # who requires a thermometer gets none by resistance


@scenario
def a_drive_in_position_mode_gets_a_shifted_target(module):
    """The target is reference less compensation, without a jump when armed; off is off."""
    growing = replace(model(), b2=np.ones(12), expansion_period_s=P)
    settings = {"position_mode": 1.0, "output_limit": 30.0, "slew_um_s": 1e6, "setpoint_rate_um_s": 8.0 / P}
    b = Bench(module, growing, **settings).warm()
    assert b.law.drive == 0.0 and b.law.enable == 0.0
    b.tick(command=arming.ARM)
    assert b.state == arming.ARMED and b.law.drive == 8.0  # where the stage is
    b.tick().well()
    assert b.law.drive == 8.0
    b.tick(command=arming.SETPOINT, value=20.0)
    assert b.law.reference_um == 16.0 and b.law.drive == 16.0
    b.set(position_um=16.0).tick().well()
    assert b.law.reference_um == 20.0 and b.law.drive == 20.0 and b.law.eps1 == 4.0
    b.law.x[0] = 2.0  # the coil is 2 K warmer: 2 um of growth
    b.set(position_um=20.0).tick(3)
    assert b.law.compensation_um == 2.0 and b.law.drive == 18.0
    b.tick(20, command=arming.SETPOINT, value=100.0)
    assert b.law.drive == 30.0
    b.set(amplifier_state=1.0).tick()
    assert b.law.drive == 20.0  # not enabled yet: where the stage is
    b.tick(command=arming.DISARM)
    assert b.law.drive == 0.0 and b.law.enable == 0.0
