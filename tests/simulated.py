"""The simulated rig for tests: its rig file in a folder, and a whole schedule in simulated time."""

from __future__ import annotations

import dataclasses
import re
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.offline.simulate import Simulation

ROOT = Path(__file__).resolve().parents[1]
QUICK = 50  # heat capacities of a quick rig are divided by it: a thermal hour passes in 72 s
QUICK_LIMITS = (
    ("slew_um_s: 1", "slew_um_s: 50"),
    ("temperatures_c: 900", "temperatures_c: 18"),
    ("period_s: 7200", "period_s: 144"),
)
"""Changes of a rig file that go with a quick plant."""


def rig_file(folder: Path, *changes: tuple[str, str], name: str = "rig") -> Path:
    """Write config/simulated.yaml into `folder`, where its socket and its recordings are too; return its path.

    changes: texts of that file, and what replaces them.
    """
    text = (ROOT / "config/simulated.yaml").read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    for old, new in (
        ("plants/", f"{ROOT}/config/plants/"),
        ("models/", f"{ROOT}/config/models/"),
        ("../run/", f"{folder}/"),
        ("../recordings", f"{folder}/recordings"),
    ):
        text = text.replace(old, new)
    path = folder / f"{name}.yaml"
    path.write_text(text)
    return path


def quick_plant(plant: Path) -> str:
    """Return a shipped plant file's text with heat capacities QUICK times smaller, and without their ranges."""
    return re.sub(
        r"(  C_\w+: +\{value: )([\d.]+)(, unit: J/K), range: \[[^]]*\]",
        lambda m: f"{m[1]}{float(m[2]) / QUICK}{m[3]}",
        plant.read_text(),
    )


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
