"""Errors of an input's readings, which a body adds up, are no missing physics."""

import dataclasses

import numpy as np
import pytest

from tests.plants import WIDE_BLOCK
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.evidence.input_noise import scatter
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

ROWS = np.arange(1200)
SMOOTH = 20 + 12 * np.sin(ROWS / 40) + 5 * np.sin(ROWS / 17 + 1)


LINEAR = WIDE_BLOCK.replace("heat: {unit: W}", "heat: {unit: W, between_samples: linear}")


def recorded(heat, seed, plant=WIDE_BLOCK, step=5.0):
    """Return a recording of a block, T measured with the true heat (N,)."""
    table = Table(f"r{seed}", "", ROWS * step, {"heat": heat, "air": 22 + 0 * heat})
    return compile_plant(loads(plant)).measure(table, seed)


def result(plant, tables):
    return contract(diagnose(loads(plant), tables, catalogue(), limits()))


def noisy(seed, sd=1.0, plant=LINEAR):
    table = recorded(SMOOTH, seed, plant)
    read = SMOOTH + np.random.default_rng(100 + seed).normal(0, sd, len(ROWS))
    return dataclasses.replace(table, columns={**table.columns, "heat": read})


@pytest.mark.parametrize("plant", [WIDE_BLOCK, LINEAR], ids=["unstated", "linear"])
def test_noise_of_a_power_that_a_block_adds_up_is_no_other_heat(plant):
    """A second ambient or a heat source, above 0.99, followed the block's random walk."""
    found = result(plant, [noisy(1), noisy(2)])
    assert (found["verdict"], found["findings"]) == ("consistent", [])
    assert any("noise of heat" in note for note in found["notes"])


def test_what_is_missing_is_found_beside_a_noisy_power():
    """Radiation of a block: it is larger than what the noise moves."""
    glowing = LINEAR.replace(
        "outputs:",
        "  glow: {from: one, rate: 2e-9 * ((one + 273.15)**4 - (air + 273.15)**4), unit: W}\noutputs:",
    )
    found = result(LINEAR, [noisy(seed, 0.3, glowing) for seed in (1, 2)])
    assert any("radiation" in f["effect"] for f in found["findings"])


def test_late_rows_of_a_power_that_is_switched_are_no_missing_physics():
    """A brake's pulses, logged 0.04 s late (sd), were three false names above 0.99."""
    rng = np.random.default_rng(3)
    pulses = 40.0 * (ROWS % 50 < 10)
    table = recorded(pulses, 1, step=1.0)
    off = 0.04 * rng.standard_normal(len(ROWS)) * np.diff(pulses, prepend=pulses[:1])
    truth = recorded(pulses + off, 1, step=1.0)
    late = dataclasses.replace(table, columns={**table.columns, "T": truth.columns["T"]})
    found = result(WIDE_BLOCK, [late])
    assert (found["verdict"], found["findings"]) == ("consistent", [])


@pytest.mark.parametrize(
    "course",
    [
        np.sin(ROWS**2 / 3000),
        np.random.default_rng(1).integers(0, 2, len(ROWS)).astype(float),
        np.cumsum(np.random.default_rng(2).normal(size=len(ROWS))),
        np.repeat(np.random.default_rng(3).uniform(0, 9, len(ROWS) // 20), 20),
        0 * ROWS,
    ],
    ids=["sweep", "switched", "random walk", "held", "still"],
)
def test_a_course_that_is_not_smooth_is_no_noise(course):
    """A clean sweep was smoothed while a spring was missing, and then the truth could not fit."""
    assert scatter([course]) == 0.0


def test_the_scatter_about_a_smooth_course_is_known():
    noise = np.random.default_rng(4).normal(0, 0.3, len(ROWS))
    assert scatter([SMOOTH + noise]) == pytest.approx(0.3, rel=0.1)
