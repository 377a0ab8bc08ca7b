"""Columns in other units: by `column` of the plant file, by the recording's header; each said aloud, none twice."""

import dataclasses

import numpy as np
import pytest

from tests.plants import ONE_BLOCK
from thermoctl import cli
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import load, loads, save
from thermoctl.plant.language import Conversion
from thermoctl.plant.recordings import read_recordings
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.plant.units import as_recorded, in_plant_units
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.foreign.logger import read_recording
from thermoctl.recording.table import Table
from thermoctl.units import conversion

T = np.arange(0.0, 400.0, 2.0)
HEAT, AIR = np.where(T < 200, 3.0, 1.0), 22 + T / 400


@pytest.mark.parametrize(
    "given, wanted, scale, offset",
    [
        ("kW", "W", 1e3, 0),
        ("mm", "m", 1e-3, 0),
        ("degF", "degC", 1 / 1.8, -32 / 1.8),
        ("F", "degC", 1 / 1.8, -32 / 1.8),
        ("K", "degC", 1, -273.15),
        ("C", "degC", 1, 0),
        ("deg", "rad", np.pi / 180, 0),
        ("%", "1", 0.01, 0),
        ("L/min", "m^3/s", 1e-3 / 60, 0),
        ("W", "W", 1, 0),
    ],
)
def test_units_convert(given, wanted, scale, offset):
    assert conversion(given, wanted) == pytest.approx((scale, offset))


def test_units_that_do_not_convert():
    for given, wanted in (("W", "K"), ("bananas", "m"), ("C", "A")):
        with pytest.raises(ValueError):
            conversion(given, wanted)


def written(folder, header, heat=HEAT, air=AIR):
    rows = "\n".join(f"{t:g},{h:.9g},{a:.9g}" for t, h, a in zip(T, heat, air, strict=True))
    path = folder / "run.csv"
    path.write_text(f"{header}\n{rows}\n")
    return path


def plant_with(heat="{unit: W}", air="{unit: degC, between_samples: linear}"):
    return loads(
        ONE_BLOCK.replace("heat: {unit: W}", f"heat: {heat}").replace(
            "air: {unit: degC, between_samples: linear}", f"air: {air}"
        )
    )


@pytest.mark.parametrize(
    "heat, air, header, values",
    [
        ("{unit: W, column: {name: P, unit: kW}}", "{unit: degC}", "t,P,air", (HEAT / 1e3, AIR)),
        ("{unit: W, column: {name: P, scale: -0.5, offset: 1}}", "{unit: degC}", "t,P,air", ((HEAT - 1) / -0.5, AIR)),
        ("{unit: W}", "{unit: degC, column: {unit: degF}}", "t,heat,air", (HEAT, 1.8 * AIR + 32)),
        ("{unit: W}", "{unit: degC}", "t,heat [mW],air [K]", (1e3 * HEAT, AIR + 273.15)),
        ("{unit: W, column: P}", "{unit: degC, column: 'air [degF]'}", "t,P [kW],air [degF]", (HEAT / 1e3, 1.8 * AIR + 32)),
    ],
)  # fmt: skip
def test_a_column_is_converted_once(tmp_path, heat, air, header, values):
    plant = plant_with(heat, air)
    path = written(tmp_path, header, *values)
    (table,) = read_recordings(plant, [path])
    assert table.notes and not table.recorded
    model = compile_plant(plant)
    for t in (table, read_recording(path), in_plant_units(plant, table)):
        np.testing.assert_allclose(model.excitation(t).u, np.column_stack([HEAT, AIR]), rtol=1e-6)


def test_what_read_table_reads_is_converted_too(tmp_path):
    plant = plant_with("{unit: W, column: {name: P, unit: kW}}")
    table = read_table(written(tmp_path, "t,P,air", HEAT / 1e3))
    np.testing.assert_allclose(compile_plant(plant).excitation(table).u[:, 0], HEAT)
    made = Table("made", "made", T, {"P": HEAT, "air": AIR})  # in memory: in the plant's units
    np.testing.assert_allclose(compile_plant(plant).excitation(made).u[:, 0], HEAT)


def test_a_conversion_survives_saving(tmp_path):
    plant = plant_with(
        "{unit: W, column: {name: P, unit: kW}}", "{unit: degC, column: {name: a, scale: 2, offset: -1}}"
    )
    save(plant, tmp_path / "p.yaml")
    again = load(tmp_path / "p.yaml")
    assert again == dataclasses.replace(plant, file=again.file)
    assert again.inputs["heat"].conversion == Conversion("kW") and again.inputs["air"].column == "a"
    back = as_recorded(again, {"P": HEAT, "a": AIR})
    np.testing.assert_allclose(back["P"], HEAT / 1e3)
    np.testing.assert_allclose(back["a"], (AIR + 1) / 2)


@pytest.mark.parametrize(
    "heat, says",
    [
        ("{unit: W, column: {name: P, unit: K}}", "no W"),
        ("{column: {name: P, unit: kW}}", "a 'unit' beside it was expected"),
        (
            "{unit: W, column: {name: P, unit: kW, scale: 2}}",
            "either 'unit', or 'scale' (not 0) and 'offset'",
        ),
        ("{unit: W, column: {name: P, scale: 0}}", "either 'unit', or 'scale' (not 0)"),
        ("{unit: W, column: {name: P, faktor: 2}}", "unknown key 'faktor'"),
        ("{unit: W, column: [P]}", "a column's name was expected"),
    ],
)
def test_a_wrong_column_is_one_line_with_its_place(heat, says):
    with pytest.raises(InputError) as e:
        plant_with(heat)
    assert says in str(e.value) and "<text>:4:" in str(e.value)


def test_a_header_that_cannot_be_the_plants_unit(tmp_path):
    with pytest.raises(InputError, match=r"run.csv: column 'heat' .* is no W .*; correct the header"):
        read_recordings(plant_with(), [written(tmp_path, "t,heat [degC],air")])


def test_commands_take_time_and_columns(tmp_path, capsys):
    (tmp_path / "p.yaml").write_text(ONE_BLOCK)
    rows = "\n".join(
        f"{1e3 * t:g};{h:g};{a:g}".replace(".", ",") for t, h, a in zip(T, HEAT, AIR, strict=True)
    )
    (tmp_path / "run.csv").write_text(f"clock [ms];P [W];T_air [degC]\n{rows}\n")
    options = ["--plant", str(tmp_path / "p.yaml"), str(tmp_path / "run.csv"), "--time", "clock"]
    assert (
        cli.main(["simulate", *options, "--columns", "heat=P,air=T_air", "--out", str(tmp_path / "o.csv")])
        == 0
    )
    printed = capsys.readouterr()
    assert f"note: {tmp_path / 'run.csv'}: separator ';', decimal comma" in printed.err
    assert "time converted from ms to s" in printed.err
    model = compile_plant(load(tmp_path / "p.yaml"))
    expected = model.simulate(Table("x", "x", T, {"heat": HEAT, "air": np.round(AIR, 3)})).y[:, 0]
    np.testing.assert_allclose(
        read_table(tmp_path / "o.csv").columns["temperature_simulated"], expected, atol=2e-3
    )
    assert cli.main(["simulate", *options, "--columns", "heat=P"]) == 2
    assert "no column 'air', which an input of" in (error := capsys.readouterr().err)
    assert (
        "does not read: T_air; name one: --columns air=T_air" in error and "a parameter of the plant" in error
    )


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "--plant"],
        ["refit", "--plant"],
        ["plant", "check"],
        ["diagnose", "--out", "o", "--plant"],
    ],
)
@pytest.mark.parametrize("header", ["t,heat,air,Temperature", "t,heat,air,TEMPERATURE [degC]"])
def test_a_recording_without_any_output_names_the_near_column(tmp_path, capsys, monkeypatch, command, header):
    """Only a simulation goes on without readings; the named option mends every command."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.yaml").write_text(ONE_BLOCK)
    rows = "\n".join(f"{t:g},{h:g},{a:g},22" for t, h, a in zip(T, HEAT, AIR, strict=True))
    (tmp_path / "run.csv").write_text(f"{header}\n{rows}\n")
    line = [*command, "p.yaml", *(["--data"] if "check" in command else []), "run.csv"]
    assert cli.main(line) == (0 if "simulate" in command else 2)
    name = header.split(",")[-1].split()[0]
    wanted = (
        "run.csv: no column 'temperature', which an output of p.yaml reads; columns that it does not read: "
        f"{name}; name one: --columns temperature={name}"
    )
    assert wanted in capsys.readouterr().err
    if "simulate" in command:
        assert cli.main([*line, "--columns", f"temperature={name}"]) == 0
        printed = capsys.readouterr()
        assert "rms error" in printed.out and "no column" not in printed.err


def test_an_input_that_was_constant_is_a_parameter_of_each_recording(tmp_path, capsys, monkeypatch):
    """The heat is in the files' names, not in the files: 3 W and 1 W, with 6 J/K and 0.08 W/K to air of 22 degC."""
    monkeypatch.chdir(tmp_path)
    heat = "  heat: {value: 0, unit: W, per_recording: true, values: {run_3: 3, run_1: 1}}\n"
    text = ONE_BLOCK.replace("  heat: {unit: W}\n", "").replace("parameters:\n", f"parameters:\n{heat}")
    (tmp_path / "p.yaml").write_text(text)
    for watts in (3, 1):
        warm = 22 + watts / 0.08 * (1 - np.exp(-T * 0.08 / 6))
        rows = "\n".join(f"{t:g},22,{v:.6f}" for t, v in zip(T, warm, strict=True))
        (tmp_path / f"run_{watts}.csv").write_text(f"t,air,temperature\n{rows}\n")
    assert cli.main(["refit", "--plant", "p.yaml", "run_3.csv", "run_1.csv", "--out", "o.yaml"]) == 0
    found = load("o.yaml").parameters
    assert (found["C"].value, found["G"].value) == pytest.approx((6, 0.08), rel=1e-3)
    assert found["heat"].values == {"run_3": 3, "run_1": 1}


def read_as(folder, header, columns, heat="{unit: W, column: P}", time=None):
    return read_recordings(plant_with(heat), [written(folder, header)], time, columns)[0].columns


def test_a_column_by_its_name_in_the_header_or_without_its_unit(tmp_path):
    for name in ("Input Power (mW)", "Input Power [mW]", "Input Power"):
        found = read_as(tmp_path, "Time (S),Input Power (mW),air [degC]", {"P": name}, time="Time (S)")
        np.testing.assert_allclose(found["P"], HEAT / 1e3)
    with pytest.raises(InputError, match=r"no column 'Input Power \(kW\)'.*did you mean 'Input Power'"):
        read_as(tmp_path, "t,Input Power (mW),air", {"P": "Input Power (kW)"})
    both = read_as(tmp_path, "t,x (mW),air", {"P": "x (mW)", "spare": "x"})
    np.testing.assert_allclose(both["spare"], 1e3 * both["P"])


@pytest.mark.parametrize("suffix", ["parquet", "arrow"])
def test_a_unit_in_the_name_of_an_arrow_column(tmp_path, suffix):
    made = Table("x", "x", T, {"P [mW]": HEAT, "air": AIR})
    write_table(tmp_path / f"run.{suffix}", made)
    (table,) = read_recordings(plant_with("{unit: W, column: P}"), [tmp_path / f"run.{suffix}"])
    np.testing.assert_allclose(table.columns["P"], HEAT / 1e3)


def test_columns_takes_the_name_of_an_input_that_has_a_column(tmp_path):
    np.testing.assert_allclose(read_as(tmp_path, "t,x,air", {"heat": "x"})["P"], HEAT)
    with pytest.raises(InputError, match="--columns P: .* reads column 'P' for it, which is given already"):
        read_as(tmp_path, "t,x,air", {"heat": "x", "P": "air"})
