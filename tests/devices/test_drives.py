"""Amplifiers that are no CiA-402: commanded by DBC messages, registers, frames, lines; and position mode.

Each drive here has a state machine and a watchdog of its own and its own framing. Shown for each: it follows
the command only when enabled; a stop by itself is not undone; it is off when we stop, when its link breaks and
after `switch_off`.
"""

import math
import struct
import threading
import time

import pytest

from tests.devices.emulators import ModbusLine, Port, SlcanAdapter, Unit, encode
from tests.devices.harness import HEAD, Rig, wait
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, AMP_FAULT, ROLE, STALE
from thermoctl_hal.profiles.bind import bind, check_rig, rig_notes
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.rig.make import driver

AXIS_DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 1 Heartbeat: 8 A
 SG_ Error : 0|32@1+ (1,0) [0|0] "" A
 SG_ State : 32|8@1+ (1,0) [0|0] "" A
BO_ 7 Set_State: 4 A
 SG_ Requested : 0|32@1+ (1,0) [0|0] "" A
BO_ 14 Set_Torque: 4 A
 SG_ Torque : 0|32@1- (1,0) [0|0] "Nm" A
BO_ 24 Clear: 1 A
 SG_ Zero : 0|8@1+ (1,0) [0|0] "" A
SIG_VALTYPE_ 14 Torque : 1;
"""
STATES = "state: {channel: axis, enabled: [8], disabled: [1]}"
CHANNELS = """channels:
  axis: {%s, unit: '1', rate_hz: 100, stale_after_s: 0.5}
  error: {%s, unit: '1', rate_hz: 100, stale_after_s: 0.5}
"""
ROLES = "{axis: amplifier_state, error: amplifier_fault}"
LIMITS = "unit: A, scale: 0.5, limits: [-2, 2]"


class Drive:
    """IDLE 1, CLOSED LOOP 8; back to IDLE when not commanded for 0.6 s. `trip` is a stop by itself."""

    def __init__(self):
        self.state, self.error, self.torque, self.fed_s, self.mute = 1, 0, 0.0, -math.inf, False
        self.enabled_count = 0
        self.lock = threading.Lock()

    def feed(self, torque=None):
        with self.lock:
            self.fed_s = time.monotonic()
            if torque is not None:
                self.torque = torque

    def request(self, state):
        self.feed()
        if state == 8 and not self.error:
            self.enabled_count += self.state != 8
            self.state = 8
        elif state == 1:
            self.state = 1

    def trip(self, error=0):
        self.state, self.error = 1, error

    @property
    def output(self):
        if time.monotonic() - self.fed_s > 0.6:
            self.state = 1
        return self.torque if self.state == 8 else 0.0


def dbc(folder):
    """As ODrive's CANSimple: identifiers are node << 5 | command."""
    drive = Drive()

    def node(frame):
        can_id, _, data = frame
        if can_id >> 5 != 3:
            return []
        if can_id & 31 == 7:
            drive.request(struct.unpack("<I", data)[0])
        elif can_id & 31 == 14:
            drive.feed(struct.unpack("<f", data)[0])
        elif can_id & 31 == 24:
            drive.error = 0
        return []

    wire = Port(SlcanAdapter(node).take, folder / "wire")
    (folder / "axis.dbc").write_text(AXIS_DBC)
    profile = (
        f"{HEAD}bus: can-dbc\ndbc: axis.dbc\nnode_shift: 5\n"
        f"drive: {{{LIMITS}, command_hz: 200, watchdog_s: 0.6, {STATES}, fault: error,\n"
        "  command: {message: Set_Torque, values: {Torque: command}},\n"
        "  enable: [{message: Set_State, values: {Requested: 8}}],\n"
        "  disable: [{message: Set_State, values: {Requested: 1}}], reset: [{message: Clear}]}\n"
        + CHANNELS
        % ("message: Heartbeat, signal: State", "message: Heartbeat, signal: Error")
    )

    def report():
        wire.send(encode((3 << 5 | 1, False, struct.pack("<IB3x", drive.error, drive.state))))

    return drive, wire, profile, f"slcan:{folder}/wire@500000", report


def modbus(folder):
    """A servo drive: control word in holding 100, command in 101, status in input 10, error in 11."""
    drive = Drive()
    unit = Unit({3: {}, 4: {10: 1, 11: 0}})

    def written(function, address, values):
        Unit._write(unit, function, address, values)
        for k, value in enumerate(values, address):
            if k == 100:
                if value == 0x80:
                    drive.error = 0
                else:
                    drive.request({6: 1, 15: 8}[value])
            elif k == 101:
                drive.feed((value - 65536 if value > 32767 else value) / 1000)

    unit._write = written
    wire = Port(ModbusLine({3: unit}, True).take, folder / "wire")
    profile = (
        f"{HEAD}bus: modbus\nmodbus: {{timeout_s: 0.05}}\n"
        "drive: {unit: A, scale: 0.0005, limits: [-2, 2], command_hz: 100, watchdog_s: 0.6, fault: error,\n"
        f"  {STATES}, command: {{register: 101, value: command}}, enable: [{{register: 100, value: 15}}],\n"
        "  disable: [{register: 100, value: 6, function: 16}], reset: [{register: 100, value: 0x80}]}\n"
        + CHANNELS
        % ("register: 10, type: uint16", "register: 11, type: uint16")
    )

    def report():
        unit.mute = drive.mute
        unit.tables[4].update({10: drive.state, 11: drive.error})

    return drive, wire, profile, f"rtu:{folder}/wire", report


def lines(folder):
    """A laboratory amplifier: "TORQ +0.250", "OUT 1", "STAT?" -> "8,0"."""
    drive, rest = Drive(), [b""]

    def take(data):
        *found, rest[0] = (rest[0] + data).split(b"\n")
        out = b""
        for line in found:
            if line.startswith(b"TORQ "):
                drive.feed(float(line[5:]))
            elif line.startswith(b"OUT "):
                drive.request(8 if line == b"OUT 1" else 1)
            elif line == b"*CLS":
                drive.error = 0
            elif line == b"STAT?" and not drive.mute:
                out += b"%d,%d\n" % (drive.state, drive.error)
        return out

    wire = Port(take, folder / "wire")
    profile = (
        f"{HEAD}bus: serial-lines\ntext: {{pattern: '(?P<s>[0-9]+),(?P<e>[0-9]+)$', request: 'STAT?\\n', "
        "request_hz: 100}\n"
        f"drive: {{{LIMITS}, command_hz: 100, watchdog_s: 0.6, fault: error, {STATES},\n"
        "  command: 'TORQ {command:+.3f}\\n', enable: ['OUT 1\\n'], disable: ['OUT 0\\n'], reset: ['*CLS\\n']}\n"
        + CHANNELS
        % ("field: s", "field: e")
    )
    return drive, wire, profile, f"{folder}/wire", lambda: None


def frames(folder):
    """A drive with binary frames: address | command | value int32 big-endian | sum8."""
    drive, rest = Drive(), [b""]

    def take(data):
        rest[0] += data
        out = b""
        while len(rest[0]) >= 7:
            frame, rest[0] = rest[0][:7], rest[0][7:]
            assert sum(frame[:6]) & 255 == frame[6], "the drive got a damaged frame"
            address, command, value = struct.unpack(">BBi", frame[:6])
            if address != 9:
                continue
            if command == 1:
                drive.request(value)
            elif command == 2:
                drive.feed(value / 1000)
            elif command == 3:
                drive.error = 0
            elif command == 6 and not drive.mute:
                body = struct.pack(">BBHH", address, 100, drive.state, drive.error)
                out += body + bytes([sum(body) & 255])
        return out

    def message(command, value):
        fields = f"{{type: uint8, value: address}}, {{type: uint8, value: {command}}}, {{type: int32, value: {value}}}"
        return f"{{endian: big, crc: sum8, fields: [{fields}]}}"

    ask = bytes([9, 6, 0, 0, 0, 0, 15])
    wire = Port(take, folder / "wire")
    profile = (
        f"{HEAD}bus: serial-binary\nframe: {{sync: [], length: false, endian: big, crc: sum8, request: {list(ask)}, "
        "request_hz: 100, fields: [{name: a, type: uint8, equals: 9}, {type: skip1}, {name: s, type: uint16}, "
        "{name: e, type: uint16}]}\n"
        f"drive: {{unit: A, scale: 0.0005, limits: [-2, 2], command_hz: 100, watchdog_s: 0.6, fault: error, {STATES},\n"
        f"  command: {message(2, 'command')}, enable: [{message(1, 8)}], disable: [{message(1, 1)}],\n"
        f"  reset: [{message(3, 0)}]}}\n" + CHANNELS % ("field: s", "field: e")
    )
    return drive, wire, profile, f"{folder}/wire", lambda: None


KINDS = {"dbc": (dbc, 3), "modbus": (modbus, 3), "lines": (lines, 1), "frames": (frames, 9)}


@pytest.fixture(params=KINDS)
def made(request, tmp_path):
    make, address = KINDS[request.param]
    drive, wire, profile, port, report = make(tmp_path)
    (tmp_path / "drive.yaml").write_text(profile)
    text = f"- {{name: drive, profile: drive.yaml, port: '{port}', address: {address}, roles: {ROLES}}}"
    rig = Rig(tmp_path, text)
    tick = rig.tick

    def ticking():
        if not drive.mute or request.param == "modbus":
            report()
        tick()

    rig.tick = ticking
    yield drive, wire, rig, text, tmp_path, report
    rig.backend.close()
    wire.close()


def test_an_amplifier_by_messages(made):
    drive, wire, rig, text, folder, report = made
    with rig:
        state = "amplifier_state"
        rig.until(lambda: rig.value(state) == AMP_DISABLED and rig.status(state) == "OK", "disabled")
        rig.drive = 1.0  # a command without enable moves nothing
        rig.until(lambda: rig.devices[0].sequencer.state == AMP_DISABLED)
        assert drive.output == 0.0 and drive.enabled_count == 0
        rig.enable = True
        rig.until(lambda: rig.value(state) == AMP_ENABLED and drive.output == pytest.approx(2.0), "enabled")
        rig.drive = -9.0
        rig.until(lambda: drive.output == pytest.approx(-4.0), "clipped")
        drive.trip()  # a stop by itself
        rig.until(lambda: rig.value(state) == AMP_DISABLED, "stopped by itself")
        count, end = drive.enabled_count, time.monotonic() + 0.3
        rig.until(lambda: time.monotonic() > end, "left alone")
        assert drive.enabled_count == count and rig.value(state) == AMP_DISABLED
        rig.enable, rig.drive = False, 0.0
        rig.until(lambda: not rig.devices[0].sequencer.left)
        rig.enable, rig.drive = True, 0.5
        rig.until(lambda: drive.output == pytest.approx(1.0), "enabled again by a person")
        drive.trip(77)
        rig.until(lambda: rig.value(state) == AMP_FAULT and rig.value("amplifier_fault") == 77, "fault")
        rig.enable = False
        rig.until(lambda: drive.error == 0 and rig.value(state) == AMP_DISABLED, "reset while disabled")
        rig.enable = True
        rig.until(lambda: drive.output == pytest.approx(1.0), "enabled")
        end = time.monotonic() + 5
        while drive.output and time.monotonic() < end:  # we stop: its own watchdog
            time.sleep(0.001)
        assert drive.output == 0.0


def test_an_amplifier_whose_state_is_not_reported_is_disabled(made):
    drive, wire, rig, *_ = made
    with rig:
        rig.enable, rig.drive = True, 0.5
        rig.until(lambda: drive.output == pytest.approx(1.0), "enabled")
        drive.mute = True
        rig.until(lambda: drive.output == 0.0 and drive.state == 1, "off")
        rig.until(lambda: rig.sample.status[ROLE["amplifier_state"]] >= STALE, "shown")


def test_an_amplifier_is_off_after_its_cable_was_pulled(made):
    drive, wire, rig, *_ = made
    with rig:
        rig.enable, rig.drive = True, 0.5
        rig.until(lambda: drive.output == pytest.approx(1.0), "enabled")
        wire.unplug()
        rig.until(lambda: rig.status("amplifier_state") == "ERROR" and drive.output == 0.0, "lost")
        rig.enable = False
        wire.plug()
        rig.until(
            lambda: rig.status("amplifier_state") == "OK" and rig.value("amplifier_state") == AMP_DISABLED
        )
        assert drive.output == 0.0


def test_an_amplifier_is_switched_off_over_a_link_of_its_own(made):
    drive, wire, rig, text, folder, report = made
    drive.request(8)
    drive.feed(1.0)
    stop = threading.Event()

    def reporting():
        while not stop.wait(0.01):
            report()

    thread = threading.Thread(target=reporting)
    thread.start()
    other = driver(check_rig([bind(yamlfile.loads(text).value[0], folder)])[0])
    other.switch_off()
    assert drive.state == 1 and drive.torque == 0.0
    stop.set()
    thread.join()


@pytest.fixture
def can_drive(tmp_path):
    """The drive by DBC messages, driving 1 Nm, and what puts frames on its bus."""
    drive, wire, profile, port, report = dbc(tmp_path)
    (tmp_path / "drive.yaml").write_text(profile)
    with Rig(
        tmp_path, f"- {{name: drive, profile: drive.yaml, port: '{port}', address: 3, roles: {ROLES}}}"
    ) as rig:
        tick = rig.tick
        rig.tick = lambda: (report(), tick())
        rig.enable, rig.drive = True, 0.5
        rig.until(lambda: drive.output == pytest.approx(1.0), "enabled")
        yield drive, wire, rig
    wire.close()


SECOND_MASTER = {
    "the command": (3 << 5 | 14, False, struct.pack("<f", -2.0)),
    "enabling": (3 << 5 | 7, False, struct.pack("<I", 9)),
    "a reset": (3 << 5 | 24, False, b"\0"),
}


@pytest.mark.parametrize("what", SECOND_MASTER)
def test_a_second_master_on_a_dbc_drive_stops_the_axis(can_drive, what):
    drive, wire, rig = can_drive
    wire.send(encode(SECOND_MASTER[what]))
    rig.until(lambda: rig.status("amplifier_state") == "ERROR" and drive.output == 0.0, "stopped")
    assert "two masters would drive one axis" in rig.backend.problem("amplifier_state")
    rig.enable = False
    rig.until(lambda: rig.status("amplifier_state") == "OK", "connected again, and not enabled by itself")
    assert drive.output == 0.0


def test_a_frame_to_another_drive_is_no_second_master(can_drive):
    drive, wire, rig = can_drive
    for _ in range(20):
        wire.send(encode((4 << 5 | 14, False, struct.pack("<f", -2.0))))
        rig.tick()
    assert rig.status("amplifier_state") == "OK" and drive.output == pytest.approx(1.0)


def test_an_adapter_that_hands_back_our_frames_is_no_second_master(can_drive):
    drive, wire, rig = can_drive
    adapter, sent = wire.take.__self__, []
    adapter.nodes = (*adapter.nodes, lambda frame: [sent.append(frame) or frame])
    rig.until(lambda: len(sent) > 50)
    assert rig.status("amplifier_state") == "OK" and drive.output == pytest.approx(1.0)


DAC = f"""{HEAD}bus: modbus
modbus: {{timeout_s: 0.05}}
drive: {{unit: V, scale: 0.005, limits: [0, 5], command_hz: 50, watchdog_s: none, state: assumed,
  command: {{register: 0, type: uint16, value: command}}, disable: []}}
channels:
  out: {{kind: holding, register: 0, type: uint16, scale: 0.005, unit: V, range: [0, 10], rate_hz: 20, stale_after_s: 1}}
"""


def test_a_dac_without_state_and_watchdog(tmp_path):
    """It is taken to obey, its output is zero when disabled, and `check` names what it cannot do."""
    unit = Unit({3: {0: 700}})
    wire = Port(ModbusLine({1: unit}, True).take, tmp_path / "wire")
    (tmp_path / "dac.yaml").write_text(DAC)
    text = f"- {{name: dac, profile: dac.yaml, port: 'rtu:{tmp_path}/wire', roles: {{state: amplifier_state, out: voltage_v}}}}"
    with Rig(tmp_path, text) as rig:
        rig.until(lambda: unit.tables[3][0] == 0 and rig.value("amplifier_state") == AMP_DISABLED)
        rig.enable, rig.drive = True, 2.5
        rig.until(lambda: unit.tables[3][0] == 500 and rig.value("voltage_v") == 2.5)
        rig.drive = -1.0  # it has no negative output: zero, not 65336 counts
        rig.until(lambda: unit.tables[3][0] == 0)
        rig.drive = 2.5
        rig.until(lambda: unit.tables[3][0] == 500)
        unit.exception = 4
        rig.until(lambda: rig.status("amplifier_state") == "ERROR", "refused")
        unit.exception = 0
        rig.until(lambda: rig.status("amplifier_state") == "OK", "back")
    assert unit.tables[3][0] == 0  # closed: off
    notes = rig_notes([d.binding for d in rig.devices])
    assert any("dac cannot stop by itself" in n for n in notes) and any(
        "does not report its state" in n for n in notes
    )
    wire.close()


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("watchdog_s: none, ", "", "'watchdog_s' is missing"),
        ("watchdog_s: none", "watchdog_s: 0.01", "below two periods of command_hz"),
        ("value: command", "value: 3", "does not carry the command"),
        ("limits: [0, 5]", "limits: [1, 5]", "must contain 0"),
        (
            "limits: [0, 5]",
            "limits: [-5, 5]",
            r"p\.yaml:7:\d+: command: -1000 does not fit uint16, 0 .. 65535 .'limits'",
        ),
        ("disable: []", "disable: [{register: 1, value: 70000}]", "disable: 70000 does not fit int16"),
        ("state: assumed", "state: {channel: outt, enabled: [1], disabled: [0]}", "did you mean 'out'"),
        ("disable: []", "disable: [{register: 1, value: 0, function: 5}]", "function: 5 cannot write"),
        ("  out:", "  state:", "name of the assumed state"),
    ],
)
def test_mistakes_in_a_drive_are_told(tmp_path, old, new, message):
    assert old in DAC
    (tmp_path / "p.yaml").write_text(DAC.replace(old, new))
    with pytest.raises(InputError, match=message):
        load_profile(tmp_path / "p.yaml")


def test_the_echo_of_a_command_is_no_reading(tmp_path):
    """An amplifier that was dead behind its echo had the current that was asked for."""
    alive, rest, commands, read = [False], [b""], [], set()

    def take(data):
        *found, rest[0] = (rest[0] + data).split(b"\r")
        commands.extend(found)
        return b"".join(m + (b"\rI=0.250\r" if m == b"I?" and alive[0] else b"\r") for m in found)

    wire = Port(take, tmp_path / "wire")
    (tmp_path / "amplifier.yaml").write_text(
        f"{HEAD}bus: serial-lines\ntext: {{pattern: 'I=(?P<i>[-+.0-9]+)$', request: 'I?\\r', request_hz: 100}}\n"
        "drive: {unit: A, scale: 1, limits: [-2, 2], watchdog_s: none, state: assumed, command: 'I={command:.3f}\\r', "
        "disable: ['OUT 0\\r'], enable: ['OUT 1\\r']}\n"
        "channels: {current: {field: i, unit: A, range: [-3, 3], rate_hz: 100, stale_after_s: 0.5}}\n"
    )
    text = f"- {{name: amplifier, profile: amplifier.yaml, port: {tmp_path}/wire, roles: {{state: amplifier_state, current: current_a}}}}"
    with Rig(tmp_path, text) as rig:

        def current():
            read.add(rig.value("current_a")) if rig.status("current_a") == "OK" else None
            return commands.count(b"I=1.500") > 20

        rig.drive, rig.enable = 1.5, True
        rig.until(current)
        assert not read and "our own message" in rig.devices[0].silence()
        alive[0] = True
        commands.clear()
        rig.until(lambda: current() and read)
        assert read == {0.25}
    wire.close()


class Positioner:
    """A CiA-402 drive in cyclic position mode behind a Lawicel adapter: SDO, PDO by SYNC, heartbeat.

    `targets` holds every target position that it was sent while enabled."""

    def __init__(self, node):
        self.node, self.od, self.control, self.state = node, {}, 0, 0x40
        self.actual, self.targets = 123_456, []

    def take(self, frame):
        can_id, _, data = frame
        if can_id == 0x600 + self.node:
            return [(0x580 + self.node, False, self.sdo(data))]
        if can_id == 0x200 + self.node:
            word, target = struct.unpack("<Hi", data)
            self.step(word)
            if self.state == 0x27:
                self.targets.append(target)
                self.actual = target
        if can_id == 0x80:
            status = struct.pack("<Hi", self.state | 0x200, self.actual)
            return [(0x180 + self.node, False, status), (0x700 + self.node, False, b"\x05")]
        return []

    def sdo(self, data):
        command, index, sub = struct.unpack_from("<BHB", data)
        if command == 0x40:
            value = {0x1000: 0x20192}.get(index, 0)
            return struct.pack("<BHBI", 0x43, index, sub, value)
        self.od[index, sub] = struct.unpack_from("<I", data, 4)[0]
        return struct.pack("<BHB4x", 0x60, index, sub)

    def step(self, word):
        low = word & 0x0F
        if not word & 2:
            self.state = 0x40
        elif low == 6:
            self.state = 0x21
        elif low == 7 and self.state != 0x40:
            self.state = 0x23
        elif low == 15 and self.state in (0x23, 0x27):
            self.state = 0x27


POSITION_DRIVE = f"""{HEAD}bus: can-cia402
cia402: {{node_id: 5, mode: 8, command: 0x607A, transmit: [0x6041, 0x6064], watchdog_s: 1}}
drive: {{unit: um, scale: 0.01, limits: [500, 2000], slew_per_s: 1000}}
channels:
  state: {{object: 0x6041, unit: '1', rate_hz: 1000, stale_after_s: 0.5}}
  position: {{object: 0x6064, unit: um, scale: 0.01, range: [-1e6, 1e6], rate_hz: 1000, stale_after_s: 0.5}}
"""


def test_a_position_drive_starts_where_it_stands(tmp_path):
    """Without an EDS file. Enabling moves nothing; the target goes to the command by the slew rate, inside the limits."""
    drive = Positioner(5)
    wire = Port(SlcanAdapter(drive.take).take, tmp_path / "wire")
    (tmp_path / "drive.yaml").write_text(POSITION_DRIVE)
    text = (
        f"- {{name: drive, profile: drive.yaml, port: 'slcan:{tmp_path}/wire', "
        "roles: {state: amplifier_state, position: position_um}}"
    )
    with Rig(tmp_path, text) as rig:
        assert drive.od[0x6060, 0] == 8 and drive.od[0x1600, 2] == 0x607A0020
        rig.until(lambda: rig.value("position_um") == 1234.56)
        rig.drive, rig.enable = 1300.0, True
        rig.until(lambda: drive.actual == 130_000)
        assert drive.targets[0] in range(123_456, 123_456 + 1100), drive.targets[:3]
        steps = [b - a for a, b in zip(drive.targets, drive.targets[1:], strict=False)]
        assert max(steps) <= 1000 and min(steps) >= 0  # at most 10 ms of 1000 um/s
        rig.drive = 1e9
        rig.until(lambda: drive.actual == 200_000)
        rig.enable = False
        rig.until(lambda: drive.state == 0x40)
    wire.close()


@pytest.mark.parametrize(
    "old,new,message",
    [
        (", slew_per_s: 1000", "", "'slew_per_s' is missing"),
        ("0x6041, 0x6064]", "0x6041]", "needs 0x6064"),
        ("mode: 8", "mode: 1", "needs a handshake"),
        ("command: 0x607A", "command: 0x2071", "the type of object 0x2071 is not known"),
        (
            "limits: [500, 2000]",
            "limits: [500, 3e7]",
            r"50000 .. 3e\+09 counts, the command object holds -2147483647",
        ),
    ],
)
def test_mistakes_in_a_position_drive_are_told(tmp_path, old, new, message):
    (tmp_path / "p.yaml").write_text(
        POSITION_DRIVE.replace(old, new).replace("object: 0x6064", "object: 0x6041")
    )
    node = yamlfile.loads("{profile: p.yaml, port: 'slcan:x', roles: {state: amplifier_state}}")
    with pytest.raises(InputError, match=message):
        driver(bind(node, tmp_path))


COMMAND_DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 5 Set: 8 A
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" A
 SG_ Torque m0 : 8|16@1- (0.001,0) [0|0] "A" A
 SG_ Level m0 : 24|8@1+ (1,%s) [0|0] "" A
 SG_ Other m1 : 8|8@1+ (1,9) [0|0] "" A
BO_ 6 Off: 8 A
 SG_ Mode : 0|2@1+ (1,0) [0|0] "" A
"""
CAN_DRIVE = f"""{HEAD}bus: can-dbc
dbc: a.dbc
drive: {{unit: A, scale: 1, limits: %s, watchdog_s: 1, state: assumed,
  command: {{message: Set, values: {{%s}}}}, disable: [{{message: Off, values: {{%s}}}}]}}
channels: {{x: {{message: Off, signal: Mode, unit: '1', rate_hz: 10, stale_after_s: 1}}}}
"""


@pytest.mark.parametrize(
    "offset,limits,values,off,message",
    [
        ("0", "[-32, 32]", "Torque: command", "Mode: 3", ""),
        ("0", "[-33, 32]", "Torque: command", "Mode: 3", "command: Torque cannot be -33: it holds -32.768 .. 32.767"),
        ("0", "[-32, 32]", "Torque: command, Page: 1", "Mode: 3", "Torque is not sent: Page selects it"),
        ("0", "[-32, 32]", "Torque: command, Page: 16", "Mode: 3", "Page cannot be 16: it holds 0 .. 15"),
        ("5", "[-32, 32]", "Torque: command", "Mode: 3", "Level cannot be 0: it holds 5 .. 260; give its value in 'val"),
        ("5", "[-32, 32]", "Torque: command, Level: 5", "Mode: 3", ""),
        ("0", "[-32, 32]", "Torque: command", "Mode: 4", "disable: Mode cannot be 4: it holds 0 .. 3$"),
    ],
)  # fmt: skip
def test_a_can_message_must_hold_its_numbers(tmp_path, offset, limits, values, off, message):
    """A number that does not fit would end the tick; the message that disables would never be sent."""
    (tmp_path / "a.dbc").write_text(COMMAND_DBC % offset)
    (tmp_path / "p.yaml").write_text(CAN_DRIVE % (limits, values, off))
    if not message:
        load_profile(tmp_path / "p.yaml")
        return
    with pytest.raises(InputError, match=rf"p\.yaml:\d+:\d+: .*{message}"):
        load_profile(tmp_path / "p.yaml")


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("unit: A", "unit: mA", "unit: the DBC file gives Torque in A, the profile says mA with scale 1"),
        (
            "scale: 1,",
            "scale: 0.001,",
            "Torque in A with its factor 0.001, which would count twice; say scale: 1",
        ),
    ],
)
def test_a_can_command_has_the_unit_of_the_file(tmp_path, old, new, message):
    """A thousand times the wanted command, or a thousandth."""
    (tmp_path / "a.dbc").write_text(COMMAND_DBC % "0")
    text = CAN_DRIVE % ("[-0.01, 0.01]", "Torque: command", "Mode: 3")
    (tmp_path / "p.yaml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=rf"p\.yaml:6:\d+: .*{message}"):
        load_profile(tmp_path / "p.yaml")


@pytest.mark.parametrize("kind,value", [("int16", 40000), ("uint8", -1), ("digits4", 10000), ("hex2", 256)])
def test_a_binary_message_must_hold_its_numbers(tmp_path, kind, value):
    (tmp_path / "p.yaml").write_text(
        f"{HEAD}bus: serial-binary\nframe: {{sync: [1], crc: none, fields: [{{name: a, type: int16}}]}}\n"
        "drive: {unit: A, scale: 1, limits: [-1, 1], watchdog_s: 1, state: assumed,\n"
        "  command: {crc: none, fields: [{type: int8, value: command}]},\n"
        f"  disable: [{{crc: none, fields: [{{type: {kind}, value: {value}}}]}}]}}\n"
        "channels: {x: {field: a, unit: '1', rate_hz: 10, stale_after_s: 1}}\n"
    )
    with pytest.raises(InputError, match=r"p\.yaml:8:\d+: disable: "):
        load_profile(tmp_path / "p.yaml")


def test_a_drive_that_takes_can_fd_frames(tmp_path):
    """The library's moteus profile: mode, torque and a query in one frame of 32 bytes; a watchdog of its own."""
    import can

    from thermoctl.devices.library import find
    from thermoctl_hal.rig.probe import Probe

    name = f"moteus-{tmp_path.name}"
    bus = can.Bus(name, interface="virtual", fd=True)
    mode, torque, fed_s = 0, 0.0, 0.0

    def device():
        nonlocal mode, torque, fed_s
        while (m := bus.recv(0)) is not None:
            assert m.is_fd and m.is_extended_id and m.arbitration_id == 0x8001 and len(m.data) == 32
            assert (
                m.data[:2] == b"\x01\x00"
                and m.data[3:6] == b"\x0c\x05\x20"
                and m.data[26:] == b"\x14\x04\x00PPP"
            )
            _, _, torque, kp, kd = struct.unpack_from("<5f", m.data, 6)
            assert kp == kd == 0.0
            mode, fed_s = m.data[2] if mode != 11 or m.data[2] == 0 else 11, time.monotonic()
            reply = b"\x24\x04\x00" + struct.pack("<hhhh", mode, 0, 0, round(torque * 100)) + b"P"
            bus.send(can.Message(arbitration_id=0x100, is_extended_id=True, is_fd=True, data=reply))

    profile = find("mjbots-moteus")
    text = f"- {{name: m, profile: {profile}, port: 'virtual:{name}@1000000,5000000', roles: {{state: amplifier_state}}}}"
    with Rig(tmp_path, text) as rig:
        tick = rig.tick
        rig.tick = lambda: (tick(), device())
        rig.until(lambda: rig.value("amplifier_state") == AMP_DISABLED)
        rig.drive, rig.enable = 2.0, True
        rig.until(lambda: mode == 10 and torque == pytest.approx(0.2))
        mode = 11  # its watchdog: it stays off until enable is withdrawn
        rig.until(lambda: rig.devices[0].sequencer.left and mode == 0)
        rig.enable = False
        rig.until(lambda: rig.value("amplifier_state") == AMP_DISABLED)
    probe = Probe(load_profile(profile), f"virtual:{name}@1000000,5000000", None)
    probe.open()
    bus.send(
        can.Message(
            arbitration_id=0x100,
            is_extended_id=True,
            is_fd=True,
            data=b"\x24\x04\x00" + struct.pack("<4h", 0, 0, 0, -25) + b"P",
        )
    )
    wait(probe.complete, probe.step)
    assert {r.channel: r.value for r in probe.readings()} == {"state": 0, "torque": -0.25}
    probe.close()
    bus.shutdown()


def test_a_drive_and_a_shunt_share_one_adapter(tmp_path):
    """Opened once; the drive is set up, enabled and followed while the shunt sends; both come back after a pulled cable."""
    from tests.devices.test_sharing import can_files

    drive = Positioner(5)
    adapter = SlcanAdapter(drive.take)
    wire = Port(adapter.take, tmp_path / "wire")
    can_files(tmp_path)
    (tmp_path / "drive.yaml").write_text(POSITION_DRIVE)
    port = f"slcan:{tmp_path}/wire"
    text = (
        f"- {{name: drive, profile: drive.yaml, port: '{port}', roles: {{state: amplifier_state, position: position_um}}}}\n"
        f"- {{name: shunt, profile: shunt.yaml, port: '{port}', roles: {{v: voltage_v}}}}"
    )
    with Rig(tmp_path, text) as rig:
        tick = rig.tick
        rig.tick = lambda: (wire.send(encode((801, False, struct.pack("<h6x", 12500)))), tick())
        rig.drive, rig.enable = 1300.0, True
        rig.until(lambda: drive.actual == 130_000 and rig.value("voltage_v") == 12.5)
        assert adapter.commands.count(b"O") == 1
        wire.unplug()
        rig.until(lambda: rig.status("amplifier_state") == "ERROR")
        rig.enable, drive.state = False, 0x40
        wire.plug()
        rig.until(lambda: all(d.up for d in rig.devices) and rig.value("amplifier_state") == AMP_DISABLED)
        rig.until(lambda: rig.status("amplifier_state") == rig.status("voltage_v") == "OK")
    wire.close()
