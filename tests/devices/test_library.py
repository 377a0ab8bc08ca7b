"""Every profile of the library against its device's emulator: values, a fault, the cable pulled and plugged.

`make devices` runs this and prints the table.
"""

import math
import os
import time
from dataclasses import replace

import pytest

from tests.devices.library import CASES, UNTRIED
from thermoctl import cli
from thermoctl.devices.library import cited, find
from thermoctl.devices.new import new
from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.rig.probe import Probe, read_for

NOT_CITED = ("; written from memory, the manual was not at hand", "; its edition is not known")
NAMES = sorted(p.stem for p in shipped("config/devices/library").glob("*.yaml"))


def test_every_profile_has_an_emulator_and_a_source():
    assert len(NAMES) >= 25 and set(NAMES) == set(CASES) | set(UNTRIED)
    for name in NAMES:
        assert load_profile(find(name)).manual, name


def test_a_profile_states_edition_and_place_of_its_manual_or_that_it_has_none():
    for name in NAMES:
        profile = load_profile(find(name))
        assert profile.is_cited != profile.manual.endswith(NOT_CITED), name
        assert bool(profile.edition) == bool(profile.place), name
    assert len(cited()) >= 25 and set(cited()) <= set(NAMES)


def test_an_edition_without_a_manual_is_refused(tmp_path):
    path = tmp_path / "profile.yaml"
    text = find("icpdas-m-7015").read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in text if not line.startswith("manual:")) + "edition: B2.8\n")
    with pytest.raises(InputError, match="the document of 'edition' and 'place' was expected"):
        load_profile(path)


@pytest.mark.skipif(not os.environ.get("THERMOCTL_TABLE"), reason="prints rows of the table")
def test_the_table_has_the_profiles_that_are_tried_elsewhere(capsys):
    for name, where in UNTRIED.items():
        with capsys.disabled():
            print(_table_row(name, load_profile(find(name)), where, "", "", ""))


def _table_row(name, profile, *rest):
    source = (profile.manual, profile.edition or "none", profile.place or "none")
    return "\n| " + " | ".join((name, profile.bus, *source, *rest)) + " |"


def read(device, profile, wanted, limit_s=20.0):
    """Read until `wanted(readings)`; returns them. Reopens the port as the daemon does."""
    end = time.monotonic() + limit_s
    readings, probe = [], None
    while time.monotonic() < end:
        try:
            if probe is None:
                probe = Probe(profile, device.port, device.address)
                probe.open()
            device.send()
            probe.step()
            readings = probe.readings()
            if wanted({r.channel: r for r in readings}):
                probe.close()
                return readings
        except (HardwareError, OSError):
            if probe is not None:
                probe.close()
            probe = None
        time.sleep(0.002)
    if probe is not None:
        probe.close()
    raise AssertionError(f"not within {limit_s} s: {readings}")


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_device_is_read_as_its_manual_says(tmp_path, name, capsys):
    device, profile = CASES[name](tmp_path), load_profile(find(name))
    profile = replace(profile, line=replace(profile.line, parity="N", data_bits=8))  # a pty has no other
    started = time.monotonic()

    def good(found):
        return all(
            not found[c].problem and math.isclose(found[c].value, v, rel_tol=2e-3, abs_tol=2e-3)
            for c, v in device.expected.items()
        )

    try:
        read(device, profile, good)
        first_s = time.monotonic() - started
        device.wire.unplug()
        with pytest.raises((HardwareError, OSError)):
            read_for(Probe(profile, device.port, device.address), 1.0)
        device.wire.plug()
        if device.port.startswith("tcp:"):
            device.port = f"tcp:127.0.0.1:{device.wire.number}"
        plugged = time.monotonic()
        read(device, profile, good)
        again_s = time.monotonic() - plugged
        device.fault()
        faulted = time.monotonic()

        def shown(found):  # a channel also has a problem until its first answer: wait for another channel
            answered = any(not r.problem for c, r in found.items() if c != device.bad)
            return bool(found[device.bad].problem) and (answered or time.monotonic() > faulted + 0.5)

        found = {r.channel: r for r in read(device, profile, shown)}
        assert "\n" not in found[device.bad].problem
        if os.environ.get("THERMOCTL_TABLE"):
            with capsys.disabled():
                value = ", ".join(f"{c} {v:g}" for c, v in list(device.expected.items())[:2])
                more = f" and {len(device.expected) - 2} more" if len(device.expected) > 2 else ""
                times = f"{first_s:.2f}", f"{again_s:.2f}"
                problem = f"`{found[device.bad].problem.replace('|', '/')}`"
                print(_table_row(name, profile, value + more, *times, problem))
    finally:
        device.wire.close()


def test_the_commands_show_search_and_probe(tmp_path, capsys):
    assert cli.main(["devices", "list"]) == 0 and len(capsys.readouterr().out.splitlines()) > 30
    assert cli.main(["devices", "search", "rtd", "modbus"]) == 0
    assert "ADAM-6015" in capsys.readouterr().out
    assert cli.main(["devices", "search", "nonsense"]) == 1
    assert "devices new" in capsys.readouterr().out
    assert cli.main(["devices", "show", "odrive-cansimple"]) == 0
    assert "stops by itself after 0.1 s" in capsys.readouterr().out
    assert cli.main(["devices", "show", "odrive"]) == 2
    device = CASES["icpdas-m-7015"](tmp_path)
    try:
        assert cli.main(["devices", "probe", device.port, "--profile", "icpdas-m-7015"]) == 0
        out = capsys.readouterr().out.splitlines()
        assert len(out) == 6 and all("2150" in x and "21.5 degC" in x and x.endswith("OK") for x in out)
        assert cli.main(["devices", "probe", device.port, "--address", "1"]) == 0
        out = capsys.readouterr().out
        assert "holding 0..9: exception 1" in out and "input 0..9: exception 2" in out
    finally:
        device.wire.close()
    assert cli.main(["devices", "probe", "/dev/none", "--profile", "icpdas-m-7015"]) == 3
    assert "rtu:/dev/... " in capsys.readouterr().err


ANSWERS = {
    "vendor": "ours", "model": "oven: left", "manual": "oven manual", "edition": "1.2", "place": "page 7", "bus": "modbus", "unit": "degC",
    "register": "12", "scale": "0.1", "rate_hz": "5", "stale_after_s": "1", "range": "[-20, 300]", "kind": "holding",
}  # fmt: skip


def test_new_asks_and_writes_a_profile(tmp_path):
    names = iter(["t1", ""])

    def ask(question):
        word = question.split()[0]
        return next(names) if question.startswith("name of a channel") else ANSWERS.get(word, "")

    target = tmp_path / "oven.yaml"
    assert new(str(target), ask) == 0
    profile = load_profile(target)
    channel = profile.channels["t1"]
    assert profile.model == "oven: left" and channel.scale == 0.1 and channel.source.address == 12
    assert channel.source.kind == "holding" and channel.range == (-20, 300)
    with pytest.raises(InputError, match="exists"):
        new(str(target), ask)
    names = iter(["t1", ""])
    with pytest.raises(InputError, match="every reading would be stale; nothing was written"):
        new(str(tmp_path / "bad.yaml"), lambda q: "0.01" if q.startswith("stale_after_s") else ask(q))
    assert not (tmp_path / "bad.yaml").exists()
