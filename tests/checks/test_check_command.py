"""`plant check --data`, and the same checks before `diagnose`: a severe finding stops it, --anyway does not."""

import json

import pytest

from tests.checks.rigs import PLANTS, rig
from thermoctl import cli
from thermoctl.diagnosis import run
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.yaml").write_text(PLANTS["two blocks"])
    _, table = rig("two blocks")
    write_table("run.csv", table)
    one, two = table.columns["temperature_1"], table.columns["temperature_2"]
    write_table(
        "swapped.csv", Table("s", "", table.t, table.columns | {"temperature_1": two, "temperature_2": one})
    )
    return tmp_path


def test_plant_check_with_data(folder, capsys):
    assert cli.main(["plant", "check", "p.yaml", "--data", "run.csv"]) == 0
    assert "the recordings fit the plant's labels" in capsys.readouterr().out
    assert cli.main(["plant", "check", "p.yaml", "--data", "swapped.csv"]) == 1
    printed = capsys.readouterr().out
    assert "severe: swapped.csv: the columns 'temperature_1' and 'temperature_2' are swapped" in printed
    option = printed.split("--columns ")[1].split()[0]
    assert cli.main(["plant", "check", "p.yaml", "--data", "swapped.csv", "--columns", option]) == 0
    assert cli.main(["plant", "check", "p.yaml", "p.yaml", "--data", "run.csv"]) == 2


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("rows", "says"), [(1, "1 row, of which"), (7, "7 rows, of which")])
def test_a_few_rows_are_not_called_a_fit(folder, capsys, rows, says):
    lines = (folder / "run.csv").read_text().splitlines()
    (folder / "few.csv").write_text("\n".join(lines[: rows + 1]) + "\n")
    assert cli.main(["plant", "check", "p.yaml", "--data", "few.csv"]) == 0
    out = capsys.readouterr().out
    assert (
        f"warning: few.csv: {says} nothing is checked. Give 8 or more." in out and "fit the plant" not in out
    )


def test_diagnose_stops_at_a_severe_finding(folder, capsys, monkeypatch):
    given = {}

    def diagnosed(plant, tables, *_, **__):
        given["tables"] = tables
        return {"verdict": "consistent"}

    monkeypatch.setattr(run, "diagnose", diagnosed)
    args = ["diagnose", "--plant", "p.yaml", "--out", "result", "--json"]
    assert cli.main([*args, "swapped.csv"]) == 2
    printed = capsys.readouterr()
    assert (
        "severe: swapped.csv" in printed.err and "diagnose with --anyway" in printed.err and not printed.out
    )
    assert not given and not (folder / "result").exists()
    assert cli.main([*args, "swapped.csv", "--anyway"]) == 0
    printed = capsys.readouterr()
    assert "severe: swapped.csv" in printed.err and json.loads(printed.out) == {"verdict": "consistent"}
    assert cli.main([*args, "run.csv"]) == 0
    assert "severe" not in capsys.readouterr().err and [t.path for t in given["tables"]] == ["run.csv"]


def test_refit_stops_and_simulate_warns_at_the_same_findings(folder, capsys):
    args = ["refit", "--plant", "p.yaml", "--out", "fitted.yaml"]
    assert cli.main([*args, "swapped.csv"]) == 2
    printed = capsys.readouterr().err
    assert "severe: swapped.csv" in printed and "refit with --anyway" in printed
    assert not (folder / "fitted.yaml").exists()
    assert cli.main([*args, "run.csv", "--held-out", "swapped.csv"]) == 2
    assert cli.main([*args, "swapped.csv", "--anyway"]) == 0 and (folder / "fitted.yaml").exists()
    capsys.readouterr()
    assert cli.main([*args, "run.csv"]) == 0 and "severe" not in capsys.readouterr().err
    assert cli.main(["simulate", "--plant", "p.yaml", "swapped.csv"]) == 0
    printed = capsys.readouterr()
    assert "severe: swapped.csv" in printed.err and "rms error" in printed.out
    lines = (folder / "run.csv").read_text().splitlines()
    keep = [k for k, name in enumerate(lines[0].split(",")) if not name.startswith("temperature")]
    inputs = [",".join(line.split(",")[k] for k in keep) for line in lines]
    (folder / "inputs.csv").write_text("\n".join(inputs))
    assert cli.main(["simulate", "--plant", "p.yaml", "inputs.csv"]) == 0
    assert "severe" not in capsys.readouterr().err


def test_folders_of_rigs_take_no_column_options(folder, capsys):
    assert cli.main(["diagnose", "--plant", "p.yaml", "--out", "r", ".", "--time", "t"]) == 2
    assert "recordings import" in capsys.readouterr().err
