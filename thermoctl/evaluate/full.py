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
from thermoctl.control.model import CompensatorModel
from thermoctl.evaluate import chain, rigs
from thermoctl.evaluate.iso230 import mean_and_two_s
from thermoctl.identify import experiments
from thermoctl.recording.table import Table
from thermoctl.signals import INDEX, NAMES, POINTS


def recorded(rows: np.ndarray, schedule: experiments.Schedule | None = None) -> rigs.Recorded:
    """Record rows (N, signals) at 1 s as one test; the position error is the two encoders' difference from its first value."""
    col = {n: rows[:, i] for n, i in INDEX.items()}
    temperatures = np.column_stack([col[f"{p}_c"] for p in POINTS])
    error = col["output_reference_um"] - col["position_raw_um"]
    error = error - np.nanmean(error[:5])
    nothing = np.full(temperatures.shape, np.nan)
    return rigs.Recorded(np.arange(len(rows), dtype=float), col["power_w"], col["air_c"], temperatures, error, nothing, error, col["setpoint_um"])


def run_test(config: str, truth: str, names: list[str], model: CompensatorModel | None, every: int = 1000,
             part: float = 1.0) -> list[np.ndarray]:
    """Each named test from rest, record rows once a second; the compensator `model` acts when given."""
    from thermoctl.daemon.simulate import Simulation
    from thermoctl.settings import load_settings
    settings = load_settings(config)
    settings = dataclasses.replace(settings, hal=dataclasses.replace(settings.hal, truth=truth),
                                   compensation=dataclasses.replace(settings.compensation, enable=model is not None, model=""))
    if model is None:                                        # nothing is estimated yet that the coil could be compared with
        settings = dataclasses.replace(settings, protection=dataclasses.replace(settings.protection, innovation_limit_c=1e3))
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
    """The truth plant with the proving rigs' expansions, written to `path`."""
    p = plant.load(plant_file)

    def change(data: dict) -> None:
        for k, factor in rigs.PAPER_SCALE.items():
            data["parameters"][k]["value"] *= factor

    plant.save(p.extended(change), path)
    return path


def agreement(plant_file: Path, test: rigs.Recorded, schedule: experiments.Schedule) -> dict[str, float]:
    """The quasi-static plant on the same schedule and recorded air against the full run: power, temperature and position error rms, and
    the largest difference of position, once the thermometers' steps are averaged over a minute."""
    p = plant.load(plant_file)
    still = rigs.quasi_static(p)
    n = len(test.t)
    value = {k: v.value for k, v in p.parameters.items()}
    fine = np.arange(n * 10) / 10
    x = schedule.at(fine) * 1e-6
    v = np.gradient(x, 0.1)
    i = (value["k_flexure"] * x + value["b_eddy"] * v) / value["k_T"]
    air = chain.smooth_air(test.air_c)
    columns = {"current": np.sqrt((i**2).reshape(n, 10).mean(1)), "eddy_w": (value["b_eddy"] * v**2).reshape(n, 10).mean(1), "air": air,
               **{f"heat_{b}": np.zeros(n) for b in rigs.HEATED}}
    model = still.compile()
    sim = model.simulate(Table("still", "still", np.arange(n, dtype=float), columns))
    names = list(model.outputs)
    order = [names.index(f"{q}_c") for q in POINTS]
    minute = n // 60 * 60
    def mean(a: np.ndarray) -> np.ndarray:
        return a[:minute].reshape(minute // 60, 60, -1).mean(1)
    dt = mean(sim.y[:, order]) - mean(test.temperatures)
    error = sim.y[:, names.index("error_um")]
    de = mean((error - error[0])[:, None]) - mean(test.error_um[:, None])
    return {"temperature_rms_k": float(np.sqrt(np.mean(dt**2))), "temperature_max_k": float(np.abs(dt).max()),
            "position_rms_um": float(np.sqrt(np.mean(de**2))), "position_max_um": float(np.abs(de).max()),
            "energy_ratio": float(sim.y[:, names.index("power_w")].sum() / test.power_w.sum())}


def run(config: str, plant_file: str, folder: Path, say: Any = print, part: float = 1.0) -> dict[str, Any]:
    """Everything; returns figures and the recordings {name: rows}. `part` < 1 is for tests: only that part of each test."""
    truth = str(scaled_truth(plant_file, folder / "truth.yaml"))
    tests = experiments.load_experiments(Path(config).parent / "experiments.yaml")
    with ProcessPoolExecutor(2) as pool:
        a = pool.submit(run_test, config, truth, ["test_2"], None, 1000, part)
        b = pool.submit(run_test, config, truth, ["test_3", "test_4a"], None, 1000, part)
        rows = {"test_2": a.result()[0], **dict(zip(("test_3", "test_4a"), b.result(), strict=True))}
        say("full run: calibration tests done")
        r = {k: recorded(v) for k, v in rows.items()}
        calibration = chain.calibrate(r["test_2"], r["test_3"], r["test_4a"])
        models = {k: chain.compensator(calibration, k) for k in ("paper", "better")}
        futures = {k: pool.submit(run_test, config, truth, ["test_4b"], m, 1000, part) for k, m in models.items()}
        for k, f in futures.items():
            rows[f"test_4b_{k}"] = f.result()[0]
        say("full run: compensated tests done")
    arrays: dict[str, Any] = {"columns": np.array(NAMES), **rows}
    np.savez_compressed(folder / "full_run.npz", **arrays)
    figures: dict[str, Any] = {"agreement": agreement(Path(truth), r["test_2"], tests["test_2"])}
    for k in models:
        w = rows[f"test_4b_{k}"]
        col = {n: w[:, i] for n, i in INDEX.items()}
        growth = col["output_reference_um"] - col["position_raw_um"]
        growth = growth - growth[:5].mean()
        at_rest = np.abs(col["reference_um"] - col["setpoint_um"]) < 1e-9
        left = col["output_reference_um"] - col["reference_um"]
        left = left - left[:5].mean()
        figures[k] = mean_and_two_s(left[at_rest])
        figures["uncompensated"] = mean_and_two_s(growth[at_rest])
        figures[f"{k}_estimator"] = mean_and_two_s((growth - col["expansion_um"])[at_rest])
        if k == "better":
            coil = chain.filled(chain.rises(recorded(w))[:, :1])
            figures["siso"] = mean_and_two_s((growth - calibration.siso_um.predict(coil))[at_rest])
    return {"figures": figures, "rows": rows, "calibration": calibration}
