"""Kinds of files that strangers have: each case is a small text after a file of a real instrument."""

from datetime import datetime, timedelta

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.logger import joined, read_recording


def read(folder, text, name="run.csv", **how):
    path = folder / name
    path.write_text(text)
    return read_recording(path, **how)


def rows(*lines):
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "text, name, values",
    [
        ("20.5\n21.5\n22.5\n", "column_1", [20.5, 21.5, 22.5]),
        ("T [degC]\n20.5\n21.5\n22.5\n", "T", [20.5, 21.5, 22.5]),
        ("T\n20,5\n21,5\n22,5\n", "T", [20.5, 21.5, 22.5]),
    ],
)
def test_one_column_with_a_stated_step(tmp_path, text, name, values):
    found = read(tmp_path, text, time="0.1s")
    assert found.columns[name].tolist() == values
    np.testing.assert_allclose(found.t, [0, 0.1, 0.2])


def test_one_column_of_words_is_no_table(tmp_path):
    with pytest.raises(InputError, match="no columns"):
        read(tmp_path, "one\ntwo\nthree\n", time="0.1s")


def test_rows_end_in_a_separator_that_the_header_lacks(tmp_path):
    text = rows(",CH1,CH2", "Second,Volt,Volt", *(f"{i}e-3,{i},{2 * i}," for i in range(-3, 3)))
    found = read(tmp_path, text)
    assert list(found.columns) == ["CH1", "CH2"] and found.units == {"CH1": "V", "CH2": "V"}
    np.testing.assert_allclose(found.t, np.arange(-3, 3) / 1000)


def test_numbers_between_blanks_have_a_column_each(tmp_path):
    text = rows(*(f" 2019  56  2 25  0  {i}  {20 + i}.5" for i in range(6)))
    found = read(tmp_path, text, time="60s")
    assert len(found.columns) == 7 and found.columns["column_7"].tolist() == [20.5 + i for i in range(6)]


LVM = (
    "LabVIEW Measurement",
    *(f"Setting_{i}\t{i}" for i in range(9)),
    "***End_of_Header***\t",
    "Channels\t1\t\t1",
    "Delta_X\t{step}\t\t{step}",
    "***End_of_Header***\t\t\t",
)


@pytest.mark.parametrize("step", ["0.5", "1.0"])
def test_few_rows_below_a_long_header_and_a_time_beside_each_channel(tmp_path, step):
    body = [f"{0.5 * i}\t{20 + i}\t{0.5 * i}\t{i}" for i in range(3)]
    text = rows(*LVM, "X_Value\tT\tX_Value\tP\tComment", *body).format(step=step)
    found = read(tmp_path, text, "run.lvm")
    assert list(found.columns) == ["T", "P"] and found.columns["P"].tolist() == [0, 1, 2]
    assert found.t.tolist() == [0, 0.5, 1]


def test_uneven_times_are_used_before_a_nominal_step(tmp_path):
    times = [0, 0.33, 1.21, 1.53, 1.93, 2.84, 3.83, 7.96]
    body = [f"{t}\t{20 + i}\tOK" for i, t in enumerate(times)]
    found = read(tmp_path, rows(*LVM, "X_Value\tT\tComment", *body).format(step=1), "run.lvm")
    np.testing.assert_allclose(found.t, times)


def test_units_behind_a_slash(tmp_path):
    text = rows(
        "mode\tox/red\ttime/s\tEwe/V\tI/mA\tCapacity/mAh/g\tQ charge/discharge/mA.h\t(Q-Qo)/C",
        *(f"1\t0\t{10 * i}\t3.{i}\t{i}\t{i}\t{i}\t{i}" for i in range(4)),
    )
    found = read(tmp_path, text)
    units = {"Ewe": "V", "I": "mA", "Capacity": "mAh/g", "Q charge/discharge": "mA*h", "(Q-Qo)": "C"}
    assert found.units == units and {"mode", "ox/red"} < set(found.columns)
    assert found.t.tolist() == [0, 10, 20, 30]


def test_a_temperature_before_a_slash(tmp_path):
    found = read(tmp_path, rows("date;T/°C;RH/%", *(f"07.08.25,00:{m}:00;22;{m}" for m in (10, 20, 30))))
    assert found.units == {"T": "degC", "RH": "%"} and found.t.tolist() == [0, 600, 1200]


@pytest.mark.parametrize("written", ["oC", "ºC", "˚C", "Â°C", "\ufffdC"])
def test_a_degree_in_another_letter(tmp_path, written):
    names, units = ["Date", "a", "b", "c"], ["", "lx", written, "lxh"]
    text = rows(*map(",".join, (names, units)), *(f"2026-03-01 10:00:0{i},1,2{i},3" for i in range(4)))
    assert read(tmp_path, text).units["b"] == "degC"


def test_a_duration_is_no_step(tmp_path):
    with pytest.raises(InputError, match="no other that is a time"):
        read(tmp_path, rows("Record time: 815.06", *(f"{42 + i % 3}.5" for i in range(9))))


def test_dates_without_a_name_are_finer_than_rounded_days(tmp_path):
    text = rows(",Date/Time,T", *(f"2021-11-12 15:{m}:00,{44512.66 + m / 1440:.5f},2" for m in (10, 25, 40)))
    found = read(tmp_path, text)
    assert found.t.tolist() == [0, 900, 1800]


def test_a_time_without_a_name_is_called_by_its_place(tmp_path):
    text = rows(
        ",Time,1",
        "S/N,,0000",
        "Type,,TGU",
        "Property,,T",
        *(f"{i},2021-07-26 14:0{i}:00,2{i}" for i in range(5)),
    )
    found = read(tmp_path, text)
    assert found.t.tolist() == [0, 60, 120, 180, 240]
    assert any("time from column 2" in n for n in found.notes)


def test_a_slash_that_parts_levels_and_units_that_have_one(tmp_path):
    text = rows("time,kitchen/V,phase/A,W/m2", *(f"{i},{i},{i},{i}" for i in range(4)))
    found = read(tmp_path, text)
    assert list(found.columns) == ["kitchen/V", "phase/A", "W/m2"] and not found.units


def test_a_share_of_retention_is_no_time(tmp_path):
    text = rows("CapC/mAh,CapD/mAh,RetentionD/%", *(f"{i % 3},{i % 2},{i}" for i in range(6)))
    with pytest.raises(InputError, match="no other that is a time"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    "cells, t",
    [
        (["2024/1/5 9:5:3", "2024/1/5 9:5:4", "2024/1/5 10:0:0"], [0, 1, 3297]),
        (["0d 00:00:0", "0d 00:00:5.05000019073486", "0d 00:01:0.5"], [0, 5.050000190, 60.5]),
        (["20160101:0010", "20160101:0110", "20160101:0210"], [0, 3600, 7200]),
        (["2020-06-01T12:00:00.0/2020-06-01T12:01:00.0", "2020-06-01T12:01:00.0/2020-06-01T12:02:00.0"], [0, 60]),
        (["01.01.2020 00:00 - 01.01.2020 00:15", "01.01.2020 00:15 - 01.01.2020 00:30"], [0, 900]),
        (["10:00:05:7", "10:00:06:7"], [0, 1]),
        (["2025011922", "2025011923", "2025012000"], [0, 3600, 7200]),
        (["0 23:59:59.5", "1 00:00:00.0"], [86399.5, 86400]),
        (["23:30:00 30/Nov/2025", "00:00:00 01/Dec/2025"], [0, 1800]),
        (["11:30:00 PM 11/30/2025", "12:00:00 AM 12/01/2025"], [0, 1800]),
    ],
)  # fmt: skip
def test_times_in_further_spellings(tmp_path, cells, t):
    found = read(tmp_path, rows("time,T", *(f"{c},2{i}" for i, c in enumerate(cells))))
    np.testing.assert_allclose(found.t, t, atol=1e-8)


def test_points_part_the_day_first_with_halves_of_the_day_too(tmp_path):
    found = read(tmp_path, rows("time,T", "10.09.2021 11:59:59 am,20", "10.09.2021 12:00:00 pm,21"))
    assert str(found.meta["start"]).startswith("2021-09-10T11:59:59") and found.t.tolist() == [0, 1]


def test_day_and_month_of_uneven_rows_past_midnight(tmp_path):
    begin, steps = datetime(2021, 5, 5, 23, 45), [0.01, 0.02, 120, 5, 700, 0.03, 60, 60, 1]
    stamps = [begin + timedelta(seconds=s) for s in np.cumsum([0, *steps])]
    text = rows("time,T", *(f"{s:%m/%d/%Y %H:%M:%S.%f},{i}" for i, s in enumerate(stamps)))
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.t, np.cumsum([0, *steps]), atol=1e-5)


@pytest.mark.parametrize(
    "names, first", [("Date,Hour", 0), ("Date,Hour Ending", 1), ("date,time", 0), ("Datum,HH", 1)]
)
@pytest.mark.parametrize("form", ["%Y-%m-%d", "%d.%m.%Y", "%Y%m%d"])
def test_a_date_and_its_hours(tmp_path, names, first, form):
    stamps = [datetime(2026, 3, 1) + timedelta(hours=k) for k in range(40)]
    body = [f"{s.strftime(form)},{s.hour + first},{20 + s.day}" for s in stamps]
    found = read(tmp_path, rows(f"{names},T", *body))
    np.testing.assert_allclose(found.t, 3600.0 * np.arange(40))
    assert any("hours of the day" in n for n in found.notes)
    assert str(found.meta["start"]).startswith(f"2026-03-01T0{first}:00")


def test_the_error_names_texts_that_may_be_times(tmp_path):
    with pytest.raises(InputError, match="no time in a form that is known: 'when': 'W05-2026"):
        read(tmp_path, rows("when,T", *(f"W05-2026 t{i},{20 + i % 2}" for i in range(4))))


def test_a_name_twice_in_parquet(tmp_path):
    numbers = [pa.array([0.0, 1.0]), pa.array([20.0, 21.0]), pa.array([3.0, 4.0])]
    for time in ("t", "time"):
        pq.write_table(pa.table(numbers, names=[time, "T", "T"]), tmp_path / "run.parquet")
        found = read_recording(tmp_path / "run.parquet")
        assert {n: c.tolist() for n, c in found.columns.items()} == {"T_1": [20, 21], "T_2": [3, 4]}
        assert any("'T' stands 2 times" in n for n in found.notes)


def test_utc_and_local_times_are_not_mixed(tmp_path):
    stamps = [f"2026-03-01T10:00:0{i}" for i in range(3)]
    mixed = rows("Time1,A,Time2,B", *(f"{s},{i},{s}.5Z,{i}" for i, s in enumerate(stamps)))
    with pytest.raises(InputError, match="UTC"):
        read(tmp_path, mixed)
    with pytest.raises(InputError, match="a time without a zone among others"):
        read(tmp_path, rows("time,T", f"{stamps[0]}Z,1", f"{stamps[1]},2"))
    local = read(tmp_path, rows("time,T", *(f"{s},1" for s in stamps)), "a.csv")
    utc = read(tmp_path, rows("time,T", *(f"{s.replace('T10', 'T11')}Z,1" for s in stamps)), "b.csv")
    with pytest.raises(InputError, match="b.csv: times in UTC beside"):
        joined([local, utc])


def test_the_first_row_ends_in_a_serial_number(tmp_path):
    body = [f"{i + 1},2026-03-01 10:0{i}:00,2{i}.5,4{i}.0" + ",010012345" * (i == 0) for i in range(5)]
    found = read(tmp_path, rows("EL-USB-2,Time,Celsius(°C),Humidity(%rh),Serial Number", *body))
    assert found.columns["Celsius"].tolist() == [20.5, 21.5, 22.5, 23.5, 24.5]
    assert found.units == {"Celsius": "degC", "Humidity": "%"} and found.t[-1] == 240
    with pytest.raises(InputError, match="5 cells; 4 as in the header"):
        read(tmp_path, rows("No,Time,Celsius(°C),Humidity(%rh)", *body))


@pytest.mark.parametrize(
    "header, names, units",
    [
        ("°C [Kanal 1],%rF [Kanal 2]", ["Kanal 1", "Kanal 2"], {"Kanal 1": "degC", "Kanal 2": "%"}),
        ("motor[0],axis [2]", ["motor[0]", "axis [2]"], {}),
        ("motor[1],eta [1]", ["motor[1]", "eta"], {"eta": "1"}),
        ("Meters/second,W per hour", ["Meters/second", "W per hour"], {}),
    ],
)
def test_brackets_and_rates_in_names(tmp_path, header, names, units):
    found = read(tmp_path, rows(f"Time [s],{header}", *(f"{i / 2},{i},{i}" for i in range(5))))
    assert list(found.columns) == names and found.units == units
    assert found.t.tolist() == [0, 0.5, 1, 1.5, 2]


@pytest.mark.parametrize(
    "head",
    [
        ("timestamp,System [0],Battery [1]", "timezone,PV power,Voltage", "Europe/Berlin (+01:00),W,V"),
        (",123,123", ",PV power,Voltage", ",Counter,Analog", "dd/MM/yyyy HH:mm:ss,W,V"),
    ],
)
def test_a_long_cell_where_the_time_has_its_unit(tmp_path, head):
    found = read(tmp_path, rows(*head, *(f"2026-03-01 10:0{i}:00,{i},5{i}.2" for i in range(6))))
    assert found.units == {"PV power": "W", "Voltage": "V"} and found.columns["Voltage"][0] == 50.2


def test_parts_of_a_date_without_a_year(tmp_path):
    stamps = [datetime(2001, 2, 28, 22) + timedelta(hours=k) for k in range(4)]
    text = rows("Month,Day,Hour,T", *(f"{s.month},{s.day},{s.hour},{k}" for k, s in enumerate(stamps)))
    found = read(tmp_path, text)
    assert found.t.tolist() == [0, 3600, 7200, 10800] and "start" not in found.meta


def test_lines_in_quotes(tmp_path):
    found = read(
        tmp_path,
        rows(
            "[Summary]", "Cell: 1", '"Date;T;P"', *(f'"01.03.2026 10:0{i}:00;2{i},5;{i}"' for i in range(4))
        ),
    )
    assert found.columns["T"].tolist() == [20.5, 21.5, 22.5, 23.5] and found.t[-1] == 180


def test_hdf5_of_other_programs(tmp_path):
    path, ns = tmp_path / "run.h5", 1_772_359_200_000_000_000 + 10**9 * np.arange(9)
    table = np.zeros(9, dtype=[("time", "f8"), ("T", "f4"), ("axes", "f8", (2,))])
    table["time"], table["T"] = np.arange(9) / 2, 20 + np.arange(9)
    with h5py.File(path, "w") as file:
        file["rig/time"] = np.arange(9) / 2
        file["rig/T"] = 20.0 + np.arange(9)
        file["rig/T"].attrs["units"] = "°C"
        file["table"] = table
        file["frame/axis0"] = [b"T", b"P"]
        file["frame/axis1"] = ns
        file["frame/axis1"].attrs["kind"] = b"datetime64"
        file["frame/block0_items"] = [b"T", b"P"]
        file["frame/block0_values"] = np.arange(18.0).reshape(9, 2)
    rig, frame = read_recording(path, sheet="rig"), read_recording(path, sheet="frame")
    assert rig.units == {"T": "degC"} and rig.t[-1] == 4 and rig.columns["T"].tolist() == [*range(20, 29)]
    assert list(frame.columns) == ["T", "P"] and frame.t[-1] == 8 and frame.columns["P"][-1] == 17
    largest = read_recording(path)
    assert list(largest.columns) == ["T", "axes_1", "axes_2"] and any(
        "--sheet GROUP" in n for n in largest.notes
    )
    with pytest.raises(InputError, match="no group 'rug'.*rig"):
        read_recording(path, sheet="rug")
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(InputError, match="not a whole HDF5 file"):
        read_recording(path)


@pytest.mark.parametrize("by_column", [True, False])
def test_the_result_of_a_modelica_program(tmp_path, by_column):
    def letters(*lines):
        matrix = np.array([list(x.ljust(20)) for x in lines])
        return ["".join(x) for x in (matrix.T if by_column else matrix)]

    data = np.array([[0.0, 20.0], [0.5, 21.0], [0.5, 22.0], [1.0, 23.0], [1.0, 23.0]])
    places = np.array([[0, 1, 0, -1], [2, 2, 0, -1], [1, 2, 0, 0], [2, -2, 0, -1]], float)
    content = {
        "Aclass": [
            "Atrajectory",
            "1.1        ",
            "           ",
            "binTrans   " if by_column else "binNormal  ",
        ],
        "name": letters("time", "block.T", "block.C", "loss[1]"),
        "description": letters("Time in [s]", "Heat [degC|K]", "Capacity [J/K]", "Loss [W]"),
        "dataInfo": places.T if by_column else places,
        "data_1": np.array([[0.0, 1.0], [5.0, 5.0]]),
        "data_2": data.T if by_column else data,
    }
    scipy.io.savemat(tmp_path / "dsres.mat", content, format="4")
    found = read_recording(tmp_path / "dsres.mat")
    assert found.t.tolist() == [0, 0.5, 1] and found.units == {"block.T": "degC", "loss[1]": "W"}
    assert found.columns["block.T"].tolist() == [20, 22, 23]
    assert found.columns["loss[1]"].tolist() == [-20, -22, -23]
    assert any("2 rows before an event" in n for n in found.notes)


def test_identities_of_digits_are_no_numbers(tmp_path):
    found = read(tmp_path, rows("Cell ID,time,T", *(f"345626_9356111_33_{i},{i},2{i}" for i in range(4))))
    assert list(found.columns) == ["T"] and any("left out: Cell ID" in n for n in found.notes)


def test_units_of_flows_speeds_and_pressures(tmp_path):
    text = rows("time,p,Speed (mph),Temp. Deg C", "s,atm,,", *(f"{i},1.{i},{i},2{i}" for i in range(5)))
    assert read(tmp_path, text).units == {"p": "atm", "Speed": "mph", "Temp.": "degC"}


def test_a_sheet_with_times_is_read_before_one_with_a_counter(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "Cycles"
    for row in [["Cycle", "Q"], *([i, 2 + i % 2] for i in range(1, 9))]:
        book.active.append(row)
    counted = tmp_path / "cycles.xlsx"
    book.save(counted)
    records = book.create_sheet("Records")
    for row in [["Time (s)", "U (V)"], *([i / 2, 3.5] for i in range(9))]:
        records.append(row)
    book.save(tmp_path / "both.xlsx")
    trace = []
    found = read_recording(tmp_path / "both.xlsx", trace=trace)
    assert not any("Cycle'" in line for line in trace)
    assert found.units == {"U": "V"} and any("sheet 'Records' read" in n for n in found.notes)
    assert list(read_recording(tmp_path / "both.xlsx", sheet="Cycles").columns) == ["Q"]
    assert list(read_recording(counted).columns) == ["Q"]


def hours(count=48, years=None):
    """Return hourly dates over the end of a January; `years`: of each month, as in a typical year."""
    stamps = [datetime(2001, 1, 31) + timedelta(hours=k) for k in range(count)]
    return [s.replace(year=(years or {}).get(s.month, 2001)) for s in stamps]


@pytest.mark.parametrize("years", [{1: 1996, 2: 1983}, {1: 1983, 2: 1996}, {1: 1999, 2: 1998}])
@pytest.mark.parametrize(
    "names, row",
    [
        ("time(UTC)", "{s:%Y%m%d:%H%M}"),
        ("Date (MM/DD/YYYY),Time (HH:MM)", "{s:%m/%d/%Y},{s:%H:%M}"),
        ("Year,Month,Day,Hour,Minute", "{s:%Y,%m,%d,%H},30"),
    ],
)
def test_the_months_of_a_typical_year_are_one_year(tmp_path, years, names, row):
    stamps = hours(years=years)
    text = rows(f"{names},T", *(f"{row.format(s=s)},{k}" for k, s in enumerate(stamps)))
    found = read(tmp_path, text)
    if years[2] > years[1]:  # forward: a gap of years, as any other
        assert found.t[24] - found.t[23] > 4e8
    else:
        assert found.t.tolist() == [3600.0 * k for k in range(48)]
        assert any("months of several years put together as one year" in n for n in found.notes)


def test_two_runs_a_year_apart_are_no_typical_year(tmp_path):
    text = rows("time,T", *(f"{y}-03-01 10:0{i}:30.{i * i},{i}" for y in (2026, 2025) for i in range(9)))
    with pytest.raises(InputError, match="2 runs in one file"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    "head, row",
    [
        (
            ["LOCATION,Town,-,NLD", "GROUND,3,.5,,10.1", "DATA PERIODS,1,1,Data"],
            "{s:%Y,%m,%d},{n},60,?9?9,{k}",
        ),
        ([], "{s:%Y %m %d %H %M} {k}.5 20.1"),
        ([" Slope", "   37.4  -88.3 105 m"], " {s:%Y %j %m %d %H %M} {k}.5 {k}"),
        ([], "{s:%Y,%j,%H%M},{k}.5,3"),
        ([], "{s:%j\t%H%M}\t{k}.5\t3"),
        ([], "53131 {s:%Y%m%d %H%M} {k}.5 3"),
        ([",Year,DOY,MST,T [deg C],P"], "0,{s:%Y},{s:%j},{n}00,{k},4"),
    ],
)
def test_a_date_in_several_columns(tmp_path, head, row):
    body = [row.format(s=s, k=k, n=s.hour + ("MST" not in str(head))) for k, s in enumerate(hours())]
    found = read(tmp_path, rows(*head, *body))
    np.testing.assert_allclose(found.t, 3600.0 * np.arange(48))
    assert "%Y" not in row or found.meta["start"].startswith("2001-01-31T0")
    assert any(np.allclose(c % 1, 0.5) or np.allclose(c, np.arange(48)) for c in found.columns.values())


def test_numbers_without_names_are_no_date_by_chance(tmp_path):
    with pytest.raises(InputError, match="no other that is a time"):
        read(tmp_path, rows(*(f"2001,{1 + i % 12},{1 + i % 7},{i % 5},{i}.5" for i in range(40))))
    with pytest.raises(InputError, match="no other that is a time"):  # a constant day and whole numbers
        read(tmp_path, rows(*(f"20010301,{20 + i % 3},{i % 2}.5" for i in range(40))))


@pytest.mark.parametrize(
    "name, scale",
    [
        ("millis", 1e-3),
        ("seconds", 1),
        ("uptime_s", 1),
        ("Elapsed", 1),
        ("Laufzeit", 1),
        ("Elapsed [min]", 60),
    ],
)
def test_a_count_beside_a_date_is_no_time_of_day(tmp_path, name, scale):
    """0, 10 ... 50 beside a date were read as hhmm: 600 s from row to row."""
    found = read(tmp_path, rows(f"date,{name},T", *(f"2026-03-01,{10 * i},2{i}" for i in range(6))))
    np.testing.assert_allclose(found.t, 10 * scale * np.arange(6))
    found = read(tmp_path, rows("date,HourMin,T", *(f"2026-03-01,10{10 * i:02d},2{i}" for i in range(6))))
    np.testing.assert_allclose(found.t, 600 * np.arange(6))


@pytest.mark.parametrize(
    ("head", "line"),
    [
        ("", "  can0  123   [4]  {0:02X} 00 00 12"),
        ("", "(1700000000.{0}1834) can0 181#{0}22334455667788"),
        ("", " (2026-11-14 10:00:{0}.500000)  vcan1  1812F4E5   [3]  {0} 22 33"),
        ("base hex  timestamps absolute\n", "   0.{0}1834 1  181             Rx   d 4 {0} 22 33 44"),
        (
            ";$FILEVERSION=1.1\n;---+--   ----+----\n",
            "    {0})       {0}.8  Rx         0181  4  {0} 22 33 44",
        ),
    ],
    ids=["candump", "candump -l", "candump -tA", "Vector", "PEAK"],
)
def test_frames_of_can_are_no_table(tmp_path, head, line):
    """A Vector log was columns, with hexadecimal bytes as decimals; of candump 0x123 was the day of the year."""
    with pytest.raises(InputError, match="frames of a CAN bus.*DBC"):
        read(tmp_path, head + rows(*(line.format(10 + i) for i in range(8))), "log.asc")


def test_names_one_a_line_above_the_table(tmp_path):
    head = ["%DataLog%", "Software : NSP", "Downloaded : 20260301 10:00:00"]
    for name in ("Coolant", "Pressure", *(f"Channel of {i}" for i in range(150))):
        head += [f"Channel : {name}", f"ID : {len(head)}", "Type : Raw", "DisplayMaxMin : 100,-100"]
    body = [f"10:00:0{i}.500,{20 + i},{i}" + ",0" * 150 for i in range(6)]
    found = read(tmp_path, rows(*head, "Log : 20260301 10:00:00", *body))
    assert found.t.tolist() == [0, 1, 2, 3, 4, 5] and len(found.columns) == 152
    assert found.columns["Coolant"].tolist() == [20, 21, 22, 23, 24, 25]
    names = ["timeS: Time [seconds]", "t090C: Temperature [deg C]", "prDM: Pressure [bar]"]
    head = [
        "* FileName = cast.hex",
        "# nquan = 3",
        *(f"# name {i} = {n}" for i, n in enumerate(names)),
        "*END*",
    ]
    found = read(tmp_path, rows(*head, *(f"   {i / 2}   2{i}.5   1.{i}" for i in range(6))))
    assert found.units == {"t090C: Temperature": "degC", "prDM: Pressure": "bar"} and found.t[-1] == 2.5


def test_units_stated_above_the_table_by_the_columns_names(tmp_path):
    head = ["[#1],,,", "Humidity = %rh,,,", "Low Alarm Threshold = 35,,,", "[#2],,,", "Temperature = °C,,,"]
    head += ["[#H],,,", "Date,Time,Humidity,Temperature", ",,,", "[#D],,,"]
    found = read(tmp_path, rows(*head, *(f"24/01/2020,13:3{i}:00,37.{i},2{i}" for i in range(6))))
    assert found.units == {"Humidity": "%", "Temperature": "degC"} and found.t[-1] == 300


def test_statements_of_an_oscilloscope_are_no_header(tmp_path):
    head = ["Memory Length,6,", "Trigger Level,1.6e+00,", "Source,CH1,", "Vertical Units,V,"]
    head += ["Horizontal Units,S,", "Sampling Period,4e-07,", "Firmware,V1.14,", "Time, ,", "Mode,Detail,"]
    body = [f"{-4e-4 + 4e-7 * i:.6e},{i}.5," for i in range(6)]
    found = read(tmp_path, rows(*head, "Waveform Data,", *body))
    assert list(found.columns) == ["column_2"] and found.units == {"column_2": "V"}
    np.testing.assert_allclose(found.t, -4e-4 + 4e-7 * np.arange(6), atol=1e-12)


@pytest.mark.parametrize("sep", [",", "\t"])
def test_the_innermost_of_nested_tables(tmp_path, sep):
    text = ["Cycle ID,Cap(mAh)", ",Step ID,Step Name", ",,Record ID,Voltage(V),Realtime", "1,9.5"]
    for step in range(3):
        text.append(f",{step + 1},Rest")
        text += [f",,{3 * step + i},{3 + i / 8},2024-01-05 10:00:{3 * step + i:02d}" for i in range(3)]
    found = read(tmp_path, rows(*text).replace(",", sep))
    assert found.t.tolist() == [*range(9)] and found.columns["Voltage"].tolist() == 3 * [3, 3.125, 3.25]
    assert any("innermost of 3 nested tables" in n for n in found.notes)
    text[7] = ",,2,3.5;4,2024-01-05 10:00:02"
    with pytest.raises(InputError, match=r"run.csv:8: .*'3.5;4'"):
        read(tmp_path, rows(*text).replace(",", sep))
    units = read(tmp_path, rows("time,T", ",degC", "0,20", "1,21"))
    assert units.units == {"T": "degC"}


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_empty_line_of_one_column_is_a_missing_sample(tmp_path, end):
    path = tmp_path / "run.csv"
    path.write_bytes(end.join(["T [degC]", "20", "21", "", "", "24", "25", "26", "", ""]).encode())
    found = read_recording(path, time="1s")
    np.testing.assert_array_equal(found.columns["T"], [20, 21, np.nan, np.nan, 24, 25, 26])
    path.write_bytes((2 * end).join(["T", "20", "21", "22"]).encode())  # each line ends twice
    assert read_recording(path, time="1s").columns["T"].tolist() == [20, 21, 22]


@pytest.mark.parametrize("unit, scale", [("[us]", 10**6), ("[ns]", 10**9), ("", 10**9)])
def test_the_dates_of_a_data_frame_in_hdf5(tmp_path, unit, scale):
    path, count = tmp_path / "run.h5", 1_772_359_200 * scale + scale * np.arange(9)
    table = np.zeros(9, dtype=[("index", "i8"), ("values_block_0", "f8", (2,))])
    table["index"], table["values_block_0"] = count, np.arange(18.0).reshape(9, 2)
    with h5py.File(path, "w") as file:
        for name in ("fixed/axis1", "series/index"):
            file[name] = count
            file[name].attrs["kind"], file[name].attrs["name"] = b"datetime64" + unit.encode(), b"N."
        file["fixed/block0_items"], file["fixed/block0_values"] = [b"T", b"P"], table["values_block_0"]
        file["series/values"], file["series"].attrs["name"] = np.arange(9.0), b"T"
        file["frame/table"] = table
        file["frame/table"].attrs["index_kind"] = b"datetime64" + unit.encode()
        file["frame/table"].attrs["values_block_0_kind"] = b"(lp0\nVT\np1\naVP\np2\na."
    for name in ("fixed", "series", "frame/table"):
        found = read_recording(path, sheet=name)
        assert found.t.tolist() == [*range(9)] and found.meta["start"].startswith("2026-03-01T10:00:00")
        assert list(found.columns) == ["T", "P"][: 1 + (name != "series")]


def test_a_table_of_other_rows_above(tmp_path):
    head = ['"Channel","Name","Function","Range","Resolution","Scale"', '"101","","Temp","","C","1"']
    head += ['"102","","DC Volts","AUTO","5.5","1"', '"Scan Control:"', '"Scan","Time","101 (C)","102 (VDC)"']
    found = read(tmp_path, rows(*head, *(f"{i},3/14/2026 10:00:0{i}:123,20.{i},1.{i}" for i in range(1, 6))))
    assert found.units == {"101": "degC", "102": "V"} and found.t.tolist() == [0, 1, 2, 3, 4]
    head = ["latitude,longitude,elevation,offset", "52.5,13.4,38.0,0", "", "time,temperature_2m (°C)"]
    found = read(tmp_path, rows(*head, *(f"2026-03-01T0{i}:00,{i}.5" for i in range(6))))
    assert found.units == {"temperature_2m": "degC"} and found.t[-1] == 5 * 3600
    head = ["*STARTTIME", "2026-03-01;10:00:00;", "*NAME", "TIME;T1", "*UNIT", ";°C", "*DATA"]
    found = read(tmp_path, rows(*head, *(f"2026-03-01 10:00:0{i};2{i}.5" for i in range(6))))
    assert found.units == {"T1": "degC"} and found.t[-1] == 5


def test_rows_above_a_wider_table_are_said(tmp_path):
    """A logger restarted with a further column: half of the rows went as 'lines before the header'."""
    narrow, wide = (f"{i},2{i}" for i in range(3)), (f"{i},2{i},1" for i in range(3, 9))
    found = read(tmp_path, rows("time,T", *narrow, "time,T,P", *wide))
    assert any(
        "4 lines before the header left out, 3 of them rows of another table" in n for n in found.notes
    )


def test_a_unit_directly_behind_a_name(tmp_path):
    text = rows(
        "No.,Time,Temperature°C,Humidity%RH", *(f"{i},2026-03-01 10:0{i}:00,2{i},4{i}" for i in range(5))
    )
    assert read(tmp_path, text).units == {"Temperature": "degC", "Humidity": "%"}


def test_a_horizontal_plane_is_no_hour(tmp_path):
    lines = [f"20050101:{h:02d}00,{h}.5,{10 * h},{h}" for h in range(6)]
    found = read(tmp_path, rows("time(UTC),T2m,G(h),t_run(h)", *lines))
    assert list(found.columns) == ["T2m", "G(h)", "t_run"] and found.units == {"t_run": "h"}


def test_columns_of_a_fixed_width_are_refused_with_a_remedy(tmp_path):
    text = rows(" 12839 MIAMI FL -5 N 25 48", *(f" 620101{h:02d}00000000?0000?0" for h in range(1, 9)))
    with pytest.raises(InputError, match="run.csv:1: .*fixed width: write them with commas"):
        read(tmp_path, text)


def _mat(folder, **content):
    scipy.io.savemat(folder / "run.mat", content)
    return folder / "run.mat"


def test_a_stated_interval_that_the_recorded_times_leave(tmp_path):
    """Loop times of a script: two rows at the start, then 2.1 s on the average, beside `ts = 2`."""
    t = np.r_[0, 0, 2.1 * np.arange(1, 99)]
    path = _mat(tmp_path, ts=2.0, t=t, u=np.sin(t))
    with pytest.raises(
        InputError, match=r"states 2 s a row; .*'t' differ by up to 7\.8 s; say --time 't', or --time 2s"
    ):
        read_recording(path)
    assert read_recording(path, time="2s").t[-1] == 198.0
    assert read_recording(path, time="t", equal_times="last").t[-1] == t[-1]


def test_a_stated_interval_beside_rounded_or_other_times(tmp_path):
    rounded = read_recording(_mat(tmp_path, ts=0.4, t=np.floor(0.4 * np.arange(20)), u=np.arange(20.0)))
    assert rounded.t[1] == 0.4 and any("states 0.4 s a row; its times in 't'" in n for n in rounded.notes)
    uneven = read_recording(_mat(tmp_path, ts=2.0, t=0.1 * np.arange(20), u=np.ones(20)))
    assert uneven.t[1] == 0.1 and any("they are used" in n for n in uneven.notes)


IN_TURN = [(f"10:00:{10 * k:02d}", k % 3 + 1, 20 + k) for k in range(6)]


@pytest.mark.parametrize(
    "head, row",
    [
        ("", "{} {}: {}"),
        ("time channel value", "{} {} {}"),
        ("time,sensor,value", "{},{},{}"),
        ("Time;channel;Wert", "{};{}:;{}"),
    ],
)
def test_channels_in_turn_are_columns(tmp_path, head, row):
    """Each has times of its own; times of day count from the first row of the file, not of the channel."""
    found = read(tmp_path, rows(*filter(None, [head]), *(row.format(*r) for r in IN_TURN)), "run.txt")
    assert [n[-1] for n in found.columns] == ["1", "2", "3"] and found.t.tolist() == [0, 10, 20, 30, 40, 50]
    for column, value in zip(found.columns.values(), (20, 21, 22), strict=True):
        at = np.flatnonzero(np.isfinite(column)).tolist()
        assert at == [value - 20, value - 17] and column[at].tolist() == [value, value + 3]


def test_channels_in_turn_without_a_sign_are_named(tmp_path):
    found = read(tmp_path, rows(*("{} {} {}".format(*r) for r in IN_TURN)), "run.txt")
    assert any("1 to 3 again and again: channels in turn?" in n for n in found.notes)
    counted = read(tmp_path, rows("time,point,value", *(f"{k},{k + 1},{k}" for k in range(6))))
    assert list(counted.columns) == ["point", "value"]


@pytest.mark.parametrize(
    "content, names",
    [
        (
            '{"rate": 50, "data": [{"kind": "drop", "of": ["b"], "u": [0, 1, 2], "y": [3, null, 5]}]}',
            ["u", "y"],
        ),
        ('[{"t": 0, "a": [1, 2]}, {"t": 2, "a": [3, 4]}, {"t": 3, "a": [5, 6]}]', ["a_1", "a_2"]),
        ('{"id": "x", "samples": [["t", "u"], [0, 1], [1, 4], [3, 5]]}', ["u"]),
        ('{"columns": ["t", "u"], "index": [0, 1], "data": [[0, 1], [1, 4]]}', ["u"]),
        ('{"columns": [["a", "u"], ["b", "u"]], "index": [0, 1], "data": [[0, 1], [1, 4]]}', ["a_u", "b_u"]),
        (
            '{"results": [{"statement_id": 0, "series": [{"columns": ["t", "u"], "values": [[0, 1], [1, 4]]}]}]}',
            ["u"],
        ),
    ],
)
def test_lists_in_json(tmp_path, content, names):
    how = {} if '"t"' in content or "index" in content else {"time": "1s"}
    assert list(read(tmp_path, content, "run.json", **how).columns) == names


def test_signals_named_by_instance_or_topic(tmp_path):
    """Two instances of Prometheus were 'equal times', which --equal-times mean would have mixed."""
    for head in ("timestamp,instance,value", "time,topic,payload"):
        found = read(tmp_path, rows(head, *(f"{i},a,2{i}\n{i},b,{i}" for i in range(6))))
        assert {n: c[5] for n, c in found.columns.items()} == {"a": 25, "b": 5}


@pytest.mark.parametrize(
    "content, says",
    [
        ('[{"t": [0, 1], "u": [0, 1]}, {"t": [0, 1], "u": [0, 1]}]', "2 objects of lists; one was expected"),
        ('{"a": {"b": 1}}', r'no table in this JSON; records \[\{"t": 0'),
    ],
)
def test_json_without_a_table(tmp_path, content, says):
    with pytest.raises(InputError, match=says):
        read(tmp_path, content, "run.json")


@pytest.mark.parametrize(
    "encoding, name, header",
    [
        ("gbk", "GBK", "时间,温度(℃),功率(W)"),
        ("cp932", "Shift-JIS", "日時,温度(℃),電力(W)"),
        ("cp949", "EUC-KR", "시간,온도(℃),전력(W)"),
        ("big5", "Big5", "時間,溫度(℃),功率(W)"),
        ("cp1251", "Windows-1251", "Время,Температура (°C),Мощность (W)"),
        ("koi8-r", "KOI8-R", "Время,Температура (°C),Мощность (W)"),
        ("cp1250", "Windows-1250", "Čas,Teplota (°C),Výkon (W)"),
        ("cp1252", "Windows-1252", "Zeit,Kühlkörper (°C),Wärme (W)"),
        ("cp850", "DOS-850", "Zeit,Kühlkörper (°C),Wärme (W)"),
        ("mac-roman", "MacRoman", "Zeit,Kühlkörper (°C),Wärme (W)"),
        ("utf-16", "UTF-16", "时间,温度(℃),功率(W)"),
        ("utf-32", "UTF-32", "时间,温度(℃),功率(W)"),
    ],
)
def test_the_words_of_a_header_show_its_encoding(tmp_path, encoding, name, header):
    path = tmp_path / "run.csv"
    text = rows(header, *(f"2026-03-01 10:00:0{i},2{i}.5,{i}" for i in range(6)))
    path.write_bytes(text.encode(encoding))
    found = read_recording(path)
    names = [cell.partition("(")[0].strip() for cell in header.split(",")[1:]]
    assert list(found.columns) == names and found.units == dict(zip(names, ("degC", "W"), strict=True))
    assert found.t.tolist() == [0, 1, 2, 3, 4, 5] and f"read as {name}" in found.notes


def test_a_last_character_that_is_cut_off_is_left_out(tmp_path):
    path = tmp_path / "run.csv"
    text = rows("Zeit,Kühler", *(f"2026-03-01 10:00:0{i},2{i}.5 °C" for i in range(9)))
    path.write_bytes(text.encode()[: -len("C\n") - 1])
    assert read_recording(path).columns["Kühler"].tolist() == [20.5 + i for i in range(8)]


def of_local_times(folder, first, back, step):
    """Write 12 rows at local times, of which those from the sixth on are an hour earlier, or later."""
    stamps = [datetime.fromisoformat(first) + k * step for k in range(12)]
    local = [s + timedelta(hours=back) * (k > 5) for k, s in enumerate(stamps)]
    return read(folder, rows("time,T", *(f"{s},{k}" for k, s in enumerate(local))))


@pytest.mark.parametrize("step", [timedelta(minutes=5), timedelta(hours=1)], ids=["5 min", "1 h"])
@pytest.mark.parametrize("day, back", [("2026-10-25", -1), ("2026-03-29", 1)], ids=["autumn", "spring"])
def test_local_times_go_on_over_a_change_of_daylight_saving(tmp_path, day, back, step):
    last = (
        datetime.fromisoformat(f"{day} 02:00:00") if back > 0 else datetime.fromisoformat(f"{day} 03:00:00")
    )
    found = of_local_times(tmp_path, str(last - 6 * step), back, step)
    assert found.t.tolist() == [k * step.total_seconds() for k in range(12)]
    assert any("daylight saving after" in n for n in found.notes)


def test_an_hour_on_another_day_is_no_daylight_saving(tmp_path):
    found = of_local_times(tmp_path, "2026-03-27 01:30:00", 1, timedelta(minutes=5))
    assert found.t[6] == 5400 and not any("daylight" in n for n in found.notes)
    with pytest.raises(InputError, match="runs backwards"):
        of_local_times(tmp_path, "2026-10-23 02:30:00", -1, timedelta(minutes=5))


@pytest.mark.parametrize(
    "first, form",
    [("1970-01-01 00:00:07", "{s}"), ("2000-01-01 00:00:07", "{s}"), ("1970-01-01 00:00:07", "{ms:.0f}")],
    ids=["1970", "2000", "unix ms"],
)
def test_a_clock_that_is_set_during_the_recording(tmp_path, first, form):
    """A count of ms was read as seconds."""
    begin, now = datetime.fromisoformat(first), datetime.fromisoformat("2026-03-01 10:00:00")
    stamps = [(begin if k < 5 else now) + timedelta(seconds=k) for k in range(12)]
    since = datetime(1970, 1, 1)
    cells = (form.format(s=s, ms=(s - since).total_seconds() * 1e3) for s in stamps)
    found = read(tmp_path, rows("time,T", *(f"{c},{k}" for k, c in enumerate(cells))))
    assert found.t[:5].tolist() == [0, 1, 2, 3, 4] and found.t[5] == (stamps[5] - begin).total_seconds()
    assert any(f"leap from {first[:10]}" in n and "was the clock set" in n for n in found.notes)


def test_a_comment_without_words_is_no_header(tmp_path):
    """It ended with a traceback."""
    with pytest.raises(InputError):
        read(tmp_path, "#\n*")


SECONDS = range(90)
CLOCKS = {  # header and row of a table whose clock has a column for each part
    "parts of a day": ("hh,mm,ss,T", "10,{m},{s},{v}"),
    "whole words": ("Hour,Minute,Second,T", "10,{m},{s},{v}"),
    "behind a date": ("Date,HH,MM,SS,T", "2025-01-02,10,{m},{s},{v}"),
    "months and minutes": ("YYYY,MM,DD,hh,mm,ss,T", "2025,1,2,10,{m},{s},{v}"),
    "two digits of a year": ("YY,MM,DD,hh,mm,ss,T", "25,1,2,10,{m},{s},{v}"),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_a_clock_in_columns_of_its_parts(tmp_path, name):
    """`mm` behind hh is a minute: it was the month, a second a month, where MM stood before it."""
    header, row = CLOCKS[name]
    found = read(tmp_path, rows(header, *(row.format(m=k // 60, s=k % 60, v=20 + k) for k in SECONDS)))
    assert found.t.tolist() == [*SECONDS] and list(found.columns) == ["T"]
    start = found.meta.get("start")
    assert start == (None if name in ("parts of a day", "whole words") else "2025-01-02T10:00:00.000")


def test_parts_of_a_day_go_on_past_midnight(tmp_path):
    found = read(tmp_path, rows("hh,mm,T", "23,58,1", "23,59,2", "0,0,3", "0,1,4"))
    assert found.t.tolist() == [0, 60, 120, 180]


@pytest.mark.parametrize("name", ["MJD", "time_mjd", "Modified Julian Date", "time (MJD)"])
def test_modified_julian_days(tmp_path, name):
    """They are as large as the days of Excel, and were read as those of the year 2066."""
    found = read(tmp_path, rows(f"{name},T", *(f"{60676.5 + k / 1440:.8f},{20 + k % 3}" for k in range(9))))
    np.testing.assert_allclose(found.t, 60 * np.arange(9), atol=1e-3)
    assert found.meta["start"] == "2025-01-01T12:00:00.000"


FETCHED = "                 ds0          ds1\n\n" + rows(
    *(f"{1700000000 + 300 * k}: {2.1e1 + k:.10e} 3.3e+01" for k in range(6)), "1700001800: -nan -nan"
)
XPORT = (
    '{ %s,\n"meta": {"start": 1700000000, "step": 300, "end": 1700001800, "legend": ["ds0", "ds1"]},\n'
    '"data": [' + ",".join(f"[ {2.1e1 + k:.10e}, 33.0 ]" for k in range(6)) + "]}"
)


@pytest.mark.parametrize("about", ["", "about: 'RRDtool xport JSON output'", '"about": "RRDtool"'])
def test_what_rrdtool_writes(tmp_path, about):
    """Of its JSON the first signal was read as the time."""
    found = read(tmp_path, XPORT % about, "x.json") if about else read(tmp_path, FETCHED)
    assert found.columns["ds0"][:6].tolist() == [21, 22, 23, 24, 25, 26]
    assert found.t[:6].tolist() == [0, 300, 600, 900, 1200, 1500]
    assert found.meta["start"] == "2023-11-14T22:13:20.000Z"


@pytest.mark.parametrize(
    "cells, names", [("{v}", ["probe_0"]), ("({v} 0 1)", [f"probe_0_{k}" for k in "123"])]
)
def test_the_probes_of_openfoam(tmp_path, cells, names):
    head = rows("# Probe 0 (0.1 0 0)", "#       Probe             0", "#        Time")
    lines = [f"{k * 0.5:13.1f}   {cells.format(v=300 + k)}" for k in range(5)]
    found = read(tmp_path, head + rows(*lines), "T")
    assert list(found.columns) == names and found.columns[names[0]].tolist() == [300, 301, 302, 303, 304]
    assert found.t.tolist() == [0, 0.5, 1, 1.5, 2]
    with pytest.raises(InputError, match=r"T:8: .*was it cut"):
        read(tmp_path, head + rows(*lines[:4], "  2.0"), "T")


@pytest.mark.parametrize(
    "line",
    [
        "[2025-01-02 10:00:0{k}] INFO T=2{k}.5 P=3",
        "2025-01-02 10:00:0{k},000 - root - INFO - P=3, T=2{k}.5 degC",
        "[2025-01-02T10:00:0{k}] INFO: T=2{k}.5, P=3 W",
    ],
)
def test_the_log_of_a_program(tmp_path, line):
    text = rows("[2025-01-02 09:59:59] INFO started", *(line.format(k=k) for k in range(6)))
    found = read(tmp_path, text, "run.log")
    assert found.columns["T"].tolist() == [20.5 + k for k in range(6)] and found.t.tolist() == [*range(6)]
    assert found.columns["P"].tolist() == [3] * 6 and "1 lines without a date" in found.notes[0]
    assert found.units == ({"T": "degC"} if "degC" in line else {"P": "W"} if " W" in line else {})
