"""Run all estimators on one simulated rig: calibrated on tests 2, 3 and 4A, compared over test 4B."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from tests.reproduction import paper
from tests.reproduction.rigs import (
    CALIBRATED_S,
    CHAMBER,
    PAPER_SCALE,
    PROOF_DAY,
    ProvingRig,
    Simulated,
    joined,
)
from thermoctl import plant
from thermoctl.calibration import chain
from thermoctl.calibration.iso230 import mean_and_two_s
from thermoctl.calibration.recorded import Recorded
from thermoctl.identify import experiments

CALIBRATION = int(CALIBRATED_S)  # samples of test 4A at 1 s
MeanTwoS = tuple[float, float]  # um


@dataclass(frozen=True)
class SeedResult:
    """One rig: position {estimator: (mean, 2 s)} over test 4B.

    Temperature {estimator: (largest, mean error)} in test 3, K.

    `stable`, `choice` (sampling period s, block rows): of the paper's model."""

    seed: int
    disturbance: str | None
    position: dict[str, MeanTwoS]
    temperature: dict[str, tuple[float, float]]
    stable: bool
    choice: list[float]


@dataclass(frozen=True)
class Kept:
    """One rig's data for the figures.

    Its calibration, its tests, the estimates in test 3 and the residuals in test 4.
    """

    calibration: paper.Calibration
    tests: tuple[Simulated, Simulated, Simulated, Simulated]
    estimate: dict[str, np.ndarray]  # rises in test 3
    truth: np.ndarray
    residual: dict[str, np.ndarray]  # position error in test 4 less each estimate


def one_seed(
    plant_file: str,
    tests_file: str,
    seed: int,
    disturbance: str | None = None,
    keep: bool = False,
    air: float = CHAMBER,
    bench: float = CHAMBER,
    heat: float = 1.0,
) -> tuple[SeedResult, Kept | None]:
    """Run one rig; `keep`: also return the data for the figures.

    `air`, `bench`, `heat`: as for ProvingRig.
    """
    tests = experiments.load_experiments(tests_file)
    rig = ProvingRig(plant.load(plant_file), seed, disturbance, PAPER_SCALE, air, bench, heat)
    run4 = joined(tests["test_4a"], tests["test_4b"], "test_4")
    r2, r3, r4 = rig.run(tests["test_2"], 1), rig.run(tests["test_3"], 2), rig.run(run4, PROOF_DAY)
    r4a = Recorded(*(getattr(r4, f.name)[:CALIBRATION] for f in dataclasses.fields(Recorded)))
    c = paper.calibrate(r2, r3, r4a)
    with np.errstate(over="ignore", invalid="ignore"):
        residual = {k: r4.true_um - v for k, v in paper.estimates(c, r4).items()}
        residual["uncompensated"] = r4.true_um
        if disturbance is None:
            residual["bayes"] = r4.true_um - rig.bayes(run4, PROOF_DAY, r4)
        position = {k: _figures(v) for k, v in residual.items()}
        truth = r3.true_c - chain.smooth_air(r3.air_c)[:, None]
        estimate = _rises(c, r3)
        errors = {k: np.abs(v - truth) for k, v in estimate.items()}
    info = c.paper_model.info
    result = SeedResult(
        seed,
        disturbance,
        position,
        {k: (float(v.max()), float(v.mean())) for k, v in errors.items()},
        c.paper_model.stable,
        [info["period_s"], info["i"]],
    )
    if not keep:
        return result, None
    return result, Kept(c, (rig.run(tests["test_1"], 0), r2, r3, r4), estimate, truth, residual)


def _figures(residual: np.ndarray) -> MeanTwoS:
    return mean_and_two_s(residual[CALIBRATION:]) if np.isfinite(residual).all() else (np.inf, np.inf)


def _rises(c: paper.Calibration, r: Recorded) -> dict[str, np.ndarray]:
    """Estimate the rises over a test: the paper's model alone, its MKF, the better filter."""
    q = round(c.paper_model.period_s)
    simulated = c.paper_model.simulate(paper.block_mean(r.power_w[:, None], q))
    return {
        "open loop": paper.held(simulated, q, len(r.t)),
        "paper": paper.estimate(c.mkf, r),
        "better": chain.run_kalman(c.kalman, r),
    }
