"""A whole schedule in simulated time."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.offline.simulate import Simulation


def run_simulated(
    settings: Settings,
    schedule: Iterable[tuple[Any, ...]],
    duration_s: float,
    seed: int | None = None,
    every: int = 1,
    model: CompensatorModel | None = None,
) -> np.ndarray:
    """Run `duration_s` of rig time; returns every `every`-th row, (N, signals).

    schedule: (time_s, command, value) in order of time; command arm, disarm or setpoint (um). seed replaces
    hal.seed.
    """
    if seed is not None:
        settings = dataclasses.replace(settings, hal=dataclasses.replace(settings.hal, seed=seed))
    simulation = Simulation(settings, model)
    period_s = simulation.period_s
    waiting = deque((round(item[0] / period_s), *item[1:]) for item in schedule)
    ticks = round(duration_s / period_s)
    rows = np.empty((ticks // every, len(settings.row)))
    try:
        for k in range(ticks):
            while waiting and waiting[0][0] <= k:
                simulation.command(*waiting.popleft()[1:])
            simulation.tick()
            if (k + 1) % every == 0:
                rows[k // every] = simulation.row
    finally:
        simulation.close()
    return rows
