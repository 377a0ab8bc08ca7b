"""The systemd unit: installed below a directory, complete, and hardened as far as a real-time device driver can be."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from thermoctl.cli import main
from thermoctl.manual import PLACES


@pytest.fixture
def installed(config, tmp_path):
    root = tmp_path / "root"
    assert main(["service", "install", "--config", str(config), "--root", str(root)]) == 0
    return root


def test_install_and_uninstall_leave_nothing(installed, config):
    unit = (installed / "etc/systemd/system/thermoctl.service").read_text()
    assert "@PROGRAM@" not in unit and f"run --config {config}" in unit
    for line in ("Type=notify", "WatchdogSec=2", "MemoryDenyWriteExecute=yes", "LimitMEMLOCK=infinity"):
        assert line in unit
    assert len([p for p in installed.rglob("*") if p.is_file()]) == 4 + len(PLACES)
    assert main(["service", "uninstall", "--root", str(installed)]) == 0
    assert not [p for p in installed.rglob("*") if p.is_file()]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze (package systemd)")
def test_exposure_is_at_most_two(installed):
    unit: Path = installed / "etc/systemd/system/thermoctl.service"
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)],
        text=True,
        capture_output=True,
        check=False,
    )
    exposure = re.search(r"Overall exposure level for thermoctl.service: ([\d.]+)", done.stdout)
    assert exposure and float(exposure[1]) <= 2.0, done.stdout + done.stderr
