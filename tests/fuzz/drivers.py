"""Every driver behind its port, fed with what no device should send: nothing but a link's end may come out of it.

    python -m tests.fuzz.drivers [NAME ...] [--frames N] [--seed 1]

Without --frames as many frames as an hour has at the device's rate. Frames are good ones, damaged ones, good ones of another
kind and noise, from a seed. After every read each new value is finite and inside its range; HardwareError and OSError are the
two ways to say that the link is gone; and after all of it a good frame is read as ever.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import select
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from tests.devices.emulators import modbus_crc
from tests.devices.harness import Line as Terminal
from thermoctl.files import yamlfile
from thermoctl_hal.base.backend import ABSENT, ERROR, OK, STALE, HardwareError, Sample
from thermoctl_hal.base.wire import Framer
from thermoctl_hal.can.bus import open_can
from thermoctl_hal.can.dbc import DbcDevice
from thermoctl_hal.can.drive import Cia402Device
from thermoctl_hal.modbus.device import ModbusDevice
from thermoctl_hal.profiles.bind import bind
from thermoctl_hal.serial.port import SerialDevice

CONFIG = Path(__file__).parents[2] / "config/devices"
FOLDER = Path(tempfile.mkdtemp(prefix="thermoctl-fuzz-"))
SHUNT = bytes.fromhex("127A00DC0BFF0700")  # 3.125 V, -0.625 A
HOUR_S = 3600
_modules = iter(range(10**9))


def bound(profile: str, port: str, roles: str, folder: Path = CONFIG) -> Any:
    """The binding of a profile."""
    text = f"{{name: fuzzed, profile: {profile}, port: '{port}', roles: {{{roles}}}}}"
    return bind(yamlfile.loads(text), folder)


def damaged(frame: bytes, r: random.Random) -> bytes:
    """A frame with a bit flipped, cut, doubled, or with noise in it."""
    at = r.randrange(len(frame) + 1)
    return r.choice(
        (
            frame[:at],
            frame[at:],
            frame + frame[:at],
            frame[:at] + r.randbytes(r.randrange(1, 9)) + frame[at:],
            bytes(b ^ (1 << r.randrange(8)) if k == at else b for k, b in enumerate(frame)),
            r.randbytes(r.randrange(1, 40)),
        )
    )


class Line(Terminal):
    """A pseudo-terminal; `send` returns when its bytes can be read at the other end."""

    def send(self, data: bytes) -> None:
        """Send what fits, and throw away what the driver has sent."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.master, data)
        if data:
            select.select([self.slave], [], [], 0.02)
        with contextlib.suppress(BlockingIOError):
            os.read(self.master, 65536)


class Fuzzed:
    """A driver, its other end, and what it is sent. Subclasses: `rate_hz`, `frame`, `send`, `good`."""

    rate_hz: float
    device: Any
    batch = 8  # frames of one read

    def frame(self, r: random.Random) -> Any:
        """One frame, good or bad."""
        raise NotImplementedError

    def send(self, frames: list[Any]) -> None:
        """To the driver's port."""
        raise NotImplementedError

    def good(self) -> Any:
        """A frame that must be read."""
        raise NotImplementedError

    def connect(self) -> None:
        """(Re)open the driver's link."""
        self.device.disconnect()
        self.device.connect()

    def read(self, sample: Sample) -> None:
        """One tick of the driver."""
        self.device.read(sample, time.monotonic())

    def check(self, sample: Sample) -> None:
        """New values are finite and inside their range; the driver has a line on its silence."""
        for role, b in zip(self.device.roles, self.device.binding.bounds, strict=True):
            assert sample.status[role] in (OK, STALE, ERROR, ABSENT)
            if sample.fresh[role]:
                assert b.low <= sample.value[role] <= b.high, (b.role, sample.value[role])
        sample.fresh[:] = False

    def run(self, frames: int, seed: int) -> dict[str, int]:
        """Feed `frames` frames; the driver's counters, and how often it gave up its link."""
        r, sample, lost = random.Random(seed), Sample(), 0
        self.connect()
        for k in range(0, frames, self.batch):
            self.send([self.frame(r) for _ in range(min(self.batch, frames - k))])
            try:
                self.read(sample)
            except (HardwareError, OSError):
                lost += 1
                self.connect()
            self.check(sample)
            if k % 1000 < self.batch:
                text = self.device.silence()
                assert text and "\n" not in text and len(text) < 400, text
        self.recovers(sample)
        counts = {**self.device.counters(), "gave up": lost}
        self.device.disconnect()
        return counts

    def recovers(self, sample: Sample) -> None:
        """A good frame is read after everything that came."""
        for _ in range(200):
            self.send([self.good()])
            with contextlib.suppress(HardwareError, OSError):
                self.read(sample)
            if sample.fresh[self.device.roles].any():
                return
        raise AssertionError("no good frame is read any more")


class Encoder(Fuzzed):
    """Binary frames on a serial line."""

    rate_hz = 1000.0

    def __init__(self) -> None:
        self.line = Line()
        self.device: Any = SerialDevice(bound("encoder-serial.yaml", self.line.path, "position: position_um"))
        self.framer, self.sequence = Framer(self.device.binding.profile.bus_spec), 0

    def good(self) -> bytes:
        self.sequence = (self.sequence + 1) % 65536
        return self.framer.encode(self.sequence, 1000, 0)

    def frame(self, r: random.Random) -> bytes:
        self.sequence = (self.sequence + 1) % 65536
        whole = self.framer.encode(self.sequence, r.randrange(-(2**31), 2**31), r.choice((0, 0, 0, 1, 255)))
        return whole if r.random() < 0.5 else damaged(whole, r)

    def send(self, frames: list[bytes]) -> None:
        self.line.send(b"".join(frames))


class Gauge(Fuzzed):
    """Lines of text, asked for."""

    rate_hz = 20.0

    def __init__(self) -> None:
        self.line = Line()
        self.device: Any = SerialDevice(bound("meter-serial-text.yaml", self.line.path, "voltage: voltage_v"))

    def good(self) -> bytes:
        return b"\r\nV=+3.1250 A=+0.6250\r\n"

    def frame(self, r: random.Random) -> bytes:
        number = r.choice(
            (b"+3.125", b"1e9", b"1e999", b"--", b"1,5", b"-   5", b".", b"9" * 400, b"nan", b"1e", b"\xff")
        )
        whole = b"V=" + number + b" A=+0.6" + r.choice((b"\r\n", b"\n", b"", b"\r"))
        return whole if r.random() < 0.5 else damaged(whole, r)

    def send(self, frames: list[bytes]) -> None:
        self.line.send(b"".join(frames))


def can_frame(r: random.Random, known: tuple[int, ...]) -> tuple[int, bool, bytes]:
    """Identifier, 29 bits, data: mostly identifiers that the driver knows, with any data."""
    can_id = r.choice(known) if r.random() < 0.8 else r.randrange(1 << 29)
    extended = can_id > 0x7FF or r.random() < 0.1
    return can_id, extended, r.randbytes(r.choice((0, 1, 2, 3, 6, 8, 8, 8)))


def lawicel(can_id: int, extended: bool, data: bytes) -> bytes:
    """A frame as the Lawicel manual writes it."""
    head = f"T{can_id:08X}" if extended else f"t{can_id:03X}"
    return f"{head}{len(data)}{data.hex().upper()}\r".encode()


class ShuntOnSlcan(Fuzzed):
    """A DBC device behind a Lawicel adapter."""

    rate_hz = 100.0

    def __init__(self) -> None:
        self.line = Line()
        self.device: Any = DbcDevice(bound("meter-can.yaml", f"slcan:{self.line.path}", "voltage: voltage_v"))

    def good(self) -> bytes:
        return b"\r" + lawicel(801, False, SHUNT)

    def frame(self, r: random.Random) -> bytes:
        whole = r.choice(
            (lawicel(*can_frame(r, (801, 802))), b"z\r", b"\a", b"r3218\r", b"d321F" + b"0" * 128 + b"\r")
        )
        return whole if r.random() < 0.7 else damaged(whole, r)

    def send(self, frames: list[bytes]) -> None:
        self.line.send(b"".join(frames))


class ShuntOnLibrary(Fuzzed):
    """The same on an interface of python-can, with CAN FD, remote and error frames."""

    rate_hz = 100.0

    def __init__(self) -> None:
        channel = f"fuzz{next(_modules)}"
        self.bus = can.Bus(channel, interface="virtual")
        self.device: Any = DbcDevice(bound("meter-can.yaml", f"virtual:{channel}", "voltage: voltage_v"))

    def good(self) -> can.Message:
        return can.Message(arbitration_id=801, data=SHUNT, is_extended_id=False)

    def frame(self, r: random.Random) -> can.Message:
        can_id, extended, data = can_frame(r, (801, 802))
        kind = r.randrange(6)
        if kind == 0:
            data = r.randbytes(r.choice((0, 8, 12, 64)))
        return can.Message(
            arbitration_id=can_id,
            is_extended_id=extended,
            data=None if kind == 1 else data,
            dlc=r.randrange(9) if kind == 1 else None,
            is_fd=kind == 0,
            is_remote_frame=kind == 1,
            is_error_frame=kind == 2,
        )

    def send(self, frames: list[can.Message]) -> None:
        for message in frames:
            self.bus.send(message)


class DriveOnSlcan(Fuzzed):
    """A CiA-402 drive after its set-up, told to drive at every tick; the set-up itself is Setup."""

    rate_hz = 1100.0  # TPDO 1 and its heartbeat

    def __init__(self) -> None:
        self.line = Line()
        self.device: Any = Cia402Device(
            bound(
                "drive-cia402.yaml",
                f"slcan:{self.line.path}",
                "state: amplifier_state, fault: amplifier_fault, supply: supply_v",
            )
        )

    def connect(self) -> None:
        self.device.disconnect()
        self.device._port = open_can(self.device.binding.port, self.device._ids)
        self.device._heard_s = time.monotonic() + 1e9  # a heartbeat that is missing is no subject here

    def read(self, sample: Sample) -> None:
        self.device.read(sample, time.monotonic())
        self.device.write(0.25, True, time.monotonic())

    def good(self) -> bytes:
        return b"\r" + lawicel(0x180 + self.device._node, False, struct.pack("<HhI", 0x27, 100, 24000))

    def frame(self, r: random.Random) -> bytes:
        node = self.device._node
        known = (0x180 + node, 0x180 + node, 0x180 + node, 0x080 + node, 0x580 + node, 0x700 + node, 0x77A, 0)
        whole = lawicel(*can_frame(r, known))
        return whole if r.random() < 0.8 else damaged(whole, r)

    def send(self, frames: list[bytes]) -> None:
        self.line.send(b"".join(frames))


class Module(Fuzzed):
    """A Modbus device that answers anything."""

    rate_hz = 10.0
    batch = 1
    head = 1  # bytes of a request before its PDU

    def __init__(self) -> None:
        self.answers: list[Callable[[bytes], bytes]] = []
        text = (
            (CONFIG / "thermocouples-modbus-12.yaml").read_text().replace("timeout_s: 0.5", "timeout_s: 0.01")
        )
        (FOLDER / "module.yaml").write_text(text)
        self.device: Any = ModbusDevice(
            bound("module.yaml", self.listen(), "thermocouple_1: coil_c, thermocouple_9: shaft_1_c", FOLDER)
        )

    def listen(self) -> str:
        """Start the other end; its port."""
        raise NotImplementedError

    def whole(self, request: bytes, pdu: bytes) -> bytes:
        """A valid frame around an answer."""
        raise NotImplementedError

    def answer(self, request: bytes) -> bytes:
        return self.answers.pop(0)(request) if self.answers else b""

    def good(self) -> Callable[[bytes], bytes]:
        """Answer what is asked: after answers that refuse a gap the driver asks for smaller blocks."""

        def make(request: bytes) -> bytes:
            function, _, count = struct.unpack_from(">BHH", request, self.head)
            return self.whole(request, struct.pack(f">BB{count}H", function, 2 * count, *[215] * count))

        return make

    def frame(self, r: random.Random) -> Callable[[bytes], bytes]:
        seed, kind = r.randrange(1 << 30), r.randrange(10)

        def make(request: bytes) -> bytes:
            own = random.Random(seed)
            pdu = own.choice(
                (
                    struct.pack(">BB9H", 4, 18, *(own.randrange(65536) for _ in range(9))),
                    bytes((0x84, own.randrange(256))),
                    own.randbytes(own.randrange(1, 30)),
                    bytes((own.randrange(256), own.randrange(256))) + own.randbytes(own.randrange(60)),
                )
            )
            whole = self.whole(request, pdu)
            return whole if kind < 7 else damaged(whole, own) if kind < 9 else b""

        return make

    def send(self, frames: list[Callable[[bytes], bytes]]) -> None:
        self.answers = frames

    def read(self, sample: Sample) -> None:
        self.device.poll(sample)


class ModuleOnTcp(Module):
    """Over TCP."""

    head = 7

    def listen(self) -> str:
        server = socket.create_server(("127.0.0.1", 0))

        def serve() -> None:
            while True:
                client, _ = server.accept()
                with client, contextlib.suppress(OSError):
                    while request := client.recv(260):
                        if answer := self.answer(request):
                            client.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        return f"tcp:127.0.0.1:{server.getsockname()[1]}"

    def whole(self, request: bytes, pdu: bytes) -> bytes:
        return request[:4] + struct.pack(">H", len(pdu) + 1) + request[6:7] + pdu


class ModuleOnLine(Module):
    """Over a serial line."""

    def listen(self) -> str:
        self.line = Line()
        os.set_blocking(self.line.master, True)

        def serve() -> None:
            while True:
                with contextlib.suppress(OSError):
                    request = os.read(self.line.master, 256)
                    if len(request) >= 8 and (answer := self.answer(request)):
                        os.write(self.line.master, answer)

        threading.Thread(target=serve, daemon=True).start()
        return f"rtu:{self.line.path}"

    def whole(self, request: bytes, pdu: bytes) -> bytes:
        return request[:1] + pdu + modbus_crc(request[:1] + pdu)


class Setup(Fuzzed):
    """The set-up of a drive whose SDO answers are anything: refused with HardwareError, or done."""

    rate_hz = 10.0
    batch = 40  # answers of one set-up

    def __init__(self) -> None:
        channel = f"fuzz{next(_modules)}"
        self.bus = can.Bus(channel, interface="virtual")
        for name in ("drive-cia402.yaml", "drive-cia402.eds"):
            text = (CONFIG / name).read_text().replace("  mode: 10 ", "  sdo_timeout_s: 0.01\n  mode: 10 ")
            (FOLDER / name).write_text(text.replace("heartbeat_s: 0.02 ", "heartbeat_s: 0.001 "))
        self.device: Any = Cia402Device(
            bound("drive-cia402.yaml", f"virtual:{channel}", "state: amplifier_state", FOLDER)
        )
        self.answers: list[bytes] = []
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        while True:
            message = self.bus.recv(1.0)
            if message is not None and message.arbitration_id == 0x605:
                r = random.Random(self.answers.pop() if self.answers else b"")
                honest = (
                    bytes((0x43 if message.data[0] == 0x40 else 0x60, *message.data[1:4])) + b"\x92\x01\x02\0"
                )
                body = (
                    honest
                    if r.random() < 0.95
                    else r.choice((r.randbytes(r.randrange(9)), bytes((r.randrange(256),)) + honest[1:]))
                )
                self.bus.send(can.Message(arbitration_id=0x585, data=body, is_extended_id=False))

    def connect(self) -> None:
        self.device.disconnect()

    def frame(self, r: random.Random) -> bytes:
        return r.randbytes(8)

    def send(self, frames: list[bytes]) -> None:
        self.answers = frames

    def read(self, sample: Sample) -> None:
        self.device.disconnect()
        self.device.connect()

    def recovers(self, sample: Sample) -> None:
        """Nothing is read in a set-up."""


DRIVERS: dict[str, type[Fuzzed]] = {
    "encoder": Encoder,
    "gauge": Gauge,
    "shunt_slcan": ShuntOnSlcan,
    "shunt_library": ShuntOnLibrary,
    "drive_slcan": DriveOnSlcan,
    "drive_setup": Setup,
    "module_tcp": ModuleOnTcp,
    "module_rtu": ModuleOnLine,
}
QUICK = {"module_tcp": 200, "module_rtu": 150, "drive_setup": 200}
"""Frames of the quick run where others take 4000: these wait for their time-outs."""


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="*", default=[], choices=[*DRIVERS, []])
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    for name in asked.name or DRIVERS:
        fuzzed = DRIVERS[name]()
        frames = asked.frames or round(HOUR_S * fuzzed.rate_hz)
        begin = time.monotonic()
        counts = fuzzed.run(frames, asked.seed)
        print(f"{name}: {frames} frames in {time.monotonic() - begin:.0f} s: {counts}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
