"""The virtual rig: the devices of a configuration at the other end of their wires, in real time.

`hal.devices` lists the devices that the daemon uses; this program simulates them by the same profiles:

- a pty for each serial port, with a symbolic link at the port's path
- a Lawicel adapter, and behind it CiA-402 drives, amplifiers and senders of DBC files
- Modbus TCP servers and RTU units

One plant feeds them all (of a rig with axes one for each). The drive's command moves it. It writes to
`hal.run_dir`:

    reference.csv   data that the daemon never gets: the output's reference encoder and the true state,
                    100 rows a second, `t` on the machine's monotonic clock; columns of an axis: AXIS.NAME
    control.sock    one command line in, one line out: unplug cables and inject faults (`help` lists them)
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
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from thermoctl.configuration.settings import Settings
from thermoctl.files.safe_file import long_socket
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.rig.channels import AxesChannels
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.profiles.bind import bind, check_rig
from thermoctl_hal.simulated.rig import make_rig
from thermoctl_hal.virtual.device import VirtualDevice, channel_of
from thermoctl_hal.virtual.encoder import EncoderStream
from thermoctl_hal.virtual.plants import Plants, Readings
from thermoctl_hal.virtual.registers import ModbusOnWire
from thermoctl_hal.virtual.slcan import DbcAmplifier, DbcSender, DriveOnSlcan, SlcanLine
from thermoctl_hal.virtual.text_meter import TextMeter

MAX_STEPS = 50  # most periods simulated at once; after a longer stop the plant skips the rest
REFERENCE_HZ = 100
PRIORITY = 70  # real-time priority, below that of the daemon's loop
OWN = ("amplifier_state", "amplifier_fault", "supply_v")  # roles that need no output of the plant
TAKES = {"open": "CHANNEL", "close": "CHANNEL", "exception": "CODE", "fault": "CODE", "stop": "MS"}
"""Argument of a device's command; `on/off` of the others."""
MAX_COMMAND = 400  # bytes of a line to the control socket
_REFERENCE = ("output_reference_um", "position_um", "coil_c", "air_c")
_COLUMNS = (*_REFERENCE, "drive", "enabled")

_KINDS: dict[str, Callable[[Binding, Readings], VirtualDevice]] = {
    "serial-binary": EncoderStream,
    "serial-lines": TextMeter,
    "modbus": ModbusOnWire,
}


def virtual_device(
    binding: Binding, rig: Readings, lines: dict[str, SlcanLine] | None = None
) -> VirtualDevice:
    """Make the device that simulates `binding`; lines: the CAN adapters of the rig so far, by path.

    Raises InputError for a bus that it does not play, and for a CAN port that is not slcan."""
    bus, amplifier = binding.profile.bus, binding.profile.amplifier
    if not bus.startswith("can"):
        if bus not in _KINDS:
            raise InputError(f"{binding.place}: the virtual rig plays no {bus} device")
        return _KINDS[bus](binding, rig)
    if not binding.port.startswith("slcan:"):
        raise InputError(
            f"{binding.place}: the virtual rig plays CAN devices on slcan ports only, found '{binding.port}'"
        )
    path = re.sub(r"^slcan:|@\d+$", "", binding.port)
    line = ({} if lines is None else lines).setdefault(path, SlcanLine(path))
    kind = DriveOnSlcan if bus == "can-cia402" else DbcSender if amplifier is None else DbcAmplifier
    return kind(binding, rig, line)


class VirtualRig:
    """Plant, devices, control socket and reference recording; `run` until `stop`."""

    def __init__(self, settings: Settings) -> None:
        folder = Path(settings.path).parent
        self.run_dir = (folder / settings.hal.run_dir).resolve()
        several = isinstance(settings.channels, AxesChannels)
        self.axes = {p.axis: make_rig(p) for p in settings.parts} if several else {"": make_rig(settings)}
        self.plant: Readings = Plants(self.axes) if several else self.axes[""]
        bindings = [bind(node, folder, settings.channels) for node in settings.hal.devices]
        check_rig(bindings)
        lines: dict[str, SlcanLine] = {}
        self.devices = {b.name: virtual_device(b, self.plant, lines) for b in bindings}
        drives = [d for d in self.devices.values() if isinstance(d, DriveOnSlcan | DbcAmplifier)]
        self._amplifiers = {d.binding.axis: d for d in drives if d.binding.profile.amplifier is not None}
        self.notes = [note for b in bindings if (note := self._silent(b, settings.hal.plant))]
        self.period_s = settings.loop.period_s
        self.stopping = False
        self.tick = self.slips = 0
        self.latest_s = 0.0  # largest delay of a tick

    def _silent(self, binding: Binding, plant: str) -> str:
        """Return a line that names the device's channels of which the plant knows nothing, else ''."""
        roles = [b.role for b in binding.bounds if channel_of(b.role) not in OWN]
        lacking = [r for r in roles if r not in self.plant.index]
        if not lacking:
            return ""
        return f"note: {binding.name}: no output of {plant} is called {', '.join(lacking)}, and hal.roles names none: it reads 0 there"

    def run(self, announce: Callable[[str], None]) -> None:
        """Connect every device and run in real time until `stopping`; disconnect every device afterwards."""
        self.run_dir.mkdir(parents=True, exist_ok=True)
        control = _listen(self.run_dir / "control.sock")
        try:
            for device in self.devices.values():
                device.plug()
            with open(self.run_dir / "reference.csv", "w", buffering=1) as reference:
                reference.write(
                    "# the virtual rig's own truth; t is CLOCK_MONOTONIC\n"
                    f"t,{','.join(f'{a}.{n}' if a else n for a in self.axes for n in _COLUMNS)}\n"
                )
                for note in self.notes:
                    announce(note)
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

    def _live(self, control: socket.socket, reference: TextIO) -> None:
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
        for axis, plant in self.axes.items():
            plant.step(self._amplifiers[axis].output if axis in self._amplifiers else 0.0)
        self.tick += 1
        for device in self.devices.values():
            device.tick(now_s, self.tick)

    def _record(self, reference: TextIO, t: float) -> None:
        values = []
        for axis, plant in self.axes.items():
            amplifier = self._amplifiers.get(axis)
            own = [plant.true(r) if r in plant.index else float("nan") for r in _REFERENCE]
            if "output_reference_um" in plant.index:
                own[0] = plant.sense("output_reference_um")
            own += [amplifier.output, float(amplifier.enabled)] if amplifier else [0.0, 0.0]
            values += own
        reference.write(f"{t:.6f}," + ",".join(f"{v:.6g}" for v in values) + "\n")

    def _serve(self, control: socket.socket) -> None:
        """Obey one command of one client; wait 20 ms for it at most."""
        try:
            client, _ = control.accept()
        except OSError:
            return
        with client:
            client.settimeout(0.02)
            try:
                answer = self.obey(client.recv(MAX_COMMAND).decode("utf-8", "replace").strip())
                client.sendall(f"{answer}\n".encode())
            except OSError:
                return

    def obey(self, line: str) -> str:
        """Obey one control command; return 'ok' or 'error: ...'.

        help | quit | DEVICE plug|unplug|VERB [ARGUMENT]"""
        name, _, rest = line.partition(" ")
        verb, _, argument = rest.strip().partition(" ")
        if name == "help":
            return "; ".join(
                "|".join((f"{d.name} plug", "unplug", *(f"{v} {TAKES.get(v, 'on/off')}" for v in d.verbs)))
                for d in self.devices.values()
            )
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
    if long := long_socket(path, "hal.run_dir"):
        raise InputError(long)
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    with contextlib.suppress(FileNotFoundError):
        tell(path, "help")
        server.close()
        raise InputError(f"{path}: another virtual rig is running; stop it first")
    if path.exists():
        path.unlink()  # left by a virtual rig that was killed
    server.bind(str(path))
    server.listen(4)
    server.setblocking(False)
    return server


def tell(path: Path, line: str) -> str:
    """Send one command to a running rig; return its answer. FileNotFoundError where none runs."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(2.0)
        try:
            client.connect(str(path))
        except ConnectionRefusedError:
            raise FileNotFoundError(errno.ENOENT, "no virtual rig is running", str(path)) from None
        client.sendall(line.encode() + b"\n")
        return client.makefile().read().strip()


def main(settings: Settings, command: str = "") -> int:
    """Run `thermoctl virtual-rig` until Ctrl-C or SIGTERM; or send `command` to a running one."""
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

    def stop(*_: object) -> None:
        """End the run after the present period; `run` then disconnects the devices."""
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
