"""What a file says: the clock by evidence, cells in every spelling, damage at its end; nothing is dropped in silence."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.logger import read_recording
from thermoctl.units import conversion

ISO = "2026-03-01 10:00:0"


def read(folder, text, **how):
    path = folder / "run.csv"
    path.write_text(text)
    return read_recording(path, **how)


def table(head, *rows):
    return head + "\n" + "\n".join(rows) + "\n"


CLOCKS = {
    "a counter before seconds": (table("Sample,Time_sec,T", "0,0.0,20", "1,0.5,21", "2,1.0,22"), [0, 0.5, 1]),
    "a counter before a date": (table("Index,Date and time,T", *(f"{i},{ISO}{i},2{i}" for i in range(3))), [0, 1, 2]),
    "a date after the values": (table("T,P,stamp", *(f"2{i},{i},{ISO}{i}" for i in range(3))), [0, 1, 2]),
    "a rising temperature first": (table("T_block,elapsed", "20,0", "21,10", "22,20"), [0, 10, 20]),
    "t is a signal": (table("time,t,T", "0,20.0,1", "10,20.5,2", "20,21.0,3"), [0, 10, 20]),
    "hours": (table("Time (hours),T", "0.0,20", "0.5,21", "1,22"), [0, 1800, 3600]),
    "a unit as a word of the name": (table("elapsed_minutes,T", "0,20", "1,21", "2,22"), [0, 60, 120]),
    "Stunden": (table("Zeit in Stunden;T", "0,0;20", "0,5;21", "1,0;22"), [0, 1800, 3600]),
    "days of Excel": (table("Date/Time,T", "46082.4166666667,20", "46082.4166782408,21", "46082.4166898148,22"), [0, 1, 2]),
    "seconds since 1904": (table("Timestamp,T", "3855204000.0,20", "3855204000.5,21", "3855204001.0,22"), [0, 0.5, 1]),
    "compact dates": (table("time,T", "20260301105958,20", "20260301105959,21", "20260301110000,22"), [0, 1, 2]),
    "compact dates with milliseconds": (table("time,T", "20260301105959500,20", "20260301110000000,21"), [0, 0.5]),
    "date and time as numbers": (table("Date,Time,T", "20260301,95959,20", "20260301,100000,21"), [0, 1]),
    "unix nanoseconds": (table("time,T", "1772359200000000000,20", "1772359200000001000,21"), [0, 1e-6]),
    "date, time, milliseconds": (table("Date,Time,ms,T", "2026/03/01,10:00:00,0,20", "2026/03/01,10:00:00,500,21"), [0, 0.5]),
    "a zone's name": (table("time,T", f"{ISO}0 CET,20", f"{ISO}1 CET,21"), [0, 1]),
    "summer time by the zone": (table("time,T", "2026-03-29 01:59:59 CET,20", "2026-03-29 03:00:00 CEST,21"), [0, 1]),
    "a time of day over a counter": (table("No,Uhrzeit,T", "1,23:59:59,20", "2,00:00:00,21"), [0, 1]),
    "minutes and seconds": (table("time,T", "10:59.5,20", "11:00.0,21"), [0, 0.5]),
    "minutes and seconds by the name": (table("Time (min:sec),T", "59:30,20", "60:00,21", "60:30,22"), [3570, 3600, 3630]),
    "the same in brackets": (table("Elapsed [mm:ss],T", "0:00,20", "0:30,21", "1:00,22"), [0, 30, 60]),
    "newest first": (table("time,T", f"{ISO}1,21", f"{ISO}0,20"), [0, 1]),
    "a counter, for want of times": (table("#;T", "1;20", "2;21", "3;22"), [1, 2, 3]),
    "an interval above the header": (table("Sampling interval: 0.5 s", "T,P", "20,1", "20,2", "20,3"), [0, 0.5, 1]),
    "a date of day once, and seconds": (table("date,seconds,T", "2026-03-01,0,20", "2026-03-01,0.5,21"), [0, 0.5]),
}  # fmt: skip


@pytest.mark.parametrize("text, t", CLOCKS.values(), ids=CLOCKS)
def test_evidence_finds_the_clock(tmp_path, text, t):
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.t, t, atol=1e-9)
    assert any(n.startswith("time from ") for n in found.notes)


@pytest.mark.parametrize(
    "header, scale",
    [
        ("Time (S)", 1), ("Time [Sec.]", 1), ("t (SEC)", 1), ("Runtime / S", 1), ("Time (MS)", 1e-3), ("Elapsed (mSec)", 1e-3),
        ("Time [Min]", 60), ("TIME (MIN.)", 60), ("Zeit [H]", 3600), ("Time (Hr)", 3600),
    ],
)  # fmt: skip
def test_a_unit_of_time_in_any_case(tmp_path, header, scale):
    assert read(tmp_path, table(f"{header},T", "0,20", "3,22", "6,21")).t.tolist() == [
        0,
        3 * scale,
        6 * scale,
    ]
    name, _, unit = header.partition(" ")
    below = table(f"{name},T", f"{unit.strip('[(/) ]')},degC", "0,20", "3,22", "6,21")
    assert read(tmp_path, below).t.tolist() == [0, 3 * scale, 6 * scale]


def test_siemens_are_no_seconds(tmp_path):
    with pytest.raises(InputError, match="unit S, increases evenly"):
        read(tmp_path, table("Conductance (S),T", "0,20", "3,22", "6,21"))
    text = table("Interval: 2 S", "Conductance (S),T", "0,20", "3,22", "6,21")
    assert read(tmp_path, text).t.tolist() == [0, 2, 4]
    assert read(tmp_path, table("x (MS),T", "0,20", "3,22"), time="x").t.tolist() == [0, 0.003]


@pytest.mark.parametrize("step, seconds", [("0.08s", 0.08), ("10 ms", 0.01), (".5 Min", 30), ("1 h", 3600)])
def test_the_time_from_row_to_row(tmp_path, step, seconds):
    for text in (table("u,y", "5,20", "3,22", "6,21"), "5 20\n3 22\n6 21\n"):
        found = read(tmp_path, text, time=step)
        np.testing.assert_allclose(found.t, [0, seconds, 2 * seconds])
        assert f"{seconds:g} s from row to row, as --time says" in found.notes and len(found.columns) == 2
    for wrong in ("10", "10 K", "0 s", "-1 s"):
        with pytest.raises(
            InputError, match=f"no column '{wrong}'.*time from row to row, such as --time 0.1s"
        ):
            read(tmp_path, text, time=wrong)


@pytest.mark.parametrize(
    "name, value, step", [("Ts", 0.2, 0.2), ("dt", 2, 2), ("Fs", 4, 0.25), ("sample_time", 0.5, 0.5)]
)
def test_matlab_states_its_interval(tmp_path, name, value, step):
    savemat = pytest.importorskip("scipy.io").savemat
    u, y = np.array([1.0, 0, 1, 1]), np.array([20.0, 22, 21, 20])
    for content in (
        {"u": u, "y": y, name: value},
        {"run": {"u": u, "y": y, name: value}},
        {"m": np.c_[u, y], name: value},
    ):
        savemat(tmp_path / "run.mat", content | {"T_room": 20.0})
        np.testing.assert_allclose(read_recording(tmp_path / "run.mat").t, step * np.arange(4))


def test_matlab_matrix_stands_beside_vectors_of_its_length(tmp_path):
    """The outputs of a whole experiment were left out without a word."""
    savemat = pytest.importorskip("scipy.io").savemat
    u, x = np.array([1.0, 0, 1, 1]), np.array([[20.0, 22, 21, 20], [5, 6, 7, 8]])
    for matrix in (x, x.T):
        savemat(tmp_path / "run.mat", {"ts": 2.0, "u": u[:, None], "x": matrix, "gains": np.ones((1, 3))})
        found = read_recording(tmp_path / "run.mat")
        np.testing.assert_allclose(found.t, 2 * np.arange(4))
        assert sorted(found.columns) == ["u", "x_1", "x_2"]
        np.testing.assert_allclose([found.columns["x_1"], found.columns["x_2"]], x)


def test_matlab_structs_keep_their_matrices_and_what_is_left_out_is_said(tmp_path):
    """A matrix of a struct, a complex or a longer vector vanished; Simulink's structure with time was refused."""
    savemat = pytest.importorskip("scipy.io").savemat
    t, rising = np.arange(6.0), 20 + np.arange(6.0)
    signals = np.zeros(2, dtype=[("values", "O"), ("label", "O")])
    signals[0], signals[1] = (np.column_stack([rising, t]), "T"), (rising[:, None], "")
    savemat(tmp_path / "run.mat", {"simout": {"time": t[:, None], "signals": signals}})
    found = read_recording(tmp_path / "run.mat")
    assert [found.columns[n][1] for n in ("T_1", "T_2", "signal_2")] == [21, 1, 21]
    log = {"t": t, "T": rising, "xy": np.column_stack([rising, t]), "n": np.arange(9.0)}
    savemat(tmp_path / "log.mat", {"log": log, "Z": rising * 1j, "cube": np.zeros((6, 2, 2))})
    found = read_recording(tmp_path / "log.mat")
    assert found.columns.keys() == {"T", "xy_1", "xy_2"}
    left = {n.partition("'")[2].partition("'")[0] for n in found.notes if "left out" in n}
    assert left == {"n", "Z", "cube"}


def test_an_assumed_unit_is_said(tmp_path):
    assert any("assumed: s" in n for n in read(tmp_path, table("time,T", "0,20", "1,21")).notes)
    assert any("a counter" in n for n in read(tmp_path, CLOCKS["a counter, for want of times"][0]).notes)


def test_two_clocks_are_two_tables(tmp_path):
    found = read(
        tmp_path, table("Time1,CH1,Time2,CH2", "0.0,20,0.0,0", "0.1,21,0.2,1", "0.2,22,0.4,2", "0.3,23,,")
    )
    np.testing.assert_allclose(found.t, [0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(found.columns["CH2"], [0, np.nan, 1, np.nan, 2])
    assert list(found.columns) == ["CH1", "CH2"]


STEADY = 1366403088.076 + 1.05 * np.arange(200)  # a logger that takes 1.05 s a row
STEADY[150:] += 3  # and stops once


def stamped(seconds):
    return [str(np.datetime64(int(s), "s")).replace("T", " ") for s in seconds]


FINE = {
    "the comma of Python's logging": [f"{d},{1e3 * (s % 1):03.0f},20" for d, s in zip(stamped(STEADY), STEADY, strict=True)],
    "nanoseconds": ["secs,nsecs,T", *(f"{int(s)},{round(1e9 * (s % 1))},20" for s in STEADY)],
    "dates, and seconds since the start": ["Time,PWM,Elapsed (s)", *(f"{d},{k % 7},{s - STEADY[0]:.3f}" for k, (d, s) in enumerate(zip(stamped(STEADY), STEADY, strict=True)))],
    "minutes, and seconds since the start": ["Elapsed (s),Date,T", *(f"{s - STEADY[0]:.3f},{d[:-3]},20" for d, s in zip(stamped(STEADY), STEADY, strict=True))],
    "dates, and a Unix time": [f"{d},{s:.6f},20" for d, s in zip(stamped(STEADY), STEADY, strict=True)],
}  # fmt: skip


@pytest.mark.parametrize("rows", FINE.values(), ids=FINE)
def test_the_finest_of_the_times_is_taken(tmp_path, rows):
    found = read(tmp_path, "\n".join(rows))
    np.testing.assert_allclose(found.t - found.t[0], STEADY - STEADY[0], atol=2e-3)
    assert rows[0].startswith("Elapsed") or found.meta["start"].startswith("2013-04-19T20:24:48")
    assert not any("rounded?" in n for n in found.notes) and sum("time from" in n for n in found.notes) == 1


def test_a_signal_is_no_millisecond_and_rounded_times_are_named(tmp_path):
    pwm = np.random.default_rng(1).integers(0, 1000, 40)
    rows = [f"{d},{p},20" for d, p in zip(stamped(STEADY[:40]), pwm, strict=True)]
    found = read(tmp_path, table("time,pwm,T", *rows))
    np.testing.assert_array_equal(found.columns["pwm"], pwm)
    assert "the times are whole multiples of 1 s and 1 or 2 s apart: rounded?" in found.notes


def test_several_times_are_one_note(tmp_path):
    rows = [
        f"{k % 3} {20 + k % 2} {1394206372724 + 500 * k + 7 * (k % 2)} {1394206486548 + 499 * k} {k / 10}"
        for k in range(9)
    ]
    found = read(tmp_path, "\n".join(rows))
    (note,) = (n for n in found.notes if "time from" in n)
    assert (
        len(found) == 9 and "'column_3'" in note and "'column_4'" in note and "other times: 'column_" in note
    )
    chosen = read(tmp_path, "\n".join(rows), time="column_3")
    np.testing.assert_allclose(chosen.t[:3], [0, 0.507, 1])


CELLS = {
    "on and off": (("OFF", "OFF", "ON"), [0, 0, 1]),
    "true and false": (("False", "True", "false"), [0, 1, 0]),
    "an und aus": (("aus", "ein", ""), [0, 1, np.nan]),
    "thousands": (('"1,100.5"', '"12,101"', '"-1,234,567.25"'), [1100.5, 12101, -1234567.25]),
    "thousands by blanks": (("1 100.5", "12 101", "0"), [1100.5, 12101, 0]),
    "Swiss thousands": (("1'100.5", "12’101", "0"), [1100.5, 12101, 0]),
    "minus signs": (("−5", "–6", "- 7"), [-5, -6, -7]),
    "minus behind, brackets": (("5-", "(6)", "+ 7"), [-5, -6, 7]),
    "quoted decimals": (('"20,5"', '"21,25"', '"-0,5"'), [20.5, 21.25, -0.5]),
    "Fortran": (("1.0D+03", "-2.5d-01", "0.D0"), [1000, -0.25, 0]),
    "units in cells": (("20 °C", "21.5°C", "n/a"), [20, 21.5, np.nan]),
    "mixed prefixes": (("500 mW", "1.2 W", "0 mW"), [500, 1200, 0]),
    "percent": (("10%", "20 %", ""), [10, 20, np.nan]),
    "no value": (("unavailable", "OVF", "3"), [np.nan, np.nan, 3]),
    "no value of Excel": (("#N/A", "#DIV/0!", "3"), [np.nan, np.nan, 3]),
}


ODD = {  # a text, its times, a column of it
    "minimum and mean below": ("t,T\n0,20\n1,21\n2,22\n3,23\nMin,20\nMean,21.5\n", [0, 1, 2, 3], "T", [20, 21, 22, 23]),
    "a sum below a blank line": ("t,T\n0,20\n1,21\n\nMean:,20.5\n", [0, 1], "T", [20, 21]),
    "header and units again": ("t,T\ns,degC\n0,20\n1,21\nt,T\ns,degC\n2,22\n3,23\n4,24\n", [0, 1, 2, 3, 4], "T", [20, 21, 22, 23, 24]),
    "units with in": ("Zeit;Temp\nin min;in °C\n0;20\n1;21\n", [0, 60], "Temp", [20, 21]),
    "blanks about quotes": ('"t" , "T"\n"0" , "20"\n"1" , "21"\n', [0, 1], "T", [20, 21]),
    "a table of Markdown": ("| t | T |\n|---|---|\n| 0 | 20 |\n| 1 | 21 |\n", [0, 1], "T", [20, 21]),
    "a unit without brackets": ("No.;Time;Temp. °C\n1;10:00:00;20\n2;10:00:01;21\n", [0, 1], "Temp.", [20, 21]),
    "a step's number before the time": ("Time Step,T,flow-time\n0,20,0\n1,21,0.5\n2,22,1\n", [0, 0.5, 1], "T", [20, 21, 22]),
    "date in parts": ("Jahr;Monat;Tag;Stunde;Minute;T\n2026;3;1;23;59;20\n2026;3;2;0;0;21\n", [0, 60], "T", [20, 21]),
    "samples are a number, no interval": ("Samples\t600\nX_Value\tT\n0,0\t20,5\n0,5\t21,5\n1,0\t22,5\n1,5\t23,5\n", [0, 0.5, 1, 1.5], "T", [20.5, 21.5, 22.5, 23.5]),
    "formulas of Excel": ('t;T\n="0";="20"\n="1";="21"\n', [0, 1], "T", [20, 21]),
    "J and N": ("t;heater\n0;N\n1;J\n2;N\n", [0, 1, 2], "heater", [0, 1, 0]),
    "milliseconds of a SCADA": ("Date,Time,Millitm,T\n" + "".join(f"03/01/2026,10:00:00,{k},{k}\n" for k in (0, 500)), [0, 0.5], "T", [0, 500]),
}  # fmt: skip


@pytest.mark.parametrize("text, t, name, values", ODD.values(), ids=ODD)
def test_odd_files(tmp_path, text, t, name, values):
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.t, t, atol=1e-9)
    np.testing.assert_allclose(found.columns[name], values)


def test_nothing_but_text_is_no_recording(tmp_path):
    with pytest.raises(InputError, match="no column of numbers beside the time"):
        read(tmp_path, "10:00:00  T0:20.0 /210.0\n10:00:01  T0:21.0 /210.0\n")
    rows = [f"Tag {i} 10 Uhr,{20 + i},{30 + i}" for i in range(4)]
    with pytest.raises(InputError, match="'Date/Time': 'Tag 0 10 Uhr' is no time .* clock is the column"):
        read(tmp_path, table("Date/Time,block time,P", *rows))


@pytest.mark.parametrize("cells, values", CELLS.values(), ids=CELLS)
def test_cells_in_every_spelling(tmp_path, cells, values):
    found = read(tmp_path, table("time,x", *(f"{i},{c}" for i, c in enumerate(cells))))
    np.testing.assert_allclose(found.columns["x"], values)
    assert found.units == (
        {"x": {"°": "degC", "m": "mW", "%": "%"}[u]}
        if (u := next((u for u in "°m%" if u in cells[0]), ""))
        else {}
    )


def test_the_whole_column_decides(tmp_path):
    rows = [f"{i},unavailable,0" for i in range(450)] + [f"{i},{i / 10},1" for i in range(450, 470)]
    found = read(tmp_path, table("time,T,P", *rows))
    assert np.isnan(found.columns["T"]).sum() == 450 and found.columns["T"][-1] == 46.9
    assert any("'unavailable' read as no value" in n for n in found.notes)
    rows = [f"{i},2{i % 10}.00," for i in range(450)] + ["450,21.0,door opened"]
    found = read(tmp_path, table("time,T,note", *rows))
    assert list(found.columns) == ["T"] and any("text left out: note" in n for n in found.notes)
    rows = [f"{i},not ready" for i in range(450)] + [f"{i},{i / 10}" for i in range(450, 470)]
    with pytest.raises(InputError, match=r":2: column 'T': 'not ready' .*--missing 'not ready'"):
        read(tmp_path, table("time,T", *rows))
    assert np.isnan(read(tmp_path, table("time,T", *rows), missing=("not ready",)).columns["T"]).sum() == 450


def test_a_number_that_means_no_value(tmp_path):
    found = read(tmp_path, table("t,T", "0,20.5", "1,-9999", "2,21"), missing=("-9999",))
    np.testing.assert_array_equal(found.columns["T"], [20.5, np.nan, 21])


def test_two_readings_of_a_number_are_an_error(tmp_path):
    text = table("time,x", '0,"1,100"', '1,"1,200"')
    with pytest.raises(InputError, match=r":2: column 'x': '1,100' .*--decimal"):
        read(tmp_path, text)
    assert read(tmp_path, text, decimal=".").columns["x"].tolist() == [1100, 1200]
    assert read(tmp_path, text, decimal=",").columns["x"].tolist() == [1.1, 1.2]
    other = table("time,x,y", '0,"1,100",20.5', '1,"1,200",20.5')
    assert read(tmp_path, other).columns["x"].tolist() == [1100, 1200]


def test_damage_is_said(tmp_path):
    found = read(tmp_path, "time,T,P\n0,20,0\n1,21,1\n2,2")
    assert found.t.tolist() == [0, 1] and any("line 4 at the end left out" in n for n in found.notes)
    found = read(tmp_path, table("time,T", "0,20", "1,21", "time,T", "2,22"))
    assert found.t.tolist() == [0, 1, 2] and any(
        "the header stands again in line 4" in n for n in found.notes
    )
    with pytest.raises(InputError, match=r":3: 1 cells; 2 as in the header"):
        read(tmp_path, table("time,T", "0,20", "1", "2,22"))
    with pytest.raises(InputError, match=r":3: column 'time': '2026-03-01 10:0' is no date"):
        read(tmp_path, table("time,n,T", f"{ISO}0,1,20", "2026-03-01 10:0,2,21", f"{ISO}2,3,22"))


@pytest.mark.parametrize("name", ["t", "time"])
def test_a_last_number_that_was_cut_is_no_number(tmp_path, name):
    rows = [f"{i},20{i}.50" for i in range(8)]
    for end in ("20", "208.5", "208."):
        found = read(tmp_path, table(f"{name},T", *rows) + f"8,{end}")
        assert len(found) == 8 and any(f"ends in '{end}'" in n for n in found.notes), end
    assert len(read(tmp_path, table(f"{name},T", *rows) + "8,208.50")) == 9
    assert len(read(tmp_path, table(f"{name},T", *rows, "8,7") + "9,208")) == 10  # digits as they come


def test_a_cut_line_of_json_and_a_broken_first_row_are_said(tmp_path):
    rows = ['{"t": 0, "T": 20}', '{"t": 1, "T": 21}', '{"t": 2, "T"']
    found = read(tmp_path, "\n".join(rows))
    assert found.t.tolist() == [0, 1] and any("line 3 at the end left out" in n for n in found.notes)
    with pytest.raises(InputError, match=r"run\.csv:2: no JSON"):
        read(tmp_path, "\n".join([rows[0], rows[2], rows[1]]))
    with pytest.raises(InputError, match=r"run\.csv:2: 2 cells; 3 as in the rows below"):
        read(tmp_path, "Time      T     P\n   0  20.0-100.0\n   1  21.0   0.0\n   2  22.0   0.0\n")


def test_a_hidden_sheet_is_the_last_one_and_formulas_without_results_are_said(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    old, new = book.active, book.create_sheet("new")
    old.sheet_state, book.active = "hidden", 1
    for k in range(3):
        old.append(["t", "T", "P"] if not k else [k, 99, 99])
        new.append(["t", "T", "P"] if not k else [k, 20 + k, f"=2*{k}"])
    book.save(tmp_path / "run.xlsx")
    found = read_recording(tmp_path / "run.xlsx")
    assert found.columns["T"].tolist() == [21, 22]
    assert any("no value at all: P (formulas without results?" in n for n in found.notes)


def test_hours_or_minutes_is_a_question(tmp_path):
    short = table("Time,T", *(f"00:{i},{i}" for i in range(50, 60)))
    for text, how in ((short, {}), (short, {"time": "Time"}), (short.replace("00:", "30:"), {})):
        with pytest.raises(InputError, match=r":2: .*:50' may be minutes .*--time 'Time \(mm:ss\)'"):
            read(tmp_path, text, **how)
    assert read(tmp_path, short, time="Time (mm:ss)").t.tolist() == list(range(50, 60))
    assert np.diff(read(tmp_path, short, time="Time (hh:mm)").t).tolist() == [60] * 9
    clear = {
        "a whole day": table("Time,T", *(f"{i // 6:02d}:{i % 6}0,{i}" for i in range(144))),
        "by the name": short.replace("Time", "Uhrzeit"),
        "with a date": table("Date,Time,T", *(f"2026-03-01,00:{i},{i}" for i in range(50, 60))),
        "in the morning": short.replace("00:", "09:"),
        "over midnight": table("Time,T", "00:30,1", "12:30,2", "23:59,3", "00:00,4"),
    }
    for why, text in clear.items():
        assert read(tmp_path, text).t[1] in (60, 600, 43200), why


def test_units_of_rows_that_are_not_one(tmp_path):
    rows = [f"{i},{20 + i},{'degC' if i < 2 else 'degF'}" for i in range(4)]
    with pytest.raises(InputError, match=r":4: .*a value in 'degF' among values in 'degC'"):
        read(tmp_path, table("time,T,Unit", *rows))
    with pytest.raises(InputError, match=r":4: column 'Unit': 'glug' after 'V'"):
        read(tmp_path, table("time,T,Unit", "0,1,V", "1,2,V", "2,3,glug"))
    found = read(tmp_path, table("time,T,H,TempUnit", "0,20,45,C", "1,21,46,C"))
    assert not found.units  # the unit is of T, not of its neighbour


def test_decimal_commas_between_commas_are_refused(tmp_path):
    for text in (
        table("time,T", "0,0,20,5", "1,0,21,5", "2,0,22,5"),
        table("time,T", "1,20,5", "2,21,5", "3,22,5"),
    ):
        with pytest.raises(InputError, match=r":1: 2 names, [34] cells .*decimal commas"):
            read(tmp_path, text)
    found = read(tmp_path, table("Zeit;P", "0;950", "1;1.000", "2;1.050"))
    assert found.columns["P"].tolist() == [950, 1000, 1050]


@pytest.mark.parametrize("sep", [";", "\t"])
def test_thousands_that_begin_below_the_first_lines(tmp_path, sep):
    """999 was followed by 1.0 where 1.000 stood below line 400, without a word."""
    rpm = 503 + np.arange(600)
    found = read(
        tmp_path,
        table(f"Zeit{sep}n", *(f"{i}{sep}{n:,}".replace(",", ".") for i, n in enumerate(rpm.tolist()))),
    )
    np.testing.assert_array_equal(found.columns["n"], rpm)
    assert any("1.000 read as 1000" in n for n in found.notes)


def test_two_runs_in_one_file(tmp_path):
    text = table("time,T", "0,20", "1,21", "time,T", "0,30", "1,31", "2,32")
    with pytest.raises(
        InputError, match=r":5: the time 0 runs backwards from 1: 2 runs in one file\? --run 1"
    ):
        read(tmp_path, text)
    assert read(tmp_path, text, run=1).columns["T"].tolist() == [20, 21]
    assert read(tmp_path, text, run=2).columns["T"].tolist() == [30, 31, 32]
    hour = table("time,T", "2026-10-25 02:59:58,20", "2026-10-25 02:59:59,21", "2026-10-25 02:00:00,22")
    with pytest.raises(InputError, match="by an hour .daylight saving"):
        read(tmp_path, hour)


@pytest.mark.parametrize(
    "choice, t, x",
    [
        ("spread", [0, 0.5, 1, 1.5, 2, 2.5], [20, 21, 22, 23, 24, 25]),
        ("mean", [0, 1, 2], [20.5, 22.5, 24.5]),
        ("first", [0, 1, 2], [20, 22, 24]),
        ("last", [0, 1, 2], [21, 23, 25]),
    ],
)
def test_equal_seconds_are_a_choice(tmp_path, choice, t, x):
    text = table("time,T", *(f"{ISO}{i // 2},{20 + i}" for i in range(6)))
    with pytest.raises(InputError, match=r":3: the time 0 stands twice.*--equal-times spread"):
        read(tmp_path, text)
    found = read(tmp_path, text, equal_times=choice)
    assert found.t.tolist() == t and found.columns["T"].tolist() == x


def test_a_header_that_lacks_a_name(tmp_path):
    with pytest.raises(InputError, match=r":1: 2 names, 3 cells in the rows below"):
        read(tmp_path, table("time,T", "0,20,5", "1,21,5", "2,22,5"))
    found = read(tmp_path, table("time,T", "1,0,20", "2,0.5,21", "3,1,22"))
    assert found.t.tolist() == [0, 0.5, 1] and found.columns["T"].tolist() == [20, 21, 22]
    assert any("lacks the first column's name" in n for n in found.notes)
    found = read(tmp_path, table("T,P", *(f"{ISO}{i},2{i},{i}" for i in range(3))))
    assert found.t.tolist() == [0, 1, 2] and found.columns["P"].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    "written, unit, factor",
    [
        ("Nm", "N*m", 1), ("mNm", "N*m", 1e-3), ("N.m", "N*m", 1), ("Ncm", "N*m", 0.01), ("Nm/A", "N*m/A", 1),
        ("U/min", "rad/s", np.pi / 30), ("RPM", "rad/s", np.pi / 30), ("rev/s", "rad/s", 2 * np.pi),
        ("min-1", "Hz", 1 / 60), ("m/s2", "m/s^2", 1), ("W/m2", "W/m^2", 1), ("m3/h", "m^3/s", 1 / 3600),
        ("LPM", "m^3/s", 1e-3 / 60), ("cfm", "m^3/s", 0.3048**3 / 60), ("Arms", "A", 1), ("VDC", "V", 1), ("KW", "W", 1000),
        ("%RH", "1", 0.01), ("bar(g)", "Pa", 1e5), ("PSI", "Pa", 6894.757293168), ("mmHg", "Pa", 133.322387),
    ],
)  # fmt: skip
def test_units_as_loggers_write_them(tmp_path, written, unit, factor):
    """pint takes Nm for a unit of yarn, U/min for one of enzymes, and cfm for a length."""
    for text in (
        table(f"time [s],x [{written}]", "0,20", "1,21"),
        table("time,x", f"s,{written}", "0,20", "1,21"),
    ):
        found = read(tmp_path, text)
        assert conversion(found.units["x"], unit) == (pytest.approx(factor), 0)


def test_names_of_parquet_state_units_as_those_of_a_text(tmp_path):
    path = tmp_path / "run.parquet"
    columns = {"time [ms]": [0, 500, 1000], "P (mW)": [1.0, 2, 3], "T": [20.0, 21, 22]}
    pq.write_table(pa.table(columns), path)
    found = read_recording(path)
    assert found.t.tolist() == [0, 0.5, 1] and found.units == {"P": "mW"} and "P" in found.columns


def test_a_counter_does_not_replace_times_that_cannot_be_read(tmp_path):
    rows = [f"{i},0:00:00:0{i}.5,2{i}" for i in range(3)]
    with pytest.raises(InputError, match=r":2: column 'Elapsed': '0:00:00:00.5' is no time .*'Scan'"):
        read(tmp_path, table("Scan,Elapsed,T", *rows))
    assert read(tmp_path, table("Scan,Elapsed,T", *rows), time="Scan").t.tolist() == [0, 1, 2]


FACTORS = {
    "time (0.1 ms)": "time \\(0.1 ms\\)' counts in steps",
    "t [10 ms]": "t \\[10 ms\\]' counts in steps",
    "time_10ms": "counts in steps",
    "Zeit [1/100 s]": "counts in steps",
    "t (10^-3 s)": "no other that is a time for sure",
    "time [ticks]": "no unit of time that is known",
    "time (samples)": "no unit of time that is known",
    "Time (HH)": "no unit of time that is known",
    "Zeit (Âµs)": "no unit of time that is known",
}


@pytest.mark.parametrize("header", FACTORS)
def test_a_time_whose_unit_has_a_factor_is_refused(tmp_path, header):
    """`0.1 ms` was read as ms, `10 ms` as s."""
    path = tmp_path / "run.csv"
    path.write_text(f"{header},U\n" + "".join(f"{i},{20 + i}\n" for i in range(6)))
    with pytest.raises(InputError, match=FACTORS[header]):
        read_recording(path)


@pytest.mark.parametrize(
    "text", ["t,T [0.1 degC]\n0,200\n1,201\n2,202\n", "t,T\ns,0.1 degC\n0,200\n1,201\n2,202\n"]
)
def test_a_factor_stays_in_the_unit_which_no_plant_takes(tmp_path, text):
    """The column was called `0.1 degC`, in tesla; below a header the unit vanished."""
    (tmp_path / "run.csv").write_text(text)
    assert read_recording(tmp_path / "run.csv").units["T"] == "0.1 degC"
    with pytest.raises(ValueError, match="scaling factor"):
        conversion("0.1 degC", "degC")


@pytest.mark.parametrize("unit, kept", [("BTU/h", "BTU/h"), ("[cnt]", "cnt"), ("on/off", None), ("-", None)])
def test_an_unknown_unit_below_the_header_is_kept(tmp_path, unit, kept):
    """It vanished, so that a plant took 341 BTU/h for 341 W; in the header's brackets it stayed."""
    found = read(tmp_path, table("Time,P,T", f"s,{unit},degC", "0,341,20", "1,341,21", "2,341,22"))
    assert (found.units.get("P"), found.units["T"]) == (kept, "degC")


def test_milliseconds_of_an_epoch_in_a_column_t_are_no_seconds(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,T\n" + "".join(f"{1773480000000 + 100 * i},{20 + i}\n" for i in range(6)))
    np.testing.assert_allclose(read_recording(path).t, 0.1 * np.arange(6))


@pytest.mark.parametrize(
    "rows,note",
    [("{i};1.{i}00;20\n", "1.000 read with a decimal point"), ("{i},5;1.{i}00\n", "'P': 1.000 read as 1000")],
)
def test_a_point_that_may_part_thousands_is_noted(tmp_path, rows, note):
    path = tmp_path / "run.csv"
    header = "Zeit;P;T\n" if rows.count(";") == 2 else "Zeit;P\n"
    path.write_text(header + "".join(rows.format(i=i) for i in range(6)))
    assert any(note in n for n in read_recording(path).notes)


@pytest.mark.parametrize("title", ["", "Motor test;;\n"])
@pytest.mark.parametrize("units", ["s;mA;degC", "[s];[mA];[degC]"])
def test_units_above_the_names(tmp_path, title, units):
    """They were left out, or were the names, and milliamperes were read as amperes."""
    found = read(tmp_path, f"{title}{units}\ntime;I;T\n0;1;20\n1;2;21\n2;4;23\n")
    assert found.t.tolist() == [0, 1, 2] and found.columns["I"].tolist() == [1, 2, 4]
    assert found.units == {"I": "mA", "T": "degC"}


@pytest.mark.parametrize("units", [";mA;degC", "Logger 7;;\n;[mA];[degC]"], ids=["plain", "below a title"])
def test_units_above_the_names_without_one_of_the_time(tmp_path, units):
    """The line was left out, and milliamperes were read as amperes."""
    found = read(tmp_path, f"{units}\nDate;I;T\n2026-03-01 10:00:00;1;20\n2026-03-01 10:00:01;2;21\n")
    assert found.units == {"I": "mA", "T": "degC"} and found.t.tolist() == [0, 1]


def test_letters_of_channels_above_the_names_are_no_units(tmp_path):
    found = read(tmp_path, "A;V;C\ntime;speed;flow\n0;1;20\n1;2;21\n2;4;23\n")
    assert found.units == {} and list(found.columns) == ["speed", "flow"]


def test_a_header_with_units_of_its_own_keeps_them(tmp_path):
    found = read(tmp_path, "s;mA;degC\ntime [s];I [A];T [degC]\n0;1;20\n1;2;21\n2;4;23\n")
    assert found.units == {"I": "A", "T": "degC"}
