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
