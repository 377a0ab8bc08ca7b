"""The quick rig for all scenarios, and the table at the end where THERMOCTL_HAZARDS names a file."""

import os
import platform
import time
from pathlib import Path

import pytest

from tests.hazards import harness


@pytest.fixture(scope="session")
def quick(tmp_path_factory):
    """Settings of the quick rig."""
    return harness.quick_settings(tmp_path_factory.mktemp("quick"))


@pytest.fixture
def rig(quick):
    r = harness.HazardRig(quick)
    yield r
    r.close()


def pytest_sessionfinish(session, exitstatus):
    path = os.environ.get("THERMOCTL_HAZARDS")
    if path and harness.ROWS:  # a row is there only where its scenario was kept
        model = next(
            (
                line.split(":", 1)[1].strip()
                for line in Path("/proc/cpuinfo").read_text().splitlines()
                if line.startswith("model name")
            ),
            platform.machine(),
        )
        machine = (
            f"{os.cpu_count()} x {model}, Linux {platform.release()}, Python {platform.python_version()}"
        )
        Path(path).write_text(harness.page(harness.ROWS, machine, time.strftime("%Y-%m-%d")))
