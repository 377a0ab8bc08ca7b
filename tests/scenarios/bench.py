"""All emulators of both rigs in one process, in real time, and what is true behind the wire.

`python -m tests.scenarios.bench FOLDER PORT_A PORT_B`: makes FOLDER/A-encoder, A-can, A-meter, B-gauge, B-can and two Modbus
servers, then takes one JSON list a line and answers each with one JSON line:

    ["inject", [[path, value], [path, value, seconds], [path, [arguments], seconds] ...], "A"]
                         set attributes, where seconds are given for so long; call methods, at once or after seconds
    ["mark", "A"]        begin to watch rig A anew
    ["seen", "A"]        what happened behind its wire since
    ["mend"]             every device as its maker built it, plugged in
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import select
import sys
import time
from pathlib import Path
from typing import Any

from tests.scenarios.canbus import OPERATIONAL, Adapter, Drive, Frame
from tests.scenarios.gauges import Encoder, PowerMeter, TextGauge, Thermocouples
from tests.scenarios.lines import Canary, Pty, TcpPort
from tests.scenarios.modbus import Registers, RtuServer, TcpServer
from tests.scenarios.plant import STEP_S, Plant

DRIVEN_A = 0.02  # more current than this is a driven coil, whoever says what
NODES = {"A": 5, "B": 6}
PRIORITY = 70  # below the loop's 80: hardware does not stall because a computer is busy


class Rig:
    """What is behind the wires of one rig."""

    def __init__(self, name: str, folder: Path, port: int, bus: Bus) -> None:
        self.name, self.plant = name, Plant(seed=NODES[name])
        self.can, self.adapter = Pty(folder / f"{name}-can"), Adapter()
        self.drive = Drive(NODES[name], bus.from_node(None))
        self.drive.send = bus.from_node(self.drive)
        self.sensor = (Encoder if name == "A" else TextGauge)(self.plant)
        self.line = Pty(folder / f"{name}-{'encoder' if name == 'A' else 'gauge'}")
        self.module = Thermocouples(self.plant, tenths=name == "B")
        self.tc = Registers(1, 3 if name == "A" else 4, self.module.read, seed=3)
        self.tc_server, self.tc_line = TcpServer(self.tc), TcpPort(port)
        self.power = PowerMeter(self.plant)
        self.meter = Registers(1, 4, self.power.read, seed=4)
        self.meter_server = RtuServer(self.meter, baud=9600, turn_s=0.01)
        self.meter_line = Pty(folder / f"{name}-meter") if name == "A" else None
        self.mark(time.monotonic())

    def mark(self, now_s: float) -> None:
        """Watch from now on."""
        self.since_s, self.last_driven_s, self.ons, self.far_um = now_s, now_s, 0, 0.0
        self.start_um, self.was_driven, self.stood_s = self.plant.x_um, self.driven, 0.0

    @property
    def driven(self) -> bool:
        """Whether the coil is driven: the output stage is on, or current flows."""
        return self.drive.stage_on or abs(self.plant.i_a) > DRIVEN_A

    def seen(self, now_s: float) -> dict[str, Any]:
        """What happened since `mark`."""
        return {
            "seconds": now_s - self.since_s,
            "driven": self.driven,
            "off_after_s": None if self.driven else self.last_driven_s - self.since_s,
            "ons": self.ons,
            "far_um": self.far_um,
            "stood_s": self.stood_s,
            "x_um": self.plant.x_um,
            "i_a": self.plant.i_a,
            "asked": self.tc.asked + self.meter.asked,
            "lost": self.tc.lost + self.meter.lost,
            "operational": self.drive.nmt == OPERATIONAL,
        }

    def step(self, now_s: float) -> None:
        """One millisecond."""
        drive = self.drive
        drive.step(now_s)
        self.plant.step(drive.target_a, drive.supply_v, drive.coil_open)
        drive.value[0x6077, 0] = round(self.plant.noisy(self.plant.i_a, 0.0005) * 1000)
        drive.value[0x6079, 0] = round(self.plant.noisy(drive.supply_v, 0.004) * 1000) & 0xFFFFFFFF
        driven = self.driven
        self.ons += driven and not self.was_driven
        self.was_driven = driven
        if driven:
            self.last_driven_s = now_s
            self.far_um = max(self.far_um, abs(self.plant.x_um - self.start_um))
        self.line.write(self.sensor.frame())

    def serve(self, now_s: float) -> None:
        """Modbus: requests in, answers out when due."""
        if data := self.tc_line.read():
            self.tc_server.take(data, now_s)
        if self.tc_line.client is None:
            self.tc_server.clear()
        self.tc_line.write(self.tc_server.due(now_s))
        if self.meter_line is not None:
            if data := self.meter_line.read():
                self.meter_server.take(data, now_s)
            self.meter_line.write(self.meter_server.due(now_s))

    def mend(self) -> None:
        """Everything plugged in and whole."""
        for port in (self.can, self.line, self.tc_line, self.meter_line):
            if port is not None:
                port.plug()
        self.adapter.bus_off = False
        for device in (self.plant, self.drive, self.sensor, self.module, self.tc, self.power, self.meter):
            device.mend()


class Bus:
    """The CAN bus that both rigs share: every frame reaches every other node and adapter."""

    def __init__(self) -> None:
        self.rigs: dict[str, Rig] = {}
        self.others: list[Drive] = []

    def from_node(self, node: Drive | None) -> Any:
        """How a node sends."""
        return lambda frame: self.pass_on(frame, node)

    def pass_on(self, frame: Frame, source: object) -> None:
        """A frame to all but its source."""
        now_s = time.monotonic()
        for node in [r.drive for r in self.rigs.values()] + self.others:
            if node is not source:
                node.take(frame, now_s)
        for rig in self.rigs.values():
            if rig.adapter is not source:
                rig.can.write(rig.adapter.encode(frame))

    def serve(self, rig: Rig) -> None:
        """What a host sent to its adapter."""
        if data := rig.can.read():
            answer, frames = rig.adapter.feed(data)
            rig.can.write(answer)
            for frame in frames:
                self.pass_on(frame, rig.adapter)
        elif rig.can.fd < 0:
            rig.adapter.open = False


class Bench:
    """Both rigs and the commands."""

    def __init__(self, folder: Path, ports: tuple[int, int]) -> None:
        self.bus = Bus()
        self.rigs = self.bus.rigs
        for name, port in zip("AB", ports, strict=True):
            self.rigs[name] = Rig(name, folder, port, self.bus)
        self.later: list[tuple[float, Any, Any]] = []
        self.canary = Canary()

    def answer(self, line: str) -> Any:
        """One command."""
        now_s = time.monotonic()
        name, *rest = json.loads(line)
        if name == "inject":
            steps, rig = rest
            self.rigs[rig].mark(now_s)
            for path, value, *seconds in steps:
                self._set(path, value, *seconds)
        elif name == "mark":
            self.rigs[rest[0]].mark(now_s)
        elif name == "mend":
            self.bus.others.clear()
            self.later.clear()
            for r in self.rigs.values():
                r.mend()
        elif name == "seen":
            return self.rigs[rest[0]].seen(now_s)
        else:
            raise ValueError(f"unknown command {name}")
        return True

    def twin(self, node: int) -> None:
        """One more drive on the bus with an address that is taken."""
        drive = Drive(node, lambda frame: None)
        drive.send = self.bus.from_node(drive)
        self.bus.others.append(drive)
        drive.restart()

    def kill(self, pid: int, number: int) -> None:
        """A signal to a process of the daemon."""
        os.kill(pid, number)

    def frame(self, can_id: int, extended: bool, data: str) -> None:
        """A frame that someone else sends."""
        self.bus.pass_on((can_id, extended, bytes.fromhex(data)), None)

    def _set(self, path: str, value: Any, seconds: float | None = None) -> None:
        first, _, rest = path.partition(".")
        target: Any = self.rigs.get(first, self)
        *parents, attribute = (rest or first).split(".")
        for parent in parents:
            target = getattr(target, parent)
        before = getattr(target, attribute)
        if callable(before) and seconds is None:
            before(*value)
        elif callable(before):
            self.later.append((time.monotonic() + seconds, before, value))
        else:
            setattr(target, attribute, value)
            if seconds is not None:
                self.later.append((time.monotonic() + seconds, setattr, (target, attribute, before)))

    def run(self) -> None:
        """Serve until the input ends."""
        due = time.monotonic()
        commands = b""
        while True:
            ready, _, _ = select.select([0], [], [], max(0.0, due - time.monotonic()))
            if ready:
                data = os.read(0, 65536)
                if not data:
                    return
                *lines, commands = (commands + data).split(b"\n")
                for text in lines:
                    print(json.dumps(self.answer(text.decode())), flush=True)
            for rig in self.rigs.values():
                self.bus.serve(rig)
            now_s = time.monotonic()
            # Devices and wires do not stand still; where this program or the kernel's terminals did, the run is void.
            late_s = max(now_s - due, self.canary.late_s(now_s))
            for rig in self.rigs.values():
                rig.stood_s = max(rig.stood_s, late_s)
            if now_s - due > 0.5:
                due = now_s
            while due <= now_s:
                due += STEP_S
                for _, action, arguments in [w for w in self.later if w[0] <= now_s]:
                    action(*arguments)
                self.later = [w for w in self.later if w[0] > now_s]
                for node in self.bus.others:
                    node.step(now_s)
                for rig in self.rigs.values():
                    rig.step(now_s)
            for rig in self.rigs.values():
                rig.serve(now_s)


def main() -> None:
    """Run the bench of the command line."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    bench = Bench(Path(sys.argv[1]), (int(sys.argv[2]), int(sys.argv[3])))
    gc.freeze()
    print(json.dumps("ready"), flush=True)
    bench.run()


if __name__ == "__main__":
    main()
