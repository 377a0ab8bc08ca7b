"""The open world: small misfits are as large as asked, change the truth only, and are drawn again from the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.concealed.generate import Bench
from tests.concealed.judge import snr
from tests.concealed.open_world import JITTER, TOP, _late, misfits_of, open_world, readings
from tests.concealed.rigs_motion import FreeStage
from tests.concealed.rigs_thermal import Heater


@pytest.mark.parametrize("signal", [4.0, 40.0])
@pytest.mark.parametrize("family", [Heater(), FreeStage()], ids=lambda f: f.name)
def test_misfits_leave_the_share_that_was_asked(family, signal):
    """A free carriage integrates every error: its misfits are far smaller than typical ones."""
    scene = family.scene(np.random.default_rng(4), "designed", True)
    bench = Bench(scene, np.random.default_rng(5))
    bench.measure([])
    recorded = [{c: run[k].copy() for c, k in scene.columns.items()} for run in scene.runs]
    plain = bench.readings([])
    world = open_world(scene, bench, [], plain, signal, np.random.default_rng(6))
    left = float(
        snr(
            bench.judge.left_over(
                bench.judge.whiten([(a - b)[None] for a, b in zip(world.runs, plain, strict=True)])
            )
        )[0]
    )
    assert left == pytest.approx(world.told["misfit_snr"], abs=0.01)
    assert 0.03 * signal / 1.3 < left < 0.5 * signal * 1.3 or world.told["misfit_size"] == TOP
    for run, before in zip(scene.runs, recorded, strict=True):
        for column, key in scene.columns.items():
            np.testing.assert_array_equal(run[key], before[column])
    again = open_world(scene, bench, [], plain, signal, np.random.default_rng(6))
    np.testing.assert_array_equal(world.runs[0], again.runs[0])


def test_a_clock_that_jitters_makes_no_larger_misfit_than_was_asked():
    """2 % of a period at random: an axis integrates its force over wrong times, and errs by hundreds of sigmas."""
    scene = FreeStage().scene(np.random.default_rng(4), "designed", True)
    bench = Bench(scene, np.random.default_rng(5))
    bench.measure([])
    plain, t = bench.readings([]), scene.runs[0]["t"]
    late = _late(scene, bench, JITTER, np.random.default_rng(8))
    assert late > 20.0
    assert _late(scene, bench, JITTER / 10, np.random.default_rng(8)) == pytest.approx(late / 10, rel=0.2)
    worlds = (open_world(scene, bench, [], plain, 10.0, np.random.default_rng(seed)) for seed in range(40))
    world = next(w for w in worlds if w.clock_jitter)
    assert world.clock_jitter < JITTER and world.told["clock_snr"] == 5.0
    assert scene.runs[0]["t"] is t


def test_every_misfit_of_a_heater_changes_its_readings():
    scene = Heater().scene(np.random.default_rng(4), "designed", True)
    plain = readings(scene, [], [], 1.0)
    for misfit in misfits_of(scene, np.random.default_rng(7)):
        moved = readings(scene, [], [misfit], 1.0)
        assert max(np.abs(a - b).max() for a, b in zip(moved, plain, strict=True)) > 1e-3, misfit.kind
