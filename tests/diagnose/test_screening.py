"""What the screening promises: also of a slow effect that a remainder may hide, and of a period that passes quickly."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from tests.plants import ONE_BLOCK, SPRING_STAGE, TWO_BLOCKS
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.evidence.levels import over_noise
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.report.unseen import not_seen
from thermoctl.diagnosis.search.beam import Search, started
from thermoctl.diagnosis.search.refits import refitted
from thermoctl.diagnosis.search.screening import LOUD, Screened, screened
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def looked_at(plant: str, table: Table) -> tuple[Search, Screened]:
    """The search with the plant alone, and its screening."""
    known = case(loads(plant), [table], catalogue(), Budget(80))
    search = started(known)
    return search, screened(known, search.best.fitted)


def promise(looked: Screened, effect: str, where: str) -> float:
    """The predicted gain in log likelihood of an effect at a place; 0 where it promises none."""
    return max((p for d, p in looked.promised if d.candidate.key == (effect, where)), default=0.0)


def test_a_remainder_does_not_hide_a_slow_effect_from_the_screening():
    """In the metric with the remainder an offset step of 17 000 in energy promised four nats, and was not refitted."""
    t, rng = np.arange(2000) * 4.0, np.random.default_rng(1)
    heat = np.repeat(rng.uniform(0.0, 3.0, 20), 100)
    truth = compile_plant(loads(TWO_BLOCKS))
    table = truth.measure(
        Table("run", "run", t, {"heat": heat, "air_temperature": np.full(len(t), 21.0)}), seed=1
    )
    table.columns["temperature_1"] = table.columns["temperature_1"] - 0.2 * (t > 4000)
    search, looked = looked_at(TWO_BLOCKS, table)
    null = search.best.fitted
    assert max(null.average.remainder) > 0.5 and max(over_noise(search.case, null)) < LOUD
    assert promise(looked, "sensor_offset_step", "temperature_1") > 20


@pytest.mark.slow
def test_an_error_that_repeats_quickly_in_time_is_seen_whatever_its_number_of_periods():
    """Its 30 periods of the scale pass within a block of samples: their rows are above those of the screening."""
    t = np.arange(48_000) * 0.001
    force = 8.0 * np.sin(2 * np.pi * 5.0 * t)
    table = compile_plant(loads(SPRING_STAGE)).measure(Table("run", "run", t, {"force": force}), seed=1)
    x = table.columns["encoder"]
    period = np.ptp(x) / 30
    table.columns["encoder"] = x + 1e-7 * np.sin(2 * np.pi * x / period)
    _, looked = looked_at(SPRING_STAGE, table)
    assert promise(looked, "cyclic_error", "encoder") > 10


def test_a_jump_promises_what_its_refit_gains_between_the_times_of_the_grid():
    """At the nearest of the grid's times it promised a tenth, and two false names were as good."""
    t = np.arange(0.0, 7200.0, 10.0)
    drives = {"heat": 1 + (np.sin(t / 700) > 0), "air_temperature": 21 + t / 7200}
    table = compile_plant(loads(TWO_BLOCKS)).measure(Table("run", "run", t, drives), seed=2)
    table.columns["temperature_1"] = table.columns["temperature_1"] + 0.7 * (t > 4010)
    search, looked = looked_at(TWO_BLOCKS, table)
    found = next(d for d, _ in looked.promised if d.candidate.key == ("sensor_offset_step", "temperature_1"))
    assert abs(found.shape["onset"] - 4015) <= 10
    (refit,) = refitted(search.case, search.best.fitted, looked, [((found,), 0.0)], search.best.fitted)
    gained = refit.log_likelihood - search.best.fitted.log_likelihood
    assert 0.7 * gained < promise(looked, "sensor_offset_step", "temperature_1") < 1.5 * gained


def test_a_plant_without_unknowns_is_screened_and_refitted():
    """Nothing of it is free, not even a start: the plant alone ended in an IndexError."""
    known = re.sub(", range: [^}]*|, initial_sigma: 0.5", "", TWO_BLOCKS)
    t = np.arange(400) * 10.0
    table = Table("run", "run", t, {"heat": 1 + (np.sin(t / 300) > 0), "air_temperature": np.full(400, 21.0)})
    table = compile_plant(loads(known)).measure(table, seed=1)
    table.columns["temperature_2"] = table.columns["temperature_2"] + 0.3
    search, looked = looked_at(known, table)
    assert not search.best.fitted.fit.model.unknowns
    assert (
        promise(looked, "sensor_drift", "temperature_2")
        + promise(looked, "sensor_offset_step", "temperature_2")
        > 20
    )


def test_detection_limits_are_those_of_the_screening_whatever_refit_is_closest():
    """Where not all columns were screened, their noise was that of the refit that the result shows."""
    plant, t = loads(ONE_BLOCK), np.arange(400.0)
    heat = np.repeat([12.0, 0.0, 12.0, 12.0, 0.0], 80)
    table = compile_plant(plant).measure(Table("run", "run", t, {"heat": heat, "air": 20 + 0 * t}), seed=1)
    found = diagnose(plant, [table], catalogue(), limits(), ())
    average = found.null.average
    louder = dataclasses.replace(average, inverse=[v / 4 for v in average.inverse])
    other = dataclasses.replace(
        found,
        searched=dataclasses.replace(found.searched, norms=()),
        null=dataclasses.replace(found.null, average=louder),
    )
    assert len(not_seen(found)) > 10 and not_seen(other) == not_seen(found)
