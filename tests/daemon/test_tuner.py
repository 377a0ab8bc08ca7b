"""Online tuning has a way back: the model before is current again at the first disagreement, also after a restart."""

import dataclasses

import numpy as np
import pytest
from scipy import signal

from tests.identify.test_estimators import compensator, motion
from thermoctl.daemon import tuner
from thermoctl.identify import modelfile
from thermoctl.identify.online import Tuner
from thermoctl.rig.channels import DEFAULT
from thermoctl.rig.signals import AT, of_channels

ROW = of_channels(DEFAULT)
HOLD_S = 600
OLD = np.array([1.0, -0.7])  # the calibrated gains of two points, um/K
F = np.exp(-1 / 120)


def gain(model):
    return ((model.b1 + model.b2) / (1 - model.f1))[:2]


class Bench:
    """A rig's record rows, one a second, whose expansion has the gains that `run` is told."""

    def __init__(self, folder, monkeypatch):
        monkeypatch.setattr(tuner, "PROPOSE_S", 100.0)
        self.folder, self.said, self.at = folder, [], 0
        self.rises, _, self.rng = motion(30_000)
        self.model = dataclasses.replace(compensator([*OLD]), expansion_period_s=1.0)
        self.first = modelfile.install(folder, self.model, "bench")
        self.start()

    def start(self):
        """Begin as the daemon does: with the calibration that is current."""
        model = modelfile.load_model(self.folder)
        learner = Tuner(model, (1.0, 3.0, 5.0), 200, hold_s=HOLD_S)
        self.tuning = tuner.Tuning(model, "bench", self.folder, self.said.append, learner)

    def run(self, gains, seconds, reference=True):
        """Record `seconds`; stop when the tuner says something. Return whether it did."""
        self.error = signal.lfilter([0, 1 - F], [1, -F], self.rises @ gains)
        said, end = len(self.said), self.at + seconds
        while self.at < end and len(self.said) == said:
            part = slice(self.at, self.at + 50)
            rows = np.zeros((50, len(ROW)))
            rows[:, AT["t_s"]] = rows[:, AT["tick"]] = np.arange(part.start, part.stop)
            rows[:, AT["air_c"]] = rows[:, ROW.estimates] = 22.0
            rows[:, ROW.estimates][:, :2] += self.rises[part]
            rows[:, AT["output_reference_um"]] = self.error[part] + 0.01 * self.rng.standard_normal(50)
            if not reference:
                rows[:, AT["output_reference_um"]] = np.nan
            self.tuning.take(rows)
            self.at += 50
        return len(self.said) > said

    @property
    def current(self):
        return modelfile.current(self.folder)


@pytest.fixture
def bench(tmp_path, monkeypatch):
    return Bench(tmp_path / "models", monkeypatch)


NEW = np.array([1.2, -0.8])


@pytest.mark.parametrize("restarted", [False, True])
def test_the_model_before_is_back_at_the_first_disagreement(bench, restarted):
    assert bench.run(NEW, 9000) and "in use from the next start on" in bench.said[0]
    tuned = bench.current
    assert tuned != bench.first
    if restarted:
        bench.start()
        assert np.allclose(gain(bench.tuning.tuner.model), gain(modelfile.load_model(tuned)))
    else:
        assert not bench.run(OLD, HOLD_S // 2)  # too few samples to judge it
    assert bench.run(OLD, 4 * HOLD_S)
    assert f"{tuned}: " in bench.said[1] and f"{bench.first} is current again" in bench.said[1]
    assert bench.current == bench.first and gain(bench.tuning.tuner.model) == pytest.approx(OLD)
    # The next proposal is judged against the one that it came from, not against the one that was taken back.
    assert bench.run(NEW, 12_000) and bench.run(OLD, 4 * HOLD_S)
    assert f"{bench.first} is current again" in bench.said[3] and bench.current == bench.first


def test_a_model_that_goes_on_being_right_stays_and_is_not_asked_again(bench):
    assert bench.run(NEW, 9000)
    tuned = bench.current
    assert not bench.run(NEW, 4 * HOLD_S) and bench.current == tuned and bench.tuning.unproven is None


def test_nothing_is_proven_without_a_reference(bench):
    assert bench.run(NEW, 9000)
    tuned = bench.current
    assert not bench.run(OLD, 4 * HOLD_S, reference=False)
    assert bench.current == tuned and bench.tuning.unproven is not None
    assert bench.run(OLD, 4 * HOLD_S) and bench.current == bench.first
