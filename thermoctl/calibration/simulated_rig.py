"""A rig in this process.

The configuration's simulated back end under the daemon's law, faster than real time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any

import numpy as np

from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.recorded import causes
from thermoctl.configuration.settings import Settings
from thermoctl.control import arming, faults
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.answers.snapshot import channel_states
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.daemon.tick.assemble import law_parameters
from thermoctl.identify.experiments import Aborted, Progress, Schedule
from thermoctl.identify.tuning import Gains
from thermoctl.recording.table import Table
from thermoctl.rig.signals import AT, fault_word
from thermoctl_hal.base.backend import HardwareError

EVERY_S = 0.1  # time between the rows that are kept
READY_S = 20.0  # longest simulated time until the law is READY
ANY_INNOVATION_C = 1e3  # unreachable limit: without a model there is nothing to compare the coil with


def with_model(settings: Settings, model: CompensatorModel | None) -> Settings:
    """Set up the compensation for a simulated test: with `model`, or none and no comparison."""
    compensation = dataclasses.replace(settings.compensation, enable=model is not None, model="")
    protection = settings.protection
    if model is None:
        protection = dataclasses.replace(protection, innovation_limit_c=ANY_INNOVATION_C)
    return dataclasses.replace(settings, compensation=compensation, protection=protection)


class SimulatedRig:
    """The configuration's simulated back end, in this process, each test from rest."""

    real = False

    def __init__(self, settings: Settings):
        self.settings, self.command_s = settings, settings.loop.period_s
        self.where = "the simulated rig, faster than real time"

    def simulation(self, settings: Settings, model: CompensatorModel | None = None) -> Simulation:
        """Make the rig of a session, at rest."""
        return Simulation(settings, model)

    def gains(self) -> Gains:
        """Return the gains in force."""
        c = self.settings.control
        return Gains(c.kp, c.ti_s, c.td_s, "present")

    def now(self) -> dict[str, Any]:
        """Read channel states, temperatures and position once the law is READY.

        Raises HardwareError after READY_S."""
        simulation = self.simulation(self.settings)
        try:
            ready = simulation.until(lambda row: row[AT["state"]] == arming.READY, READY_S)
            row = simulation.row
            if not ready:
                raise HardwareError(f"{self.settings.path}: not READY within {READY_S:g} s: {causes(row)}")
            measured = row[self.settings.row.measured].tolist()
            return {
                "channels": channel_states(row, self.settings.row),
                "temperatures_c": dict(zip(self.settings.channels.point_names, measured, strict=True)),
                "compensated_um": float(row[AT["compensated_um"]]),
            }
        finally:
            simulation.close()

    def run(
        self,
        schedule: Schedule,
        progress: Callable[[Progress], None],
        keyboard: Keyboard,
        earlier: Table | None = None,
        at_s: float = 0.0,
        model: CompensatorModel | None = None,
        every_s: float = EVERY_S,
        rest: bool = True,
        gains: Gains | None = None,
    ) -> Generator[np.ndarray, None, None]:
        """Yield the rows of a test, one every `every_s`, compensated by `model` if given.

        `gains` are applied after arming, without a jump. `earlier`, `at_s` and `rest` are not used: the rows
        are reproducible, and the rig starts at rest.
        Raises Aborted when the law leaves ARMED or the user ends it."""
        settings = with_model(self.settings, model)
        simulation = self.simulation(settings, model)

        def stop() -> bool:
            """Wait while the user pauses the test; return whether he has ended it."""
            while keyboard.pausing():
                pass
            return keyboard.ended

        try:
            if gains is not None:
                simulation.arm()
                tried = dataclasses.replace(settings.control, kp=gains.kp, ti_s=gains.ti_s, td_s=gains.td_s)
                simulation.reload(law_parameters(dataclasses.replace(settings, control=tried)))
                simulation.tick()
            every = max(1, round(every_s / simulation.period_s))
            yield from play(simulation, schedule, every, progress, stop)
        except RuntimeError:
            raise Aborted(f"not READY within {READY_S:g} s: {causes(simulation.row)}", 0.0) from None
        finally:
            simulation.close()


def play(
    simulation: Simulation,
    schedule: Schedule,
    every: int = 100,
    progress: Callable[[Progress], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[np.ndarray]:
    """Run a schedule on a rig, which is armed first; yield blocks of record rows, every `every`-th tick.

    Each block is given out before the next is computed, so an abort loses nothing. Raises Aborted when the
    law leaves ARMED (the fault bits are named) or `stop()` turns true."""
    period, waiting = simulation.period_s, schedule.commands()
    ticks = round(schedule.duration_s / period)
    block, began, k = [], time.monotonic(), 0
    state = AT["state"]
    if simulation.row[state] != arming.ARMED:
        simulation.arm()
    while k < ticks:
        while waiting and round(waiting[0][0] / period) <= k:
            simulation.command(*waiting.pop(0)[1:])
        coming = round(waiting[0][0] / period) if waiting else ticks
        count = min(every - k % every, coming - k, ticks - k)
        row = simulation.tick(count)
        k += count
        if k % every == 0:
            block.append(row.copy())
        left, full = row[state] != arming.ARMED, len(block) == 1000 or k == ticks
        if block and (full or left):
            yield np.array(block)
            block = []
        if full:
            if progress is not None:
                progress(Progress(k * period, schedule.duration_s, time.monotonic() - began))
            if stop():
                raise Aborted("stopped on request", k * period)
        if left:
            standing = [f.name for f in faults.decode(fault_word(row))]
            raise Aborted(f"the law left ARMED: {', '.join(standing) or 'no fault bit set'}", k * period)
