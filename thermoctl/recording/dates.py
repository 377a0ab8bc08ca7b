"""Dates of recordings, and the trend over these dates of a quantity that each recording gives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from thermoctl.recording.table import Table

MONTH_S = 30 * 86400.0
FEWEST = 3  # least number of sizes to compute their scatter about a line


def line(times_s: Sequence[float], sizes: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the slope, a month, of a line through (value, standard deviation), and its standard error.

    Fewer than FEWEST sizes, or one date for all, leave it unknown: (0, infinity)."""
    t = np.asarray(times_s) / MONTH_S
    if len(t) < FEWEST or np.ptp(t) == 0.0:
        return 0.0, math.inf
    value, sd = np.array(sizes, dtype=float).T
    weight = 1.0 / np.maximum(sd, 1e-9 * np.abs(value) + 1e-300) ** 2
    away = t - np.average(t, weights=weight)
    spread = float(np.sum(weight * away**2))
    mean = np.average(value, weights=weight)
    slope = float(np.sum(weight * away * (value - mean))) / spread
    scatter = float(np.sum(weight * (value - mean - slope * away) ** 2)) / (len(t) - 2)
    return slope, math.sqrt(max(scatter, 1.0) / spread)


def begun(table: Table) -> float:
    """Return when a recording began, s since 1970; NaN where it does not say."""
    wall = table.columns.get("wall_s", np.zeros(0))
    if np.isfinite(wall).any():
        return float(wall[np.isfinite(wall)][0])
    try:
        return float(np.datetime64(table.meta["start"].rstrip("Z"), "ms").astype(np.int64)) / 1000
    except (KeyError, ValueError):
        return math.nan
