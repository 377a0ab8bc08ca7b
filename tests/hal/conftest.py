"""A rig at the wire for the tests of hal: virtual devices in this process, drivers unmodified, no daemon."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.devices.emulators import free_port
from thermoctl.files import yamlfile
from thermoctl.rig.channels import DEFAULT
from thermoctl_hal.base.backend import ROLE, STATUS_NAMES, Sample
from thermoctl_hal.virtual.rig import VirtualRig

CONFIG = Path(__file__).parents[2] / "config"

WIRING = """
- name: encoder
  profile: encoder-serial.yaml
  port: "{dir}/encoder"
  stale_after_s: 0.1     # the rig and the reader are threads of one process: either may stall for tens of ms
  roles: {{position: position_um}}
- name: drive
  profile: "{dir}/drive-cia402.yaml"
  port: "slcan:{dir}/can"
  stale_after_s: 0.1
  watchdog_s: 1        # as above
  roles: {{state: amplifier_state, fault: amplifier_fault, supply: supply_v}}
- name: thermocouples
  profile: thermocouples-modbus-12.yaml
  port: "tcp:127.0.0.1:{port}"
  roles: {{thermocouple_1: coil_c, thermocouple_9: shaft_1_c, pt100: air_c}}
- name: meter
  profile: meter-modbus.yaml
  port: "rtu:{dir}/meter"
  roles: {{voltage: voltage_v, current: current_a}}
"""
AIR = "{air: {mean: 22, swing: 0.5, period_s: 7200, noise: 0.02, resolution: 0.01}}"


def make_settings(directory: Path, **hal: object) -> SimpleNamespace:
    """Settings as settings.py makes them, of the part that hal reads."""
    values = {
        "backend": "simulated",
        "plant": str(CONFIG / "plants/actuator.yaml"),
        "truth": "",
        "drive_input": "drive",
        "inputs": yamlfile.loads(AIR),
        "roles": {},
        "seed": 1,
        "sensor_period_s": 0.1,
        "recording": "",
        "run_dir": str(directory),
        "devices": (),
        "faults": (),
    }
    return SimpleNamespace(
        path=str(CONFIG / "devices/rig.yaml"),
        loop=SimpleNamespace(period_s=0.001),
        channels=DEFAULT,
        protection=SimpleNamespace(required=tuple(ROLE)),
        hal=SimpleNamespace(**{**values, **hal}),
    )


class Wire:
    """A running virtual rig and, once opened, a back end that is ticked until a condition holds."""

    def __init__(self, settings: SimpleNamespace) -> None:
        self.settings = settings
        self.rig = VirtualRig(settings)
        self.thread = threading.Thread(target=self.rig.run, args=(lambda line: None,))
        self.thread.start()
        self.drive, self.enable = 0.0, False
        self.until(lambda _: (self.rig.run_dir / "reference.csv").exists(), tick=False)

    def until(
        self,
        condition: Callable[[Sample | None], bool],
        limit_s: float = 10.0,
        backend=None,
        tick: bool = True,
    ):
        """Tick (read, write) every millisecond until `condition(sample)`; returns the seconds it took."""
        begin = time.monotonic()
        sample = None
        while True:
            now = time.monotonic()
            if backend is not None and tick:
                sample = backend.read(now)
                backend.write(self.drive, self.enable)
            if condition(sample):
                return now - begin
            assert now - begin < limit_s, f"not within {limit_s} s: " + str(
                {r: STATUS_NAMES[sample.status[i]] for r, i in ROLE.items()} if sample is not None else ""
            )
            time.sleep(0.001)  # the pace of the loop, not a wait

    def stop(self) -> None:
        self.rig.stopping = True
        self.thread.join(10)
        assert not self.thread.is_alive()


@pytest.fixture
def wired(tmp_path):
    """Settings of the four wired devices, not running."""
    text = WIRING.format(dir=tmp_path, port=free_port())
    devices, node = CONFIG / "devices", "  node_id: 5\n"
    drive = (devices / "drive-cia402.yaml").read_text()
    patient = drive.replace(node, f"{node}  sdo_timeout_s: 2\n")  # both ends are threads of one process
    assert patient != drive
    (tmp_path / "drive-cia402.yaml").write_text(patient)
    (tmp_path / "drive-cia402.eds").write_bytes((devices / "drive-cia402.eds").read_bytes())
    return make_settings(
        tmp_path, backend="devices", devices=tuple(yamlfile.loads(text, "wiring.yaml").value)
    )


@pytest.fixture
def wire(wired):
    """The virtual rig, running."""
    w = Wire(wired)
    yield w
    w.stop()
