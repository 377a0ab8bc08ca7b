"""The command line: commands by purpose, and mistakes answered by the command in which they were made."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from thermoctl import cli
from thermoctl.cli.commands import COMMANDS
from thermoctl.command import FORMATS, PURPOSES
from thermoctl.recording.foreign.opening import _SUFFIXES


def refused(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    return capsys.readouterr().err


def test_the_help_lists_every_command_once_below_its_purpose(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    places = [text.index(f"\n{purpose}:\n") for purpose in PURPOSES]
    assert places == sorted(places)
    for name in {row.name.split()[0] for row in COMMANDS}:
        assert text.count(f"\n  {name} ") == 1, name
    assert max(map(len, text.splitlines())) <= 120


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "thermoctl", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("thermoctl ")


@pytest.mark.parametrize("run", ["exec {} >&-", "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 exec {}"])
def test_without_stdout_or_in_a_locale_that_is_not_utf_8(tmp_path, run):
    """Both were a traceback: `None` has no `flush`, and the reader's words are no ASCII."""
    (tmp_path / "log.csv").write_text("Zeit [s];T [°C]\n0;20,5\n1;21,5\n")
    line = run.format(f"{sys.executable} -m thermoctl recordings import --explain log.csv")
    env = os.environ | {"PYTHONPATH": f"{Path(__file__).parents[1]}:{Path(__file__).parents[1] / 'hal'}"}
    done = subprocess.run(line, shell=True, cwd=tmp_path, env=env, capture_output=True)
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr.decode()
    assert b"degC" in done.stdout or ">&-" in run


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("chek", "thermoctl check"),
        ("staus", "thermoctl status"),
        ("diagnoze x", "thermoctl diagnose"),
        ("recording list", "thermoctl recordings"),
        ("plant chekc p.yaml", "thermoctl plant check"),
        ("device list", "thermoctl devices"),
        ("export p.yaml", "thermoctl recordings export' or 'thermoctl plant export"),
        ("plant simulate", "thermoctl simulate"),
        ("linearize", "thermoctl plant linearise"),
    ],
)
def test_an_unknown_command_names_the_nearest(words, meant, capsys):
    assert f"did you mean '{meant}" in refused(capsys, *words.split())


def test_what_resembles_no_command_gets_no_guess(capsys):
    error = refused(capsys, "xyzzy")
    assert "unknown command 'xyzzy'" in error and "did you mean" not in error


@pytest.mark.parametrize(
    ("words", "usage", "says"),
    [
        ("model list --config F", "usage: thermoctl model ", "unrecognized arguments: --config F"),
        ("plant", "usage: thermoctl plant ", "new, "),
        ("plant zzz", "usage: thermoctl plant ", "unknown command 'zzz'"),
        ("setpoint", "usage: thermoctl setpoint ", "VALUE_UM"),
        ("diagnose --heldout x", "usage: thermoctl diagnose ", "did you mean '--held-out'?"),
        ("recordings import a --out b --tim t --x", "usage: thermoctl recordings import ", "--x"),
    ],
)
def test_a_mistake_shows_the_usage_of_its_own_command(words, usage, says, capsys):
    error = refused(capsys, *words.split())
    assert error.startswith(usage) and says in error


def test_every_command_lists_the_same_formats():
    listed = {row.name for row in COMMANDS for a in row.arguments if FORMATS in str(a.options.get("help"))}
    assert listed >= {"plant check", "simulate", "refit", "diagnose", "noise", "recordings import"}
    kinds = {_SUFFIXES[s] for s in FORMATS.replace(",", "").split() if s in _SUFFIXES}
    assert kinds == set(_SUFFIXES.values())


def test_diagnose_names_a_plant_that_is_given_as_a_recording(capsys):
    assert cli.main(["diagnose", "plant.yaml", "run_1.csv", "--out", "out"]) == 2
    assert "--plant FILE is missing (--plant plant.yaml was meant?)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "--plant", "plant.yaml", "run.csv", "--out", "run.csv"),
        ("simulate", "--plant", "plant.yaml", "run.csv", "--plot", "run.csv"),
        ("refit", "--plant", "plant.yaml", "run.csv", "--out", "./plant.yaml"),
        ("recordings", "import", "run.csv", "--out", "link.csv"),
        ("recordings", "export", "run.csv", "run.csv"),
        ("recordings", "recover", "run.csv", "--out", "run.csv"),
    ],
)
def test_no_result_is_written_over_a_file_that_was_read(tmp_path, monkeypatch, capsys, words):
    """`simulate --out` of a recording's own name lost the recording."""
    monkeypatch.chdir(tmp_path)
    for name in ("run.csv", "plant.yaml"):
        (tmp_path / name).write_text("precious")
    (tmp_path / "link.csv").symlink_to("run.csv")
    assert cli.main(words) == 2
    assert "is a file that the command reads; name another one" in capsys.readouterr().err
    assert {(tmp_path / n).read_text() for n in ("run.csv", "plant.yaml")} == {"precious"}


@pytest.mark.parametrize("word", ["/dev/zero", "pipe"])
def test_a_device_or_a_pipe_is_no_recording(tmp_path, monkeypatch, capsys, word):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    assert cli.main(["recordings", "import", "--explain", word]) == 2
    assert f"{word}: a pipe or a device" in capsys.readouterr().err


def test_the_command_line_alone_loads_no_package():
    """`thermoctl --help` reads the tables of commands and nothing that they name."""
    code = "import sys, thermoctl.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not {"numpy", "scipy", "pint", "rich", "thermoctl.settings", "thermoctl.plant.files"} & set(
        loaded.split()
    )
