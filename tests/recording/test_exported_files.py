"""Files as programs and devices export them: inputs of our own, compared with the numbers that they hold."""

import bz2
import io
import lzma
import pickle
from datetime import timedelta

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.recording.test_field import read, table
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.logger import read_recording

ROWS = range(10)
EDGES = '"time","T"', *(f'"{k}.0","{20 + k}.75"' for k in ROWS)


@pytest.mark.parametrize(
    "lines, t, columns, units",
    [
        (
            ['"report-def-0-rfile"', '"Time Step" "report-def-0 etc.."', '("Time Step" "report-def-0" "flow-time")']
            + [f"{k + 1} 300.{k} 0.{k}" for k in ROWS],
            [k / 10 for k in ROWS], {"report-def-0": [300 + k / 10 for k in ROWS]}, {},
        ),
        (
            ["% Model:              oven.mph", "% Time (s)        T (degC), Point 1   P (W), Global"]
            + [f"{k}                  2{k}.5                1" for k in ROWS],
            ROWS, {"T, Point 1": [20.5 + k for k in ROWS]}, {"T, Point 1": "degC", "P, Global": "W"},
        ),
        (
            ["# name: data", "# type: matrix", "# rows: 10", "# columns: 2", *(f" {k}.5 2{k}.5" for k in ROWS)],
            ROWS, {"column_2": [20.5 + k for k in ROWS]}, {},
        ),
        (
            ["Index,Reading,Unit,Date,Time,Fractional Seconds"]
            + [f"{k},2{k}.5,Celsius,03/14/2026,10:00:0{k // 2},0.{25 + 50 * (k % 2)}0" for k in ROWS],
            [k / 2 for k in ROWS], {"Reading": [20.5 + k for k in ROWS]}, {"Reading": "degC"},
        ),
        (
            ["Date/Time,Unit,Value", *(f"3/14/26 10:00:0{k} AM,C,2{k}.5" for k in ROWS)],
            ROWS, {"Value": [20.5 + k for k in ROWS]}, {"Value": "degC"},
        ),
        (
            ["Line#,Date,Temp - °C (S-THB 10253456:10253457-1)", *(f"{k},03/14/26 10:00:0{k},2{k}.5" for k in ROWS)],
            ROWS, {"Temp": [20.5 + k for k in ROWS]}, {"Temp": "degC"},
        ),
        (
            ["_id,_name,_numericid,_value,_timestamp,_quality"]
            + [f"{k},Oven.{'PS'[k % 2]}V,0,2{k}.5,2026-03-14 10:00:0{k // 2}.000,192" for k in ROWS],
            range(5), {"Oven.PV": [20.5, 22.5, 24.5, 26.5, 28.5], "Oven.SV": [21.5, 23.5, 25.5, 27.5, 29.5]}, {},
        ),
    ],
    ids=["Fluent", "COMSOL", "Octave", "Keithley", "iButton", "HOBOlink", "KEPServer"],
)  # fmt: skip
def test_tables_of_programs(tmp_path, lines, t, columns, units):
    found = read(tmp_path, table(*lines))
    np.testing.assert_allclose(found.t - found.t[0], t)
    assert {n: found.columns[n].tolist() for n in columns} == columns
    assert {n: found.units[n] for n in units} == units


LONG = {
    "no value by name": ("time,loc,T [degC]", "{0},in,2{0}.5\n{0},out,1{0}.5", "in_T [degC]", "out_T [degC]"),
    "two values": ("time,unit_name,T,P", "{0},a,2{0}.5,1\n{0},b,1{0}.5,2", "a_T", "b_T"),
    "numbers of sensors": ("time,sensor_id,T", "{0},1,2{0}.5\n{0},2,1{0}.5", "sensor_id_1_T", "sensor_id_2_T"),
    "a name that is not known": ("time,Probe,Reading", "{0},TC1,2{0}.5\n{0},TC2,1{0}.5", "TC1", "TC2"),
    "no header": ("2026-03-01 10:00:00,a,20.5", "2026-03-01 10:00:0{0},a,2{0}.5\n2026-03-01 10:00:0{0},b,1{0}.5", "a", "b"),
}  # fmt: skip


@pytest.mark.parametrize("how", LONG)
def test_rows_of_several_sensors(tmp_path, how):
    """They were refused with --equal-times mean as the cure, which takes the mean of two sensors."""
    head, rows, *names = LONG[how]
    first = [head] if "10:00" not in head else []
    found = read(tmp_path, table(*first, *(rows.format(k) for k in ROWS)))
    for name, low in zip(names, (20.5, 10.5), strict=True):
        name, _, unit = name.partition(" ")
        assert found.columns[name].tolist() == [low + k for k in ROWS]
        assert found.units.get(name, "") == unit.strip("[]")


def test_sensors_that_take_turns_are_not_one_column(tmp_path):
    """T was 20, 10, 21, 11 ... with a note that `sensor` is a column of text."""
    rows = (
        f"{2 * k + i},{name},{low + k}" for k in ROWS for i, (name, low) in enumerate((("a", 20), ("b", 10)))
    )
    found = read(tmp_path, table("time,sensor,T", *rows))
    assert found.columns["a_T"][::2].tolist() == [20 + k for k in ROWS]
    assert found.columns["b_T"][1::2].tolist() == [10 + k for k in ROWS]


@pytest.mark.parametrize("words", [("on", "off"), ("ok", "ok")])
def test_states_and_remarks_name_no_sensors(tmp_path, words):
    lines = (f"{k},{w},{k}.5" for k in ROWS for w in words)
    with pytest.raises(InputError, match="--equal-times"):
        read(tmp_path, table("time,state_of_door,T", *lines))
    lines = (f"{k},{'heating' if k < 5 else 'cooling'},{k}.5" for k in ROWS)
    assert list(read(tmp_path, table("time,item,T", *lines)).columns) == ["T"]


@pytest.mark.parametrize(
    "text",
    [
        "***BUSMASTER Ver 3.2.2***\n***HEX***\n10:00:00:0001 Rx 1 0x321 s 2 00 01\n",
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n1660,321,false,Rx,0,1,00\n",
    ],
)
def test_further_logs_of_frames(tmp_path, text):
    with pytest.raises(InputError, match="frames of a CAN bus"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    "lines",
    [
        [*EDGES, '"10.0","40.'],
        [*EDGES[:4], '"3.0","4'],  # few rows: the open quote tells
        ["t,P", *(f"{k},{1000 + 7 * k}" for k in ROWS), "10,10"],
    ],
)
def test_a_last_number_without_its_end_is_left_out(tmp_path, lines):
    """It was read as 40, 4 and 10 without a word."""
    found = read(tmp_path, "\n".join(lines))
    assert len(found) == len(lines) - 2 and any("cut off?" in n for n in found.notes)


def test_words_for_no_value_between_marks(tmp_path):
    words = "[N/A]", "-----OL-----", "<NULL>", "*OVER*", "OFL", "#####", "Fühlerbruch", "n.c."
    for word in words:
        found = read(tmp_path, table("t,T", *(f"{k},{word if k == 4 else 20 + k}" for k in ROWS)))
        assert np.isnan(found.columns["T"][4]) and np.isfinite(found.columns["T"]).sum() == 9, word


@pytest.mark.parametrize(
    "form, step",
    [
        ("{m}m30s", 60), ("PT{m}M30.5S", 60), ("1h {m}m", 60), ("10h{m:02d}m05s", 60), ("0 days {m} hours", 3600),
        ("{d}.{h:02d}:00:00", 3600), ("PM 10:{m:02d}:00", 60), ("2026/03/14 PM 10:{m:02d}:00", 60),
        ("\u200e14/\u200e03/\u200e2026 \u200f\u200e10:{m:02d}:00", 60),
    ],
)  # fmt: skip
def test_further_forms_of_times(tmp_path, form, step):
    times = [form.format(m=k, d=k // 24, h=k % 24) for k in range(30)]
    found = read(tmp_path, table("Elapsed,T", *(f"{time},{k}.5" for k, time in enumerate(times))))
    np.testing.assert_allclose(found.t - found.t[0], step * np.arange(30.0))


def test_days_that_dot_net_leaves_out(tmp_path):
    shown = [str(timedelta(hours=k)).replace(" day, ", ".").replace(" days, ", ".") for k in range(0, 60, 6)]
    found = read(tmp_path, table("Elapsed,T", *(f"{s},1" for s in shown)))
    np.testing.assert_allclose(found.t, 6 * 3600.0 * np.arange(10))


def test_lengths_are_no_durations(tmp_path):
    found = read(tmp_path, table("t,x", *(f"{k},{k}.5m" for k in ROWS)))
    assert found.units == {"x": "m"} and found.columns["x"][2] == 2.5


NUMPY = io.BytesIO()
np.save(NUMPY, np.zeros((3, 2)))
NO_TABLES = {
    "pickle": pickle.dumps({"t": 1}, protocol=4), "NumPy": NUMPY.getvalue(), "xz": lzma.compress(b"t,T\n0,1\n1,2\n2,3\n"),
    "bzip2": bz2.compress(b"t,T\n0,1\n1,2\n2,3\n"), "SQLite": b"SQLite format 3\0" + bytes(99), "MCAP": b"\x89MCAP0\r\n" + bytes(99),
    "Git LFS": b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", "TOA5": b'"TOB1","CR5000"\r\n\0\1',
    "web page": b"\xef\xbb\xbf\n<!DOCTYPE html><html><body>404</body></html>\n", "Feather 2": b"FEA1" + bytes(99),
    "XML": b"<?xml version='1.0'?>\n<a/>",
}  # fmt: skip


@pytest.mark.parametrize("word", NO_TABLES)
def test_files_that_are_no_tables_are_named(tmp_path, word):
    """`was the file cut off?` was asked of a NumPy file, and a small xz archive was read as numbers."""
    (tmp_path / "run.csv").write_bytes(NO_TABLES[word])
    with pytest.raises(InputError, match=word):
        read_recording(tmp_path / "run.csv")


def test_columns_of_a_struct_and_views_of_texts(tmp_path):
    stamps = [f"2026-03-14 10:00:0{k}" for k in ROWS]
    both = pa.array([{"T": 20.5 + k, "P": float(k)} for k in ROWS])
    pq.write_table(
        pa.table({"time": pa.array(stamps, pa.string_view()), "v": both}), tmp_path / "run.parquet"
    )
    found = read_recording(tmp_path / "run.parquet")
    assert found.t.tolist() == [*ROWS] and found.columns["v.T"].tolist() == [20.5 + k for k in ROWS]


def test_a_sheet_of_a_text_is_a_note(tmp_path):
    found = read(tmp_path, table("t,T", "0,20", "1,21"), sheet="Data")
    assert "--sheet Data has no effect: text has no sheets" in found.notes


def test_units_of_ni_hardware_and_frames_of_a_bus(tmp_path):
    nptdms, asammdf = pytest.importorskip("nptdms"), pytest.importorskip("asammdf")
    said = {"wf_increment": 0.5, "NI_UnitDescription": "Deg C"}
    with nptdms.TdmsWriter(str(tmp_path / "run.tdms")) as writer:
        writer.write_segment([nptdms.ChannelObject("A", "T", np.arange(4.0), properties=said)])
    assert read_recording(tmp_path / "run.tdms").units == {"T": "degC"}
    frames = np.zeros(4, [("CAN_DataFrame.BusChannel", "u1"), ("CAN_DataFrame.ID", "<u4")])
    with asammdf.MDF() as mdf:
        mdf.append([asammdf.Signal(frames, np.arange(4.0), name="CAN_DataFrame")])
        mdf.save(tmp_path / "bus.mf4")
    with pytest.raises(InputError, match="frames of a CAN bus"):
        read_recording(tmp_path / "bus.mf4")


@pytest.mark.parametrize(
    "header, step, units",
    [
        ("时间（毫秒）,温度（℃）,功率（kW）", 1e-3, {"温度": "degC", "功率": "kW"}),
        ("経過時間(ミリ秒),温度[℃],電力[W]", 1e-3, {"温度": "degC", "電力": "W"}),
        ("시간(분),온도(℃),전력(W)", 60, {"온도": "degC", "전력": "W"}),
        ("Время (мин),Температура (°С),Мощность (кВт)", 60, {"Температура": "degC", "Мощность": "kW"}),
        ('"Время, с","Температура, °С","Ток, мА"', 1, {"Температура": "degC", "Ток": "mA"}),
        ("Czas [godz.],T [°C],P [W]", 3600, {"T": "degC", "P": "W"}),
        ("Tid (timmar),T (°C),P (W)", 3600, {"T": "degC", "P": "W"}),
        ("time,T,Phase - A", 1, {}),
    ],
)
def test_headers_of_other_languages(tmp_path, header, step, units):
    """Brackets of Chinese keyboards and Cyrillic letters lost the units without a word."""
    found = read(tmp_path, table(header, *(f"{k},2{k}.5,{k}" for k in ROWS)))
    np.testing.assert_allclose(found.t, [step * k for k in ROWS])
    assert {n: u for n, u in found.units.items() if n in found.columns} == units


def test_a_header_of_two_columns_is_no_statement_of_a_unit(tmp_path):
    """The unit of the time was 'T (°)'."""
    assert read(tmp_path, table("time,T (°)", *(f"{k},2{k}.5" for k in ROWS))).units == {"T": "deg"}


def test_words_in_place_of_numbers_are_shown(tmp_path):
    """The time was listed as a column of text."""
    with pytest.raises(InputError, match=r"columns of text: P \('1\.00x10\^3'\)$"):
        read(tmp_path, table("time,P", *(f"{k},1.0{k}x10^3" for k in ROWS)))


def test_units_in_wide_brackets_below_the_names(tmp_path):
    """The units were the names, each a column too far to the right, and a counter was the time."""
    found = read(tmp_path, table("时间,温度,功率", "（s）,（℃）,（kW）", *(f"{k},2{k}.5,{k}" for k in ROWS)))
    assert found.units == {"温度": "degC", "功率": "kW"}
    assert found.columns["温度"].tolist() == [20.5 + k for k in ROWS]


@pytest.mark.parametrize("first, head", [("{0}", "time T P"), ("10:00:0{0}", "Uhrzeit T P")])
def test_decimal_commas_between_blanks(tmp_path, first, head):
    """The commas were taken for separators, and a name was said to lack."""
    found = read(tmp_path, table(head, *(first.format(k) + f" 2{k},5 {k}" for k in ROWS)))
    assert found.t.tolist() == [*ROWS] and found.columns["T"].tolist() == [20.5 + k for k in ROWS]


def test_a_date_without_its_year(tmp_path):
    found = read(tmp_path, table("Zeit;T", *(f"14.03. 10:0{k};2{k},5" for k in ROWS)))
    assert found.t.tolist() == [60 * k for k in ROWS] and found.meta["start"].startswith("1900-03-14")
