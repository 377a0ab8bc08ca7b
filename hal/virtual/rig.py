"""The virtual rig: the devices of a configuration at the other end of their wires, in real time.

`hal.devices` says what the daemon talks to; this program plays those devices by the same profiles: a pty with
a symbolic link at each serial port's path, a Lawicel adapter with a CiA-402 drive (or the sender of a DBC file) behind
it, Modbus TCP servers and RTU units. One plant feeds them all; the drive's current moves it. In `hal.run_dir` stand

    reference.csv   what the daemon never sees: the output's reference encoder and the true state, 100 rows a second,
                    `t` on the machine's monotonic clock
    control.sock    a line in, a line out: pull cables and break things (`help` lists what each device knows)
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import re
import select
import signal
import socket
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hal.profile import ERROR_CODE, STATUS_WORD, Binding, Bound, bind, check_rig
from hal.serial_port import LineReader
from hal.simulated import PlantRig, make_rig
from hal.virtual.drive import Cia402Drive, SlcanAdapter
from hal.virtual.modbus import ModbusUnit
from hal.wire import EXTENDED, Framer, encode_slcan
from thermoctl.yamlfile import InputError, suggest

MAX_STEPS = 50  # periods caught up at once; a longer stop of this program shifts the plant's time
REFERENCE_HZ = 100
SUPPLY_V = 24.0
PRIORITY = 70  # below the daemon's loop
_REFERENCE = ("output_reference_um", "position_um", "coil_c", "air_c")


class Pty:
    """A pseudo-terminal whose slave has a symbolic link at `path`."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        self.master = self._slave = -1

    def plug(self) -> None:
        """Make the terminal and its link."""
        if self.master >= 0:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.master, self._slave = os.openpty()  # the slave stays open: the master lives while nobody listens
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        if self.path.is_symlink():
            self.path.unlink()
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Hang up: whoever has it open reads an error, as from a pulled USB adapter."""
        if self.master < 0:
            return
        with contextlib.suppress(OSError):
            self.path.unlink()
        os.close(self.master)
        os.close(self._slave)
        self.master = self._slave = -1

    def send(self, data: bytes) -> None:
        """Send what fits; a listener that does not read loses bytes, as on a real line."""
        if self.master >= 0:
            with contextlib.suppress(BlockingIOError, OSError):
                os.write(self.master, data)

    def receive(self) -> bytes:
        """What the other side has sent."""
        try:
            return os.read(self.master, 4096)
        except (BlockingIOError, OSError):
            return b""


class VirtualDevice:
    """One device of the rig. `verbs` are what the control socket can do to it, beside plug and unplug."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        self.binding, self.rig, self.name = binding, rig, binding.name
        self.verbs: dict[str, Callable[[str], None]] = {}

    def plug(self) -> None:
        """Put the device (back) on its wire."""
        raise NotImplementedError

    def unplug(self) -> None:
        """Pull its cable."""
        raise NotImplementedError

    def descriptors(self) -> list[int]:
        """What to wait on for input."""
        raise NotImplementedError

    def ready(self, descriptor: int, now_s: float) -> None:
        """Input has arrived."""

    def tick(self, now_s: float, tick: int) -> None:
        """One period has passed."""

    def flag(self, owner: Any, attribute: str) -> Callable[[str], None]:
        """A verb `<attribute> on|off`."""

        def switch(argument: str) -> None:
            if argument not in ("on", "off"):
                raise InputError(f"{attribute}: on or off was expected, found '{argument}'")
            setattr(owner, attribute, argument == "on")

        return switch

    def raw(self, bound: Bound, value: float) -> float:
        """The device's raw number for a role's value: the profile's scale backwards."""
        return (value - bound.offset) / bound.scale

    def reading(self, bound: Bound) -> float | None:
        """What the device's sensor reads now, raw; None where the plant knows nothing of this role."""
        if bound.role == "supply_v":
            return self.raw(bound, SUPPLY_V)
        return self.raw(bound, self.rig.sense(bound.role)) if bound.role in self.rig.index else None


class EncoderStream(VirtualDevice):
    """Binary frames, one a period of its rate."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        spec = binding.profile.bus_spec
        self.pty, self._framer, self._spec = Pty(binding.port), Framer(spec), spec
        self._names = [n for n, _ in spec.fields]
        self._sequence = 0
        self.freeze = self.corrupt = self.mute = self.garbage = self.invalid = False
        self.verbs = {v: self.flag(self, v) for v in ("freeze", "corrupt", "mute", "garbage", "invalid")}
        self._held: dict[str, float] = {}

    def plug(self) -> None:
        """Put the device (back) on its wire."""
        self.pty.plug()

    def unplug(self) -> None:
        """Pull its cable."""
        self.pty.unplug()

    def descriptors(self) -> list[int]:
        """What to wait on for input."""
        return [self.pty.master] if self.pty.master >= 0 else []

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer what has come in on `descriptor`."""
        self.pty.receive()

    def tick(self, now_s: float, tick: int) -> None:
        """Send what is due at now_s."""
        if self.mute:
            return
        fields: dict[str, float] = dict.fromkeys(self._names, 0)
        if not self.freeze:
            self._held = {b.channel.source: self.reading(b) or 0.0 for b in self.binding.bounds}
            for name, kind in self._spec.fields:
                if name in self._held and not kind.startswith("float"):
                    self._held[name] = round(self._held[name])
        fields.update(self._held)
        if self._spec.sequence:
            self._sequence = (self._sequence + 1) % self._framer.modulus
            fields[self._spec.sequence] = self._sequence
        if self.invalid and self._spec.invalid:
            fields[self._spec.invalid[0]] = self._spec.invalid[1]
        data = self._framer.encode(*(fields[n] for n in self._names))
        if self.corrupt:
            data = data[:-3] + bytes((data[-3] ^ 0x10,)) + data[-2:]
        if self.garbage and tick % 2:
            data = os.urandom(7) + self._spec.sync[:1] + data
        self.pty.send(data)


class TextMeter(VirtualDevice):
    """Lines in answer to the profile's request. The profile's own pattern says what a line must hold."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self.pty, self._lines = Pty(binding.port), LineReader()
        self.mute = self.half = False
        self.verbs = {v: self.flag(self, v) for v in ("mute", "half")}

    def plug(self) -> None:
        """Put the device (back) on its wire."""
        self.pty.plug()

    def unplug(self) -> None:
        """Pull its cable."""
        self.pty.unplug()

    def descriptors(self) -> list[int]:
        """What to wait on for input."""
        return [self.pty.master] if self.pty.master >= 0 else []

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer what has come in on `descriptor`."""
        for _ in self._lines.feed(self.pty.receive()):
            if not self.mute:
                line = self._line()
                self.pty.send(line[: len(line) // 2] if self.half else line)

    def _line(self) -> bytes:
        values = {b.channel.source.group: self.reading(b) or 0.0 for b in self.binding.bounds}
        pattern = self.binding.profile.bus_spec.pattern.pattern
        filled = re.sub(r"\(\?P<(\w+)>[^)]*\)", lambda m: f"{values.get(m[1], 0.0):+.5f}", pattern)
        return filled.strip("^$").encode() + b"\r\n"


class SlcanDevice(VirtualDevice):
    """A Lawicel adapter on a pty with a bus behind it."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self.pty = Pty(re.sub(r"^slcan:|@\d+$", "", binding.port))
        self.adapter = SlcanAdapter()

    def plug(self) -> None:
        """Put the device (back) on its wire."""
        if self.pty.master < 0:
            self.adapter = SlcanAdapter()
        self.pty.plug()

    def unplug(self) -> None:
        """Pull its cable."""
        self.pty.unplug()

    def descriptors(self) -> list[int]:
        """What to wait on for input."""
        return [self.pty.master] if self.pty.master >= 0 else []


class DriveOnSlcan(SlcanDevice):
    """The CiA-402 amplifier."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self.drive = Cia402Drive(binding.address, binding.profile.bus_spec.command[0])
        self.verbs = {
            "heartbeat": self.flag(self.drive, "heartbeat"),
            "power": self._power,
            "fault": self._fault,
            "stop": self._stop,
        }

    def _power(self, argument: str) -> None:
        if argument not in ("on", "off"):
            raise InputError(f"power: on or off was expected, found '{argument}'")
        self.drive.alive = argument == "on"
        self.drive.power_up()

    def _fault(self, argument: str) -> None:
        try:
            self.drive.fault(int(argument, 0) & 0xFFFF)
        except ValueError:
            raise InputError(f"fault: an error code as 0x2310 was expected, found '{argument}'") from None

    def _stop(self, argument: str) -> None:
        """The stop input is active for so many ms."""
        try:
            self.drive.stop_until_s = time.monotonic() + float(argument) * 1e-3
        except ValueError:
            raise InputError(f"stop: a time in ms as 50 was expected, found '{argument}'") from None

    @property
    def output(self) -> float:
        """What drives the plant, in the profile's unit."""
        profile = self.binding.profile.drive
        assert profile is not None
        return self.drive.command * profile.scale if self.drive.alive else 0.0

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer what has come in on `descriptor`."""
        answer, frames = self.adapter.feed(self.pty.receive())
        for frame in frames:
            self.drive.take(frame, now_s)
        self._send(answer, now_s)

    def tick(self, now_s: float, tick: int) -> None:
        """Send what is due at now_s."""
        for b in self.binding.bounds:
            if b.channel.source not in (STATUS_WORD, ERROR_CODE) and (raw := self.reading(b)) is not None:
                self.drive.od[b.channel.source].value = round(raw)
        self._send(b"", now_s)

    def _send(self, answer: bytes, now_s: float) -> None:
        frames = self.drive.tick(now_s)
        if answer or frames:
            self.pty.send(answer + self.adapter.encode(frames))


class DbcSender(SlcanDevice):
    """Sends the messages of a DBC file at their channels' rate."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self.mute = False
        self.verbs = {"mute": self.flag(self, "mute")}

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer what has come in on `descriptor`."""
        answer, _ = self.adapter.feed(self.pty.receive())
        self.pty.send(answer)

    def tick(self, now_s: float, tick: int) -> None:
        """Send what is due at now_s."""
        period = max(1, round(1.0 / (self.binding.bounds[0].channel.rate_hz * self.rig.stepper.period_s)))
        if self.mute or tick % period or not self.adapter.open:
            return
        database = self.binding.profile.bus_spec.database
        for name in {b.channel.source.message for b in self.binding.bounds}:
            message = database.get_message_by_name(name)
            values = dict.fromkeys((s.name for s in message.signals), 0.0)
            values.update(
                {
                    b.channel.source.signal: self.reading(b) or 0.0
                    for b in self.binding.bounds
                    if b.channel.source.message == name
                }
            )
            can_id = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
            self.pty.send(encode_slcan(can_id, bytes(message.encode(values, strict=False))))


class ModbusOnWire(VirtualDevice):
    """A register device over TCP or RTU. Voltage and current are means since the last refresh."""

    def __init__(self, binding: Binding, rig: PlantRig) -> None:
        super().__init__(binding, rig)
        self.unit = ModbusUnit(binding.address)
        tcp = re.fullmatch(r"tcp:(.+):(\d+)", binding.port)
        self._address = (tcp[1].strip("[]"), int(tcp[2])) if tcp else None
        self.pty = Pty(binding.port.removeprefix("rtu:"))
        self._server: socket.socket | None = None
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}
        self._buffer = bytearray()
        self._open: set[str] = set()
        self._sums = [0.0] * len(binding.bounds)
        self._summed = 0
        self._every = max(
            1, round(1 / (max(b.channel.rate_hz for b in binding.bounds) * rig.stepper.period_s))
        )
        self.verbs = {v: self.flag(self.unit, v) for v in ("silent", "half", "corrupt")}
        self.verbs |= {"exception": self._exception, "open": self._open_sensor, "close": self._close_sensor}
        self._refresh()

    def _exception(self, argument: str) -> None:
        if not argument.isdigit() or int(argument) > 11:
            raise InputError(f"exception: a code 1..11, or 0 for none, was expected, found '{argument}'")
        self.unit.exception = int(argument)

    def _channel(self, argument: str) -> str:
        names = [b.channel.name for b in self.binding.bounds]
        if argument not in names:
            raise InputError(f"no channel '{argument}'{suggest(argument, names)}; bound: {', '.join(names)}")
        return argument

    def _open_sensor(self, argument: str) -> None:
        self._open.add(self._channel(argument))
        self._refresh()

    def _close_sensor(self, argument: str) -> None:
        self._open.discard(self._channel(argument))
        self._refresh()

    def plug(self) -> None:
        """Put the device (back) on its wire."""
        if self._address is None:
            self.pty.plug()
        elif self._server is None:
            self._server = socket.create_server(
                self._address, family=socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
            )
            self._server.setblocking(False)

    def unplug(self) -> None:
        """Pull its cable."""
        self.pty.unplug()
        for client, _ in self._clients.values():
            client.close()
        self._clients.clear()
        if self._server is not None:
            self._server.close()
            self._server = None

    def descriptors(self) -> list[int]:
        """What to wait on for input."""
        if self._server is not None:
            return [self._server.fileno(), *self._clients]
        return [self.pty.master] if self.pty.master >= 0 else []

    def ready(self, descriptor: int, now_s: float) -> None:
        """Answer what has come in on `descriptor`."""
        if descriptor == self.pty.master:
            self._buffer += self.pty.receive()
            del self._buffer[:-1024]
            if answer := self.unit.feed_rtu(self._buffer):
                self.pty.send(answer)
        elif self._server is not None and descriptor == self._server.fileno():
            with contextlib.suppress(OSError):
                client, _ = self._server.accept()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._clients[client.fileno()] = (client, bytearray())
        elif descriptor in self._clients:
            client, buffer = self._clients[descriptor]
            try:
                data = client.recv(1024)
                buffer += data
                if answer := self.unit.feed_tcp(buffer):
                    client.send(answer)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                client.close()
                del self._clients[descriptor]

    def tick(self, now_s: float, tick: int) -> None:
        """Send what is due at now_s."""
        for i, b in enumerate(self.binding.bounds):
            if b.role in ("voltage_v", "current_a"):
                self._sums[i] += self.rig.true(b.role)
        self._summed += 1
        if self._summed >= self._every:
            self._refresh()

    def _refresh(self) -> None:
        for i, b in enumerate(self.binding.bounds):
            if b.channel.name in self._open and b.channel.source.sentinels:
                raw: float | None = b.channel.source.sentinels[0]
            elif b.role in ("voltage_v", "current_a") and self._summed:
                raw = self.raw(b, self.rig.measured(self.rig.index[b.role], self._sums[i] / self._summed))
            else:
                raw = self.reading(b)
            self.unit.store(b.channel.source, raw or 0.0)
            self._sums[i] = 0.0
        self._summed = 0


_KINDS: dict[str, type[VirtualDevice]] = {
    "serial-binary": EncoderStream,
    "serial-lines": TextMeter,
    "can-cia402": DriveOnSlcan,
    "can-dbc": DbcSender,
    "modbus": ModbusOnWire,
}


def virtual_device(binding: Binding, rig: PlantRig) -> VirtualDevice:
    """The device that plays `binding`. Raises InputError for a CAN port that is not slcan."""
    if binding.profile.bus.startswith("can") and not binding.port.startswith("slcan:"):
        raise InputError(
            f"{binding.place}: the virtual rig plays CAN devices on slcan ports only, found '{binding.port}'"
        )
    return _KINDS[binding.profile.bus](binding, rig)


class VirtualRig:
    """Plant, devices, control socket and reference recording; `run` until `stop`."""

    def __init__(self, settings: Any) -> None:
        folder = Path(settings.path).parent
        self.run_dir = (folder / settings.hal.run_dir).resolve()
        self.plant = make_rig(settings)
        bindings = [bind(node, folder) for node in settings.hal.devices]
        check_rig(bindings)
        self.devices = {b.name: virtual_device(b, self.plant) for b in bindings}
        self._amplifier = next((d for d in self.devices.values() if isinstance(d, DriveOnSlcan)), None)
        self.period_s = settings.loop.period_s
        self.stopping = False
        self.tick = self.slips = 0
        self.latest_s = 0.0  # the longest that a tick came late

    def run(self, announce: Callable[[str], None]) -> None:
        """Plug everything in and live in real time until `stopping`; everything is unplugged afterwards."""
        self.run_dir.mkdir(parents=True, exist_ok=True)
        control = _listen(self.run_dir / "control.sock")
        try:
            for device in self.devices.values():
                device.plug()
            with open(self.run_dir / "reference.csv", "w", buffering=1) as reference:
                reference.write(
                    "# the virtual rig's own truth; t is CLOCK_MONOTONIC\n"
                    f"t,{','.join(_REFERENCE)},drive,enabled\n"
                )
                for device in self.devices.values():
                    announce(f"{device.name}: {device.binding.port}")
                announce(f"control: {self.run_dir / 'control.sock'}; reference: {reference.name}; ready")
                self._live(control, reference)
            announce(f"{self.tick} periods, at most {self.latest_s * 1e3:.1f} ms late, {self.slips} left out")
        finally:
            for device in self.devices.values():
                device.unplug()
            control.close()
            with contextlib.suppress(OSError):
                (self.run_dir / "control.sock").unlink()

    def _live(self, control: socket.socket, reference: Any) -> None:
        every = max(1, round(1 / (REFERENCE_HZ * self.period_s)))
        deadline = time.monotonic()
        while not self.stopping:
            now_s = time.monotonic()
            due = int((now_s - deadline) / self.period_s) + 1 if now_s >= deadline else 0
            if due:
                self.latest_s = max(self.latest_s, now_s - deadline)
            if due > MAX_STEPS:
                self.slips += due - MAX_STEPS
                deadline += (due - MAX_STEPS) * self.period_s
                due = MAX_STEPS
            for _ in range(due):
                self._step(now_s)
                if self.tick % every == 0:
                    self._record(reference, deadline)
                deadline += self.period_s
            owners = {fd: d for d in self.devices.values() for fd in d.descriptors()}
            wait_s = max(0.0, deadline - time.monotonic())
            ready, _, _ = select.select([*owners, control.fileno()], [], [], wait_s)
            now_s = time.monotonic()
            for fd in ready:
                if fd == control.fileno():
                    self._serve(control)
                else:
                    owners[fd].ready(fd, now_s)

    def _step(self, now_s: float) -> None:
        self.plant.step(self._amplifier.output if self._amplifier else 0.0)
        self.tick += 1
        for device in self.devices.values():
            device.tick(now_s, self.tick)

    def _record(self, reference: Any, t: float) -> None:
        amplifier = self._amplifier
        values = [self.plant.true(r) if r in self.plant.index else float("nan") for r in _REFERENCE]
        if "output_reference_um" in self.plant.index:
            values[0] = self.plant.sense("output_reference_um")
        values += [amplifier.output, float(amplifier.drive.state == 0x27)] if amplifier else [0.0, 0.0]
        reference.write(f"{t:.6f}," + ",".join(f"{v:.6g}" for v in values) + "\n")

    def _serve(self, control: socket.socket) -> None:
        """One command of one client; a client that sends nothing is not waited for."""
        try:
            client, _ = control.accept()
        except OSError:
            return
        with client:
            client.settimeout(0.02)
            try:
                client.sendall(
                    (self.obey(client.recv(400).decode("utf-8", "replace").strip()) + "\n").encode()
                )
            except OSError:
                return

    def obey(self, line: str) -> str:
        """Do one control command; 'ok' or 'error: ...'. help | quit | DEVICE plug|unplug|VERB [ARGUMENT]."""
        name, _, rest = line.partition(" ")
        verb, _, argument = rest.strip().partition(" ")
        if name == "help":
            return "; ".join(f"{d.name} plug|unplug|{'|'.join(d.verbs)}" for d in self.devices.values())
        if name == "quit":
            self.stopping = True
            return "ok"
        device = self.devices.get(name)
        if device is None:
            return f"error: no device '{name}'{suggest(name, self.devices)}; one of {', '.join(self.devices)}"
        try:
            if verb in ("plug", "unplug"):
                device.plug() if verb == "plug" else device.unplug()
            elif verb in device.verbs:
                device.verbs[verb](argument.strip())
            else:
                known = ["plug", "unplug", *device.verbs]
                return f"error: {name}: '{verb}' is none of {', '.join(known)}{suggest(verb, known)}"
        except (InputError, OSError) as e:
            return f"error: {e}"
        return "ok"


def _listen(path: Path) -> socket.socket:
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    with contextlib.suppress(FileNotFoundError):
        tell(path, "help")
        server.close()
        raise InputError(f"{path}: another virtual rig is running; stop it first")
    if path.exists():
        path.unlink()  # left over from one that was killed
    server.bind(str(path))
    server.listen(4)
    server.setblocking(False)
    return server


def tell(path: Path, line: str) -> str:
    """Send one command to a running rig's control socket; returns its answer. FileNotFoundError where none runs."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(2.0)
        try:
            client.connect(str(path))
        except ConnectionRefusedError:
            raise FileNotFoundError(errno.ENOENT, "no virtual rig is running", str(path)) from None
        client.sendall(line.encode() + b"\n")
        return client.makefile().read().strip()


def main(settings: Any, command: str = "") -> int:
    """`thermoctl virtual-rig`: run until Ctrl-C or SIGTERM; or tell a running one `command`."""
    if command:
        path = (Path(settings.path).parent / settings.hal.run_dir).resolve() / "control.sock"
        try:
            answer = tell(path, command)
        except FileNotFoundError:
            raise InputError(
                f"{path}: no virtual rig is running; start `thermoctl virtual-rig` first"
            ) from None
        print(answer)
        return 1 if answer.startswith("error") else 0
    rig = VirtualRig(settings)

    def stop(*_: Any) -> None:
        rig.stopping = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        print(
            "no real-time priority (CAP_SYS_NICE): frames may come late when the machine is busy", flush=True
        )
    ctypes.CDLL(None).mlockall(3)  # current and future pages; may be refused
    gc.freeze()
    rig.run(lambda line: print(line, flush=True))
    return 0
