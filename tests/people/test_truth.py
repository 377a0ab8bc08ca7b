"""What is shown is true: a sensor that dies is shown as dead within its stale time, in every view; causes stand first."""

import dataclasses
import json
import math
import os
import re
from collections import deque
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console
from running import Running
from test_dashboard import served

from thermoctl.control import causes, faults
from thermoctl.control.causes import Standing, in_order
from thermoctl.daemon import commands
from thermoctl.daemon.answers.display import fault_lines
from thermoctl.daemon.answers.snapshot import status
from thermoctl.daemon.command_server import Commands
from thermoctl.daemon.journal import Watcher
from thermoctl.daemon.tick.shared import NO_MODEL
from thermoctl.daemon.views import dashboard, monitor
from thermoctl.daemon.views.metrics import metrics
from thermoctl.recording.commands import list_recordings
from thermoctl.recording.history import history
from thermoctl.recording.writer import RecordingWriter
from thermoctl.rig.channels import CHANNELS
from thermoctl.rig.signals import INDEX, POINTS, SIGNALS
from thermoctl_hal.base.backend import ABSENT, ERROR, OK, ROLE, STALE
from thermoctl_hal.can.drive_errors import describe

SENSORS = (
    "position_um",
    "output_reference_um",
    "voltage_v",
    "current_a",
    "air_c",
    *(f"{p}_c" for p in POINTS),
)


def stale_ticks(settings, role):
    """So many ticks after its last reading a silent sensor has to be shown as dead, and one for the round of the texts."""
    protection = settings.protection.stale_s
    limit_s = protection.get(role, protection.get("temperatures_c"))
    return (
        round(limit_s / settings.loop.period_s)
        + round(settings.hal.sensor_period_s / settings.loop.period_s)
        + 2
    )


class Silent:
    """A back end whose sensors can fall silent: OK and old, as a pulled plug that no driver notices."""

    def __init__(self, inner):
        self.inner, self.silent = inner, set()

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def read(self, now_s):
        sample = self.inner.read(now_s)
        for role in self.silent:
            sample.fresh[ROLE[role]] = False
        return sample


def in_the_terminal(running, capsys, monkeypatch):
    """(status as printed, its JSON, the monitor's screen, Prometheus' page) of this moment."""
    answer = {"ok": True, **status(running.shared)}
    monkeypatch.setattr(commands, "ask", lambda *a: answer)
    capsys.readouterr()
    commands.status(running.settings)
    printed = capsys.readouterr().out
    commands.status(running.settings, as_json=True)
    trails: dict[str, deque[float]] = {}
    monitor.remember(trails, answer)
    console = Console(file=StringIO(), width=80, record=True)
    console.print(monitor.screen(answer, None, trails, 80))
    return printed, json.loads(capsys.readouterr().out), console.export_text(), metrics(running.shared)


@pytest.mark.parametrize("how", ["error", "silence"])
def test_each_sensor_that_dies_is_dead_in_every_view_of_the_terminal(
    settings, running, capsys, monkeypatch, how
):
    silent = running.rig.backend = Silent(running.backend)
    running.arm()
    for role in SENSORS:
        (running.backend.broken if how == "error" else silent.silent).add(role)
        running.tick(25 if how == "error" else stale_ticks(settings, role))
        printed, plain, screen, page = in_the_terminal(running, capsys, monkeypatch)
        kind = "ERROR" if how == "error" else "STALE"
        reading = plain["readings"][role]
        assert reading["state"] == plain["channels"][role] == kind and reading["value"] is None, role
        assert reading["last"] is not None and reading["age_s"] > 0.0 and reading["message"], role
        assert f"{role} {kind.lower()}" in printed and reading["message"] in printed, role
        assert f"{role} {kind.lower()}" in screen, role
        name = "position_raw_um" if role == "position_um" else role
        point = role.removesuffix("_c")
        samples = {
            (s.name, tuple(sorted(s.labels.items()))): s.value
            for family in text_string_to_metric_families(page)
            for s in family.samples
        }
        assert samples["thermoctl_reading_ok", (("role", role),)] == 0.0
        if point in POINTS:
            assert plain["temperatures_c"][point] is None
            row = next(
                line for line in printed.splitlines() if line.startswith(point.replace("_", " ") + " ")
            )
            assert row.split()[len(point.split("_"))] == "-" and row.endswith(kind.lower()), row
            labels = (("kind", "measured"), ("point", point))
            assert math.isnan(samples["thermoctl_temperature_celsius", labels])
            if point == "coil":  # the compensation rests on the model alone
                assert (
                    "? um   output" in printed and "compensation (?)" in screen and "expansion (?)" in screen
                )
        else:
            assert plain.get(name) is None and math.isnan(samples[f"thermoctl_{name}", ()])
        running.backend.broken.clear()
        silent.silent.clear()
        running.backend.mend(role)
        running.tick(120)
    assert plain["power_w"] is not None and plain["position_um"] is not None, "well again: numbers again"


def test_each_sensor_that_dies_is_dead_on_the_page(settings, running, browser):
    """The rig stands still right after the stale time: what the page then shows is what it had to show by then."""
    silent = running.rig.backend = Silent(running.backend)
    running.arm()
    running.tick(500)
    for thread in running.threads:
        thread.start()
    with served(settings) as (server, _):
        browser.open(dashboard.url(server))
        browser.until("document.getElementById('state').textContent === 'ARMED'")
        for role in SENSORS:
            silent.silent.add(role)
            running.tick(stale_ticks(settings, role))
            point = role.removesuffix("_c")
            if point in POINTS or role == "air_c":
                cell = f"document.getElementById('m-{point}')"
                browser.until(
                    f"{cell}.textContent.startsWith('– (stale') && {cell}.parentNode.className === 'dead'"
                )
            if point in POINTS:
                browser.until(f"document.querySelector('[data-p={point}]').style.fill.includes('hatch')")
                browser.until(f"/^stale/.test(document.getElementById('t-{point}').textContent)")
            signal = {"position_um": "position_raw_um", "output_reference_um": role}.get(role)
            if signal:
                browser.until(f"/^– .stale/.test(document.querySelector('[data-v={signal}]').textContent)")
            if role in ("voltage_v", "current_a"):
                browser.until("/– .stale/.test(document.getElementById('n-power').textContent)")
            browser.until(
                f"document.getElementById('fault-list').textContent.includes('{role}: no new reading within')"
            )
            silent.silent.clear()
            running.tick(200)
        running.remove()
        browser.until("document.body.classList.contains('old')")
        assert "line-through" in browser.js(
            "getComputedStyle(document.getElementById('m-coil')).textDecoration"
        )
        assert browser.messages == []


def test_the_page_fits_a_phone(settings, running, browser):
    """At 360 px nothing is wider than its card, with a dead sensor and in FAULT."""
    running.arm()
    running.backend.broken |= {"coil_c", "stator_connector_c"}
    running.tick(1000)
    with served(settings) as (server, _):
        browser.size(360, 800)
        browser.open(dashboard.url(server))
        browser.until("document.getElementById('m-coil').textContent.startsWith('– (error')")
        assert browser.js("document.documentElement.scrollWidth") <= 360
        wide = """[...document.querySelectorAll('section')].filter(s => [...s.querySelectorAll('table, svg, canvas, p, dl, div')]
            .some(n => n.getBoundingClientRect().right > s.getBoundingClientRect().right + 1)).map(s => s.getAttribute('aria-labelledby'))"""
        assert browser.js(wide) == []


# ------------------------------------------------------------------------------------------------- causes
def test_the_first_in_time_is_the_cause_and_the_rest_stands_behind_it():
    """A9: a pulled module as the review saw it, in order of bits: position_stale, monitored_error, air_error, ..."""
    found = in_order(
        [
            Standing("monitored_error", 3.001, 3001),
            Standing("air_error", 3.0, 3000),
            Standing("air_rate", 3.02, 3020),
            Standing("coil_error", 3.0, 3000),
            Standing("coil_disagrees", 5.0, 5000),
        ],
        1 << faults.BIT["coil_error"],
    )
    assert [f.name for f, _ in found][0] == "coil_error"
    assert {cause for _, cause in found} == {"", found[0][0].name}


def test_a_cause_that_shows_later_still_stands_first_and_an_old_warning_last():
    """A frozen encoder is noticed after the following error; a broken sensor of an hour ago is another case."""
    trips = 1 << faults.BIT["following_error"] | 1 << faults.BIT["position_frozen"]
    found = in_order(
        [
            Standing("monitored_error", 10.0, 10000),
            Standing("following_error", 3600.0, 3600000),
            Standing("position_frozen", 3600.3, 3600300),
        ],
        trips,
    )
    assert [(f.name, c) for f, c in found] == [
        ("position_frozen", ""),
        ("following_error", "position_frozen"),
        ("monitored_error", ""),
    ]
    assert causes.severity_of("monitored_error", trips) == "warning"


def test_every_name_of_the_relation_is_a_fault_and_every_fault_is_shown_once():
    names = set(faults.BIT)
    assert set(causes.FOLLOWS) <= names and set().union(*causes.FOLLOWS.values()) <= names
    everything = [Standing(n, 1.0, 1000) for n in faults.BIT]
    shown = [f.name for f, _ in in_order(everything, (1 << 53) - 1)]
    assert sorted(shown) == sorted(names) and shown[0] == "loop_late"


def test_late_ticks_are_named_before_the_fault_they_may_have_caused(settings, running):
    """A2: the machine stalls for 27 ms, the stage is off its reference: the first line says so, with the page to read."""
    running.arm()
    running.tick(2000)
    running.now_s += 0.027
    running.rig.tick(running.now_s, 0.027, 26000.0)
    running.rig.backend = Silent(running.backend)
    running.rig.backend.silent = {"position_um"}
    running.tick(30)
    now = status(running.shared)
    lines = fault_lines(now["faults"])
    assert now["state"] == "FAULT" and "late by 27 ms" in lines[0] and "position_stale" in lines[0]
    assert "docs/how-to/real-time.md" in lines[1]
    running.rig.backend = running.backend
    running.tick(3000)
    running.send(2)
    running.tick(5)
    running.rig.backend = Silent(running.backend)
    running.rig.backend.silent = {"position_um"}
    running.tick(30)
    assert "late" not in fault_lines(status(running.shared)["faults"])[0], (
        "three seconds later it is no longer said"
    )


def test_the_drives_code_stays_after_its_reset(settings, running):
    """B5: 0x3220 for one tick, then 0: code, text and time are in the status, the log has the line."""
    running.arm()
    inner, code = running.backend.inner, [0x3220]
    read = inner.read

    def with_code(now_s):
        sample = read(now_s)
        sample.value[ROLE["amplifier_fault"]] = code[0]
        sample.value[ROLE["amplifier_state"]] = 3.0 if code[0] else 1.0
        return sample

    inner.read = with_code
    log = []
    watcher = Watcher(running.shared, lambda event, **v: log.append((event, v)))
    running.tick(5)
    watcher.look()
    code[0] = 0
    running.tick(500)
    watcher.look()
    now = status(running.shared)
    assert now["drive_code"]["code"] == 0x3220 and not now["drive_code"]["stands"]
    lines = fault_lines(now["faults"])
    assert "amplifier_fault" in lines[0] and "0x3220 (DC link under-voltage" in lines[0]
    assert any(e == "device" and "0x3220" in v["message"] for e, v in log)
    assert [v["name"] for e, v in log if e == "critical"][0] == "amplifier_fault"


def test_codes_of_drives_have_words():
    assert describe(0x8130).startswith("0x8130 (our heartbeat")
    assert describe(0x3299) == "0x3299 (voltage inside the device)"
    assert describe(0xFF07) == "0xFF07 (specific to the maker)" and "manual" in describe(0xE001)


def test_starting_is_no_fault(settings, running):
    """A9: readings that have not come yet are no `amplifier_stale at tick 1`, neither in the log nor in the status."""
    inner = running.backend.inner
    read = inner.read

    def later(now_s):
        sample = read(now_s)
        if now_s < 0.05:
            sample.fresh[:] = False
            sample.status[sample.status == OK] = STALE
        return sample

    inner.read = later
    log = []
    watcher = Watcher(running.shared, lambda event, **v: log.append((event, v)))
    for _ in range(30):
        running.tick(10)
        watcher.look()
        assert status(running.shared)["faults"] == []
    assert {e for e, _ in log} == {"state"}, log


def test_arm_in_fault_answers_in_readable_lines(settings, running):
    running.arm()
    running.backend.broken |= {"coil_c", "air_c", "bobbin_c"}
    running.tick(200)
    answer = Commands(running.shared, settings, None, lambda *a, **k: None).answer(b'{"command": "arm"}', "")
    lines = answer["error"].splitlines()
    assert not answer["ok"] and 3 <= len(lines) <= 8 and max(map(len, lines)) < 300
    assert "open wire" in answer["error"] and "followed by" in answer["error"]


def test_the_devices_words_are_logged_once_with_their_time(settings, running):
    running.arm()
    log = []
    watcher = Watcher(running.shared, lambda event, **v: log.append((event, v)))
    watcher.look()
    running.backend.broken.add("coil_c")
    for _ in range(20):
        running.tick(100)
        watcher.look()
    words = [v for e, v in log if e == "device"]
    assert [w["role"] for w in words] == ["coil_c"] and "open wire" in words[0]["message"]
    assert [v["name"] for e, v in log if e == "fault"] == ["coil_error"]
    assert running.rig.reading.status[ROLE["coil_c"]] == ERROR


# ------------------------------------------------------------------------------------------------- recordings
def written(settings, rig, metadata, wall_s, value):
    rows = np.zeros((3000, len(SIGNALS)))
    rows[:, INDEX["t_s"]] = np.arange(3000) * 0.1
    rows[:, INDEX["wall_s"]] = wall_s + rows[:, INDEX["t_s"]]
    rows[:, INDEX["compensation_um"]] = value
    rows[:, INDEX["coil_c"]] = 25.0
    rows[1000:2000, INDEX["status_bits"]] = 2 << 2 * CHANNELS.index("coil_c")
    metadata = metadata and {"points": settings.channels.text(), **metadata}
    writer = RecordingWriter(settings.recording, metadata, rig, clock=lambda: 0.0, wall=lambda: wall_s)
    writer.write(rows)
    writer.close()
    for path in Path(settings.recording.directory).iterdir():
        os.utime(path, (wall_s + 300.0, wall_s + 300.0))


def test_two_rigs_in_one_folder_are_never_mixed(settings, capsys):
    """S4: history of one rig has nothing of the other's nor of a recording that names no rig; the list says whose each is."""
    from argparse import Namespace

    Path(settings.recording.directory).mkdir(exist_ok=True)
    begin = 1.8e9
    written(settings, "simulated", {"rig": "simulated", "run": "20270115T080000Z"}, begin, 1.0)
    written(settings, "wire", {"rig": "wire", "run": "20270115T080001Z"}, begin + 1.0, 50.0)
    written(settings, "old", {}, begin + 2.0, 99.0)
    for rig, value in (("simulated", 1.0), ("wire", 50.0)):
        found = history(settings.recording.directory, rig, "compensation_um", begin - 10.0, begin + 400.0)
        assert found.files == 1 and found.low.min() == found.high.max() == value
    assert (
        history(settings.recording.directory, "", "compensation_um", begin - 10.0, begin + 400.0).files == 1
    )
    with served(settings, follow=False) as (server, _):
        from test_dashboard import fetch

        _, _, body = fetch(server, f"/api/history?signal=coil_c&begin={begin}&end={begin + 300}&points=300")
        answer = json.loads(body)
    gap = [t for t in answer["t"] if begin + 102 < t < begin + 198]
    assert answer["files"] == 1 and gap == [], "a dead sensor has no history"
    assert list_recordings(Namespace(directory=settings.recording.directory, json=False)) == 0
    out = capsys.readouterr().out
    assert "simulated, run 20270115T080000Z:" in out and "wire, run" in out and "unknown rig:" in out


def test_a_rig_without_a_name_is_known_by_its_configuration(settings):
    import dataclasses

    from thermoctl.daemon.tick.assemble import rig_identity

    unnamed = dataclasses.replace(settings, rig=dataclasses.replace(settings.rig, name="rig"))
    other = dataclasses.replace(unnamed, path="/elsewhere/rig.yaml")
    assert rig_identity(settings) == "simulated"
    assert rig_identity(unnamed).startswith("rig-") and rig_identity(unnamed) != rig_identity(other)


def test_the_rigs_own_daemon_says_so_in_its_recording(settings):
    from thermoctl.daemon.recorder import make_recorder
    from thermoctl.recording.history import rig_of

    running = Running(settings)
    try:
        recorder = make_recorder(settings, running.shared, lambda *a, **k: None)
        running.tick(300)
        recorder.move()
        recorder.close()
        paths = list(Path(settings.recording.directory).glob("*.arrows"))
        assert paths and {rig_of(p) for p in paths} == {"simulated"}
    finally:
        running.remove()


def test_the_monitor_at_80x24_shows_values_beside_three_faults(running):
    """Before, the faults' text filled the screen (review_user_3 C6)."""
    running.arm()
    running.backend.broken.update(("coil_c", "voltage_v", "position_um"))
    running.tick(60)
    now = {"ok": True, **status(running.shared)}
    assert len(now["faults"]) >= 3
    console = Console(file=StringIO(), width=80, height=24, record=True)
    trails: dict[str, deque[float]] = {}
    monitor.remember(trails, now)
    latency = Commands(running.shared, running.settings, None, lambda *a, **k: None).answer(
        b'{"command": "latency"}', ""
    )
    console.print(monitor.screen(now, latency, trails, 80, monitor.BLOCKS, 24))
    lines = console.export_text().splitlines()
    assert len(lines) <= 24, len(lines)
    assert any(line.startswith("fault ") for line in lines) and any("->" in line for line in lines)
    for label in ("setpoint", "compensation", "drive", "air", "shaft 1"):
        assert any(label in line for line in lines), (label, lines)


class WithoutReference(Silent):
    """A rig to which no second encoder is bound."""

    def read(self, now_s):
        sample = self.inner.read(now_s)
        k = ROLE["output_reference_um"]
        sample.status[k], sample.fresh[k], sample.value[k] = ABSENT, False, math.nan
        return sample


@pytest.mark.parametrize("model", [True, False])
def test_nothing_measured_is_called_so_in_every_view_of_the_terminal(settings, capsys, monkeypatch, model):
    compensation = settings.compensation if model else dataclasses.replace(settings.compensation, model="")
    running = Running(dataclasses.replace(settings, compensation=compensation))
    try:
        running.shared.counters[NO_MODEL] = float(not model)
        running.rig.backend = WithoutReference(running.backend)
        running.arm()
        running.tick(50)
        printed, plain, screen, _ = in_the_terminal(running, capsys, monkeypatch)
        if model:
            assert plain["output_is"] == "expected, not measured"
            assert "um (expected, not measured)" in printed and "expected, not measured" in screen
        else:
            assert plain["output_is"].startswith("unknown") and set(plain["estimates_c"].values()) == {None}
            assert plain["estimates_state"] == "NONE" and plain["expansion_um"] is None
            assert re.search(r"^coil +[\d.]+ +- ", printed, re.MULTILINE), printed
            assert re.search(r"error with it +- +um", screen), screen
    finally:
        running.close()
