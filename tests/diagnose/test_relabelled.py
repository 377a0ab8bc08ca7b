"""Swapped columns compete with physics after a search, also where physics is missing; a gain has to be a sensor's."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from tests.bench.scale import block_plant, recorded
from tests.checks.rigs import inputs, truth
from tests.plants import TWO_BLOCKS
from thermoctl.checks import checks
from thermoctl.checks.labels import swaps
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.relabelled import absurd, better_unfitted, changed, relabelled
from thermoctl.plant import load, loads
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
    assert right.decision.verdict != "consistent" and relabelled(right) == []
    assert wrong.decision.verdict == "explained", "physics that imitates the mistake"
    (finding,) = relabelled(wrong)
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
        again = changed(known, [swap(t) for t in known.tables], known.null.cost, Budget(1))
        assert known.block > 1 and (again is not None) is fits
        if again:
            assert sorted(g.count.sum() for g in again.grids) == sorted(g.count.sum() for g in known.grids)


def test_pairs_are_refitted_where_the_plant_files_own_values_fit_better(tmp_path):
    """Neighbours read nearly alike. Swapped, they fit worse, and none is refitted."""
    recorded(tmp_path, block_plant(12), "{into: block_2, rate: 0.5, unit: W}", 300, 10.0, 10.0)
    plant = load(tmp_path / "plant.yaml")
    pairs = [*swaps(plant, read_recordings(plant, [tmp_path / "run_1.csv"]))]
    (found,) = [h for h in pairs if set(h.columns) == {"temperature_1", "temperature_4"}]
    (table,) = read_recordings(plant, [tmp_path / "run_1.csv"])
    for read, likely in (table, []), (found.change(table), [found]):
        known = case(plant, [read], {}, Budget(1))
        assert [h for h in better_unfitted(known, pairs) if h is found or not likely] == likely


@pytest.mark.parametrize(
    ("gain", "at_bound", "refused"),
    [
        (1.79, {}, True),
        (0.25, {}, True),
        (1.1, {}, False),
        (0.7, {}, False),
        (0.2, {"A_of_heat": "low"}, False),
    ],
)
def test_a_gain_that_no_sensor_has_is_a_wrong_column(gain, at_bound, refused):
    named = SimpleNamespace(key=("sensor_gain", "heat"), own={"A": "A_of_heat"})
    refitted = SimpleNamespace(parameters={"A_of_heat": SimpleNamespace(value=gain)})
    found = SimpleNamespace(
        shown=(named,),
        best=SimpleNamespace(plant=refitted, fit=SimpleNamespace(at_bound=at_bound)),
        case=SimpleNamespace(plant=loads(CLOSE, "plant.yaml")),
    )
    told = absurd(found, "run.csv")
    assert bool(told) is refused
    assert all(
        f.severe and f"{gain:.3g} at 'heat'" in f.what and "another unit" in f.suggestion for f in told
    )
