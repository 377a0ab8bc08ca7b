"""A sample of `make disk`, and the daemon on a disk that another program fills (root: a small tmpfs)."""

import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.control_socket import ask
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import read_table

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ("recorder and", "tune", "rollback", "save-effect")


@pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
def test_a_sample_of_writers_under_errors(tmp_path):
    section = tmp_path / "section"
    command = [
        sys.executable,
        "-m",
        "tests.disk.run",
        *SAMPLE,
        "--every",
        "4",
        "--on",
        "tmpfs",
        "--section",
        str(section),
    ]
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


def wait(condition, what, limit_s=90.0):
    begin = time.monotonic()
    while time.monotonic() - begin < limit_s:
        with suppress(InputError):
            if found := condition():
                return found
        time.sleep(0.05)  # how often we look
    raise AssertionError(what)


@pytest.mark.slow  # make disk
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: a small tmpfs is mounted")
def test_a_disk_that_another_program_fills(tmp_path):
    """Armed throughout; what is not recorded is said; the sound recording stays; recording goes on by itself."""
    small = tmp_path / "small"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(small)]).returncode:
        pytest.skip("cannot mount a tmpfs")
    config = tmp_path / "rig.yaml"
    text = (ROOT / "config/simulated.yaml").read_text()
    text = text.replace("directory: ../recordings", "directory: small/rec").replace(
        "plants/", f"{ROOT}/config/plants/"
    )
    text = text.replace("models/", f"{ROOT}/config/models/").replace("../run/simulated.sock", "rig.sock")
    config.write_text(text)
    settings = load_settings(config)
    status = lambda: ask(settings.socket.path, {"command": "status"})  # noqa: E731
    program = [sys.executable, "-m", "thermoctl.cli"]
    with (tmp_path / "log").open("wb") as log:
        daemon = subprocess.Popen([*program, "run", "--config", str(config)], stderr=log, cwd=ROOT)
    try:
        wait(lambda: status()["state"] == "READY", "not ready")
        wait(lambda: ask(settings.socket.path, {"command": "arm"})["ok"], "not armed")
        first = wait(lambda: [*(small / "rec").glob("*Z.arrows")], "no recording")[0]
        wait(lambda: len(read_table(first)) > 1000, "no rows")
        with suppress(OSError), (small / "fill").open("wb", 0) as fill:
            while True:
                fill.write(bytes(4096))
        (unsaved,) = wait(lambda: status()["unsaved"], "a full disk is not reported")
        rows = len(read_table(first))
        assert unsaved["what"] == "recording" and unsaved["why"] == f"{small}/rec: No space left on device"
        said = subprocess.run(
            [*program, "status", "--config", str(config)], capture_output=True, text=True, cwd=ROOT
        )
        assert "not saved: recording, since" in said.stdout and "No space left" in said.stdout
        lost = status()["recorder"]["lost"]
        wait(lambda: status()["recorder"]["lost"] > lost, "lost ticks are not counted")
        now = status()
        assert now["state"] == "ARMED"
        (small / "fill").unlink()
        wait(lambda: not status()["unsaved"], "recording does not go on by itself")
        assert len(read_table(first)) == rows and status()["state"] == "ARMED"
        wait(
            lambda: [p for p in (small / "rec").glob("*Z.arrows") if p != first and len(read_table(p)) > 100],
            "no second recording",
        )
    finally:
        daemon.terminate()
        daemon.wait(30)
        subprocess.run(["umount", "-l", str(small)], check=True)
    told = [
        line
        for line in (tmp_path / "log").read_text().splitlines()
        if "recorded" in line or "recording again" in line
    ]
    assert len(told) == 2 and "nothing is recorded why=" in told[0], told
