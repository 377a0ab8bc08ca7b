"""Figures of the Python interface, with matplotlib and without pyplot."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from thermoctl.plant.language import Plant
from thermoctl.plant.simulate import Excitation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("#b7791f", "#2b6cb0", "#c2410c")
KOLMOGOROV = 1.358  # 95 % point of sqrt(n) times the largest deviation of a cumulated distribution
NORMAL = 1.96  # 95 % point of a standard normal deviate, two-sided
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
    count = len(plant.outputs)
    picture = _picture(9, max(3.0, 1.9 * count))
    panels = picture.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    for j, (axes, o) in enumerate(zip(panels, plant.outputs.values(), strict=True)):
        seen = np.isfinite(excitation.y[:, j])
        axes.plot(excitation.t[seen], excitation.y[seen, j], ".", ms=2, color="#7a8894", label="measured")
        for k, (label, y) in enumerate(lines.items()):
            axes.plot(excitation.t, y[:, j], lw=1.1, color=_COLOURS[-len(lines) :][k], label=label)
        axes.set_ylabel(f"{o.name}\n[{o.unit or '1'}]", fontsize=8)
        axes.grid(alpha=0.3)
    panels[0].legend(loc="upper right", fontsize=8)
    panels[-1].set_xlabel("t [s]")
    return picture


def autocorrelation(e: np.ndarray, lags: int) -> np.ndarray:
    """Return the autocorrelation of e (N,) at the lags 1..lags (biased, as in Box and Jenkins)."""
    centred = e - e.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * len(e))) ** 2
    found = np.fft.irfft(spectrum)[: lags + 1]
    return found[1:] / found[0]


def cumulated_periodogram(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies as shares of the sampling rate, and the share of the variance up to each."""
    power = np.abs(np.fft.rfft(e - e.mean())[1:]) ** 2
    return np.arange(1, len(power) + 1) / len(e), np.cumsum(power) / power.sum()


def residual_panels(e: np.ndarray, name: str, unit: str | None) -> Figure:
    """Return residuals (N,) over samples, autocorrelation, cumulated periodogram and normal quantiles."""
    picture = _picture(9, 5.5)
    axes = picture.subplots(2, 2)
    axes[0, 0].plot(e, lw=0.6, color="#2b6cb0")
    _titled(axes[0, 0], f"residuals of {name}", "sample", unit or "")
    lags = min(40, len(e) // 4)
    axes[0, 1].vlines(np.arange(1, lags + 1), 0, autocorrelation(e, lags), color="#2b6cb0")
    for side in (-1, 1):
        axes[0, 1].axhline(side * NORMAL / np.sqrt(len(e)), color="#c2410c", lw=0.8, ls="--")
    _titled(axes[0, 1], "autocorrelation", "lag, samples", "")
    f, share = cumulated_periodogram(e)
    axes[1, 0].plot(f, share, color="#2b6cb0")
    for side in (-1, 0, 1):
        bound = side * KOLMOGOROV / np.sqrt(len(f))
        axes[1, 0].plot(f, 2 * f + bound, color="#c2410c", lw=0.8, ls="--" if side else ":")
    axes[1, 0].set_ylim(0, 1)
    _titled(axes[1, 0], "cumulated periodogram", "frequency / sampling rate", "")
    expected = ndtri((np.arange(len(e)) + 0.5) / len(e))
    axes[1, 1].plot(expected, np.sort(e), ".", ms=2, color="#2b6cb0")
    axes[1, 1].plot(expected, e.mean() + e.std() * expected, color="#c2410c", lw=0.8, ls="--")
    _titled(axes[1, 1], "normal quantiles", "standard normal", unit or "")
    return picture


def profile_curve(values: np.ndarray, rise: np.ndarray, name: str, unit: str | None) -> Figure:
    """Return the rise of -2 log likelihood over a parameter's values, with the 95 % bound."""
    picture = _picture(5, 3.2)
    axes = picture.subplots()
    axes.plot(values, rise, "o-", ms=3, color="#2b6cb0")
    axes.axhline(CHI_SQUARE, color="#c2410c", lw=0.8, ls="--")
    _titled(
        axes, f"profile likelihood of {name}", f"{name} [{unit or '1'}]", "-2 log likelihood, above the best"
    )
    return picture


def _titled(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.grid(alpha=0.3)
