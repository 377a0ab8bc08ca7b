"""Swapped columns compete with physics after a search, also where physics is missing; a gain has to be a sensor's."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from tests.bench.scale import block_plant, recorded
from tests.checks.rigs import inputs, truth
from tests.plants import TWO_BLOCKS
from thermoctl.checks import checks
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.data.columns import Columns
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.relabelled import absurd, likely, relabelled
from thermoctl.plant import load, loads
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

CLOSE = TWO_BLOCKS.replace("0.02, unit: W/K, range: [0.004, 0.08]", "0.2, unit: W/K, range: [0.04, 1]")
RADIATES = CLOSE.replace(
    "outputs:",
    '  radiated: {from: one, rate: "4e-10 * ((one + 273.15)**4 - (air + 273.15)**4)", unit: W}\noutputs:',
)
ONE, TWO = "temperature_1", "temperature_2"


@pytest.fixture(scope="module")
def searched():
    """A plant that lacks radiation, a recording, the same with two columns swapped, and the diagnoses of both."""
    plant, entries = loads(CLOSE, "plant.yaml"), catalogue((CATALOGUE,))
    table = compile_plant(truth(loads(RADIATES), 3)).measure(inputs("two blocks"), 3)
    columns = table.columns | {ONE: table.columns[TWO], TWO: table.columns[ONE]}
    swapped = dataclasses.replace(table, columns=columns)
    return plant, [(t, diagnose(plant, [t], entries, limits())) for t in (table, swapped)]


def test_swapped_columns_are_told_from_physics(searched):
    plant, ((table, right), (swapped, wrong)) = searched
    assert not [f for f in checks(plant, [table]) if f.severe]
    assert right.decision.verdict != "consistent" and relabelled(right, limits()) == []
    assert wrong.decision.verdict == "explained", "physics that imitates the mistake"
    (finding,) = relabelled(wrong, limits())
    assert (
        finding.severe and f"'{ONE}' and '{TWO}' are swapped" in finding.what and "convection" in finding.what
    )
    assert finding.suggestion == f"If so: --columns {ONE}={TWO},{TWO}={ONE}"


def test_columns_are_swapped_in_the_rows_that_were_diagnosed():
    """Else the means of a long recording would be taken anew, and evidences of other rows would be compared."""
    plant, slow = loads(CLOSE, "plant.yaml"), inputs("two blocks")
    t = np.arange(0.0, 1600.0, 0.08)
    long = Table("run_1", "run_1.csv", t, {k: np.repeat(v, 25) for k, v in slow.columns.items()})
    table = compile_plant(truth(loads(RADIATES), 3)).measure(long, 3)

    def swap(x):
        """Return a recording with the two temperatures swapped."""
        return dataclasses.replace(x, columns=x.columns | {ONE: x.columns[TWO], TWO: x.columns[ONE]})

    for read, fits in ((table, False), (swap(table), True)):
        known = case(plant, [read], catalogue((CATALOGUE,)), Budget(1))
        again = Columns(known).changed(swap, known.null.cost, Budget(1))
        assert known.block > 1 and (again is not None) is fits
        if again:
            assert sorted(g.count.sum() for g in again.grids) == sorted(g.count.sum() for g in known.grids)


def test_other_readings_are_evaluated_from_one_run(tmp_path):
    recorded(tmp_path, block_plant(7), "{into: block_2, rate: 0.5, unit: W}", 300, 10.0, 10.0)
    plant = load(tmp_path / "plant.yaml")
    (table,) = read_recordings(plant, [tmp_path / "run_1.csv"])
    gaps = {
        **table.columns,
        "temperature_4": np.where(table.t == 500, np.nan, table.columns["temperature_4"]),
    }
    known = case(plant, [dataclasses.replace(table, columns=gaps)], {}, Budget(1))
    one, four = (known.tables[0].columns[f"temperature_{k}"] for k in (1, 4))
    there = np.isfinite(one) & np.isfinite(four)
    swapped = {"temperature_1": np.where(there, four, one), "temperature_4": np.where(there, one, four)}
    drives = [
        known.null.model.excitation(dataclasses.replace(t, columns={**t.columns, **swapped}))
        for t in known.tables
    ]
    found = Columns(known)._read(drives)
    exact = Problem(known.null.model, drives, known.noise).evaluate(known.null.z, True)
    assert found.cost == pytest.approx(exact.cost, rel=1e-6)
    assert found.gradient == pytest.approx(exact.gradient, rel=1e-6, abs=1e-6 * np.abs(exact.gradient).max())
    assert found.matrix == pytest.approx(exact.matrix, rel=1e-5, abs=1e-6 * exact.matrix.max())
    driven = dataclasses.replace(drives[0], u=drives[0].u + 1.0)
    assert Columns(known)._read([driven]) is None


@pytest.mark.parametrize(
    ("at", "after", "goal", "kept"),
    [
        (1.078, 1.065, 1.0, False),  # readings that are nearly alike: a fit moves nothing
        (0.594, 0.580, 1.0, True),  # likelier as it is
        (0.671, 0.659, 0.580, False),  # less likely than another pair
        (6.49, 3.18, 1.0, True),  # swapped in a generated case; the refit ends at 0.016
        (113.0, 56.6, 1.0, False),  # far worse: two of twelve bodies
    ],
)
def test_pairs_that_no_refit_can_make_better_are_not_refitted(at, after, goal, kept):
    assert likely(at, after, goal, 1.0) is kept


@pytest.mark.parametrize(("gain", "refused"), [(1.79, True), (0.25, True), (1.1, False), (0.7, False)])
def test_a_gain_that_no_sensor_has_is_a_wrong_column(gain, refused):
    named = SimpleNamespace(key=("sensor_gain", "heat"), own={"A": "A_of_heat"})
    refitted = SimpleNamespace(parameters={"A_of_heat": SimpleNamespace(value=gain)})
    found = SimpleNamespace(
        shown=(named,),
        best=SimpleNamespace(plant=refitted),
        case=SimpleNamespace(plant=loads(CLOSE, "plant.yaml")),
    )
    told = absurd(found, "run.csv")
    assert bool(told) is refused
    assert all(
        f.severe and f"{gain:.3g} at 'heat'" in f.what and "another unit" in f.suggestion for f in told
    )
