"""loop.pace: device. The encoder's frame starts the tick; the clock does where no frame comes."""

from __future__ import annotations

import os
import threading
import time
import tty
from types import SimpleNamespace

import numpy as np
import pytest

from tests.hal.conftest import CONFIG
from tests.limits import OFF
from thermoctl.configuration.settings import load_settings
from thermoctl.control.model import Parameters, zero_model
from thermoctl.daemon.answers.display import counter_lines
from thermoctl.daemon.command_server import Commands
from thermoctl.daemon.tick.arrival import device_counters, put_counters, slow_readings
from thermoctl.daemon.tick.clock import now_ns
from thermoctl.daemon.tick.loop import Axis, run_loop
from thermoctl.daemon.tick.shared import Shared
from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.signals import AT, INDEX
from thermoctl_hal.base.backend import ROLE
from thermoctl_hal.base.wire import Framer
from thermoctl_hal.profiles.bind import bind
from thermoctl_hal.rig.devices import DevicesBackend
from thermoctl_hal.rig.make import driver

PERIOD_S = 0.005


class Encoder:
    """The other end of a pty, and the back end that reads it."""

    def __init__(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        text = f"{{name: encoder, profile: encoder-serial.yaml, port: {os.ttyname(slave)}, roles: {{position: position_um}}}}"
        binding = bind(yamlfile.loads(text, "wiring.yaml"), CONFIG / "devices")
        self.backend = DevicesBackend([driver(binding)], [])
        self.framer, self.sequence = Framer(binding.profile.bus_spec), 0
        self.backend.open()

    def frame(self):
        self.sequence = (self.sequence + 1) % 65536
        return self.framer.encode(self.sequence, 1000 + self.sequence, 0)


@pytest.fixture
def encoder():
    e = Encoder()
    yield e
    e.backend.close()
    os.close(e.master)


def wait(encoder, periods=2):
    begin = now_ns()
    encoder.backend.wait_frame(begin + int(PERIOD_S * 1e9), begin + int(periods * PERIOD_S * 1e9))
    return (now_ns() - begin) * 1e-9


def test_half_a_frame_is_no_frame(encoder):
    frame = encoder.frame()
    os.write(encoder.master, frame[:7])
    assert wait(encoder) >= 2 * PERIOD_S
    assert not encoder.backend.read(time.monotonic()).fresh[0]
    threading.Timer(PERIOD_S, os.write, (encoder.master, frame[7:])).start()
    assert wait(encoder, 400) < 300 * PERIOD_S  # woken by the rest of it
    sample = encoder.backend.read(time.monotonic())
    assert sample.fresh[ROLE["position_um"]] and sample.value[0] == pytest.approx(1001 * 0.005)
    assert not encoder.backend.read(time.monotonic()).fresh[0]  # a frame is shown once


def test_an_encoder_that_is_gone_leaves_the_clock(encoder):
    os.close(encoder.master)
    wait(encoder)
    assert PERIOD_S <= wait(encoder, 100) < 50 * PERIOD_S
    encoder.master = os.openpty()[0]


def test_ticks_follow_the_frames_and_go_on_without_them(encoder):
    shared = Shared.create(f"thermoctl-pace-{os.getpid()}")
    settings = SimpleNamespace(loop=SimpleNamespace(period_s=PERIOD_S, spin_s=0.0, pace="device"))
    parameters = Parameters(kp=0.01, ti_s=0.01, td_s=0.0, output_limit=1.0, **OFF)
    rig = Axis(encoder.backend, zero_model(), parameters, PERIOD_S, shared.ring, start_s=time.monotonic())
    muted, done = threading.Event(), threading.Event()

    def feed():
        while not muted.wait(0.8 * PERIOD_S):  # the encoder's clock is not ours
            os.write(encoder.master, encoder.frame())

    feeder = threading.Thread(target=feed)
    feeder.start()

    def stopping():
        if rig.law.tick == 150:
            muted.set()
        return done.is_set() or rig.law.tick >= 200

    try:
        run_loop(settings, shared, rig, stopping)
        rows, _, _ = shared.ring.read(0)
    finally:
        muted.set()
        feeder.join()
        shared.remove()
    fresh = rows[:, INDEX["fresh_bits"]].astype(int) & 1
    dt = rows[:, INDEX["dt_s"]]
    by_frame = dt[5:150] < 1.9 * PERIOD_S  # the others: the feeder itself came too late, the clock ticked
    assert fresh[5:150][by_frame].all() and by_frame.mean() > 0.5
    assert 0.5 * PERIOD_S < np.median(dt[5:150]) < 1.5 * PERIOD_S
    assert not fresh[160:].any() and np.median(dt[160:]) >= 1.99 * PERIOD_S


def test_status_has_the_counters_of_the_devices(encoder):
    """Frames and damaged frames are in `status --json` while the daemon runs, and a line of `status` names what was bad."""
    shared = Shared.create(f"thermoctl-counters-{os.getpid()}")
    settings = SimpleNamespace(loop=SimpleNamespace(period_s=0.001, spin_s=0.0, pace="clock"))
    parameters = Parameters(kp=0.01, ti_s=0.01, td_s=0.0, output_limit=1.0, **OFF)
    rig = Axis(encoder.backend, zero_model(), parameters, 0.001, shared.ring, start_s=time.monotonic())
    good = encoder.frame()
    os.write(encoder.master, good + good[:-1] + bytes([good[-1] ^ 1]) + encoder.frame())
    try:
        run_loop(settings, shared, rig, lambda: rig.law.tick >= 510)
        commands = Commands(shared, load_settings(CONFIG / "simulated.yaml"), None, lambda *a, **k: None)
        answer = commands.answer(b'{"command": "status"}', "test")
        assert answer["device_counters"] == {"encoder": encoder.backend.fast[0].counters()}
        assert answer["device_counters"]["encoder"]["frames"] == 2
        assert counter_lines(answer) == ["encoder: 2 frames, 1 errors"]
        before = answer["device_counters"]
        put_counters(shared, {f"device{k}.frames": k for k in range(1000)})  # do not fit: the old ones stay
        assert device_counters(shared) == before
    finally:
        shared.remove()


def test_who_cannot_give_the_time_is_told_so(tmp_path):
    with pytest.raises(InputError, match="loop.pace: device: the position comes from no device"):
        DevicesBackend([], []).check_pacing()
    text = (CONFIG / "simulated.yaml").read_text().replace("loop:", "loop:\n  pace: device", 1)
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(InputError, match=r"rig.yaml:\d+.*pace"):
        load_settings(tmp_path / "rig.yaml")


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ((), "slow, 100 of 1000 Hz"),
        (range(505, 510), "slow, 100 of 1000 Hz"),  # late before the next one: still too slow
        (range(2000), ""),  # lost: a fault says so
    ],
)
def test_a_slow_reading_is_said_though_it_was_late_for_a_moment(bad, said):
    rows = np.zeros((2000, AT["t_s"] + 1))
    rows[:, AT["t_s"]] = np.arange(2000) * 1e-3
    arrived, states = np.zeros((2000, 1), bool), np.zeros((2000, 1), int)
    arrived[::10], states[list(bad)] = True, 1
    shared = SimpleNamespace(
        ring=SimpleNamespace(head=len(rows), read=lambda start: (rows, 0, 0)),
        row=SimpleNamespace(arrived=lambda r: arrived, states=lambda r: states),
        channels=SimpleNamespace(names=("position_um",)),
    )
    lines = slow_readings(shared, {"position_um": 1000.0})
    assert said in " ".join(lines) if said else lines == []
