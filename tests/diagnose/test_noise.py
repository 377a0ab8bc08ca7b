"""The averaged likelihood: against an independent optimizer, and what it keeps of an effect in coloured noise."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.fft import dct
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.special import logsumexp

from thermoctl.diagnosis.data.coordinates import Coordinates, transform
from thermoctl.diagnosis.data.grids import Grid, Reading, grid
from thermoctl.diagnosis.data.spectra import SLOW, slow_parts
from thermoctl.diagnosis.evidence import noise as module
from thermoctl.diagnosis.evidence.densities import NOISE, REMAINDER
from thermoctl.diagnosis.evidence.densities import SLOW as SLOW_NOISE
from thermoctl.diagnosis.evidence.levels import floor
from thermoctl.diagnosis.evidence.noise import Around, Averaged, averaged
from thermoctl.plant.simulation.simulate import Excitation

ROWS, SIGMA, SWING = 2000, 0.05, 5.0
SHARE = 0.4  # of the noise's variance, that is not white


def banded(
    e: np.ndarray, sigma: float = SIGMA, block: int = 1, change: float = 0.0
) -> tuple[list[Grid], list[np.ndarray]]:
    n = len(e)
    d = Excitation("run", np.arange(n) * 1.0, np.zeros((n, 0)), e[:, None], {}, np.zeros(0, np.intc))
    c = Coordinates([d])
    reading = Reading("y", sigma, None, SWING, change, False, block)
    return [grid(c, [0], reading)], c.powers([transform(c.channels[0], e)])


def likelihood(e: np.ndarray) -> Averaged:
    return averaged(*banded(e))


def coloured(seed: int, phi: float, size: float = 1.0, rows: int = ROWS) -> np.ndarray:
    """Noise of `size` times the stated one: 60 % of its variance is white, the rest first-order."""
    white, other = np.random.default_rng(seed).standard_normal((2, rows))
    slow = lfilter([1], [1, -phi], other) * np.sqrt(1 - phi**2)
    return (np.sqrt(1 - SHARE) * white + np.sqrt(SHARE) * slow) * SIGMA * size


def effect(sigmas: float, phi: float) -> np.ndarray:
    """A slow course that an ideal test, which knows the noise, sees with so many sigmas."""
    levels = [0, 1, 0.2, 0.8, 0.1, 1, 0.3, 0.9, 0.2]
    s = np.interp(np.arange(ROWS), np.linspace(0, ROWS, len(levels)), levels) - 0.5
    turn = np.cos(np.pi * np.arange(ROWS) / ROWS)
    spectrum = 1 - SHARE + SHARE * (1 - phi**2) / (1 - 2 * phi * turn + phi**2)
    return s * sigmas * SIGMA / np.sqrt(np.sum(dct(s, norm="ortho") ** 2 / spectrum))


def by_hand(g: Grid, power: np.ndarray) -> float:
    """Laplace's log p(R | remainder), from the equations of the module's docstring and scipy's BFGS."""
    n, q = g.count, g.small
    known = g.known

    def minus(x: np.ndarray) -> float:
        u = np.exp(x[1:])
        mean = n @ u / n.sum()
        v = g.variance * np.exp(x[0]) + q * (u + module.FLOOR * mean)
        prior = 0.5 * (x[0] / known) ** 2 + 0.5 * x[1:] @ g.rough @ x[1:] + 0.5 * mean
        return 0.5 * float(n @ np.log(2 * np.pi * v) + (power / v).sum()) + prior

    x = np.concatenate([[0.0], np.log(power / n / q)])
    for _ in range(5):  # BFGS with numerical slopes ends early once
        x = minimize(minus, x, method="L-BFGS-B", options={"maxfun": 10**6, "maxiter": 10**4}).x
    h, step = np.empty((len(x), len(x))), 1e-3 * np.eye(len(x))
    for i in range(len(x)):
        for j in range(len(x)):
            ends = [minus(x + a * step[i] + b * step[j]) for a in (1, -1) for b in (1, -1)]
            h[i, j] = (ends[0] - ends[1] - ends[2] + ends[3]) / 4e-6
    return -minus(x) - np.log(known) + 0.5 * g.log_rough - g.log_small - 0.5 * np.linalg.slogdet(h)[1]


@pytest.mark.parametrize("steep", [0.0, 2.0, 5.0])
def test_the_remainder_is_averaged_about_its_maximum_however_many_decades_it_spans(steep):
    """A slow residual of 8 decades: Newton's steps by Fisher's curvature ended thousands of nats below."""
    t = np.linspace(0, 1, ROWS)
    slow = sum(np.cos(np.pi * k * t + k) / (1 + k) ** steep for k in range(1, 300))
    g, power = banded(SWING * slow / np.std(slow) * 0.3 + 0.02 * SIGMA * coloured(3, 0.0))
    assert averaged(g, power).log_likelihood == pytest.approx(
        by_hand(g[0], np.bincount(g[0].node, power[0])) + np.log(1 - module.ABSENT), abs=0.1
    )


@pytest.mark.parametrize("phi", [0.3, 0.84])
def test_slow_noise_is_averaged_over_its_size_time_and_flicker(phi):
    """Beside a sum over 30 000 spectra; the data determine each parameter in another way."""
    (g,), (power,) = banded(coloured(1, phi))
    power = np.bincount(g.node, power)
    middle = (np.arange(30) + 0.5) / 30
    size, time, flicker = (np.exp(a + (b - a) * middle) for a, b in SLOW)
    r = np.exp(-1 / time)[:, None]
    first = (1 - r**2) / (1 - 2 * r * np.cos(g.turn) + r**2)
    shape = (
        1
        + (size[:, None, None] ** 2 * first)[:, :, None]
        + (flicker[:, None] ** 2 * np.pi / np.log(10) / g.turn)
    )
    shape = shape * (g.count.sum() / (shape @ g.count))[..., None]
    level = np.linspace(-0.4, 0.4, 81)
    ratio = (power / g.variance / shape).sum(axis=-1)[..., None]
    n = g.count.sum()
    log_p = -0.5 * (
        n * (np.log(2 * np.pi * g.variance) + level)
        + (np.log(shape) @ g.count)[..., None]
        + ratio * np.exp(-level)
    )
    log_p = log_p - 0.5 * (level / g.known) ** 2 - np.log(np.sqrt(2 * np.pi) * g.known)
    whole = logsumexp(log_p) + np.log(0.01 / 30**3)
    found = module.log_p(g, SLOW_NOISE, *module.density(g, SLOW_NOISE).top(power))
    assert found == pytest.approx(whole, abs=0.5)


@pytest.mark.parametrize("kind", [NOISE, SLOW_NOISE, REMAINDER])
@pytest.mark.parametrize("change", [0.0, 20 * SIGMA])
def test_slopes_and_curvatures_of_the_log_densities_are_those_of_differences(kind, change):
    (g,), powers = banded(coloured(5, 0.7, 3.0), change=change)
    power = np.bincount(g.node, powers[0])
    assert len(g.scales) == 1 + (change > 0)
    density = module.density(g, kind)
    x = density.start(power)
    x += 0.3 * np.random.default_rng(1).standard_normal(len(x))
    at, step = density.at(x, power), 1e-5 * np.eye(len(x))
    ends = [(density.at(x + d, power), density.at(x - d, power)) for d in step]
    slope = [(low.log_density - high.log_density) / 2e-5 for high, low in ends]
    curvature = [(high.uphill - low.uphill) / 2e-5 for high, low in ends]
    ratio = [(np.log(high.variance) - np.log(low.variance)) / 2e-5 for high, low in ends]
    np.testing.assert_allclose(at.uphill, slope, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(at.curvature, curvature, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(at.slope, np.transpose(ratio), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("change", [0.0, 20 * SIGMA])
def test_the_densities_are_the_equations_of_the_docstring(change):
    """V, likelihood and prior of each, written out in numpy beside the compiled ones."""
    (g,), powers = banded(coloured(5, 0.7, 3.0), change=change)
    power, n, late = np.bincount(g.node, powers[0]), g.count, len(g.scales) - 1
    rng = np.random.default_rng(4)
    for kind, size in ((NOISE, 0), (SLOW_NOISE, 3), (REMAINDER, len(n))):
        x = 0.5 * rng.standard_normal(1 + late + size)
        head, rest = x[: 1 + late], x[1 + late :]
        shape = slow_parts(g.turn, rest) if kind == SLOW_NOISE else g.shape
        v = g.variance * np.exp(x[0]) * shape * n.sum() / (shape @ n)
        v = v + (g.variance * g.clock * np.exp(x[1]) if late else 0.0)
        prior = head @ (head / g.scales**2) + (rest @ rest if kind == SLOW_NOISE else 0.0)
        if kind == REMAINDER:
            mean = n @ np.exp(rest) / n.sum()
            v = v + g.small * (np.exp(rest) + module.FLOOR * mean)
            prior += rest @ g.rough @ rest + mean
        at = module.density(g, kind).at(x, power)
        np.testing.assert_allclose(at.variance, v, rtol=1e-12)
        assert at.log_density == pytest.approx(-0.5 * (n @ np.log(v) + (power / v).sum() + prior), rel=1e-12)


def test_a_density_is_the_same_in_another_process():
    (g,), powers = banded(coloured(5, 0.7))
    density, power = module.density(g, REMAINDER), np.bincount(g.node, powers[0])
    again = pickle.loads(pickle.dumps(density))
    np.testing.assert_array_equal(again.top(power)[0].x, density.top(power)[0].x)


@pytest.mark.parametrize("late", [0.0, 0.02])
def test_uncertain_times_of_a_fast_reading_are_noise_and_no_misfit(late):
    """A sine of 100 noises: 2 % of a sampling interval is four times the noise where the reading is fastest."""
    rng, t = np.random.default_rng(9), np.arange(ROWS)
    slope = 200 * SIGMA * np.cos(0.2 * t)
    e = SIGMA * rng.standard_normal(ROWS) + late * slope * rng.standard_normal(ROWS)
    change = float(np.sqrt(np.mean(slope**2)))
    (g,), powers = banded(e, change=change)
    assert floor(g, powers, 5) == pytest.approx(SIGMA**2 + (late * change) ** 2, rel=0.2)
    assert averaged([g], powers).remainder[0] < 0.5
    (still,), powers = banded(e)
    assert floor(still, powers, 5) <= still.most  # nothing moves: only the sensor errs


def test_a_misfit_that_falls_with_frequency_is_no_noise():
    e = coloured(3, 0.0) + 30 * effect(1.0, 0.0)
    (g,), powers = banded(e, change=20 * SIGMA)
    assert floor(g, powers, 5) < 1.5 * SIGMA**2


@pytest.mark.parametrize("phi", [0.3, 0.5, 0.7, 0.84, 0.9])
def test_slow_noise_in_a_long_recording_is_no_remainder(phi):
    """A few spectra of noise, apart by a factor of three, left 20 to 45 nats to the remainder."""
    for seed in range(3):
        assert likelihood(coloured(seed, phi, rows=20_000)).remainder[0] < 0.01


@pytest.mark.parametrize("phi", [0.0, 0.3, 0.5, 0.7, 0.9])
def test_half_of_an_effect_stays_in_noise_of_stated_size_and_any_colour(phi):
    """An ideal test gains 24.5 nats. The colour has to be learnt from the same record."""
    gains = []
    for seed in range(8):
        e = coloured(seed, phi)
        gains.append(likelihood(e).log_likelihood - likelihood(e + effect(7, phi)).log_likelihood)
    assert np.mean(gains) > 0.45 * 7**2 / 2  # 67 % in white noise, 48 % with phi 0.9


def test_slow_errors_far_louder_than_the_stated_noise_are_a_remainder():
    for seed in range(4):
        steps = np.random.default_rng(seed).standard_normal(ROWS)
        wandering = lfilter([1], [1, -0.995], steps) * np.sqrt(1 - 0.995**2) * 3 * SIGMA
        assert likelihood(coloured(seed, 0.0) + wandering).remainder[0] > 0.95


def test_a_residual_of_zero_has_a_finite_likelihood():
    """A simulated recording without noise, or a sensor that stands still."""
    found = averaged(*banded(np.zeros(ROWS)), unsure=True)
    assert np.isfinite(found.log_likelihood)
    assert all(np.isfinite(v).all() for v in (*found.inverse, *found.unsure))


def test_noise_as_stated_is_no_remainder():
    for phi in (0.0, 0.7, 0.9):
        assert all(likelihood(coloured(seed, phi)).remainder[0] < 0.5 for seed in range(4)), phi


def test_slow_noise_is_the_same_noise_in_means_of_rows():
    """Means keep the first-order part whole, and it is larger than their white part: still no remainder."""
    block = 5
    means = coloured(4, 0.9, rows=block * ROWS).reshape(-1, block).mean(axis=1)
    present = [averaged(*banded(means, SIGMA / np.sqrt(block), b)).remainder[0] for b in (block, 1)]
    assert present[0] < 0.05 and present[1] > 0.5


@pytest.mark.parametrize("sigmas", [1.0, 7.0, 70.0, 7000.0])
def test_a_predicted_rise_is_the_difference_of_two_likelihoods(sigmas):
    """For a small effect to first order, for a huge one, whose residual falls by decades, from a new start."""
    clean = coloured(3, 0.6)
    g, before = banded(clean + effect(sigmas, 0.6))
    after = banded(clean)[1]
    whole = averaged(g, after).log_likelihood - averaged(g, before).log_likelihood
    assert Around(g, before).rise(after) == pytest.approx(whole, abs=0.1)
    assert Around(g, after).rise(before) == pytest.approx(-whole, abs=0.1)
