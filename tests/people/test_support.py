"""`thermoctl report`: an archive with versions, configuration, log and recording, without secrets."""

import zipfile

import numpy as np
import pyarrow.parquet as pq
import pytest

from thermoctl import cli
from thermoctl.cli.support import without_secrets
from thermoctl.configuration.settings import load_settings
from thermoctl.recording.writer import RecordingWriter


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("THERMOCTL_CONFIG", raising=False)
    assert cli.main(["init"]) == 0
    return tmp_path


def test_an_archive_of_a_rig_that_ran(folder, capsys):
    with open("config/simulated.yaml", "a") as config:
        config.write("\n# password: hunter2\n")
    own = load_settings("config/simulated.yaml")
    writer = RecordingWriter(own.recording, {"config": "rig"}, signals=own.row.signals)
    rows = np.zeros((5000, len(own.row.signals)))
    rows[:, [s.name for s in own.row.signals].index("t_s")] = np.arange(5000) * 1e-3
    writer.write(rows)
    writer.close()
    (folder / "run").mkdir(exist_ok=True)
    (folder / "run/simulated.log").write_text("connected to mqtt://me:hunter2@broker\nstarted\n")
    assert cli.main(["report", "--seconds", "1"]) == 0
    assert "Read it before you send it" in capsys.readouterr().out
    with zipfile.ZipFile("thermoctl-report.zip") as archive:
        texts = {n: archive.read(n) for n in archive.namelist()}
        (recording,) = [n for n in texts if n.endswith(".parquet")]
        archive.extract(recording)
    assert b"hunter2" not in b"".join(texts.values())
    assert b"started" in texts["log.txt"] and b"numpy 2" in texts["versions.txt"]
    assert {"configuration.yaml", "effective.yaml"} < texts.keys()
    rows = pq.read_table(recording)
    assert 900 <= rows.num_rows <= 1001 and "position_um" in rows.column_names


def test_what_is_missing_is_said(folder, capsys):
    assert cli.main(["report"]) == 0
    said = capsys.readouterr().out
    assert "no log" in said and "no recording" in said
    assert cli.main(["report", "--out", "none/report.zip"]) == 2


@pytest.mark.parametrize(
    "text",
    [
        "token: X",
        "api_key = X",
        '"password": "X"',
        "Authorization: Bearer X",
        "https://a:X@b.c",
        "MQTT_PASSWORD=X",
    ],
)
def test_secrets_are_left_out(text):
    assert "X" not in without_secrets(text)
