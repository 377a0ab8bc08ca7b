"""Experiment files that list inputs: read, refused, run."""

import numpy as np
import pytest

from thermoctl.calibration.commands import record
from thermoctl.cli import main
from thermoctl.files.yamlfile import InputError
from thermoctl.identify.experiments import load_experiments, load_inputs
from thermoctl.recording.files import read_table

GOOD = """format: thermoctl-experiments/1
experiments:
  next_experiment:
    title: Warm-up and cool-down
    sample_s: 5
    inputs:
      heat: {unit: W, corners: [[0, 0], [10, 8], [300, 8], [310, 0], [600, 0]]}
    assumed: {air: 22}
"""
PLANT = """format: thermoctl-plant/1
inputs: {heat: {unit: W}, air: {unit: degC}}
parameters: {C: {value: 40, unit: J/K}, G: {value: 0.25, unit: W/K}}
nodes: {T: {unit: degC, storage: C, initial: air}}
flows: {power: {into: T, rate: heat, unit: W}, loss: {from: T, rate: G * (T - air), unit: W}}
outputs: {T_block: {value: T, unit: degC, noise: 0.05, resolution: 0.01}}
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "next.yaml").write_text(GOOD)
    (tmp_path / "plant.yaml").write_text(PLANT)
    return tmp_path


def test_inputs_follow_straight_lines_between_their_corners(folder):
    (x,) = load_inputs(folder / "next.yaml").values()
    t, columns = x.columns()
    assert t[-1] == x.duration_s == 600 and len(t) == 121
    assert columns["heat"] == pytest.approx(np.interp(t, [0, 10, 300, 310, 600], [0, 8, 8, 0, 0])) and np.all(
        columns["air"] == 22
    )


def test_a_plant_file_in_the_rigs_place_gives_a_recording(folder):
    out = folder / "r.csv"
    assert main(f"experiment {folder / 'next.yaml'} --plant {folder / 'plant.yaml'} --out {out}".split()) == 0
    made = read_table(out)
    assert set(made.columns) == {"heat", "air", "T_block"} and len(made.t) == 121
    k = np.arange(
        3, 60
    )  # 8 W into 40 J/K that lose 0.25 W/K, closed form; each sample's power is held to the next
    rise = 8 / 0.25 * (1 - np.exp(-(made.t[k] - 10) * 0.25 / 40)) + 4 / 0.25 * (
        1 - np.exp(-5 * 0.25 / 40)
    ) * np.exp(-(made.t[k] - 10) * 0.25 / 40)
    error = made.columns["T_block"][k] - 22 - rise
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.05, rel=0.35)
    assert made.columns["T_block"] * 100 == pytest.approx(np.round(made.columns["T_block"] * 100), abs=1e-6)


def test_the_daemon_is_not_asked_for_inputs_that_it_does_not_command(folder, capsys):
    assert main(["experiment", str(folder / "next.yaml")]) == 2
    assert "commands setpoint_um only" in capsys.readouterr().err
    assert main(["experiment", str(folder / "next.yaml"), "--dry-run"]) == 0


def test_a_setpoint_among_inputs_is_a_schedule(folder):
    (folder / "s.yaml").write_text(GOOD.replace("heat: {unit: W, ", "setpoint_um: {"))
    schedule = load_experiments(folder / "s.yaml")["next_experiment"]
    assert (
        schedule.commands() == [(0.0, "setpoint", 8.0), (300.0, "setpoint", 0.0)]
        and schedule.duration_s == 600
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[10, 8], [300, 8]", "[300, 8], [10, 8]"), "must begin at 0 and increase"),
        (("[[0, 0], [10", "[[1, 0], [10"), "must begin at 0"),
        (("[10, 8],", "[10, hot],"), "a number from"),
        (("corners: [[0, 0], [10, 8], [300, 8], [310, 0], [600, 0]]", "corners: 5"), "two or more corners"),
        (("sample_s: 5", "sample_s: -5"), "a number from"),
        (("    title: Warm-up and cool-down\n", ""), "'title' is missing"),
        (("    inputs:\n", "    inptus:\n"), "unknown key"),
        (("      heat:", "      other: {corners: [[0, 0], [9, 1]]}\n      heat:"), "end at the same time"),
        (("/1", "/2"), "was expected"),
    ],
)
def test_a_wrong_file_gives_one_error_with_its_line(folder, capsys, change, words):
    text = GOOD.replace(*change)
    assert text != GOOD
    (folder / "bad.yaml").write_text(text)
    with pytest.raises(InputError, match=words) as e:
        load_experiments(folder / "bad.yaml")
    assert "bad.yaml:" in str(e.value)


@pytest.mark.parametrize(
    "parts, words",
    [
        ("[{hold: 5}]", "hold: a list was expected, found 5"),
        ("[{hold: [5]}]", "seconds, um. was expected"),
        ("[{hold: [[1, 0]], more: 1}]", "a part: unknown key 'more'"),
        (
            "[{trapezoid: {low_um: 0, high_um: 9, hold_s: 3, duration_s: 60}}]",
            "hold_s: a list was expected, found 3",
        ),
        (
            "[{trapezoid: {low_um: 9, high_um: 9, hold_s: [0], duration_s: 60}}]",
            "hold_s: seconds were expected that fill duration_s",
        ),
        (
            "[{repeat: 1000, parts: [{repeat: 1000, parts: [{hold: [[1, 0], [1, 5]]}]}]}]",
            "more than 100000 corners up to here",
        ),
    ],
)
def test_a_wrong_part_is_refused_at_its_line(tmp_path, parts, words):
    """A trapezoid that neither moves nor holds never ended."""
    path = tmp_path / "experiments.yaml"
    head = "format: thermoctl-experiments/1\nrate_um_s: 10\nexperiments:\n  short: {title: t, parts: "
    path.write_text(f"{head}{parts}}}\n")
    with pytest.raises(InputError, match=rf"experiments.yaml:4:\d+: .*{words}"):
        load_experiments(path)


def test_on_the_simulated_back_end_it_runs_under_the_daemons_protections(
    folder, capsys, monkeypatch, request
):
    monkeypatch.chdir(request.config.rootpath)
    text = GOOD.replace(
        "[[0, 0], [10, 8], [300, 8], [310, 0], [600, 0]]", "[[0, 0], [2, 20], [6, 20]]"
    ).replace("heat: {unit: W, ", "setpoint_um: {")
    (folder / "s.yaml").write_text(text.replace("sample_s: 5", "sample_s: 0.1"))
    record(folder / "s.yaml", folder / "r.csv", "config/simulated.yaml", None)
    made = read_table(folder / "r.csv")
    assert made.columns["setpoint_um"][-1] == 20 and made.columns["position_um"][-1] == pytest.approx(
        20, abs=5
    )
    assert np.all(made.columns["fault_bits"] == 0) and made.columns["state"][-1] == 3
    (folder / "far.yaml").write_text(text.replace("sample_s: 5", "sample_s: 0.1").replace("20]", "90000]"))
    with pytest.raises(InputError, match="setpoints leave"):
        record(folder / "far.yaml", folder / "r.csv", "config/simulated.yaml", None)
