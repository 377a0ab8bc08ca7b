"""No path to a driven output: whatever is commanded, read, reloaded or broken, in any order, the amplifier is driven only in
ARMED, which is entered only by an ARM that arrives in READY with nothing standing. The real loop and law on a small stage."""

import math

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.limits import OFF, channels
from thermoctl.control import arming, faults
from thermoctl.control.law import WARM_UP_TICKS
from thermoctl.control.model import CompensatorModel, Parameters, packed_length
from thermoctl.daemon.tick.loop import RELOAD, Axis
from thermoctl.daemon.tick.ring import Box, Mailbox
from thermoctl.rig.signals import INDEX
from thermoctl_hal.base.backend import ABSENT, ERROR, OK, ROLE, ROLES, STALE, Sample

NEEDED = ("position_um", "voltage_v", "current_a", "air_c", "coil_c", "amplifier_state")
LIMIT = 1.5
PERIOD_S = 1e-3


def parameters(**changes):
    values = dict(
        kp=0.01,
        ti_s=0.004,
        td_s=0.001,
        output_limit=LIMIT,
        setpoint_low_um=-250.0,
        setpoint_high_um=250.0,
        bound_um=40.0,
        slew_um_s=1.0,
        low=channels(-1e3),
        high=channels(1e3),
        rate=channels(math.inf, position_um=5e4, coil_c=20.0),
        stale_s=channels(0.5, position_um=0.01),
        required=channels(0.0, **dict.fromkeys(NEEDED, 1.0)),
        following_um=20.0,
        following_s=0.05,
        coil_limit_c=80.0,
        power_limit_w=15.0,
        idle_current_a=0.05,
        idle_power_w=0.5,
        saturation_s=0.5,
        late_s=0.1,
        current_per_drive=1.0,
        current_tolerance_a=0.2,
        resistance_ohm=5.0,
    )
    return Parameters(**{**OFF, **values, **changes})


def model():
    C = np.zeros((12, 2))
    C[0, 0] = C[1, 1] = 1.0
    A = np.array([[-0.03, 0.03], [0.05, -0.06]]) * PERIOD_S
    return CompensatorModel(
        "kalman",
        PERIOD_S,
        A,
        np.array([[0.026, -1.0], [0.0, -1.0]]) * PERIOD_S,
        C,
        np.array([1e-2, 5e-3]),
        1e-4,
        0.01,
        0.0,
        np.zeros(12),
        np.r_[1.0, 1.0, np.zeros(10)],
        0.1,
    )


class Stage:
    """A stage on flexures with a current amplifier, 300 um/A with a lag of 5 ms; readings can be replaced."""

    def __init__(self):
        self.sample, self.x_um, self.drive, self.enable = Sample(), 0.0, 0.0, False
        self.spoilt: dict[str, float] = {}
        self.said: dict[str, int] = {}
        self.refuse = False
        self.writes: list[tuple[float, bool]] = []
        self.k = 0

    def read(self, now_s):
        self.k += 1
        self.x_um += 0.2 * (300.0 * self.drive - self.x_um)
        s, noise = self.sample, 1e-3 * (self.k % 7)
        values = {
            "position_um": self.x_um + noise,
            "voltage_v": 5.0 * self.drive + noise,
            "current_a": self.drive + noise / 10,
            "air_c": 22.0 + noise,
            "coil_c": 22.5 + noise,
            "bobbin_c": 22.3 + noise,
            "amplifier_state": 2.0 if self.enable else 1.0,
        }
        s.status[:] = ABSENT
        s.fresh[:] = False
        for name, value in {**values, **self.spoilt}.items():
            k = ROLE[name]
            s.value[k], s.status[k] = value, self.said.get(name, OK)
            s.fresh[k] = s.status[k] == OK
        return s

    def write(self, drive, enable):
        self.writes.append((drive, enable))
        if self.refuse:
            raise OSError("bus off")
        self.drive, self.enable = (drive, True) if enable and math.isfinite(drive) else (0.0, False)


class NoPath(RuleBasedStateMachine):
    """Rules spoil, command and let time pass; every tick is checked in `tick`."""

    @initialize(warm=st.booleans())
    def begin(self, warm):
        self.stage, self.given = Stage(), None
        self.mail, self.box = (
            Mailbox(np.zeros(2, np.uint64), np.zeros((4, 2))),
            Box(np.zeros(1, np.uint64), np.zeros(packed_length(len(ROLES)) + 1)),
        )
        self.rig = Axis(self.stage, model(), parameters(), PERIOD_S, lambda row: None, self.mail, self.box)
        self.rig.wall_s = lambda: 0.0
        self.now_s, self.before = 0.0, arming.OFF
        if warm:
            self.tick(WARM_UP_TICKS + 3)

    def tick(self, count, dt=PERIOD_S):
        for _ in range(count):
            law, given, self.given = self.rig.law, self.given, None
            self.now_s += PERIOD_S
            self.rig.tick(self.now_s, dt, 0.0, lambda: 0)
            drive, enable = self.stage.writes.pop()
            assert not self.stage.writes  # one command to the amplifier a tick
            state, bits = law.state, int(law.fault_bits)
            tripping = [f for f in faults.decode(bits) if f.severity == "critical"]
            # Driven only in ARMED, inside the limit, finite; zero and disabled else.
            assert enable == (state == arming.ARMED) and math.isfinite(drive) and abs(drive) <= LIMIT
            assert enable or drive == 0.0
            if state == arming.ARMED:
                assert not tripping
                if (
                    self.before != arming.ARMED
                ):  # only by this tick's ARM, from READY, at rest, without a jump
                    assert self.before == arming.READY and given == arming.ARM
                    assert drive == 0.0 and law.setpoint_um == law.compensated_um == law.reference_um
                for name in NEEDED:  # nothing needed is at fault
                    assert law.verdict[ROLE[name]] == 0.0
            elif self.before == arming.ARMED:
                assert state in (arming.SAFE, arming.FAULT)
                assert state == arming.FAULT or given == arming.DISARM
            if self.before == arming.FAULT and state != arming.FAULT:
                assert state == arming.SAFE and given == arming.DISARM and not tripping
            assert np.isfinite(self.rig.row[INDEX["drive"]]) and self.rig.row[INDEX["enable"]] == float(
                enable
            )
            self.before = state

    def give(self, command, value=0.0):
        """One command for the next tick, which takes it."""
        assert self.mail.push(float(command), value)
        self.given = command

    @rule(
        command=st.sampled_from(
            [arming.ARM, arming.ARM, arming.DISARM, arming.SETPOINT, arming.NONE, 7.0, -1.0]
        ),
        value=st.one_of(st.floats(-300, 300), st.floats()),
    )
    def command(self, command, value):
        self.give(command, value)
        self.tick(1)

    @rule()
    def acknowledge_and_arm(self):
        for command in (arming.DISARM, arming.NONE, arming.ARM):
            self.give(command)
            self.tick(2)

    @rule(count=st.integers(1, 60))
    def time_passes(self, count):
        self.tick(count)

    @rule(dt=st.one_of(st.floats(0.0, 30.0), st.floats()))
    def a_step_of_time(self, dt):
        self.tick(1, dt)

    @rule(name=st.sampled_from(NEEDED), value=st.floats())
    def a_reading(self, name, value):
        self.stage.spoilt[name] = value
        self.tick(1)

    @rule(name=st.sampled_from(NEEDED), status=st.sampled_from([STALE, ERROR, ABSENT]))
    def a_device_says(self, name, status):
        self.stage.said[name] = status
        self.tick(1)
        assert self.rig.law.state != arming.ARMED  # at once

    @rule()
    def mend(self):
        self.stage.spoilt.clear()
        self.stage.said.clear()
        self.stage.refuse = False
        self.tick(3)

    @rule()
    def the_bus_refuses(self):
        self.stage.refuse = True
        self.tick(2)
        if (
            self.rig.law.state == arming.SAFE
        ):  # the warm-up ended in the last of them: the fault trips in the next
            self.tick(1)
        assert self.rig.law.state in (arming.FAULT, arming.OFF)

    @rule(
        kp=st.floats(0, 0.05),
        limit=st.floats(0.0, LIMIT),
        average=st.integers(1, 64),
        compensate=st.booleans(),
    )
    def reload(self, kp, limit, average, compensate):
        self.box.put(
            parameters(
                kp=kp, output_limit=limit, moving_average=float(average), compensate=float(compensate)
            ).pack()
        )
        self.give(RELOAD)
        self.tick(1)

    @invariant()
    def at_rest_unless_armed(self):
        if hasattr(self, "rig") and self.rig.law.state != arming.ARMED:
            assert self.rig.law.drive == 0.0 and self.rig.law.v == 0.0


NoPath.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestNoPath = NoPath.TestCase
