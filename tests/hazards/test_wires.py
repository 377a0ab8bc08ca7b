"""The wires of the encoder and of the drive, in simulated time: the real drivers on pseudo-terminals, whose other ends are
played between two ticks by a frame generator and a CiA-402 drive; plant, loop and law are those of the simulated rig."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import select
import socket
import struct
import threading
import types

import numpy as np
import pytest

from tests.hazards.harness import ROOT, ROWS, HazardRig, Row, say
from thermoctl.files import yamlfile
from thermoctl_hal.base.backend import ROLE, Sample
from thermoctl_hal.base.wire import Framer
from thermoctl_hal.rig.devices import DevicesBackend
from thermoctl_hal.rig.make import make_devices
from thermoctl_hal.virtual import drive as drives
from thermoctl_hal.virtual.device import Pty

ENCODER, DRIVE = ("position_um",), ("amplifier_state", "amplifier_fault", "supply_v")


FRAME = struct.Struct("=IB3x8s")  # struct can_frame of the kernel
ERROR_FRAME = FRAME.pack(0x2000_0040, 8, bytes(8))  # CAN_ERR_FLAG | CAN_ERR_BUSOFF
OTHER_ERROR = FRAME.pack(0x2000_0008, 8, bytes(8))  # CAN_ERR_PROT: what a wrong bit rate gives
PASSIVE = FRAME.pack(0x2000_0004, 8, b"\0\x20") + FRAME.pack(0x2000_0004, 8, b"\0\x40")


class Gate:
    """The driver's end of a KernelBus, which takes no frames while its queue is full."""

    def __init__(self, bus):
        self.bus = bus

    def __getattr__(self, name):
        return getattr(self.bus.theirs, name)

    def send(self, data):
        if self.bus.full:
            raise OSError(errno.ENOBUFS, os.strerror(errno.ENOBUFS))
        return self.bus.theirs.send(data)


class KernelBus:
    """SocketCAN's frames through a pair of sockets, with what Wires asks of a terminal and of an adapter; `off`: bus-off, nothing
    passes either way. (The kernel's own CAN runs in a guest: make test-qemu.)"""

    def __init__(self):
        self.off, self.full, self.master = False, False, -1

    def plug(self):
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.setblocking(False)
        self.master, self._slave = self.ours.fileno(), self.theirs.fileno()

    def unplug(self):
        self.ours.close()
        self.theirs.close()

    def open(self, channel, interface, bitrate, can_filters, receive_own_messages):
        """In place of can.Bus."""
        return types.SimpleNamespace(socket=Gate(self), shutdown=lambda: None)

    def receive(self):
        data = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                data += self.ours.recv(16)
        return b"" if self.off else data

    def send(self, data):
        for at in range(0, len(data), 16):
            self.ours.send(data[at : at + 16])

    def feed(self, data):
        return b"", [(i, d[:n]) for i, n, d in FRAME.iter_unpack(data)]

    def encode(self, frames):
        return b"" if self.off else b"".join(FRAME.pack(i, len(d), d) for i, d in frames)


class Wires:
    """A back end: position and amplifier through the drivers, all else from the simulated plant. bus: a KernelBus, None: an
    slcan adapter."""

    def __init__(self, simulated, settings, folder, bus=None):
        self.simulated, self.rig, self.sample, self.now_s = simulated, simulated.rig, Sample(), 0.0
        self.encoder, self.adapter_port = Pty(str(folder / "encoder")), bus or Pty(str(folder / "can"))
        self.encoder.plug()
        self.adapter_port.plug()
        devices = ROOT / "config/devices"
        text = (
            f"[{{name: encoder, profile: {devices}/encoder-serial.yaml, port: {folder}/encoder, "
            f"roles: {{position: position_um}}}}, {{name: drive, profile: {devices}/drive-cia402.yaml, "
            f"port: '{'socketcan:can0' if bus else f'slcan:{folder}/can'}', "
            f"roles: {{state: amplifier_state, fault: amplifier_fault, supply: supply_v}}}}]"
        )
        bound = dataclasses.replace(
            settings, hal=dataclasses.replace(settings.hal, devices=tuple(yamlfile.loads(text).value))
        )
        self.devices = DevicesBackend(make_devices(bound), [])
        self.framer = Framer(self.devices.fast[0].binding.profile.bus_spec)
        self.drive, self.adapter, self.sequence = drives.Cia402Drive(5), bus or drives.SlcanAdapter(), 0
        self.spoil_frame = lambda frame: frame  # what becomes of an encoder frame on its way
        self.spoil_can = lambda data: data  # and of the adapter's bytes
        self.status = 0
        self.connecting = threading.Event()

    def open(self):
        self.connect(self.devices.open)

    def connect(self, action):
        """Run `action` (which blocks on the drive's answers) with the drive played by a thread."""

        def play():
            while not self.connecting.is_set():
                self.play_drive()
                select.select([self.adapter_port.master], [], [], 0.002)

        self.connecting.clear()
        player = threading.Thread(target=play)
        player.start()
        try:
            action()
        finally:
            self.connecting.set()
            player.join()

    def play_drive(self):
        data = self.adapter_port.receive() if self.adapter_port.master >= 0 else b""
        answer, frames = self.adapter.feed(data)
        for frame in frames:
            self.drive.take(frame, self.now_s)
        self.adapter_port.send(self.spoil_can(answer + self.adapter.encode(self.drive.tick(self.now_s))))

    def read(self, now_s):
        self.now_s = now_s
        inner = self.simulated.read(now_s)
        if self.encoder.master >= 0:
            counts = round(inner.value[ROLE["position_um"]] / 0.005)
            self.encoder.send(self.spoil_frame(self.framer.encode(self.sequence, counts, self.status)))
            self.sequence = (self.sequence + 1) % 65536
        if self.adapter_port.master >= 0:
            self.play_drive()
        for port in (self.encoder, self.adapter_port):
            if port.master >= 0:  # until the terminal has passed on what was written
                select.select([port._slave], [], [], 0.02)
        wired, out = self.devices.read(now_s), self.sample
        out.value[:], out.time_s[:], out.fresh[:], out.status[:] = (
            inner.value,
            inner.time_s,
            inner.fresh,
            inner.status,
        )
        for k in (ROLE[r] for r in (*ENCODER, *DRIVE)):
            out.value[k], out.time_s[k], out.fresh[k], out.status[k] = (
                wired.value[k],
                wired.time_s[k],
                wired.fresh[k],
                wired.status[k],
            )
        return out

    def write(self, drive, enable):
        self.devices.write(drive, enable)
        if self.adapter_port.master >= 0:
            select.select([self.adapter_port.master], [], [], 0.02)
            self.play_drive()
        self.simulated.write(self.drive.command * 1e-6, self.drive.state == drives.ENABLED)

    def problem(self, role):
        return self.devices.problem(role)

    def close(self):
        self.devices.close()
        self.simulated.close()
        self.encoder.unplug()
        self.adapter_port.unplug()


class WiredRig(HazardRig):
    def __init__(self, settings, folder, bus=None):
        super().__init__(settings)
        self.wires = self.injector.inner = Wires(self.backend, settings, folder, bus)
        self.wires.open()

    def close(self):
        self.wires.close()

    def settle(self, condition, limit_ticks=20000):
        """Tick until condition(); a link that is connected again in the background is waited for."""
        for _ in range(limit_ticks):
            if condition():
                return
            self.tick()
            if not all(d.up for d in self.wires.devices.fast):
                self.wires.play_drive()
                select.select([], [], [], 1e-4)  # the reconnecting thread's turn
        raise AssertionError((self.state, self.faults))

    def comes_back(self, limit_s=20.0):
        w = self.wires
        w.spoil_frame = w.spoil_can = lambda data: data
        w.status = 0
        if not w.drive.alive:
            w.drive.power_up()
        w.drive.alive = w.drive.heartbeat = True
        self.settle(lambda: all(d.up for d in w.devices.fast))
        return super().comes_back(limit_s)


@pytest.fixture
def wired(quick, tmp_path):
    r = WiredRig(quick, tmp_path)
    r.settle(lambda: r.state == "READY")
    yield r
    r.close()


def happens(rig, hazard, expected, limit, begin, cause):
    """The scenario's course; `cause` must be told by the back end, too."""
    rig.ready_to_be_spoiled(5.0)
    begin(rig.wires)
    ticks, found, way = rig.detect(expected, limit)
    for _ in range(1000):  # a link notices that it is gone at its next heartbeat
        text = rig.wires.problem("position_um") + rig.wires.problem("amplifier_state")
        if not cause or cause in text:
            break
        rig.tick()
    assert cause in text, text
    rig.settle(lambda: rig.wires.drive.command == 0, 200)  # the real end of the wire is off
    jump = rig.comes_back(60.0)
    say("Wires", hazard, limit, ticks, found, way, jump)


def flip(frame):
    return frame[:5] + bytes([frame[5] ^ 0x10]) + frame[6:]


RANDOM = np.random.default_rng(5)


def garbage(frame):
    return RANDOM.integers(0, 256, len(frame), dtype=np.uint8).tobytes()


def no_supply(wires):
    wires.drive.alive, wires.drive.state = False, drives.DISABLED


def set_(name, value):
    return lambda wires: setattr(wires, name, value)


@pytest.mark.parametrize(
    "hazard,expected,limit,begin,cause",
    [
        (
            "encoder: every frame fails its CRC",
            {"position_stale"},
            12,
            set_("spoil_frame", flip),
            "with a wrong CRC",
        ),
        (
            "encoder: noise instead of frames",
            {"position_stale"},
            12,
            set_("spoil_frame", garbage),
            "bytes came",
        ),
        (
            "encoder: half of each frame",
            {"position_stale"},
            12,
            set_("spoil_frame", lambda f: f[:6]),
            "bytes came",
        ),
        (
            "encoder: says that its signal is too weak",
            {"position_error"},
            1,
            set_("status", 1),
            "reports an error",
        ),
        ("encoder: silent", {"position_stale"}, 12, set_("spoil_frame", lambda f: b""), "nothing arrives"),
        ("encoder: cable out", {"position_stale"}, 12, lambda w: w.encoder.unplug(), "lost on"),
        (
            "drive: its heartbeat is missing",
            {"amplifier_error"},
            103,
            lambda w: setattr(w.drive, "heartbeat", False),
            "no heartbeat",
        ),
        ("drive: supply off", {"amplifier_stale", "amplifier_error"}, 25, no_supply, ""),
        (
            "drive: restarts by itself",
            {"amplifier_error", "amplifier_stopped"},
            5,
            lambda w: w.drive.power_up(),
            "",
        ),
        ("drive: over-current (0x2310)", {"amplifier_fault"}, 2, lambda w: w.drive.fault(0x2310), ""),
        ("drive: over-temperature (0x4210)", {"amplifier_fault"}, 2, lambda w: w.drive.fault(0x4210), ""),
        ("CAN: adapter's cable out", {"amplifier_error"}, 2, lambda w: w.adapter_port.unplug(), "lost on"),
        (
            "CAN: half of each message",
            {"amplifier_stale", "amplifier_error"},
            25,
            set_("spoil_can", lambda d: d[: len(d) // 2]),
            "",
        ),
        (
            "CAN: the adapter refuses everything (BEL)",
            {"amplifier_stale", "amplifier_error"},
            25,
            set_("spoil_can", lambda d: b"\a" * bool(d)),
            "",
        ),
    ],
)
def test_wire(wired, hazard, expected, limit, begin, cause):
    if "cable out" in hazard:
        port = wired.wires.encoder if "encoder" in hazard else wired.wires.adapter_port

        def comes_back(limit_s=20.0, again=wired.comes_back):
            port.plug()
            if port is wired.wires.adapter_port:
                wired.wires.adapter = drives.SlcanAdapter()
            return again(limit_s)

        wired.comes_back = comes_back
    happens(wired, hazard, expected, limit, begin, cause)


@pytest.mark.parametrize(
    "state", ["NOT_READY", "DISABLED", "READY", "SWITCHED_ON", "QUICK_STOP", "FAULT_REACTION"]
)
def test_the_drive_leaves_operation_by_itself(wired, state):
    """Each other state of CiA-402, held by a drive that does not go back to work."""
    code = {"FAULT_REACTION": 0x0F}.get(state) if state == "FAULT_REACTION" else getattr(drives, state)
    expected = {"amplifier_fault"} if state == "FAULT_REACTION" else {"amplifier_stopped"}

    def stays(wires):
        step = wires.drive._step_state
        wires.drive.state = code
        wires.drive._step_state = lambda word: step(word) if word == 0 else None

    try:
        happens(wired, f"drive: {state.lower().replace('_', ' ')} while armed", expected, 2, stays, "")
    finally:
        vars(wired.wires.drive).pop("_step_state", None)


@pytest.mark.parametrize("stop_s", [0.005, 0.05, 0.55])
def test_a_stop_input_ends_driving_for_good(wired, stop_s):
    """Pulsed while the stage is held off its rest: no current ever flows again without a new arming."""
    wired.ready_to_be_spoiled(15.0)
    drive = wired.wires.drive
    drive.stop_until_s = wired.wires.now_s + stop_s
    ticks, found, way = wired.detect({"amplifier_stopped"}, 3)
    assert found == {"amplifier_stopped"} and wired["amplifier_state"] == 4.0 and wired["control_v"] == 0.0
    assert "quick stop active" in wired.wires.problem("amplifier_state")
    for _ in range(round(stop_s / wired.period_s) + 200):
        wired.tick()
        assert drive.command == 0 and drive.state != drives.ENABLED and wired.state == "FAULT"
    jump = wired.comes_back()
    assert wired.wires.problem("amplifier_state") == ""
    say("Wires", f"drive: stop input for {stop_s * 1e3:g} ms", 3, ticks, found, way, jump)


def test_single_errors_are_survived(wired):
    """One frame in a hundred fails its CRC, is cut or has noise before it: nothing but that frame is lost, nothing trips."""
    wired.ready_to_be_spoiled(5.0)
    random, spoiled, k = np.random.default_rng(1), 0, 0

    def spoil(frame):
        nonlocal k, spoiled
        k += 1
        if k % 100:
            return frame
        spoiled += 1
        return (
            flip(frame),
            frame[: random.integers(1, len(frame))],
            random.integers(0, 256, 200, dtype=np.uint8).tobytes() + b"\xaa\x55" + frame,
        )[spoiled % 3]

    wired.wires.spoil_frame = spoil
    before, worst = dict(wired.wires.devices.counters()), 0.0
    for _ in range(3000):
        wired.tick()
        worst = max(worst, abs(wired["compensated_um"] - wired["reference_um"]))
        assert wired.state == "ARMED" and not wired.faults, wired.faults
    after = wired.wires.devices.counters()
    lost = 3000 - (after["encoder.frames"] - before["encoder.frames"])
    assert (
        spoiled == 30
        and after["encoder.errors"] > before["encoder.errors"]
        and lost <= 2 * spoiled
        and worst < 0.5
    )
    ROWS.append(
        Row(
            "Wires",
            "encoder: one frame in a hundred damaged",
            f"{2 * spoiled} of 3000 frames lost",
            f"{lost} lost, error of the loop {worst:.2f} um",
            "drives on",
            "counted in `encoder.errors`",
        )
    )


def test_usb_renumbering(wired, tmp_path):
    """The encoder comes back as another terminal under its by-id name; then the name leads to a foreign device, whose
    numbers must never be taken for a position."""
    wired.ready_to_be_spoiled(5.0)
    old = os.readlink(tmp_path / "encoder")
    wired.wires.encoder.unplug()
    ticks, found, way = wired.detect({"position_stale"}, 12)
    taken = [os.openpty() for _ in range(3)]  # the lowest free numbers: the old one, or it is still held
    wired.wires.encoder.plug()
    assert os.readlink(tmp_path / "encoder") != old
    jump = wired.comes_back(60.0)
    say("Wires", "USB renumbering: the encoder under another number", 12, ticks, found, way, jump)
    wired.wires.encoder.unplug()
    wired.settle(lambda: wired.state == "FAULT", 13)
    wired.wires.spoil_frame = lambda frame: b"V=+3.1250 A=+0.6250\r\n"
    position = wired["position_um"]
    wired.wires.encoder.plug()
    for _ in range(3000):
        wired.wires.play_drive()
        wired.tick()
        assert wired.state == "FAULT" and wired["position_um"] == position
    for f in (f for pair in taken for f in pair):
        os.close(f)


def test_the_adapter_takes_no_more_data(wired):
    """A hung adapter: our own queue must not grow, and the drive's watchdog stops it."""
    wired.ready_to_be_spoiled(5.0)
    wires = wired.wires
    wires.play_drive = lambda: wires.drive.tick(wires.now_s) and None
    ticks, found, way = wired.detect({"amplifier_stale", "amplifier_error"}, 25)
    wired.settle(lambda: wires.drive.command == 0, 150)  # by its own watchdog, 0.1 s
    del wires.play_drive
    jump = wired.comes_back(60.0)
    say("Wires", "CAN: the adapter hangs", 25, ticks, found, way, jump)


@pytest.fixture
def on_socket(quick, tmp_path, monkeypatch):
    """The wired rig on SocketCAN's frames."""
    bus = KernelBus()
    monkeypatch.setattr("can.Bus", bus.open)
    r = WiredRig(quick, tmp_path, bus)
    r.settle(lambda: r.state == "READY")
    yield r
    r.close()


def bus_off(wires):
    """The kernel's error frame, and then nothing passes."""
    wires.adapter_port.ours.send(ERROR_FRAME)
    wires.adapter_port.off = True


def shorter(data):
    """The drive's TPDO 1 with 6 of its 8 bytes."""
    return b"".join(FRAME.pack(i, 6 if i == 0x185 else n, d) for i, n, d in FRAME.iter_unpack(data))


@pytest.mark.parametrize(
    "hazard,expected,limit,begin,cause",
    [
        ("bus-off", {"amplifier_error"}, 2, bus_off, "CAN bus-off: check wiring, termination and bitrate"),
        (
            "transmit queue full (ENOBUFS)",
            {"amplifier_stale"},
            25,
            lambda w: setattr(w.adapter_port, "full", True),
            "nobody on the bus takes frames",
        ),
        (
            "wrong bit rate: error frames only",
            {"amplifier_stale"},
            25,
            set_("spoil_can", lambda d: OTHER_ERROR),
            "no heartbeat of node 5",
        ),
        ("TPDO of 6 bytes", {"amplifier_stale"}, 25, set_("spoil_can", shorter), "6 bytes, 8 were mapped"),
    ],
)
def test_can(on_socket, hazard, expected, limit, begin, cause):
    """The cause is named, and the drive's own watchdog stops it where no command reaches it."""

    def comes_back(limit_s=20.0, again=on_socket.comes_back):
        on_socket.wires.adapter_port.off = on_socket.wires.adapter_port.full = False
        return again(limit_s)

    on_socket.comes_back = comes_back
    happens(on_socket, f"CAN: {hazard}", expected, limit, begin, cause)


@pytest.mark.parametrize(
    "hazard,more",
    [
        ("error-passive, then error-active", PASSIVE),
        (
            "20 frames a tick of another node",
            20 * (FRAME.pack(0x186, 8, bytes(8)) + FRAME.pack(0x706, 1, b"\5")),
        ),
    ],
)
def test_can_goes_on(on_socket, hazard, more):
    on_socket.ready_to_be_spoiled(5.0)
    on_socket.wires.spoil_can = lambda data: more + data
    for _ in range(1000):
        on_socket.tick()
        assert on_socket.state == "ARMED" and not on_socket.faults, on_socket.faults
    ROWS.append(Row("Wires", f"CAN: {hazard}", "no fault", "no fault in 1000 ticks", "drives on", ""))


def test_struct_sizes():
    assert struct.calcsize("<HiB") == 7
