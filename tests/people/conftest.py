"""A configuration of its own for each test, and a rig that runs on it."""

import tempfile
from pathlib import Path

import pytest
from browser import Browser, find

from thermoctl.configuration.settings import load_settings

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def settings():
    with tempfile.TemporaryDirectory(prefix="thermoctl") as folder:
        text = (ROOT / "config/simulated.yaml").read_text()
        for old, new in (
            ("plants/", f"{ROOT}/config/plants/"),
            ("models/", f"{ROOT}/config/models/"),
            ("../run/", f"{folder}/"),
            ("../recordings", f"{folder}/rec"),
        ):
            text = text.replace(old, new)
        path = Path(folder) / "rig.yaml"
        path.write_text(text)
        yield load_settings(path)


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
