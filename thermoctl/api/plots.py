"""Figures of the Python interface, with matplotlib and without pyplot."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.plant import show
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.report.residuals import draw_autocorrelation, draw_periodogram, titled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHI_SQUARE = 3.84  # 95 % point of chi square of one degree of freedom


def _picture(width: float, height: float) -> Figure:
    """Return a matplotlib Figure, sizes in inches, that a notebook shows without pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Picture(Figure):
        """A Figure that a notebook draws as PNG."""

        def _repr_png_(self) -> bytes:
            out = io.BytesIO()
            self.savefig(out, format="png", dpi=90)
            return out.getvalue()

    picture = Picture(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(picture)
    return picture


def over_time(plant: Plant, excitation: Excitation, lines: Mapping[str, np.ndarray]) -> Figure:
    """Return the measured outputs, and simulated ones (N, outputs) by label."""
    picture = _picture(9, max(3.0, 1.9 * len(plant.outputs)))
    show.over_time(picture, plant, excitation, lines)
    return picture


def residual_panels(e: np.ndarray, name: str, unit: str | None) -> Figure:
    """Return residuals (N,) over samples, autocorrelation, cumulated periodogram and normal quantiles."""
    picture = _picture(9, 5.5)
    axes = picture.subplots(2, 2)
    axes[0, 0].plot(e, lw=0.6, color="#2b6cb0")
    titled(axes[0, 0], f"residuals of {name}", "sample", unit or "")
    draw_autocorrelation(axes[0, 1], e)
    draw_periodogram(axes[1, 0], e)
    from scipy.special import ndtri

    expected = ndtri((np.arange(len(e)) + 0.5) / len(e))
    axes[1, 1].plot(expected, np.sort(e), ".", ms=2, color="#2b6cb0")
    axes[1, 1].plot(expected, e.mean() + e.std() * expected, color="#c2410c", lw=0.8, ls="--")
    titled(axes[1, 1], "normal quantiles", "standard normal", unit or "")
    return picture


def profile_curve(values: np.ndarray, rise: np.ndarray, name: str, unit: str | None) -> Figure:
    """Return the rise of -2 log likelihood over a parameter's values, with the 95 % bound."""
    picture = _picture(5, 3.2)
    axes = picture.subplots()
    axes.plot(values, rise, "o-", ms=3, color="#2b6cb0")
    axes.axhline(CHI_SQUARE, color="#c2410c", lw=0.8, ls="--")
    titled(
        axes, f"profile likelihood of {name}", f"{name} [{unit or '1'}]", "-2 log likelihood, above the best"
    )
    return picture
