"""The recorder's watch of the model: innovations in, an alarm out, and never a row lost for it."""

import dataclasses
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.daemon.conftest import make_model
from tests.limits import OFF
from thermoctl.control.model import Parameters, zero_model
from thermoctl.daemon.misfit import BLOCK_S, Misfit
from thermoctl.daemon.recorder import Recorder
from thermoctl.daemon.tick.shared import RECORDER_ROWS, Shared
from thermoctl.rig.signals import INDEX, SIGNALS

SIGMA = np.sqrt(make_model().R_v)


def innovations(shift, seconds=2000.0, held=10, seed=1):
    """t, innovation and gain of 100 Hz rows that hold each of the sensor's samples `held` rows; `shift` sigma on the last third."""
    t = np.arange(0.0, seconds, 0.01)
    e = np.repeat(np.random.default_rng(seed).normal(0.0, SIGMA, len(t) // held + 1), held)[: len(t)]
    e[:5] = np.nan  # no sample yet
    return t, e + shift * SIGMA * (t > 2 * seconds / 3), np.full(len(t), 0.1)


@settings(deadline=None)
@given(st.lists(st.integers(1, 60_000), min_size=1, max_size=30), st.sampled_from([0.0, 1.0, -2.0]))
def test_how_the_rows_are_cut_into_calls_does_not_matter(sizes, shift):
    t, e, k = innovations(shift)
    whole, cut = Misfit(make_model()), Misfit(make_model())
    at_once, alarms = whole.add(t, e, k), []
    for begin, end in zip([0, *np.cumsum(sizes)], [*np.cumsum(sizes), len(t)], strict=True):
        alarms.append(cut.add(t[begin:end], e[begin:end], k[begin:end]))
    alarms = [a for a in alarms if a is not None]
    assert alarms[-1:] == ([] if at_once is None else [at_once]) and bool(alarms) == (shift != 0.0)
    assert cut.sums == whole.sums and cut.alarmed == whole.alarmed


def test_rows_one_by_one_and_a_clock_that_begins_again():
    t, e, k = innovations(2.0, seconds=600.0)
    whole, each = Misfit(make_model()), Misfit(make_model())
    found = whole.add(t, e, k)
    assert [
        a
        for a in (each.add(t[n : n + 1], e[n : n + 1], k[n : n + 1]) for n in range(len(t)))
        if a is not None
    ] == [found]
    assert found.begin_s == pytest.approx(400.0, abs=2 * BLOCK_S)
    fresh = Misfit(make_model())
    fresh.add(t, e, k)
    whole.add(
        np.concatenate((t, t)), np.concatenate((e, e)), np.concatenate((k, k))
    )  # twice the same: begun anew each time
    assert whole.sums == fresh.sums and whole.alarmed


def test_a_rig_without_a_model_is_never_told_that_its_model_is_wrong():
    t, e, k = innovations(50.0)
    assert Misfit(zero_model()).add(t, e + 5.0, k) is None


@pytest.mark.parametrize("gain", [np.nan, np.inf, 1.0 / make_model().gain[0, 0], -1.0])
def test_a_gain_that_no_filter_has_is_not_used(gain):
    t, e, _ = innovations(0.0)
    assert Misfit(make_model()).add(t, e, np.full(len(t), gain)) is None
    t, e, _ = innovations(2.0)
    assert Misfit(make_model()).add(t, e, np.full(len(t), gain)) is not None


def test_only_nan_and_no_rows():
    watch = Misfit(dataclasses.replace(make_model(), R_v=5e-324))
    assert watch.add(np.arange(99.0), np.full(99, np.nan), np.zeros(99)) is None
    assert watch.add(np.empty(0), np.empty(0), np.empty(0)) is None
    assert watch.add(np.arange(9999.0), np.arange(9999.0) % 2 * 1e100, np.zeros(9999)) is not None


class Kept:
    """A writer that keeps the rows."""

    full = False

    def __init__(self):
        self.rows = []

    def write(self, rows):
        self.rows.extend(rows[:, INDEX["tick"]].tolist())
        return 0

    def close(self):
        return 0


def test_a_watch_that_fails_loses_no_row():
    shared, writer, told = Shared.create(f"thermoctl-recorder-{os.getpid()}"), Kept(), []
    try:
        recorder = Recorder(
            shared,
            make_model(),
            Parameters(kp=0.0, ti_s=1.0, td_s=0.0, output_limit=1.0, **OFF),
            1e-3,
            lambda law: writer,
            lambda event, **more: told.append(event),
        )

        def fails(*_):
            raise ZeroDivisionError

        recorder.misfit.add = fails
        row = np.zeros(len(SIGNALS))
        for tick in range(1, 501):
            row[INDEX["tick"]] = tick
            shared.ring.write(row)
            if tick % 50 == 0:
                assert recorder.move() == 50
        assert writer.rows == list(range(1, 501)) and shared.counters[RECORDER_ROWS] == 500
        assert told == ["the check of the model failed and is switched off; recording continues"]
    finally:
        shared.remove()
