"""Run the whole chain at the loop's own period: the daemon's law and the full plant, in simulated time.

Phase 1 (two processes): test 2; test 3 and test 4A, without compensation. Phase 2: test 4B with the paper's
and with the better compensator.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from tests.reproduction import paper
from tests.reproduction.plants import HEATED, quasi_static
from tests.reproduction.rigs import PAPER_SCALE, Simulated
from thermoctl import plant
from thermoctl.calibration import chain
from thermoctl.calibration.iso230 import mean_and_two_s
from thermoctl.calibration.recorded import Recorded, of_columns
from thermoctl.calibration.schedules import of_config
from thermoctl.calibration.simulated_rig import play, with_model
from thermoctl.configuration.settings import load_settings
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.offline.simulate import Simulation
from thermoctl.identify import experiments
from thermoctl.plant import extended
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table
from thermoctl.rig.signals import INDEX, NAMES, POINTS


def of_rows(rows: np.ndarray) -> Recorded:
    """Take record rows (N, signals) at 1 s as one test."""
    return of_columns(np.arange(len(rows), dtype=float), {n: rows[:, i] for n, i in INDEX.items()}, POINTS)


def run_test(
    config: str, truth: str, name: str, model: CompensatorModel | None, every: int = 1000, part: float = 1.0
) -> np.ndarray:
    """Run one test from rest; record one row every `every` ticks. `model` compensates, if given."""
    settings = load_settings(config)
    settings = dataclasses.replace(settings, hal=dataclasses.replace(settings.hal, truth=truth))
    test = experiments.load_experiments(of_config(config))[name]
    simulation = Simulation(with_model(settings, model), model)
    try:
        test = dataclasses.replace(test, duration_s=part * test.duration_s)
        return np.vstack(list(play(simulation, test, every)))
    finally:
        simulation.close()


def scaled_truth(plant_file: str | Path, path: Path) -> Path:
    """Write the truth plant with the rigs' larger expansions to `path`; return the absolute path."""
    p = plant.load(plant_file)

    def change(data: dict[str, Any]) -> None:
        """Multiply the expansions in place by their factors in PAPER_SCALE."""
        for k, factor in PAPER_SCALE.items():
            data["parameters"][k]["value"] *= factor

    plant.save(extended(p, change), path)
    return path.resolve()  # settings read a relative path from their own file's folder


def quasi_static_run(
    plant_file: Path,
    test: Recorded,
    schedule: experiments.Schedule,
    seed: int,
    compensation_um: np.ndarray | float = 0.0,
) -> Simulated:
    """Simulate the quasi-static plant on a full run's schedule and air, with its instruments.

    The coil moves by the schedule minus `compensation_um` (N,), the law's correction. A correction of 15 um
    in 250 um changes the heat by a tenth."""
    p = plant.load(plant_file)
    n = len(test.t)
    value = {k: v.value for k, v in p.parameters.items()}
    fine = np.arange(n * 10) / 10
    x = (schedule.at(fine) - np.interp(fine, test.t, np.broadcast_to(compensation_um, n))) * 1e-6
    v = np.gradient(x, 0.1)
    i = (value["k_flexure"] * x + value["b_eddy"] * v) / value["k_T"]
    columns = {
        "current": np.sqrt((i**2).reshape(n, 10).mean(1)),
        "eddy_w": (value["b_eddy"] * v**2).reshape(n, 10).mean(1),
        "air": chain.smooth_air(test.air_c),
        **{f"heat_{b}": np.zeros(n) for b in HEATED},
    }
    model = compile_plant(quasi_static(p))
    sim = model.simulate(Table("still", "still", np.arange(n, dtype=float), columns))
    names = list(model.outputs)
    true_c = sim.y[:, [names.index(f"{q}_c") for q in POINTS]]
    true_um = sim.y[:, names.index("error_um")] - sim.y[0, names.index("error_um")]
    rng = np.random.default_rng([seed, n])

    def read(y: np.ndarray, name: str) -> np.ndarray:
        """Return true values (N,) as read by output `name`: with its noise, rounded to its resolution."""
        o = p.outputs[name]
        return np.round((y + o.noise_sd * rng.standard_normal(y.shape)) / (o.resolution or 1e-9)) * (
            o.resolution or 1e-9
        )

    measured = np.column_stack([read(true_c[:, j], f"{q}_c") for j, q in enumerate(POINTS)])
    error = read(true_um, "output_reference_um") - read(np.zeros(n), "position_um")
    return Simulated(
        test.t,
        sim.y[:, names.index("power_w")],
        test.air_c,
        measured,
        error - error[:5].mean(),
        schedule.at(test.t),
        true_c,
        true_um,
    )


def agreement(full: Recorded, quasi: Simulated) -> dict[str, float]:
    """Compare the quasi-static run of a test with the full one.

    Temperature and position, rms and largest, and the energies' ratio.

    Both are averaged over each minute, which removes the instruments' steps."""
    minute = len(full.t) // 60 * 60

    def mean(a: np.ndarray) -> np.ndarray:
        """Return the mean of each whole minute (minutes, columns) of rows at 1 s."""
        return a[:minute].reshape(minute // 60, 60, -1).mean(1)

    dt = mean(quasi.true_c) - mean(full.temperatures)
    de = mean(quasi.true_um[:, None]) - mean(full.error_um[:, None])
    return {
        "temperature_rms_k": float(np.sqrt(np.mean(dt**2))),
        "temperature_max_k": float(np.abs(dt).max()),
        "position_rms_um": float(np.sqrt(np.mean(de**2))),
        "position_max_um": float(np.abs(de).max()),
        "position_range_um": float(np.ptp(mean(full.error_um[:, None]))),
        "energy_ratio": float(quasi.power_w.sum() / full.power_w.sum()),
    }


def run(
    config: str, plant_file: str, folder: Path, say: Callable[[str], object] = print, part: float = 1.0
) -> dict[str, Any]:
    """Run every test and return the figures; the recordings go into FOLDER/full_run.npz.

    `part` < 1: only that part of each test, for tests of this module.
    """
    truth = scaled_truth(plant_file, folder / "truth.yaml")
    with ProcessPoolExecutor(2) as pool:

        def submit(name: str, model: CompensatorModel | None) -> Future[np.ndarray]:
            """Start a test in the pool; `model`: of the compensator, None: without compensation."""
            return pool.submit(run_test, config, str(truth), name, model, 1000, part)

        waiting = {k: submit(k, None) for k in ("test_2", "test_3", "test_4a")}
        rows = {k: f.result() for k, f in waiting.items()}
        say("full run: calibration tests done")
        calibration = paper.calibrate(
            of_rows(rows["test_2"]), of_rows(rows["test_3"]), of_rows(rows["test_4a"])
        )
        models = {k: paper.compensator(calibration, k) for k in ("paper", "better")}
        waiting = {f"test_4b_{k}": submit("test_4b", m) for k, m in models.items()}
        rows |= {k: f.result() for k, f in waiting.items()}
        say("full run: compensated tests done")
    arrays: dict[str, Any] = {"columns": np.array(NAMES), **rows}
    np.savez_compressed(folder / "full_run.npz", **arrays)
    return judge(truth, rows, calibration, experiments.load_experiments(of_config(config)))


def judge(
    truth: Path,
    rows: dict[str, np.ndarray],
    calibration: paper.Calibration,
    tests: dict[str, experiments.Schedule],
) -> dict[str, Any]:
    """Compute (mean, 2 s) of test 4B over all samples at rest at the target.

    `paper`, `better`: the output's error under each compensator. `..._estimator`: the growth in the better
    compensator's run less each estimate. `still_...`: the same for the quasi-static plant. `agreement`: of
    the two plants over tests 2, 4A and 4B.
    """
    figures: dict[str, Any] = {}
    r = {k: of_rows(v) for k, v in rows.items()}
    for k in ("paper", "better"):
        w = rows[f"test_4b_{k}"]
        col = {n: w[:, i] for n, i in INDEX.items()}
        at_rest = np.abs(col["reference_um"] - col["setpoint_um"]) < 1e-9
        left = col["output_reference_um"] - col["reference_um"]
        figures[k] = mean_and_two_s((left - left[:5].mean())[at_rest])
    growth = r["test_4b_better"].error_um
    figures["uncompensated"] = mean_and_two_s(growth[at_rest])
    moved = rows["test_4b_better"][:, INDEX["compensation_um"]]
    quasi = {k: quasi_static_run(truth, r[k], tests[k], 1) for k in ("test_2", "test_3", "test_4a")}
    quasi["test_4b_better"] = quasi_static_run(truth, r["test_4b_better"], tests["test_4b"], 1, moved)
    again = paper.calibrate(quasi["test_2"], quasi["test_3"], quasi["test_4a"])
    for label, c, recording in (
        ("", calibration, r["test_4b_better"]),
        ("still_", again, quasi["test_4b_better"]),
    ):
        estimate = paper.estimates(c, recording, starts_anew=True)
        for k in ("siso", "paper", "better", "twelve"):
            error = recording.error_um - estimate[k]
            figures[f"{label}{k}_estimator"] = mean_and_two_s(
                (error - error[:60].mean())[at_rest[: len(error)]]
            )
    figures["still_uncompensated"] = mean_and_two_s(quasi["test_4b_better"].error_um[at_rest])
    figures["agreement"] = {k: agreement(r[k], quasi[k]) for k in ("test_2", "test_4a", "test_4b_better")}
    return figures
