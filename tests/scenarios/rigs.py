"""Two rigs as a user would describe them, and both programs of a run: the bench and the daemon.

A: binary encoder, CiA-402 drive, thermocouple module (Modbus TCP), power meter (Modbus RTU). Limits: config/wire.yaml's.
B: text gauge, drive on the same CAN bus, thermocouple module; without voltage, current, air, reference and model.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.daemon.process import Daemon, wait
from tests.devices.emulators import free_port
from tests.scenarios import canbus

ROOT = Path(__file__).resolve().parents[2]

# Times of the rigs, s. The first five stand in config/wire.yaml's protection, the others in the profiles below.
POSITION_STALE_S, POSITION_FROZEN_S = 0.1, 0.5
METER_STALE_S, METER_FROZEN_S, TC_STALE_S = 0.5, 2.0, 1.0
DRIVE_STALE_S, WATCHDOG_S, HEARTBEAT_S = 0.1, 0.2, 0.02
METER_HZ, TC_HZ = 10, 10

PROFILES = {
    "encoder.yaml": """
format: thermoctl-device/1
vendor: emulator
model: binary encoder
bus: serial-binary
frame:
  sync: [0x7E, 0x81]
  length: false
  endian: big
  fields:
    - {name: counter, type: uint8}
    - {name: flags, type: uint8}
    - {name: nm, type: int32}
  crc: modbus
  sequence: counter
  invalid: {field: flags, mask: 1}
channels:
  position: {field: nm, unit: nm, range: [-1000000, 1000000], rate_hz: 1000, stale_after_s: POSITION_STALE}
""",
    "gauge.yaml": """
format: thermoctl-device/1
vendor: emulator
model: text gauge
bus: serial-lines
line: {baud: 115200}
text: {pattern: 'X (?P<x>[-+][0-9]+[.][0-9]+) um$'}
channels:
  position: {field: x, unit: um, range: [-1000, 1000], rate_hz: 500, stale_after_s: POSITION_STALE}
""",
    "drive.yaml": """
format: thermoctl-device/1
vendor: emulator
model: current drive
bus: can-cia402
cia402:
  eds: drive.eds
  node_id: 5
  mode: 10
  command: 0x6071
  transmit: [0x6041, 0x6077, 0x6079]
  heartbeat_s: HEARTBEAT
  watchdog_s: WATCHDOG
drive: {unit: A, scale: 0.001, limits: [-2, 2]}
channels:
  supply: {object: 0x6079, unit: V, scale: 0.001, range: [0, 60], rate_hz: 1000, stale_after_s: DRIVE_STALE}
  state: {object: 0x6041, unit: '1', rate_hz: 1000, stale_after_s: DRIVE_STALE}
  fault: {object: 0x603F, unit: '1', rate_hz: 1000, stale_after_s: DRIVE_STALE}
""",
    "meter.yaml": """
format: thermoctl-device/1
vendor: emulator
model: power meter
bus: modbus
line: {baud: 9600}
modbus: {unit_id: 1, timeout_s: METER_TIMEOUT, max_gap: 0}
channels:
  voltage: {register: 0, type: float32, unit: V, range: [-60, 60], rate_hz: METER_HZ, stale_after_s: METER_STALE}
  current: {register: 6, type: float32, unit: A, range: [-10, 10], rate_hz: METER_HZ, stale_after_s: METER_STALE}
""",
    "module.yaml": """
format: thermoctl-device/1
vendor: emulator
model: thermocouple module, full scale
bus: modbus
modbus: {unit_id: 1, timeout_s: TC_TIMEOUT}
channels:
"""
    + "".join(
        f"  tc{k}: {{kind: holding, register: {k}, type: uint16, scale: 0.020904860761, unit: degC, "
        "range: [0, 1369], rate_hz: TC_HZ, stale_after_s: TC_STALE, sentinels: [65535]}\n"
        for k in range(8)
    ),
    "tenths.yaml": """
format: thermoctl-device/1
vendor: emulator
model: thermocouple module, tenths
bus: modbus
modbus: {unit_id: 1, timeout_s: TC_TIMEOUT}
channels:
  tc0: {register: 0, type: int16, scale: 0.1, unit: degC, range: [-100, 500], rate_hz: TC_HZ, stale_after_s: TC_STALE,
        sentinels: [32767]}
  tc1: {register: 1, type: int16, scale: 0.1, unit: degC, range: [-100, 500], rate_hz: TC_HZ, stale_after_s: TC_STALE,
        sentinels: [32767]}
""",
}
DEVICES = {
    "A": """
    - {name: encoder, profile: encoder.yaml, port: ./A-encoder, roles: {position: position_um}}
    - name: drive
      profile: drive.yaml
      port: slcan:./A-can@1000000
      roles: {state: amplifier_state, fault: amplifier_fault, supply: supply_v}
    - name: thermocouples
      profile: module.yaml
      port: tcp:127.0.0.1:PORT
      roles: {tc0: coil_c, tc1: bobbin_c, tc2: inner_magnet_c, tc3: inner_stator_c, tc7: air_c}
    - {name: meter, profile: meter.yaml, port: rtu:./A-meter, roles: {voltage: voltage_v, current: current_a}}
""",
    "B": """
    - {name: gauge, profile: gauge.yaml, port: ./B-gauge, roles: {position: position_um}}
    - name: drive
      profile: drive.yaml
      address: 6
      port: slcan:./B-can@1000000
      roles: {state: amplifier_state, fault: amplifier_fault, supply: supply_v}
    - {name: thermocouples, profile: tenths.yaml, port: 'tcp:127.0.0.1:PORT', roles: {tc0: coil_c, tc1: bobbin_c}}
""",
}


def configuration(name: str, port: int) -> str:
    """The rig file: config/wire.yaml with these devices, and what rig B does not have taken away."""
    text = (ROOT / "config/wire.yaml").read_text()
    for pattern, instead in (
        (r"(?s)  # For the virtual rig only.*?  run_dir: \S+\n", ""),
        (r"(?s)  devices:\n.*?\n\n", f"  devices:{DEVICES[name].replace('PORT', str(port))}\n"),
        (r"\.\./run/wire\.sock", f"./{name}.sock"),
        (r"(?s)recording:\n.*?\n\n", "recording: {enable: false}\n\n"),
        (r"reference: true .*", "reference: false"),
        (r"models/wire.yaml.*", f"{ROOT}/config/models/wire.yaml"),
        (r"setpoint_rate_um_s: 1 mm/min", "setpoint_rate_um_s: 60"),
        # The drive's link voltage is never still: where it is, the drive repeats an old answer.
        (r"temperatures_c: 900\}", f"temperatures_c: 900, supply_v: {DRIVE_FROZEN_S}}}"),
        # 60 um/s are 0.2 A/s; the meter is 0.1 s behind; its own error is below 5 mA.
        (r"current_per_drive: 1.0", f"current_per_drive: 1.0\n  current_tolerance_a: {CURRENT_TOLERANCE_A}"),
    ):
        text, count = re.subn(pattern, instead.replace("\\", "\\\\"), text)
        assert count == 1, pattern
    if name == "B":
        for pattern, instead in (
            (r"required: .*", "required: [position_um, coil_c, amplifier_state]"),
            (r"name: wire", "name: B"),
            (r"  model: .*\n", ""),
            (
                r"  resistance_ohm: .*\n|  current_per_drive: .*\n|  current_tolerance_a: .*\n|  flexure_um_per_a: .*\n",
                "",
            ),
        ):
            text = re.sub(pattern, instead, text)
    return text


DRIVE_FROZEN_S = 1.0
CURRENT_TOLERANCE_A = 0.03


def write_rig(folder: Path, name: str, port: int, **changes: Any) -> Path:
    """Profiles and rig file in `folder`; `changes` replaces a time of the profiles. The rig file's path."""
    numbers = {
        "POSITION_STALE": POSITION_STALE_S,
        "METER_STALE": METER_STALE_S,
        "TC_STALE": TC_STALE_S,
        "DRIVE_STALE": DRIVE_STALE_S,
        "WATCHDOG": WATCHDOG_S,
        "HEARTBEAT": HEARTBEAT_S,
        "METER_HZ": METER_HZ,
        "TC_HZ": TC_HZ,
        "TC_TIMEOUT": 0.3,
        "METER_TIMEOUT": 0.15,
        **changes,
    }
    for file, text in PROFILES.items():
        for key, number in numbers.items():
            text = text.replace(key, str(number))
        (folder / file).write_text(text.lstrip())
    (folder / "drive.eds").write_text(canbus.eds())
    path = folder / f"{name}.yaml"
    path.write_text(configuration(name, port))
    return path


class Bench:
    """The emulators' process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.ports = folder, (free_port(), free_port())
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.scenarios.bench", str(folder), *map(str, self.ports)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._line() == "ready"

    def _line(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the bench ended"
        return json.loads(line)

    def tell(self, *command: Any) -> Any:
        """One command, its answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        return self._line()

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()


class Rigs:
    """The bench, both configurations, and the daemons that run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.bench = folder, Bench(folder)
        self.configs = {n: write_rig(folder, n, p) for n, p in zip("AB", self.bench.ports, strict=True)}
        self.daemons: dict[str, Daemon] = {}

    def daemon(self, name: str) -> Daemon:
        """The rig's daemon, started where it does not run."""
        if name not in self.daemons or self.daemons[name].process.poll() is not None:
            self.daemons[name] = Daemon(self.configs[name])
        return self.daemons[name]

    def stop(self, name: str) -> None:
        """End the rig's daemon where it runs."""
        if (daemon := self.daemons.pop(name, None)) is not None:
            daemon.stop()

    def seen(self, name: str) -> dict[str, Any]:
        """What happened behind the wire since the last mark."""
        return self.bench.tell("seen", name)

    def until(self, name: str, condition: Any, limit_s: float, what: str) -> dict[str, Any]:
        """Behind the wire, until condition(seen)."""
        return wait(lambda: (s := self.seen(name)) if condition(self.seen(name)) else None, what, limit_s)[0]

    def arm(self, name: str, setpoint_um: float | None = None) -> None:
        """Acknowledge, arm, and where a setpoint is given, move there; judged behind the wire."""
        daemon = self.daemon(name)
        wait(lambda: daemon.ask("arm")["ok"] or daemon.ask("disarm") and False, f"{name} armed", 30.0)
        if setpoint_um is not None:
            wait(lambda: daemon.ask("setpoint", value=setpoint_um)["ok"], "setpoint", 5.0)
            here = self.seen(name)["x_um"]
            way_s = abs(setpoint_um - here) / 60
            self.until(name, lambda s: abs(s["x_um"] - setpoint_um) < 1.5, 10 + 2 * way_s, "at the setpoint")

    def close(self) -> None:
        """End everything."""
        for daemon in self.daemons.values():
            daemon.kill()
        self.bench.close()
