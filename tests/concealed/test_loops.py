"""The compiled loops of the truths against the same loops in Python: every effect, every parameter, every start."""

from __future__ import annotations

import numpy as np
import pytest

from tests.concealed import generate, rigs_motion, rigs_tanks, rigs_thermal, sensors, thermal
from tests.concealed.same_cases import differences, loops_in_python
from tests.concealed.thermal import Variant

SAMPLES = 120  # of each run that the loops in Python are compared on


def variants(scene) -> list[Variant]:
    """The truth alone, with each parameter and each start moved, and with each effect and unknown at a common size."""
    moved = [Variant({p: scene.theta[p] * 1.1}) for p in scene.ranges]
    started = [Variant(start={n: 2 * sd}) for n, sd in scene.starts.items()]
    faulty = [Variant(effects=[(s.effect, s.where, s.make(1.0))]) for s in scene.suspects + scene.unknowns]
    return [Variant(), *moved, *started, *faulty]


def cut(run: dict, step: int, first: int = 0) -> dict:
    """A run of SAMPLES: every `step`th sample, or a window that begins at `first`."""
    n = len(run["t"])
    return {
        k: x[first::step][:SAMPLES].copy() if isinstance(x, np.ndarray) and len(x) == n else x
        for k, x in run.items()
    }


def agree(one, other, scale, within=1e-9) -> None:
    """Equal to `within` of the scale; what runs away does so in both."""
    assert np.array_equal(np.isfinite(one), np.isfinite(other))
    fine = np.isfinite(one)
    assert np.abs(one[fine] - other[fine]).max() < within * scale


@pytest.mark.parametrize("family", ["heater", "drive", "actuator"])
def test_thermal_networks(family, monkeypatch):
    """The whole of a run at a coarser step, so that every onset is in it."""
    seen = []

    def both(net, theta, run, rows):
        short = cut(run, len(run["t"]) // SAMPLES)
        one = thermal.simulate(net, theta, short, rows)
        with loops_in_python():
            other = thermal.simulate(net, theta, short, rows)
        agree(one, other, 10.0)
        seen.append(len(np.unique(one[:, -1], axis=0)))
        return np.zeros((len(rows), len(run["t"]), len(net.bodies)))

    scene = generate.FAMILIES[family].scene(np.random.default_rng(4), "designed", True)
    monkeypatch.setattr(rigs_thermal, "simulate", both)
    rows = variants(scene)
    scene.outputs_of(0, rows)
    assert seen[-1] > len(rows) / 3  # most rows end elsewhere; faults of sensors do not


@pytest.mark.parametrize("family", ["stage", "flexure"])
@pytest.mark.parametrize("schedule", ["designed", "warm-up"])
def test_motion(family, schedule):
    """A window of a run from where the drive is on."""
    scene = generate.FAMILIES[family].scene(np.random.default_rng(4), schedule, True)
    rows, run = variants(scene), scene.runs[0]
    busy = int(np.argmax(np.abs(run["drive"]) > 0.5 * np.abs(run["drive"]).max()))
    short = cut(run, 1, max(busy - 10, 0))
    one = rigs_motion.simulate(scene.theta, short, rows)
    with loops_in_python():
        other = rigs_motion.simulate(scene.theta, short, rows)
    for k, x in one.items():
        agree(x, other[k], max(np.ptp(other[k][0]), 1e-9))
    assert len(np.unique(one["velocity"][:, -1])) > len(rows) / 3  # faults of sensors change no motion


def test_tanks():
    scene = generate.FAMILIES["tanks"].scene(np.random.default_rng(4), "designed", True)
    rows = variants(scene)
    one = scene.outputs_of(0, rows)
    with loops_in_python():
        other = scene.outputs_of(0, rows)
    agree(
        one, other, 1.0, 1e-6
    )  # a rounding changes steps of LSODA, which is itself right to 1e-7 at an overflow
    assert len(np.unique(one[:, -1, 0])) > len(rows) / 2
    assert rigs_tanks.rate_of is not rigs_tanks.rate_in_python


def test_a_lag():
    rng = np.random.default_rng(2)
    t, y = np.cumsum(rng.uniform(0.5, 2, 300)), rng.standard_normal(300)
    one = sensors.lag(t, y, 3.0)
    with loops_in_python():
        assert np.allclose(one, sensors.lag(t, y, 3.0), rtol=1e-13, atol=1e-13)


def test_whole_cases_have_the_same_numbers():
    for family, kind in (("tanks", "none"), ("heater", "none")):
        words = f"--number 1 --seed 5 --families {family} --kind {kind} --world open --smoke".split()
        assert [what for _, what in differences(words)] == [None]


@pytest.mark.slow
@pytest.mark.parametrize("family", list(generate.FAMILIES))
def test_whole_cases_with_an_effect_have_the_same_numbers(family):
    words = f"--number 2 --seed 5 --families {family} --kind one --world both --smoke".split()
    assert [what for _, what in differences(words)] == [None, None]
