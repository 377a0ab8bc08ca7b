"""The paper's figures 10 to 18, from one simulated rig."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tests.reproduction import paper
from tests.reproduction.rigs import Simulated
from tests.reproduction.seeds import Kept
from thermoctl.calibration import chain
from thermoctl.calibration.recorded import Recorded, filled
from thermoctl.calibration.schedules import CUTOFF_HZ
from thermoctl.identify import experiments
from thermoctl.report.page import figure
from thermoctl.rig.signals import POINTS

SHOWN = (0, 2, 5, 8, 10)  # points whose rises are drawn
REACHED = 1 - np.exp(-1)  # share of a first-order step after one time constant


def figures(kept: Kept) -> list[str]:
    """Draw every figure as HTML, in the paper's order."""
    _, r2, r3, _ = kept.tests
    c = kept.calibration
    return [
        _step(kept.tests[0]),
        _input(r2),
        _singular_values(c),
        _errors(
            r2,
            {"paper's MKF": paper.estimate(c.mkf, r2), "better": chain.run_kalman(c.kalman, r2)},
            "Fig. 12, test 2: true rises, and the estimates' errors, means of a minute",
        ),
        _motion(r3),
        _errors(
            r3,
            {
                "before filtering": kept.estimate["open loop"],
                "paper's MKF": kept.estimate["paper"],
                "better": kept.estimate["better"],
            },
            "Fig. 14 and 15, test 3: true rises, and the errors of the paper's model alone, its MKF and the better filter, "
            "means of a minute",
        ),
        _gain(c, r3),
        _position(kept),
    ]


def _axes(n: int = 1, high: float = 2.6) -> tuple[Figure, list[Axes]]:
    fig = Figure(figsize=(8, high * n), layout="constrained")
    return fig, list(fig.subplots(n, 1, squeeze=False)[:, 0])


def _step(r: Simulated) -> str:
    fig, (a,) = _axes()
    for j in (0, 10):
        a.plot(r.t / 60, r.temperatures[:, j] - r.air_c, lw=0.7, label=POINTS[j])
    a.set(xlabel="min", ylabel="rise, K")
    a.legend(frameon=False)
    coil = r.true_c[:, 0] - r.air_c
    tau = float(np.argmax(coil >= REACHED * coil[-300:].mean()))
    return figure(
        fig,
        f"Fig. 10, test 1: step of power; the coil reaches 63.2 % after {tau:.0f} s, f_c = {1 / (2 * np.pi * tau):.2g} Hz",
    )


def _input(r: Recorded) -> str:
    fig, (a, b) = _axes(2)
    a.plot(r.t / 3600, r.power_w)
    a.set(xlabel="h", ylabel="power, W")
    f, s = experiments.spectrum(r.t, r.power_w)
    b.loglog(f[1:3000], s[1:3000])
    b.axvline(CUTOFF_HZ, ls="--")
    b.set(xlabel="Hz", ylabel="W²/Hz", ylim=(s[1:3000].max() * 1e-7, None))
    share = 100 * experiments.share_below(r.t, r.power_w, CUTOFF_HZ)
    return figure(fig, f"Fig. 11, test 2: input; {share:.0f} % of its alternating power lies below f_c")


def _singular_values(c: paper.Calibration) -> str:
    fig, (a,) = _axes()
    a.semilogy(np.arange(1, 31), np.array(c.paper_model.info["singular_values"][:30]), "o-")
    a.set(xlabel="order", ylabel="singular value")
    return figure(
        fig, "Singular values of the oblique projection (19); 12 are used, 6 to 8 stand above the noise"
    )


def _errors(r: Simulated, estimates: Mapping[str, np.ndarray], caption: str) -> str:
    truth = r.true_c - chain.smooth_air(r.air_c)[:, None]
    fig, (top, *rest) = _axes(1 + len(estimates), 2.2)
    for j in SHOWN:
        top.plot(r.t / 3600, truth[:, j], lw=1, label=POINTS[j].replace("_", " "))
    top.set(ylabel="rise, K")
    for ax, (name, estimate) in zip(rest, estimates.items(), strict=True):
        error = paper.block_mean(estimate - truth, 60)
        ax.plot((np.arange(len(error)) + 0.5) / 60, error[:, list(SHOWN)], lw=1)
        ax.axhline(0, color="0.6", lw=0.6)
        ax.set(ylabel=f"{name}, K")
    rest[-1].set(xlabel="h")
    handles = top.get_legend_handles_labels()
    fig.legend(*handles, loc="outside upper center", ncols=len(SHOWN), frameon=False, fontsize=8)
    return figure(fig, caption)


def _motion(r: Recorded) -> str:
    fig, (a, b) = _axes(2, 2.0)
    a.plot(r.t / 3600, r.setpoint_um, lw=0.7)
    first = r.t < 900
    b.plot(r.t[first] / 60, r.setpoint_um[first], lw=1)
    a.set(ylabel="setpoint, µm", xlabel="h")
    b.set(ylabel="setpoint, µm", xlabel="min")
    return figure(fig, "Fig. 13, test 3: motion, and its first quarter of an hour")


def _gain(c: paper.Calibration, r: Recorded) -> str:
    fig, (a, b) = _axes(2)
    q = round(c.mkf.period_s)
    coil = paper.block_mean(filled(chain.rises(r)[:, :1]), q)[:, 0]
    t, k = c.mkf.run(paper.block_mean(r.power_w[:, None], q)[:, 0], coil)
    a.plot(k[:30], "o-")
    a.set(xlabel="sample", ylabel="gain")
    b.plot(np.arange(len(t)) * q / 3600, coil - t[:, 0], lw=0.5)
    b.set(xlabel="h", ylabel="coil error, K")
    return figure(fig, "Fig. 16: gain of the MKF and its error signal")


def _position(kept: Kept) -> str:
    r = kept.tests[3]
    fig, (a, b, d) = _axes(3)
    a.plot(r.t / 3600, r.setpoint_um, lw=0.5)
    b.plot(r.t / 3600, r.true_um, label="uncompensated")
    for name in ("siso", "paper", "better"):
        d.plot(r.t / 3600, kept.residual[name], label=name, lw=0.8)
    a.set(ylabel="setpoint, µm")
    b.set(ylabel="uncompensated, µm")
    d.set(ylabel="residual, µm", xlabel="h")
    d.legend(ncols=3, frameon=False)
    return figure(
        fig,
        "Fig. 17 and 18, test 4: motion, position error, and the residual of each estimator; the first two hours are the "
        "calibration",
    )
