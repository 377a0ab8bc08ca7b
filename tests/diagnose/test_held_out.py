"""Held-out data speak against findings only where their errors are larger by more than chance."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from thermoctl.diagnosis.evidence.held_out import worse


def errors(seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return two recordings' errors of two outputs, coloured, and the pattern of an effect that is not there."""
    rng = np.random.default_rng(seed)
    coloured = lfilter([1.0], [1.0, -0.9], rng.standard_normal((2, 2000, 2)), axis=1)
    return list(coloured * [1.0, 50.0]), np.sin(np.arange(2000) / 60.0)[:, None] * [1.0, 50.0]


@pytest.mark.parametrize("effect", [0.02, 0.1])
def test_two_predictions_that_err_alike_are_told_apart_by_chance_only(effect):
    """Both err by half of an effect. By the ratio of the errors alone, the findings lost half of the cases."""
    found = []
    for seed in range(300):
        noise, pattern = errors(seed)
        found.append(
            worse([e + effect * pattern / 2 for e in noise], [e - effect * pattern / 2 for e in noise])
        )
    assert 0.03 < np.mean(np.array(found) >= 0.9) < 0.17
    assert 0.4 < np.mean(found) < 0.6


@pytest.mark.parametrize("effect", [1.0, 3.0])
def test_an_effect_that_is_not_there_makes_a_prediction_worse(effect):
    noise, pattern = errors(3)
    added = [e + effect * pattern for e in noise]
    assert worse(noise, added) > 0.95
    assert worse(added, noise) < 0.05


def test_a_simulation_that_fails_is_worse_and_a_cell_that_is_missing_is_not():
    noise, pattern = errors(3)
    cells = [np.where(np.arange(2000)[:, None] % 7 == 0, np.nan, e) for e in noise]
    assert worse([e + pattern for e in cells], cells) < 0.1
    assert worse(noise, [np.full_like(noise[0], np.nan), noise[1]]) == 1.0


def test_an_output_that_no_recording_measured_says_nothing():
    noise, pattern = errors(3)
    unseen = [np.column_stack([e, np.full(len(e), np.nan)]) for e in noise]
    after = [np.column_stack([e + pattern, np.full(len(e), np.nan)]) for e in noise]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert worse(unseen, after) == worse(noise, [e + pattern for e in noise])
        assert worse(unseen, unseen) == 0.0
