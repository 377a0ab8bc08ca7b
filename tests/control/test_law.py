"""The law against closed forms and an independent numpy reference; its limits are in protection.py."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.limits import OFF, channels
from thermoctl.control import arming, faults, law
from thermoctl.control.law import AIR_READINGS, OUTPUTS, Law
from thermoctl.control.model import CompensatorModel, Parameters, zero_model
from thermoctl.rig.channels import CHANNELS

INDEX = {name: i for i, name in enumerate(CHANNELS)}
OUT = {name: i for i, name in enumerate(OUTPUTS)}
ESTIMATES = slice(len(OUTPUTS), len(OUTPUTS) + 12)
REQUIRED = ("position_um", "voltage_v", "current_a", "coil_c")
AMBIENT = 22.0


def parameters(**changes):
    required = channels(0, **dict.fromkeys(REQUIRED, 1))
    return replace(
        Parameters(kp=0.02, ti_s=0.004, td_s=0.001, output_limit=5.0, required=required, **OFF), **changes
    )


def thermal_model(kind="mkf", n=12, seed=1):
    rng = np.random.default_rng(seed)
    rates = np.geomspace(1 / 3000, 1 / 5, n)
    mix = rng.normal(size=(n, n)) * 0.2 + np.eye(n)
    A = -mix @ np.diag(rates) @ np.linalg.inv(mix) * 1e-3
    B = np.abs(rng.normal(size=(n, 2))) * 1e-6
    C = np.eye(12, n) if kind == "mkf" else rng.normal(size=(12, n))
    gain = np.linspace(1.0, 0.2, n) if kind == "mkf" else rng.normal(size=n) * 0.05 + np.linalg.pinv(C)[:, 0]
    return CompensatorModel(
        kind,
        1e-3,
        A,
        B,
        C,
        gain,
        R_w=1e-4,
        R_v=0.04,
        f1=0.99,
        b1=rng.normal(size=12) * 0.01,
        b2=rng.normal(size=12) * 0.01,
        expansion_period_s=0.05,
    )


class Rig:
    """Readings that are good until a test changes them, and the tick."""

    def __init__(self, model=None, parameters_=None, law_class=Law):
        self.law = law_class(model or zero_model(), parameters_ or parameters(), 1e-3)
        self.value = channels(
            np.nan, position_um=10.0, voltage_v=0.0, current_a=0.0, air_c=AMBIENT, coil_c=AMBIENT
        )
        self.status = np.where(np.isnan(self.value), 3, 0).astype(np.uint8)
        self.fresh = (self.status == 0).astype(np.uint8)
        self.law.bind(self.value, self.fresh, self.status)

    def set(self, **values):
        for name, number in values.items():
            self.value[INDEX[name]] = number

    def tick(self, count=1, command=arming.NONE, argument=0.0, dt=1e-3, external=0):
        for k in range(count):
            self.law.step(dt, command if k == 0 else arming.NONE, argument, external)
        return self

    def armed(self):
        self.tick(law.WARM_UP_TICKS + 3).tick(command=arming.ARM)
        assert self.state == "ARMED"
        return self

    @property
    def state(self):
        return arming.STATES[self.law.state]

    @property
    def faults(self):
        return {f.name for f in faults.decode(self.law.outputs[OUT["fault_bits"]])}

    def __getattr__(self, name):
        return self.law.outputs[OUT[name]]


def interpreted():
    """The same source, run by the interpreter instead of compiled."""
    source = Path(law.__file__).with_name("law.py")
    spec = importlib.util.spec_from_file_location("interpreted_law", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Law


def test_compiled():
    assert law.COMPILED


def test_velocity_pid_is_equation_41():
    """Against the positional closed form of (41): with constant Ts the sum telescopes to P + I + D of the error."""
    Kp, Ti, Td, Ts = 0.03, 0.02, 0.002, 1e-3
    rig = Rig(
        parameters_=parameters(kp=Kp, ti_s=Ti, td_s=Td, output_limit=1e9, setpoint_rate_um_s=1e12)
    ).armed()
    rng = np.random.default_rng(2)
    eps, v = [0.0, 0.0], []
    for _ in range(200):
        position = 10.0 + rng.normal()
        rig.set(position_um=position)
        rig.tick(command=arming.SETPOINT, argument=12.0)
        eps.append(12.0 - position)
        v.append(rig.control_v)
    e = np.array(eps)
    expected, out = 0.0, []
    for k in range(2, len(e)):
        expected += Kp * ((1 + Ts / Ti + Td / Ts) * e[k] - (1 + 2 * Td / Ts) * e[k - 1] + Td / Ts * e[k - 2])
        out.append(expected)
    np.testing.assert_allclose(v, out, rtol=1e-9, atol=1e-12)


def test_setpoint_limiter_moves_at_one_millimetre_per_minute():
    rig = Rig(parameters_=parameters(kp=0.0)).armed()
    rig.tick(command=arming.SETPOINT, argument=20.0)
    references = []
    for _ in range(900):
        references.append(rig.reference_um)
        rig.tick()
    steps = np.diff(references)
    assert references[0] == pytest.approx(10.0 + 1 / 60, rel=1e-9)
    moving = steps[steps > 1e-9]
    assert np.allclose(moving[:-1], 1000 / 60 * 1e-3) and rig.reference_um == 20.0
    assert len(moving) == pytest.approx(10.0 / (1000 / 60 * 1e-3), abs=2)


def test_no_windup():
    """Held at the limit for long, the output leaves it at the first tick of an error of the other sign."""
    rig = Rig(parameters_=parameters(td_s=0.0, output_limit=1.0, setpoint_rate_um_s=1e9)).armed()
    rig.tick(5000, command=arming.SETPOINT, argument=400.0)
    assert rig.control_v == 1.0
    rig.set(position_um=401.0)
    assert rig.tick().control_v < 1.0


def test_moving_average_is_the_mean_of_the_last_frames():
    rig = Rig(parameters_=parameters(moving_average=5))
    frames = np.random.default_rng(3).normal(size=40)
    for k, frame in enumerate(frames):
        rig.set(position_um=frame)
        rig.tick()
        if k >= 4:
            assert rig.position_um == pytest.approx(frames[k - 4 : k + 1].mean(), abs=1e-12)


@pytest.mark.parametrize("kind", ["mkf", "kalman"])
def test_estimator_and_expansion_against_numpy(kind):
    """Power and air vary, the coil is read every 20th tick; a matrix form written from the paper gives the same."""
    model = thermal_model(kind, n=12 if kind == "mkf" else 9)
    rig = Rig(model)
    rng = np.random.default_rng(4)
    n, Ts, tau = len(model.A_minus_I), 1e-3, model.air_filter_s
    x, P, air, T_before = np.zeros(n), 1e3 * model.R_v, 0.0, np.zeros(12)
    yl = [0.0, 0.0]
    A, a1 = model.A_minus_I, np.eye(n)[0] + model.A_minus_I[0]
    first, primed, phase = True, False, 0.0
    for k in range(1500):
        voltage, current, air_read = rng.normal(), rng.normal(), AMBIENT + 0.1 * np.sin(k / 200)
        coil = AMBIENT + 3 + np.sin(k / 300)
        new = k % 20 == 10
        rig.set(voltage_v=voltage, current_a=current, air_c=air_read, coil_c=coil)
        rig.fresh[INDEX["coil_c"]] = new
        rig.tick()
        if k < AIR_READINGS:  # the origin is their mean, and the rises above the air follow it
            step = (air_read - air) / (k + 1)
            air += step
            x = x if first else x + model.B[:, 1] / Ts * step
        rate = (air_read - air) / tau
        air += rate * Ts
        x = x + A @ x + model.B @ np.array([voltage * current, rate])
        if new:
            e = coil - air - model.C[0] @ x
            if first:
                x, first = x + model.gain[:, 0] / (model.C[0] @ model.gain[:, 0]) * e, False
            elif kind == "mkf":
                prior = a1 @ a1 * P + model.R_w
                gain = prior / (prior + model.R_v)
                x, P = x + gain * e * model.gain[:, 0], prior * (1 - gain)
            else:
                x = x + model.gain[:, 0] * e
        T = model.C @ x
        if not primed:
            yl = [(model.b1 + model.b2) @ T / (1 - model.f1)] * 2
            T_before, phase, primed = T, 0.0, not first and k + 1 >= AIR_READINGS
        phase += Ts
        if phase >= model.expansion_period_s:
            phase -= model.expansion_period_s
            yl, T_before = [yl[1], model.f1 * yl[1] + model.b1 @ T_before + model.b2 @ T], T
        expansion = yl[0] + min(1.0, phase / model.expansion_period_s) * (yl[1] - yl[0])
        np.testing.assert_allclose(rig.law.outputs[ESTIMATES], T + air, rtol=1e-10, atol=1e-10)
        assert rig.expansion_um == pytest.approx(expansion, rel=1e-9, abs=1e-9)


def test_expansion_has_no_delay_and_steady_gain():
    """Constant temperature: yL settles at (b1+b2).T/(1-f1)."""
    model = replace(thermal_model("kalman", n=3), A_minus_I=-np.eye(3) * 1e-9, f1=0.5)
    rig = Rig(model)
    rig.set(coil_c=AMBIENT + 4)
    rig.tick(2000)
    T = rig.law.outputs[ESTIMATES] - AMBIENT
    assert rig.expansion_um == pytest.approx((model.b1 + model.b2) @ T / 0.5, rel=1e-4)


def test_two_sensors_are_corrected_together():
    """A steady gain for two sensors: both innovations are taken before either moves the state."""
    base = thermal_model("kalman", n=4)
    gain = np.random.default_rng(5).normal(size=(4, 2))
    model = replace(base, gain=gain, sensors=(0, 4))
    rig = Rig(model)
    rig.status[INDEX["inner_stator_c"]], rig.fresh[INDEX["inner_stator_c"]] = 0, 1
    rig.set(inner_stator_c=AMBIENT)
    rig.tick()
    x = np.array(rig.law.x)
    rig.set(coil_c=AMBIENT + 1, inner_stator_c=AMBIENT - 2)
    rig.tick()
    x = x + model.A_minus_I @ x
    np.testing.assert_allclose(
        rig.law.x, x + gain @ (np.array([1.0, -2.0]) - model.C[[0, 4]] @ x), rtol=1e-12
    )


def test_interpreted_source_gives_the_same_bits():
    """The compiled law and the interpreter agree to the last bit over estimation, motion, faults and reload."""
    rigs = [Rig(thermal_model(), parameters(moving_average=4), cls) for cls in (Law, interpreted())]
    rng = np.random.default_rng(6)
    for k in range(900):
        readings = dict(
            position_um=10 + rng.normal(),
            voltage_v=rng.normal(),
            current_a=rng.normal(),
            coil_c=25 + rng.normal(),
            air_c=22 + rng.normal(),
        )
        dt = 1e-3 + abs(rng.normal()) * 1e-4
        for rig in rigs:
            rig.set(**readings)
            rig.status[INDEX["coil_c"]] = 2 if 500 < k < 520 else 0
            if k == 300:
                rig.law.configure(parameters(kp=0.05, moving_average=7))
            command = {150: arming.ARM, 200: arming.SETPOINT, 600: arming.DISARM, 650: arming.ARM}.get(
                k, arming.NONE
            )
            rig.tick(command=command, argument=30.0, dt=dt)
        assert rigs[0].law.outputs.tobytes() == rigs[1].law.outputs.tobytes(), k
    assert rigs[0].law.snapshot().tobytes() == rigs[1].law.snapshot().tobytes()


def test_snapshot_restores_every_bit():
    one = Rig(thermal_model("kalman", n=5)).armed().tick(100, command=arming.SETPOINT, argument=11.0)
    two = Rig(thermal_model("kalman", n=5))
    two.law.restore(one.law.snapshot())
    for rig in (one, two):
        rig.set(coil_c=25.0, position_um=10.3)
        rig.tick(200)
    assert one.law.outputs.tobytes() == two.law.outputs.tobytes()
    with pytest.raises(ValueError, match="state of 3 numbers"):
        one.law.restore(np.zeros(3))


def test_parameters_travel_as_one_vector():
    p = parameters(kp=0.1, stale_s=channels(np.inf, coil_c=1.0))
    q = Parameters.unpack(p.pack())
    assert q.pack().tobytes() == p.pack().tobytes() and q.stale_s[INDEX["coil_c"]] == 1.0
    with pytest.raises(ValueError, match="expected"):
        Parameters.unpack(np.zeros(4))


def test_reload_moves_nothing():
    """New gains act on what comes; the output, the reference and the estimate do not jump at the change."""
    rig = Rig(thermal_model()).armed().tick(300, command=arming.SETPOINT, argument=10.5)
    before = (rig.control_v, rig.compensation_um, rig.expansion_um, rig.position_um)
    rig.law.configure(parameters(kp=0.08, ti_s=0.2, moving_average=9))
    rig.tick()
    assert rig.state == "ARMED" and rig.position_um == pytest.approx(before[3])
    assert rig.compensation_um == pytest.approx(before[1], abs=1e-3)
    assert abs(rig.control_v - before[0]) < 0.02


LIMITED = dict(
    low=channels(-np.inf, coil_c=-20, position_um=-500, voltage_v=-30, current_a=-5),
    high=channels(np.inf, coil_c=120, position_um=500, voltage_v=30, current_a=5),
    rate=channels(np.inf, coil_c=100.0, position_um=1e5),
    stale_s=channels(np.inf, coil_c=0.5, position_um=0.005, voltage_v=0.01, current_a=0.01),
    frozen_s=channels(np.inf, voltage_v=0.2),
    coil_limit_c=60.0,
    coil_rate_k_s=0.5,
    power_limit_w=20.0,
    power_time_s=1.0,
    following_um=50.0,
    following_s=0.01,
    idle_current_a=0.2,
    idle_power_w=1.0,
    idle_s=0.01,
    saturation_s=0.05,
    innovation_limit_c=5.0,
    innovation_time_s=1.0,
    late_s=0.05,
)


def test_compensation_is_bounded_and_slewed():
    model = replace(thermal_model(), b1=np.zeros(12), b2=np.full(12, 1.0), f1=0.0)
    rig = Rig(model, parameters(slew_um_s=2.0, bound_um=30.0)).armed()
    rig.set(coil_c=AMBIENT + 1)
    last, steps = rig.compensation_um, []
    for _ in range(400):
        rig.tick()
        steps.append(rig.compensation_um - last)
        last = rig.compensation_um
    assert max(map(abs, steps)) <= 2.0 * 1e-3 * (1 + 1e-9) and "compensation_slewing" in rig.faults
    rig.set(coil_c=AMBIENT + 50)
    rig.tick(3000)
    assert "compensation_bound" in rig.faults and rig.state == "FAULT" and abs(rig.compensation_um) <= 30.0


def test_compensation_off_means_zero_and_reload_turns_it_on_by_slewing():
    model = replace(thermal_model(), offset_um=3.0)
    rig = Rig(model, parameters(compensate=0.0, slew_um_s=1.0)).armed()
    assert rig.compensation_um == 0.0
    rig.law.configure(parameters(compensate=1.0, slew_um_s=1.0))
    rig.tick()
    assert abs(rig.compensation_um) == pytest.approx(1e-3)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(CHANNELS),
            st.floats(allow_nan=True, allow_infinity=True),
            st.sampled_from([0, 0, 0, 1, 2, 3]),
            st.sampled_from(range(4)),
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(-1, 2),
        ),
        max_size=80,
    )
)
def test_whatever_is_read_the_drive_is_finite_and_off_unless_armed(events):
    """No reading, command or time step, however absurd, gives a drive that is not finite, beyond its limit, or on in
    another state than ARMED."""
    rig = Rig(thermal_model(), parameters(**LIMITED)).armed()
    for name, value, status, command, argument, dt in events:
        rig.value[INDEX[name]], rig.status[INDEX[name]] = value, status
        rig.tick(command=command, argument=argument, dt=dt)
        assert np.isfinite(rig.drive) and abs(rig.drive) <= 5.0
        assert (rig.enable == 1.0) == (rig.state == "ARMED")
        if rig.state != "ARMED":
            assert rig.drive == 0.0


def test_outputs_are_the_attributes_of_their_names():
    rig = Rig(thermal_model()).armed().tick(50, command=arming.SETPOINT, argument=10.2)
    for name in OUTPUTS:
        expected = {"position_age_s": rig.law.age[0], "coil_age_s": rig.law.age[INDEX["coil_c"]]}.get(name)
        expected = rig.law.fault_bits >> 53 if name == "fault_bits_2" else expected
        assert rig.law.outputs[OUT[name]] == (getattr(rig.law, name) if expected is None else expected), name


@pytest.mark.parametrize(
    "change,message",
    [
        (dict(kind="lqr"), "kind"),
        (dict(C=np.zeros((3, 12))), "b1 has shape"),
        (dict(f1=1.0), "f1"),
        (dict(sensors=(3,)), "sensors"),
        (dict(R_v=0.0), "R_v"),
        (dict(B=np.full((12, 2), np.nan)), "not finite"),
        (dict(R_w=-1.0), "R_w"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(thermal_model(), **change)
