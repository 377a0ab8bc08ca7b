"""Hazards of two axes in one tick: a fault of one reaches the other as configured; a shared sensor's reaches both."""

import subprocess
import sys
import time

import psutil
import pytest

from tests.daemon.process import forget, wait
from tests.rigs.axes import Axes, simulated_axes
from tests.rigs.wire import WireRig
from thermoctl.configuration.settings import load_rig
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.tick.assemble import shared_name
from thermoctl.daemon.tick.shared import LOOP_PID, Shared
from thermoctl.rig.channels import AT
from thermoctl.rig.signals import AT as SIGNAL_AT
from thermoctl_hal.rig.make import make_backends

GO_ON = "  on_other_axis_fault: go_on"


def armed(folder, more=""):
    axes = Axes(load_rig(simulated_axes(folder, more=more)))
    for backend in axes.backends:
        backend.open()
    axes.ready()
    for axis in "xy":
        axes.send(axis, "arm")
    axes.tick(50)
    assert [axes.state(a) for a in "xy"] == ["ARMED", "ARMED"]
    return axes


def break_position(axes, axis):
    """The axis' encoder fails: its position is not finite from now on."""
    rig = axes.by_name[axis].backend.rig
    rig.measured = lambda i, value: float("nan") if i == rig.index["position_um"] else value


def enabled(axes, axis):
    return axes.by_name[axis].row[SIGNAL_AT["enable"]]


@pytest.mark.parametrize("axis, other", ["xy", "yx"])
def test_a_fault_of_one_axis_disarms_the_other_within_a_tick(tmp_path, axis, other):
    axes = armed(tmp_path)
    break_position(axes, axis)
    for _ in range(1000):
        axes.tick()
        if axes.state(axis) == "FAULT":
            break
    axes.tick()  # an axis that ticks before the faulty one knows of it a tick later
    assert axes.state(axis) == axes.state(other) == "FAULT"
    assert enabled(axes, axis) == enabled(axes, other) == 0.0
    assert axes.faults(other) == {"other_axis"} and "other_axis" not in axes.faults(axis)
    axes.send(other, "arm")
    assert axes.state(other) == "FAULT"  # latched
    axes.send(other, "disarm")  # acknowledged, but the other one still stands
    axes.tick(5)
    assert axes.state(other) == "SAFE" and "other_axis" in axes.faults(other)
    axes.send(other, "arm")
    axes.tick(5)
    assert axes.state(other) == "SAFE" and enabled(axes, other) == 0.0
    del axes.by_name[axis].backend.rig.measured
    axes.tick(50)
    axes.send(axis, "disarm")
    axes.ready()
    assert not axes.faults(axis) and not axes.faults(other)


def test_an_axis_that_goes_on_is_not_touched(tmp_path):
    axes = armed(tmp_path, GO_ON)
    break_position(axes, "x")
    axes.tick(200)
    assert axes.state("x") == "FAULT" and axes.state("y") == "ARMED"
    assert enabled(axes, "x") == 0.0 and enabled(axes, "y") == 1.0 and not axes.faults("y")


@pytest.fixture
def wired(tmp_path):
    """Two axes at the wire, each with its own amplifier, behind one CAN adapter and one Modbus unit."""
    rig = WireRig(tmp_path, {"x": ("coil", "bench"), "y": ("coil", "frame_1", "frame_2")})
    yield rig
    rig.close()


def open_axes(wired, more=""):
    settings = load_rig(wired.rig_file(more))
    axes = Axes(settings, make_backends(settings), time.monotonic)
    axes.backends[0].open()
    return axes


@pytest.mark.slow
def test_a_shared_sensor_reaches_both_axes_and_a_command_only_its_own(wired):
    axes = open_axes(wired)
    try:
        axes.until(lambda: all(axes.state(a) == "READY" for a in "xy"))
        axes.send("x", "arm")
        axes.until(lambda: wired.axes["x"].enabled)
        assert axes.state("y") == "READY" and not wired.axes["y"].enabled
        axes.send("y", "arm")
        axes.until(lambda: wired.axes["y"].enabled)
        values = [b.sample.value[AT["air_c"]] for b in axes.backends]
        assert values[0] == values[1] and abs(values[0] - 22.0) < 1.0
        wired.registers_fail("air")
        axes.until(lambda: all(axes.state(a) == "FAULT" for a in "xy"))
        assert all(axes.faults(a) & {"air_error", "air_stale"} for a in "xy")
        axes.until(lambda: not any(wired.axes[a].enabled for a in "xy"))
        assert all("thermometers" in b.problem("air_c") for b in axes.backends)
    finally:
        axes.close()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["loop", "all"])
def test_a_dead_daemon_leaves_both_amplifiers_off(wired, how):
    """loop: the supervisor switches both off. all: nobody is left, and the amplifiers' own watchdogs do it."""
    settings = load_rig(wired.rig_file())
    daemon = subprocess.Popen([sys.executable, "-m", "thermoctl.cli", "run", "--config", settings.path])
    try:
        for part in settings.axes:
            wait(lambda p=part: ask(p.socket.path, {"command": "status"})["state"] == "READY", "READY")
            wait(lambda p=part: ask(p.socket.path, {"command": "arm"})["ok"], "armed")
        wait(lambda: all(a.enabled for a in wired.axes.values()), "both amplifiers drive")
        loop = int(Shared.attach(shared_name(settings.axes[1])).counters[LOOP_PID])
        family = psutil.Process(daemon.pid).children(recursive=True) if how == "all" else []
        for process in [psutil.Process(daemon.pid), *family] if how == "all" else [psutil.Process(loop)]:
            process.kill()
        wait(lambda: not any(a.enabled for a in wired.axes.values()), "both amplifiers off", 10.0)
        if how == "loop":
            assert daemon.wait(30) == 1
    finally:
        daemon.kill()
        daemon.wait()
        forget(settings)
