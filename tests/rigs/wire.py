"""Rigs at wire level: the plants of a rig's axes behind a CAN adapter and a Modbus unit, in real time, and its rig file.

Every axis has a plant (tests/rigs/chain.py), its own node on the one CAN adapter and its own amplifier: an ODrive-like one
commanded by DBC messages, or a CiA-402 drive in cyclic position mode. One Modbus unit has all thermometers, of which the air's
is shared. Framing is that of tests/devices/emulators.py.
"""

from __future__ import annotations

import re
import struct
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from tests.devices.emulators import Frame, ModbusLine, Port, SlcanAdapter, Unit, encode
from tests.devices.test_drives import AXIS_DBC, POSITION_DRIVE, Drive, Positioner
from tests.rigs.chain import plants
from thermoctl.rig.channels import Channels, Point, of_points
from thermoctl_hal.simulated.rig import PlantRig, Surrounding

PERIOD_S, AIR_C, WATCHDOG_S = 0.005, 22.0, 0.6
READ = "rate_hz: 100, stale_after_s: 1"
HEAD = "format: thermoctl-device/1\nvendor: test\nmodel: test\n"
ENCODERS_AND_METER = """BO_ 9 Encoders: 8 A
 SG_ Position : 0|32@1- (1,0) [0|0] "nm" A
 SG_ Output : 32|32@1- (1,0) [0|0] "nm" A
BO_ 10 Electric: 8 A
 SG_ Voltage : 0|32@1- (0.0001,0) [0|0] "V" A
 SG_ Current : 32|32@1- (0.0001,0) [0|0] "A" A
"""
DBC = AXIS_DBC.replace('"Nm"', '"A"').replace("BO_ 14", f"{ENCODERS_AND_METER}BO_ 14", 1)
SENSORS = f"""
  position: {{message: Encoders, signal: Position, unit: nm, range: [-1e6, 1e6], {READ}}}
  output: {{message: Encoders, signal: Output, unit: nm, range: [-1e6, 1e6], {READ}}}
  voltage: {{message: Electric, signal: Voltage, unit: V, range: [-30, 30], {READ}}}
  current: {{message: Electric, signal: Current, unit: A, range: [-3, 3], {READ}}}
"""
SENSED = {
    "position": "position_um",
    "output": "output_reference_um",
    "voltage": "voltage_v",
    "current": "current_a",
}
TORQUE = f"""{HEAD}bus: can-dbc
dbc: axis.dbc
node_shift: 5
drive: {{unit: A, scale: 1, limits: [-2, 2], command_hz: 200, watchdog_s: {WATCHDOG_S}, state: {{channel: state, enabled: [8], disabled: [1]}},
  fault: error, command: {{message: Set_Torque, values: {{Torque: command}}}},
  enable: [{{message: Set_State, values: {{Requested: 8}}}}], disable: [{{message: Set_State, values: {{Requested: 1}}}}]}}
channels:
  state: {{message: Heartbeat, signal: State, unit: '1', {READ}}}
  error: {{message: Heartbeat, signal: Error, unit: '1', {READ}}}{SENSORS}"""
ENCODERS = f"{HEAD}bus: can-dbc\ndbc: axis.dbc\nnode_shift: 5\nchannels:{SENSORS}"


class Axis:
    """One axis at the wire: plant, amplifier, and the frames that its node sends."""

    def __init__(self, folder: Path, node: int, points: Sequence[str], mode: str, quick: float) -> None:
        folder.mkdir(exist_ok=True)
        self.node, self.points, self.mode = node, points, mode
        for path in plants(
            folder, points, mode
        ):  # bodies `quick` times smaller: a test takes seconds, not hours
            text = re.sub(
                r"(  C_\w+: \{value: )([\d.]+)", lambda m: f"{m[1]}{float(m[2]) / quick}", path.read_text()
            )
            path.write_text(text)
        channels: Channels = of_points(Point(p, role="" if k else "coil") for k, p in enumerate(points))
        air = Surrounding(AIR_C, 0.0, 1.0, 0.01, 0.005)
        self.plant = PlantRig(folder / "plant.yaml", PERIOD_S, "drive", {"air": air}, {}, node, channels)
        self.torque, self.positioner = Drive(), Positioner(node)
        self.positioner.actual = 0

    def take(self, frame: Frame) -> list[Frame]:
        """Obey a frame of the bus."""
        can_id, _, data = frame
        if self.mode == "position":
            return self.positioner.take(frame)
        if can_id >> 5 == self.node:
            if can_id & 31 == 7:
                self.torque.request(struct.unpack("<I", data)[0])
            elif can_id & 31 == 14:
                self.torque.feed(struct.unpack("<f", data)[0])
        return []

    @property
    def output(self) -> float:
        """What the amplifier gives, A, or its target, um; 0 when it is off."""
        if self.mode == "position":
            return self.positioner.actual * 0.01
        return self.torque.output

    @property
    def enabled(self) -> bool:
        """Whether the amplifier drives."""
        on = (
            self.positioner.state == 0x27
            if self.mode == "position"
            else self.torque.output != 0.0 or self.torque.state == 8
        )
        return bool(on)

    def frames(self) -> list[Frame]:
        """Return what the node sends by itself."""
        sense = self.plant.sense
        base = (self.node + 8 if self.mode == "position" else self.node) << 5
        found: list[Frame] = [
            (
                base | 9,
                False,
                struct.pack("<ii", *(round(sense(SENSED[s]) * 1e3) for s in ("position", "output"))),
            ),
            (
                base | 10,
                False,
                struct.pack("<ii", *(round(sense(SENSED[s]) * 1e4) for s in ("voltage", "current"))),
            ),
        ]
        if self.mode != "position":
            found.append((base | 1, False, struct.pack("<IB3x", self.torque.error, self.torque.state)))
        return found


class WireRig:
    """The axes' plants in real time, in a thread, until `close`."""

    def __init__(
        self, folder: Path, axes: dict[str, Sequence[str]], mode: str = "torque", quick: float = 1.0
    ) -> None:
        self.folder, self.mode = folder, mode
        self.axes = {
            name: Axis(folder / (name or "rig"), k + 3, points, mode, quick)
            for k, (name, points) in enumerate(axes.items())
        }
        (folder / "axis.dbc").write_text(DBC)
        (folder / "torque.yaml").write_text(TORQUE)
        (folder / "encoders.yaml").write_text(ENCODERS)
        (folder / "position.yaml").write_text(
            POSITION_DRIVE.replace("slew_per_s: 1000", "slew_per_s: 5000").replace(
                "[500, 2000]", "[-400, 400]"
            )
        )
        self.registers = ["air", *(f"{n}.{p}" if n else p for n, a in self.axes.items() for p in a.points)]
        (folder / "thermometers.yaml").write_text(
            f"{HEAD}bus: modbus\nmodbus: {{timeout_s: 0.5}}\nchannels:\n"
            + "\n".join(
                f"  t{k}: {{register: {k}, type: int16, scale: 0.01, unit: degC, range: [-50, 200], rate_hz: 20, stale_after_s: 3}}"
                for k in range(len(self.registers))
            )
        )
        self.unit, self.broken = Unit({4: {}}), set[int]()
        self._measure()
        self.can = Port(SlcanAdapter(*(a.take for a in self.axes.values())).take, folder / "can")
        self.modbus = Port(ModbusLine({1: self.unit}, False).take)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def devices(self) -> str:
        """Return the lines of hal.devices."""
        lines, can = [], f"slcan:{self.folder}/can@1000000"
        for name, axis in self.axes.items():
            of = f"{name}." if name else ""
            sensed = ", ".join(f"{c}: {of}{r}" for c, r in SENSED.items())
            if self.mode == "position":
                lines.append(
                    f"- {{name: drive{name}, profile: position.yaml, port: '{can}', address: {axis.node}, roles: {{state: {of}amplifier_state}}}}"
                )
                lines.append(
                    f"- {{name: encoders{name}, profile: encoders.yaml, port: '{can}', address: {axis.node + 8}, roles: {{{sensed}}}}}"
                )
            else:
                lines.append(
                    f"- {{name: drive{name}, profile: torque.yaml, port: '{can}', address: {axis.node}, "
                    f"roles: {{state: {of}amplifier_state, error: {of}amplifier_fault, {sensed}}}}}"
                )
        roles = ", ".join(f"t{k}: {r}_c" for k, r in enumerate(self.registers))
        lines.append(
            f"- {{name: thermometers, profile: thermometers.yaml, port: 'tcp:127.0.0.1:{self.modbus.number}', address: 1, roles: {{{roles}}}}}"
        )
        return "\n".join(f"    {line}" for line in lines)

    def rig_file(self, more: str = "", model: str = "") -> Path:
        """Write the rig file; more: lines of `protection`. A model is the file model.yaml below the axis' folder."""
        single = "" in self.axes
        declared = {
            name: "{"
            + ", ".join(f"{p}: {{role: coil}}" if not k else f"{p}: {{}}" for k, p in enumerate(a.points))
            + "}"
            for name, a in self.axes.items()
        }
        required = {
            n: f"[position_um, voltage_v, current_a, air_c, {a.points[0]}_c, amplifier_state]"
            for n, a in self.axes.items()
        }
        if single:
            head, own = f"points: {declared['']}\n", f"  required: {required['']}\n"
            model = f'"rig/{model}"' if model else '""'
        else:
            head, own = "axes:\n", ""
            for n in self.axes:
                of_model = f'"{n}/{model}"' if model else '""'
                head += f"  {n}:\n    points: {declared[n]}\n    protection: {{required: {required[n]}}}\n    compensation: {{model: {of_model}}}\n"
            model = '""'
        path = self.folder / "rig.yaml"
        path.write_text(f"""rig: {{name: wired}}
{head}loop: {{period_s: 10 ms, priority: 0}}
control: {{mode: {self.mode}, kp: 0.0003, ti_s: 0.05, output_limit: {300 if self.mode == "position" else 1.5}, setpoint_rate_um_s: 200}}
compensation: {{model: {model}, enable: true, bound_um: 100, slew_um_s: 50}}
protection:
{own}  stale_s: {{position_um: 2, voltage_v: 2, current_a: 2, air_c: 5, temperatures_c: 5}}
  late_s: 10
  following_um: 200
  following_s: 30
  coil_limit_c: 150
  coil_rate_k_s: 100
  innovation_limit_c: 50
  amplifier_s: 5
{more}recording: {{directory: recordings}}
hal:
  backend: devices
  devices:
{self.devices()}
socket: {{path: rig.sock}}
""")
        return path

    def registers_fail(self, name: str) -> None:
        """Break a thermometer: its reading lies outside its range from now on."""
        self.broken.add(self.registers.index(name))

    def _measure(self) -> None:
        values = [AIR_C, *(a.plant.sense(f"{p}_c") for a in self.axes.values() for p in a.points)]
        self.unit.set(4, 0, [-30000 if k in self.broken else round(v * 100) for k, v in enumerate(values)])

    def _live(self) -> None:
        due, tick = time.monotonic(), 0
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            due = max(due + PERIOD_S, time.monotonic() - 0.1)
            tick += 1
            for axis in self.axes.values():
                axis.plant.step(axis.output)
            if tick % 2 == 0:
                self.can.send(b"".join(encode(f) for a in self.axes.values() for f in a.frames()))
            if tick % 10 == 0:
                self._measure()

    def close(self) -> None:
        """Stop the plants and close the ports."""
        self._stop.set()
        self._thread.join(5)
        self.can.close()
        self.modbus.close()
