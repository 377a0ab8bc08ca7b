"""Modbus devices that lose, spoil and refuse answers: what the driver makes of it (issue 21, B3 and B13).

The other end is written from the protocol's description with its own framing, over TCP and over a serial line.
"""

import contextlib
import os
import select
import socket
import struct
import threading
import time
import tty

import pytest

from tests.devices.emulators import modbus_crc
from thermoctl.files import yamlfile
from thermoctl_hal.base.backend import ABSENT, ERROR, OK, ROLE, STALE, HardwareError, Sample
from thermoctl_hal.modbus.device import LOST_POLLS, ModbusDevice
from thermoctl_hal.profiles.bind import bind
from thermoctl_hal.rig.board import Board
from thermoctl_hal.rig.devices import DevicesBackend
from thermoctl_hal.rig.poller import poll_until

COIL, AIR, SHAFT = (ROLE[r] for r in ("coil_c", "air_c", "shaft_1_c"))
PROFILE = """
format: thermoctl-device/1
vendor: test
model: module
bus: modbus
modbus: {{unit_id: 7, timeout_s: 0.1, max_gap: {gap}}}
channels:
  a: {{register: 10, scale: 0.1, unit: degC, range: [-50, 300], rate_hz: 100, stale_after_s: {stale}, sentinels: [32767]}}
  b: {{register: 11, scale: 0.1, unit: degC, range: [-50, 300], rate_hz: 100, stale_after_s: {stale}}}
  c: {{register: {far}, scale: 0.1, unit: degC, range: [-50, 300], rate_hz: 100, stale_after_s: {stale}}}
"""
ROLES = "{a: coil_c, b: air_c, c: shaft_1_c}"


class Module:
    """Registers behind TCP or a serial line. `answers` are taken first, one a request: a function (pdu) -> bytes of the
    answer's PDU, or what was put in as bytes; b'' is no answer."""

    def __init__(self, tcp):
        self.registers = {10: 215, 11: 220, 12: 0, 13: 0, 14: 301, 40001: 5, 40002: 6}
        self.answers, self.asked, self.tcp, self.unit = [], [], tcp, 7
        self.spoil = lambda frame: frame
        self.done = False
        if tcp:
            self.server = socket.create_server(("127.0.0.1", 0))
            self.port = f"tcp:127.0.0.1:{self.server.getsockname()[1]}"
        else:
            self.master, self.slave = os.openpty()
            tty.setraw(self.slave)
            self.port = f"rtu:{os.ttyname(self.slave)}"
        self.thread = threading.Thread(target=self.serve_tcp if tcp else self.serve_line, daemon=True)
        self.thread.start()

    def pdu(self, request):
        self.asked.append(request)
        if self.answers:
            answer = self.answers.pop(0)
            return answer(request) if callable(answer) else answer
        return self.honest(request)

    def honest(self, request):
        function, address, count = struct.unpack(">BHH", request)
        wanted = range(address, address + count)
        if function != 4 or any(k not in self.registers for k in wanted):
            return bytes((function | 0x80, 2))
        return struct.pack(f">BB{count}H", function, 2 * count, *(self.registers[k] for k in wanted))

    def serve_tcp(self):
        while not self.done:
            try:
                client, _ = self.server.accept()
            except OSError:
                return
            self.client = client
            with client, contextlib.suppress(ConnectionError):
                while head := client.recv(7):
                    body = client.recv(struct.unpack(">HHHB", head)[2] - 1)
                    if answer := self.pdu(body):
                        frame = head[:4] + struct.pack(">HB", len(answer) + 1, self.unit) + answer
                        client.sendall(self.spoil(frame))

    def serve_line(self):
        while not self.done:
            if select.select([self.master], [], [], 0.05)[0]:
                request = b""
                while len(request) < 8:
                    request += os.read(self.master, 8 - len(request))
                assert modbus_crc(request[:6]) == request[6:]
                if answer := self.pdu(request[1:6]):
                    frame = bytes((self.unit,)) + answer
                    os.write(self.master, self.spoil(frame + modbus_crc(frame)))

    def close(self):
        self.done = True
        if self.tcp:
            self.server.close()


@pytest.fixture(params=["tcp", "rtu"])
def module(request):
    m = Module(request.param == "tcp")
    yield m
    m.close()


@pytest.fixture
def connect(tmp_path, module):
    devices = []

    def make(stale=3.0, gap=8, far=14):
        (tmp_path / "module.yaml").write_text(PROFILE.format(stale=stale, gap=gap, far=far))
        node = f"{{name: m, profile: module.yaml, port: '{module.port}', roles: {ROLES}}}"
        devices.append(ModbusDevice(bind(yamlfile.loads(node), tmp_path)))
        return devices[-1]

    yield make
    for d in devices:
        d.disconnect()


@pytest.fixture
def device(connect):
    d = connect()
    d.connect()
    return d


@pytest.fixture
def sample(device):
    """Good readings of all three channels."""
    s = Sample()
    device.poll(s)
    assert list(s.value[[COIL, AIR, SHAFT]]) == pytest.approx([21.5, 22.0, 30.1])
    return s


def held(sample):
    return all(sample.status[k] == OK for k in (COIL, AIR, SHAFT)) and sample.value[COIL] == pytest.approx(
        21.5
    )


@pytest.mark.parametrize("times", [1, LOST_POLLS - 1])
def test_lost_answers_leave_the_values_standing(module, device, sample, times):
    module.answers = [b""] * times
    module.registers[10] = 999
    for _ in range(times):
        device.poll(sample)
        assert held(sample)
    assert device.counters()["lost"] == times
    assert "input registers 10..14: no answer within 0.1 s" in device.problems[COIL]
    device.poll(sample)
    assert sample.value[COIL] == pytest.approx(99.9) and COIL not in device.problems


def test_silence_for_long_opens_the_link_again(module, device, sample):
    module.answers = [b""] * LOST_POLLS
    with pytest.raises(HardwareError, match="no answer within"):
        for _ in range(LOST_POLLS):
            device.poll(sample)
    assert held(sample)


@pytest.mark.parametrize("code", [5, 6])
def test_a_busy_device_is_asked_again_at_once(module, device, sample, code):
    module.answers = [bytes((0x84, code))] * 2
    module.registers[10] = 999
    device.poll(sample)
    assert sample.value[COIL] == pytest.approx(99.9) and device.counters()["errors"] == 2


@pytest.mark.parametrize(
    "code,words", [(4, "failure of its own"), (6, "busy"), (8, "memory"), (11, "behind the gateway")]
)
def test_one_exception_leaves_the_values_standing(module, device, sample, code, words):
    module.answers = [bytes((0x84, code))] * 3
    device.poll(sample)
    assert held(sample)
    assert f"exception {code} (" in device.problems[AIR] and words in device.problems[AIR]
    assert "register map" not in device.problems[AIR]


def test_an_exception_that_lasts_is_the_channels_error(module, connect):
    device, sample = connect(stale=0.2), Sample()
    device.connect()
    device.poll(sample)
    module.answers = [b"\x84\x04"] * 10_000
    begin = time.monotonic()
    while sample.status[COIL] != ERROR:
        device.poll(sample)
        assert time.monotonic() - begin < 10
    assert time.monotonic() - begin > 0.15
    module.answers = []
    device.poll(sample)
    assert held(sample)


def test_an_illegal_register_is_named_and_takes_no_other_along(module, device, sample):
    del module.registers[11], module.registers[12]
    module.registers[10] = 999
    fresh = Sample()
    for _ in range(2):
        device.poll(fresh)
        assert fresh.value[COIL] == pytest.approx(99.9) and fresh.status[COIL] == fresh.status[SHAFT] == OK
        assert fresh.status[AIR] == ERROR
    assert (
        "m b: input register 11: exception 2 (illegal register address): check 'register' and 'kind'"
        in device.problems[AIR]
    )
    module.asked.clear()
    device.poll(fresh)
    assert len(module.asked) == 3  # the good ones in one request each side of the gap, the bad one alone
    module.registers |= {11: 230}
    device.poll(fresh)
    assert fresh.status[AIR] == OK and fresh.value[AIR] == pytest.approx(23.0)


def test_a_device_that_refuses_gaps_is_read_without_them(module, device):
    del module.registers[12], module.registers[13]
    sample = Sample()
    device.poll(sample)
    assert held(sample) and not device.problems
    module.asked.clear()
    device.poll(sample)
    assert [struct.unpack(">BHH", r)[1:] for r in module.asked] == [(10, 2), (14, 1)]


def test_a_manuals_register_number_gets_a_hint(module, connect):
    device, sample = connect(far=40003), Sample()
    device.connect()
    device.poll(sample)
    assert sample.status[SHAFT] == ERROR and sample.status[COIL] == OK
    assert "kind: holding, register: 2" in device.problems[SHAFT]


def test_an_open_sensor_is_an_error_at_once_and_its_channels_only(module, device, sample):
    module.registers[10] = 32767
    device.poll(sample)
    assert sample.status[COIL] == ERROR and sample.status[AIR] == OK
    assert "register 10 reads 32767: open or missing sensor" in device.problems[COIL]


@pytest.mark.parametrize(
    "spoil,rtu_words,tcp_words",
    [
        (lambda f: f[:-1] + bytes((f[-1] ^ 1,)), "with a wrong CRC", None),
        (lambda f: f[: len(f) // 2], "wrong CRC, or cut short", "cut short"),
        (lambda f: os.urandom(20), "no ", "no "),
    ],
)
def test_damaged_answers_leave_the_values_standing(module, device, sample, spoil, rtu_words, tcp_words):
    words = tcp_words if module.tcp else rtu_words
    if words is None:
        return  # TCP has no checksum of its own
    module.spoil = spoil
    device.poll(sample)
    assert held(sample) and words in device.problems[COIL]


@pytest.mark.parametrize(
    "answer", [b"\x04\x04\x00\x01\x00\x02", b"\x03\x0a" + bytes(10), b"\x2b\x0e", b"\x04"]
)
def test_a_foreign_answer_is_no_reading(module, device, sample, answer):
    """Too few registers, another function, another protocol."""
    module.answers = [answer]
    device.poll(sample)
    assert held(sample) and device.problems[COIL]


def test_the_answer_of_another_unit_is_no_reading(module, device, sample):
    module.unit = 9
    device.poll(sample)
    assert held(sample)
    if not module.tcp:
        assert "unit 9, unit 7 was asked" in device.problems[COIL]


def test_a_late_answer_is_not_taken_for_the_next_blocks(module, connect):
    """Two blocks of one register count: the answer to the first comes when it is no longer waited for."""
    module.registers |= {60: 777, 61: 0}
    device, sample = connect(far=60, gap=0), Sample()
    device.connect()
    device._blocks = [b for b in device._blocks]
    device.poll(sample)
    assert sample.value[SHAFT] == pytest.approx(77.7)

    def late(request):
        time.sleep(0.13)  # the device's own slowness, longer than timeout_s
        return module.honest(request)

    for _ in range(4):
        module.answers = [late]
        device.poll(sample)
        time.sleep(0.05)  # until it has come
        device.poll(sample)
        device.poll(sample)
        assert [sample.value[k] for k in (COIL, AIR, SHAFT)] == pytest.approx([21.5, 22.0, 77.7])


class Polled:
    """The back end over a poller thread, as in the daemon."""

    def __init__(self, device, stale):
        self.backend = DevicesBackend([], [device], Board.private())
        self.backend.open()
        self.stop = threading.Event()
        self.thread = threading.Thread(target=poll_until, args=([device], self.backend.board, self.stop))
        self.seen = set()
        self.thread.start()

    def until(self, condition, limit_s=10.0):
        begin = time.monotonic()
        while True:
            sample = self.backend.read(time.monotonic())
            self.seen |= {int(sample.status[k]) for k in (COIL, AIR, SHAFT)}
            if condition(sample):
                return sample
            assert time.monotonic() - begin < limit_s, self.backend.problem("coil_c")
            time.sleep(0.001)

    def close(self):
        self.stop.set()
        self.thread.join(5)
        self.backend.close()


def test_a_connection_that_is_gone_for_a_second_is_not_seen_by_the_loop(connect, module):
    """Status by status: between the poller's posts and the loop's ticks no other than OK is ever seen (once it is)."""
    polled = Polled(connect(), 3.0)
    try:
        polled.until(lambda s: s.status[COIL] == s.status[SHAFT] == OK)
        polled.seen.clear()
        first = polled.backend.sample.time_s[COIL]
        module.answers = [b""] * 4 + [b"\x84\x06"] * 4 + [b"\x84\x04"] * 2
        if module.tcp:
            module.client.shutdown(socket.SHUT_RDWR)
        polled.until(lambda s: not module.answers and s.time_s[COIL] > first + 0.3)
        assert polled.seen == {OK}
        counts = polled.backend.counters()
        assert counts["m.lost"] >= 3 and counts["m.errors"] >= 4 and counts["m.frames"] >= 2
        assert counts["m.reconnections"] >= 1
    finally:
        polled.close()


def test_silence_is_told_through_the_board_and_no_channel_is_ever_absent(connect, module):
    module.answers = [b""] * 10_000
    polled = Polled(connect(stale=0.3), 0.3)
    try:
        polled.until(lambda s: "no answer within" in polled.backend.problem("coil_c"))
        assert polled.seen == {STALE} and ABSENT not in polled.seen
        text = polled.backend.problem("coil_c")
        assert text.startswith("m a: ") and text.count("m a: ") == 1 and text.count(module.port) <= 1
        module.answers = []
        polled.until(lambda s: s.status[COIL] == OK)
        assert polled.backend.problem("coil_c") == ""
    finally:
        polled.close()
