"""Rates of temperatures as buses deliver them: answers in close order, coarse digits, late answers; and real jumps.

The limits are those of config/wire.yaml, which a new rig starts with.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.limits import OFF
from thermoctl.control import arming, faults
from thermoctl.control.law import WARM_UP_TICKS, Law
from thermoctl.control.model import Parameters, zero_model
from thermoctl.rig.channels import CHANNELS

P, AIR, COIL = 0.001, CHANNELS.index("air_c"), CHANNELS.index("coil_c")
LIMIT = {AIR: 5.0, COIL: 20.0}  # K/s


class Bench:
    """An armed law whose air and coil readings arrive when `deliver` says so."""

    def __init__(self, start=24.0):
        n = len(CHANNELS)
        rate, required = np.full(n, np.inf), np.zeros(n)
        for c, limit in LIMIT.items():
            rate[c], required[c] = limit, 1.0
        self.law = Law(zero_model(P), Parameters(0.0, 1.0, 0.0, 1.0, rate=rate, required=required, **OFF), P)
        self.value, self.fresh = np.zeros(n), np.zeros(n, np.uint8)
        self.status, self.delay = np.full(n, 3, np.uint8), np.zeros(n, np.uint8)
        self.law.bind(self.value, self.fresh, self.status, self.delay)
        self.ticks = 0
        for c in (AIR, COIL):
            self.status[c] = 0
        self.run({0: start}, WARM_UP_TICKS + 5)
        self.law.step(P, arming.ARM)
        assert self.law.state == arming.ARMED

    def run(self, readings, ticks, delays=()):
        """`readings`: tick -> value of both channels. The tick in which a fault is shown, None where there is none."""
        for k in range(ticks):
            for c in (AIR, COIL):
                self.fresh[c] = k in readings
                if k in readings:
                    self.value[c] = readings[k]
                    self.delay[c] = dict(delays).get(k, 0)
            self.law.step(P, arming.NONE)
            if self.law.outputs[1]:
                return k
        return None


@pytest.mark.parametrize("step,apart", [(0.0418, 2), (0.1, 4), (0.25, 12), (0.25, 1), (0.5, 1), (0.0418, 1)])
def test_a_step_of_one_digit_is_no_jump_however_close_the_readings(step, apart):
    """Pairs of readings `apart` ms, ten a second, up and down by one step: an hour of them in 60 s of ticks."""
    bench, readings, value = Bench(), {}, 24.0
    random = np.random.default_rng(1)
    for k in range(600):
        readings[100 * k] = value
        value += (
            step * random.choice([-1.0, 0.0, 1.0])
            if abs(value - 24.0) < 2.0
            else np.sign(24.0 - value) * step
        )
        readings[100 * k + apart] = value
    assert bench.run(readings, 60_000) is None


@pytest.mark.parametrize("digit", [0.0209, 0.1, 0.25])
def test_jittering_answers_do_not_trip(digit):
    """10 Hz asked, each answer 5 to 300 ms late, a coil that heats with 0.4 K/s, noise of half a digit: ten minutes."""
    bench, readings, now = Bench(round(24.0 / digit) * digit), {}, 0.0
    random = np.random.default_rng(2)
    while now < 600.0:
        asked = now
        now = asked + random.uniform(0.005, 0.3)
        true = 24.0 + 0.4 * 10.0 * np.sin(asked / 10.0) + 0.5 * digit * random.normal()
        readings[round(now * 1000)] = round(true / digit) * digit
        now = max(now, asked + 0.1)
    assert bench.run(readings, 600_000) is None


@pytest.mark.parametrize("batch", [2, 3, 5])
def test_readings_held_back_and_delivered_together_do_not_trip(batch):
    """An adapter that holds lines back: a few readings of 10 Hz arrive one a tick, 0.25 K from one to the next."""
    bench, readings = Bench(), {}
    for k in range(300):
        for j in range(batch):
            readings[100 * batch * k + j] = 24.0 + 0.25 * ((k * batch + j) % 2)
    assert bench.run(readings, 30_000 * batch) is None


@pytest.mark.parametrize(
    "name,value,before",
    [
        ("connectors swapped, 30 K", lambda t: 54.0, 1),
        ("connectors swapped, -12 K", lambda t: 12.0, 1),
        ("thermocouple opens, ramp of 100 K/s", lambda t: 24.0 + 100.0 * t, 1),
        ("thermocouple opens, ramp of 30 K/s", lambda t: 24.0 + 30.0 * t, 1),
    ],
)
def test_a_real_jump_is_found_by_the_second_reading(name, value, before):
    """`before`: readings until the law of the version before tripped; it takes one more, 0.1 s."""
    bench = Bench()
    readings = {100 * k: 24.0 if k < 5 else value((k - 4) * 0.1) for k in range(20)}
    found = bench.run(readings, 2000)
    print(f"{name}: {before * 100} ms before, {found - 400} ms now")
    assert found == 400 + 100 * (before + 1)
    assert bench.law.state == arming.FAULT and {f.name for f in faults.decode(bench.law.outputs[1])} >= {
        "air_rate"
    }


def test_a_single_outlier_is_not_used_and_does_not_trip():
    bench = Bench()
    readings = {100 * k: 24.0 for k in range(20)} | {500: 80.0}
    assert bench.run(readings, 2000) is None and bench.law.last[COIL] == 24.0


def test_late_samples_count_by_the_time_they_were_taken():
    """Two samples 0.3 s apart that arrive 5 ms apart: 1.2 K are 4 K/s of air, below the limit; as 5 ms they are not."""
    for delays, fine in (({400: 12}, True), ({}, False)):
        bench = Bench()
        readings = {0: 24.0, 400: 24.0, 405: 25.2}
        bench.run(readings, 406, delays)
        assert (bench.law.suspect[AIR] == 0.0) == fine
