"""A simulation on inputs alone: given initial values, the steady state, or the last state of a recording."""

import numpy as np
import pytest

import thermoctl as tc
from thermoctl import cli
from thermoctl.files.yamlfile import InputError

PLANT = """format: thermoctl-plant/1
inputs: {heat: {unit: W}, air: {unit: degC, role: ambient}}
parameters: {C: {value: 50, unit: J/K}, G: {value: 0.5, unit: W/K}}
nodes: {block: {unit: degC, storage: C, initial: first(T), initial_sigma: 0.3}}
flows:
  heating: {into: block, rate: heat, unit: W}
  loss: {from: block, rate: G * (block - air), unit: W}
outputs: {T: {value: block, unit: degC, noise: 0.05}}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.yaml").write_text(PLANT)
    (tmp_path / "step.csv").write_text("t,heat,air\n0,10,20\n100,10,20\n200,0,20\n300,0,20\n")
    return tmp_path


def ends(folder, capsys, *initial):
    """The first and last simulated temperature, and what was printed on stderr."""
    assert cli.main(["simulate", "--plant", "p.yaml", "step.csv", "--out", "o.csv", *initial]) == 0
    rows = np.genfromtxt(folder / "o.csv", delimiter=",", names=True)
    return rows["T_simulated"][[0, -1]], capsys.readouterr()


@pytest.mark.parametrize(
    ("initial", "start"), [((), 40.0), (("--initial", "steady"), 40.0), (("--initial", "block=25"), 25.0)]
)
def test_inputs_alone_are_enough(folder, capsys, initial, start):
    got, printed = ends(folder, capsys, *initial)
    # 10 W for 200 s, then none for 100 s; time constant 100 s, steady state 20 + 10 / 0.5
    warm = 40 + (start - 40) * np.exp(-2)
    assert got == pytest.approx([start, 20 + (warm - 20) * np.exp(-1)], rel=1e-5)
    assert ("steady state of the first inputs, block = 40 degC" in printed.err) == (not initial)
    assert "highest" in printed.out
    assert "note: step.csv: no column 'T', which an output of p.yaml reads;" in printed.err


def test_a_start_that_no_reading_gives_is_told(folder, capsys):
    (folder / "p.yaml").write_text(PLANT.replace("first(T)", "25"))
    (folder / "step.csv").write_text("t,heat,air,T\n0,10,20,40\n100,10,20,40\n200,0,20,40\n")
    assert "starts at block = 25 ± 0.3 degC, as the plant file says" in ends(folder, capsys)[1].err
    assert "as the plant file says" not in ends(folder, capsys, "--initial", "block=40")[1].err
    (folder / "p.yaml").write_text(PLANT)
    assert "as the plant file says" not in ends(folder, capsys)[1].err


def test_a_forecast_goes_on_from_a_recordings_last_state(folder, capsys):
    t = np.arange(0.0, 400.0, 2.0)
    truth = 35 + (22 - 35) * np.exp(-t / 100)  # 7.5 W
    noisy = truth + np.random.default_rng(3).normal(0, 0.05, len(t))
    rows = "\n".join(f"{a:g},7.5,20,{b:.4f}" for a, b in zip(t, noisy, strict=True))
    (folder / "past.csv").write_text(f"t,heat,air,T\n{rows}\n")
    got, printed = ends(folder, capsys, "--initial", "past.csv")
    assert got[0] == pytest.approx(truth[-1], abs=0.05) and "start: block = 3" in printed.out
    future = {"t": [0.0, 100.0], "heat": [7.5, 7.5], "air": [20.0, 20.0]}
    by_file = tc.simulate("p.yaml", future, x0="past.csv")
    assert by_file.outputs["T"][0] == pytest.approx(got[0])
    again = tc.simulate("p.yaml", future, x0=by_file.last)
    assert again.outputs["T"][0] == by_file.outputs["T"][-1]
    assert tc.simulate("p.yaml", future, x0="steady").outputs["T"] == pytest.approx([35.0, 35.0])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("blok=3", "no such node (did you mean 'block'?)"),
        ("block=warm", "--initial block=warm: NODE=VALUE"),
        ("nothing.csv", "nothing.csv"),
        ("step.csv", "no column 'T', which an output of p.yaml reads"),
    ],
)
def test_a_wrong_initial_value_is_one_line(folder, capsys, given, says):
    assert cli.main(["simulate", "--plant", "p.yaml", "step.csv", "--initial", given]) == 2
    error = capsys.readouterr().err
    notes, (last,) = error.splitlines()[:-1], error.splitlines()[-1:]
    assert says in last and all(n.startswith("note: ") for n in notes)


def test_a_plant_without_a_steady_state_asks_for_values(folder):
    (folder / "s.yaml").write_text(
        PLANT.replace("G * (block - air)", "G * (air - air)")  # nothing holds it
    )
    with pytest.raises(
        InputError, match="no steady state at the first inputs; give the initial values: block=VALUE"
    ):
        tc.simulate("s.yaml", {"t": [0.0, 1.0], "heat": [1.0, 1.0], "air": [20.0, 20.0]})
