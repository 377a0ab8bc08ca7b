"""A lost reading's remedy fits the device's own message, and a cause that a device states comes before late ticks."""

import dataclasses
import re

import pytest
from running import Running, Spoilt

from thermoctl.control import losses
from thermoctl.control.arming import DISARM
from thermoctl.control.causes import Standing
from thermoctl.control.faults import FAULTS
from thermoctl.daemon.answers.display import fault_lines
from thermoctl.daemon.answers.snapshot import status
from thermoctl_hal.base.backend import ROLE, STALE

BESIDE = {"status", "monitor", "latency", "arm", "disarm", "reload", "replay", "tune", "check"}
"""Commands that do their work while a daemon holds the rig."""
MESSAGES = [
    # as the drivers write them: message, kind of loss, what the remedy says
    ("meter voltage: lost on /dev/meter (Input/output error); reconnecting: check cable and power", "gone", "plug the device in"),
    ("meter voltage: rtu:/dev/meter: no such device: is it plugged in? prefer a name of /dev/serial/by-id", "gone", "or power it"),
    ("meter voltage: tcp:10.0.0.9:502: nobody answers: check power, network and address", "gone", "nothing was received since"),
    ("meter voltage: input registers 0..3: no answer within 0.3 s: check power, wiring, address 1", "silent", "baud rate and address"),
    ("meter: no new reading on /dev/meter: nothing arrives: check its power and cable", "silent", "power the device"),
    ("meter voltage: no valid answer: 5 bytes came (01 04) with a wrong CRC, or cut short", "garbled", "parity and frame"),
    ("meter: no new reading on /dev/m: 120 bytes came, 10 frames with a wrong CRC: check 'crc'", "garbled", "parity and frame"),
    ("meter voltage: /dev/m: permission denied: add the user to the group of the device (dialout)", "refused", "what the message says"),
    ("meter voltage: lost on socketcan:can0 (CAN bus-off: check wiring, termination and bitrate)", "bus-off", "terminator at both ends"),
    ("meter voltage: input register 0: exception 2 (illegal address): correct 'register'", None, "an exception names the register"),
    ("meter voltage: register 0 reads 32767: open or missing sensor", None, "read the meter's own message"),
]  # fmt: skip


class Lost(Spoilt):
    """A back end whose channel `role` is in error with a message of a driver, or old and then renewed."""

    role, message, held = "voltage_v", "", False

    def read(self, now_s):
        sample = super().read(now_s)
        if self.held:
            sample.fresh[ROLE[self.role]], sample.status[ROLE[self.role]] = False, STALE
        return sample

    def problem(self, role):
        return self.message if role == self.role and self.message else super().problem(role)


@pytest.fixture
def lost(running):
    running.rig.backend = running.backend = Lost(running.backend.inner)
    return running


def voltage_fault(running):
    return next(f for f in status(running.shared)["faults"] if f["name"].startswith("voltage"))


def test_the_remedy_is_that_of_the_devices_message(lost):
    lost.arm()
    for message, loss, remedy in MESSAGES:
        lost.backend.message = message
        lost.backend.broken.add("voltage_v")
        lost.tick(30)
        found = voltage_fault(lost)
        assert found["loss"] == loss and remedy in found["remedy"], (message, found)
        assert "raise" not in found["remedy"] or loss is None, (
            "a lost device is no reason to weaken the protection"
        )
        assert message.split(": ", 1)[1] in "\n".join(fault_lines([found]))
        lost.backend.mend("voltage_v")
        lost.backend.message = ""
        lost.tick(30)
        if loss is not None:
            assert voltage_fault(lost)["remedy"] == losses.BACK, message
        lost.send(DISARM)
        lost.arm()


def test_a_reading_that_comes_late_is_slow(lost):
    lost.arm()
    lost.backend.held, lost.backend.message = True, MESSAGES[4][0]
    lost.tick(1200)
    assert voltage_fault(lost)["loss"] == "silent"
    lost.backend.held = False
    lost.tick(150)
    found = voltage_fault(lost)
    assert found["loss"] == "slow" and "raise protection.stale_s" in found["remedy"]


@pytest.mark.parametrize(("message", "age_ticks", "first"), [
    (MESSAGES[0][0], 30, False),   # gone: stated
    (MESSAGES[4][0], 1500, False), # silent for longer than late ticks explain
    (MESSAGES[4][0], 120, True),   # silent for a moment
])  # fmt: skip
def test_what_a_device_states_comes_before_late_ticks(lost, message, age_ticks, first):
    limits = lost.rig.law.parameters.stale_s.copy()
    limits[ROLE["voltage_v"]] = 0.1
    lost.rig.law.configure(dataclasses.replace(lost.rig.law.parameters, stale_s=limits))
    lost.arm()
    with lost.lock:
        lost.rig.tick(lost.now_s, 0.018, 18000.0)  # one tick 18 ms late
    lost.backend.held, lost.backend.message = True, message
    lost.tick(age_ticks)
    lines = fault_lines(status(lost.shared)["faults"])
    late = next(k for k, line in enumerate(lines) if "late" in line)
    named = next(k for k, line in enumerate(lines) if message.split(": ", 1)[1][:40] in line)
    assert (late < named) == first, "\n".join(lines)
    assert "18 ms" in lines[late]


def test_late_ticks_do_not_come_before_a_following_error():
    assert not Standing("following_error", 1.0, 1000, 0.018).is_timed
    assert Standing("following_error", 1.0, 1000, 0.018).may_be_late
    assert Standing("position_stale", 1.0, 1000, 0.018).is_timed


def test_a_required_channel_without_a_device_is_called_so(settings):
    running = Running(dataclasses.replace(
        settings, protection=dataclasses.replace(settings.protection, required=("position_um", "supply_v"))
    ))  # fmt: skip
    try:
        running.tick(200)
        found = next(f for f in status(running.shared)["faults"] if f["loss"] == "unbound")
        assert found["messages"] == ["supply_v: no device of hal.devices has this role"]
        assert "protection.required" in found["remedy"] and "lamps" not in found["remedy"]
    finally:
        running.close()


def test_a_remedy_names_only_commands_that_run_beside_the_daemon():
    for text in [f.remedy for f in FAULTS] + [
        loss.remedy for loss in (*losses.LOSSES, losses.SLOW, losses.UNBOUND)
    ]:
        for command in re.findall(r"(?<!after `thermoctl stop`, )`thermoctl (\w+)", text):
            assert command in BESIDE | {"stop"}, text
        assert not re.search(r"\.[;,]", text), text
