"""A position loop of known truth under the daemon's own tick, with skipped and late ticks, in simulated time.

Independent of the product's model of a loop: the plant moves in continuous time between the instants at which a command takes
effect; a command is sent at the first tick that is 1 / command_hz after the one before, and takes effect `dead_s` later.
"""

import dataclasses
import math
from collections import deque
from pathlib import Path

import numpy as np

from thermoctl.calibration.simulated_rig import SimulatedRig
from thermoctl.configuration.settings import load_settings
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.rig.channels import AT
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, OK, Sample

CONFIG = """\
rig: {{name: loop}}
loop: {{period_s: {period_s}}}
control:
  kp: {kp}
  ti_s: {ti_s}
  td_s: {td_s}
  output_limit: 1.5
  setpoint_rate_um_s: {rate_um_s}
  setpoint_low_um: -250
  setpoint_high_um: 250
  moving_average: {average}
protection:
  required: [position_um, amplifier_state]
  low: {{position_um: -400}}
  high: {{position_um: 400}}
  following_um: 20
  late_s: 5
recording: {{directory: recordings}}
hal: {{backend: simulated, plant: none.yaml, drive_input: drive}}
socket: {{path: loop.sock}}
"""


@dataclasses.dataclass(frozen=True)
class Truth:
    """What the product is not told, s and um: the plant, its dead time, the command's rate, the machine's ticks."""

    gain: float = 300.0
    t1_s: float = 0.012
    t2_s: float = 0.001
    dead_s: float = 0.002
    command_hz: float = 1000.0
    noise_um: float = 0.05
    skips: float = 0.0  # share of the ticks that a stall of the machine covers
    stall_ticks: float = 1.5  # mean number of ticks that one stall covers
    jitter_s: float = 0.0  # mean lateness of the other ticks
    period_s: float = 0.002


class Plant:
    """gain e^(-s dead) / ((t1 s + 1)(t2 s + 1)), moved exactly between the changes of its input."""

    def __init__(self, truth, delay_s=0.0):
        self.truth, self.dead_s = truth, truth.dead_s + delay_s
        self.now_s, self.u, self.x1, self.x2 = 0.0, 0.0, 0.0, 0.0
        self.coming = deque()

    def command(self, at_s, drive):
        self.coming.append((at_s + self.dead_s, drive))

    def position(self, at_s):
        while self.coming and self.coming[0][0] <= at_s:
            when, drive = self.coming.popleft()
            self._move(when)
            self.u = drive
        self._move(at_s)
        return self.truth.gain * self.x2

    def _move(self, to_s):
        dt = to_s - self.now_s
        if dt <= 0.0:
            return
        t1, t2 = self.truth.t1_s, self.truth.t2_s
        a, b = math.exp(-dt / t1), math.exp(-dt / t2)
        d1 = self.x1 - self.u
        # x2' = (x1 - x2)/t2 with x1 = u + d1 e^(-t/t1)
        through = d1 * t1 / (t1 - t2) * (a - b)
        self.x2 = self.u + (self.x2 - self.u) * b + through
        self.x1 = self.u + d1 * a
        self.now_s = to_s


class Backend:
    """`thermoctl_hal.base.backend.Backend` over a Plant: encoder and amplifier, nothing else."""

    def __init__(self, truth, channels, seed):
        self.truth, self.plant, self.random = truth, Plant(truth), np.random.default_rng(seed)
        self.sample = Sample(len(channels.names))
        self.last_s, self.now_s, self.enabled = -math.inf, 0.0, False
        self._roles = [AT["position_um"], AT["amplifier_state"], AT["amplifier_fault"]]

    def open(self):
        pass

    def read(self, now_s):
        s = self.sample
        self.now_s = now_s
        value = self.plant.position(now_s) + self.truth.noise_um * self.random.standard_normal()
        s.value[self._roles] = value, AMP_ENABLED if self.enabled else AMP_DISABLED, 0.0
        s.fresh[self._roles], s.time_s[self._roles], s.status[self._roles] = True, now_s, OK
        return s

    def write(self, drive, enable):
        if enable != self.enabled or self.now_s >= self.last_s + 1.0 / self.truth.command_hz:
            self.enabled, self.last_s = enable, self.now_s
            self.plant.command(self.now_s, drive if enable else 0.0)

    def close(self):
        self.write(0.0, False)

    def problem(self, role):
        return ""

    def counters(self):
        return {}


def late_ticks(truth, random):
    """Times of the ticks of a machine that is late and skips: (s, lateness s, skipped before it), without end."""
    k, skipped = 1, 0
    # a stall of n ticks begins with a probability that makes `skips` of all ticks
    begin = truth.skips / (truth.stall_ticks * (1.0 - truth.skips)) if truth.skips else 0.0
    while True:
        late = min(truth.jitter_s * random.gamma(2.0, 0.5), 0.95 * truth.period_s) if truth.jitter_s else 0.0
        yield k * truth.period_s + late, late, skipped
        skipped = int(random.geometric(1.0 / truth.stall_ticks)) if random.random() < begin else 0
        k += 1 + skipped


class LateSimulation(Simulation):
    """The daemon's tick at the times of `late_ticks`."""

    def __init__(self, truth, seed, settings, model=None, parameters=None):
        super().__init__(
            settings,
            model,
            parameters,
            publish=lambda row: None,
            backend=Backend(truth, settings.channels, seed),
        )
        self.times = late_ticks(truth, np.random.default_rng([seed, 1]))

    def tick(self, count=1):
        for _ in range(count):
            before = self.now_s
            self.now_s, late, skipped = next(self.times)
            self.rig.slips += skipped
            self.ticks += 1
            self.rig.tick(self.now_s, self.now_s - before, late * 1e6, lambda: 0)
        return self.row


def settings_of(folder, truth, kp, ti_s, td_s, rate_um_s=100.0, average=1):
    """The configuration of such a rig, in `folder`."""
    path = Path(folder) / "rig.yaml"
    path.write_text(
        CONFIG.format(
            kp=kp, ti_s=ti_s, td_s=td_s, rate_um_s=rate_um_s, average=average, period_s=truth.period_s
        )
    )
    return load_settings(path)


class LoopRig(SimulatedRig):
    """Such a loop as the rig of a command: each session from rest, at other instants."""

    def __init__(self, settings, truth, seed=0):
        super().__init__(settings)
        self.truth, self.seed, self.sessions = truth, seed, 0
        self.command_s = (
            max(1.0, math.ceil(1.0 / (truth.command_hz * truth.period_s) - 1e-9)) * truth.period_s
        )

    def simulation(self, settings, model=None):
        self.sessions += 1
        return LateSimulation(self.truth, 1000 * self.seed + self.sessions, settings, model)
