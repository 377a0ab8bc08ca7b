"""`thermoctl noise` finds the noise that a sensor was given, and the diagnosis reads it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from thermoctl.cli import main
from thermoctl.diagnosis.data.spectra import spectrum
from thermoctl.plant import load
from thermoctl.plant.language import SensorNoise
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table

PLANT = """format: thermoctl-plant/1
title: A block at rest
inputs:
  air: {unit: degC, role: ambient}
parameters:
  C: {value: 200.0, unit: J/K, range: [50, 800]}
  G: {value: 1.0, unit: W/K, range: [0.1, 10]}
nodes:
  block: {unit: degC, storage: C, initial: 20.0, initial_sigma: 0.5}
flows:
  loss: {from: block, rate: "G * (block - air)", unit: W}
outputs:
  temperature: {value: block, unit: degC, noise: 0.5}
"""


def recorded(
    folder, n: int, white: float, drift: float, tau: float, interval: float, seeds=(1, 2)
) -> list[str]:
    """Recordings of a block in still air, by an independent AR(1) recursion."""
    out = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        phi = np.exp(-interval / tau)
        slow = lfilter([1.0], [1.0, -phi], random.standard_normal(n + 2000) * drift * np.sqrt(1 - phi**2))[
            2000:
        ]
        y = 20.0 + slow + white * random.standard_normal(n)
        t = np.arange(n) * interval
        path = folder / f"quiet_{seed}.csv"
        write_table(path, Table("quiet", str(path), t, {"air": np.full(n, 20.0), "temperature": y}))
        out.append(str(path))
    return out


def test_a_white_and_a_slow_part_are_learnt_with_their_time(tmp_path, capsys):
    (tmp_path / "plant.yaml").write_text(PLANT)
    runs = recorded(tmp_path, 6000, 0.05, 0.04, 60.0, 1.0)
    status = main(
        ["noise", "--plant", str(tmp_path / "plant.yaml"), "--out", str(tmp_path / "out.yaml"), *runs]
    )
    assert status == 0
    noise = load(tmp_path / "out.yaml").outputs["temperature"].noise
    assert isinstance(noise, SensorNoise)
    assert noise.white == pytest.approx(0.05, rel=0.1)
    assert noise.drift == pytest.approx(0.04, rel=0.3)
    assert noise.time == pytest.approx(60.0, rel=0.5)
    assert "0.5" in capsys.readouterr().out


def test_white_noise_is_learnt_as_white(tmp_path):
    (tmp_path / "plant.yaml").write_text(PLANT)
    runs = recorded(tmp_path, 3000, 0.05, 0.0, 60.0, 1.0)
    main(["noise", "--plant", str(tmp_path / "plant.yaml"), "--out", str(tmp_path / "out.yaml"), *runs])
    noise = load(tmp_path / "out.yaml").outputs["temperature"].noise
    assert noise.drift is None and noise.flicker is None
    assert noise.white == pytest.approx(0.05, rel=0.05)


def test_the_spectrum_of_a_first_order_part_is_that_of_its_samples():
    random, phi, n = np.random.default_rng(5), 0.9, 4096
    sensor = SensorNoise(0.3, drift=1.0, time=-1.0 / np.log(phi))
    from scipy.fft import dct

    powers = np.zeros(n)
    for _ in range(200):
        slow = lfilter([1.0], [1.0, -phi], random.standard_normal(n + 500) * np.sqrt(1 - phi**2))[500:]
        powers += dct(slow + 0.3 * random.standard_normal(n), norm="ortho") ** 2 / 200
    f = np.arange(n) / (2 * n)
    expected = spectrum(sensor, np.maximum(f, 0.25 / n), 1.0)
    bands = np.array_split(np.arange(8, n), 40)
    ratio = [powers[b].mean() / expected[b].mean() for b in bands]
    assert np.allclose(ratio, 1.0, atol=0.06)


def test_too_few_values_are_refused_with_their_number(tmp_path, capsys):
    (tmp_path / "plant.yaml").write_text(PLANT)
    runs = recorded(tmp_path, 60, 0.05, 0.0, 60.0, 1.0, seeds=(1,))
    status = main(
        ["noise", "--plant", str(tmp_path / "plant.yaml"), "--out", str(tmp_path / "out.yaml"), *runs]
    )
    assert status == 2
    assert "60 measured values" in capsys.readouterr().err
    assert not (tmp_path / "out.yaml").exists()
