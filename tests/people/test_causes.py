"""Cause -> first line -> remedy: one thing is broken on an armed rig, and the first line a person reads has to name it.

`make causes` writes docs/proof/causes.md. The devices of the wires are the real drivers; their other ends are played in
simulated time (tests/hazards), as are the spoiled readings of thermoctl_hal.simulated.faulty.
"""

import math
import os
import re
from pathlib import Path

import pytest

from tests.hazards.harness import HazardRig, quick_settings
from tests.hazards.test_wires import ERROR_FRAME, KernelBus, WiredRig
from thermoctl.daemon.answers.display import fault_lines, message_lines
from thermoctl.daemon.answers.snapshot import status
from thermoctl.daemon.tick.shared import Shared
from thermoctl_hal.base.backend import ROLE

ROWS: list[tuple[str, str, str, str]] = []
COUNT_UM = 0.005  # of config/devices/encoder-serial.yaml
TEMPERATURES = tuple(r for r in ROLE if r.endswith("_c") and r != "air_c")


def injected(kind, *roles, by=0.0):
    return lambda rig: rig.inject(kind, *roles, by=by)


def late(seconds):
    """The machine stands for so long, and the encoder with it."""

    def stall(rig):
        rig.ticks += round(seconds * 1e3)
        rig.rig.tick(rig.ticks * 1e-3, seconds)
        rig.inject("drop", "position_um")

    return stall


def code(number):
    """The drive's own fault: an emergency with this code, and the state `fault`."""
    return lambda rig: rig.wires.drive.fault(number)


def unplug(port):
    return lambda rig: getattr(rig.wires, port).unplug()


def encoder_counts(change):
    """The encoder's frames hold change(counts), with a right checksum: its head is wrong, not the line."""

    def breaks(rig):
        wires = rig.wires

        def spoiled(frame):
            sequence, counts = (
                int.from_bytes(frame[a:b], "little", signed=a == 5) for a, b in ((3, 5), (5, 9))
            )
            return wires.framer.encode(sequence, change(counts), frame[9])

        wires.spoil_frame = spoiled

    return breaks


def hangs(rig):
    held = round(rig["position_raw_um"] / COUNT_UM)
    encoder_counts(lambda counts: held)(rig)


def spoil(rig):
    rig.wires.spoil_frame = lambda frame: frame[:-1] + bytes([frame[-1] ^ 0xFF])


def silent(rig):
    rig.wires.spoil_frame = lambda frame: b""


def dead_drive(rig):
    rig.wires.drive.alive = False


def bus_off(rig):
    rig.wires.adapter_port.ours.send(ERROR_FRAME)
    rig.wires.adapter_port.off = True


def switched_off(rig):
    """The drive's stop input closes: quick stop, and it stays out of `operation enabled`."""
    rig.wires.drive.stop_until_s = math.inf


CAUSES = [
    # what is broken, which rig, how, what the first line has to say, and what the lines of the devices do
    ("coil thermocouple open", HazardRig, injected("error", "coil_c"), "coil_error", "coil_c"),
    ("thermocouple module unplugged", HazardRig, injected("error", *TEMPERATURES, "air_c"), "coil_error", "bracket_2_c"),
    ("coil thermocouple silent", HazardRig, injected("drop", "coil_c"), "coil_stale", "coil_c"),
    ("coil thermocouple jumps", HazardRig, injected("step", "coil_c", by=30.0), "coil_rate", "jumped"),
    ("coil reading not a number", HazardRig, injected("nan", "coil_c"), "coil_range", "coil_c"),
    ("air sensor open", HazardRig, injected("error", "air_c"), "air_error", "air_c"),
    ("air reading 90 degC", HazardRig, injected("set", "air_c", by=90.0), "air_range", "90"),
    ("voltage meter unplugged", HazardRig, injected("error", "voltage_v"), "voltage_error", "voltage_v"),
    ("voltage meter hangs", HazardRig, injected("freeze", "voltage_v"), "voltage_frozen", "without a change"),
    ("current sensor unplugged", HazardRig, injected("error", "current_a"), "current_error", "current_a"),
    ("current sensor hangs", HazardRig, injected("freeze", "current_a"), "current_frozen", "without a change"),
    ("voltage meter reads 2 V too much", HazardRig, injected("step", "voltage_v", by=2.0), "electrical_disagrees", ""),
    ("encoder hangs", WiredRig, hangs, "position_frozen", "without a change"),
    ("encoder jumps by 60 um", WiredRig, encoder_counts(lambda n: n + 12000), "position_rate", "jumped"),
    ("encoder reads 900 um", WiredRig, encoder_counts(lambda n: 180000), "position_range", "900"),
    ("machine late by 40 ms", HazardRig, late(0.040), "late by 40 ms", "position_um"),
    ("drive's stop input closed", WiredRig, switched_off, "amplifier_stopped", ""),
    ("amplifier drives 0.3 A, whatever it is told", HazardRig, injected("stuck", by=0.3), "following_error", ""),
    ("encoder's cable pulled", WiredRig, unplug("encoder"), "position_stale", "reconnecting"),
    ("encoder's checksums wrong", WiredRig, spoil, "position_", "position_um"),
    ("encoder mute", WiredRig, silent, "position_stale", "no new"),
    ("CAN adapter pulled", WiredRig, unplug("adapter_port"), "amplifier_error", "reconnecting"),
    ("drive without supply", WiredRig, dead_drive, "amplifier_", "amplifier_state"),
    ("drive: DC link under-voltage", WiredRig, code(0x3220), "0x3220 (DC link under-voltage", ""),
    ("drive: over-current", WiredRig, code(0x2310), "0x2310 (continuous over-current", ""),
    ("drive: own following error", WiredRig, code(0x8611), "0x8611 (following error in the drive", ""),
    ("CAN bus-off", "socketcan", bus_off, "amplifier_error", "bus-off"),
]  # fmt: skip


LOSSES = {
    "encoder's cable pulled": "gone",
    "encoder's checksums wrong": "garbled",
    "encoder mute": "silent",
    "CAN adapter pulled": "gone",
    "drive without supply": "gone",
    "CAN bus-off": "bus-off",
}
"""The way in which a reading is lost, by what is broken at the wire (control/losses.py); None: the others."""


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    return quick_settings(tmp_path_factory.mktemp("quick"))


@pytest.fixture
def shared():
    s = Shared.create(f"thermoctl-causes-{os.getpid()}")
    yield s
    s.remove()


@pytest.mark.slow  # 27 rigs are warmed up: `make causes`
@pytest.mark.parametrize(("what", "kind", "breaks", "first", "device"), CAUSES, ids=[c[0] for c in CAUSES])
def test_the_first_line_names_the_cause(
    quick, shared, tmp_path, monkeypatch, what, kind, breaks, first, device
):
    bus = None
    if kind == "socketcan":
        bus, kind = KernelBus(), WiredRig
        monkeypatch.setattr("can.Bus", bus.open)
    rig = kind(quick, tmp_path, bus) if kind is WiredRig else kind(quick)
    publish, rig.rig.remarks = rig.rig.publish_row, shared.make_remarks(quick.loop.period_s)

    def both(row):
        shared.ring.write(row)
        publish(row)

    rig.rig.publish_row = both
    try:
        if kind is WiredRig:
            rig.settle(lambda: rig.state == "READY")
        rig.ready_to_be_spoiled()
        breaks(rig)
        for _ in range(4000):
            rig.tick()
            if rig.state == "FAULT":
                break
        rig.tick(700)
        now = status(shared)
        lines = fault_lines(now["faults"])
        assert rig.state == "FAULT" and rig["enable"] == 0.0, (rig.state, rig.faults)
        assert first in lines[0], "\n".join(lines)
        assert now["faults"][0]["loss"] == LOSSES.get(what) or kind is HazardRig, now["faults"][0]
        assert device in "\n".join([*lines, *message_lines(now)]), (lines, message_lines(now))
        assert lines[1].startswith("    -> ")
        line = re.sub(r" at \d\d:\d\d:\d\d, tick \d+", "", lines[0]).replace(f"{tmp_path}/", "/dev/")
        place = "wire" if kind is WiredRig else "reading"
        ROWS.append((what, place, line, lines[1][7:]))
    finally:
        rig.close()


@pytest.fixture(scope="module", autouse=True)
def page():
    """docs/proof/causes.md, where THERMOCTL_CAUSES names it and every cause was shown."""
    yield
    path = os.environ.get("THERMOCTL_CAUSES")
    if path and len(ROWS) == len(CAUSES):
        rows = "".join("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |\n" for row in ROWS)
        Path(path).write_text(
            "<!-- Written by `make causes`; each row is a test in tests/people/test_causes.py. -->\n# Causes\n\nOne thing is "
            "broken on an armed rig in simulated time; this is the first line that `thermoctl status`, `arm`, monitor and "
            "dashboard then show, and its remedy. The relation of causes is in `thermoctl/control/causes.py`. `wire`: the "
            "device's other end is played, and its driver reads it. `reading`: the reading is spoiled behind the driver.\n\n"
            f"| broken | where | first line | remedy |\n| --- | --- | --- | --- |\n{rows}"
        )
