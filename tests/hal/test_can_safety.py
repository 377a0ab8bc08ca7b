"""Several masters and drives on one CAN bus, and frames that are not ours (issue 21, B2, B8, B9, B11, B12, B13).

The other end is played with frames written out here: Lawicel text on a pseudo-terminal, python-can messages on its virtual
bus, and a drive of its own.
"""

import os
import struct
import threading
import time
import tty

import can
import numpy as np
import pytest

from tests.hal.conftest import CONFIG
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import (
    AMP_DISABLED,
    AMP_ENABLED,
    ERROR,
    OK,
    ROLE,
    STALE,
    HardwareError,
    Sample,
)
from thermoctl_hal.base.wire import SlcanParser
from thermoctl_hal.can.dbc import DbcDevice
from thermoctl_hal.can.drive import Cia402Device
from thermoctl_hal.profiles.bind import bind, check_rig
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.rig.devices import DevicesBackend

STATE, VOLTAGE, CURRENT, SUPPLY = (ROLE[r] for r in ("amplifier_state", "voltage_v", "current_a", "supply_v"))
EDS = (CONFIG / "devices/drive-cia402.eds").read_text()
DRIVE = (CONFIG / "devices/drive-cia402.yaml").read_text()


class Axis:
    """A CiA-402 drive as its manual has it, on a python-can bus: strict about what it is told."""

    def __init__(self, bus, node, refuse=(), slow_s=0.0, transmit_size=None):
        self.bus, self.node, self.refuse, self.slow_s = bus, node, dict(refuse), slow_s
        self.transmit_size = transmit_size
        self.od = {(0x1000, 0): 0x20192, (0x603F, 0): 0}
        self.words, self.status, self.command, self.master_seen, self.operational = [], 0x40, 0, None, False
        self.written, self.done, self.beat = [], False, 0.0
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def send(self, can_id, data):
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def run(self):
        while not self.done:
            message = self.bus.recv(0.002)
            now = time.monotonic()
            if message is not None and not message.is_extended_id:
                self.take(message.arbitration_id, bytes(message.data), now)
            watch = self.od.get((0x1016, 1), 0) & 0xFFFF
            if watch and self.master_seen is not None and now - self.master_seen > watch / 1000:
                self.status, self.command, self.operational = 0x08, 0, False
            period = self.od.get((0x1017, 0), 0) / 1000
            if period and now - self.beat > period:
                self.beat = now
                self.send(0x700 + self.node, bytes((0x05 if self.operational else 0x7F,)))

    def take(self, can_id, data, now):
        if can_id == 0 and data[1:] in (b"\0", bytes((self.node,))):
            self.operational = data[0] == 1
            if data[0] in (0x81, 0x82):
                self.od = {(0x1000, 0): 0x20192, (0x603F, 0): 0}
                self.status, self.command, self.master_seen = 0x40, 0, None
        elif can_id == 0x600 + self.node:
            threading.Timer(self.slow_s, self.sdo, (data,)).start() if self.slow_s else self.sdo(data)
        elif can_id == 0x080 and self.operational:
            body = struct.pack("<HhI", self.status, 100, 24000)
            self.send(0x180 + self.node, body[: self.transmit_size])
        elif can_id == 0x200 + self.node and self.operational:
            self.obey(struct.unpack_from("<H", data)[0], struct.unpack_from("<i", data, 2)[0])
        elif can_id == 0x700 + (self.od.get((0x1016, 1), 0) >> 16 & 0x7F) and can_id != 0x700:
            self.master_seen = now

    def obey(self, word, command):
        steps = {(0x40, 0x06): 0x21, (0x21, 0x07): 0x23, (0x23, 0x0F): 0x27}
        if self.status != 0x08:
            self.status = steps.get((self.status, word), 0x40 if not word & 2 else self.status)
        self.command = command if self.status == 0x27 else 0

    def sdo(self, data):
        command, index, sub = struct.unpack_from("<BHB", data)
        value = int.from_bytes(data[4:], "little")
        if (index, sub) in self.refuse and (code := self.refuse[index, sub](value)):
            self.send(0x580 + self.node, struct.pack("<BHBI", 0x80, index, sub, code))
        elif command == 0x40:
            self.send(0x580 + self.node, struct.pack("<BHBI", 0x43, index, sub, self.od.get((index, sub), 0)))
        else:
            self.written.append((index, sub, value))
            self.od[index, sub] = value
            if index == 0x6040 and not value & 2:
                self.status, self.command = (self.status if self.status == 0x08 else 0x40), 0
            self.send(0x580 + self.node, struct.pack("<BHB4x", 0x60, index, sub))

    def stop(self):
        self.done = True
        self.thread.join(2)


class Master:
    """A rig's own back end, ticked."""

    def __init__(self, port, node, more="", profile="drive-cia402.yaml", folder=CONFIG / "devices", roles=""):
        text = (
            f"{{name: axis {node}, profile: {profile}, port: '{port}', address: {node}, stale_after_s: 1, watchdog_s: 0.3"
            f"{more}, roles: {{state: amplifier_state, fault: amplifier_fault, supply: supply_v{roles}}}}}"
        )
        self.device = Cia402Device(bind(yamlfile.loads(text), folder))
        self.backend = DevicesBackend([self.device], [])
        self.drive, self.enable = 0.0, False

    def tick(self):
        self.backend.write(self.drive, self.enable)
        return self.backend.read(time.monotonic())


def until(condition, *masters, limit_s=10.0):
    begin = time.monotonic()
    while True:
        samples = [m.tick() for m in masters]
        if condition(*samples):
            return time.monotonic() - begin
        assert time.monotonic() - begin < limit_s, [m.backend.problem("amplifier_state") for m in masters]
        time.sleep(0.002)


@pytest.fixture
def bus(request):
    """A python-can virtual bus of its own; drive(node) puts a drive on it, bus.port is for masters."""

    class Bus:
        port = f"virtual:{request.node.name}"

        def __init__(self):
            self.axes, self.members = [], []

        def member(self):
            self.members.append(can.Bus(self.port.partition(":")[2], interface="virtual"))
            return self.members[-1]

        def drive(self, node, **how):
            self.axes.append(Axis(self.member(), node, **how))
            return self.axes[-1]

        def master(self, node, *more, **how):
            m = Master(self.port, node, *more, **how)
            self.members.append(m.backend)
            return m

    b = Bus()
    yield b
    for axis in b.axes:
        axis.stop()
    for member in b.members:
        member.close() if isinstance(member, DevicesBackend) else member.shutdown()


def test_a_lost_axis_stops_although_the_other_axis_lives(bus):
    drive_a, drive_b = bus.drive(5), bus.drive(6)
    a, b = bus.master(5), bus.master(6)
    a.backend.open()
    b.backend.open()
    assert drive_a.od[0x1016, 1] >> 16 != drive_b.od[0x1016, 1] >> 16
    for m in (a, b):
        m.drive, m.enable = 0.25, True
    until(lambda s, t: drive_a.command == drive_b.command == 250_000, a, b)
    a.device._port.close()  # A's adapter is pulled out
    until(lambda t: drive_a.command == 0, b)
    assert drive_b.command == 250_000 and b.backend.sample.value[STATE] == AMP_ENABLED


@pytest.mark.parametrize(
    "more,message", [("", "heartbeat 0x77A .node id 122."), (", master_id: 99", "heartbeat 0x763")]
)
def test_a_foreign_producer_of_our_heartbeat_is_refused_before_anything_is_sent(bus, more, message):
    drive, other = bus.drive(5), bus.member()
    done = threading.Event()
    master_id = 0x77A if not more else 0x763

    def produce():
        while not done.wait(0.02):
            other.send(can.Message(arbitration_id=master_id, data=[5], is_extended_id=False))

    thread = threading.Thread(target=produce)
    thread.start()
    try:
        m = bus.master(5, more)
        with pytest.raises(HardwareError, match=f"axis 5: .*{message}.*'master_id' beside 'address'") as e:
            m.backend.open()
        assert bus.port in str(e.value) and not drive.written
    finally:
        done.set()
        thread.join()
    m.backend.open()
    until(lambda s: s.status[STATE] == OK, m)


def test_a_foreign_producer_that_comes_later_stops_the_axis(bus):
    drive, other, m = bus.drive(5), bus.member(), bus.master(5)
    m.backend.open()
    m.drive, m.enable = 0.25, True
    until(lambda s: drive.command == 250_000, m)
    other.send(can.Message(arbitration_id=0x77A, data=[5], is_extended_id=False))
    until(lambda s: s.status[STATE] == ERROR and drive.command == 0, m)


@pytest.mark.parametrize("rpdo", [1, 3])
def test_another_master_that_sends_the_command_stops_the_axis(bus, rpdo):
    drive, other, m = bus.drive(5), bus.member(), bus.master(5)
    m.backend.open()
    m.drive, m.enable = 0.25, True
    until(lambda s: drive.command == 250_000, m)
    command = can.Message(arbitration_id=0x105 + 0x100 * rpdo, data=bytes(6), is_extended_id=False)
    other.send(command)
    until(lambda s: s.status[STATE] == ERROR and drive.command == 0, m)
    assert "two masters would drive one axis" in m.backend.problem("amplifier_state")
    until(lambda s: s.status[STATE] == OK, m)  # connected again, and not enabled by itself
    other.send(command)
    until(lambda s: s.status[STATE] == ERROR, m)


def test_the_master_id_of_the_binding_counts(bus):
    drive, m = bus.drive(5), bus.master(5, ", master_id: 99")
    m.backend.open()
    assert drive.od[0x1016, 1] >> 16 == 99
    for text, message in (
        (", master_id: 5", "the drive's own node id"),
        (", master_id: 128", "outside 1 .. 127"),
    ):
        with pytest.raises(InputError, match=message):
            Master(bus.port, 5, text)


def test_two_drives_of_one_node_id_are_refused(bus):
    bus.drive(5)
    bus.drive(5)
    with pytest.raises(HardwareError, match="two devices answer as node 5"):
        bus.master(5).backend.open()


def test_an_sdo_abort_names_object_value_and_reason(bus):
    bus.drive(5, refuse={(0x6060, 0): lambda v: 0x06090030})
    with pytest.raises(HardwareError) as e:
        bus.master(5).backend.open()
    text = str(e.value)
    assert "refuses 10 (0xA) to object 0x6060: abort 0x06090030, Value range of parameter exceeded" in text
    assert "termination" not in text and text.count("axis 5") == 1 and text.count(bus.port) == 1


@pytest.mark.parametrize(
    "strict", [lambda v: 0 if v & 0x4000_0000 else 0x06090030, lambda v: 0x06090030 if v & 0x4000_0000 else 0]
)
def test_the_no_rtr_bit_of_the_tpdo_is_as_the_drive_wants_it(bus, strict):
    drive, m = bus.drive(5, refuse={(0x1800, 1): strict}), bus.master(5)
    m.backend.open()
    until(lambda s: s.status[STATE] == OK and s.value[STATE] == AMP_DISABLED, m)
    assert drive.od[0x1800, 1] & 0x8000_07FF == 0x185 and drive.od[0x1400, 1] == 0x205


def test_a_slow_drive_needs_the_option(bus, tmp_path):
    bus.drive(5, slow_s=0.1)
    (tmp_path / "drive-cia402.eds").write_text(EDS)
    for timeout, message in (("0.02", "no answer to object 0x1000 within 0.02 s.*sdo_timeout_s"), ("3", "")):
        (tmp_path / "d.yaml").write_text(
            DRIVE.replace("  node_id: 5\n", f"  node_id: 5\n  sdo_timeout_s: {timeout}\n")
        )
        m = bus.master(5, profile="d.yaml", folder=tmp_path)
        if message:
            with pytest.raises(HardwareError, match=message):
                m.backend.open()
        else:
            m.backend.open()


def test_a_wrong_node_id_is_told_with_those_that_are_there(bus):
    other, done = bus.member(), threading.Event()

    def produce():
        while not done.wait(0.02):
            other.send(can.Message(arbitration_id=0x709, data=[5], is_extended_id=False))

    thread = threading.Thread(target=produce)
    thread.start()
    try:
        with pytest.raises(HardwareError, match="heartbeats of nodes 9 are heard: check the node id"):
            bus.master(5).backend.open()
    finally:
        done.set()
        thread.join()


def test_a_tpdo_of_another_length_is_told(bus):
    bus.drive(5, transmit_size=6)
    m = bus.master(5)
    m.backend.open()
    until(
        lambda s: "TPDO 1 frames came with 6 bytes, 8 were mapped" in m.backend.problem("amplifier_state"), m
    )
    assert m.backend.sample.status[STATE] == STALE and m.backend.counters()["axis 5.errors"] > 0


ARRAY = """
[30D1]
ParameterName=Current actual values
ObjectType=0x8
SubNumber=0x3

[30D1sub0]
ParameterName=Highest sub-index
ObjectType=0x7
DataType=0x0005
AccessType=const
PDOMapping=0

[30D1sub1]
ParameterName=Averaged
ObjectType=0x7
DataType=0x0004
AccessType=ro
PDOMapping=1

[30D1sub2]
ParameterName=Momentary
ObjectType=0x7
DataType=0x0004
AccessType=ro
PDOMapping=1
"""


def with_sub_indices(tmp_path, transmit="[0x6041, 0x30D1:1]", item="0x30D1:1", more=""):
    count = int(EDS.partition("[OptionalObjects]")[2].partition("SupportedObjects=")[2].split()[0])
    eds = EDS.replace(f"SupportedObjects={count}", f"SupportedObjects={count + 1}\n{count + 1}=0x30D1", 1)
    if "=0x30D1" not in eds.partition("[OptionalObjects]")[2][:2000]:
        eds = EDS.replace("[OptionalObjects]\nSupportedObjects=", "[OptionalObjects]\nSupportedObjects=", 1)
    eds = eds.replace(
        "[1A00]\nParameterName=TPDO1 mapping parameter\nObjectType=0x9",
        "[1A00]\nParameterName=TPDO1 mapping parameter\nObjectType=0x8",
    )
    (tmp_path / "drive-cia402.eds").write_text(eds + ARRAY)
    text = DRIVE.replace("[0x6041, 0x6078, 0x6079]", transmit).replace("object: 0x6078", f"object: {item}")
    text = "\n".join(line for line in text.split("\n") if "0x6079" not in line or "transmit" in line)
    (tmp_path / "d.yaml").write_text(text.replace("  node_id: 5\n", f"  node_id: 5\n{more}"))
    node = (
        "{name: d, profile: d.yaml, port: 'virtual:x', roles: {state: amplifier_state, current: current_a}}"
    )
    return Cia402Device(bind(yamlfile.loads(node.replace("virtual:x", f"virtual:{tmp_path.name}")), tmp_path))


def test_an_object_with_a_sub_index_is_mapped_and_read(tmp_path):
    device = with_sub_indices(tmp_path)
    axis = Axis(can.Bus(tmp_path.name, interface="virtual"), 5)
    backend = DevicesBackend([device], [])
    try:
        backend.open()
        assert axis.od[0x1A00, 2] == 0x30D1_0120 and axis.od[0x1A00, 0] == 2
        axis.operational = False
        sample = Sample()
        axis.send(0x185, struct.pack("<Hi", 0x27, -1000))
        begin = time.monotonic()
        while not sample.fresh[CURRENT]:
            device.read(sample, time.monotonic())
            assert time.monotonic() - begin < 5
        assert sample.value[CURRENT] == pytest.approx(-2.5) and sample.value[STATE] == AMP_ENABLED
    finally:
        backend.close()
        axis.stop()
        axis.bus.shutdown()


@pytest.mark.parametrize(
    "how,message",
    [
        (
            {"transmit": "[0x6041, 0x30D1]", "item": "0x6041"},
            "transmit: .*object 0x30D1 has sub-indices; say which, as 0x30D1:1, 0x30D1:2",
        ),
        (
            {"transmit": "[0x6041, 0x30D1:9]", "item": "0x6041"},
            "object 0x30D1:9 has no sub-index 9; it has 1, 2",
        ),
        ({"transmit": "[0x6041, 0x6078:1]", "item": "0x6041"}, "object 0x6078:1 has no sub-indices"),
        ({"transmit": "[0x6041, 0x5555]", "item": "0x6041"}, "object 0x5555 is not in it"),
        ({"transmit": "[0x6041, 0x30D1:1, 0x30D1:2]"}, "a PDO has 8 bytes, these objects take 10"),
        ({"more": "  start_up: [{index: 0x5555, value: 1}]\n"}, "start_up: .*object 0x5555 is not in it"),
        (
            {"more": "  start_up: [{index: 0x6060, value: 300}]\n"},
            "start_up: 300 does not fit object 0x6060 .8 bits, with sign.",
        ),
    ],
)
def test_objects_that_the_eds_has_not_are_told_by_check(tmp_path, how, message):
    with pytest.raises(InputError, match=message) as e:
        with_sub_indices(tmp_path, **how)
    assert "\n" not in str(e.value)


def altered_eds(folder, at, more, start_up=""):
    """Bind the shipped drive with lines `more` in section `at` of its EDS file."""
    for name in ("drive-cia402.eds", "drive-cia402.yaml"):
        text = (CONFIG / "devices" / name).read_text()
        if name.endswith("eds"):
            head, section, rest = text.partition(f"[{at}]\n")
            text = head + section + more + "\n" + rest
        else:
            text = text.replace("  watchdog_s: 0.1 ", start_up + "  watchdog_s: 0.1 ")
        (folder / name).write_text(text)
    rig = "{profile: drive-cia402.yaml, port: 'virtual:eds', roles: {state: amplifier_state}}"
    return Cia402Device(bind(yamlfile.loads(rig), folder))


MODES = "  start_up: [{index: 0x6060, value: 10}]\n"


@pytest.mark.parametrize(
    "at, more, start_up, message",
    [
        ("6078", "AccessType=wo", "", "transmit: .*object 0x6078 .*has AccessType=wo: it cannot be sent"),
        ("2071", "AccessType=ro", "", "command: .*object 0x2071 .*has AccessType=ro: it cannot be written"),
        ("2071", "AccessType = CONST ; fixed", "", "has AccessType=const: it cannot be written"),
        ("6060", "AccessType=ro", MODES, "start_up: .*AccessType=ro"),
        (
            "6060",
            "LowLimit=0\nHighLimit=8",
            MODES,
            "0x6060 takes 0 .. 8 .LowLimit, HighLimit., 10 is outside",
        ),
        (
            "2071",
            "LowLimit=0xFFF0BDC0\nHighLimit=1000000",
            "",
            "0x2071 takes -1000000 .. 1000000 .*-2.5e.06 .. 2.5e.06 is",
        ),
        ("2071", "HighLimit=2000000", "", "takes -inf .. 2000000"),
    ],
)
def test_access_and_limits_of_the_eds_are_heeded(tmp_path, at, more, start_up, message):
    with pytest.raises(InputError, match=message) as e:
        altered_eds(tmp_path, at, more, start_up)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize(
    "at, more",
    [
        ("2071", "LowLimit=-2500000\nHighLimit=2500000"),
        ("2071", "LowLimit=0x80000000\nHighLimit=0x7FFFFFFF"),
        ("2071", "LowLimit=0\nHighLimit=0"),
        ("2071", "LowLimit=$NODEID\nHighLimit="),
        ("6078", "AccessType=rwr"),
    ],
)
def test_limits_that_allow_the_command_or_say_nothing(tmp_path, at, more):
    assert altered_eds(tmp_path, at, more, MODES)


class Adapter:
    """The other end of a Lawicel adapter's line, in bytes."""

    def __init__(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.port = f"slcan:{os.ttyname(slave)}@500000"

    def say(self, text):
        os.write(self.master, text)


@pytest.fixture
def shunt(tmp_path):
    """The shipped shunt (message 801 = 0x321, 11 bits) and one whose DBC file says 29 bits."""
    made = []

    def make(extended=False):
        dbc = (CONFIG / "devices/meter-can.dbc").read_text()
        (tmp_path / "meter-can.dbc").write_text(
            dbc.replace("BO_ 801", f"BO_ {801 | 1 << 31}") if extended else dbc
        )
        (tmp_path / "meter-can.yaml").write_text((CONFIG / "devices/meter-can.yaml").read_text())
        adapter = Adapter()
        node = f"{{name: shunt, profile: meter-can.yaml, port: '{adapter.port}', roles: {{voltage: voltage_v, current: current_a}}}}"
        device = DbcDevice(bind(yamlfile.loads(node), tmp_path))
        device.connect()
        made.append(device)
        return adapter, device, Sample()

    yield make
    for device in made:
        device.disconnect()


def read_until(device, sample, seen, limit_s=5.0):
    """Read until `seen`: a terminal hands bytes over when the kernel's worker gets its turn."""
    deadline = time.monotonic() + limit_s
    while not seen() and time.monotonic() < deadline:
        device.read(sample, 1.0)


FRAME_11, FRAME_29 = b"t3218127A00DC0BFF0700\r", b"T000003218127A00DC0BFF0700\r"  # 3.125 V, -0.62500 A


@pytest.mark.parametrize("extended,wanted,other", [(False, FRAME_11, FRAME_29), (True, FRAME_29, FRAME_11)])
def test_an_identifier_of_another_length_is_another_one(shunt, extended, wanted, other):
    adapter, device, sample = shunt(extended)
    assert "nothing arrives" in device.silence()
    adapter.say(other)
    read_until(device, sample, lambda: "nothing arrives" not in device.silence())
    assert not sample.fresh.any()
    words = (
        "came as 11-bit id, the DBC file says 29 bits"
        if extended
        else "came as 29-bit id, the DBC file says 11 bits"
    )
    assert f"1 frames came and gave no reading: 0x321 {words}" in device.silence()
    adapter.say(wanted)
    read_until(device, sample, lambda: np.isfinite(sample.value[VOLTAGE]))
    assert sample.value[VOLTAGE] == pytest.approx(3.125) and sample.value[CURRENT] == pytest.approx(-0.625)


@pytest.mark.parametrize("extended", [False, True])
def test_identifiers_of_both_lengths_through_the_library(tmp_path, extended):
    dbc = (CONFIG / "devices/meter-can.dbc").read_text()
    (tmp_path / "meter-can.dbc").write_text(
        dbc.replace("BO_ 801", f"BO_ {801 | 1 << 31}") if extended else dbc
    )
    (tmp_path / "meter-can.yaml").write_text((CONFIG / "devices/meter-can.yaml").read_text())
    node = f"{{name: s, profile: meter-can.yaml, port: 'virtual:{tmp_path.name}', roles: {{voltage: voltage_v}}}}"
    device, sample, sender = (
        DbcDevice(bind(yamlfile.loads(node), tmp_path)),
        Sample(),
        can.Bus(tmp_path.name, interface="virtual"),
    )
    device.connect()
    data = bytes.fromhex("127A00DC0BFF0700")
    odd = [
        can.Message(arbitration_id=0x321, data=data, is_extended_id=not extended),
        can.Message(arbitration_id=0x321, is_remote_frame=True, dlc=8, is_extended_id=extended),
        can.Message(arbitration_id=0x321, is_error_frame=True, is_extended_id=extended),
        can.Message(arbitration_id=0x321, data=bytes(12), is_fd=True, is_extended_id=extended),
        can.Message(arbitration_id=0x321, data=bytes(64), is_fd=True, is_extended_id=extended),
        can.Message(arbitration_id=0x321, data=bytes(8), is_fd=True, is_extended_id=extended),
        can.Message(arbitration_id=0x321, data=data[:2], is_extended_id=extended),
    ]
    for message in odd:
        sender.send(message)
    device.read(sample, 1.0)
    assert not sample.fresh.any() and device.counters()["ignored"] == 4 and device.counters()["errors"] == 1
    assert "SHUNT_READING came with 2 of 8 bytes, without the signal" in device.silence()
    sender.send(can.Message(arbitration_id=0x321, data=data, is_extended_id=extended))
    device.read(sample, 1.0)
    assert sample.value[VOLTAGE] == pytest.approx(3.125)
    device.disconnect()
    sender.shutdown()


def test_frames_of_29_bits_are_none_of_the_drives(bus):
    """The review's frames: TPDO 1 of node 5 with a fault, its boot-up, an emergency, our own heartbeat; all 29 bits."""
    bus.drive(5)
    other, m = bus.member(), bus.master(5)
    m.backend.open()
    until(lambda s: s.value[STATE] == AMP_DISABLED and s.status[STATE] == OK, m)
    for can_id, data in (
        (0x185, "0800640000000000"),
        (0x705, "00"),
        (0x085, "1023010000000000"),
        (0x77A, "05"),
    ):
        other.send(can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=True))
    frames = m.device.counters()["frames"]
    until(lambda s: m.device.counters()["frames"] > frames + 20, m)
    assert m.backend.sample.value[STATE] == AMP_DISABLED and m.backend.sample.status[STATE] == OK
    assert m.backend.counters()["axis 5.emergencies"] == m.backend.counters()["axis 5.reconnections"] == 0


def test_lawicel_text_as_in_its_manual():
    parser = SlcanParser()
    assert parser.feed(b"t1852ABCD\rT000001852ABCD\r") == [
        (0x185, b"\xab\xcd"),
        (1 << 31 | 0x185, b"\xab\xcd"),
    ]
    assert parser.feed(b"r1852\rR000001852\rd1859" + b"00" * 12 + b"\rT200000000\rt8000\r") == []
    assert parser.ignored == 3 and parser.bad == 2


def test_the_amplifier_is_switched_off_although_nothing_else_opens(bus, tmp_path):
    from types import SimpleNamespace

    from thermoctl.rig.channels import DEFAULT
    from thermoctl_hal.rig.make import disable_amplifier

    drive, m = bus.drive(5), bus.master(5)
    m.backend.open()
    m.drive, m.enable = 0.25, True
    until(lambda s: drive.command == 250_000, m)
    m.device._port.close()
    devices = yamlfile.loads(f"""
- {{name: encoder, profile: encoder-serial.yaml, port: /dev/none, roles: {{position: position_um}}}}
- {{name: broken, profile: no-such-file.yaml, port: /dev/none, roles: {{position: position_um}}}}
- {{name: drive, profile: drive-cia402.yaml, port: '{bus.port}', address: 5, watchdog_s: 5, roles: {{state: amplifier_state}}}}
""").value
    hal = SimpleNamespace(backend="devices", devices=devices)
    settings = SimpleNamespace(path=str(CONFIG / "devices/rig.yaml"), hal=hal, channels=DEFAULT)
    disable_amplifier(settings)
    assert drive.status == 0x40 and drive.command == 0 and (0x6040, 0, 0) in drive.written
    hal.devices = devices[1:2]
    with pytest.raises(InputError, match="no-such-file.yaml"):
        disable_amplifier(settings)
    drive.stop()
    hal.devices = devices
    with pytest.raises(HardwareError, match="no answer to object 0x6040"):
        disable_amplifier(settings)


def test_a_device_that_nobody_requires_may_be_absent_at_the_start(tmp_path, bus):
    from thermoctl_hal.serial.port import SerialDevice

    bus.drive(5)
    m = bus.master(5)
    text = f"{{name: reference, profile: encoder-serial.yaml, port: {tmp_path}/encoder, roles: {{position: output_reference_um}}}}"
    encoder = SerialDevice(bind(yamlfile.loads(text), CONFIG / "devices"))
    backend = m.backend = DevicesBackend([encoder, m.device], [], None, ["amplifier_state"])
    bus.members.append(backend)
    backend.open()
    until(lambda s: s.status[STATE] == OK, m)
    reference = ROLE["output_reference_um"]
    assert backend.sample.status[reference] == STALE
    problem = backend.problem("output_reference_um")
    assert (
        problem.startswith("reference position: ")
        and "no such device" in problem
        and "trying again" in problem
    )
    master, slave = os.openpty()
    tty.setraw(slave)
    (tmp_path / "encoder").symlink_to(os.ttyname(slave))
    frame = encoder._framer.encode(1, 2000, 0)

    def send_and_see(sample):
        os.write(master, frame)
        return sample.status[reference] == OK

    until(send_and_see, m)
    assert (
        backend.sample.value[reference] == pytest.approx(10.0)
        and backend.problem("output_reference_um") == ""
    )
    backend.close()
    needed = DevicesBackend([encoder], [], None, ["output_reference_um"])
    (tmp_path / "encoder").unlink()
    with pytest.raises(HardwareError, match="reference: .*no such device"):
        needed.open()


def test_one_port_for_two_devices_is_shared(tmp_path):
    (tmp_path / "tty").write_text("")
    (tmp_path / "by-id").symlink_to(tmp_path / "tty")
    meter = "profile: meter-modbus.yaml, roles: {voltage: voltage_v}"
    module = "profile: thermocouples-modbus-8.yaml, roles: {thermocouple_1: coil_c}"
    for one, other, shared in (
        (f"rtu:{tmp_path}/tty", f"rtu:{tmp_path}/tty", True),
        (f"rtu:{tmp_path}/tty", f"rtu:{tmp_path}/by-id", True),
        ("rtu:/dev/a", "rtu:/dev/b", False),
        ("tcp:127.0.0.1:502", "tcp:127.0.0.1:502", True),
    ):
        two = [
            bind(yamlfile.loads(f"{{name: n{k}, port: '{p}', {rest}}}"), CONFIG / "devices")
            for k, (p, rest) in enumerate(((one, meter), (other, module)))
        ]
        assert [b.shared for b in check_rig(two)] == [shared, shared]
    assert load_profile(CONFIG / "devices/meter-modbus.yaml")
