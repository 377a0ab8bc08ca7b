"""An ambient that nobody recorded: the data tell conductance times temperature, only the prior tells the two apart."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plants import TWO_BLOCKS
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.search.beam import started
from thermoctl.diagnosis.search.refits import refitted
from thermoctl.diagnosis.search.screening import screened
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

WALL = 'flows:\n  wall: {from: one, rate: "0.004 * (one - 21 - 3 * sin(t / 900))", unit: W}\n'


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_its_refit_starts_where_it_gains_what_the_screening_promised(seed):
    """The loss absorbs the conductance: its sign was open, and a refit from a negative one stayed at none."""
    t, rng = np.arange(1500) * 4.0, np.random.default_rng(seed)
    heat = np.repeat(rng.uniform(0.0, 3.0, 15), 100)
    table = Table("run", "run", t, {"heat": heat, "air_temperature": np.full(1500, 21.0)})
    truth = loads(TWO_BLOCKS.replace("flows:\n", WALL))
    table = compile_plant(truth).measure(table, seed=seed)
    known = case(loads(TWO_BLOCKS), [table], catalogue(), Budget(80))
    null = started(known).best
    looked = screened(known, null.fitted)
    key = ("second_ambient", "one")
    promise, found = next((p, d) for d, p in looked.promised if d.candidate.key == key)
    assert found.start["G"] > 0
    assert abs(found.start["B"] - 21.0) < 30 and abs(found.start["D"]) < 30
    (f,) = refitted(known, null.fitted, looked, [((found,), promise)], null.fitted)
    gained = f.log_likelihood - null.fitted.log_likelihood
    assert gained > 0.7 * promise > 5.0
