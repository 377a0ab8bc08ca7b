"""Tunes on loops of known truth: what is written is stable and no worse, what is no test is refused, what surprises is taken back."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tune import prove
from tests.tune.rig import LoopRig, Truth, settings_of
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.tune import Disagrees, tune
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import tuning
from thermoctl.identify.measured_loop import Timing
from thermoctl.rig.option import LIVE_STEP, TRIAL_FACTOR
from thermoctl.rig.signals import INDEX
from thermoctl_hal.base.backend import HardwareError

ROWS = max(INDEX.values()) + 1


def tuned(rig, said=None):
    return tune(rig, True, Keyboard(False), (said if said is not None else []).append)


@pytest.mark.parametrize("seed", [1])
def test_no_tune_is_written_unstable_or_leaves_the_loop_worse(seed, tmp_path):
    """A sample of `make prove-tune`."""
    results = [prove.run(case, k, tmp_path) for k, case in enumerate(prove.cases(4, seed))]
    assert not any(r.unstable or r.worse for r in results), prove.table(results)
    assert any(r.outcome == "written" for r in results)


def test_a_loop_that_skips_ticks_is_not_tuned(tmp_path):
    """The loop of which 9 % of the ticks were skipped and whose gains diverged in 0.16 s; nothing was tried on it."""
    truth = Truth(t1_s=0.015, dead_s=0.003, command_hz=200, skips=0.09)
    rig = LoopRig(settings_of(tmp_path, truth, 0.0005, 0.01, 0.0), truth)
    with pytest.raises(
        InputError, match=r"of \d+ ticks \d+ were skipped.*at most 1 % were expected.*loop.priority"
    ):
        tuned(rig)
    assert rig.sessions == 2, "the look at the position, and one test"


def test_slow_commands_are_dead_time_and_no_gain_grows_by_more_than_the_factor(tmp_path):
    truth = Truth(t1_s=0.015, dead_s=0.003, command_hz=200)
    said: list[str] = []
    found = tuned(LoopRig(settings_of(tmp_path, truth, 0.0005, 0.01, 0.0), truth), said)
    assert found.plant.theta_s >= 0.5 * (0.006 - truth.period_s), (
        "200 Hz at ticks of 2 ms: a command every third tick"
    )
    assert found.proposed.kp == pytest.approx(TRIAL_FACTOR * 0.0005) and found.proposed.td_s == 0.0
    assert any("run it again" in line and "factor of 3" in line for line in said)
    assert not any("inf" in line for line in said)


class ChangesMeanwhile(LoopRig):
    """A rig that is another one from its third session on: after the look at the position and the first test."""

    later = Truth()

    def simulation(self, settings, model=None):
        if self.sessions >= 2:
            self.truth = self.later
        return super().simulation(settings, model)

    def run(self, *args, gains=None, **more):
        self.tried = [*getattr(self, "tried", []), gains]
        yield from super().run(*args, gains=gains, **more)


@pytest.mark.parametrize(
    "change, error, words",
    [
        ({"dead_s": 0.012}, Disagrees, "measured, at least .* predicted"),
        ({"gain": 2500.0}, HardwareError, "the error grew|ended after|predicted"),
        ({"skips": 0.1}, InputError, "were skipped"),
        ({"noise_um": 3.0}, HardwareError, "not known well enough|the error grew"),
    ],
    ids=["longer dead time", "larger gain", "skipped ticks", "noise"],
)
def test_the_old_gains_stay_at_the_first_disagreement(change, error, words, tmp_path):
    truth = Truth(dead_s=0.002, command_hz=500)
    rig = ChangesMeanwhile(settings_of(tmp_path, truth, 0.002, 0.01, 0.0), truth)
    rig.later = dataclasses.replace(truth, **change)
    with pytest.raises(
        error, match=rf"step 1 of \d .*({words}).*the gains of before are in force, nothing was written"
    ):
        tuned(rig)
    assert len(rig.tried) == 2 and rig.tried[0] is None, "no further step after the first disagreement"


@given(
    st.tuples(*(st.floats(1e-4, 1.0) for _ in range(3))),
    st.tuples(*(st.floats(1e-4, 1.0) for _ in range(3))),
    st.booleans(),
)
def test_a_way_is_of_small_steps_within_the_factor(present, wanted, derivative):
    a = tuning.Gains(*present[:2], present[2] if derivative else 0.0, "present")
    b = tuning.within_factor(a, tuning.Gains(*wanted[:2], wanted[2] if derivative else 0.0, "wanted"))
    steps = [a, *tuning.way(a, b)]
    assert steps[-1] == b and len(steps) <= 4
    for one, other in zip(steps, steps[1:], strict=False):
        for name in ("kp", "ti_s", "td_s"):
            x, y = getattr(one, name), getattr(other, name)
            assert x == y or 1 / (LIVE_STEP * 1.0001) <= y / x <= LIVE_STEP * 1.0001
            assert getattr(a, name) == 0 or 0.3333 <= y / getattr(a, name) <= 3.0001


def rows(n, period_s, slips=0, late=0, lost=0):
    found = np.zeros((n + lost, ROWS))
    k = np.arange(n + lost)
    found[:, INDEX["tick"]], found[:, INDEX["dt_s"]] = k, period_s
    found[-1, INDEX["slips"]] = slips
    found[1 : 1 + late, INDEX["lateness_us"]] = 0.6e6 * period_s
    found[1:, INDEX["dt_s"]] += 1e-6 * np.diff(found[:, INDEX["lateness_us"]])
    return np.delete(found, slice(5, 5 + lost), axis=0)


@pytest.mark.parametrize("bad", ["slips", "late", "lost"])
def test_ticks_that_were_skipped_late_or_lost_are_counted(bad):
    Timing.of(rows(1000, 0.001, **{bad: 10}), 0.001).check()
    worse = Timing.of(rows(1000, 0.001, **{bad: 11}), 0.001)
    with pytest.raises(InputError, match="11 "):
        worse.check()
