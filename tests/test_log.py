"""The log's lines: time and rig in each, JSON for journald, and no error where nothing can be written."""

import json
import os
import re
import subprocess
import sys

import pytest

CODE = """
import os
{before}
from thermoctl.log import bind, console_log
bind(rig="bench 3", axis="", run="20261126T043000Z")
console_log("state", tick=7, now="ARMED", why=None, message="it's open")
console_log("fault", axis="x", name="sensor")
{after}
"""
JOURNAL = "s = os.fstat(2); os.environ['JOURNAL_STREAM'] = f'{s.st_dev}:{s.st_ino}'"


def lines(before="", after="", **more):
    code = CODE.format(before=before, after=after)
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, check=True, **more)
    return done.stderr.splitlines()


def test_a_line_has_time_with_zone_event_fields_rig_and_run():
    first, second = lines()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d+Z", first.split()[0])
    rest = """thermoctl: state tick=7 now=ARMED message="it's open" rig='bench 3' run=20261126T043000Z"""
    assert first.split(" ", 1)[1] == rest
    assert second.endswith("fault name=sensor rig='bench 3' axis=x run=20261126T043000Z")


def test_the_journal_gets_json():
    first, second = map(json.loads, lines(JOURNAL))
    assert list(first)[:2] == ["time", "event"] and first.pop("time").endswith("Z")
    assert first == {
        "event": "state",
        "tick": 7,
        "now": "ARMED",
        "message": "it's open",
        "rig": "bench 3",
        "run": "20261126T043000Z",
    }
    assert second["axis"] == "x"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_ends_nothing_and_is_reported_afterwards():
    full = "keep = os.dup(2); os.dup2(os.open('/dev/full', os.O_WRONLY), 2)"
    (lost, line) = lines(full, "os.dup2(keep, 2); console_log('state', tick=9)")
    assert "2 lines are lost" in lost and "tick=9" in line


def test_a_pipe_that_nobody_reads_holds_nobody_up():
    """The process that answers commands waited in its log: an armed rig could not be disarmed."""
    code = """
import os, time
from thermoctl.log import console_log
keep, (end, begin) = os.dup(2), os.pipe()
os.dup2(begin, 2)
start_s = time.monotonic()
for k in range(2000):
    console_log("state", tick=k, text=5000 * "x" if k % 9 == 0 else None)
assert time.monotonic() - start_s < 5.0
os.set_blocking(end, False)
first = os.read(end, 1 << 20)
console_log("state", tick=2000)
said = os.read(end, 1 << 20).decode().splitlines()
os.dup2(keep, 2)
assert first.startswith(b"20") and b"tick=1 " not in first[:100], first[:100]
assert "lines are lost" in said[-2] and said[-1].endswith("state tick=2000"), said
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_disk_that_hangs_holds_up_one_line_and_not_each():
    """Each command waited 2 s for its line in a file on such a disk, and `stop` 13 s."""
    code = """
import os, sys, time
from thermoctl import log
write = os.write
os.write = lambda fd, data: (time.sleep(0.6), write(fd, data))[1]
start_s = time.monotonic()
for k in range(50):
    log.console_log("state", tick=k)
assert time.monotonic() - start_s < 3.0
log.time.monotonic = lambda: start_s + 60.0
log.console_log("state", tick=50)
"""
    said = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, check=True).stderr
    first, lost, last = said.splitlines()
    assert first.endswith("tick=0") and "49 lines are lost" in lost and last.endswith("tick=50")


def test_what_libraries_and_threads_say_are_events_too():
    code = """
import logging, threading, warnings
from thermoctl.log import take_over
take_over()
take_over()
logging.getLogger("can.pcan").warning("the %s is late", "bus")
logging.getLogger("can.pcan").info("opened")
warnings.warn("old argument")
thread = threading.Thread(target=lambda: 1 // 0, name="reconnect meter")
thread.start()
thread.join()
"""
    found = [json.loads(line) for line in lines(JOURNAL, code)[2:]]
    assert [f["event"] for f in found] == ["library", "library", "reconnect meter failed"]
    assert (found[0]["name"], found[0]["level"], found[0]["message"]) == (
        "can.pcan",
        "warning",
        "the bus is late",
    )
    assert "old argument" in found[1]["message"] and all(f["rig"] == "bench 3" for f in found)
    assert "ZeroDivisionError" in found[2]["error"] and "Traceback" in found[2]["traceback"]
