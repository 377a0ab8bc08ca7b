"""A rig of several axes: its rig file from those of one, and the axes' simulation in one tick."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tests.rigs.chain import plants
from thermoctl.configuration.settings import Settings
from thermoctl.control import arming, faults
from thermoctl.daemon.offline.simulate import COMMANDS
from thermoctl.daemon.processes import guard
from thermoctl.daemon.tick.assemble import compensator, law_parameters
from thermoctl.daemon.tick.loop import Axis
from thermoctl.daemon.tick.ring import Mailbox
from thermoctl.rig.signals import AT, fault_word
from thermoctl_hal.rig.make import make_backends

NAMES = ("x", "y", "z", "u")


def simulated_axes(
    folder: Path, points: Sequence[str] = ("coil", "bench"), axes: int = 2, more: str = ""
) -> Path:
    """Write the plant and the rig file of simulated axes, each with these points; return the rig file.

    more: lines added to the section `protection` of every axis."""
    plants(folder, points)
    own = "\n".join(
        f"  {name}:\n    points: {{{', '.join(f'{p}: {{role: coil}}' if not k else f'{p}: {{}}' for k, p in enumerate(points))}}}"
        + f"\n    protection: {{required: [position_um, voltage_v, current_a, air_c, {points[0]}_c]}}\n    hal: {{seed: {k + 1}}}"
        for k, name in enumerate(NAMES[:axes])
    )
    path = folder / "rig.yaml"
    path.write_text(f"""rig: {{name: stage}}
axes:
{own}
loop: {{period_s: 1 ms, priority: 0, pace: tick}}
control: {{kp: 0.001, ti_s: 0.01, output_limit: 1.5, setpoint_rate_um_s: 100}}
protection:
  low: {{position_um: -400, temperatures_c: 0}}
  high: {{position_um: 400, temperatures_c: 120}}
  stale_s: {{position_um: 0.1, temperatures_c: 2}}
  following_um: 50
{more}
recording: {{directory: recordings}}
hal:
  backend: simulated
  plant: plant.yaml
  drive_input: drive
  inputs: {{air: {{mean: 22.0, noise: 0.02, resolution: 0.01}}}}
socket: {{path: rig.sock}}
""")
    return path


class Axes:
    """The axes of a rig in one tick, without processes."""

    def __init__(
        self, settings: Settings, backends: list | None = None, clock: Callable[[], float] | None = None
    ) -> None:
        """clock: real time; None: the ticks count the time."""
        self.clock = clock
        self.backends = backends or make_backends(settings)
        self.parts, self.now_s, self.period_s = settings.parts, 0.0, settings.loop.period_s
        self.rigs = [
            Axis(
                b,
                compensator(p),
                law_parameters(p),
                self.period_s,
                lambda row: None,
                Mailbox(np.zeros(2, np.uint64), np.zeros((64, 2))),
                channels=p.channels,
            )
            for b, p in zip(self.backends, self.parts, strict=True)
        ]
        guard(self.rigs, self.parts)
        self.by_name = {p.axis: r for p, r in zip(self.parts, self.rigs, strict=True)}

    def tick(self, count: int = 1) -> None:
        """Tick every axis so many times."""
        for _ in range(count):
            before, self.now_s = self.now_s, self.clock() if self.clock else self.now_s + self.period_s
            for rig in self.rigs:
                rig.tick(self.now_s, self.now_s - before if before else self.period_s)

    def until(self, condition: Callable[[], bool], limit_s: float = 60.0) -> None:
        """Tick in real time until `condition`."""
        end = time.monotonic() + limit_s
        while not condition():
            found = {a: (self.state(a), self.faults(a)) for a in self.by_name}
            assert time.monotonic() < end, found
            self.tick()
            time.sleep(self.period_s)  # the pace of a loop, not a wait

    def close(self) -> None:
        """Disable and close the back ends."""
        for backend in self.backends:
            backend.close()

    def send(self, axis: str, command: str, value: float = 0.0) -> None:
        """Give a command to one axis, and tick."""
        assert self.by_name[axis].mailbox.push(COMMANDS[command], value)
        self.tick()

    def ready(self, limit: int = 5000) -> None:
        """Tick until every axis is READY."""
        for _ in range(limit):
            self.tick()
            if all(self.state(a) == "READY" for a in self.by_name):
                return
        raise AssertionError({a: (self.state(a), self.faults(a)) for a in self.by_name})

    def state(self, axis: str) -> str:
        """Return the state of an axis."""
        return arming.STATES[int(self.by_name[axis].row[AT["state"]])]

    def faults(self, axis: str) -> set[str]:
        """Return the faults of an axis, active and latched."""
        return {f.name for f in faults.decode(fault_word(self.by_name[axis].row))}
