"""The whole chain at the loop's own period: the daemon's law and the full electromechanical plant, in simulated time.

Phase 1 (two processes): test 2; test 3 and test 4A, without compensation. Phase 2: test 4B with the paper's and with the better compensator.
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl import plant
from thermoctl.calibration import chain
from thermoctl.calibration.iso230 import mean_and_two_s
from thermoctl.control.model import CompensatorModel
from thermoctl.identify import experiments
from thermoctl.plant import extended
from thermoctl.plant.simulate import compile_plant
from thermoctl.recording.table import Table
from thermoctl.reproduction import rigs
from thermoctl.signals import INDEX, NAMES, POINTS


def recorded(rows: np.ndarray, schedule: experiments.Schedule | None = None) -> rigs.Recorded:
    """Record rows (N, signals) at 1 s as one test; the position error is the two encoders' difference from its first value."""
    col = {n: rows[:, i] for n, i in INDEX.items()}
    temperatures = np.column_stack([col[f"{p}_c"] for p in POINTS])
    error = col["output_reference_um"] - col["position_raw_um"]
    error = error - np.nanmean(error[:5])
    nothing = np.full(temperatures.shape, np.nan)
    return rigs.Recorded(
        np.arange(len(rows), dtype=float),
        col["power_w"],
        col["air_c"],
        temperatures,
        error,
        nothing,
        error,
        col["setpoint_um"],
    )


def run_test(
    config: str,
    truth: str,
    names: list[str],
    model: CompensatorModel | None,
    every: int = 1000,
    part: float = 1.0,
) -> list[np.ndarray]:
    """Each named test from rest, record rows once a second; the compensator `model` acts when given."""
    from thermoctl.daemon.simulate import Simulation
    from thermoctl.settings import load_settings

    settings = load_settings(config)
    settings = dataclasses.replace(
        settings,
        hal=dataclasses.replace(settings.hal, truth=truth),
        compensation=dataclasses.replace(settings.compensation, enable=model is not None, model=""),
    )
    if model is None:  # nothing is estimated yet that the coil could be compared with
        settings = dataclasses.replace(
            settings, protection=dataclasses.replace(settings.protection, innovation_limit_c=1e3)
        )
    tests = experiments.load_experiments(Path(config).parent / "experiments.yaml")
    out = []
    for name in names:
        simulation = Simulation(settings, model)
        try:
            test = dataclasses.replace(tests[name], duration_s=part * tests[name].duration_s)
            out.append(np.vstack(list(experiments.run(simulation, test, every))))
        finally:
            simulation.close()
    return out


def scaled_truth(plant_file: str | Path, path: Path) -> Path:
    """The truth plant with the proving rigs' expansions, written to `path`, whose absolute form is returned."""
    p = plant.load(plant_file)

    def change(data: dict) -> None:
        for k, factor in rigs.PAPER_SCALE.items():
            data["parameters"][k]["value"] *= factor

    plant.save(extended(p, change), path)
    return path.resolve()  # settings read a relative path from their own file's folder


def still(
    plant_file: Path,
    test: rigs.Recorded,
    schedule: experiments.Schedule,
    seed: int,
    compensation_um: np.ndarray | float = 0.0,
) -> rigs.Recorded:
    """The quasi-static plant on the same schedule and the same recorded air as a full run, read by the same instruments. What the law
    compensated, (N,) um, the coil moves back: 15 um of 250 are a tenth of the heat."""
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
        **{f"heat_{b}": np.zeros(n) for b in rigs.HEATED},
    }
    model = compile_plant(rigs.quasi_static(p))
    sim = model.simulate(Table("still", "still", np.arange(n, dtype=float), columns))
    names = list(model.outputs)
    true_c = sim.y[:, [names.index(f"{q}_c") for q in POINTS]]
    true_um = sim.y[:, names.index("error_um")] - sim.y[0, names.index("error_um")]
    rng = np.random.default_rng([seed, n])

    def read(y: np.ndarray, name: str) -> np.ndarray:
        o = p.outputs[name]
        return np.round((y + (o.noise or 0.0) * rng.standard_normal(y.shape)) / (o.resolution or 1e-9)) * (
            o.resolution or 1e-9
        )

    measured = np.column_stack([read(true_c[:, j], f"{q}_c") for j, q in enumerate(POINTS)])
    error = read(true_um, "output_reference_um") - read(np.zeros(n), "position_um")
    return rigs.Recorded(
        test.t,
        sim.y[:, names.index("power_w")],
        test.air_c,
        measured,
        error - error[:5].mean(),
        true_c,
        true_um,
        schedule.at(test.t),
    )


def agreement(full: rigs.Recorded, quasi: rigs.Recorded) -> dict[str, float]:
    """How far the quasi-static run of a test is from the full one, minute by minute (instruments' steps averaged out): temperature and
    position error, rms and largest; and the ratio of the energies."""
    minute = len(full.t) // 60 * 60

    def mean(a: np.ndarray) -> np.ndarray:
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


def run(config: str, plant_file: str, folder: Path, say: Any = print, part: float = 1.0) -> dict[str, Any]:
    """Everything; returns figures and the recordings {name: rows}. `part` < 1 is for tests: only that part of each test."""
    truth = scaled_truth(plant_file, folder / "truth.yaml")
    tests = experiments.load_experiments(Path(config).parent / "experiments.yaml")
    with ProcessPoolExecutor(2) as pool:
        waiting = {
            k: pool.submit(run_test, config, str(truth), [k], None, 1000, part)
            for k in ("test_2", "test_3", "test_4a")
        }
        rows = {k: f.result()[0] for k, f in waiting.items()}
        say("full run: calibration tests done")
        r = {k: recorded(v) for k, v in rows.items()}
        calibration = chain.calibrate(r["test_2"], r["test_3"], r["test_4a"])
        models = {k: chain.compensator(calibration, k) for k in ("paper", "better")}
        futures = {
            k: pool.submit(run_test, config, str(truth), ["test_4b"], m, 1000, part)
            for k, m in models.items()
        }
        for k, f in futures.items():
            rows[f"test_4b_{k}"] = f.result()[0]
        say("full run: compensated tests done")
    arrays: dict[str, Any] = {"columns": np.array(NAMES), **rows}
    np.savez_compressed(folder / "full_run.npz", **arrays)
    return {"figures": judge(truth, rows, calibration, tests), "rows": rows, "calibration": calibration}


def judge(
    truth: Path,
    rows: dict[str, np.ndarray],
    calibration: chain.Calibration,
    tests: dict[str, experiments.Schedule],
) -> dict[str, Any]:
    """(mean, 2 s) of test 4B wherever the reference stands at its target: the output's error under each compensator (`paper`, `better`),
    what each estimator and the coil alone leave of the growth in the better one's run, and the same from the quasi-static plant
    (`still_...`); and the agreement of the two plants over tests 2, 4A and 4B."""
    figures: dict[str, Any] = {}
    r = {k: recorded(v) for k, v in rows.items()}
    for k in ("paper", "better"):
        w = rows[f"test_4b_{k}"]
        col = {n: w[:, i] for n, i in INDEX.items()}
        at_rest = np.abs(col["reference_um"] - col["setpoint_um"]) < 1e-9
        left = col["output_reference_um"] - col["reference_um"]
        figures[k] = mean_and_two_s((left - left[:5].mean())[at_rest])
    growth = r["test_4b_better"].error_um
    figures["uncompensated"] = mean_and_two_s(growth[at_rest])
    moved = rows["test_4b_better"][:, INDEX["compensation_um"]]
    quasi = {k: still(truth, r[k], tests[k], 1) for k in ("test_2", "test_3", "test_4a")}
    quasi["test_4b_better"] = still(truth, r["test_4b_better"], tests["test_4b"], 1, moved)
    again = chain.calibrate(quasi["test_2"], quasi["test_3"], quasi["test_4a"])
    for label, c, recording in (
        ("", calibration, r["test_4b_better"]),
        ("still_", again, quasi["test_4b_better"]),
    ):
        estimate = chain.estimates(c, recording, starts_anew=True)
        for k in ("siso", "paper", "better", "twelve"):
            error = recording.error_um - estimate[k]
            figures[f"{label}{k}_estimator"] = mean_and_two_s(
                (error - error[:60].mean())[at_rest[: len(error)]]
            )
    figures["still_uncompensated"] = mean_and_two_s(quasi["test_4b_better"].error_um[at_rest])
    figures["agreement"] = {k: agreement(r[k], quasi[k]) for k in ("test_2", "test_4a", "test_4b_better")}
    return figures
