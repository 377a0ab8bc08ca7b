"""The whole chain at the wire: `thermoctl virtual-rig` and `thermoctl run`, two programs (issue 2, 'Must show' 2 and 5).

Slow: `python -m pytest -m slow tests/hal/test_wire_daemon.py`. Limits are for a busy machine.
Each cable and each kill: tests/hazards and tests/scenarios.
"""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

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


def test_killed_rig_is_a_fault_and_comes_back(chain):
    chain.arm()
    os.kill(chain.rig.pid, signal.SIGKILL)
    chain.rig.wait()
    chain.until(lambda s: s["state"] == "FAULT", 10)  # of whichever device is missed first
    chain.until(lambda s: any("position" in f["name"] for f in s["faults"]), 10)
    chain.rig = chain.start_rig()
    chain.arm()
