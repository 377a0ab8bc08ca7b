"""The rigs of config/examples at the wire, on the virtual rig: other points, two axes, a DBC amplifier, a position drive."""

import re
import shutil
import threading
import time
from pathlib import Path

import pytest

from tests.devices.emulators import free_port
from tests.rigs.axes import Axes
from thermoctl.configuration.settings import load_rig
from thermoctl_hal.rig.make import make_backends
from thermoctl_hal.virtual.rig import VirtualRig

pytestmark = pytest.mark.slow  # in real time: make test-wire
CONFIG = Path(__file__).resolve().parents[2] / "config"


@pytest.fixture
def example(tmp_path):
    """Returns a function: the virtual rig of an example and its axes in one tick."""
    running = []

    def start(name):
        for folder in ("devices", "examples"):
            shutil.copytree(CONFIG / folder, tmp_path / "config" / folder)
        odrive = tmp_path / "config/devices/library/odrive-cansimple.yaml"  # patient with a loaded machine
        odrive.write_text(odrive.read_text().replace("watchdog_s: 0.1", "watchdog_s: 1"))
        path = tmp_path / "config/examples" / f"{name}.yaml"
        path.write_text(re.sub(r"(127\.0\.0\.1:)\d+", rf"\g<1>{free_port()}", path.read_text()))
        settings = load_rig(path)
        virtual = VirtualRig(settings)
        thread = threading.Thread(target=virtual.run, args=(lambda line: None,), daemon=True)
        thread.start()
        begun = time.monotonic()
        while not (virtual.run_dir / "reference.csv").exists():
            assert time.monotonic() < begun + 20
            time.sleep(0.01)  # how often we look
        axes = Axes(settings, make_backends(settings), time.monotonic)
        running.append((axes, virtual, thread))
        axes.backends[0].open()
        return virtual, axes

    yield start
    for axes, virtual, thread in running:
        axes.close()
        virtual.stopping = True
        thread.join(10)
        assert not thread.is_alive()


@pytest.mark.parametrize("name, other", [("small", ""), ("spindle", ""), ("stage", "y")])
def test_an_example_is_driven_at_the_wire(example, name, other):
    virtual, axes = example(name)
    driven = next(iter(axes.by_name))
    axes.until(lambda: all(axes.state(a) == "READY" for a in axes.by_name))
    axes.send(driven, "arm")
    axes.until(lambda: virtual._amplifiers[driven].enabled)
    axes.send(driven, "setpoint", 60.0)
    axes.until(lambda: abs(virtual.axes[driven].true("position_um") - 60.0) < 1.0)
    assert not other or (axes.state(other) == "READY" and not virtual._amplifiers[other].enabled)
    axes.send(driven, "disarm")
    axes.until(lambda: not virtual._amplifiers[driven].enabled)


def test_a_dbc_amplifier_stops_without_commands_and_shows_a_fault(example):
    virtual, axes = example("small")
    axes.until(lambda: axes.state("") == "READY")
    axes.send("", "arm")
    axes.until(lambda: virtual._amplifiers[""].enabled and axes.state("") == "ARMED")
    begun = time.monotonic()
    while virtual._amplifiers[""].enabled:  # its watchdog: nobody ticks
        assert time.monotonic() < begun + 5
        time.sleep(0.01)
    axes.until(lambda: axes.state("") == "FAULT")
    assert virtual.obey("drive fault 0x40") == "ok"
    axes.until(lambda: virtual._amplifiers[""].error == 0.0)  # reset by the driver while it is off
    axes.until(lambda: axes.send("", "disarm") or axes.state("") == "READY")  # the reset must be reported
