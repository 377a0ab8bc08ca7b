"""A recording whose start a free run forgets becomes pieces, each with a start of its own; no other does."""

import numpy as np
import pytest

from tests.laws.published import SYSTEMS
from tests.plants import TWO_BLOCKS
from thermoctl.diagnosis.data.pieces import in_pieces
from thermoctl.plant import loads
from thermoctl.plant.parts import FEW
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

CART = """\
format: thermoctl-plant/1
title: Cart without friction, of which the position is read
inputs:
  force: {unit: N}
nodes:
  velocity: {unit: m/s, storage: 2, initial: 0, initial_sigma: 0.1}
  position: {unit: m, storage: 1, initial: 0, initial_sigma: 0.01}
flows:
  drive: {into: velocity, rate: force, unit: N}
  travel: {into: position, rate: velocity, unit: m/s}
outputs:
  encoder: {value: position, unit: m, noise: 1e-4}
"""


@pytest.fixture(scope="module")
def lorenz():
    system = next(s for s in SYSTEMS if s.name == "Lorenz")
    return loads(system.plant), system.draw(0).tables[:1]


def test_a_chaotic_recording_becomes_pieces_that_hold_all_of_it(lorenz):
    plant, (table,) = lorenz
    pieces, (note,) = in_pieces(plant, [table])
    assert 10 < len(pieces) < 60 and min(map(len, pieces)) >= FEW
    for column, values in table.columns.items():
        assert np.array_equal(np.concatenate([p.columns[column] for p in pieces]), values)
    assert len({p.name for p in pieces}) == len(pieces)
    assert f"read as {len(pieces)} recordings" in note
    model = compile_plant(plant)
    starts = [model.run(model.excitation(p)).x[0] for p in pieces]
    assert np.allclose(starts, [[p.columns[f"{s}_meas"][0] for s in model.states] for p in pieces])


def test_a_body_that_drifts_and_one_that_settles_stay_whole():
    t = np.arange(0, 4000.0, 2.0)
    cart = compile_plant(loads(CART)).measure(Table("run", "run.csv", t, {"force": np.sin(t / 50)}), 1)
    columns = {"heat": np.where(t % 400 < 200, 2.0, 0.0), "air_temperature": np.full(len(t), 21.0)}
    blocks = compile_plant(loads(TWO_BLOCKS)).measure(Table("run", "run.csv", t, columns), 1)
    assert in_pieces(loads(CART), [cart]) == ([cart], [])
    assert in_pieces(loads(TWO_BLOCKS), [blocks]) == ([blocks], [])
