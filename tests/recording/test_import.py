"""`recordings import`: Parquet with units from any logger's files, several parts in the order of their times."""

import pyarrow.parquet as pq
import pytest

from thermoctl import cli
from thermoctl.recording.foreign.logger import read_recording


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_units_are_kept(folder, capsys):
    (folder / "a.csv").write_text(
        "Zeit;P [kW];T (°C)\n2026-03-14 09:00:00;1,5;21\n2026-03-14 09:00:01;2,5;22\n"
    )
    assert cli.main(["recordings", "import", "a.csv", "--out", "a.parquet"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "a.parquet: 2 rows, 1 s; P [kW], T [degC]\n" and "note: a.csv: " in printed.err
    assert pq.read_schema("a.parquet").field("P").metadata == {b"unit": b"kW"}
    table = read_recording("a.parquet")
    assert table.units == {"P": "kW", "T": "degC"} and table.meta == {"start": "2026-03-14T09:00:00.000"}
    assert table.columns["P"].tolist() == [1.5, 2.5]


def test_parts_are_joined_by_their_dates(folder):
    (folder / "b.csv").write_text("time,x\n2026-03-14 10:00:00,3\n2026-03-14 10:00:01,4\n")
    (folder / "a.csv").write_text("time,x\n2026-03-14 09:00:00,1\n2026-03-14 09:00:01,2\n")
    assert cli.main(["recordings", "import", "b.csv", "a.csv", "--out", "ab.parquet"]) == 0
    table = read_recording("ab.parquet")
    assert table.t.tolist() == [0, 1, 3600, 3601] and table.columns["x"].tolist() == [1, 2, 3, 4]
    assert table.meta["start"] == "2026-03-14T09:00:00.000"


def test_renamed_columns_and_time(folder):
    (folder / "a.csv").write_text("n,ms,x\n1,0,5\n2,500,6\n")
    args = ["recordings", "import", "a.csv", "--out", "a.parquet", "--time", "n", "--columns", "heat=x"]
    assert cli.main(args) == 0
    table = read_recording("a.parquet")
    assert table.t.tolist() == [1, 2] and list(table.columns) == ["ms", "heat"]


@pytest.mark.parametrize(
    "second, says",
    [
        ("t,y\n5,1\n6,1\n", "other columns than a.csv (x, y)"),
        ("t,x\n1,1\n6,1\n", "begins at t = 1 s, before the end of a.csv at 2 s"),
        ("t,x [m]\n5,1\n6,1\n", "other units than a.csv"),
    ],
)
def test_what_is_no_part_is_refused(folder, capsys, second, says):
    (folder / "a.csv").write_text("t,x\n0,1\n2,1\n")
    (folder / "b.csv").write_text(second)
    assert cli.main(["recordings", "import", "a.csv", "b.csv", "--out", "ab.parquet"]) == 2
    assert says in capsys.readouterr().err and not (folder / "ab.parquet").exists()


@pytest.mark.parametrize(
    "first, second, good",
    [
        ("03/04/2026", "04/04/2026", False),
        ("03/04/2026", "13/04/2026", True),
        ("03/04/2026", "04/13/2026", False),
        ("03/04/2026", "03/04/2026", True),
        ("2026-04-03", "2026-04-04", True),
    ],
)
def test_files_are_placed_by_dates_that_are_sure(folder, capsys, first, second, good):
    """A month was a day, or the other way round: the files had another gap between them."""
    (folder / "a.csv").write_text(f"time,x\n{first} 10:00:00,1\n{first} 10:00:01,2\n")
    (folder / "b.csv").write_text(f"time,x\n{second} 11:00:00,3\n{second} 11:00:01,4\n")
    assert cli.main(["recordings", "import", "a.csv", "b.csv", "--out", "ab.parquet"]) == (0 if good else 2)
    assert good or "day and month cannot be told apart" in capsys.readouterr().err


def test_times_without_a_date_have_no_place_among_dates(folder, capsys):
    (folder / "a.csv").write_text("time,x\n2026-03-14 09:00:00,1\n2026-03-14 09:00:01,2\n")
    (folder / "b.csv").write_text("time,x\n5,3\n6,4\n")
    assert cli.main(["recordings", "import", "a.csv", "b.csv", "--out", "ab.parquet"]) == 2
    assert "b.csv: times without a date beside files with dates" in capsys.readouterr().err
