"""What data that took no part say of an explanation, where it shows only once."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from thermoctl.diagnose.heldout import FORETOLD, foretold, pooled_gain
from thermoctl.plant.refit import Noise

SIGMA, SAMPLES = 0.1, 4000


def errors(colour, rng):
    """Two recordings of a sensor's errors (SAMPLES, 1)."""
    out = []
    for _ in range(2):
        e = rng.standard_normal(SAMPLES)
        if colour == "slow":
            e += lfilter([0.15], [1, -0.98], rng.standard_normal(SAMPLES))
        if colour == "flicker":
            spectrum = np.fft.rfft(rng.standard_normal(SAMPLES)) / np.sqrt(
                np.maximum(np.arange(SAMPLES // 2 + 1), 1)
            )
            e += 6 * np.fft.irfft(spectrum, SAMPLES)
        out.append(SIGMA * e[:, None])
    return out


def judged(before, after):
    return pooled_gain(SimpleNamespace(noise=(Noise(SIGMA),)), before, after)


@pytest.mark.parametrize("colour", ["white", "slow", "flicker"])
def test_noise_follows_no_prediction_more_than_by_chance(colour):
    rng = np.random.default_rng(1)
    t = np.linspace(0, 1, SAMPLES)
    z = []
    for k in range(200):
        before = errors(colour, rng)
        shift = (
            (np.sin(2 * np.pi * (k % 9 + 0.5) * t), (t > 0.7) * 1.0, np.exp(-t / 0.1))[k % 3]
            * SIGMA
            * rng.uniform(0.05, 1)
        )
        z.append(foretold(before, [e - shift[:, None] for e in before]))
    assert np.sqrt(np.mean(np.square(z))) < 1.6
    assert np.max(np.abs(z)) < FORETOLD


@pytest.mark.parametrize("colour", ["white", "slow", "flicker"])
def test_what_happens_once_is_proved_by_one_block(colour):
    """A tank overflows once in two recordings: every third draw of blocks is without it, and the interval cannot exclude zero."""
    after = errors(colour, np.random.default_rng(2))
    once = np.zeros((SAMPLES, 1))
    once[3000:3100] = 8 * SIGMA
    before = [after[0], after[1] + once]
    ratio, _, high = judged(before, after)
    assert high == ratio < 1
    assert judged(after, before)[2] > 1  # the other way round nothing is gained
    faint = [after[0], after[1] + 0.015 * once]
    assert judged(faint, after)[2] >= 1  # nor by what noise does as well
