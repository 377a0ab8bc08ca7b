"""A simulated rig that ticks into a daemon's shared memory, in this process, with the daemon's command socket."""

import threading
import time
from pathlib import Path

import numpy as np

from thermoctl.daemon.command_server import Commands, listen, serve
from thermoctl.daemon.tick.assemble import compensator, law_parameters, shared_name
from thermoctl.daemon.tick.loop import Axis
from thermoctl.daemon.tick.shared import Shared
from thermoctl.rig.signals import INDEX
from thermoctl_hal.base.backend import ERROR, OK, ROLE
from thermoctl_hal.rig.make import make_backend


class Spoilt:
    """The back end, with channels that can be set to fail."""

    def __init__(self, inner):
        self.inner, self.broken = inner, set()

    def read(self, now_s):
        sample = self.inner.read(now_s)
        for role in self.broken:
            sample.status[ROLE[role]], sample.fresh[ROLE[role]] = ERROR, False
        return sample

    def write(self, drive, enable):
        self.inner.write(drive, enable)

    def problem(self, role):
        return f"thermocouples {role}: open wire" if role in self.broken else self.inner.problem(role)

    def mend(self, role):
        self.broken.discard(role)
        self.inner.read(0.0).status[ROLE[role]] = OK


class Running:
    """A daemon's ring, mailbox and command socket, ticked in simulated time by a thread that can be held."""

    def __init__(self, settings):
        self.settings = settings
        self.shared = Shared.create(shared_name(settings), settings.channels)
        backend = make_backend(settings)
        backend.open()
        self.backend = Spoilt(backend)
        self.rig = Axis(
            self.backend,
            compensator(settings),
            law_parameters(settings),
            settings.loop.period_s,
            self._publish,
            self.shared.mailbox,
            self.shared.parameters,
            self.shared.state,
            remarks=self.shared.make_remarks(settings.loop.period_s),
            channels=settings.channels,
        )
        self.rig.wall_s = lambda: self.base_s + self.now_s
        self.base_s, self.now_s, self.record = time.time(), 0.0, None
        self.lateness = np.random.default_rng(1)
        self.lock, self.stopping = threading.Lock(), threading.Event()
        self.threads = [
            threading.Thread(
                target=serve,
                daemon=True,
                args=(
                    listen(Path(settings.socket.path), None),
                    Commands(self.shared, settings, None, lambda *a, **k: None),
                    self.stopping.is_set,
                ),
            )
        ]

    def _publish(self, row):
        self.shared.ring.write(row)
        self.shared.lateness.add(row[INDEX["lateness_us"]])
        self.shared.busy.add(row[INDEX["busy_us"]])
        if self.record is not None:
            self.record(row)

    def tick(self, count=1):
        """So many ticks, at once."""
        with self.lock:
            for _ in range(count):
                self.now_s += self.settings.loop.period_s
                self.rig.tick(self.now_s, self.settings.loop.period_s, float(self.lateness.gamma(4.0, 15.0)))
        return self.rig.row

    def run(self, ticks=20, pause_s=0.02):
        """From now on, tick beside the test."""

        def pace():
            while not self.stopping.wait(pause_s):
                self.tick(ticks)

        self.threads.append(threading.Thread(target=pace, daemon=True))
        for thread in self.threads:
            thread.start()

    def send(self, kind, value=0.0):
        assert self.shared.mailbox.push(float(kind), value)

    def until(self, condition, what):
        """Tick until condition(row)."""
        for _ in range(60000):
            if condition(self.tick()):
                return
        raise AssertionError(what)

    def arm(self):
        self.until(lambda row: row[INDEX["state"]] == 2, "READY")
        self.send(1)
        self.until(lambda row: row[INDEX["state"]] == 3, "ARMED")

    def close(self):
        self.stopping.set()
        for thread in self.threads:
            if thread.ident:
                thread.join(5.0)
        self.remove()

    def remove(self):
        """As at the daemon's end."""
        self.shared.remove()
