"""A recording with a gap is read as parts, each with a start of its own; a jump of the clock is named."""

import warnings

import numpy as np
import pytest

import thermoctl as tc
from tests.plants import WIDE_BLOCK
from thermoctl.cli import main
from thermoctl.plant.files import loads
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.parts import in_parts
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table


def run(jump_s=0.0, missing=None, heat_between=10.0):
    """Return a recording of 1200 s, one row each 2 s: rows left out, or a clock that jumps at 600 s."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 1200, 2)
    heat = np.where((t < 160) | ((t >= 400) & (t < 600)), heat_between, 0.0) + np.where(t >= 800, 5.0, 0.0)
    one = np.empty_like(t)
    one[0] = 22.0
    for k in range(len(t) - 1):
        end = 22 + heat[k] / 0.2
        one[k + 1] = end + (one[k] - end) * np.exp(-2 * 0.2 / 100)
    kept = np.ones(len(t), bool) if missing is None else (t < missing[0]) | (t >= missing[1])
    shown = np.where(t >= 600, t + jump_s, t)
    columns = {"heat": heat, "air": np.full(len(t), 22.0), "T": one + 0.05 * rng.standard_normal(len(t))}
    return Table("run", "run.csv", shown[kept], {n: v[kept] for n, v in columns.items()})


@pytest.mark.parametrize(
    ("table", "word"),
    [
        (run(missing=(400, 600)), "inputs may have changed meanwhile"),
        (run(jump_s=3600.0), "a jump of the clock (daylight saving?)"),
        (run(jump_s=500.0), "as if no time had passed"),
    ],
    ids=["a gap", "an hour", "another jump"],
)
def test_parts_start_by_their_readings(table, word):
    plant = loads(WIDE_BLOCK, "plant.yaml")
    parts = in_parts(plant, table)
    assert len(parts) == 2 and sum(map(len, parts)) == len(table)
    assert any(word in n for n in parts[0].notes), parts[0].notes
    model = compile_plant(plant)
    found = fit(model, [model.excitation(p) for p in parts])
    values = dict(zip(model.parameters, found.values[0], strict=False))
    assert values["C"] == pytest.approx(100, rel=0.02) and values["G"] == pytest.approx(0.2, rel=0.02)
    assert found.rms()["T"] < 0.06


def test_a_whole_recording_is_one_part():
    plant = loads(WIDE_BLOCK, "plant.yaml")
    table = run()
    assert in_parts(plant, table) == [table]


def test_another_rate_is_no_gap_and_a_gap_beside_it_is_one():
    """A heater's first 32 rows are 1 s apart, the others 0.2 s: it was 33 parts, of which 32 were left out."""
    plant, slow = loads(WIDE_BLOCK, "plant.yaml"), np.arange(0.0, 32, 1.0)
    t = np.concatenate([slow, 32 + np.arange(0.0, 1200, 0.2)])
    columns = {"heat": (t > 500).astype(float), "air": np.full(len(t), 22.0), "T": 22 + 0.01 * t}
    table = Table("run", "run.csv", t, columns)
    assert in_parts(plant, table) == [table]
    table.t[16:] += 9.0
    assert [len(p) for p in in_parts(plant, table)] == [16, len(t) - 16]


def test_a_part_has_the_values_of_its_recording():
    """The value of run_1 did not apply to run_1_part2, and nothing said so."""
    text = WIDE_BLOCK.replace("C: {value: 80,", "C: {value: 80, per_recording: true, values: {run: 70},")
    model = compile_plant(loads(text, "plant.yaml"))
    parts = in_parts(model.plant, run(missing=(400, 600)))
    assert [p.name for p in parts] == ["run", "run_part2"]
    assert [model.vector(None, p.name)[model.parameters.index("C")] for p in parts] == [70, 70]


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_gap_after_the_first_rows(rows):
    parts = in_parts(loads(WIDE_BLOCK, "plant.yaml"), run(missing=(2 * rows, 60)))
    assert "inputs may have changed meanwhile" in " ".join(parts[-1].notes) and len(parts[-1]) == 570


def test_an_unknown_state_after_a_gap_leaves_the_rest_out():
    plant = loads(
        WIDE_BLOCK.replace(", initial_sigma: 0.5", "").replace("value: one,", "value: 2 * one,"), "plant.yaml"
    )
    (part,) = in_parts(plant, run(missing=(400, 600)))
    assert part.t[-1] < 400 and any("nothing states where 'one' starts" in n for n in part.notes)


@pytest.mark.filterwarnings("ignore:.*each with a start of its own")
def test_python_splits_at_a_gap_too():
    plant = tc.Plant(loads(WIDE_BLOCK, "plant.yaml"))
    table = run(missing=(400, 600))
    frame = {"t": table.t, **table.columns}
    with pytest.warns(UserWarning, match="no samples from t = 398 to 600 s"):
        known = tc.refit(plant, frame)
    assert known.plant.parameters["C"] == pytest.approx(100, rel=0.02) and known.rms["T"] < 0.06
    again = tc.simulate(known.plant, frame, x0={"one": 22.0})
    np.testing.assert_array_equal(again.t, table.t)
    assert again.states["one"][0] == 22 and again.rms["T"] < 0.1
    assert again.states["one"][200] == pytest.approx(table.columns["T"][200])
    ahead = tc.simulate(known.plant, frame, x0=frame)
    assert ahead.states["one"][0] == pytest.approx(table.columns["T"][-1], abs=0.2)
    found = tc.diagnose(plant, frame).json
    assert found["verdict"] == "consistent" and not found["findings"]
    assert found["fit"]["held_out_refit_only"]["T"] < 0.06


def test_inputs_alone_are_a_schedule():
    plant = tc.Plant(loads(WIDE_BLOCK, "plant.yaml"))
    t = np.array([*range(20), 500.0, 1000.0])
    inputs = {"t": t, "heat": np.where(t < 10, 5.0, 0.0), "air": np.full(len(t), 22.0)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free = tc.simulate(plant, inputs)
    assert len(free.t) == len(t) and free.states["one"][-1] < 22.1


def test_simulate_starts_each_part_by_its_readings(tmp_path, capsys):
    table = run(missing=(400, 600))
    rows = np.column_stack([table.t, *table.columns.values()])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="t,heat,air,T", comments="")
    (tmp_path / "plant.yaml").write_text(
        WIDE_BLOCK.replace("C: {value: 80", "C: {value: 100").replace("0.3, u", "0.2, u")
    )
    given = ["simulate", "--plant", str(tmp_path / "plant.yaml"), str(tmp_path / "run.csv")]
    assert main([*given, "--out", str(tmp_path / "out.csv")]) == 0
    later = np.genfromtxt(tmp_path / "out_run_part2.csv", delimiter=",", names=True)
    assert later["one_state"][0] == pytest.approx(table.columns["T"][200], abs=1e-6)
    assert main([*given, "--initial", str(tmp_path / "run.csv")]) == 0
    assert "the end of" in capsys.readouterr().out
