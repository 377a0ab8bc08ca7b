"""Signals in the middle of a command: one line, status 130, no half file, the recorded rows kept.

kill -9 of a test: what its stream on the disk lacks, and that the test goes on.
"""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.daemon.process import Daemon, patient, wait
from tests.hazards.harness import ROWS, Row
from tests.simulated import ROOT, rig_file
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.lock import holder
from thermoctl.recording.files import read_table

HEATER = ROOT / "docs/examples/heater"
COMMANDS = {
    "experiment": (
        ["experiment", "test_1", "--config", "rig.yaml", "--out", "test.parquet"],
        "",
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
    "fleet": (
        ["fleet", "rigs", "--plant", HEATER / "plant.yaml", "--workers", "2"],
        "",
        "thermoctl: fleet: ended by SIGTERM",
    ),
    "start": (["start", "--config", "rig.yaml"], "", "thermoctl: start: ended by SIGTERM"),
}
"""Words of each command, what it prints before the signal ('': see `is_begun`), and its last line."""


EXPERIMENT = """format: thermoctl-experiments/1
rate_um_s: 16.6667
experiments:
  short: {title: Up and down, parts: [{hold: [[1, 0], [6, 20], [3, 0]]}]}
"""


def command(folder, out, *words):
    """Start a command in a folder; what it prints goes to `out`."""
    return subprocess.Popen(
        [sys.executable, "-m", "thermoctl.cli", *map(str, words)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT}/hal", "PYTHONUNBUFFERED": "1"},
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=out,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


@pytest.fixture
def folder(tmp_path):
    rig_file(tmp_path)
    (tmp_path / "experiments.yaml").write_bytes((ROOT / "config/experiments.yaml").read_bytes())
    (tmp_path / "rigs/a").mkdir(parents=True)
    (tmp_path / "rigs/a/run_1.csv").write_bytes((HEATER / "run_1.csv").read_bytes())
    return tmp_path


def is_begun(name, folder, said):
    """Return whether a command is at work."""
    if name == "experiment":
        return (folder / "test.parquet.progress").exists()
    if name == "export":
        return any(folder.glob(".long.csv.*.part"))
    if name == "fleet":  # a process of its cluster has just begun
        return len(psutil.Process().children(recursive=True)) > 1
    if name == "start":
        return any(folder.glob("*.log"))
    return COMMANDS[name][1] in said


@pytest.mark.parametrize(  # the first Ctrl-C ends a diagnosis with the result so far, see tests/diagnose
    ("name", "number"),
    [
        *((name, signal.SIGTERM) for name in COMMANDS if name != "calibrate"),
        *((name, signal.SIGINT) for name in ("experiment", "calibrate", "fleet", "start")),
    ],
)
def test_a_signal_ends_a_command(folder, name, number):
    words, _, line = COMMANDS[name]
    if name == "export":
        rows = np.arange(600_000)
        columns = {"t_s": rows * 1e-3, **{f"a{k}": np.sin(rows + k) for k in range(12)}}
        pq.write_table(pa.table(columns), folder / "long.parquet")
    log = folder / "said"
    with log.open("w") as out:
        process = command(folder, out, *words)
    wait(lambda: is_begun(name, folder, log.read_text()), name)
    process.send_signal(number)
    assert process.wait(60) == 130, log.read_text()
    said = log.read_text()
    assert line.replace("SIGTERM", number.name) in said.splitlines()[-1] and "Traceback" not in said, said
    assert not [*folder.glob(".*.part"), *folder.glob("long.csv"), *folder.glob("out")]
    assert holder(load_settings(folder / "rig.yaml")) is None
    if name == "experiment":
        assert len(read_table(folder / "test.parquet")) > 0
    if name == "calibrate":
        reached_s = json.loads((folder / "cal/state.json").read_text())["at_s"]["test_1"]
        assert read_table(folder / "cal/test_1.part.parquet").t[-1] >= reached_s - 1.0


EARLY = """
import os, signal, sys
from thermoctl.cli import main
class Early:
    def find_spec(self, name, path, target=None):
        if name == "thermoctl.cli.command_line":
            os.kill(os.getpid(), signal.Signals[sys.argv[1]])
sys.meta_path.insert(0, Early())
sys.exit(main())
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_while_a_command_is_loaded_ends_it_in_one_line(name):
    """The first 0.2 s of a command are imports: a signal in them ended it with -15 and no line."""
    done = subprocess.run([sys.executable, "-c", EARLY, name], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stderr) == (130, f"thermoctl: ended by {name}\n")


HELD = """
import os, signal, thermoctl.interrupt as i
i.raise_on_signals()
try:
    with i.held():
        os.kill(os.getpid(), signal.SIGTERM)
        print("process known")
except i.Interrupted as e:
    print(e)
"""


def test_a_signal_waits_until_a_process_that_starts_is_known():
    """`start` that was ended right after it had made the daemon left it running."""
    done = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.splitlines() == ["process known", "ended by SIGTERM"]


LATE = """
import os, signal, sys, thermoctl.interrupt as i
i.raise_on_signals()
class Late:
    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.Signals[sys.argv[1]]):
        kill(pid, number)
late = Late()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_while_python_ends_changes_no_exit_status(name):
    """The command has done its work: before, its status was -2 or -15 all the same."""
    done = subprocess.run([sys.executable, "-c", LATE, name], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and not done.stderr


def test_kill_9_of_a_test_costs_a_second_of_rows_and_it_goes_on(tmp_path):
    config, out = patient(rig_file(tmp_path)), tmp_path / "short.parquet"
    (tmp_path / "experiments.yaml").write_text(EXPERIMENT)
    words = "experiment", "short", "--config", config, "--out", out, "--resume", "--yes"
    stream = out.with_name("short.parquet.running.arrows")
    daemon = Daemon(config)
    try:
        process = command(tmp_path, subprocess.DEVNULL, *words)
        wait(lambda: stream.exists() and len(read_table(stream)) > 20, "rows on the disk")
        process.kill()
        process.wait()
        killed_s = time.time()
        lost_s = killed_s - read_table(stream).columns["wall_s"][-1]
        assert lost_s < 2.0  # 1 s, and the rows of the last look
        wait(lambda: daemon.ask("status")["state"] == "READY", "disarmed")
        with (tmp_path / "said").open("w") as said:
            assert command(tmp_path, said, *words).wait(120) == 0
        assert "goes on at" in (tmp_path / "said").read_text()
        whole = read_table(out)
        assert np.diff(whole.t).max() < 2.0 and whole.columns["wall_s"][0] < killed_s
        assert [p.name for p in tmp_path.glob("short*")] == ["short.parquet"]
        measured = f"{lost_s:.2f} s of its rows lost"
        ROWS.append(
            Row("Processes", "kill -9: experiment", "2 s of rows", measured, "amplifier off; goes on", "")
        )
    finally:
        daemon.kill()
