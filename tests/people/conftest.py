"""A configuration of its own for each test, and a rig that runs on it."""

import tempfile
from pathlib import Path

import pytest
from browser import Browser, find

from tests.simulated import rig_file
from thermoctl.configuration.settings import load_settings


@pytest.fixture
def settings():
    with tempfile.TemporaryDirectory(prefix="thermoctl") as folder:
        yield load_settings(rig_file(Path(folder)))


@pytest.fixture
def running(settings):
    from running import Running  # the daemon's rooms are loaded where they are used

    r = Running(settings)
    yield r
    r.close()


@pytest.fixture
def browser(tmp_path):
    program = find()
    if program is None:
        pytest.skip("no Chromium on this machine: the page is not driven (apt-get install chromium)")
    b = Browser(program, tmp_path / "browser")
    yield b
    b.close()
