"""`make rigs`: rigs of any points from configuration alone, each calibrated and then compensated, judged by the reference.

For each rig: three tests of half an hour from rest are recorded, the model is identified from these recordings, and the
output's largest error over a fourth test is measured by the second encoder, with compensation off and on. Simulated time,
10 ms a tick.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.rigs.chain import plants, rig_text
from tests.simulated import run_simulated
from thermoctl.calibration import chain
from thermoctl.calibration.recorded import Recorded, filled, of_columns
from thermoctl.calibration.simulated_rig import with_model
from thermoctl.configuration.settings import Settings, load_settings
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.tick.assemble import compensator
from thermoctl.identify.modelfile import save_model
from thermoctl.rig.signals import AT

RIGS = {
    "a coil and a bench": (("coil", "bench"), "torque"),
    "a spindle in position mode": (("motor", "spindle_front_bearing", "rear_bearing", "frame"), "position"),
    "a stage with eight points": (("coil", *(f"stage_{k}" for k in range(1, 8))), "torque"),
}
TEST_S, HOLD_S, REACH_UM, FIRST_S = 1800.0, 90.0, 240.0, 30.0


def schedule(seed: int) -> list[tuple[float, str, float]]:
    """Return an arm command, and a setpoint every HOLD_S."""
    rng = np.random.default_rng(seed)
    times = np.arange(FIRST_S, TEST_S, HOLD_S)
    moves = [
        (float(t), "setpoint", float(um))
        for t, um in zip(times, rng.uniform(-1, 1, len(times)) * REACH_UM, strict=True)
    ]
    return [(FIRST_S - 10.0, "arm", 0.0), *moves]


def record(settings: Settings, seed: int, model: CompensatorModel | None = None) -> np.ndarray:
    """Return the rows of one test, one a second."""
    every = round(1.0 / settings.loop.period_s)
    return run_simulated(with_model(settings, model), schedule(seed), TEST_S, seed, every, model)


def recorded(settings: Settings, rows: np.ndarray) -> Recorded:
    """Return a test's rows for the identification, from the arming on."""
    rows = rows[round(FIRST_S) - 15 :]
    columns = {name: rows[:, i] for name, i in settings.row.index.items()}
    for name in ("power_w", "air_c"):
        columns[name] = filled(columns[name][:, None])[:, 0]
    return of_columns(np.arange(float(len(rows))), columns, settings.channels.point_names)


def calibrated(settings: Settings, order: int = 0) -> CompensatorModel:
    """Return the model from three tests."""
    tests = [recorded(settings, record(settings, seed)) for seed in (1, 2, 3)]
    _, kalman, _, expansion = chain.calibrate(tests, order or None)
    return chain.compensator(kalman, expansion, settings.loop.period_s, points=settings.channels.point_names)


def errors(settings: Settings, model: CompensatorModel | None) -> float:
    """Return the largest error of the output at rest over a test, um, less the encoders' difference at its start."""
    rows = record(settings, 4, model)
    assert rows[-1, AT["state"]] == 3.0, f"not ARMED at the end: fault bits {rows[-1, AT['fault_bits']]:.0f}"
    error = rows[:, AT["output_reference_um"]] - rows[:, AT["reference_um"]]
    rest = ((rows[:, AT["t_s"]] - FIRST_S) % HOLD_S > HOLD_S / 3) & (rows[:, AT["t_s"]] > FIRST_S)
    return float(np.abs(error[rest]).max())


def prove(folder: Path, names: Sequence[str], mode: str, order: int = 0) -> tuple[float, float]:
    """Calibrate and compensate one rig; return its largest error without and with compensation, um."""
    plants(folder, names, mode)
    path = folder / "rig.yaml"
    path.write_text(
        rig_text(names, mode=mode, period="10 ms").replace("kp: 0.001, ti_s: 0.01", "kp: 0.0003, ti_s: 0.02")
    )
    settings = load_settings(path)
    save_model(folder / "model.yaml", calibrated(settings, order), "chain")
    path.write_text(path.read_text().replace('model: ""', "model: model.yaml"))
    settings = load_settings(path)
    limits = replace(settings.protection, innovation_limit_c=20.0)
    return errors(settings, None), errors(replace(settings, protection=limits), compensator(settings))


def main() -> int:
    """Print the table."""
    print(f"{'rig':30}{'points':>7}{'error off':>12}{'error on, um':>14}")
    for name, (points, mode) in RIGS.items():
        with tempfile.TemporaryDirectory() as folder:
            off, on = prove(Path(folder), points, mode)
        print(f"{name:30}{len(points):7d}{off:12.2f}{on:14.3f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
