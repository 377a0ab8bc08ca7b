"""Files as tools write them: a small input of our own for each habit, compared with the numbers that it holds."""

import datetime
import json
import warnings
import zipfile

import numpy as np
import pyarrow as pa
import pytest

from tests.recording.test_field import ISO, read, table
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.logger import read_recording

DATES = "2026/03/01 10:00:0"
GL840 = [
    "Vendor,GRAPHTEC", "Model,GL840", "Version,1.22", "Sampling interval,1s", "Total data points,3", "Amp settings",
    "CH,Signal name,Input,Range", 'CH1,"Oven","TEMP","TC_K"', 'CH2,"Room","TEMP","TC_K"', "Logic/Pulse,Off", "Data",
    "Number,Date&Time,ms,CH1,CH2,Alarm1-10,AlarmOut", "NO.,Time,ms,degC,degC,A1234567890,A1234",
    *(f"{k + 1},{DATES}{k},000,+  2{k}.5,{w},LLLLLLLLLL,LLLL" for k, w in enumerate(("+ 21.0", "BURNOUT", "+ 21.2"))),
]  # fmt: skip
DL850 = [
    '"Model","DL850E"', '"BlockNumber","1"', '"TraceName","A","B"', '"BlockSize","3","3"', '"VUnit","V","C"',
    '"SampleRate","2.0E+00","2.0E+00"', '"HResolution","5.0E-01","5.0E-01"', '"HOffset","0.0E+00","0.0E+00"', '"HUnit","s","s"',
    '"Date","2026/03/01","2026/03/01"', '"Time","10:00:00.00","10:00:00.00"', "", *(f",0.{k + 1},2{k}.5," for k in range(6)),
]  # fmt: skip
CATMAN = [
    "HBM_CATMAN_DATAFILE_40", "Number of channels:\t3", "Comment:\ttest", "", "Zeit  1 - Standardmessrate\tA\tB", "s\tV\t°C",
    "T0 = 01.03.2026 10:00:00\tCH=1\tCH=2", "0\t0,1\t20,5", "0,5\t0,2\t21,5", "1\t0,3\t22,5",
]  # fmt: skip
DX = [
    "DAQSTANDARD,R8.11", "Date,Time,Sampling,A,B", "YYYY/MM/DD,HH:MM:SS,mmm,,", " , , ,V,degC",
    *(f"2026/03/01,10:00:0{k},000,0.{k + 1},2{k}.5" for k in range(3)),
]  # fmt: skip
JS = "Sun Mar 01 2026 10:00:0{} GMT+0100 (Central European Standard Time)"
AB = ([0.1, 0.2, 0.3], [20.5, 21.5, 22.5])
FILES = {  # a text, its times, columns
    "a long header above few rows": (GL840, [0, 1, 2], {"CH1": AB[1], "CH2": [21, np.nan, 21.2]}),
    "names above their units, rates and dates": (DL850, np.arange(6) / 2, {"A": np.arange(1, 7) / 10, "B": 20.5 + np.arange(6)}),
    "a line between the units and as many rows": (CATMAN, [0, 0.5, 1], {"A": AB[0], "B": AB[1]}),
    "the form of date and time below the names": (DX, [0, 1, 2], {"A": AB[0], "B": AB[1]}),
    "a clock before each channel": (
        ["X_Value\tA\tX_Value\tB\tComment", "0,0\t1\t0,0\t5", "0,1\t2\t0,2\t6", "0,2\t3\t0,4\t7"],
        [0, 0.1, 0.2, 0.4], {"A": [1, 2, 3, np.nan], "B": [5, np.nan, 6, 7]},
    ),
    "a cell of two lines": (['"Time\n(s)","T\n(°C)"', "0,20.5", "0.5,21.5", "1,22.5"], [0, 0.5, 1], {"T": AB[1]}),
    "seconds and nanoseconds by name": (
        ["stamp.sec,stamp.nanosec,T", "1678788000,900000000,20.5", "1678788001,100000000,21.5", "1678788001,300000000,22.5"],
        [0, 0.2, 0.4], {"T": AB[1]},
    ),
    "a date with midnight, and a time of day": (
        ["Date,Time,T", "2026-03-01 00:00:00,23:59:59,20.5", "2026-03-02 00:00:00,00:00:00,21.5", "2026-03-05 00:00:00,00:00:00,22.5"],
        [0, 1, 3 * 86400 + 1], {"T": AB[1]},
    ),
    "a date of JavaScript": (["time,T", *(f'"{JS.format(k)}",2{k}.5' for k in range(3))], [0, 1, 2], {"T": AB[1]}),
    "a narrow blank before AM": (["time,T", "3/14/2026 11:59:59\u202fAM,20.5", "3/14/2026 12:00:00\u202fPM,21.5"], [0, 1], {"T": AB[1][:2]}),
    "infinite for no value": (["time,T,P", "0,INF,1", "1,21,-inf", "2,22,+Inf"], [0, 1, 2], {"T": [np.nan, 21, 22], "P": [1, np.nan, np.nan]}),
    "words out of range": (["time,T,P", "0,Open TC,1", "1,21,Under Range", "2,22,3"], [0, 1, 2], {"T": [np.nan, 21, 22], "P": [1, np.nan, 3]}),
}  # fmt: skip


@pytest.mark.parametrize("lines, t, columns", FILES.values(), ids=FILES)
def test_the_numbers_of_a_text(tmp_path, lines, t, columns):
    found = read(tmp_path, table(*lines))
    np.testing.assert_allclose(found.t, t, atol=1e-6)
    for name, values in columns.items():
        np.testing.assert_allclose(found.columns[name], values, err_msg=name)


def test_units_of_these_texts(tmp_path):
    """A file in which they are lost is compared in the plant's unit, whatever its own."""
    assert [read(tmp_path, table(*f)).units for f in (DL850, CATMAN, DX)] == 3 * [{"A": "V", "B": "degC"}]
    found = read(tmp_path, table("Zeit in s\tTemperatur in °F\tin °C", "0\t70,5\t1", "1\t71,5\t2"))
    assert found.units == {"Temperatur": "degF"} and list(found.columns) == ["Temperatur", "in °C"]


def test_dates_and_times_of_excel_in_two_columns(tmp_path):
    """The days of such a table were lost: two days later was a minute later."""
    openpyxl = pytest.importorskip("openpyxl")
    book, day = openpyxl.Workbook(), datetime.date(2026, 3, 1)
    rows = [(day, datetime.time(10), 20.5), (day + datetime.timedelta(2), datetime.time(10, 1), 21.5)]
    for row in (["Date", "Time", "T, Oven\n(°C)"], *rows):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    found = read_recording(tmp_path / "run.xlsx")
    assert found.t.tolist() == [0, 2 * 86400 + 60] and found.meta["start"].startswith("2026-03-01T10:00")
    assert found.units == {"T, Oven": "degC"}


@pytest.mark.parametrize("suffix", [".feather", ".arrow"])
def test_arrow_files_of_other_programs(tmp_path, suffix):
    stamps = pa.array([datetime.datetime(2026, 3, 1, 10, 0, k) for k in range(3)])
    days = pa.array([datetime.date(2026, 3, 1 + k) for k in range(3)])
    for times, step in ((stamps, 1), (days, 86400)):
        arrow = pa.table({"time": times, "T [°C]": AB[1], "on": [True, False, True]})
        with pa.OSFile(str(tmp_path / f"run{suffix}"), "wb") as f, pa.ipc.new_file(f, arrow.schema) as writer:
            writer.write_table(arrow)
        found = read_recording(tmp_path / f"run{suffix}")
        assert found.t.tolist() == [0, step, 2 * step] and found.columns["on"].tolist() == [1, 0, 1]
        assert found.units == {"T": "degC"}


def test_packed_numbers_and_dates_of_netcdf(tmp_path):
    """Packed numbers were read as they are, without a word."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "run.nc", "w") as file:
        file.create_dataset("time", data=[0, 1, 2]).attrs["units"] = "minutes since 2026-03-01 10:00:00"
        packed = file.create_dataset("T", data=np.array([205, -999, 225], np.int16))
        packed.attrs.update({"units": "degC", "scale_factor": 0.1, "_FillValue": np.int16(-999)})
    found = read_recording(tmp_path / "run.nc")
    np.testing.assert_allclose(found.columns["T"], [20.5, np.nan, 22.5])
    assert found.t.tolist() == [0, 60, 120] and found.meta["start"].startswith("2026-03-01T10:00")


def test_wrong_dates_of_a_long_table_are_an_error_with_the_line(tmp_path):
    text = table("entity_id,state,last_changed", f"a,1,{ISO}0", "b,2,10:00:01", f"a,3,{ISO}2", "b,4,10:00:03")
    with pytest.raises(InputError, match=r"run\.csv:3: a time without a date among dates"):
        read(tmp_path, text)


def test_a_damaged_parquet_or_hdf5_file_is_named_in_one_line(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "good.h5", "w") as file:
        file["t"], file["T"] = np.arange(50.0), np.arange(50.0)
    pa.parquet.write_table(pa.table({"t": np.arange(50.0), "T": np.arange(50.0)}), tmp_path / "good.parquet")
    refused = 0
    for name in ("good.h5", "good.parquet"):
        data = (tmp_path / name).read_bytes()
        for at in range(0, len(data), 7):
            damaged = tmp_path / f"bad{name[4:]}"
            damaged.write_bytes(data[:at] + bytes((data[at] ^ 0x55,)) + data[at + 1 :])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    read_recording(damaged)
                except InputError as e:
                    refused += 1
                    assert "\n" not in str(e) and "cannot be read" not in str(e), e
    assert refused > 50


def test_rows_of_a_day_have_no_daylight_saving(tmp_path):
    """From ten hours a row on, each step seemed to be an hour off: 82800 s for a day, on Sundays of spring."""
    for hours in (24, 12):
        stamps = np.datetime64("2026-02-27T00:00:00") + np.arange(6) * np.timedelta64(hours, "h")
        found = read(tmp_path, table("time,T", *(f"{str(s)},{k}" for k, s in enumerate(stamps))))
        assert np.diff(found.t).tolist() == 5 * [3600 * hours]


def test_long_tables_of_parquet_and_with_an_empty_tag(tmp_path):
    arrow = pa.table({"time": [0.0, 0, 1, 1], "sensor": ["T", "P", "T", "P"], "value": [20.5, 1, 21.5, 2]})
    pa.parquet.write_table(arrow, tmp_path / "run.parquet")
    rows = ('101,"",20.5,C,0', '102,"",1,VDC,0', '101,"",21.5,C,1', '102,"",2,VDC,1')
    for found, names in (
        (read_recording(tmp_path / "run.parquet"), ["T", "P"]),
        (read(tmp_path, table("Channel,Tag,Reading,Unit,Time", *rows)), ["Channel_101", "Channel_102"]),
    ):
        assert [found.columns[n].tolist() for n in names] == [[20.5, 21.5], [1, 2]]
        assert found.t.tolist() == [0, 1]


def test_archives_and_excel_files_of_another_suffix(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["t", "T"], [0, 20.5], [1, 21.5]):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    (tmp_path / "run.xlsx").rename(tmp_path / "run.dat")
    assert read_recording(tmp_path / "run.dat").columns["T"].tolist() == AB[1][:2]
    with zipfile.ZipFile(tmp_path / "run.zip", "w") as archive:
        archive.writestr("run.csv", "t,T\n0,1\n")
    with pytest.raises(InputError, match="unpack the archive, or save its table as .xlsx or .csv"):
        read_recording(tmp_path / "run.zip")


def test_a_tdms_file_that_was_cut_is_said(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(tmp_path / "run.tdms") as writer:
        for k in range(2):
            values = np.arange(100.0) + 100 * k
            writer.write_segment([nptdms.ChannelObject("g", "T", values, {"wf_increment": 0.5})])
    path = tmp_path / "run.tdms"
    assert not any("cut off" in n for n in read_recording(path).notes)
    path.write_bytes(path.read_bytes()[:-80])
    found = read_recording(path)
    assert found.columns["T"].tolist() == list(range(190)) and any("cut off" in n for n in found.notes)


def test_lakhs_and_times_of_unknown_form(tmp_path):
    assert read(tmp_path, table("t,P", '0,"1,00,000.5"', '1,"99,999.5"')).columns["P"].tolist() == [
        100000.5,
        99999.5,
    ]
    with pytest.raises(InputError, match="no time in a form that is known: 'Elapsed': '0 beats'"):
        read(tmp_path, table("Elapsed,T", "0 beats,20", "30 beats,21", "60 beats,22"))


@pytest.mark.parametrize(
    "stamp, start",
    [
        ("02/03/2026 10.00.0{}", "2026-03-02T10:00"),  # Italian
        ("2.3.2026 klo 10.00.0{}", "2026-03-02T10:00"),  # Finnish
        ("2026.03.02. 10:00:0{}", "2026-03-02T10:00"),  # Hungarian
        ("2026. 3. 2. 오전 10:00:0{}", "2026-03-02T10:00"),
        ("02/03/2569 10:00:0{}", "2026-03-02T10:00"),  # Thai: was 1984
        ("2569-03-02 10:00:0{}", "2026-03-02T10:00"),
        ("2026-03-02T10:00:0{}+01:00[Europe/Berlin]", "2026-03-02T09:00"),  # Java
        ("2026-03-02 10:00:0{} Europe/Berlin", "2026-03-02T10:00"),
        ("02.03.2026;10.00.0{}", "2026-03-02T10:00"),
    ],
)
def test_dates_of_further_countries(tmp_path, stamp, start):
    names = "Datum;Uhrzeit;T" if ";" in stamp else "Zeit;T"
    found = read(tmp_path, table(names, *(f"{stamp.format(k)};2{k},5" for k in range(3))))
    assert found.t.tolist() == [0, 1, 2] and found.columns["T"].tolist() == AB[1]
    assert found.meta["start"].startswith(start)


def test_the_time_in_ms_of_wincc_is_millionths_of_a_day(tmp_path):
    """Alone, without the TimeString beside it, a second was 0.0116 s."""
    rows = [f"{46095416666.6667 + 11.574074 * k:.4f};2{k},5" for k in range(3)]
    found = read(tmp_path, table("Time_ms;T", *rows))
    np.testing.assert_allclose(found.t, [0, 1, 2], atol=1e-4)
    assert found.meta["start"].startswith("2026-03-14T10:00")


def test_a_year_that_nanoseconds_cannot_hold_is_refused(tmp_path):
    """The last date of a database was a date of our century."""
    for date in ("9999-12-31 23:59:5", "0001-01-01 00:00:0"):
        with pytest.raises(InputError, match=r":2: .*a year of 1678 to 2261 were expected"):
            read(tmp_path, table("time,T", f"{date}8,20", f"{date}9,21"))


def test_a_rate_and_units_in_comments(tmp_path):
    for head in ("Sample rate [Hz];2", "# fs = 2 Hz"):
        assert read(tmp_path, table(head, "T;P", "20,5;1", "21,5;2", "22,5;3")).t.tolist() == [0, 0.5, 1]
    found = read(tmp_path, table("# time T P", "# min degC W", "0 20.5 1", "1 21.5 2", "2 22.5 3"))
    assert found.t.tolist() == [0, 60, 120] and found.columns["T"].tolist() == AB[1]
    assert found.units == {"T": "degC", "P": "W"}


def test_overload_of_a_multimeter_is_no_litre(tmp_path):
    """0.L was 0, with the unit L."""
    found = read(
        tmp_path, table("Time,Main,Unit", "0,12.345,V DC", "1,0.L,V DC", "2,OL.,V DC", "3,12.5,V DC")
    )
    np.testing.assert_allclose(found.columns["Main"], [12.345, np.nan, np.nan, 12.5])


def test_the_scale_of_a_temperature_as_a_word_of_the_name(tmp_path):
    """Without it 68 degF are 68 in the plant's degC."""
    for clock in ("t", "Timestamp"):
        found = read(tmp_path, table(f"{clock},Temperature_Fahrenheit,air celsius", "0,68.5,20", "1,69.5,21"))
        assert found.units == {"Temperature_Fahrenheit": "degF", "air celsius": "degC"}


def test_topics_of_mqtt_are_signals(tmp_path):
    """Their values stood in one column, one after the other."""
    rows = [
        f"2026-03-02T10:00:0{k}.{s} oven/{n} {v}"
        for k in range(3)
        for s, n, v in ((1, "T", 20 + k), (2, "P", k))
    ]
    found = read(tmp_path, table(*rows))
    assert found.columns.keys() == {"oven/T", "oven/P"}
    np.testing.assert_allclose(found.columns["oven/T"], [20, np.nan, 21, np.nan, 22, np.nan])


def test_units_beside_a_table_of_json(tmp_path):
    path = tmp_path / "run.json"
    hourly = {"time": [f"2026-03-02T0{k}:00" for k in range(3)], "temperature_2m": [5.0, 6.0, 7.0]}
    path.write_text(
        json.dumps({"hourly_units": {"time": "iso8601", "temperature_2m": "°C"}, "hourly": hourly})
    )
    found = read_recording(path)
    assert found.units == {"temperature_2m": "degC"} and found.t.tolist() == [0, 3600, 7200]


def test_vectors_of_matlab_of_other_lengths_are_named(tmp_path):
    savemat = pytest.importorskip("scipy.io").savemat
    savemat(tmp_path / "run.mat", {"t": np.arange(6.0), "T": np.arange(5.0)})
    with pytest.raises(InputError, match="'T' left out: float64, size 5"):
        read_recording(tmp_path / "run.mat")


@pytest.mark.parametrize(
    "head, units",
    [
        ([";Oven;Oven;Room", "time;T;P;T"], {}),
        (["Time;Oven;;Room", ";T;P;T", "s;°C;W;°C"], {"T_1": "degC", "P": "W", "T_2": "degC"}),
    ],
)
def test_names_below_those_of_groups_are_no_units(tmp_path, head, units):
    """The names T and P were tesla and a second time."""
    found = read(tmp_path, table(*head, *(f"{k};2{k},5;{k % 2};1{k},5" for k in range(4))))
    assert found.columns["T_1"].tolist() == [20.5, 21.5, 22.5, 23.5] and found.columns["P"].tolist() == [
        0,
        1,
        0,
        1,
    ]
    assert found.columns["T_2"].tolist() == [10.5, 11.5, 12.5, 13.5] and found.units == units


def test_lines_of_names_and_values_with_equals_signs(tmp_path):
    found = read(tmp_path, table(*(f"time={k} T={20 + k}.5 P={k}" for k in range(3))))
    assert found.t.tolist() == [0, 1, 2] and found.columns["T"].tolist() == AB[1]


@pytest.mark.parametrize(
    "written, unit",
    [
        ("C°", "degC"),
        ("º C", "degC"),
        ("mV DC", "mV"),
        ("mVDC", "mV"),
        ("AC V", "V"),
        ("mA DC", "mA"),
        ("degree_C", "degC"),
    ],
)
def test_spellings_of_units_in_round_brackets(tmp_path, written, unit):
    """One that is not known stays in the name, so that nothing refuses mV for V."""
    assert read(tmp_path, table(f"time,x ({written})", "0,20", "1,21")).units == {"x": unit}


def test_lines_of_limits_above_the_table_are_no_names(tmp_path):
    head = ["Time;T;P", "s;°C;W", "Min;-50;0", "Max;150;10"]
    found = read(tmp_path, table(*head, *(f"{k};2{k},5;{k % 2}" for k in range(5))))
    assert list(found.columns) == ["T", "P"] and found.units == {"T": "degC", "P": "W"}
    found = read(tmp_path, table("Logger;TC;TC", "Time;101;102", *(f"{k};2{k},5;{k % 2}" for k in range(5))))
    assert list(found.columns) == ["101", "102"]


def test_more_names_than_columns_are_refused(tmp_path):
    """The names were lost, and the time was a counter."""
    with pytest.raises(InputError, match=r"run\.csv:1: 4 names, 3 cells in the rows below; delete"):
        read(tmp_path, table("Time,T,P,Remark", "0,20.5,1", "1,21.5,2", "2,22.5,3"))
