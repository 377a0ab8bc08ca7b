"""A rig that lies in a home folder, as a clone does: `service install` refuses it, and its words lead to a unit that runs.

Boots a container of its own. Slow: `make test-systemd`.
"""

import re
import shutil
import time

import pytest

from tests.systemd.container import ROOT, Container, may_raise_limits, missing
from tests.systemd.test_booted import DROP_IN

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing())]
HOME = "/home/pi/rig"


@pytest.fixture
def container(tmp_path):
    c = Container(tmp_path)
    home, program = c.root / HOME.lstrip("/"), c.root / "home/pi/.venv/bin/thermoctl"
    shutil.copytree(ROOT / "config", home / "config")
    shutil.copy(home / "config/simulated.yaml", home / "config/rig.yaml")
    program.parent.mkdir(parents=True)
    shutil.copy(c.root / "opt/thermoctl/bin/thermoctl", program)
    if not may_raise_limits():
        drop_in = c.root / "etc/systemd/system/thermoctl.service.d/rights.conf"
        drop_in.parent.mkdir(parents=True)
        drop_in.write_text(DROP_IN)
    try:
        c.boot()
        yield c
    finally:
        c.remove()


def test_from_a_home_folder_to_a_unit_that_runs(container):
    """What the refusal says is done word for word; then the unit is READY."""
    said = container.run(
        "/home/pi/.venv/bin/thermoctl",
        "service",
        "install",
        "--config",
        f"{HOME}/config/rig.yaml",
        check=False,
    )
    assert "not installed" in said and "program /home/pi/.venv/bin/thermoctl" in said, said
    assert not container.file("/etc/systemd/system/thermoctl.service").exists()
    copy = re.search(rf"configuration {HOME}/config/rig.yaml: (cp -r \S+ \S+)", said)
    container.run("sh", "-ec", copy[1])
    for key, place in re.findall(r"write (\S+): (\S+)", said):
        name = key.partition(".")[2]
        container.run("sed", "-i", f"s|^\\(  {name}: *\\).*|\\1{place}|", "/etc/thermoctl/rig.yaml")
    installed = container.thermoctl("service", "install", "--config", "/etc/thermoctl/rig.yaml")
    assert "wrote /etc/systemd/system/thermoctl.service" in installed and "no user" not in installed, (
        installed
    )
    assert "thermoctl:x:" in container.run("getent", "passwd", "thermoctl")
    container.run("systemctl", "start", "thermoctl.service")
    begin = time.monotonic()
    while "READY" not in (
        status := container.thermoctl("status", "--config", "/etc/thermoctl/rig.yaml", check=False)
    ):
        assert time.monotonic() - begin < 60, status + container.run(
            "journalctl", "-u", "thermoctl", "--no-pager", check=False
        )
        time.sleep(0.2)
