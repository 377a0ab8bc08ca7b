"""Thermal models: real poles, resampling, against closed forms and a simulator of known truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from tests.identify.peers import identify_validated, initial_state
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import modal
from thermoctl.identify.statespace import StateSpace

TAU = np.array([20.0, 150.0, 900.0])


def truth(period_s=1.0):
    """Three real poles, four outputs."""
    rng = np.random.default_rng(7)
    p = np.exp(-period_s / TAU)
    return StateSpace(np.diag(p), (1 - p)[:, None], rng.uniform(0.3, 2, (4, 3)), period_s, np.zeros(3))


def pulses(n=6000):
    t = np.arange(n)
    return 5.0 * ((t < 1500) | ((t > 2200) & (t < 2800)) | ((t > 3300) & (t < 3500))).astype(float)[:, None]


@pytest.fixture(scope="module")
def data():
    u = pulses()
    y = truth().simulate(u)
    return u, y, y + 0.05 * np.random.default_rng(1).standard_normal(y.shape)


def test_simulation_is_that_of_scipy():
    m, u = truth(), pulses(300)
    reference = signal.dlsim((m.a, m.b, m.c, np.zeros((4, 1)), 1.0), u)[1]
    assert np.allclose(m.simulate(u), reference, atol=1e-12)


def drifting(rng, y, sigma, tau_s=2500.0):
    """y with white noise and, over every output, a slow disturbance that no input explains."""
    f = np.exp(-1 / tau_s)
    walk = signal.lfilter([1.0], [1.0, -f], np.sqrt(1 - f * f) * rng.standard_normal(y.shape), axis=0)
    return y + sigma * walk + 0.05 * rng.standard_normal(y.shape)


def test_slow_disturbances_bend_plain_least_squares_more():
    """Three tests of a rig whose outputs drift; the model runs free over a fourth: what is left varies less when the drift's colour is
    known, though only to a factor of three."""
    t = np.arange(7200)
    inputs = [
        pulses(9000),
        *(
            5.0 * ((t % period < on) & (t < 3600)).astype(float)[:, None]
            for period, on in ((900, 400), (500, 200))
        ),
    ]
    t = np.arange(9000)
    other = 4.0 * ((t % 75 < 35) & (t % 3600 < 2400)).astype(float)[:, None]
    wanted = truth().simulate(other)
    left: dict = {None: [], (7200.0, 250.0): []}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        records = [modal.reduce((u, drifting(rng, truth().simulate(u), 0.3)), 1.0) for u in inputs]
        for drift, errors in left.items():
            m = modal.identify(records, 4, drift_s=drift)
            assert m.stable
            errors.append(np.std(m.simulate(other) - wanted))
    plain, coloured = (np.median(e) for e in left.values())
    assert coloured < 0.85 * plain


def test_other_recordings_of_a_rig_help_where_one_is_short():
    """A hundred seconds of one record, with and without two other records of the rig: error of the free run that goes on."""
    rng = np.random.default_rng(5)
    m = StateSpace(
        np.diag(np.exp(-1 / np.array([15.0, 200.0]))),
        np.array([[0.3], [0.05]]),
        np.array([[1.0, 1.0]]),
        1.0,
        np.zeros(2),
    )

    def record(on, n=180):
        u = ((np.arange(n) % (2 * on)) < on).astype(float)[:, None]
        y = m.simulate(u)
        return u, y, np.round((y + 0.05 * rng.standard_normal(y.shape)) / 0.1) * 0.1

    (u, y, read), others = record(40), [record(60)[::2], record(90)[::2]]
    errors = []
    for more in ((), others):
        found = identify_validated(u[:100], read[:100], 1.0, others=more)
        x0 = found.x0 if found.info["rest"] else initial_state(found, u[:100], read[:100])
        errors.append(np.sqrt(np.mean((found.simulate(u, x0)[100:] - y[100:]) ** 2)))
    assert found.info["rest"] and errors[1] < 0.7 * errors[0]


def test_real_poles_are_found_and_are_stable(data):
    u, y, noisy = data
    m = modal.identify(modal.reduce((u, noisy), 1.0), 3)
    assert m.stable and np.isreal(m.poles).all()
    assert np.allclose(np.sort(m.time_constants_s), TAU, rtol=0.1)
    assert np.sqrt(np.mean((m.simulate(u) - y) ** 2)) < 0.01


def test_blocks_lose_nothing_of_the_slow_dynamics():
    """From data at 0.1 s and at 1 s of the same experiment the model is the same; the noise-free model is exact to 1e-4 of the range."""
    coarse, fine = truth(1.0), truth(1.0).resample(0.1)
    u = pulses()
    a = modal.identify(modal.reduce((u, coarse.simulate(u)), 1.0), 3)
    u10 = np.repeat(u, 10, axis=0)
    b = modal.identify(modal.reduce((u10, fine.simulate(u10)), 0.1), 3).resample(1.0)
    y = coarse.simulate(u)
    for m in (a, b):
        assert np.abs(m.simulate(u) - y).max() < 2e-3 * y.max()


def test_pieces_gaps_and_a_late_start(data):
    u, y, noisy = data
    whole = modal.reduce((u, noisy), 1.0)
    pieces = modal.reduce(((u[k : k + 77], noisy[k : k + 77]) for k in range(0, len(u), 77)), 1.0)
    assert np.allclose(whole.u, pieces.u) and np.allclose(whole.y, pieces.y)
    holes = noisy.copy()
    holes[np.random.default_rng(0).random(holes.shape) < 0.4] = np.nan
    holes[2000:2300, 1] = np.nan
    m = modal.identify(modal.reduce((u, holes), 1.0), 3)
    assert np.sqrt(np.mean((m.simulate(u) - y) ** 2)) < 0.03
    late = modal.identify(modal.reduce((u[600:], noisy[600:]), 1.0), 3, rest=False)
    assert np.sqrt(np.mean((late.simulate(u[600:], late.x0) - y[600:]) ** 2)) < 0.02


def test_order_by_bic(data):
    u, _, noisy = data
    assert modal.identify(modal.reduce((u, noisy), 1.0), None).order == 3


@given(st.floats(0.001, 60), st.floats(0.001, 60))
@settings(max_examples=30, deadline=None)
def test_resampling_there_and_back(one, two):
    m = truth(one)
    back = m.resample(two).resample(one)
    assert np.allclose(back.a, m.a, atol=1e-11) and np.allclose(back.b, m.b, atol=1e-11)


def test_resampling_is_exact_and_a_linear_scaling_is_not():
    m = truth(10.0)
    fine = m.resample(0.001)
    exact = np.diag(np.expm1(-0.001 / TAU))
    assert np.abs(m.minus_identity(0.001) - exact).max() < 1e-15
    assert np.abs(fine.a - np.eye(3) - exact).max() < 1e-13
    assert np.abs((m.a - np.eye(3)) / 10000 - exact).max() > 0.1 * np.abs(exact).max()


def test_a_noise_pole_is_refused_with_its_value():
    m = StateSpace(np.diag([0.99, -0.3]), np.ones((2, 1)), np.eye(2), 10.0, np.zeros(2))
    with pytest.raises(InputError, match="pole at -0.3"):
        m.resample(0.001)


@pytest.mark.parametrize(
    "work, message",
    [
        (lambda u, y: modal.reduce((u[:30], y[:30]), 1.0), "at least 20"),
        (lambda u, y: modal.identify(modal.reduce((u, 0 * y + np.nan), 1.0), 3), "has no sample"),
    ],
)
def test_bad_data_are_refused_in_one_line(data, work, message):
    with pytest.raises(InputError, match=message):
        work(data[0], data[2])
