"""Files of loggers are read to the numbers that they hold; the page that lists them is what the reader prints."""

import pytest

from tests.recording import loggers
from thermoctl import cli
from thermoctl.recording.foreign.logger import read_recording


@pytest.mark.parametrize("case", loggers.CASES, ids=lambda c: c.logger)
def test_a_loggers_file_gives_its_numbers(tmp_path, case):
    path = case.written(tmp_path)
    assert loggers.differences(case, read_recording(path, **case.how)) == []


def test_the_page_lists_every_logger_as_it_is_read():
    assert loggers.PAGE.read_text() == loggers.page(), "python -m tests.recording.loggers --write"
    assert len(loggers.CASES) >= 40


def test_explain_says_how_and_why(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.csv").write_text("Sample;Zeit [ms];T [°C]\n0;0;20,5\n1;500;21,5\n2;1000;22,5\n")
    assert cli.main(["recordings", "import", "--explain", "run.csv"]) == 0
    printed = capsys.readouterr().out
    assert "run.csv: read as: text, separator ';', data from line 2" in printed
    assert "time: 'Zeit': unit, name 'Zeit', increases evenly; time converted from ms to s" in printed
    assert "column: T [degC]" in printed and not list(tmp_path.glob("*.parquet"))
    assert cli.main(["recordings", "import", "run.csv"]) == 2
    assert "--out" in capsys.readouterr().err
