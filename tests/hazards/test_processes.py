"""The daemon's real processes on the simulated rig: each one killed, stopped and gone on, on a full and on a read-only disk, over
leftovers of shared memory. Real time: limits are generous, what was measured is in the table."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.daemon.process import LIMIT_S, Daemon, wait
from tests.hazards.harness import ROOT, ROWS, Row
from tests.simulated import rig_file
from thermoctl.daemon.tick.assemble import shared_name
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import read_table

pytestmark = pytest.mark.slow


def start(folder, directory):
    """The simulated rig's daemon, recording into `directory`, its files in `folder`."""
    changes = ("../recordings", str(directory)), ("reference: true", "reference: false")
    found = Daemon(rig_file(folder, *changes))
    assert found.process.poll() is None, found.log
    return found


@pytest.fixture
def daemon(tmp_path):
    d = start(tmp_path, tmp_path / "recordings")
    yield d
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error, OSError):
            process.send_signal(signal.SIGCONT)
    d.kill()


def say(hazard, limit, measured, outcome, message):
    ROWS.append(Row("Processes", hazard, limit, measured, outcome, message))


def ticks(directory):
    """Ticks recorded in a folder, and how many are missing between the first and the last."""
    found = set()
    for path in sorted(directory.glob("*.arrows")):
        if "10hz" not in path.name:
            found |= {int(k) for k in read_table(str(path)).columns["tick"]}
    return len(found), (max(found) - min(found) + 1 - len(found) if found else 0)


@pytest.mark.parametrize("name", ["commands", "recorder"])
def test_kill_9_of_a_helper(daemon, name):
    """The loop runs on armed; the helper is back; the recorder loses at most a second."""
    daemon.armed()
    wait(lambda: daemon.ask("status")["ticks"] > 2500, "a second and more on disk")
    pid, before = daemon.child(name), daemon.ask("status")["ticks"]
    os.kill(pid, signal.SIGKILL)
    _, seconds = wait(lambda: f"{name} ended, started again" in daemon.log, "its end is noticed", 20)
    now, back = wait(lambda: daemon.ask("status"), "an answer")
    assert now["state"] == "ARMED" and now["ticks"] > before
    wait(lambda: daemon.ask("status")["ticks"] > now["ticks"] + 1500, "ticks")
    assert daemon.stop() == 0
    count, missing = ticks(Path(daemon.settings.recording.directory))
    assert count > 1000 and missing <= 1500
    say(
        f"kill -9: {name}",
        "1.5 s of record",
        f"noticed in {seconds:.1f} s; {missing} ticks not recorded",
        "drives on",
        f"`{name} ended, started again`",
    )


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_the_loop_killed_or_stopped_for_good(daemon, how):
    daemon.armed()
    begin = time.monotonic()
    os.kill(daemon.child("loop"), how)
    assert daemon.process.wait(LIMIT_S) == 1
    seconds = time.monotonic() - begin
    assert "the loop" in daemon.log and "could not be disabled" not in daemon.log
    say(
        f"{'kill -9' if how == signal.SIGKILL else 'SIGSTOP for good'}: loop",
        "ends, exit 1",
        f"{seconds:.1f} s",
        "amplifier off by the supervisor; systemd starts it into SAFE",
        "`the loop ended` or `stands still`",
    )


def test_the_loop_stopped_for_a_while(daemon):
    daemon.armed()
    pid = daemon.child("loop")
    os.kill(pid, signal.SIGSTOP)
    begin = time.monotonic()
    wait(lambda: time.monotonic() - begin > 0.3, "0.3 s")
    os.kill(pid, signal.SIGCONT)
    now, _ = wait(lambda: (s := daemon.ask("status"))["state"] == "FAULT" and s, "FAULT")
    assert "loop_late" in [f["name"] for f in now["faults"]] and now["enable"] == 0.0
    daemon.armed()
    now = daemon.ask("status")
    assert abs(now["setpoint_um"] - now["compensated_um"]) < 0.5
    say(
        "SIGSTOP, SIGCONT after 0.3 s: loop",
        "first tick",
        "first tick after it",
        "amplifier off; re-armed without a jump",
        "`loop_late`",
    )


def test_the_whole_machine_stands_for_a_while(daemon):
    """Every process stands, the loop's watcher too: that is no loop that hangs. The loop finds the gap itself and drives on
    only when armed anew."""
    daemon.armed()
    everyone = [daemon.process.pid, *(p.pid for p in daemon.family)]
    for pid in everyone:
        os.kill(pid, signal.SIGSTOP)
    begin = time.monotonic()
    wait(lambda: time.monotonic() - begin > 3.0, "3 s")
    os.kill(everyone[0], signal.SIGCONT)  # the supervisor first: it looks, and sees no tick since
    begin = time.monotonic()
    wait(lambda: time.monotonic() - begin > 0.2, "0.2 s")
    for pid in everyone[1:]:
        os.kill(pid, signal.SIGCONT)
    now, _ = wait(lambda: (s := daemon.ask("status"))["state"] == "FAULT" and s, "FAULT")
    assert "loop_late" in [f["name"] for f in now["faults"]] and now["enable"] == 0.0
    daemon.armed()
    assert daemon.process.poll() is None and "stands still" not in daemon.log
    say(
        "SIGSTOP, SIGCONT after 3 s: every process",
        "first tick",
        "first tick after it",
        "amplifier off; re-armed without a jump",
        "`loop_late`",
    )


def test_the_recorder_stopped_for_a_while_loses_nothing(daemon):
    daemon.armed()
    pid = daemon.child("recorder")
    os.kill(pid, signal.SIGSTOP)
    before = daemon.ask("status")["ticks"]
    wait(lambda: daemon.ask("status")["ticks"] > before + 3000, "three seconds of ticks")
    os.kill(pid, signal.SIGCONT)
    wait(lambda: daemon.ask("status")["recorder"]["rows"] > before + 3000, "the rows are written")
    assert daemon.ask("status")["recorder"]["lost"] == 0
    assert daemon.stop() == 0
    count, missing = ticks(Path(daemon.settings.recording.directory))
    assert missing == 0 and count > 3000
    say(
        "SIGSTOP, SIGCONT after 3 s: recorder", "nothing lost", f"{missing} of {count} ticks", "drives on", ""
    )


@pytest.mark.parametrize("name", ["commands", "recorder"])
def test_a_helper_stopped_for_good_is_replaced(daemon, name):
    from thermoctl.daemon.processes import HANG_S

    daemon.armed()
    os.kill(daemon.child(name), signal.SIGSTOP)
    _, seconds = wait(
        lambda: f"{name} hangs: killed" in daemon.log and f"{name} ended, started again" in daemon.log,
        "replaced",
    )
    assert seconds > HANG_S / 2  # a busy machine may have held it up before
    now, _ = wait(lambda: daemon.ask("status"), "an answer")
    assert now["state"] == "ARMED"
    say(
        f"SIGSTOP for good: {name}",
        f"{HANG_S:g} s and a start",
        f"replaced in {seconds:.1f} s",
        "drives on",
        f"`{name} hangs: killed`",
    )


def test_the_supervisor_stopped_and_killed(daemon, tmp_path):
    """Stopped: the loop drives on and obeys. Killed: all children go, the loop disables first. What it leaves is replaced, the
    next daemon is never armed by itself, and it goes on with the estimates."""
    daemon.armed()
    daemon.process.send_signal(signal.SIGSTOP)
    before = daemon.ask("status")["ticks"]
    wait(lambda: daemon.ask("status")["ticks"] > before + 2000, "ticks without a supervisor")
    assert daemon.ask("disarm")["ok"]
    daemon.process.send_signal(signal.SIGCONT)
    daemon.armed()
    wait(lambda: Path(daemon.settings.socket.path).with_suffix(".state").exists(), "estimates are kept")
    daemon.process.kill()
    daemon.process.wait()
    _, seconds = wait(lambda: not any(p.is_running() for p in daemon.family), "all children gone", 20)
    left = Path("/dev/shm", shared_name(daemon.settings)).stat().st_ino  # nobody is left who could remove it
    again = Daemon(daemon.config)
    try:
        assert again.ask("status")["state"] == "READY" and "kept=True" in again.log
        assert Path("/dev/shm", shared_name(daemon.settings)).stat().st_ino != left
        assert again.stop() == 0 and not Path("/dev/shm", shared_name(daemon.settings)).exists()
    finally:
        again.kill()
    say(
        "kill -9: supervisor",
        "20 s",
        f"children gone in {seconds:.1f} s",
        "amplifier off by the loop; the next daemon starts into SAFE",
        "`estimates kept=True`",
    )


@pytest.mark.parametrize("left", [b"", b"x" * 8, b"\0" * 4096, b"\xff" * 20_000_000])
def test_leftovers_in_shared_memory(tmp_path, left):
    """Whatever stands under the segment's name is replaced, and told where it is attached to."""
    from thermoctl.daemon.tick.shared import Shared

    name = f"thermoctl-hazard-{os.getpid()}"
    Path("/dev/shm", name).write_bytes(left)
    with pytest.raises(InputError, match="not there|another version"):
        Shared.attach(name)
    shared = Shared.create(name)
    try:
        assert Shared.attach(name).ring.head == 0 and shared.mailbox.take() is None
    finally:
        shared.remove()
    say(
        f"shared memory left over: {len(left)} bytes",
        "replaced",
        "replaced",
        "starts",
        "`of another version; restart the daemon`",
    )


@pytest.fixture
def small_disk(tmp_path):
    place = tmp_path / "disk"
    place.mkdir()
    if (
        os.geteuid()
        or subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(place)], capture_output=True
        ).returncode
    ):
        pytest.skip("a small file system cannot be mounted here (root is needed)")
    yield place
    subprocess.run(["mount", "-o", "remount,rw", str(place)], capture_output=True)
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_disk_full_and_read_only(tmp_path, small_disk):
    """The disk fills up, then becomes read-only, then is well again: told once each, ticks counted as lost, the loop never waits."""
    daemon = start(tmp_path, small_disk / "recordings")
    try:
        daemon.armed()
        filler = small_disk / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as f:
            while f.write(b"x" * 4096):
                pass
        _, seconds = wait(
            lambda: re.search("nothing is recorded.*[Nn]o space", daemon.log), "told that the disk is full"
        )
        lost, _ = wait(lambda: daemon.ask("status")["recorder"]["lost"], "counted as lost")
        slips = daemon.ask("status")["slips"]
        assert daemon.ask("status")["state"] == "ARMED"
        filler.unlink()
        rows = daemon.ask("status")["recorder"]["rows"]
        wait(lambda: daemon.ask("status")["recorder"]["rows"] > rows + 3000, "records again")
        say(
            "disk full",
            "told; the loop never waits",
            f"told in {seconds:.1f} s, {lost} ticks lost at first, {slips} slips",
            "drives on",
            "`nothing is recorded: No space left on device`",
        )
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=False)
        if (
            "read-only" in daemon.log.lower()
            or subprocess.run(["touch", str(small_disk / "x")], capture_output=True).returncode
        ):
            _, seconds = wait(lambda: "ead-only" in daemon.log, "told that the disk is read-only")
            assert daemon.ask("status")["state"] == "ARMED"
            say(
                "disk becomes read-only",
                "told; the loop never waits",
                f"told in {seconds:.1f} s",
                "drives on",
                "`Read-only file system`",
            )
    finally:
        daemon.kill()


def test_setpoint_flood_by_the_socket(daemon):
    """Four clients ask for setpoints as fast as they can; another one's disarm is obeyed at once."""
    import threading

    daemon.armed()
    done, count = threading.Event(), [0]

    def flood(sign):
        while not done.is_set():
            with contextlib.suppress(InputError):
                daemon.ask("setpoint", value=sign * 200.0)
                count[0] += 1

    clients = [threading.Thread(target=flood, args=((-1) ** k,)) for k in range(4)]
    for c in clients:
        c.start()
    try:
        wait(lambda: count[0] > 200, "the flood")
        begin = time.monotonic()
        assert daemon.ask("disarm")["ok"]
        seconds = time.monotonic() - begin
        assert daemon.ask("status")["state"] in ("SAFE", "READY") and seconds < 2.0
    finally:
        done.set()
        for c in clients:
            c.join()
    say("setpoint flood: four clients", "2 s", f"disarmed in {seconds * 1e3:.0f} ms", "disarmed", "")


def test_a_log_that_nobody_reads(tmp_path):
    """`thermoctl run` into a pipe, or in a terminal that Ctrl-S stopped: a disarm was never answered."""
    os.mkfifo(tmp_path / "rig.log")
    unread = os.open(tmp_path / "rig.log", os.O_RDWR)
    daemon = start(tmp_path, tmp_path / "recordings")
    try:
        for _ in range(200):
            daemon.ask("arm")
            daemon.ask("disarm")
        daemon.armed()
        begin = time.monotonic()
        assert daemon.ask("disarm")["ok"]
        seconds = time.monotonic() - begin
        assert daemon.ask("status")["state"] == "READY" and seconds < 2.0
        assert daemon.stop() == 0
    finally:
        daemon.kill()
        os.close(unread)
    say(
        "log: a pipe that nobody reads, or a stopped terminal",
        "2 s",
        f"disarmed in {seconds * 1e3:.0f} ms",
        "drives on",
        "`the log could not be written, N lines are lost` when it can be again",
    )


def test_two_daemons(daemon, tmp_path):
    second = subprocess.run(
        [sys.executable, "-m", "thermoctl.cli", "run", "--config", str(daemon.config)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=LIMIT_S,
    )
    assert second.returncode == 2 and "another daemon runs" in second.stderr and daemon.ask("status")["ok"]
    say(
        "two daemons on one rig",
        "refused",
        "refused, exit 2",
        "the first runs on",
        "`another daemon runs on this socket`",
    )
