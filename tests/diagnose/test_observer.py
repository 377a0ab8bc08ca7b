"""A plant that an observer holds to its recording follows it, although physics is missing."""

from __future__ import annotations

import numpy as np

from tests.plants import FREE_CARRIAGE, ONE_BLOCK
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.search import beam as search
from thermoctl.diagnosis.search.observer import drifts, held, linear
from thermoctl.plant import loads
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.table import Table

RUBBED = FREE_CARRIAGE.replace(
    "travel:", "rub: {from: velocity, rate: 3.0 * tanh(velocity / 0.0005), unit: N}\n  travel:"
)


def _recorded() -> Table:
    """A carriage with dry friction, 8 s."""
    t = np.arange(4000) * 0.002
    force = np.interp(t, np.arange(0, 9, 0.4), np.random.default_rng(1).uniform(-8, 8, 23))
    table = Table("run", "run", t, {"force": force, "encoder": np.zeros(len(t))})
    return compile_plant(loads(RUBBED)).measure(table)


def test_an_observer_holds_a_carriage_whose_friction_is_missing_and_is_no_place_of_physics():
    plant, table = loads(FREE_CARRIAGE), _recorded()
    model = compile_plant(plant)
    drives = [model.excitation(table)]
    noise = default_noise(plant, drives)
    null = fit(model, drives, noise)
    about = linear(null, drives)
    assert about is not None and drifts(about, 8.0)
    free = float(np.sqrt(np.mean(null.residuals[0] ** 2)))
    sizes = []
    for trust in (0.01, 0.1):
        followed = held(plant, about, noise, 0.002, trust)
        assert followed is not None
        other = compile_plant(followed)
        drive = other.excitation(table)
        sizes.append(float(np.sqrt(np.mean((drive.y - other.run(drive).y) ** 2))))
    assert sizes[1] < sizes[0] < 0.5 * free  # the more trust in the recording, the closer
    rig = Rig(followed, [drive], [table.columns])
    assert rig.physics.flows.keys() == plant.flows.keys() and rig.physics.inputs.keys() == plant.inputs.keys()


def test_an_observer_that_fails_does_not_end_the_search(monkeypatch):
    plant, table = loads(FREE_CARRIAGE), _recorded()
    s = search.started(case(plant, [table], {}, Budget(8)))
    tried = []

    def fails(of, followed):
        tried.append(followed)
        raise SimulationError("the simulation gives values that are not numbers")

    monkeypatch.setattr(search, "_following", fails)
    assert not search.with_observer(s)
    assert len(tried) == 2 and s.best.fitted.hypothesis.keys == frozenset()


def test_a_heated_block_forgets_where_it_started():
    plant = loads(ONE_BLOCK)
    model = compile_plant(plant)
    t = np.arange(0.0, 2000.0, 2.0)
    columns = {i.column: np.full(len(t), 20.0) for i in plant.inputs.values()}
    columns |= {o.column: np.full(len(t), 20.0) for o in plant.outputs.values()}
    drives = [model.excitation(Table("run", "run", t, columns))]
    about = linear(fit(model, drives, default_noise(plant, drives), iterations=1), drives)
    assert about is not None and not drifts(about, 2000.0)
    assert not drifts(about, 60.0)  # it cools by less than half: linear enough for a free run


def test_a_plant_with_a_delay_is_searched_without_an_observer():
    text = FREE_CARRIAGE.replace("value: position,", "value: 'delay(position, 0.004)',")
    assert text != FREE_CARRIAGE
    plant, table = loads(text), _recorded()
    model = compile_plant(plant)
    drives = [model.excitation(table)]
    assert linear(fit(model, drives, default_noise(plant, drives), iterations=1), drives) is None
