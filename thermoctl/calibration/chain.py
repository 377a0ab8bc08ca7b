"""Compute position residuals from recordings, by the paper's method and by the better one.

`calibrate` fits the estimators to tests 2, 3 and 4A; `estimates` gives each one's position error over test 4.
The measured error less the estimate is compared over test 4B. Estimators:

    siso     coil alone, first order, recursion (5)
    paper    N4SID of order 12 with (26), MKF, recursion (5); one sampling period, as (38) and (39) have one n
    better   real poles by separable generalised least squares; Kalman filter with the coil alone and the
             air's rate as input; output error
    twelve   the same filter and expansion model with the thermometers of all points
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, signal

from thermoctl.calibration.recorded import Recorded, filled
from thermoctl.control.model import CompensatorModel
from thermoctl.identify import expansion, filter, modal, subspace
from thermoctl.identify.statespace import StateSpace
from thermoctl.yamlfile import InputError

STEP_K, NOISE_K = 0.25, 0.06  # resolution and noise of a thermocouple's reading
LONGEST_S = 36000.0  # no expansion takes longer than ten hours
ROW_NOISE = 1e-16  # K^2: keeps the Riccati equation regular for a state without noise
FASTEST = 0.05  # smallest real pole of a sampled heat network; smaller ones are fits of noise
AIR_FILTER_S = 60.0
# order of the better model in the first rounds; the last round selects it by BIC if none is given
FIRST_ORDER = 6
# Drift that no input explains, (time constant, corner) in s: it decays over two hours; above 1/(2 pi 250 s)
# the thermometers' noise exceeds it.
DRIFT_S = (7200.0, 250.0)
# Sampling periods, s, and the block rows i tried with each
PAPER_ROWS = {
    1: (30, 40, 50),
    2: (15, 20, 30, 40),
    3: (15, 20, 30),
    4: (15, 20, 30, 40),
    6: (15, 20),
    8: (15, 20),
}
PAPER_CHOICES = [(period_s, i) for period_s, rows in PAPER_ROWS.items() for i in rows]
ESTIMATORS = ("siso", "paper", "better", "twelve")


@dataclass(frozen=True)
class Calibration:
    """Estimators that a calibration fitted, and their position errors in um.

    `paper_model`, `mkf`, `paper_um`, `siso_um`; `model`, `kalman`, `better_um`, `twelve`, `twelve_um`.
    """

    paper_model: StateSpace
    mkf: filter.Mkf
    paper_um: expansion.Expansion
    siso_um: expansion.Expansion
    model: StateSpace
    kalman: filter.Kalman
    better_um: expansion.Expansion
    twelve: filter.Kalman
    twelve_um: expansion.Expansion
    variances: np.ndarray


def rises(r: Recorded) -> np.ndarray:
    """Return the measured rises above the measured air (N, points), K."""
    return r.temperatures - smooth_air(r.air_c)[:, None]


def smooth_air(air_c: np.ndarray) -> np.ndarray:
    """Filter the air by a first-order low-pass of AIR_FILTER_S, as the law does.

    (N,) degC at 1 s."""
    f = np.exp(-1 / AIR_FILTER_S)
    return signal.lfilter([1 - f], [1, -f], air_c, zi=[f * air_c[0]])[0]


def air_rate(air_c: np.ndarray) -> np.ndarray:
    """Differentiate the low-passed air, K/s, held over the following second."""
    a = smooth_air(air_c)
    return np.append(np.diff(a), 0.0)


def block_mean(v: np.ndarray, q: int) -> np.ndarray:
    """Average over blocks of q rows; drop an incomplete last block."""
    return v[: len(v) // q * q].reshape(len(v) // q, q, -1).mean(1)


def calibrate(test_2: Recorded, test_3: Recorded, test_4a: Recorded, order: int | None = None) -> Calibration:
    """Calibrate all estimators from the three calibration tests at 1 s."""
    r_v = filter.sensor_variance(STEP_K, NOISE_K)
    # the paper's method
    paper_model, mkf = identify_paper(test_2, test_4a)
    y4 = test_4a.error_um
    paper_um = expansion.recursive(
        _mkf_steps(mkf, test_4a), block_mean(y4[:, None], round(mkf.period_s))[:, 0], mkf.period_s
    )
    # unstable at the model's period: use the fastest measured period, as the paper advises
    if paper_um.f1 >= 1:
        paper_um = expansion.recursive(estimate_mkf(mkf, test_4a), y4, 1.0)
    paper_um = replace(paper_um, f1=min(paper_um.f1, float(np.exp(-paper_um.period_s / LONGEST_S))))
    coil = filled(rises(test_4a)[:, :1])
    siso_um = expansion.recursive(coil, y4, 1.0)
    # the better method
    tests = [test_2, test_3, test_4a]
    model, kalman, variances, better_um = calibrate_better(tests, order)
    plant = filter.disturbed(filter.with_air(model))
    twelve = filter.steady(plant, variances, r_v, tuple(range(len(plant.c))))
    twelve_um = fit_expansion(twelve, tests)
    return Calibration(
        paper_model, mkf, paper_um, siso_um, model, kalman, better_um, twelve, twelve_um, variances
    )


def identify_paper(test_2: Recorded, check: Recorded) -> tuple[StateSpace, filter.Mkf]:
    """Identify the paper's model of order 12 by (7) to (26) and its MKF, both from test 2.

    The paper leaves sampling period and block rows i open. Of PAPER_CHOICES this takes those whose stable
    model's filter follows the thermometers best over `check`, another test."""
    r_v = filter.sensor_variance(STEP_K, NOISE_K)
    y2, measured = filled(rises(test_2)), filled(rises(check))
    best: tuple[StateSpace, filter.Mkf] | None = None
    least = np.inf
    for period_s, i in PAPER_CHOICES:
        u, y = block_mean(test_2.power_w[:, None], period_s), block_mean(y2, period_s)
        try:
            model = subspace.identify(u, y, float(period_s), 12, i, "paper")
            mkf = filter.mkf(model, u, y, r_v, float(period_s))
        except InputError:  # too few samples for this number of rows
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            left = float(np.sqrt(np.mean((estimate_mkf(mkf, check) - measured) ** 2)))
        if left < least and (model.stable or best is None):
            least, best = left, (replace(model, info={**model.info, "period_s": period_s, "i": i}), mkf)
    if best is None:
        raise InputError(
            "no choice of sampling and block rows gives a model of order 12 from this test; it is too short"
        )
    return best


def calibrate_better(
    tests: list[Recorded], order: int | None = None, model: StateSpace | None = None
) -> tuple[StateSpace, filter.Kalman, np.ndarray, expansion.Expansion]:
    """Calibrate the better estimator alone, from any tests.

    Return model, filter, its variances and expansion. `model`: a given thermal model, else it is identified.
    """
    model = model or identify_better(tests, order)
    plant = filter.disturbed(filter.with_air(model))
    records = [filter.Record(t.power_w, air_rate(t.air_c), rises(t)) for t in tests]
    kalman, variances = filter.tune(plant, records, filter.sensor_variance(STEP_K, NOISE_K))
    return model, kalman, variances, fit_expansion(kalman, tests)


def calibrate_refined(
    tests: list[Recorded], order: int | None = None
) -> tuple[StateSpace, filter.Kalman, np.ndarray, expansion.Expansion, str]:
    """Calibrate with and without refining the thermal model by its prediction errors.

    The model is refined on all tests but the last. Return the one that predicts the thermometers of the last
    test better, and a sentence that compares both.
    """
    plain = calibrate_better(tests, order)
    refined_model = refine(plain[0], tests[:-1])
    if refined_model is plain[0]:
        return *plain, "no better in its own criterion; left out"
    refined = calibrate_better(tests, order, refined_model)
    last = rises(tests[-1])
    a, b = (
        float(np.sqrt(np.nanmean((run_kalman(k, tests[-1]) - last) ** 2))) for k in (plain[1], refined[1])
    )
    compared = f"{b:.4f} K rms with, {a:.4f} K without, over the test that it was not refined on"
    return (*refined, compared + "; taken") if b < a else (*plain, compared + "; left out")


def refine(model: StateSpace, tests: list[Recorded]) -> StateSpace:
    """Refine poles, B and C by prediction errors, without the air's own changes.

    Blocks of 10 s are used, one test after the other. Return the model itself where nothing improves."""
    slow = model.resample(10.0)
    air = with_air_alone(model)
    for t in tests:
        y = block_mean(filled(rises(t)) - air.simulate(air_rate(t.air_c)[:, None]), 10)
        slow = subspace.refine_prediction_error(
            replace(slow, x0=np.zeros(slow.order)), block_mean(t.power_w[:, None], 10), y
        )[0]
    if not slow.stable or (np.diag(slow.a) <= 0).any():
        return model
    return replace(
        slow.resample(model.period_s),
        info={**model.info, "prediction_error": slow.info.get("prediction_error")},
    )


def with_air_alone(model: StateSpace) -> StateSpace:
    """Build the model driven by d(air)/dt alone."""
    air = filter.with_air(model)
    return StateSpace(air.a, air.b[:, 1:], air.c, air.period_s, np.zeros(air.order))


def identify_better(tests: list[Recorded], order: int | None) -> StateSpace:
    """Identify a real-pole model from all tests together, without the effect of the air's changes.

    A change of the air shifts every rise by C b_air. This effect is simulated with the model of the previous
    round and subtracted. `order` None: selected by BIC in the last round.
    """
    moved: list[np.ndarray] | list[float] = [0.0] * len(tests)
    for round_, now in enumerate((order or FIRST_ORDER, order or FIRST_ORDER, order)):
        model = modal.identify(
            [
                modal.reduce((t.power_w[:, None], rises(t) - m), 1.0)
                for t, m in zip(tests, moved, strict=True)
            ],
            now,
            drift_s=DRIFT_S,
        )
        if round_ < 2:
            alone = with_air_alone(model)
            moved = [alone.simulate(air_rate(t.air_c)[:, None]) for t in tests]
    return model


def estimate_mkf(mkf: filter.Mkf, r: Recorded) -> np.ndarray:
    """Run the MKF over a 1 s recording; return rises (N, points), held between the MKF's steps."""
    return held(_mkf_steps(mkf, r), round(mkf.period_s), len(r.power_w))


def _mkf_steps(mkf: filter.Mkf, r: Recorded) -> np.ndarray:
    """Run the MKF; rises (K, points), one row for each of its periods."""
    q = round(mkf.period_s)
    return mkf.run(block_mean(r.power_w[:, None], q)[:, 0], block_mean(filled(rises(r)[:, :1]), q)[:, 0])[0]


def held(v: np.ndarray, q: int, n: int) -> np.ndarray:
    """Hold each row of v for q samples, n in all; the last one to the end."""
    return np.repeat(v, q, axis=0)[np.minimum(np.arange(n), len(v) * q - 1)]


def run_kalman(k: filter.Kalman, r: Recorded) -> np.ndarray:
    """Run the Kalman filter over a recording from rest; rises (N, points)."""
    return k.run(r.power_w, air_rate(r.air_c), rises(r)[:, list(k.sensors)])


def fit_expansion(k: filter.Kalman, tests: list[Recorded]) -> expansion.Expansion:
    """Fit the expansion by output error on the filter's own estimates.

    The filter's error is the inputs' uncertainty."""
    sigma = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", k.model.c, k.p, k.model.c), 0))
    return expansion.output_error(
        [run_kalman(k, t) for t in tests],
        [t.error_um for t in tests],
        1.0,
        sigma,
        [smooth_air(t.air_c) for t in tests],
        lags=1,
        output_step_um=0.005,
    )


def estimates(c: Calibration, r: Recorded, starts_anew: bool = False) -> dict[str, np.ndarray]:
    """Estimate the position error (N,) um by each estimator over a test that starts with test 4A.

    `starts_anew`: over another recording, from zero."""
    air = smooth_air(r.air_c)
    start = {k: 0.0 if starts_anew else getattr(c, f"{k}_um").info.get("start_um", 0.0) for k in ESTIMATORS}
    return {
        "siso": c.siso_um.predict(filled(rises(r)[:, :1])),
        "paper": held(
            c.paper_um.predict(_mkf_steps(c.mkf, r))[:, None], round(c.mkf.period_s), len(r.power_w)
        )[:, 0]
        if c.paper_um.period_s == c.mkf.period_s
        else c.paper_um.predict(estimate_mkf(c.mkf, r)),
        "better": c.better_um.predict(run_kalman(c.kalman, r), air, start["better"]),
        "twelve": c.twelve_um.predict(run_kalman(c.twelve, r), air, start["twelve"]),
    }


def compensator(
    c: Calibration, kind: str, period_s: float = 0.001, sensor_s: float = 0.1, points: tuple[str, ...] = ()
) -> CompensatorModel:
    """Build the daemon's compensator model at its own period.

    Kind: 'paper' (MKF and recursion (5)) or 'better'. Sensor readings come every `sensor_s`. Process noise is
    per second, so it scales with the period. A quantised reading ten times a second brings no more
    information than one a second, so its variance grows in proportion.
    """
    if kind == "paper":
        model = c.paper_model
        alpha, _ = model.output_form()
        reduced = StateSpace(
            alpha, model.c @ model.b, np.eye(len(alpha)), model.period_s, np.zeros(len(alpha))
        )
        reduced = _without_noise_poles(reduced)
        fast = reduced.resample(period_s)
        um = c.paper_um
        return CompensatorModel(
            "mkf",
            period_s,
            reduced.minus_identity(period_s),
            np.column_stack([fast.b[:, 0], np.zeros(len(alpha))]),
            np.eye(len(alpha)),
            c.mkf.zeta,
            c.mkf.r_w * period_s / c.mkf.period_s,
            c.mkf.r_v,
            um.f1,
            um.b1,
            um.b2,
            um.period_s,
            air_filter_s=AIR_FILTER_S,
            points=points,
        )
    return better_compensator(c.kalman, c.better_um, period_s, sensor_s, points)


def better_compensator(
    kalman: filter.Kalman,
    um: expansion.Expansion,
    period_s: float = 0.001,
    sensor_s: float = 0.1,
    points: tuple[str, ...] = (),
) -> CompensatorModel:
    """Build the better estimator as the daemon runs it; see `compensator`."""
    model = kalman.model
    scale = sensor_s / model.period_s
    at_sensor = _at_period(model, sensor_s)
    q = kalman.noise * scale
    cs = at_sensor.c[:1]
    r = np.array([[filter.sensor_variance(STEP_K, NOISE_K) / scale]])
    p = linalg.solve_discrete_are(at_sensor.a.T, cs.T, q + ROW_NOISE * np.eye(len(q)), r)
    gain = (p @ cs.T / (cs @ p @ cs.T + r))[:, 0]
    fast = _at_period(model, period_s)
    return CompensatorModel(
        "kalman",
        period_s,
        model.minus_identity(period_s),
        fast.b,
        model.c,
        gain,
        0.0,
        float(r[0, 0]),
        um.f1,
        um.b1,
        um.b2,
        um.period_s,
        b_air=um.b_air,
        offset_um=um.offset_um,
        points=points,
        air_filter_s=AIR_FILTER_S,
    )


def _at_period(model: StateSpace, period_s: float) -> StateSpace:
    """Resample the model; keep the air's effect (K per K/s over one period) exact.

    The air's change is a shift of all rises, not a rate that is held into the network.
    """
    fast = model.resample(period_s)
    return replace(fast, b=np.column_stack([fast.b[:, 0], model.b[:, 1] * period_s / model.period_s]))


def _without_noise_poles(model: StateSpace) -> StateSpace:
    """Move poles that no sampled heat network has (real, below FASTEST) to FASTEST."""
    values, vectors = np.linalg.eig(model.a)
    keep = np.where((np.abs(values.imag) < 1e-12) & (values.real <= FASTEST), FASTEST, values)
    return replace(model, a=np.real(vectors @ np.diag(keep) @ np.linalg.inv(vectors)))
