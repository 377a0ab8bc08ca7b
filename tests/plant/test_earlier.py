"""Signals some seconds earlier, beside SciPy's Akima interpolation."""

import warnings

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import Akima1DInterpolator

from thermoctl.plant.simulation.earlier import earlier

SIGNALS = {
    "smooth": lambda t: np.sin(t) + 0.3 * np.cos(2.7 * t),
    "held": lambda t: np.floor(t / 3) % 4.0,
    "ramp": lambda t: 2.0 - 0.5 * t,
    "at rest": lambda t: np.full_like(t, 20.0),
}


@settings(deadline=None)
@given(kind=st.sampled_from(sorted(SIGNALS)), seconds=st.floats(0, 7), jitter=st.floats(0, 0.4))
def test_earlier_is_akima_of_scipy(kind, seconds, jitter):
    t = np.arange(40) * 0.5
    t = t + 0.5 * jitter * np.random.default_rng(3).uniform(-1, 1, len(t))
    g, at = SIGNALS[kind](t), np.maximum(t - seconds, t[0])
    values, slope, changes = earlier(t, g, seconds, np.stack([g, np.ones_like(g)], axis=1))
    known = Akima1DInterpolator(t, g)
    assert np.allclose(values, known(at), rtol=1e-7, atol=1e-7)
    inside = t - seconds > t[0] + 1e-9
    assert np.allclose(slope[inside], known.derivative()(at)[inside], rtol=1e-6, atol=1e-6)
    assert not slope[t - seconds < t[0]].any()
    assert np.allclose(changes, np.stack([values, np.ones_like(g)], axis=1), atol=1e-12)


@settings(deadline=None)
@given(seconds=st.floats(0, 3))
def test_a_delayed_jump_does_not_overshoot(seconds):
    t = np.arange(30.0)
    values, _, _ = earlier(t, np.where(t < 12, -1.0, 5.0), seconds)
    assert values.min() > -1.0 - 1e-9 and values.max() < 5.0 + 1e-9
    assert np.allclose(values[t < 12], -1.0)  # nothing moves before the jump


def test_a_signal_of_two_samples_is_a_line():
    values, slope, _ = earlier(np.array([0.0, 2.0]), np.array([1.0, 5.0]), 0.5)
    assert values.tolist() == [1.0, 4.0] and slope.tolist() == [0.0, 2.0]


def test_the_slopes_of_a_run_away_from_the_data_bring_no_warning():
    t, slopes = np.arange(6.0), np.full((6, 1), 1e308)
    slopes[::2] *= -1
    slopes[3:5] = np.inf
    with warnings.catch_warnings(action="error"):
        values, _, changes = earlier(t, t, 0.5, slopes)
    assert np.isfinite(values).all() and not np.isfinite(changes).all()
