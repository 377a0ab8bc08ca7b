"""Tests for white residuals: autocorrelation and cumulated periodogram, with the bounds of white noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KOLMOGOROV = 1.358  # 95 % point of sqrt(n) times the largest deviation of a cumulated distribution
NORMAL = 1.96  # 95 % point of a standard normal deviate, two-sided
LAGS = 40  # at most
POINTS = 400  # largest number of points of a curve: pixels of its panel
LINE, BOUND, FAINT = "#0b6bcb", "#c7621b", "#d9d9d9"


def autocorrelation(e: np.ndarray, lags: int) -> np.ndarray:
    """Return the autocorrelation of e (N,) at the lags 1..lags (biased, as in Box and Jenkins)."""
    centred = e - e.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * len(e))) ** 2
    correlation = np.fft.irfft(spectrum)[: lags + 1]
    return correlation[1:] / correlation[0]


def cumulated_periodogram(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies as shares of the sampling rate, and the share of the variance up to each."""
    power = np.abs(np.fft.rfft(e - e.mean())[1:]) ** 2
    return np.arange(1, len(power) + 1) / len(e), np.cumsum(power) / power.sum()


def draw_autocorrelation(axes: Axes, e: np.ndarray) -> None:
    """Draw the autocorrelation of residuals (N,) with its 95 % bounds."""
    lags = min(LAGS, len(e) // 4)
    axes.vlines(np.arange(1, lags + 1), 0, autocorrelation(e, lags), color=LINE)
    for side in (-1, 1):
        axes.axhline(side * NORMAL / np.sqrt(len(e)), color=BOUND, lw=0.8, ls="--")
    titled(axes, "autocorrelation", "lag, samples", "")


def draw_periodogram(axes: Axes, e: np.ndarray) -> None:
    """Draw the cumulated periodogram of residuals (N,) with its 95 % bounds."""
    f, share = cumulated_periodogram(e)
    shown = np.linspace(0, len(f) - 1, min(len(f), POINTS)).astype(int)
    axes.plot(f[shown], share[shown], color=LINE)
    for side in (-1, 0, 1):
        bound = side * KOLMOGOROV / np.sqrt(len(f))
        axes.plot(f[[0, -1]], 2 * f[[0, -1]] + bound, color=BOUND, lw=0.8, ls="--" if side else ":")
    axes.set_ylim(0, 1)
    titled(axes, "cumulated periodogram", "frequency / sampling rate", "")


def titled(axes: Axes, title: str, x: str, y: str) -> None:
    """Set title and labels, and draw a grid."""
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.grid(color=FAINT, lw=0.6)
    axes.set_axisbelow(True)
