"""The whole chain at the wire: `thermoctl virtual-rig` and `thermoctl run`, two programs (issue 2, 'Must show' 2 and 5).

Slow: `python -m pytest -m slow tests/hal/test_wire_daemon.py`. Limits are for a busy machine; what was measured is printed.
"""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.daemon.process import forget
from tests.devices.emulators import free_port
from tests.hal.conftest import CONFIG
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.control_socket import ask
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import read_table
from thermoctl_hal.virtual.rig import tell

pytestmark = pytest.mark.slow
CLI = [sys.executable, "-m", "thermoctl.cli"]


class Chain:
    """Both programs on a private copy of config/wire.yaml."""

    def __init__(self, tmp_path):
        text = (
            (CONFIG / "wire.yaml").read_text().replace("15020", str(free_port())).replace("../run/", "./run/")
        )
        text = text.replace("../recordings", str(tmp_path / "recordings"))
        text = re.sub(r"(profile: |plant: |model: )(\w+/)", rf"\g<1>{CONFIG}/\g<2>", text)
        self.config, self.run_dir = tmp_path / "wire.yaml", tmp_path / "run/wire"
        self.config.write_text(text)
        self.socket = load_settings(self.config).socket.path
        self.rig = self.start_rig()
        self.daemon = subprocess.Popen([*CLI, "run", "--config", str(self.config)], stderr=subprocess.DEVNULL)
        try:
            self.until(lambda s: s.get("state") == "READY", 60)  # two programs' imports, on a busy machine
        except AssertionError:
            self.stop()
            raise

    def start_rig(self):
        rig = subprocess.Popen(
            [*CLI, "virtual-rig", "--config", str(self.config)], stdout=subprocess.PIPE, text=True
        )
        for line in rig.stdout:
            if "ready" in line:
                return rig
        raise AssertionError("the virtual rig did not start")

    def ask(self, command, value=None):
        try:
            return ask(self.socket, {"command": command, "value": value})
        except InputError as e:
            return {"ok": False, "state": "OFF", "error": str(e)}

    def status(self):
        return self.ask("status")

    def until(self, condition, limit_s):
        begin = time.monotonic()
        while not condition(s := self.status()):
            assert time.monotonic() - begin < limit_s, (s.get("state"), s.get("faults"), s.get("slips"))
            time.sleep(0.01)  # how often we ask, not a wait
        return s

    def tell(self, line):
        assert tell(self.run_dir / "control.sock", line) == "ok"

    def arm(self):
        """Acknowledge what stands, and arm; the machine may still be settling, so within a limit."""
        begin = time.monotonic()
        while not self.ask("arm")["ok"]:
            self.ask("disarm")
            assert time.monotonic() - begin < 20, self.status()
            time.sleep(0.05)
        return self.until(lambda s: s.get("state") == "ARMED", 10)

    def reference(self):
        return read_table(self.run_dir / "reference.csv")

    def stop(self):
        for process in (self.daemon, self.rig):
            process.terminate()
        for process in (self.daemon, self.rig):
            process.wait(20)


@pytest.fixture
def chain(tmp_path):
    c = Chain(tmp_path)
    yield c
    c.stop()


@pytest.mark.parametrize(
    "pull,plug,fault",
    [
        ("encoder unplug", "encoder plug", "position"),
        ("encoder mute on", "encoder mute off", "position"),
        ("drive unplug", "drive plug", "amplifier"),
        ("drive heartbeat off", "drive heartbeat on", "amplifier"),
        ("thermocouples unplug", "thermocouples plug", "coil"),
        ("meter unplug", "meter plug", "voltage"),
    ],
)
def test_pulled_cable_ends_in_its_fault_and_rearms_without_a_jump(chain, pull, plug, fault):
    chain.arm()
    assert chain.ask("setpoint", 20.0)["ok"]
    chain.until(lambda s: s["position_um"] is not None and abs(s["position_um"] - 20) < 1, 30)
    pulled = time.monotonic()
    chain.tell(pull)
    chain.until(lambda s: any(fault in str(f) for f in s["faults"]), 10)
    stopped = fault in ("position", "amplifier", "voltage")  # a lost thermocouple freezes the compensation
    if stopped:
        chain.until(lambda s: s["state"] == "FAULT", 5)
    chain.tell(plug)
    armed = chain.arm()
    assert abs(armed["setpoint_um"] - armed["position_um"]) < 0.5
    driven = chain.until(
        lambda s: s["ticks"] > armed["ticks"] + 1500, 10
    )  # the drive has been driving for a while
    assert driven["state"] == "ARMED", driven
    chain.stop()
    r = chain.reference()
    after = r.t > pulled
    off = after & (r.columns["enabled"] == 0)
    if stopped:
        print(f"{pull}: amplifier off {(r.t[off][0] - pulled) * 1e3:.0f} ms after the command was typed")
    on = r.columns["enabled"] > 0
    held = after[1:] & on[1:] & on[:-1]  # both rows driven: what the controller did
    assert (
        held.any() and np.abs(np.diff(r.columns["position_um"]))[held].max() < 2.0
    )  # re-armed without a jump


def test_killed_rig_is_a_fault_and_comes_back(chain):
    chain.arm()
    os.kill(chain.rig.pid, signal.SIGKILL)
    chain.rig.wait()
    chain.until(lambda s: s["state"] == "FAULT", 10)  # of whichever device is missed first
    chain.until(lambda s: any("position" in f["name"] for f in s["faults"]), 10)
    chain.rig = chain.start_rig()
    chain.arm()


def test_killed_daemon_leaves_the_amplifier_off(chain):
    chain.arm()
    for process in subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(chain.daemon.pid)], capture_output=True, text=True
    ).stdout.split():
        os.kill(int(process), signal.SIGKILL)  # our own children: loop, pollers, recorder
    chain.daemon.kill()
    chain.daemon.wait()
    forget(load_settings(chain.config))
    killed = time.monotonic()
    while time.monotonic() < killed + 1.0:
        assert "encoder" in tell(chain.run_dir / "control.sock", "help")  # the rig itself lives on
    chain.rig.terminate()
    chain.rig.wait(10)
    r = chain.reference()
    late = r.t > killed + 0.5  # watchdog 0.2 s
    assert late.any() and not r.columns["enabled"][late].any() and not r.columns["drive"][late].any()


@pytest.mark.parametrize("stop_ms", [5, 50, 550])
def test_a_stop_input_ends_driving_until_a_person_arms(chain, stop_ms):
    """The drive's quick stop, pulsed while the stage is held off its rest, with the shipped amplifier_s of 1 s."""
    chain.arm()
    assert chain.ask("setpoint", 15.0)["ok"]
    chain.until(lambda s: s["position_um"] is not None and abs(s["position_um"] - 15) < 1, 30)
    pulsed = time.monotonic()
    chain.tell(f"drive stop {stop_ms}")
    s = chain.until(lambda s: s["state"] == "FAULT", 5)
    assert "amplifier_stopped" in [f["name"] for f in s["faults"]] and s["control_v"] == 0.0
    ticks = s["ticks"]
    chain.until(lambda s: s["ticks"] > ticks + stop_ms + 1000, 20)
    assert not chain.ask("arm")["ok"]  # FAULT is acknowledged first
    again = time.monotonic()
    armed = chain.arm()
    assert abs(armed["setpoint_um"] - armed["position_um"]) < 0.5
    chain.until(lambda s: s["ticks"] > armed["ticks"] + 500, 20)  # the drive takes its time to enable
    chain.stop()
    r = chain.reference()
    on, at = r.columns["enabled"] > 0, r.t
    off = at[(at > pulsed) & ~on]
    print(f"stop of {stop_ms} ms: drive off {(off[0] - pulsed) * 1e3:.0f} ms after the command was typed")
    assert not on[(at > off[0]) & (at < again)].any()  # never driven again by itself
    driven = on[1:] & on[:-1] & (at[1:] > again)
    assert driven.any() and np.abs(np.diff(r.columns["position_um"]))[driven].max() < 2.0
