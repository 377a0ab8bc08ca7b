"""A sample of `make disk`, and the daemon on a disk that another program fills (root: a small tmpfs)."""

import os
import shutil
import subprocess
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from tests.daemon.process import Daemon, wait
from tests.simulated import rig_file
from thermoctl.recording.files import read_table

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ("recorder and", "tune", "rollback", "save-effect")


@pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
def test_a_sample_of_writers_under_errors(tmp_path):
    section = tmp_path / "section"
    command = [sys.executable, "-m", "tests.disk.run", *SAMPLE]
    command += ["--every", "7", "--on", "tmpfs", "--section", str(section)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert section.read_text().count("\n| ") == len(SAMPLE) + 2, "a row each, the head and the sum"


@pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
def test_the_sweep_finds_a_writer_that_does_not_keep_what_is_there(tmp_path):
    """It can fail."""
    code = """
import sys
from tests.disk.harness import Writer, preloaded, sweep
preloaded(sys.argv)
from pathlib import Path
old = lambda: Path("a.json").write_text("{}") and 0
new = lambda: Path("a.json").write_text('{"a": [1, 2, 3]}') and 0
print(*sweep(Writer("careless", new, old), Path(sys.argv[1])).faults, sep="\\n")
"""
    (tmp_path / "careless.py").write_text(code)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(tmp_path / "careless.py"), str(tmp_path)],
        env=env,
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert "a.json is torn" in done.stdout and "kill inside n" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow  # make disk
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: a small tmpfs is mounted")
def test_a_disk_that_another_program_fills(tmp_path):
    """Armed throughout; what is not recorded is said; the sound recording stays; recording goes on by itself."""
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(small)]).returncode:
        pytest.skip("cannot mount a tmpfs")
    with ExitStack() as at_end:
        at_end.callback(subprocess.run, ["umount", "-l", str(small)], check=True)
        daemon = Daemon(rig_file(tmp_path, ("../recordings", "small/rec")))
        at_end.callback(daemon.kill)
        daemon.armed()
        first = wait(lambda: [*(small / "rec").glob("*Z.arrows")], "no recording")[0][0]
        wait(lambda: len(read_table(first)) > 1000, "no rows")
        with suppress(OSError), (small / "fill").open("wb", 0) as fill:
            while True:
                fill.write(bytes(4096))
        ((unsaved,), _) = wait(lambda: daemon.ask("status")["unsaved"], "a full disk is not reported")
        rows = len(read_table(first))
        assert (
            unsaved["what"] == "recording"
            and unsaved["why"] == f"{small}/rec: No space left on device; free some space"
        )
        said = subprocess.run(
            [sys.executable, "-m", "thermoctl.cli", "status", "--config", str(daemon.config)],
            capture_output=True,
            text=True,
            cwd=ROOT,
        )
        assert "not saved: recording, since" in said.stdout and "No space left" in said.stdout
        lost = daemon.ask("status")["recorder"]["lost"]
        wait(lambda: daemon.ask("status")["recorder"]["lost"] > lost, "lost ticks are not counted")
        now = daemon.ask("status")
        assert now["state"] == "ARMED"
        (small / "fill").unlink()
        wait(lambda: not daemon.ask("status")["unsaved"], "recording does not go on by itself")
        assert len(read_table(first)) == rows and daemon.ask("status")["state"] == "ARMED"
        wait(
            lambda: [p for p in (small / "rec").glob("*Z.arrows") if p != first and len(read_table(p)) > 100],
            "no second recording",
        )
        assert daemon.stop() == 0
    told = [line for line in daemon.log.splitlines() if "recorded" in line or "recording again" in line]
    assert len(told) == 2 and "nothing is recorded why=" in told[0], told
