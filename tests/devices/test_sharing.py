"""Devices that share a wire: opened once, asked in turn; one that fails leaves the others alone."""

import contextlib
import os
import struct
import threading
import time

import can
import pytest

from tests.devices.emulators import ModbusLine, Port, SlcanAdapter, Unit, encode, words
from tests.devices.harness import HEAD, Line, Rig
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import HardwareError, Sample
from thermoctl_hal.base.profile import LineSettings
from thermoctl_hal.can.bus import open_can
from thermoctl_hal.modbus import link as modbus_link
from thermoctl_hal.profiles.bind import bind, check_rig

READ = "rate_hz: 50, stale_after_s: 5"
TC = f"""{HEAD}bus: modbus
line: {{baud: 19200}}
modbus: {{timeout_s: 0.1}}
channels:
  t: {{register: 4, type: int16, scale: 0.1, unit: degC, range: [-50, 300], {READ},
      invalid: {{kind: discrete, register: 120}}}}
  u: {{kind: holding, register: 9, type: uint16, low_bit: 4, bits: 12, signed: true, unit: degC, range: [-300, 300],
      {READ}, invalid: {{kind: input, register: 5, mask: 0x0300, good: 0x0100}}}}
"""
METER = f"""{HEAD}bus: modbus
line: {{baud: 19200}}
modbus: {{timeout_s: 0.1, max_gap: 0}}
channels:
  v: {{register: 0, type: float32, unit: V, range: [-60, 60], {READ}}}
  i: {{register: 6, type: float32, byte_order: little, unit: A, range: [-60, 60], {READ}}}
"""


def units():
    tc = Unit({2: {120: 0}, 3: {9: (-37 & 0xFFF) << 4}, 4: {4: 253, 5: 0x0100}})
    swapped = [w >> 8 | (w & 255) << 8 for w in words(1.5, "f")]
    meter = Unit({4: dict(zip([0, 1, 6, 7], words(12.5, "f") + swapped, strict=True))})
    return tc, meter


def modbus_rig(folder, port):
    (folder / "tc.yaml").write_text(TC)
    (folder / "meter.yaml").write_text(METER)
    return Rig(
        folder,
        f"- {{name: tc, profile: tc.yaml, port: '{port}', address: 3, roles: {{t: coil_c, u: air_c}}}}\n"
        f"- {{name: meter, profile: meter.yaml, port: '{port}', address: 7, roles: {{v: voltage_v, i: current_a}}}}\n",
    )


@pytest.mark.parametrize("kind", ["rtu", "rtu over tcp", "tcp"])
def test_two_units_of_one_line_with_status_bits(tmp_path, kind):
    tc, meter = units()
    line = ModbusLine({3: tc, 7: meter}, kind != "tcp")
    wire = Port(line.take, tmp_path / "line" if kind == "rtu" else None)
    port = {
        "rtu": f"rtu:{tmp_path}/line",
        "rtu over tcp": f"rtu:socket://127.0.0.1:{wire.number}",
        "tcp": f"tcp:127.0.0.1:{wire.number}",
    }[kind]
    with modbus_rig(tmp_path, port) as rig:
        ok = "coil_c", "air_c", "voltage_v", "current_a"
        rig.until(lambda: all(rig.status(r) == "OK" for r in ok), kind)
        assert rig.value("coil_c") == pytest.approx(25.3) and rig.value("air_c") == -37
        assert rig.value("voltage_v") == 12.5 and rig.value("current_a") == 1.5
        tc.tables[2][120] = 1  # an open wire: this channel alone
        rig.until(lambda: rig.status("coil_c") == "ERROR")
        assert rig.status("air_c") == "OK" and "open wire" in rig.backend.problem("coil_c")
        tc.tables[2][120], tc.tables[4][5] = 0, 0x0300
        rig.until(lambda: rig.status("coil_c") == "OK" and rig.status("air_c") == "ERROR")
        tc.tables[4][5], tc.mute = 0x0100, True  # one unit is mute: the other goes on
        before = line.asked.count(7)
        rig.until(lambda: line.asked.count(7) > before + 10)
        assert rig.status("voltage_v") == "OK"
        tc.mute = False
        rig.until(lambda: rig.status("air_c") == "OK")
        wire.unplug()
        rig.until(lambda: rig.backend.counters()["meter.reconnections"] > 0)
        wire.plug()
        meter.set(4, 0, words(7.25, "f"))
        rig.until(lambda: rig.value("voltage_v") == 7.25 and rig.status("coil_c") == "OK")
    assert line.bad == 0
    wire.close()


def test_a_lost_link_never_opens_the_port_beside_the_new_one(tmp_path):
    tc, _ = units()
    wire = Port(ModbusLine({3: tc}, True).take, tmp_path / "line")
    port, line = f"rtu:{tmp_path}/line", LineSettings(baud=19200)
    first, second = (modbus_link.join(port, line, 0.1) for _ in range(2))
    assert first is second and first.read("holding", 9, 1, 3, 0.5) == [(-37 & 0xFFF) << 4]
    wire.unplug()
    with pytest.raises(HardwareError, match="gone"):
        first.read("holding", 9, 1, 3, 0.5)
    wire.plug()
    with pytest.raises(HardwareError, match="gone"):
        second.read("holding", 9, 1, 3, 0.5)
    modbus_link.leave(first)
    third = modbus_link.join(port, line, 0.1)
    assert third.read("holding", 9, 1, 3, 0.5) == [(-37 & 0xFFF) << 4]
    for link in (second, third):
        modbus_link.leave(link)
    wire.close()


GAUGE = f"""{HEAD}bus: serial-lines
line: {{baud: 9600}}
text: {{pattern: '(?P<x>[-+.0-9]+)$', request: '#{{address:02d}}\\r', request_hz: 200, answer_s: 0.02}}
channels:
  x: {{field: x, unit: um, range: [-5000, 5000], rate_hz: 50, stale_after_s: 5}}
"""


def test_text_devices_that_are_asked_share_a_line(tmp_path):
    """Answers carry no address: only the one that was asked may take it."""
    values, silent = {1: 100, 2: 200}, set()

    def take(data):
        out = b""
        for request in data.split(b"\r")[:-1]:
            number = int(request[1:])
            out += b"" if number in silent else b"%+08.1f\r" % values[number]
        return out

    wire = Port(take, tmp_path / "line")
    (tmp_path / "gauge.yaml").write_text(GAUGE)
    text = "\n".join(
        f"- {{name: g{k}, profile: gauge.yaml, port: {tmp_path}/line, address: {k}, roles: {{x: {role}}}}}"
        for k, role in ((1, "position_um"), (2, "output_reference_um"))
    )

    def shown():
        return {1: rig.value("position_um"), 2: rig.value("output_reference_um")}

    with Rig(tmp_path, text) as rig:
        for _ in range(5):
            values.update({k: v + 1 for k, v in values.items()})
            rig.until(lambda: shown() == values)
        silent.add(1)
        values.update({1: 7, 2: 8})
        rig.until(lambda: rig.value("output_reference_um") == 8)
        assert rig.value("position_um") != 7
        silent.clear()
        rig.until(lambda: rig.value("position_um") == 7)
        wire.unplug()
        rig.until(lambda: not any(d.up for d in rig.devices))
        wire.plug()
        values.update({1: 17, 2: 18})
        rig.until(lambda: shown() == values)
    wire.close()


@pytest.mark.parametrize("echoes", [False, True])
def test_a_late_answer_is_not_taken_for_another_device(tmp_path, echoes):
    """A gauge that is always later than `answer_s` gives no reading, and its neighbours keep theirs.

    The echo of an RS-485 adapter is no answer either: it ended a gauge's turn before the answer came."""
    takes_s, wrong = {1: 0.6, 2: 0.3}, []  # answer_s is 0.4 s: a stalled machine is within 0.2 s

    def send(answer):
        with contextlib.suppress(IndexError, OSError):  # the wire is closed
            os.write(wire.fds[0], answer)

    def take(data):
        out = data if echoes else b""
        for request in data.split(b"\r")[:-1]:
            number = int(request[1:])
            answer = b"%+08.1f\r" % (100.0 * number)
            if number in takes_s:
                threading.Timer(takes_s[number], send, [answer]).start()
            else:
                out += answer
        return out

    wire = Port(take, tmp_path / "line")
    roles = {1: "position_um", 2: "output_reference_um", 3: "voltage_v"}
    text = "\n".join(
        f"- {{name: g{k}, profile: gauge{k}.yaml, port: {tmp_path}/line, address: {k}, roles: {{x: {role}}}}}"
        for k, role in roles.items()
    )
    for k in roles:
        gauge = GAUGE.replace("um", "V") if k == 3 else GAUGE
        (tmp_path / f"gauge{k}.yaml").write_text(
            gauge.replace("request_hz: 200, answer_s: 0.02", "request_hz: 5, answer_s: 0.4")
        )

    with Rig(tmp_path, text) as rig:

        def asked_often():
            read = {k: rig.value(role) for k, role in roles.items() if rig.status(role) == "OK"}
            wrong.extend((k, v) for k, v in read.items() if v != 100.0 * k)
            return rig.backend.counters()["g3.frames"] > 4

        rig.until(asked_often)
    assert not wrong
    wire.close()


def test_a_serial_device_behind_a_network_adapter(tmp_path):
    """socket://host:port carries the bytes of a serial line; pulled and plugged."""
    wire = Port(lambda data: b"+0012.5\r" * data.count(b"\r"))
    (tmp_path / "gauge.yaml").write_text(GAUGE)
    text = f"- {{name: g, profile: gauge.yaml, port: 'socket://127.0.0.1:{wire.number}', roles: {{x: position_um}}}}"
    with Rig(tmp_path, text) as rig:
        rig.until(lambda: rig.value("position_um") == 12.5)
        wire.unplug()
        rig.until(lambda: "reconnecting" in "".join(rig.devices[0].problems.values()))
        wire.plug()
        frames = rig.backend.counters()["g.frames"]
        rig.until(lambda: rig.backend.counters()["g.frames"] > frames)
    wire.close()


DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 801 SHUNT: 8 A
 SG_ Volts : 0|16@1- (0.001,0) [0|0] "V" A
 SG_ Bad : 16|8@1+ (1,0) [0|0] "" A
BO_ 2147484673 SCANNER: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" A
 SG_ T1 m0 : 15|16@0- (0.1,0) [0|0] "degC" A
 SG_ T2 m1 : 15|16@0- (0.1,0) [0|0] "degC" A
BO_ 256 LONG: 16 A
 SG_ Amps : 64|32@1- (0.001,0) [0|0] "A" A
"""
SHUNT = f"""{HEAD}bus: can-dbc
dbc: bus.dbc
channels:
  v: {{message: SHUNT, signal: Volts, unit: V, range: [-60, 60], {READ}, sentinels: [32.767],
      invalid: {{signal: Bad, mask: 0x04}}}}
  t1: {{message: SCANNER, signal: T1, unit: degC, range: [-50, 300], {READ}}}
  t2: {{message: SCANNER, signal: T2, unit: degC, range: [-50, 300], {READ}}}
  i: {{message: LONG, signal: Amps, unit: A, range: [-60, 60], {READ}}}
"""


def can_files(folder):
    (folder / "bus.dbc").write_text(DBC)
    (folder / "shunt.yaml").write_text(SHUNT)


def test_two_devices_on_one_slcan_adapter_at_its_own_baud_rate(tmp_path):
    can_files(tmp_path)
    adapter = SlcanAdapter()
    wire = Port(adapter.take, tmp_path / "can")
    port = f"slcan:{tmp_path}/can@500000,115200"
    text = (
        f"- {{name: shunt, profile: shunt.yaml, port: '{port}', roles: {{v: voltage_v}}}}\n"
        f"- {{name: scanner, profile: shunt.yaml, port: '{port}', roles: {{t1: coil_c, t2: air_c}}}}\n"
    )

    def send(volts, bad=0):
        def frames():
            return not wire.send(
                encode((801, False, struct.pack("<hB5x", volts, bad)))
                + encode((1025, True, struct.pack(">Bh5x", 0, 215)))
                + encode((1025, True, struct.pack(">Bh5x", 1, -5)))
                + encode((1025, False, struct.pack(">Bh5x", 1, 999)))
            )

        return frames

    with Rig(tmp_path, text) as rig:
        rig.until(lambda: send(12500)() and rig.value("voltage_v") == 12.5 and rig.value("coil_c") == 21.5)
        assert rig.value("air_c") == -0.5 and adapter.commands.count(b"O") == 1 and b"S6" in adapter.commands
        rig.until(lambda: send(12500, 4)() and rig.status("voltage_v") == "ERROR")
        rig.until(lambda: send(12000, 2)() and rig.value("voltage_v") == 12)
        rig.until(lambda: send(32767)() and "no reading" in rig.backend.problem("voltage_v"))
        wire.unplug()
        rig.until(lambda: all(d.problems for d in rig.devices))
        wire.plug()
        rig.until(lambda: send(9000)() and rig.value("voltage_v") == 9 and all(d.up for d in rig.devices))
    wire.close()


def test_a_can_fd_message_is_read(tmp_path):
    can_files(tmp_path)
    name = f"fd-{tmp_path.name}"
    text = f"- {{name: shunt, profile: shunt.yaml, port: 'virtual:{name}', roles: {{i: current_a, v: voltage_v}}}}"
    sender = can.Bus(name, interface="virtual")
    with Rig(tmp_path, text) as rig:
        long = can.Message(
            arbitration_id=256,
            is_fd=True,
            is_extended_id=False,
            data=bytes(8) + struct.pack("<i", -2500) + bytes(4),
        )
        classic = can.Message(arbitration_id=801, is_extended_id=False, data=struct.pack("<h6x", 1000))
        sender.send(long)
        sender.send(classic)
        rig.until(lambda: rig.value("current_a") == -2.5 and rig.value("voltage_v") == 1)
    sender.shutdown()


def test_an_interface_whose_receive_blocks_does_not_slow_the_tick(tmp_path, monkeypatch):
    """Some interfaces of python-can wait in recv(0); a thread reads those."""
    arrived = threading.Event()

    class Slow(can.BusABC):
        def __init__(self, channel, **_):
            self.channel_info = channel
            super().__init__(channel)

        def _recv_internal(self, timeout):
            time.sleep(0.05)
            arrived.set()
            return can.Message(
                arbitration_id=801, is_extended_id=False, data=struct.pack("<h6x", 2500)
            ), False

        def send(self, msg, timeout=None):
            pass

    monkeypatch.setattr(can, "Bus", lambda channel, interface, **k: Slow(channel))
    can_files(tmp_path)
    text = "- {name: shunt, profile: shunt.yaml, port: 'seeedstudio:/dev/x', roles: {v: voltage_v}}"
    with Rig(tmp_path, text) as rig:
        assert arrived.wait(5)
        cpu = time.thread_time()
        begin, reads = time.monotonic(), 0
        while time.monotonic() - begin < 0.3:
            rig.tick()
            reads += 1
        assert reads > 20 and time.thread_time() - cpu < 0.3  # with recv in the tick: at most 6
        assert rig.value("voltage_v") == 2.5
    with pytest.raises(Exception, match="interface:channel@bitrate"):
        open_can("nothing", ())


@pytest.mark.parametrize(
    "one,other,message",
    [
        (
            "profile: drive-cia402.yaml, port: 'slcan:/dev/x', roles: {state: amplifier_state}",
            "profile: meter-can.yaml, port: 'slcan:/dev/x@500000', roles: {voltage: voltage_v}",
            "one bus has one bitrate",
        ),
        (
            "profile: encoder-serial.yaml, port: /dev/x, roles: {position: position_um}",
            "profile: encoder-serial.yaml, port: /dev/x, roles: {position: output_reference_um}",
            "sends without being asked",
        ),
        (
            "profile: meter-serial-text.yaml, port: /dev/x, roles: {voltage: voltage_v}",
            "profile: thermocouples-modbus-8.yaml, port: 'rtu:/dev/x', roles: {thermocouple_1: coil_c}",
            "give each a port of its own",
        ),
    ],
)
def test_check_refuses_what_cannot_share(one, other, message):
    from tests.hal.conftest import CONFIG

    two = [
        bind(yamlfile.loads(f"{{name: n{k}, {t}}}"), CONFIG / "devices") for k, t in enumerate((one, other))
    ]
    with pytest.raises(InputError, match=message):
        check_rig(two)


def test_a_single_device_has_its_port_alone(tmp_path):
    line = Line()
    (tmp_path / "gauge.yaml").write_text(GAUGE)
    node = yamlfile.loads(f"{{profile: gauge.yaml, port: {line.path}, roles: {{x: position_um}}}}")
    assert not check_rig([bind(node, tmp_path)])[0].shared and Sample()
    line.close()
