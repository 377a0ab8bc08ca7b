"""Recordings as loggers write them: every dialect read alike, every guess a note, every mistake one line with its place."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.logger import parsed_columns, read_recording

T, X = [0.0, 1.0, 2.5], [21.5, np.nan, 1e-3]

DIALECTS = {
    "semicolon, decimal comma": "t;x\n0;21,5\n1;\n2,5;1e-3\n",
    "tab": "t\tx\n0\t21.5\n1\t\n2.5\t1e-3\n",
    "bar": "t|x\n0|21.5\n1|NA\n2.5|1e-3\n",
    "quoted, decimal comma": '"t","x"\n"0","21,5"\n"1",""\n"2,5","1e-3"\n'.replace('","', '";"'),
    "units in the header": "time [s],x [degC]\n0,21.5\n1,\n2.5,1e-3\n",
    "units in round brackets": "Time (s);x (°C)\n0;21,5\n1;--\n2,5;0,001\n",
    "units row": "t;x\ns;°C\n0;21,5\n1;\n2,5;1e-3\n",
    "units row in brackets": "t,x\n[s],[degC]\n0,21.5\n1,\n2.5,1e-3\n",
    "preamble": "Logger 3\nSerial;7\n\nt;x\n0;21,5\n1;\n2,5;1e-3\n",
    "comments": "# rig 3\nt;x\n# begin\n0;21,5\n1;\n# pause\n2,5;1e-3\n",
    "sep line of Excel": "sep=;\nt;x\n0;21,5\n1;\n2,5;1e-3\n",
    "separator at the end": "t;x;\n0;21,5;\n1;;\n2,5;1e-3;\n",
    "text column": "t;x;state\n0;21,5;ok\n1;;ok\n2,5;1e-3;fault\n",
    "milliseconds": "t [ms];x\n0;21,5\n1000;\n2500;1e-3\n",
    "minutes": "t (min),x\n0,21.5\n0.016666666666666666,\n0.041666666666666664,1e-3\n",
    "suffix": "time_ms,x\n0,21.5\n1000,\n2500,1e-3\n",
    "unix s": "timestamp,x\n1773480413,21.5\n1773480414,\n1773480415.5,1e-3\n",
    "unix ms": "timestamp,x\n1773480413000,21.5\n1773480414000,\n1773480415500,1e-3\n",
    "unix 100 ns": "timestamp,x\n17734804130000000,21.5\n17734804140000000,\n17734804155000000,1e-3\n",
    "unix us": "timestamp,x\n1773480413000000,21.5\n1773480414000000,\n1773480415500000,1e-3\n",
    "ISO": "Zeit;x\n2026-03-14T09:26:53;21,5\n2026-03-14T09:26:54;\n2026-03-14T09:26:55.500;1e-3\n",
    "ISO with zone": "time,x\n2026-03-14 09:26:53+01:00,21.5\n2026-03-14 09:26:54+01:00,\n2026-03-14 09:26:55.5+01:00,1e-3\n",
    "German dates": "Datum;x\n14.03.2026 09:26:53;21,5\n14.03.2026 09:26:54;\n14.03.2026 09:26:55,500;0,001\n",
    "American dates": "time,x\n3/14/2026 9:26:53 AM,21.5\n3/14/2026 9:26:54 AM,\n3/14/2026 9:26:55.5 AM,1e-3\n",
    "date of one day": "time,x\n03/04/2026 09:26:53,21.5\n03/04/2026 09:26:54,\n03/04/2026 09:26:55.5,1e-3\n",
    "named month": "time,x\n14-Mar-2026 09:26:53,21.5\n14-Mar-2026 09:26:54,\n14-Mar-2026 09:26:55.5,1e-3\n",
    "date and time apart": "Datum;Uhrzeit;x\n14.03.2026;23:59:59;21,5\n15.03.2026;00:00:00;\n15.03.2026;00:00:01,5;0,001\n",
    "time of day over midnight": "time,x\n23:59:59,21.5\n00:00:00,\n00:00:01.5,1e-3\n",
    "first column increases": "seconds of rig;x\n0;21,5\n1;\n2,5;1e-3\n",
}


def written(folder, data, name="run.csv"):
    path = folder / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
def test_every_dialect_gives_the_same_table(tmp_path, text):
    table = read_recording(written(tmp_path, text))
    np.testing.assert_allclose(table.t - table.t[0], T, atol=1e-6)
    assert list(table.columns) == ["x"]
    np.testing.assert_allclose(table.columns["x"], X)
    if "C" in text.split("0")[0]:
        assert table.units == {"x": "degC"}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1", "utf-16", "utf-16-le", "utf-16-be"])
def test_every_encoding(tmp_path, encoding):
    table = read_recording(written(tmp_path, "t;Öl [°C]\n0;21,5\n1;22\n".encode(encoding)))
    assert list(table.columns) == ["Öl"] and table.units == {"Öl": "degC"}
    said = [n for n in table.notes if n.startswith("read as")]
    assert bool(said) == (encoding != "utf-8-sig")


def test_excel(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    from datetime import datetime

    book = openpyxl.Workbook()
    for row in (
        ["Zeit", "x [°C]"],
        [datetime(2026, 3, 14, 9, 26, 53), 21.5],
        [datetime(2026, 3, 14, 9, 26, 54), None],
    ):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    table = read_recording(tmp_path / "run.xlsx")
    assert table.t.tolist() == [0, 1] and table.units == {"x": "degC"}
    np.testing.assert_array_equal(table.columns["x"], [21.5, np.nan])
    with pytest.raises(InputError, match="not a whole Excel file"):
        read_recording(written(tmp_path, "t,x\n", "no.xlsx"))


@pytest.mark.parametrize(
    "text, says",
    [
        ("t;x\n0;1,5\n1;warm\n2;3,5\n", ":3: column 'x': 'warm' stands where a number belongs"),
        (
            "t;x\n# c\n0;1,5\n\n1;1.5\n2;3,5\n",
            ":5: column 'x': '1.5' stands where a number with a decimal comma",
        ),
        ("t;x\n0;1,5\n1\n2;3,5\n", ":3: 1 cells; 2 as in the header were expected"),
        ("t;x\n0;1\n1;2\n1;3\n", ":4: the time 1 stands twice"),
        ("t;x\n0;1\n5;2\n1;3\n", ":4: the time 1 runs backwards from 5"),
        ("t;x;x;x_1\n0;1;1;1\n", ":2: the column 'x' stands twice in the header"),
        ("Time;x;Time;y\n0;1;5;1\n1;1;5;1\n2;1;5;1\n", ":2: the column 'Time' stands twice in the header"),
        ("a;b\n5;1\n3;2\n", "name it with --time COLUMN"),
        (
            "Zeit;x\n2026-03-14T09:26:53;1\n;2\n2026-03-14T09:26:55;2\n",
            ":3: column 'Zeit': the time is missing",
        ),
        (
            "Zeit;x\n2026-03-14 09:26:53;1\n2026-03-14 09:26:54;2\n2026-13-14 09:26:55;1\n",
            "no date: a month of 1 to 12",
        ),
        ("Zeit;x\n01/02/2026 1:00;1\n03/05/2026 1:00;2\n", "cannot be told apart"),
        ("t;x\n", "no rows"),
        ("just a text\nof two lines\n", ":1: 'just a text': no columns"),
        (b"t;x\n0;\x001\n1\x00;2\n\xff", "zero bytes"),
    ],
)
def test_a_mistake_is_one_line_with_its_place(tmp_path, text, says):
    path = written(tmp_path, text)
    with pytest.raises(InputError) as e:
        read_recording(path)
    assert says in str(e.value) and str(e.value).startswith(str(path)) and "\n" not in str(e.value)


DOUBLED = {
    "by a number": ("t,Loop,y,Loop\n0,1,2,3\n1,4,5,6\n", {"Loop_1": [1, 4], "y": [2, 5], "Loop_2": [3, 6]}),
    "with a unit": ("t,Loop [K],Loop [K]\n0,1,2\n1,3,4\n", {"Loop_1": [1, 3], "Loop_2": [2, 4]}),
    "an empty one": ("t,x,y,x\n0,1,2,\n1,4,5,\n", {"x": [1, 4], "y": [2, 5]}),
    "no name": ("t [s],x,,\n0,1,2,\n1,4,5,\n", {"x": [1, 4], "column_3": [2, 5]}),
    "blocks": ("Time,Loop,Time,Loop\n0,1,0,3\n1,4,0.5,6\n", {"Loop_1": [1, np.nan, 4], "Loop_2": [3, 6, np.nan]}),
}  # fmt: skip


@pytest.mark.parametrize("text, columns", DOUBLED.values(), ids=DOUBLED)
def test_a_doubled_name_refuses_no_file(tmp_path, text, columns):
    table = read_recording(written(tmp_path, text))
    assert list(table.columns) == list(columns)
    assert table.units == (dict.fromkeys(columns, "K") if "[K]" in text else {})
    for name, values in columns.items():
        np.testing.assert_array_equal(table.columns[name], values)
    if "Loop_1" in columns:
        assert "'Loop' stands 2 times in the header: called Loop_1, Loop_2" in table.notes
        with pytest.raises(InputError, match="no column 'Loop'.*did you mean 'Loop_"):
            read_recording(table.path, columns={"heat": "Loop"})
    if "column_3" in columns:
        assert "columns without a name: called column_3" in table.notes


def test_every_guess_is_said_aloud(tmp_path):
    notes = read_recording(written(tmp_path, DIALECTS["ISO"])).notes
    assert notes == (
        "separator ';'" + ", decimal comma",
        "time from 'Zeit': dates read as year-month-day, from 2026-03-14 09:26:53.000 (another: --time COLUMN)",
    )
    assert read_recording(written(tmp_path, "t,x\n0,1\n")).notes == ()


CODES = ("-127", "85", "-9999", "-9999.0", "6999", "7999", "1e37", "-999.9", "32767")


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("sign", [",", ";"])
def test_a_number_that_means_no_reading_is_named_and_kept(tmp_path, code, sign):
    """A DS18B20 that lost contact logs -127, one that restarted 85.0: a diagnosis took both for heat."""
    rows = [f"{k}{sign}{code if k in (3, 7) else 20 + 0.25 * k}{sign}{k % 2}" for k in range(20)]
    path = written(tmp_path, "\n".join([sign.join(("t", "T", "heat")), *rows]) + "\n")
    table = read_recording(path)
    number = float(code)
    assert (table.columns["T"] == number).sum() == 2
    said = next(n for n in table.notes if "no reading" in n)
    assert said.startswith(f"'T': {number:.10g} stands 2 times, the other readings are 20 to 24.75")
    again = read_recording(path, missing=(said.rpartition("=")[2],))
    assert np.isnan(again.columns["T"]).sum() == 2 and not any("no reading" in n for n in again.notes)


@pytest.mark.parametrize(
    "values",
    [
        [20 + 5.0 * k for k in range(14)],  # it passes 85 on its way
        [0, 0, 999, 999, 0, 999],  # on and off
        [80.0, 81.5, 85.0, 85.0, 79.5],
        [-9999.0] * 5,
    ],
)
def test_a_reading_that_looks_like_a_code_is_no_suspect(tmp_path, values):
    path = written(tmp_path, "\n".join(["t,T", *(f"{k},{v}" for k, v in enumerate(values))]) + "\n")
    assert not any("no reading" in n for n in read_recording(path).notes)


def test_two_codes_of_one_column_are_both_named(tmp_path):
    values = [20.5, 21, -127, 22, 85, 20, -127, 21]
    path = written(tmp_path, "\n".join(["t,T", *(f"{k},{v}" for k, v in enumerate(values))]) + "\n")
    notes = [n for n in read_recording(path).notes if "no reading" in n]
    assert [n.partition(",")[0] for n in notes] == ["'T': -127 stands 2 times", "'T': 85 stands 1 times"]


def test_our_own_files_go_the_old_way(tmp_path, monkeypatch):
    from thermoctl.recording.foreign import logger

    monkeypatch.setattr(logger, "sheets_of", lambda *_: 1 / 0)
    assert len(read_recording(written(tmp_path, "# c\nt,x\n0,1\n1,\n"))) == 2


def test_the_time_column_by_name_and_renamed_columns(tmp_path):
    path = written(tmp_path, "n;clock [ms];P [kW];T\n1;0;2;3\n2;500;4;5\n")
    table = read_recording(path, "clock", {"heat": "P", "n": "T"})
    assert table.t.tolist() == [0, 0.5] and table.units == {"heat": "kW"}
    assert {k: v.tolist() for k, v in table.columns.items()} == {"heat": [2, 4], "n": [3, 5]}
    other = read_recording(written(tmp_path, "t;clock;x\n7;0;2\n9;1;4\n", "other.csv"), "clock")
    assert other.t.tolist() == [0, 1] and list(other.columns) == ["t", "x"]
    swapped = read_recording(path, "clock", {"P": "T", "T": "P"})
    assert swapped.columns["P"].tolist() == [3, 5] and swapped.columns["T"].tolist() == [2, 4]
    with pytest.raises(InputError, match=r"no column 'clok' \(did you mean 'clock'\?\)"):
        read_recording(path, "clok")
    with pytest.raises(InputError, match="no column 'Q', which 'heat' shall be read from"):
        read_recording(path, "clock", {"heat": "Q"})
    for wrong in ("heat", "a=b,a=c", "=b"):
        with pytest.raises(InputError, match="--columns"):
            parsed_columns(wrong)
    assert (
        parsed_columns("heat = P,T=T block") == {"heat": "P", "T": "T block"} and parsed_columns(None) == {}
    )


def test_parquet_with_a_time_of_its_own(tmp_path):
    path = tmp_path / "run.parquet"
    stamps = pa.array([1773480413000, 1773480414500], pa.timestamp("ms"))
    field = pa.field("x", pa.float64(), metadata={"unit": "degF"})
    schema = pa.schema([pa.field("when", stamps.type), field, pa.field("who", pa.string())])
    pa.parquet.write_table(pa.table([stamps, pa.array([70.0, 71.0]), pa.array(["a", "b"])], schema), path)
    table = read_recording(path, "when")
    assert table.t.tolist() == [0, 1.5] and list(table.columns) == ["x"]
    with pytest.raises(InputError, match="no column 'then'"):
        read_recording(path, "then")


PIECES = [
    "t",
    "x",
    ";",
    ",",
    "\t",
    "\n",
    "\r\n",
    "1",
    "2,5",
    "3.5",
    '"',
    "#",
    "Zeit",
    "[s]",
    "(",
    ")",
    "-",
    ":",
    "12:30:00",
    "2026-03-14",
    "NaN",
]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    data=st.binary(max_size=80)
    | st.lists(st.sampled_from(PIECES), max_size=40).map(lambda p: "".join(p).encode())
    | st.lists(st.sampled_from(PIECES), max_size=40).map(
        lambda p: b"t;x\n0;1\n" + "".join(p).encode("utf-16-le")
    ),
    suffix=st.sampled_from([".csv", ".txt", ".tsv"]),
)
def test_no_bytes_at_all_make_a_traceback(tmp_path, data, suffix):
    path = written(tmp_path, data, f"junk{suffix}")
    try:
        table = read_recording(path)
    except InputError as e:
        assert str(e).startswith(str(path)) and "\n" not in str(e)
    else:
        assert len(table) and np.all(np.diff(table.t) > 0)
