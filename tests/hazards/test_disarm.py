"""From `disarm`, and from a fault, to the safe command on the wire, while devices beside the drive are dead.

The daemon is a process of its own; drive, encoders and thermometers are emulated at their wires. What is
timed is the arrival of the command at the drive, in several phases of its neighbours' time limits.
"""

import contextlib
import math
import multiprocessing
import os
import socket
import struct
import threading
import time

import psutil
import pytest

from tests.daemon.process import Daemon, wait
from tests.devices.emulators import ModbusLine, Port, SlcanAdapter, encode, free_port, modbus_crc
from tests.devices.test_drives import AXIS_DBC, Drive, modbus
from tests.hal.conftest import make_settings
from tests.hazards.harness import ROWS, Row
from tests.rigs.wire import HEAD, SENSED, TORQUE, WireRig
from thermoctl.files import yamlfile
from thermoctl_hal.base.backend import HardwareError, Sample
from thermoctl_hal.modbus import link as links
from thermoctl_hal.profiles.bind import bind
from thermoctl_hal.rig.board import Board
from thermoctl_hal.rig.make import disable_amplifier, driver, driving_devices
from thermoctl_hal.rig.poller import run_poller

PHASES = 8
STOP_S = 2.5
ANSWER_S = 0.4  # time limit of the dead units, below the 0.5 s in which the drive has to answer
SPARE = [f"spare_{k}" for k in range(1, 4)]
THERMOMETER = f"""{HEAD}bus: modbus
modbus: {{timeout_s: {ANSWER_S}}}
channels:
  t0: {{register: 0, type: int16, scale: 0.01, unit: degC, range: [-50, 200], rate_hz: 20, stale_after_s: 3}}
"""
METER = f"""{HEAD}bus: serial-lines
text: {{pattern: '(?P<t>[-0-9.]+)$', request: 'T?', request_hz: 10}}
channels:
  t0: {{field: t, unit: degC, range: [-50, 200], rate_hz: 10, stale_after_s: 3}}
"""


def dead_host(stack, kind):
    """Return the port of a host that refuses, whose connection is never made, or that never answers."""
    if kind == "refused":
        return free_port()
    listener = stack.enter_context(socket.socket())
    listener.bind(("127.0.0.1", 0))
    listener.listen(0 if kind == "black hole" else 64)
    for _ in range(3 if kind == "black hole" else 0):  # the backlog is full: the next one waits
        waiting = stack.enter_context(socket.socket())
        waiting.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            waiting.connect(listener.getsockname())
    return listener.getsockname()[1]


class Neighbours:
    """A rig of one axis with dead devices beside its drive, and its daemon.

    servo: '' for a drive on CAN; rtu, tcp: a unit of a Modbus line or gateway."""

    def __init__(self, folder, dead, servo):
        self.stack = contextlib.ExitStack()
        self.rig = WireRig(folder, {"": ("coil", "bench", *SPARE)})
        self.stack.callback(self.rig.close)
        self.rig.registers = self.rig.registers[:3]
        (folder / "thermometer.yaml").write_text(THERMOMETER)
        (folder / "meter.yaml").write_text(METER)
        self.axis = self.rig.axes[""]
        lines = self.rig.devices().splitlines()
        if servo:
            lines[:1] = self.servo(folder, servo)
        lines += [f"    - {self.dead(folder, kind, k)}" for k, kind in enumerate(dead)]
        self.rig.devices = lambda: "\n".join(lines)
        self.safe_s, self.sense, drive = 0.0, self.axis.plant.sense, self.axis.torque
        request = drive.request

        def noted(state):
            """Note the first command that disables."""
            if state == 1 and drive.state == 8:
                self.safe_s = time.monotonic()
            request(state)

        drive.request = noted
        self.daemon = Daemon(self.rig.rig_file())
        self.stack.callback(self.daemon.kill)

    def servo(self, folder, kind):
        """Return the devices of a drive on a Modbus port; the encoders stay on CAN."""
        drive, wire, profile, self.port, report = modbus(folder)
        if kind == "tcp":
            wire.close()
            wire = Port(ModbusLine({3: wire.take.__self__.units[3]}, False).take)
            self.port = f"tcp:127.0.0.1:{wire.number}"
        self.wire = wire
        self.stack.callback(wire.close)
        (folder / "servo.yaml").write_text(profile)
        self.axis.torque, frames = drive, self.axis.frames
        self.axis.frames = lambda: [report(), frames()][1]
        sensed = ", ".join(f"{c}: {r}" for c, r in SENSED.items())
        return [
            f"    - {{name: drive, profile: servo.yaml, port: '{self.port}', address: 3, "
            "roles: {axis: amplifier_state, error: amplifier_fault}}",
            f"    - {{name: encoders, profile: encoders.yaml, port: 'slcan:{folder}/can@1000000', address: 3, "
            f"roles: {{{sensed}}}}}",
        ]

    def dead(self, folder, kind, k):
        """Return the item of a dead device."""
        if kind in ("silent", "unplugged"):
            if kind == "silent":
                self.stack.callback(Port(lambda data: b"", folder / f"meter{k}").close)
            return f"{{name: dead{k}, profile: meter.yaml, port: {folder}/meter{k}, roles: {{t0: {SPARE[k]}_c}}}}"
        port, address = self.port if kind == "unit" else "", 10 + k
        port = port or f"tcp:127.0.0.1:{dead_host(self.stack, kind)}"
        return f"{{name: dead{k}, profile: thermometer.yaml, port: '{port}', address: {address}, roles: {{t0: {SPARE[k]}_c}}}}"

    def worst_s(self, stop):
        """Return the longest time from `stop` to the safe command at the drive."""
        found = []
        for phase in range(PHASES):
            self.axis.plant.sense = self.sense
            self.daemon.armed()
            wait(lambda: self.axis.torque.state == 8, "driven")
            ticks = self.daemon.ask("status")["ticks"] + 30 + 13 * phase  # of 10 ms
            wait(lambda last=ticks: self.daemon.ask("status")["ticks"] > last, "another phase")
            begin = time.monotonic()
            stop()
            wait(lambda since=begin: self.safe_s > since, "the safe command")
            found.append(self.safe_s - begin)
        return max(found)

    def disarm(self):
        assert self.daemon.ask("disarm")["ok"]

    def fault(self):
        """Let the encoder read far outside its range."""
        self.axis.plant.sense = lambda role: 1.5e6 if role == "position_um" else self.sense(role)


CASES = {
    "drive on CAN, all alive": ([], ""),
    "drive on CAN; a serial meter silent, one unplugged": (["silent", "unplugged"], ""),
    "drive on CAN; Modbus hosts refused, black-holed, half-open": (
        ["refused", "black hole", "half-open"],
        "",
    ),
    "drive on Modbus RTU, all alive": ([], "rtu"),
    "drive on Modbus RTU; a unit of its line silent": (["unit"], "rtu"),
    "drive on Modbus RTU; three units of its line silent": (["unit"] * 3, "rtu"),
    "drive on Modbus TCP; hosts refused, black-holed, half-open": (
        ["refused", "black hole", "half-open"],
        "tcp",
    ),
    "drive on Modbus TCP; three units of its gateway silent": (["unit"] * 3, "tcp"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_disarm_waits_for_no_neighbour(tmp_path, case):
    rig = Neighbours(tmp_path, *CASES[case])
    with rig.stack:
        disarm_s, fault_s = rig.worst_s(rig.disarm), rig.worst_s(rig.fault)
        assert max(disarm_s, fault_s) < ANSWER_S / 2
        begin = time.monotonic()
        assert rig.daemon.stop() == 0
        stop_s = time.monotonic() - begin
    assert stop_s < STOP_S
    figures = f"disarm {disarm_s * 1e3:.0f} ms, fault {fault_s * 1e3:.0f} ms; daemon ended in {stop_s:.1f} s"
    ROWS.append(Row("Disarm", case, f"{ANSWER_S / 2 * 1e3:.0f} ms", figures, "safe command at the drive", ""))


@pytest.mark.parametrize("kind", ["black hole", "half-open"])
def test_a_poller_that_drives_nothing_ends_soon(tmp_path, kind, monkeypatch):
    """Its host has 8 s to answer, and was silent at several connections already."""
    with contextlib.ExitStack() as stack:
        port = f"tcp:127.0.0.1:{dead_host(stack, kind)}"
        (tmp_path / "thermometer.yaml").write_text(THERMOMETER.replace(f"{ANSWER_S}", "8"))
        node = f"{{name: dead, profile: thermometer.yaml, port: '{port}', roles: {{t0: coil_c}}}}"
        monkeypatch.setitem(links._SILENT, port, len(links.SETTLE_S) - 1)
        device = driver(bind(yamlfile.loads(node), tmp_path))
        board = Board.create(f"thermoctl-test-{os.getpid()}", len(device.binding.channels.names))
        stack.callback(board.close)
        poller = multiprocessing.get_context("fork").Process(target=run_poller, args=([device], board.name))
        poller.start()
        wait(psutil.Process(poller.pid).net_connections, "its connection")
        begin = time.monotonic()
        poller.terminate()
        poller.join(9)
        assert time.monotonic() - begin < 2.0


def test_a_poller_that_is_asked_twice_to_end_disables_its_drive(tmp_path):
    """The supervisor asks every helper, then each again. Before, the second signal could stop it for good."""
    drive, wire, profile, port, _ = modbus(tmp_path)
    (tmp_path / "servo.yaml").write_text(profile)
    node = f"{{name: drive, profile: servo.yaml, port: '{port}', address: 3, roles: {{axis: amplifier_state, error: amplifier_fault}}}}"
    device = driver(bind(yamlfile.loads(node), tmp_path))
    board = Board.create(f"thermoctl-test-{os.getpid()}", len(device.binding.channels.names))
    with contextlib.closing(wire), contextlib.closing(board):
        for _ in range(10):
            poller = multiprocessing.get_context("fork").Process(
                target=run_poller, args=([device], board.name)
            )
            polls = board.beat(device.roles)
            poller.start()
            wait(lambda polls=polls: board.beat(device.roles) > polls, "the first poll")
            drive.request(8)
            for _ in range(100):
                poller.terminate()
                time.sleep(1e-4)
            poller.join(5.0)
            poller.kill()
            assert poller.exitcode == 0 and drive.state == 1


def test_the_supervisor_disables_a_drive_beside_one_on_a_dead_host(tmp_path):
    """The loop is gone; the first drive's host makes no connection for its time limit of a second."""
    heard, drive = threading.Event(), Drive()
    (tmp_path / "axis.dbc").write_text(AXIS_DBC)
    channels = TORQUE.index("  position:")
    (tmp_path / "torque.yaml").write_text(TORQUE[:channels].replace("axis.dbc", str(tmp_path / "axis.dbc")))
    wire = modbus(tmp_path)[1:3]
    (tmp_path / "servo.yaml").write_text(wire[1])

    def node(frame):
        if frame[0] == 3 << 5 | 7 and struct.unpack("<I", frame[2])[0] == 1:
            heard.set()
        return [(3 << 5 | 1, False, struct.pack("<IB3x", 0, drive.state))]

    can = Port(SlcanAdapter(node).take, tmp_path / "can")
    with contextlib.ExitStack() as stack:
        stack.callback(can.close)
        stack.callback(wire[0].close)
        text = (
            f"[{{name: dead, profile: {tmp_path}/servo.yaml, port: 'tcp:127.0.0.1:{dead_host(stack, 'black hole')}', "
            "roles: {axis: amplifier_state, error: amplifier_fault}}, "
            f"{{name: alive, profile: {tmp_path}/torque.yaml, port: 'slcan:{tmp_path}/can', address: 3, "
            "roles: {state: amplifier_state, error: amplifier_fault}}]"
        )
        settings = make_settings(tmp_path, backend="devices", devices=tuple(yamlfile.loads(text).value))
        driving_devices(settings)  # loads the libraries, as the start of the daemon does
        failed = []

        def act():
            try:
                disable_amplifier(settings)
            except HardwareError as e:
                failed.append(str(e))

        begin, thread = time.monotonic(), threading.Thread(target=act)
        thread.start()
        assert heard.wait(10)
        took_s = time.monotonic() - begin
        thread.join()
        assert took_s < 0.9 and len(failed) == 1 and failed[0].startswith("dead: tcp:")
    ROWS.append(
        Row(
            "Disarm",
            "loop killed; the first of two drives on a black-holed host",
            "0.9 s",
            f"the other's command after {took_s * 1e3:.0f} ms",
            "by the supervisor",
            f"`{failed[0][:60]}`",
        )
    )


@pytest.mark.parametrize("code", [5, 6])
def test_a_busy_unit_takes_the_safe_command_at_the_next_try(tmp_path, code):
    """Before, one such answer lost the drive, and two delayed the safe command from 6 ms to 254 ms."""
    drive, wire, profile, port, _ = modbus(tmp_path)
    (tmp_path / "servo.yaml").write_text(profile)
    node = f"{{name: drive, profile: servo.yaml, port: '{port}', address: 3, roles: {{axis: amplifier_state, error: amplifier_fault}}}}"
    device, honest, busy = driver(bind(yamlfile.loads(node), tmp_path)), wire.take, [0]

    def take(data):
        if busy[0] and data[1:2] in (b"\x06", b"\x10"):
            busy[0] -= 1
            answer = bytes((data[0], data[1] | 0x80, code))
            return answer + modbus_crc(answer)
        return honest(data)

    wire.take = take
    with contextlib.closing(wire):
        device.connect()
        drive.request(8)
        busy[0] = 2
        device.write(0.0, False, time.monotonic())
        assert drive.state == 1 and not busy[0]
        busy[0] = 3
        device.sequencer.send_again()
        with pytest.raises(HardwareError, match=f"exception {code} "):
            device.write(0.0, False, time.monotonic())
        device.disconnect()


@pytest.mark.parametrize("end", ["disconnect", "switch_off"])
def test_a_drive_without_valid_answers_gets_every_message_that_disables(tmp_path, end):
    drive, wire, profile, port, _ = modbus(tmp_path)
    (tmp_path / "servo.yaml").write_text(profile)
    node = f"{{name: drive, profile: servo.yaml, port: '{port}', address: 3, roles: {{axis: amplifier_state, error: amplifier_fault}}}}"
    device, honest = driver(bind(yamlfile.loads(node), tmp_path)), wire.take
    with contextlib.closing(wire):
        device.connect()
        drive.request(8)
        wire.take = lambda data: honest(data)[:-1]
        with contextlib.suppress(HardwareError):
            getattr(device, end)()
        assert drive.state == 1


def another_unit(take):
    """Answer with the id of the next unit (Modbus TCP: byte 6)."""
    return lambda data: bytes(byte + (k == 6) for k, byte in enumerate(take(data)))


def one_late(take):
    """Answer each request when the next one comes."""
    waiting = [b""]

    def late(data):
        waiting.append(take(data))
        return waiting.pop(0)

    return late


SPOILED = {
    "drive on Modbus TCP: another master disables it": None,
    "drive on Modbus TCP: every answer has another unit's id": another_unit,
    "drive on Modbus TCP: every answer is one request late": one_late,
}


@pytest.mark.slow
@pytest.mark.parametrize("case", SPOILED)
def test_a_drive_that_another_master_or_its_gateway_spoils(tmp_path, case):
    rig = Neighbours(tmp_path, [], "tcp")
    with rig.stack:
        rig.daemon.armed()
        wait(lambda: rig.axis.torque.state == 8, "driven")
        begin, spoil = time.monotonic(), SPOILED[case]
        if spoil is None:
            rig.axis.torque.state = 1
        else:
            rig.wire.take = spoil(rig.wire.take)
        wait(lambda: rig.daemon.ask("status")["state"] == "FAULT", "FAULT")
        fault_s = time.monotonic() - begin
        wait(lambda: rig.axis.torque.output == 0.0 and rig.axis.torque.state == 1, "no current")
        off_s = time.monotonic() - begin
        (fault,) = [f["name"] for f in rig.daemon.ask("status")["faults"] if f["severity"] != "warning"]
    assert max(fault_s, off_s) < 0.5  # the drive's own watchdog: 0.6 s after the last command
    figures = f"FAULT after {fault_s * 1e3:.0f} ms, no current after {off_s * 1e3:.0f} ms"
    ROWS.append(Row("Disarm", case, "0.5 s", figures, "amplifier off", f"`{fault}`"))


def on_can(message, kind, *values, obeyed=True):
    """Return what sends a frame of the drive's node on the bus, which the drive obeys, too."""

    def send(rig):
        frame = (3 << 5 | message, False, struct.pack(kind, *values))
        if obeyed:
            rig.axis.take(frame)
        rig.rig.can.send(encode(frame))

    return send


def on_rtu(*words):
    """Return what sends a request on the Modbus line; the drive's unit answers its own."""

    def send(rig):
        body = struct.pack(">BBHH", *words)
        rig.wire.send(body + modbus_crc(body) + rig.wire.take(body + modbus_crc(body)))

    return send


def colliding(rig):
    """Let a second unit of the address answer at the same time."""
    take = rig.wire.take
    rig.wire.take = lambda data: bytes(byte & 0x5F for byte in take(data))


OTHERS = {  # drive, what happens, how often (Hz, 0: once), the faults of which one is named first
    "drive on CAN: another master disables it": ("", on_can(7, "<I", 1), 0, ["amplifier_stopped"]),
    "drive on CAN: another master commands 1.5 A": ("", on_can(14, "<f", 1.5), 100, ["amplifier_error"]),
    "drive on CAN: another node says that it is off": (
        "",
        on_can(1, "<IB3x", 0, 1, obeyed=False),
        100,
        ["amplifier_stopped"],
    ),
    "drive on CAN: another node says that it has a fault": (
        "",
        on_can(1, "<IB3x", 7, 8, obeyed=False),
        100,
        ["amplifier_fault"],
    ),
    "drive on Modbus RTU: another master disables it": (
        "rtu",
        on_rtu(3, 6, 100, 6),
        0,
        ["amplifier_stopped"],
    ),
    "drive on Modbus RTU: another master commands 1.5 A": (
        "rtu",
        on_rtu(3, 6, 101, 1500),
        100,
        ["amplifier_error", "following_error"],
    ),
    "drive on Modbus RTU: a second unit has its address": ("rtu", colliding, 0, ["amplifier_error"]),
}


@contextlib.contextmanager
def repeated(act, rig, rate_hz):
    """Act once, or at a rate until the end of the block."""
    stop = threading.Event()

    def run():
        act(rig)
        while rate_hz and not stop.wait(1.0 / rate_hz):
            act(rig)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.mark.slow
@pytest.mark.parametrize("case", OTHERS)
def test_an_armed_drive_that_somebody_else_commands_or_answers_for(tmp_path, case):
    servo, act, rate_hz, faults = OTHERS[case]
    rig = Neighbours(tmp_path, [], servo)
    with rig.stack:
        rig.daemon.armed()
        wait(lambda: rig.axis.torque.state == 8, "driven")
        begin = time.monotonic()
        with repeated(act, rig, rate_hz):
            wait(lambda: rig.daemon.ask("status")["state"] == "FAULT", "FAULT")
            fault_s = time.monotonic() - begin
            wait(lambda: rig.axis.torque.state == 1, "off")
            off_s = time.monotonic() - begin
        found = rig.daemon.ask("status")["faults"]
        fault = next(f["name"] for f in found if f["severity"] != "warning" and not f["follows"])
    assert fault in faults
    assert max(fault_s, off_s) < 0.55  # the drive's own watchdog: 0.6 s after the last command
    figures = f"FAULT after {fault_s * 1e3:.0f} ms, disabled after {off_s * 1e3:.0f} ms"
    often = f" at {rate_hz} Hz" if rate_hz else ""
    ROWS.append(Row("Disarm", case + often, "0.55 s", figures, "amplifier off", f"`{fault}`"))


@pytest.mark.slow
def test_another_master_that_enables_a_disarmed_drive_on_can(tmp_path):
    """The drive's readings are not taken any more: the rig stays SAFE, cannot be armed, and says who commands."""
    rig = Neighbours(tmp_path, [], "")
    with rig.stack:
        begin = time.monotonic()
        with repeated(lambda r: (on_can(7, "<I", 8)(r), on_can(14, "<f", 0.5)(r)), rig, 100):
            wait(lambda: "amplifier_error" in str(rig.daemon.ask("status")["faults"]), "told", 2.0)
            told_s, again = time.monotonic() - begin, rig.safe_s
            assert "two masters would drive one axis" in str(rig.daemon.ask("status")["faults"])
            assert not rig.daemon.ask("arm")["ok"]
            _, repeated_s = wait(lambda: rig.safe_s > again, "the safe command again", 1.0)
    ROWS.append(
        Row(
            "Disarm",
            "drive on CAN, disarmed: another master enables it at 100 Hz",
            "2 s",
            f"told after {told_s * 1e3:.0f} ms",
            f"SAFE; safe command repeated, the next after {repeated_s * 1e3:.0f} ms",
            "`amplifier_error`",
        )
    )


@pytest.mark.slow
def test_a_disarm_waits_for_no_master_that_reads_all_the_time(tmp_path):
    """Before, it waited for a pause of 0.1 s between the other master's requests, however long that took."""
    rig = Neighbours(tmp_path, [], "rtu")
    with rig.stack:
        rig.daemon.armed()
        wait(lambda: rig.axis.torque.state == 8, "driven")
        rig.axis.torque.feed = lambda torque=None: setattr(rig.axis.torque, "fed_s", math.inf)  # no watchdog
        with repeated(on_rtu(7, 4, 0, 2), rig, 33):
            begin = time.monotonic()
            rig.disarm()
            wait(lambda: rig.safe_s > begin, "the safe command", 2.0)
        disarm_s = rig.safe_s - begin
    assert disarm_s < 0.4
    case, figures = "drive on Modbus RTU: another master reads at 33 Hz", f"disarm {disarm_s * 1e3:.0f} ms"
    ROWS.append(Row("Disarm", case, "400 ms", figures, "safe command at the drive", ""))


@pytest.mark.parametrize("timeout_s", [0.05, 0.3])
def test_a_drive_without_valid_answers_is_disabled_after_three_of_them(tmp_path, timeout_s):
    """A reading, the command and the command of 0 wait for their answers; then comes the word that disables."""
    drive, wire, profile, port, _ = modbus(tmp_path)
    (tmp_path / "servo.yaml").write_text(profile.replace("timeout_s: 0.05", f"timeout_s: {timeout_s}"))
    node = f"{{name: drive, profile: servo.yaml, port: '{port}', address: 3, roles: {{axis: amplifier_state, error: amplifier_fault}}}}"
    device, honest, zero_s = driver(bind(yamlfile.loads(node), tmp_path)), wire.take, []
    with contextlib.closing(wire):
        device.connect()
        drive.request(8)
        sample = Sample(len(device.binding.channels.names))
        device.poll(sample)
        feed = drive.feed
        drive.feed = lambda torque=None: (feed(torque), zero_s.append(time.monotonic()) if torque == 0 else 0)
        wire.take = lambda data: honest(data)[:-1]
        begin = time.monotonic()
        device.poll(sample)
        with contextlib.suppress(HardwareError):
            device.write(0.5, True, time.monotonic())
        device.disconnect()
        assert drive.state == 1 and zero_s[0] - begin < 2 * timeout_s + 0.1
        assert time.monotonic() - begin < 4 * timeout_s + 0.1


@pytest.mark.slow
@pytest.mark.parametrize("servo", ["rtu", "tcp"])
def test_another_master_that_enables_a_disarmed_drive(tmp_path, servo):
    """It drives 0.5 A at 100 Hz. Each of our disabling messages ends that for 10 ms."""
    rig = Neighbours(tmp_path, [], servo)

    def drive(rig):
        rig.axis.torque.request(8)
        rig.axis.torque.feed(0.5)

    with rig.stack:
        begin = time.monotonic()
        with repeated(drive, rig, 100):
            wait(lambda: rig.daemon.ask("status")["state"] == "FAULT", "FAULT", 8.0)
            fault_s, again = time.monotonic() - begin, rig.safe_s
            (fault,) = [f["name"] for f in rig.daemon.ask("status")["faults"] if f["severity"] != "warning"]
            _, repeated_s = wait(lambda: rig.safe_s > again, "the safe command again", 1.0)
    assert fault == "coil_stuck_on" and fault_s < 2.0
    ROWS.append(
        Row(
            "Disarm",
            f"drive on Modbus {servo.upper()}, disarmed: another master enables it at 100 Hz",
            "2 s",
            f"FAULT after {fault_s * 1e3:.0f} ms",
            f"safe command repeated, the next after {repeated_s * 1e3:.0f} ms",
            f"`{fault}`",
        )
    )
