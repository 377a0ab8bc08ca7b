"""The steps of a calibration between its tests. Each uses the rig or recordings and returns its result.

`summary` of a result is one line for the user; the series are thinned for the report's figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.calibration import chain, drive
from thermoctl.calibration.iso230 import mean_and_two_s
from thermoctl.calibration.keyboard import Keyboard
from thermoctl.calibration.recorded import SETTLED, Recorded, read
from thermoctl.calibration.schedules import triangles
from thermoctl.calibration.tune import Disagrees, tune
from thermoctl.configuration.settings import Settings
from thermoctl.files.yamlfile import InputError
from thermoctl.identify import modelfile, tuning
from thermoctl.identify.expansion import Expansion
from thermoctl.identify.filter import Kalman
from thermoctl.identify.measured_loop import NOTHING
from thermoctl.recording.files import read_table
from thermoctl.rig.signals import AT

FITTED = ("test_2", "test_3", "test_4a")  # the tests that the model is fitted to
SHOWN_S = 3.0  # part of the ramps' recording in the report
SHOWN = 2000  # approximate number of points of a curve in the report
AT_TARGET_UM = 1e-6  # largest distance of reference and setpoint at rest
NEEDED = ("position_um", "output_reference_um", "voltage_v", "current_a", "air_c")
"""Channels that a calibration needs besides the points'."""

Series = list[float | None]
MeanTwoS = tuple[float, float]  # mean and 2 s, um, after ISO 230-2


@dataclass(frozen=True)
class Doctor:
    """Result of the doctor: every channel that a calibration needs is valid."""

    summary: str
    channels: dict[str, str]


@dataclass(frozen=True)
class Response:
    """The position's response to short ramps: a fitted second-order system with dead time."""

    summary: str
    t: list[float]
    measured_um: list[float]
    fitted_um: list[float]
    k0: float
    tau_d_s: float
    tau_c_s: float


@dataclass(frozen=True)
class Pid:
    """Present and proposed gains with their measured margins; without proven gains both are the present ones.

    Of each: kp, ti_s, td_s, how, and the fields of measured_loop.Measured."""

    summary: str
    present: dict[str, Any]
    proposed: dict[str, Any]

    def gains(self) -> tuple[tuning.Gains, tuning.Gains]:
        """Return the present and the proposed gains."""
        present, proposed = (
            tuning.Gains(g["kp"], g["ti_s"], g["td_s"], g["how"]) for g in (self.present, self.proposed)
        )
        return present, proposed


@dataclass(frozen=True)
class Test:
    """A test of the schedule, recorded to its end."""

    summary: str
    seconds: float
    mean_w: float
    largest_w: float


@dataclass(frozen=True)
class Model:
    """The model and its residuals; the series are the growth over test 4A and its residual."""

    summary: str
    method: str
    time_constants_s: list[float]
    residual_rms_k: float
    expansion_rms_um: float
    grown_rms_um: float
    t: list[float]
    measured_um: Series
    residual_um: Series


@dataclass(frozen=True)
class Proof:
    """Position error over test 4B without and with the model; `how`: how the latter was found."""

    summary: str
    before: MeanTwoS
    after: MeanTwoS
    how: str
    t: list[float]
    without_um: Series
    with_um: Series
    better: bool


Result = Doctor | Response | Pid | Test | Model | Proof


def doctor(states: Mapping[str, str], settings: Settings) -> Doctor:
    """Check the channels; the power needs no voltage where the coil's resistance is known.

    Raises InputError with the invalid ones."""
    needed = [n for n in NEEDED if n != "voltage_v" or settings.protection.resistance_ohm == 0.0]
    by_channel = {n: states.get(n, "ABSENT") for n in (*needed, *settings.channels.temperatures)}
    if bad := [f"{n} is {s}" for n, s in by_channel.items() if s != "OK"]:
        raise InputError(
            "a calibration needs the second encoder and the thermometers of all points; "
            + ", ".join(bad)
            + ": see `thermoctl doctor`"
        )
    return Doctor(f"{len(by_channel)} channels read well", dict(states))


def response(settings: Settings, rig: drive.DrivenRig) -> Response:
    """Drive short ramps and fit the position's response."""
    period_s = settings.loop.period_s
    rows = drive.excite(rig, triangles(settings, rig.now()["compensated_um"]), Keyboard(False))
    t, u, y = (rows[:, AT[n]] for n in ("t_s", "drive", "position_raw_um"))
    fitted = tuning.fit_response(t, u, y, period_s)
    k0, tau_d, tau_c = tuning.tangent(fitted)
    model = fitted.response(u - u[0], period_s)
    shown = slice(0, round(SHOWN_S / period_s))
    return Response(
        f"K0 {k0:.4g} um per unit, delay {1e3 * tau_d:.3g} ms, time constant {1e3 * tau_c:.3g} ms",
        (t[shown] - t[0]).tolist(),
        (y - y.mean())[shown].tolist(),
        (model - model.mean())[shown].tolist(),
        k0,
        tau_d,
        tau_c,
    )


def pid(rig: drive.DrivenRig) -> Pid:
    """Propose gains and prove them on the rig; without proven ones the present gains stay, with the reason.

    Raises HardwareError when the rig ends a test, InputError when it is not READY."""
    c = rig.settings.control
    present = proposed = tuning.Gains(c.kp, c.ti_s, c.td_s, "present")
    before = after = NOTHING
    said: list[str] = []
    try:
        tuned = tune(rig, True, Keyboard(False), said.append)
        proposed, before, after = tuned.proposed, tuned.before, tuned.after or NOTHING
        summary = f"present: {before}; " + (
            "nothing to change" if proposed == tuned.present else f"proposed, each step measured: {after}"
        )
    except (InputError, Disagrees) as e:
        summary = f"the present gains stay: {e}"
    plain = [
        {"kp": g.kp, "ti_s": g.ti_s, "td_s": g.td_s, "how": g.how, **asdict(m)}
        for g, m in ((present, before), (proposed, after))
    ]
    return Pid(summary, *plain)


def model(settings: Settings, recordings: Mapping[str, Path], order: int, path: Path) -> Model:
    """Fit the model to the recordings of FITTED and save it at `path`."""
    points = settings.channels.point_names
    tests = [read(recordings[n], points) for n in FITTED]
    thermal, kalman, _, expansion = chain.calibrate(tests, order or None)
    compensator = chain.compensator(kalman, expansion, settings.loop.period_s, points=points)
    last = tests[-1]
    residual = last.error_um - _estimate(kalman, expansion, last)
    thin = max(1, len(residual) // SHOWN)
    figures = {
        "method": "better",
        "time_constants_s": np.asarray(thermal.info["time_constants_s"]).tolist(),
        "residual_rms_k": float(np.mean(thermal.info["residual_rms"])),
        "expansion_rms_um": _rms(residual),
    }
    recorded = [recordings[n] for n in FITTED]
    modelfile.save_model(path, compensator, settings.rig.name, recorded, figures, replace=True)
    return Model(
        f"order {len(compensator.A_minus_I)} ({thermal.order} poles of the identified model, the rest for disturbing heat), "
        f"temperatures to {figures['residual_rms_k']:.3f} K rms, expansion to "
        f"{figures['expansion_rms_um']:.3f} um rms of {_rms(last.error_um):.2f}",
        **figures,
        grown_rms_um=_rms(last.error_um),
        t=last.t[::thin].tolist(),
        measured_um=_series(last.error_um[::thin]),
        residual_um=_series(residual[::thin]),
    )


def proof(settings: Settings, recordings: Mapping[str, Path], order: int, acting: bool) -> Proof:
    """Compare the position error over test 4B without and with the model.

    `acting`: the model acted in that test."""
    t = read_table(recordings["test_4b"])
    c = t.columns
    growth = c["output_reference_um"] - c["position_raw_um"]
    origin_um = np.nanmean(growth[:SETTLED])  # difference of the two encoders before the output moves
    growth = growth - origin_um
    if acting:
        left = c["output_reference_um"] - c["reference_um"] - origin_um
        how = "the loop with the new model acting, judged by the second encoder, which it does not use"
    else:
        points = settings.channels.point_names
        tests = [read(recordings[n], points) for n in FITTED]
        _, kalman, _, expansion = chain.calibrate(tests, order or None)
        r = read(recordings["test_4b"], points)
        left = growth - np.interp(t.t - t.t[0], r.t, _estimate(kalman, expansion, r))
        how = (
            "the second encoder less what the new model estimates from the recording; the model is not acting before it is "
            "accepted"
        )
    rest = np.abs(c["reference_um"] - c["setpoint_um"]) < AT_TARGET_UM
    before, after = (mean_and_two_s(e[rest & np.isfinite(e)]) for e in (growth, left))
    thin = max(1, len(t) // SHOWN)
    return Proof(
        f"without compensation {before[0]:+.2f} +- {before[1]:.2f} um, with the new model {after[0]:+.3f} +- {after[1]:.3f} um",
        before,
        after,
        how,
        (t.t - t.t[0])[::thin].tolist(),
        _series(growth[::thin]),
        _series(left[::thin]),
        _worst(after) < _worst(before),
    )


def _estimate(kalman: Kalman, expansion: Expansion, r: Recorded) -> np.ndarray:
    start = expansion.info.get("start_um", 0.0)
    return expansion.predict(chain.run_kalman(kalman, r), chain.smooth_air(r.air_c), start)


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(x))))


def _worst(mean_two_s: MeanTwoS) -> float:
    return abs(mean_two_s[0]) + mean_two_s[1]


def _series(x: np.ndarray) -> Series:
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in x.tolist()]
