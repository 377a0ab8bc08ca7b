"""From recordings to the compensator's model.

Real poles by separable generalised least squares; a Kalman filter with the coil alone and the air's rate as
input; the expansion by output error.

The paper's own method stands beside it in `make reproduce` (tests/reproduction/paper.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg, signal

from thermoctl.calibration.recorded import Recorded
from thermoctl.control.model import CompensatorModel
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import expansion, filter, modal
from thermoctl.identify.statespace import StateSpace

STEP_K, NOISE_K = 0.25, 0.06  # resolution and noise of a thermocouple's reading
ROW_NOISE = 1e-16  # K^2: keeps the Riccati equation regular for a state without noise
AIR_FILTER_S = 60.0
SENSOR_S = 0.1  # time between two readings of a thermocouple
# order of the model in the first rounds; the last round selects it by BIC if none is given
FIRST_ORDER = 6
# Drift that no input explains, (time constant, corner) in s: it decays over two hours; above 1/(2 pi 250 s)
# the thermometers' noise exceeds it.
DRIFT_S = (7200.0, 250.0)


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


def calibrate(
    tests: list[Recorded], order: int | None = None
) -> tuple[StateSpace, filter.Kalman, np.ndarray, expansion.Expansion]:
    """Calibrate the estimator from any tests; return model, filter, its variances and expansion."""
    model = identify(tests, order)
    plant = filter.disturbed(filter.with_air(model))
    records = [filter.Record(t.power_w, air_rate(t.air_c), rises(t)) for t in tests]
    kalman, variances = filter.tune(plant, records, filter.sensor_variance(STEP_K, NOISE_K))
    return model, kalman, variances, fit_expansion(kalman, tests)


def with_air_alone(model: StateSpace) -> StateSpace:
    """Build the model driven by d(air)/dt alone."""
    air = filter.with_air(model)
    return StateSpace(air.a, air.b[:, 1:], air.c, air.period_s, np.zeros(air.order))


def identify(tests: list[Recorded], order: int | None) -> StateSpace:
    """Identify a real-pole model from all tests together, without the effect of the air's changes.

    A change of the air shifts every rise by C b_air. This effect is simulated with the model of the previous
    round and subtracted. `order` None: selected by BIC in the last round.
    Raises InputError where no test heats."""
    if not any(np.ptp(t.power_w) > 0.0 for t in tests):
        raise InputError(
            "power_w is constant in all recordings: tests that heat the coil and let it cool were expected"
        )
    moved: list[np.ndarray] | list[float] = [0.0] * len(tests)
    for round_, now in enumerate((order or FIRST_ORDER, order or FIRST_ORDER, order)):
        pairs = zip(tests, moved, strict=True)
        records = [modal.reduce((t.power_w[:, None], rises(t) - m), 1.0) for t, m in pairs]
        model = modal.identify(records, now, drift_s=DRIFT_S)
        if round_ < 2:
            alone = with_air_alone(model)
            moved = [alone.simulate(air_rate(t.air_c)[:, None]) for t in tests]
    return model


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
        output_step_um=0.005,
    )


def compensator(
    kalman: filter.Kalman, um: expansion.Expansion, period_s: float = 0.001, points: tuple[str, ...] = ()
) -> CompensatorModel:
    """Build the daemon's compensator model at its own period.

    Sensor readings come every SENSOR_S. Process noise is per second, so it scales with the period. A
    quantised reading ten times a second brings no more information than one a second, so its variance grows
    in proportion."""
    model = kalman.model
    scale = SENSOR_S / model.period_s
    at_sensor = _at_period(model, SENSOR_S)
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

    The air's change is a shift of all rises, not a rate that is held into the network."""
    fast = model.resample(period_s)
    return replace(fast, b=np.column_stack([fast.b[:, 0], model.b[:, 1] * period_s / model.period_s]))
