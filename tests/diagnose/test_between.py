"""A heater that switches between the rows of a logger is read on straight lines; one that switches at rows is held."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.bench.between import named
from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.data.case import Budget, Case, case
from thermoctl.diagnosis.data.memory import Memory
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.evidence.between import between
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import load, loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

C, G, AIR, EVERY_S = 4.8, 0.06, 20.0, 2.0


def recording(between: bool, seed: int) -> Table:
    """Rows every two seconds; the exact solution from switch to switch of a relay's heat of 6 W."""
    times = np.cumsum(np.random.default_rng(seed).uniform(15, 60, 60))
    return switched(times if between else np.round(times / EVERY_S) * EVERY_S, seed)


def switched(times: np.ndarray, seed: int) -> Table:
    """The recording of a relay that switches at these times, s."""
    rng, t = np.random.default_rng(seed), np.arange(0, 1200, EVERY_S)
    edges = np.sort(np.concatenate([t, times[times < t[-1]]]))
    on = lambda at: 6.0 * (np.searchsorted(times, at, "right") % 2)  # noqa: E731
    x, at = [AIR], {0.0: AIR}
    for a, b in zip(edges, edges[1:], strict=False):
        end = AIR + on(a) / G
        x.append(end + (x[-1] - end) * np.exp(-G / C * (b - a)))
        at[b] = x[-1]
    read = np.array([at[s] for s in t]) + rng.normal(0, 0.1, len(t))
    return Table(f"run_{seed}", "run", t, {"heat": on(t), "air": np.full(len(t), AIR), "temperature": read})


def taken(text: str, between_rows: bool, folder: Path) -> Case:
    (folder / "plant.yaml").write_text(text)
    runs = [recording(between_rows, 1), recording(between_rows, 2)]
    return between(load(folder / "plant.yaml"), lambda p: case(p, runs, catalogue(), Budget(80)))


@pytest.mark.parametrize("between_rows", [True, False])
def test_inputs_go_on_as_the_plant_alone_follows_them_better(between_rows, tmp_path):
    known = taken(ONE_BLOCK, between_rows, tmp_path)
    assert known.plant.inputs["heat"].linear == between_rows
    assert any("straight lines between the rows of 'heat'" in note for note in known.notes) == between_rows


def test_a_switch_that_is_later_than_the_others_is_no_event():
    """Straight lines know the mean lateness only: a room's fan was an offset step of its sensor, 1.0."""
    times = np.arange(41.0, 1200.0, 60.0)
    assert (
        diagnose(loads(ONE_BLOCK), [switched(times, 1)], catalogue(), limits()).decision.verdict
        == "consistent"
    )
    times[4] -= 0.95
    found = diagnose(loads(ONE_BLOCK), [switched(times, 1)], catalogue(), limits())
    assert not found.decision.named and found.asked == {("external_heat_source", "block"): 0.5}


def test_a_diagnosis_that_goes_on_reads_inputs_as_before(tmp_path):
    """The sums of the earlier recordings hold one reading of them."""
    (tmp_path / "plant.yaml").write_text(ONE_BLOCK)
    for straight in ((), ("heat",)):
        past = Memory((), ("run_0",), straight)
        known = between(
            load(tmp_path / "plant.yaml"),
            lambda p, past=past: case(p, [recording(True, 1)], catalogue(), Budget(80), past),
        )
        assert known.plant.inputs["heat"].linear == bool(straight)


def test_what_the_plant_file_states_is_not_asked(tmp_path):
    text = ONE_BLOCK.replace("{unit: W}", "{unit: W, between_samples: hold}", 1)
    assert not taken(text, True, tmp_path).plant.inputs["heat"].linear


def test_a_heater_that_is_logged_a_row_late_is_said_to_be_late(tmp_path):
    """The block answers before its heater changes. Nothing of the plant is missing, and its parameters are right."""
    (tmp_path / "plant.yaml").write_text(ONE_BLOCK)
    late = []
    for seed in (1, 2):
        r = recording(False, seed)
        late.append(replace(r, columns=r.columns | {"heat": np.roll(r.columns["heat"], 1)}))
    d = diagnose(load(tmp_path / "plant.yaml"), late, catalogue(), limits())
    (found,) = contract(d)["findings"]
    assert (found["effect"], found["where"]) == ("sensor_advance", "heat") and found["probability"] > 0.99
    (advance,) = found["parameters"].values()
    assert advance["value"] == pytest.approx(EVERY_S, abs=3 * advance["sd"]) and advance["sd"] < 0.1
    assert contract(d)["verdict"] == "explained"
    values = d.best.plant.parameters
    assert values["C"].value == pytest.approx(C, rel=0.01) and values["G"].value == pytest.approx(G, rel=0.01)


@pytest.mark.parametrize(("late", "rows"), [("heat", 2), ("air", 3), ("heat", 0)])
def test_an_input_on_straight_lines_that_is_late_is_named_too(late, rows):
    """A measured ramp of the heater, and the room; where none is late, nothing is missing."""
    plant, runs = loads(ONE_BLOCK.replace("heat: {unit: W}", "heat: {unit: W, between_samples: linear}")), []
    for seed in (1, 2):
        rng, t = np.random.default_rng(seed), np.arange(0, 1200, EVERY_S)
        ramps = (rng.uniform(0, 6, 33), 20 + rng.uniform(-4, 4, 33))
        u = {n: np.interp(t, np.arange(33) * 40.0, x) for n, x in zip(("heat", "air"), ramps, strict=True)}
        y = compile_plant(plant).simulate(Table("run", "run", t, u), {"C": C, "G": G}).y[:, 0]
        u[late] = np.concatenate([np.full(rows, u[late][0]), u[late]])[: len(t)]
        runs.append(Table(f"run_{seed}", "run", t, u | {"temperature": y + rng.normal(0, 0.1, len(t))}))
    found = contract(diagnose(plant, runs, catalogue(), limits()))["findings"]
    assert [(f["effect"], f["where"]) for f in found] == [("sensor_advance", late)] * bool(rows)
    for p in (p for f in found for p in f["parameters"].values()):
        assert p["value"] == pytest.approx(rows * EVERY_S, abs=3 * p["sd"]) and p["sd"] < 0.3


@pytest.mark.slow  # half a minute: two diagnoses
def test_switches_between_rows_are_no_missing_physics():
    """Held until the next row, the heater's steps are taken for a hidden mass."""
    assert not named(25.0, 15, straight=True)
    assert named(25.0, 15, straight=False)
