"""The likelihood of coloured residuals against spectra and draws made here."""

import numpy as np
import pytest
from scipy.fft import idct
from scipy.signal import lfilter
from scipy.stats import kstest

from thermoctl.diagnose.evidence import channels, flicker, least_gain
from thermoctl.diagnose.explain import Case
from thermoctl.diagnose.locate import rhythms, suspects, together
from thermoctl.diagnose.remains import REMAINS, WHITE, metric_of, remains
from thermoctl.plant import load
from thermoctl.plant.simulate import compile_plant
from thermoctl.recording.table import Table


@pytest.mark.parametrize(("beside", "large"), [(None, 0.0), (0.7, 0.25), (0.93, 0.5)])
def test_a_flicker_filter_has_the_spectrum_of_its_parts(beside, large):
    ar, ma = flicker(0.01, 1.0, beside, large)
    z = np.exp(-1j * np.linspace(1e-3, np.pi, 200))
    made = np.abs(np.polyval(ma[::-1], z) / np.polyval(ar[::-1], z)) ** 2
    parts = 1 + sum(
        0.01 * (1 - p**2) / np.abs(1 - p * z) ** 2 for p in np.exp(-1 / (2.0 * 8.0 ** np.arange(5)))
    )
    if beside:
        parts = parts + large * (1 - beside**2) / np.abs(1 - beside * z) ** 2
    assert np.ptp(made / parts) < 1e-3 * np.mean(made / parts)
    assert np.abs(np.roots(ma)).max() < 1 and np.abs(np.roots(ar)).max() < 1


def mixed(n, rng):
    """White noise, a first-order part and a 1/f part, standard deviation about 1."""
    slow = np.zeros(n)
    slow[1:] = 1 / np.arange(1, n)
    return (
        0.88 * rng.standard_normal(n)
        + lfilter([0.45 * np.sqrt(1 - 0.5**2)], [1, -0.5], rng.standard_normal(n))
        + 0.15 * idct(rng.standard_normal(n) * np.sqrt(slow * n / slow.sum()), norm="ortho")
    )


KINDS = ("white", "first order", "flicker")


def noise_of(kind, n, rng):
    """Noise of one of KINDS, its white part of standard deviation about 1."""
    white = rng.standard_normal(n)
    return (
        white
        if kind == "white"
        else white + lfilter([0.2], [1, -0.97], rng.standard_normal(n))
        if kind == "first order"
        else mixed(n, rng)
    )


def test_a_slow_wave_is_not_paid_for_in_noise_that_has_a_fast_and_a_slow_part():
    """A sine of a few periods is fitted to pure noise and taken out: what that pays, against what white noise would pay."""
    n, paid, white = 8000, [], []
    t = np.arange(n)
    for seed in range(12):
        noise = mixed(n, np.random.default_rng(seed))
        best = None
        for turns in np.arange(1.0, 8.0, 0.25):
            X = np.column_stack([np.sin(2 * np.pi * turns * t / n), np.cos(2 * np.pi * turns * t / n)])
            left = noise - X @ np.linalg.lstsq(X, noise, rcond=None)[0]
            if best is None or left @ left < best @ best:
                best = left
        white.append(noise @ noise - best @ best)
        paid.append(least_gain([noise[:, None]], [best[:, None]], [1.0]))
    assert np.median(white) > 25 and max(paid) < 12


def test_what_leaves_white_noise_behind_is_paid_in_full():
    """A drift of three sigmas' size that no sensor would have: with it gone the residual is white."""
    rng = np.random.default_rng(0)
    noise, t = rng.standard_normal(4000), np.linspace(0, 1, 4000)
    drift = 0.35 * np.tanh(8 * (t - 0.4))
    before, after = (noise + drift)[:, None], noise[:, None]
    found = channels([before], [1.0])[0].score - channels([after], [1.0])[0].score
    assert least_gain([before], [after], [1.0]) == pytest.approx(found, rel=1e-6) and found > 30


@pytest.fixture
def block(tmp_path):
    """A heated block whose two recordings are the plant's own simulation, and what is added to its temperature."""
    path = tmp_path / "plant.yaml"
    path.write_text(
        "format: thermoctl-plant/1\ninputs: {P: {unit: W}, air: {unit: degC}}\n"
        "parameters: {C: {value: 30, unit: J/K, range: [10, 90]}, G: {value: 0.5, unit: W/K, range: [0.1, 1]}}\n"
        "nodes: {T: {unit: degC, storage: C, initial: air}}\n"
        "flows: {heat: {into: T, rate: P, unit: W}, loss: {from: T, rate: G * (T - air), unit: W}}\n"
        "outputs: {y: {value: T, unit: degC, noise: 0.1}}\n"
    )

    def refitted(added):
        plant, tables = load(path), []
        for k in range(2):
            t = np.arange(3000.0)
            table = Table(
                f"r{k}",
                f"r{k}",
                t,
                {"P": 6.0 * np.random.default_rng(k).integers(0, 2, 60).repeat(50), "air": 21 + 0 * t},
            )
            table.columns["y"] = compile_plant(plant, ()).simulate(table).y[:, 0] + added(
                t, np.random.default_rng(100 + k)
            )
            tables.append(table)
        case = Case(plant, tables)
        return case, case.explain(plant, [], [])

    return refitted


def rhythm(case, e):
    """The likeliest rhythm in the colour of the residual."""
    return rhythms(metric_of(case, e, e.colours))[0]


def test_a_rhythm_is_found_with_its_period_though_its_phase_changes(block):
    def bursts(t, rng):
        return 0.1 * rng.standard_normal(len(t)) - 0.12 * ((t + rng.uniform(0, 240)) % 240 < 40)

    found = rhythm(*block(bursts))
    assert (
        found.log_p < -8
        and found.period == pytest.approx(240, rel=0.02)
        and "rhythm of 2" in found.sentence()
    )


@pytest.mark.parametrize("kind", KINDS)
def test_noise_of_any_colour_has_no_rhythm(block, kind):
    """Of twenty draws a colour the smallest p is what twenty of pure chance would show."""

    def noise(t, rng, seed):
        return 0.1 * noise_of(kind, len(t), np.random.default_rng([seed, *rng.integers(0, 9, 2)]))

    least = sorted(rhythm(*block(lambda t, rng, seed=seed: noise(t, rng, seed))).log_p for seed in range(20))
    assert least[0] > -3.5 and np.median(least) > -1


def test_what_white_noise_leaves_has_the_chance_that_is_told(block):
    """An unknown flow into the block, a function of time: uniform; and of all looks the one that remains is none."""
    told, left = [], []
    for seed in range(80):
        case, e = block(
            lambda t, rng, seed=seed: (
                0.1 * np.random.default_rng([seed, *rng.integers(0, 9, 2)]).standard_normal(len(t))
            )
        )
        told.append(10 ** next(s for s in suspects(metric_of(case, e, e.colours)) if s.kind == "node").log_p)
        left.append(e.white and remains(case, e))
    assert kstest(told, "uniform").pvalue > 0.01
    assert not any(left)


def test_little_that_remains_in_white_noise_is_seen(block):
    """A swing of an eighth of the noise, 6.6 sigmas in all, is none that could be colour."""
    case, e = block(lambda t, rng: 0.1 * rng.standard_normal(len(t)) + 0.012 * np.sin(2 * np.pi * t / 900))
    left = remains(case, e)
    assert e.white and left is not None and REMAINS < left.log_p < WHITE


@pytest.fixture
def three(tmp_path):
    """A plant with three outputs, two of them of one sensor."""
    path = tmp_path / "plant.yaml"
    path.write_text(
        "format: thermoctl-plant/1\ninputs: {P: {unit: W}}\nparameters: {C: {value: 30, unit: J/K}}\n"
        "nodes: {T: {unit: degC, storage: C, initial: 20}}\nflows: {heat: {into: T, rate: P, unit: W}}\n"
        "outputs: {a: {value: T, unit: degC}, b: {value: 2 * T, unit: degC}, c: {value: T, unit: degC, column: a}}\n"
    )
    return load(path)


def test_sensors_of_any_colour_share_nothing(three):
    """The chance that is told is uniform where there is nothing to find; gaps and a second recording do not matter."""
    told = []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        residuals = [
            np.stack([noise_of(rng.choice(KINDS), n, rng) for _ in range(3)], axis=1) for n in (3000, 2000)
        ]
        residuals[0][500:700, 0] = np.nan
        found = {s.name: s for s in together(residuals, channels(residuals, [1.0] * 3), three)}
        assert set(found) == {"a and b", "b and c"}  # a and c are of one sensor
        told.append(10 ** found["a and b"].log_p / found["a and b"].looks)
    assert kstest(told, "uniform").pvalue > 0.01


def test_what_two_sensors_share_is_no_noise_of_theirs(three):
    """A disturbance of 0.4 sigmas in one and, later and slower, in the other: each takes it for a sensor's colour."""
    rng = np.random.default_rng(0)
    wave = lfilter([0.1], [1, -0.95], rng.standard_normal(6000))
    r = rng.standard_normal((6000, 3)) + np.stack(
        [1.25 * wave, lfilter([0.05], [1, -0.95], np.roll(wave, 8)), 0 * wave], axis=1
    )
    colours = channels([r], [1.0] * 3)
    assert len(colours[0].ar) > 1
    best = together([r], colours, three)[0]
    assert best.name == "a and b" and best.log_p < -8 and "share" in best.sentence()
