"""A recording whose start a free run forgets becomes pieces, each with a start of its own; no other does."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.laws.published import SYSTEMS
from tests.plants import TWO_BLOCKS
from thermoctl.diagnosis.data.pieces import in_pieces, with_free_starts
from thermoctl.diagnosis.diagnose import diagnose, sought
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
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


DOUBLE_WELL = """\
format: thermoctl-plant/1
title: A beam between two magnets, driven by a sine
inputs:
  drive: {between_samples: linear}
parameters:
  d: {value: 0.22, range: [0.05, 0.6]}
  a: {value: 1.1, range: [0.5, 2]}
  b: {value: 0.95, range: [0.5, 2]}
nodes:
  w: {storage: 1, initial: "0", initial_sigma: 0.1}
  x: {storage: 1, initial: first(X), initial_sigma: 0.05}
flows:
  force: {into: w, rate: drive}
  damp: {from: w, rate: d * w}
  well: {into: w, rate: a * x - b * x**3}
  move: {into: x, rate: w}
outputs:
  X: {value: x, noise: 0.03}
"""


@pytest.fixture(scope="module")
def beam():
    """Two recordings of a chaotic beam whose speed is not read, by scipy."""
    tables, rng = [], np.random.default_rng(822)
    for k, (start, size) in enumerate([(1.0, 0.4), (-0.5, 0.36)], 1):
        t = np.arange(0.0, 60.0, 0.1)

        def rates(at, y, size=size):
            return size * np.cos(at) - 0.25 * y[0] + y[1] - y[1] ** 3, y[0]

        x = solve_ivp(rates, (0, 60), (0.0, start), t_eval=t, rtol=1e-9, atol=1e-9).y[1]
        columns = {"drive": size * np.cos(t), "X": x + rng.normal(0, 0.03, len(t))}
        tables.append(Table(f"run_{k}", "", t, columns))
    return loads(DOUBLE_WELL), tables


def test_a_piece_starts_with_any_speed_that_was_not_read(beam):
    """The speed at the start of the recording, which the plant file states, was taken for that of each piece."""
    plant, tables = beam
    pieces, notes = in_pieces(plant, tables)
    assert notes and len(pieces) > 2
    free = with_free_starts(plant, pieces).nodes
    assert free["w"].initial_sigma > 0.3 and free["x"] == plant.nodes["x"]


def test_nothing_is_missing_where_a_chaotic_plant_has_its_parameters_a_little_wrong(beam):
    """A refit in a wrong optimum was left by the start of any effect, which was then named, above 0.99."""
    found = diagnose(*beam, catalogue(), limits())
    assert found.decision.verdict == "consistent"
    assert found.null.fit.rms()["X"] < 0.031


def test_a_recording_set_aside_that_was_cut_is_noted_too(beam):
    """The report did not say that errors on it are those of its pieces."""
    plant, tables = beam
    (cut,) = [t for t in tables if in_pieces(plant, [t])[1]]
    whole = [t for t in tables if t is not cut]
    notes = sought(plant, whole, {}, limits(), [cut]).case.notes
    assert [n for n in notes if n.startswith(f"a free run of {cut.name} forgets its start")]
