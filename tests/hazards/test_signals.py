"""SIGINT and SIGTERM in the middle of a command: one line, status 130, no half file, the recorded rows kept."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.daemon.process import wait
from tests.simulated import ROOT, rig_file
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.lock import holder
from thermoctl.recording.files import read_table

HEATER = ROOT / "docs/examples/heater"
COMMANDS = {
    "experiment": (
        ["experiment", "test_1", "--config", "rig.yaml", "--out", "test.parquet"],
        "moves the output",
        "the amplifier is disabled: stopped on request; go on with --resume --out test.parquet",
    ),
    "calibrate": (
        ["calibrate", "--config", "rig.yaml", "--out", "cal"],
        " test_1: ",
        "the same command goes on",
    ),
    "tune": (["tune", "--config", "rig.yaml", "--write"], "response: ", "thermoctl: tune: "),
    "diagnose": (
        ["diagnose", "--plant", HEATER / "plant.yaml", HEATER / "run_1.csv", "--out", "out"],
        "searching",
        "thermoctl: diagnose: ended by SIGTERM; out holds nothing of this diagnosis",
    ),
    "export": (
        ["recordings", "export", "long.parquet", "long.csv"],
        "",
        "thermoctl: recordings export: ended by SIGTERM",
    ),
    "start": (["start", "--config", "rig.yaml"], "", "thermoctl: start: ended by SIGTERM"),
}
"""Words of each command, what it prints before the signal ('': see `is_begun`), and its last line."""


@pytest.fixture
def folder(tmp_path):
    rig_file(tmp_path)
    (tmp_path / "experiments.yaml").write_bytes((ROOT / "config/experiments.yaml").read_bytes())
    rows = np.arange(600_000)
    columns = {"t_s": rows * 1e-3, **{f"a{k}": np.sin(rows + k) for k in range(12)}}
    pq.write_table(pa.table(columns), tmp_path / "long.parquet")
    return tmp_path


def is_begun(command, folder, said):
    """Return whether a command is at work."""
    if command == "export":
        return any(folder.glob(".long.csv.*.part"))
    if command == "start":
        return any(folder.glob("*.log"))
    return COMMANDS[command][1] in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_signal_ends_a_command(folder, command, number):
    if command == "diagnose" and number == signal.SIGINT:
        pytest.skip("the first Ctrl-C ends the search with the result so far, see tests/diagnose")
    words, _, line = COMMANDS[command]
    log = folder / "said"
    with log.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", *map(str, words)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT}/hal", "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    wait(lambda: is_begun(command, folder, log.read_text()), command)
    process.send_signal(number)
    assert process.wait(60) == 130, log.read_text()
    said = log.read_text()
    assert line.replace("SIGTERM", number.name) in said.splitlines()[-1] and "Traceback" not in said, said
    assert not [*folder.glob(".*.part"), *folder.glob("long.csv"), *folder.glob("out")]
    assert holder(load_settings(folder / "rig.yaml")) is None
    if command == "experiment":
        assert len(read_table(folder / "test.parquet")) > 0
    if command == "calibrate":
        reached_s = json.loads((folder / "cal/state.json").read_text())["at_s"]["test_1"]
        assert read_table(folder / "cal/test_1.part.parquet").t[-1] >= reached_s - 1.0
