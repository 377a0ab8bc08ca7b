"""The Python interface: data frames, arrays and files in; results with figures out."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import thermoctl as tc
from thermoctl.files.yamlfile import InputError

HEATER = Path(__file__).parents[2] / "docs/examples/heater"


@pytest.fixture(scope="module")
def plant():
    return tc.load_plant(HEATER / "plant.yaml")


@pytest.fixture(scope="module")
def frames():
    return [pd.read_csv(HEATER / f"run_{k}.csv", comment="#") for k in (1, 2)]


@pytest.fixture(scope="module")
def result(plant, frames):
    return tc.diagnose(plant, frames)


def test_import_loads_nothing_heavy():
    code = "import sys, thermoctl; print(thermoctl.__version__, [m for m in ('numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        .stdout.strip()
        .endswith("[]")
    )
    with pytest.raises(AttributeError, match="no attribute 'diagnoze'"):
        tc.diagnoze  # noqa: B018


def test_a_diagnosis_of_data_frames(result, tmp_path):
    assert result.verdict == "explained"
    (finding,) = result.findings
    assert (finding.effect, finding.where) == ("external_heat_source", "two")
    assert finding.probability > 0.9 and "step(t" in finding.equation
    assert result.summary.startswith("Found: external heat source")
    assert len(result.plot().axes) == 2
    assert "<svg" in result._repr_html_() and "external_heat_source" in repr(result)
    result.save(tmp_path / "out")
    again = tc.load_plant(tmp_path / "out/plant.yaml")
    assert again.parameters == pytest.approx(result.plant.parameters)
    assert (tmp_path / "out/diagnosis.json").exists()


def test_the_extended_plant_simulates_and_is_exported(result, frames, plant, tmp_path):
    before, after = tc.simulate(plant, frames[0]), tc.simulate(result.plant, frames[0])
    assert all(after.rms[o] < 0.2 < before.rms[o] for o in plant.description.outputs)
    assert after.t.shape == after.outputs["temperature_1"].shape == after.states["one"].shape
    assert np.allclose(
        after.errors["temperature_1"],
        frames[0].temperature_1 - after.outputs["temperature_1"],
        equal_nan=True,
    )
    assert len(after.plot().axes) == 2
    result.plant.export(tmp_path / "heater.py", frames[0])
    assert "def simulate(" in (tmp_path / "heater.py").read_text()
    with pytest.raises(InputError, match="one of the endings"):
        result.plant.export(tmp_path / "heater.txt")


def test_every_kind_of_data_gives_the_same(plant, frames):
    path = HEATER / "run_1.csv"
    frame = frames[0]
    indexed = frame.set_index(pd.to_datetime(frame.t, unit="s")).drop(columns="t")
    minutes = frame.rename(columns={"t": "clock"})
    table = tc.read(minutes, time="clock")
    milliwatts = frame.assign(heat=1000 * frame.heat).rename(columns={"heat": "heat [mW]"})
    expected = tc.simulate(plant, path).outputs["temperature_2"]
    renamed = tc.read(milliwatts, columns={"heat": "heat [mW]"})
    for data in (frame, {c: frame[c].to_numpy() for c in frame}, indexed, table, milliwatts, renamed):
        assert np.allclose(tc.simulate(plant, data).outputs["temperature_2"], expected, atol=1e-9)


def test_a_file_is_read_as_its_options_say(tmp_path, frames):
    path = tmp_path / "run.csv"
    path.write_text('time,T\n0,"1,100"\n1,-9999\n2,"1,200"\n')
    table = tc.read(path, decimal=",", missing=[-9999])
    np.testing.assert_array_equal(table.columns["T"], [1.1, np.nan, 1.2])
    frames[0].to_excel(tmp_path / "run.xlsx", sheet_name="second", index=False)
    assert len(tc.read(tmp_path / "run.xlsx", sheet="second").t) == len(frames[0])
    with pytest.raises(InputError, match="other"):
        tc.read(tmp_path / "run.xlsx", sheet="other")
    with pytest.raises(InputError, match="decimal: a file was expected"):
        tc.read(frames[0], decimal=",")


def test_unusable_data_is_one_clear_error(plant, frames):
    frame = frames[0]
    for data, expected in (
        (frame.iloc[::-1], "times must increase"),
        (frame.drop(columns="heat"), "no column 'heat'"),
        ({k: v for k, v in frame.items() if k != "t"}, "no column of times"),
        ({"t": ["a", "b"], "heat": [1, 2]}, "holds no times"),
        ({"t": [0, 1, 2], "heat": [1, 2]}, r"has \(2,\) values; \(3,\) were expected"),
    ):
        with pytest.raises(InputError, match=expected):
            tc.simulate(plant, data)
    with pytest.raises(InputError, match="no column 'clok' .did you mean 'clock'"):
        tc.read(frame.rename(columns={"t": "clock"}), time="clok")


def test_swapped_columns_are_refused_before_a_diagnosis(plant, frames):
    swapped = [
        f.rename(columns={"temperature_1": "temperature_2", "temperature_2": "temperature_1"}) for f in frames
    ]
    assert any(f.severe for f in tc.check(plant, swapped))
    with pytest.raises(InputError, match="anyway=True"):
        tc.diagnose(plant, swapped)


def test_a_refit_with_its_residuals_and_profile(frames, result):
    known = tc.refit(result.plant, frames)
    g = known.parameters["G_12"]
    assert known.plant.parameters["G_12"] == pytest.approx(g.value)
    assert np.std(known.residuals("temperature_1")) == pytest.approx(0.1, rel=0.05)
    assert len(known.plot("temperature_2").axes) == 4 and "<svg" in known._repr_html_()
    values, rise = known.profile("G_12", points=5, reach=2.0)
    assert rise.min() == pytest.approx(0.0, abs=0.05) and np.argmin(rise) == 2
    assert rise[[0, -1]] == pytest.approx([4.0, 4.0], rel=0.25), "two standard errors cost four"
    assert np.ptp(values) == pytest.approx(4 * g.sd, rel=1e-6)
    assert known.plot_profile("G_12")._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="'G_13' was not fitted .did you mean"):
        known.profile("G_13")


def test_the_residual_figures_show_a_trend_and_pass_white_noise():
    from thermoctl.report.residuals import KOLMOGOROV, autocorrelation, cumulated_periodogram

    rng = np.random.default_rng(3)
    white = rng.normal(size=4000)
    drift = white + np.cumsum(rng.normal(size=4000)) / 20
    for e, inside in ((white, True), (drift, False)):
        f, share = cumulated_periodogram(e)
        assert (np.max(np.abs(share - 2 * f)) < KOLMOGOROV / np.sqrt(len(f))) is np.bool_(inside)
        assert (np.mean(np.abs(autocorrelation(e, 40)) < 1.96 / np.sqrt(len(e))) > 0.8) is np.bool_(inside)


def test_a_plant_shows_itself(plant):
    assert "2 nodes" in repr(plant)
    html = plant._repr_html_()
    assert "<svg" in html and "<td>G_12</td>" in html
    assert plant.with_values({"G_12": 0.03}).parameters["G_12"] == 0.03
    with pytest.raises(InputError, match="did you mean 'G_1'"):
        plant.with_values({"G_13": 1})
    built = tc.load_plant({"format": "thermoctl-plant/1", "outputs": {"y": {"value": 1}}})
    assert built.description.outputs["y"].value.value == 1
