"""Drivers against virtual devices over ptys and TCP: readings agree with the plant, and every pulled cable ends in the
right channel status, quickly, and comes back (issue 2, 'Must show' 5)."""

import math
import os
import re
import sys
import threading
import time

import pytest

from tests.hal.conftest import CONFIG
from thermoctl.configuration.settings import load_settings
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import (
    ABSENT,
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    ERROR,
    OK,
    ROLE,
    STALE,
    HardwareError,
    Sample,
)
from thermoctl_hal.rig.board import Board
from thermoctl_hal.rig.make import make_backend, make_devices
from thermoctl_hal.rig.poller import poll_until
from thermoctl_hal.virtual.drive import HEARTBEAT_LOST
from thermoctl_hal.virtual.rig import VirtualRig, tell

POSITION, COIL, AIR, VOLTAGE, CURRENT = (
    ROLE[r] for r in ("position_um", "coil_c", "air_c", "voltage_v", "current_a")
)
STATE, FAULT_CODE = ROLE["amplifier_state"], ROLE["amplifier_fault"]
BOUND = [
    ROLE[r]
    for r in (
        "position_um",
        "amplifier_state",
        "amplifier_fault",
        "supply_v",
        "coil_c",
        "shaft_1_c",
        "air_c",
        "voltage_v",
        "current_a",
    )
]


@pytest.fixture
def backend(wire):
    b = make_backend(wire.settings)
    b.open()
    wire.until(lambda s: all(s.status[BOUND] == OK), backend=b)
    yield b
    b.close()


def obey(wire, line):
    assert tell(wire.rig.run_dir / "control.sock", line) == "ok"


def test_readings_agree_with_the_plant_while_driven(wire, backend):
    wire.drive, wire.enable = 0.25, True
    wire.until(
        lambda s: (
            s.value[STATE] == AMP_ENABLED
            and abs(s.value[POSITION] - 0.25 * 8 / 26000 * 1e6) < 0.1
            and abs(s.value[CURRENT] - 0.25) < 0.005
        ),
        backend=backend,
    )  # k_T i / k_flexure
    s = backend.sample
    true = wire.rig.plant.true
    assert s.value[POSITION] == pytest.approx(true("position_um"), abs=0.06)
    assert s.value[VOLTAGE] == pytest.approx(true("voltage_v"), abs=0.02)
    assert s.value[AIR] == pytest.approx(true("air_c"), abs=0.1)
    assert s.value[COIL] == pytest.approx(true("coil_c"), abs=0.4) and s.value[COIL] % 0.25 == 0
    assert s.value[ROLE["supply_v"]] == 24.0
    assert s.status[ROLE["bracket_1_c"]] == ABSENT and s.status[ROLE["output_reference_um"]] == ABSENT
    counters = backend.counters()
    assert counters["encoder.errors"] == counters["drive.errors"] == counters["meter.errors"] == 0


def test_a_drive_that_is_not_finite_or_too_large_is_held(wire, backend):
    drive = wire.rig.devices["drive"].drive
    wire.drive, wire.enable = 99.0, True
    wire.until(lambda s: drive.command == 2_500_000, backend=backend)  # the profile's limit
    wire.drive = math.nan
    wire.until(lambda s: s.value[STATE] == AMP_DISABLED and drive.command == 0, backend=backend)


# device, command that breaks, command that mends, channel, status it must end in
CABLES = [
    ("encoder unplug", "encoder plug", POSITION, STALE),
    ("encoder mute on", "encoder mute off", POSITION, STALE),
    ("encoder corrupt on", "encoder corrupt off", POSITION, STALE),
    ("encoder invalid on", "encoder invalid off", POSITION, ERROR),
    ("drive unplug", "drive plug", STATE, ERROR),
    ("drive power off", "drive power on", STATE, ERROR),
    ("drive heartbeat off", "drive heartbeat on", STATE, ERROR),
    ("thermocouples unplug", "thermocouples plug", COIL, STALE),
    ("thermocouples silent on", "thermocouples silent off", COIL, STALE),
    ("thermocouples half on", "thermocouples half off", COIL, STALE),
    ("thermocouples exception 6", "thermocouples exception 0", COIL, STALE),
    ("thermocouples exception 4", "thermocouples exception 0", COIL, ERROR),
    ("meter unplug", "meter plug", VOLTAGE, STALE),
    ("meter corrupt on", "meter corrupt off", VOLTAGE, STALE),
    ("meter half on", "meter half off", VOLTAGE, STALE),
]


@pytest.mark.parametrize("pull,plug,role,status", CABLES, ids=[c[0].replace(" ", "_") for c in CABLES])
def test_a_pulled_cable_shows_and_comes_back(wire, backend, pull, plug, role, status):
    obey(wire, pull)
    healthy = [i for i in BOUND if i not in backend._owner[role].roles]
    wire.until(  # the other devices are not drawn in; a stall of the machine passes
        lambda s: s.status[role] == status and all(s.status[healthy] == OK), backend=backend
    )
    name = next(n for n, i in ROLE.items() if i == role)
    assert pull.split()[0] in backend.problem(name)
    obey(wire, plug)
    wire.until(lambda s: s.status[role] == OK and s.fresh[role], limit_s=5.0, backend=backend)


def test_an_open_thermocouple_is_an_error_of_its_channel_only(wire, backend):
    obey(wire, "thermocouples open thermocouple_1")
    wire.until(lambda s: s.status[COIL] == ERROR, limit_s=2.0, backend=backend)
    assert backend.sample.status[AIR] == OK and backend.sample.status[ROLE["shaft_1_c"]] == OK
    assert "open or missing sensor" in backend.problem("coil_c")
    obey(wire, "thermocouples close thermocouple_1")
    wire.until(lambda s: s.status[COIL] == OK, limit_s=2.0, backend=backend)


def test_garbage_between_frames_loses_none(wire, backend):
    obey(wire, "encoder garbage on")
    frames = backend.counters()["encoder.frames"]
    wire.until(lambda s: backend.counters()["encoder.frames"] > frames + 300, backend=backend)
    assert backend.sample.status[POSITION] == OK
    assert backend.fast[0]._framer.skipped > 500


def test_the_drive_stops_by_itself_when_the_daemon_dies_and_can_be_enabled_again(wire, backend):
    drive = wire.rig.devices["drive"].drive
    wire.drive, wire.enable = 0.1, True
    wire.until(lambda s: drive.command == 100_000, backend=backend)
    wire.until(lambda _: drive.command == 0, tick=False)  # nobody ticks: no heartbeat
    assert drive.od[0x603F, 0].value == HEARTBEAT_LOST
    wire.until(lambda s: s.value[FAULT_CODE] == HEARTBEAT_LOST, limit_s=5.0, backend=backend)
    assert drive.command == 0  # the wish to drive alone does not restart it
    wire.enable = False
    wire.until(
        lambda s: s.value[STATE] == AMP_DISABLED and s.value[FAULT_CODE] == 0, limit_s=5.0, backend=backend
    )
    wire.enable = True
    wire.until(lambda s: drive.command == 100_000, limit_s=5.0, backend=backend)


def test_a_fault_of_the_drive_is_told_with_its_code_and_not_driven_over(wire, backend):
    wire.drive, wire.enable = 0.1, True
    wire.until(lambda s: s.value[STATE] == AMP_ENABLED, backend=backend)
    obey(wire, "drive fault 0x2310")
    wire.until(
        lambda s: s.value[STATE] == AMP_FAULT and s.value[FAULT_CODE] == 0x2310, limit_s=2.0, backend=backend
    )
    for _ in range(200):
        backend.read(time.monotonic())
        backend.write(0.1, True)
        assert wire.rig.devices["drive"].drive.command == 0


def test_a_reconnected_drive_is_set_up_anew_and_stays_off(wire, backend):
    drive = wire.rig.devices["drive"].drive
    wire.drive, wire.enable = 0.1, True
    wire.until(lambda s: drive.command == 100_000, backend=backend)
    obey(wire, "drive unplug")
    wire.until(lambda s: s.status[STATE] == ERROR and drive.command == 0, limit_s=2.0, backend=backend)
    wire.enable = False
    obey(wire, "drive plug")
    wire.until(
        lambda s: s.status[STATE] == OK and s.value[STATE] == AMP_DISABLED, limit_s=5.0, backend=backend
    )
    assert backend.counters()["drive.reconnections"] == 1
    assert drive.od[0x1016, 1].value & 0xFFFF == 1000  # its watchdog is set again


def test_close_disables_the_drive(wire):
    b = make_backend(wire.settings)
    b.open()
    drive = wire.rig.devices["drive"].drive
    wire.drive, wire.enable = 0.1, True
    wire.until(lambda s: drive.command == 100_000, backend=b)
    b.close()
    wire.until(lambda _: drive.command == 0 and drive.state != 0x27, tick=False)
    assert drive.od[0x603F, 0].value != HEARTBEAT_LOST  # by our command, not by its watchdog
    b.close()


def test_a_second_daemon_on_the_same_port_is_refused(wire, backend):
    with pytest.raises(HardwareError, match="in use by another program"):
        make_backend(wire.settings).open()


def test_open_reports_every_device_that_is_missing(wired):
    with pytest.raises(HardwareError) as e:
        make_backend(wired).open()
    assert re.search("encoder: .*no such device", str(e.value)) and "can: no such device" in str(e.value)


def test_a_wrong_node_is_told(wire):
    device = next(d for d in make_devices(wire.settings) if d.drives)
    device._node = 6
    with pytest.raises(
        HardwareError,
        match="node 6: set-up failed: no answer to object 0x1000 .*check power, node id|node 6: .*heartbeats of nodes 5",
    ):
        device.connect()


def test_poller_through_a_board_in_shared_memory(wire):
    """As the daemon does it: a poller writes to the board, the back end merges; a dead poller's values go stale."""
    board = Board.create(f"thermoctl-test-{os.getpid()}")
    attached = Board.attach(board.name)
    stop = threading.Event()
    pollers = [
        threading.Thread(target=poll_until, args=([d], attached, stop))
        for d in make_devices(wire.settings)
        if d.slow
    ]
    for p in pollers:
        p.start()
    backend = make_backend(wire.settings, board)
    backend.open()
    try:
        wire.until(lambda s: s.status[COIL] == s.status[VOLTAGE] == OK, backend=backend)
        first = backend.sample.time_s[COIL]
        wire.until(lambda s: s.fresh[COIL] and s.time_s[COIL] > first, backend=backend)
        obey(wire, "thermocouples unplug")
        wire.until(lambda s: s.status[COIL] == STALE, limit_s=6.0, backend=backend)
        assert "connection is gone" in backend.problem("coil_c") or "reconnecting" in backend.problem(
            "coil_c"
        )
        obey(wire, "thermocouples plug")
        wire.until(lambda s: s.status[COIL] == OK, limit_s=5.0, backend=backend)
        stop.set()
        wire.until(lambda s: s.status[COIL] == s.status[VOLTAGE] == STALE, limit_s=6.0, backend=backend)
    finally:
        stop.set()
        for p in pollers:
            p.join(5)
        backend.close()
        board.close()
    with pytest.raises(HardwareError, match="supervisor creates it"):
        Board.attach(board.name)


def test_a_board_survives_a_writer_killed_while_writing(wired):
    device = next(d for d in make_devices(wired) if d.name == "thermocouples")
    board, sample, shown = Board.private(), Sample(), Sample()
    device.put(sample, 0, 2225, 1.0)
    board.post(sample, device)
    seen = board.merge(shown, device.roles, 0)
    assert shown.value[COIL] == 22.25 and shown.fresh[COIL]
    board.rows["sequence"][device.roles[0]] += 1  # killed here
    device.put(sample, 0, 2250, 2.0)
    assert board.merge(shown, device.roles, seen) == seen and shown.value[COIL] == 22.25
    board.post(sample, device)  # its successor
    assert board.merge(shown, device.roles, seen) > seen and shown.value[COIL] == 22.5


def test_a_command_that_is_being_written_is_the_one_before(wired):
    """Read as disabled, it would switch an armed amplifier off for a turn."""
    device = next(d for d in make_devices(wired) if d.drives)
    board = Board.private()
    assert board.command(device) == (0.0, False, -math.inf)
    board.send(device, 0.5, True, 1.0)
    assert board.command(device) == (0.5, True, 1.0)
    board.rows["command_sequence"][device.roles[0]] += 1  # the loop is amid a write
    assert board.command(device) == (0.5, True, 1.0)
    board.send(device, 0.0, False, 2.0)
    assert board.command(device) == (0.0, False, 2.0)


def test_control_socket_answers_nonsense_plainly(wire):
    path = wire.rig.run_dir / "control.sock"
    assert "did you mean 'encoder'" in tell(path, "encodr unplug")
    assert "is none of" in tell(path, "encoder explode")
    assert "on or off was expected" in tell(path, "encoder freeze maybe")
    assert "error code" in tell(path, "drive fault x")
    said = tell(path, "help")
    assert "encoder plug|unplug" in said and "mute on/off" in said and "open CHANNEL" in said, said


def test_the_reference_is_recorded_with_a_time_that_the_daemon_shares(wire):
    from thermoctl.recording.files import read_table

    path = wire.rig.run_dir / "reference.csv"
    begin = time.monotonic()
    wire.until(lambda _: wire.rig.tick > 1000, tick=False)
    wire.stop()
    stopped = time.monotonic()
    table = read_table(path)
    assert abs(table.t[-1] - stopped) < 5 and table.t[0] < begin + 0.1
    assert len(table.t) >= 90 and {"output_reference_um", "drive", "enabled"} <= set(table.columns)


def test_a_port_that_goes_while_it_is_opened_is_a_hardware_error(monkeypatch):
    """termios.error is no OSError: it would end the thread that connects a device again."""
    import termios

    from thermoctl_hal.base.line import open_port
    from thermoctl_hal.base.profile import LineSettings

    master, slave = os.openpty()

    real = termios.tcflush

    def gone(*arguments):
        if sys._getframe(1).f_globals["__name__"].startswith("serial."):  # pyserial's own: still there
            return real(*arguments)
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr(termios, "tcflush", gone)
    with pytest.raises(HardwareError, match="gone while it was opened"):
        open_port(os.ttyname(slave), LineSettings())
    os.close(master)
    os.close(slave)


def test_a_rig_without_a_plant_is_told_what_the_virtual_rig_needs(tmp_path):
    """Before: `thermoctl: .: cannot be read: Is a directory` (review_user_3 A6)."""
    path = tmp_path / "rig.yaml"
    text = re.sub(r"(profile: |model: )(\w+/)", rf"\g<1>{CONFIG}/\g<2>", (CONFIG / "wire.yaml").read_text())
    path.write_text(re.sub(r"  plant: .*\n", "", text))
    with pytest.raises(InputError, match=r"rig.yaml: hal.plant is missing: .*outputs carry the roles' names"):
        VirtualRig(load_settings(path))


class Echo:
    """An adapter's own node: it hands back every frame that the host sends, before any answer."""

    def __init__(self):
        self.frames, self.count = [], 0

    def take(self, frame, now_s):
        self.frames.append(frame)
        self.count += 1

    def due(self, now_s):
        frames, self.frames = self.frames, []
        return frames


@pytest.mark.parametrize("echoes", [True, False])
@pytest.mark.parametrize(
    "frame,message",
    [
        ((0x205, bytes(6)), "two masters would drive one axis"),
        ((0x77A, b"\x05"), "sends the heartbeat 0x77A"),
    ],
)
def test_an_slcan_adapter_that_echoes_is_told_from_a_second_master(wire, echoes, frame, message):
    """The heartbeat of the other master has the same bytes as ours."""
    line, echo = wire.rig.devices["drive"].line, Echo()
    if echoes:
        line.nodes.insert(0, echo)
    b = make_backend(wire.settings)
    b.open()
    try:
        wire.drive, wire.enable = 0.25, True
        drive = wire.rig.devices["drive"].drive
        wire.until(lambda s: drive.command == 250_000, backend=b)
        for _ in range(1500):  # more frames than an adapter may hold back
            frames = b.counters()["drive.frames"]
            b.write(wire.drive, wire.enable)

            def is_answered(_, before=frames):
                """Each tick comes after the answer to the one before: a stall leaves no echoes behind."""
                if b.read(time.monotonic()).status[STATE] != OK:  # lost in a stall: it is connected again
                    b.write(wire.drive, wire.enable)
                return b.counters()["drive.frames"] != before

            wire.until(is_answered, limit_s=30.0)
            # An echo that is taken for another master's frame costs one in 64 ticks.
            assert b.counters()["drive.reconnections"] < 15
        assert (echo.count > 1000) is echoes

        def is_told(sample):
            """Say it again: a drive that a stall of the machine lost is connected first."""
            line.send(line.adapter.encode([frame]))
            return sample.status[STATE] == ERROR and message in b.problem("amplifier_state")

        wire.until(is_told, backend=b)
        wire.until(lambda s: drive.command == 0, backend=b)
        wire.enable = False
        wire.until(lambda s: s.status[STATE] == OK, backend=b)  # connected again
    finally:
        b.close()
