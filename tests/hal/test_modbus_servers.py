"""Modbus servers and lines with habits of their own; the other end has its own framing."""

import contextlib
import os
import re
import select
import socket
import struct
import threading
import time
import tty

import pytest

from tests.devices.emulators import modbus_crc
from tests.devices.harness import HEAD
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import ERROR, OK, ROLE, HardwareError, Sample
from thermoctl_hal.base.profile import LineSettings
from thermoctl_hal.modbus import link as links
from thermoctl_hal.modbus.device import ModbusDevice
from thermoctl_hal.profiles.bind import bind

AIR, VOLTAGE = ROLE["air_c"], ROLE["voltage_v"]
READ = "rate_hz: 10, stale_after_s: 2"
REGISTERS = {0: 2345, 8: 888, 100: 777}


class Server:
    """Registers over TCP. `answer`: (request, number of the request, seconds since connecting) -> bytes, None: none."""

    def __init__(self, answer, registers=REGISTERS, close_after=0, reset=False):
        self.answer, self.registers, self.close_after, self.reset = answer, registers, close_after, reset
        self.asked, self.connections = [], 0
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = f"tcp:127.0.0.1:{self.server.getsockname()[1]}"
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self.server.accept()
                self.connections += 1
                threading.Thread(target=self.talk, args=(client,), daemon=True).start()

    def talk(self, client):
        begin, answered = time.monotonic(), 0
        with client, contextlib.suppress(OSError):
            while request := client.recv(260):
                unit, function, address, count = struct.unpack(">BBHH", request[6:12])
                self.asked.append((unit, function, address, count))
                if all(address + k in self.registers for k in range(count)):
                    words = [self.registers[address + k] & 0xFFFF for k in range(count)]
                    pdu = struct.pack(f">BB{count}H", function, 2 * count, *words)
                else:
                    pdu = None
                data = self.answer(self, request, pdu, time.monotonic() - begin)
                if data is None:
                    continue
                client.sendall(data)
                answered += 1
                if self.close_after and answered >= self.close_after:
                    if self.reset:
                        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    return

    def close(self):
        self.server.close()


def framed(request, pdu, transaction=None, unit=None, length=None):
    head = request[:2] if transaction is None else struct.pack(">H", transaction & 0xFFFF)
    size = len(pdu) + 1 if length is None else length
    return head + struct.pack(">HHB", 0, size, request[6] if unit is None else unit) + pdu


def honest(server, request, pdu, age_s):
    return framed(request, pdu if pdu is not None else bytes((request[7] | 0x80, 2)))


def gap(code):
    """Answer a request over missing registers by an exception; code 0: not at all."""
    return lambda s, r, pdu, _: (
        framed(r, pdu) if pdu else framed(r, bytes((r[7] | 0x80, code))) if code else None
    )


@pytest.fixture
def made(tmp_path):
    servers, devices = [], []

    def make(answer, registers="0 8", known=REGISTERS, more="", address="", timeout_s=0.2, **how):
        servers.append(Server(answer, known, **how))
        one, two = registers.split()
        (tmp_path / "d.yaml").write_text(
            f"{HEAD}bus: modbus\nmodbus: {{unit_id: 1, timeout_s: {timeout_s}}}\nchannels:\n"
            f"  t: {{kind: holding, register: {one}, scale: 0.01, unit: degC, {READ}{more}}}\n"
            f"  v: {{kind: holding, register: {two}, type: uint16, scale: 0.01, unit: V, {READ}}}\n"
        )
        node = f"{{name: m, profile: d.yaml, port: '{servers[-1].port}'{address}, roles: {{t: air_c, v: voltage_v}}}}"
        devices.append(ModbusDevice(bind(yamlfile.loads(node), tmp_path)))
        return devices[-1], servers[-1]

    links._SILENT.clear()
    yield make
    for d in devices:
        d.disconnect()
    for s in servers:
        s.close()


def poll_until_read(device, sample, limit_s=12.0):
    """Poll as the poller does: connect again when the link is lost."""
    end = time.monotonic() + limit_s
    up = False
    while not (sample.status[AIR] == OK and sample.status[VOLTAGE] == OK):
        assert time.monotonic() < end, device.problems
        try:
            if not up:
                device.connect()
                up = True
            device.poll(sample)
        except HardwareError:
            device.disconnect()
            up = False
    assert sample.value[AIR] == pytest.approx(23.45)


@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize("after", [1, 2, 3])
def test_a_server_that_closes_after_its_answers_is_read(made, after, reset):
    device, server = made(honest, "0 100", timeout_s=2.0, close_after=after, reset=reset)
    sample = Sample()
    device.connect()
    for _ in range(6):
        device.poll(sample)
    assert sample.value[VOLTAGE] == pytest.approx(7.77) and sample.value[AIR] == pytest.approx(23.45)
    assert device.counters()["lost"] == 0 and server.connections > 12 // (after + 1)


@pytest.mark.parametrize("silent_s", [0.3, 1.2])
def test_a_server_that_is_silent_after_connecting_is_read(made, silent_s):
    device, _ = made(lambda s, r, pdu, age: framed(r, pdu) if age > silent_s else None, "0 100")
    poll_until_read(device, Sample())


def test_a_server_that_hangs_when_it_is_asked_too_early_is_read(made):
    early = set()

    def answer(server, request, pdu, age_s):
        if age_s < 0.4:
            early.add(server.connections)
        return None if server.connections in early else framed(request, pdu)

    device, _ = made(answer, "0 100")
    poll_until_read(device, Sample())


@pytest.mark.parametrize("code", [0, 2, 3, 4, 9])
def test_gaps_that_a_server_refuses_or_passes_over_in_silence_are_left_out(made, code):
    device, server = made(gap(code))
    sample = Sample()
    poll_until_read(device, sample)
    assert sample.value[VOLTAGE] == pytest.approx(8.88)
    server.asked.clear()
    device.poll(sample)
    device.poll(sample)
    assert {a[2:] for a in server.asked} <= {(0, 1), (8, 1)} and server.connections == 1


@pytest.mark.parametrize(
    "wrong,words",
    [
        (lambda s, r, pdu, _: framed(r, pdu, transaction=0), "transaction id 0, .*'timeout_s'.*rtu:socket"),
        (lambda s, r, pdu, _: framed(r, pdu, transaction=r[1] + 1), "transaction id"),
        (lambda s, r, pdu, _: framed(r, pdu, transaction=r[1] << 8 | r[0]), "transaction id"),
        (lambda s, r, pdu, _: framed(r, pdu, unit=0), "unit 0, unit 1 was asked: address: 0"),
        (lambda s, r, pdu, _: framed(r, pdu, unit=255), "unit 255, unit 1 was asked: address: 255"),
        (lambda s, r, pdu, _: framed(r, b"\x04" + pdu[1:]), "function 4, 3 was asked: check 'kind'"),
        (lambda s, r, pdu, _: framed(r, pdu, length=9), "wrong length: 9 bytes are announced, 5 came"),
        (lambda s, r, pdu, _: framed(r, pdu + b"\0\0"), "wrong length: .* check 'type'"),
        (lambda s, r, pdu, _: framed(r, b"\x03\x04" + bytes(4)), "wrong length: 4 bytes .* 2 were asked"),
        (lambda s, r, pdu, _: r[6:7] + pdu + modbus_crc(r[6:7] + pdu), "rtu:socket://"),
        (lambda s, r, pdu, _: None, "no answer within 0.2 s: .*'timeout_s'.*max_gap"),
    ],
)
def test_a_wrong_answer_names_what_is_wrong_and_the_key(made, wrong, words):
    device, _ = made(wrong, "0 100")
    device.connect()
    device.poll(Sample())
    assert re.search(words, device.problems[AIR]), device.problems


@pytest.mark.parametrize(
    "habit",
    [
        lambda s, r, pdu, _: framed(r, pdu) + b"\0\0\0",  # padding behind each answer
        lambda s, r, pdu, _: framed(r, pdu, transaction=r[1] - 1) + framed(r, pdu),  # an old answer before it
    ],
)
def test_bytes_around_an_answer_are_dropped(made, habit):
    device, _ = made(habit, "0 100")
    sample = Sample()
    device.connect()
    for _ in range(3):
        device.poll(sample)
    assert sample.value[AIR] == pytest.approx(23.45) and device.counters()["lost"] == 0


@pytest.mark.parametrize("address", ["0", "248", "255", "0xFF"])
def test_units_to_255_on_tcp(made, address):
    device, server = made(honest, "0 100", address=f", address: {address}")
    device.connect()
    device.poll(Sample())
    assert {a[0] for a in server.asked} == {int(address, 0)}


def test_units_above_247_are_refused_on_a_line(tmp_path):
    (tmp_path / "d.yaml").write_text(
        f"{HEAD}bus: modbus\nmodbus: {{unit_id: 1}}\nchannels:\n  t: {{register: 0, unit: degC, {READ}}}\n"
    )
    for port in ("rtu:/dev/x", "rtu:socket://a:1"):
        with pytest.raises(InputError, match="address: 248 is outside 0 .. 247"):
            bind(
                yamlfile.loads(f"{{profile: d.yaml, port: '{port}', address: 248, roles: {{t: air_c}}}}"),
                tmp_path,
            )


@pytest.mark.parametrize(
    "exponent,value", [(-1, 234.5), (0, 2345.0), (0xFFFE, 23.45), (1, 23450.0), (0x8000, None), (11, None)]
)
def test_sunspec_scale_registers(made, exponent, value):
    known = REGISTERS | {1: exponent}
    device, server = made(honest, "0 100", known, ", scale_register: 1")
    sample = Sample()
    device.connect()
    device.poll(sample)
    if value is None:
        assert sample.status[AIR] == ERROR and "scale register" in device.problems[AIR]
    else:
        assert sample.value[AIR] == pytest.approx(value * 0.01)
    assert sample.value[VOLTAGE] == pytest.approx(7.77)
    del server.registers[1]
    if value is not None:
        device.poll(sample)
        assert sample.status[AIR] == OK


@pytest.mark.parametrize(
    "kind,sentinels,word,status",
    [
        ("int16", "[-32768]", 0x8000, ERROR),
        ("int16", "[0x8000]", 0x8000, ERROR),
        ("uint16", "['0xFFFF']", 0xFFFF, ERROR),
        ("uint16", "[65535, 65534]", 0xFFFE, ERROR),
        ("int16", "[-32768]", 0x7FFF, OK),
        ("uint16, low_bit: 4, bits: 8, signed: true", "[0x80]", 0x0801, ERROR),
        ("bcd16", "[9999]", 0x9999, ERROR),
        ("uint64", "[0xFFFFFFFFFFFFFFFF]", 0xFFFF, ERROR),
        ("uint64", "[18446744073709551615]", 0xFFFF, ERROR),
        ("int64", "[0xFFFFFFFFFFFFFFFF]", 0xFFFF, ERROR),
        ("int64", "[0x7FFFFFFFFFFFFFFF]", 0x8000, OK),
    ],
)
def test_sentinels_are_raw_numbers(made, kind, sentinels, word, status):
    known = {0: word, 1: word, 2: word, 3: word, 100: 1}
    device, _ = made(honest, "0 100", known, f", type: {kind}, sentinels: {sentinels}")
    sample = Sample()
    device.connect()
    device.poll(sample)
    assert sample.status[AIR] == status


@pytest.mark.parametrize(
    "kind,sentinel,words",
    [
        ("int16", "32768", r"-32768 \.\. 32767; its bits 0x8000 are read as -32768"),
        ("uint16", "-1", r"0 \.\. 65535; its bits 0xFFFF are read as 65535"),
        ("int16", "0x10000", "cannot come"),
        ("int16", "327.67", "cannot come"),
        ("uint32", "4294967296", "cannot come"),
        ("bcd16", "10000", "4 digits"),
        ("uint16, low_bit: 0, bits: 12", "4096", r"0 \.\. 4095"),
        ("float32", "1e39", "no float of 32 bits"),
    ],
)
def test_a_sentinel_that_the_type_cannot_hold_is_refused(made, kind, sentinel, words):
    with pytest.raises(InputError, match=rf"d\.yaml:\d+:\d+: sentinels: .*{words}"):
        made(honest, "0 100", more=f", type: {kind}, sentinels: [{sentinel}]")


@pytest.mark.parametrize("text,status", [("", ERROR), (", range: [-1e38, 1e38]", OK)])
@pytest.mark.parametrize("number", [9.9e37, 9.91e37, -9.9e37, 3.0e38])
def test_9_9e37_is_no_reading_unless_the_profile_says_so(made, text, status, number):
    words = struct.unpack(">2H", struct.pack(">f", number))
    known = {0: words[0], 1: words[1], 100: 1}
    device, _ = made(honest, "0 100", known, f", type: float32{text}")
    sample = Sample()
    device.connect()
    device.poll(sample)
    expected = status if abs(number) < 1e38 or status == ERROR else OK  # scaled by 0.01 it is inside
    assert sample.status[AIR] == expected
    if status == ERROR:
        assert "overload, or no value" in device.problems[AIR]


class RtuLine:
    """A unit at a serial line; `spoil`: (request, answer) -> bytes sent; every request may be echoed before."""

    def __init__(self, spoil):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        tty.setraw(self.master)
        self.spoil, self.done = spoil, False
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        data = b""
        while not self.done:
            if not select.select([self.master], [], [], 0.05)[0]:
                continue
            data += os.read(self.master, 256)
            while len(data) >= 8 and modbus_crc(data[:6]) == data[6:8]:
                request, data = data[:8], data[8:]
                function, address, count = struct.unpack(">BHH", request[1:6])
                words = [REGISTERS[address + k] for k in range(count)] if function == 3 else []
                body = request[:2] + (
                    struct.pack(f">B{count}H", 2 * count, *words) if words else request[2:6]
                )
                os.write(self.master, self.spoil(request, body + modbus_crc(body)))


@pytest.fixture
def line():
    lines = []

    def make(spoil):
        lines.append(RtuLine(spoil))
        return links.join(f"rtu:{os.ttyname(lines[-1].slave)}", LineSettings(latency_timer_ms=0), 0.2)

    make.lines = lines
    yield make
    for made_line in lines:
        made_line.done = True
    for link in list(links._LINKS.values()):
        links.leave(link)


@pytest.mark.parametrize("late_s", [0.22, 0.3, 0.38])
def test_a_unit_that_is_always_late_gives_no_register_for_another(line, late_s):
    """An RTU answer names no register: that to the request before would be the answer to the next one."""

    def late(request, answer):
        time.sleep(late_s)  # the unit's own slowness, longer than the time-out
        return answer

    link, found = line(late), []
    for register in (0, 8, 100, 0, 8, 100):
        with contextlib.suppress(links.NoAnswer):
            found.append((register, link.read("holding", register, 1, 1, 0.2)))
    assert [f for f in found if f[1] != [REGISTERS[f[0]]]] == []
    assert link.read("holding", 8, 1, 1, 1.0) == [888]  # with a time-out that is long enough


def refuses_function_8(request, answer):
    body = request[:1] + b"\x88\x01"
    return body + modbus_crc(body) if request[1] == 8 else answer


KNOWS_FUNCTION_8 = {"echoes": lambda request, answer: answer, "refuses": refuses_function_8}


@pytest.mark.parametrize("spoil", KNOWS_FUNCTION_8.values(), ids=KNOWS_FUNCTION_8)
@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("late_s", [0.12, 0.25, 0.35])
def test_an_answer_later_than_twice_the_timeout_is_no_other_register(line, spoil, echo, late_s):
    """A unit that writes its memory answers once after 3.5 times `timeout_s`."""
    delays = []

    def late(request, answer):
        time.sleep(delays.pop() if delays else 0.0)  # the unit's own slowness
        return (request if echo else b"") + spoil(request, answer)

    link, found = line(late), []
    for _ in range(3):
        delays.append(late_s)
        for register in (0, 8, 100, 0, 8, 100, 8):
            with contextlib.suppress(links.NoAnswer):
                found.append((register, link.read("holding", register, 1, 1, 0.1)))
    assert [f for f in found if f[1] != [REGISTERS[f[0]]]] == [] and len(found) >= 9


def test_a_late_answer_is_remembered_while_other_units_are_asked(line):
    """Unit 1 is late, unit 2 answers at once: unit 1's answer must not become that to its next register."""
    delays = []

    def late(request, answer):
        if request[0] == 1:
            time.sleep(delays.pop() if delays else 0.0)  # the unit's own slowness
        return answer

    link = line(late)
    assert link.read("holding", 0, 1, 1, 0.1) == [2345]
    delays.append(0.13)
    with pytest.raises(links.NoAnswer):
        link.read("holding", 0, 1, 1, 0.1)
    with contextlib.suppress(links.NoAnswer):
        link.read("holding", 8, 1, 2, 0.02)
    with contextlib.suppress(links.NoAnswer):
        assert link.read("holding", 8, 1, 1, 0.1) == [888]


@pytest.mark.parametrize("zeros", [b"", b"\0", b"\0\0\0", b"\xff\0"])
@pytest.mark.parametrize("echo", [False, True])
def test_an_echo_and_zeros_before_an_rtu_answer_are_passed_over(line, zeros, echo):
    link = line(lambda request, answer: (request if echo else b"") + zeros + answer)
    for _ in range(3):
        assert link.read("holding", 100, 1, 1, 0.5) == [777]
    assert link.write(6, 5, [7], 1, 0.5) == 0


def test_the_echo_of_a_write_is_no_confirmation(line):
    mute = []
    link = line(lambda request, answer: request + (b"" if mute else answer))
    assert link.read("holding", 0, 1, 1, 0.5) == [2345]
    mute.append(True)
    with pytest.raises(links.NoAnswer, match="only the echo of the request came back"):
        link.write(6, 5, [7], 1, 0.2)


@pytest.mark.parametrize(
    "spoil,words",
    [
        (
            lambda r, a: b"\x09" + a[1:-2] + modbus_crc(b"\x09" + a[1:-2]),
            "of unit 9, unit 1 was asked: check 'address'",
        ),
        (
            lambda r, a: b"\x01\x04\x02\x00\x01" + modbus_crc(b"\x01\x04\x02\x00\x01"),
            "function 4, 3 was asked for: check 'kind'",
        ),
        (lambda r, a: a[:-1] + bytes((a[-1] ^ 1,)), "wrong CRC, or cut short: check the baud rate"),
        (lambda r, a: b"", "no answer within"),
    ],
)
def test_a_wrong_rtu_answer_names_what_is_wrong(line, spoil, words):
    with pytest.raises(links.NoAnswer, match=words):
        line(spoil).read("holding", 0, 1, 1, 0.2)


def test_an_rtu_exception_behind_an_echo_is_its_code(line):
    body = b"\x01\x83\x02"
    assert line(lambda r, a: r + body + modbus_crc(body)).read("holding", 0, 1, 1, 0.5) == 2


def read_frame(unit, address, count=1):
    body = struct.pack(">BBHH", unit, 3, address, count)
    return body + modbus_crc(body)


def answer_frame(unit, value):
    body = struct.pack(">BBBH", unit, 3, 2, value)
    return body + modbus_crc(body)


@pytest.mark.parametrize("unit", [1, 9], ids=["our unit", "another unit"])
def test_the_answer_to_another_master_is_not_taken(line, unit):
    """An answer names no register: its value was taken for ours."""
    strange = [read_frame(unit, 40) + answer_frame(unit, 6000)]
    link = line(lambda request, answer: (strange.pop() if strange else b"") + answer)
    with pytest.raises(links.NoAnswer, match=f"another master asks unit {unit} on this line"):
        link.read("holding", 0, 1, 1, 0.2)
    with contextlib.suppress(links.NoAnswer):  # function 8 clears the line first
        assert link.read("holding", 0, 1, 1, 0.2) == [2345]
    assert link.read("holding", 0, 1, 1, 0.2) == [2345]


def test_an_answer_before_the_request_of_another_master_is_ours(line):
    strange = read_frame(1, 40) + answer_frame(1, 6000)
    link = line(lambda request, answer: answer + strange)
    for _ in range(3):
        assert link.read("holding", 0, 1, 1, 0.5) == [2345]


def test_a_request_waits_for_the_answer_to_another_master(line):
    """Another master had asked just before; its answer came behind our request."""

    answered = threading.Event()
    answered.set()

    def in_turn(request, answer):
        answered.wait(1.0)  # a unit answers one request after the other
        return answer

    link = line(in_turn)
    assert link.read("holding", 0, 1, 1, 0.5) == [2345]
    master, slave = line.lines[-1].master, line.lines[-1].slave
    answered.clear()
    os.write(master, read_frame(1, 40))
    assert select.select([slave], [], [], 1.0)[0]  # the other request is on the line

    def answer_other():
        os.write(master, answer_frame(1, 6000))
        answered.set()

    threading.Timer(0.03, answer_other).start()
    assert link.read("holding", 0, 1, 1, 0.5) == [2345]
