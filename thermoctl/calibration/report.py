"""The page of a calibration: the proof first, then model, response and gains, and every step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.calibration.steps import Model, Pid, Proof, Response, Series
from thermoctl.report.page import figure, page, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLACK, ORANGE, BLUE = "#1b1f24", "#c7621b", "#0b6bcb"


def report(
    rig: str,
    where: str,
    summaries: Mapping[str, str],
    response: Response,
    pid: Pid,
    model: Model,
    proof: Proof,
) -> str:
    """Write the page of one calibration."""
    (m0, s0), (m1, s1) = proof.before, proof.after
    lead = (
        f'<p class="lead"><b>{"Better" if proof.better else "No better"}:</b> position error '
        f"{m0:+.2f} ± {s0:.2f} µm without compensation, {m1:+.3f} ± "
        f"{s1:.3f} µm with the new model (ISO 230-2: mean ± 2 s, at rest).</p>"
    )
    lines = [(k.replace("_", " "), _for_people(s)) for k, s in summaries.items()]
    sections = [
        ("", lead),
        ("Proof: before and after", figure(_proof_figure(proof), f"Test 4B. How it was made: {proof.how}.")),
        ("Model", _model(model)),
        ("Step and PID", _response(response, pid)),
        ("Steps", table(("step", "result"), lines)),
    ]
    return page("Calibration", sections, f"rig '{rig}' · {where}")


def _proof_figure(proof: Proof) -> Figure:
    fig, (a, b) = _axes(2)
    t = np.array(proof.t) / 60
    a.plot(t, _curve(proof.without_um), color=ORANGE, lw=1, label="without compensation")
    a.plot(t, _curve(proof.with_um), color=BLUE, lw=1, label="with the new model")
    b.plot(t, _curve(proof.with_um), color=BLUE, lw=0.8)
    a.set(ylabel="error (µm)")
    b.set(ylabel="with, enlarged (µm)", xlabel="time (min)")
    _legend(fig, a)
    return fig


def _model(model: Model) -> str:
    fig, (a, b) = _axes(2)
    t, measured, residual = np.array(model.t) / 60, _curve(model.measured_um), _curve(model.residual_um)
    a.plot(t, measured, color=BLACK, lw=1, label="measured by both encoders")
    a.plot(t, measured - residual, color=BLUE, lw=1, label="estimated")
    b.plot(t, residual, color=BLUE, lw=0.8)
    a.set(ylabel="expansion (µm)")
    b.set(ylabel="residual (µm)", xlabel="time (min)")
    _legend(fig, a)
    rows = [
        ("time constants, s", ", ".join(f"{v:.4g}" for v in model.time_constants_s)),
        ("temperatures, K rms", model.residual_rms_k),
        ("residual expansion over test 4A, µm rms", model.expansion_rms_um),
        ("expansion itself, µm rms", model.grown_rms_um),
    ]
    caption = "Test 4A, which took part in the fit: growth of the output against the encoder, and the residual of its estimate."
    return table(("figure", "value"), rows) + figure(fig, caption)


def _response(response: Response, pid: Pid) -> str:
    fig, (a,) = _axes()
    a.plot(response.t, response.measured_um, ".", ms=2, color=BLACK, label="measured")
    a.plot(response.t, response.fitted_um, color=BLUE, lw=1, label="second order with dead time")
    a.set(xlabel="time (s)", ylabel="position (µm)")
    _legend(fig, a)
    rows = [
        (k, g["kp"], g["ti_s"], g["td_s"], g["gain"], g["phase_deg"], g["how"])
        for k, g in (("present", pid.present), ("proposed", pid.proposed))
    ]
    caption = (
        "Short ramps of the setpoint, and the response fitted to drive and position. "
        f"{_for_people(response.summary)}."
    )
    titles = ("gains", "kp", "ti, s", "td, s", "gain margin", "phase margin, °", "how")
    return figure(fig, caption) + table(titles, rows)


def _axes(n: int = 1) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    fig = Figure(figsize=(9, 2.6 * n), layout="constrained")
    return fig, list(fig.subplots(n, 1, sharex=True, squeeze=False)[:, 0])


def _legend(fig: Figure, axes: Axes) -> None:
    handles = axes.get_legend_handles_labels()
    fig.legend(*handles, loc="outside upper right", ncols=2, frameon=False, fontsize=8)


def _curve(series: Series) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in series])


def _for_people(text: str) -> str:
    return text.replace("+-", "±").replace(" um", " µm").replace(" deg", "°")
