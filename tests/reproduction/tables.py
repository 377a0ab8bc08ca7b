"""Tables of the paper's printed figures with ours."""

from __future__ import annotations

from typing import Any

import numpy as np

from thermoctl.rig.signals import POINTS

ZETA = (1, 0.763, 0.729, 0.495, 0.353, 0.264, 0.148, 0.312, 0.185, 0.131, 0.372, 0.661)
TABLE_V = (
    (0.65, 0.01),
    (0.52, 0.16),
    (0.56, 0.16),
    (0.39, 0.24),
    (0.37, 0.27),
    (0.34, 0.32),
    (0.38, 0.35),
    (0.32, 0.22),
    (0.28, 0.21),
    (0.39, 0.37),
    (0.33, 0.28),
    (0.51, 0.25),
)
TABLE_VI = (
    (0.33, 0.00),
    (0.26, 0.05),
    (0.26, 0.05),
    (0.26, 0.09),
    (0.19, 0.08),
    (0.15, 0.12),
    (0.14, 0.14),
    (0.13, 0.09),
    (0.09, 0.09),
    (0.11, 0.13),
    (0.16, 0.12),
    (0.25, 0.09),
)
POSITION = {"uncompensated": (5.7, 7.3), "siso": (0.7, 2.3), "paper": (-0.2, 0.7)}
LARGEST_K = 0.37  # 1.8 % of the paper's range, so that the range is 20.6 K
RANGE_K = LARGEST_K / 0.018


def temperature_rows(
    estimate: dict[str, np.ndarray], truth: np.ndarray
) -> tuple[list[list[Any]], list[list[Any]]]:
    """Return the rows of Tables V and VI: point, the paper's, then the errors of every estimate.

    Errors are the largest and the mean; estimates are (N, 12).
    """
    largest = {k: np.nanmax(np.abs(v - truth), axis=0) for k, v in estimate.items()}
    mean = {k: np.nanmean(np.abs(v - truth), axis=0) for k, v in estimate.items()}
    five = [
        [p.replace("_", " "), *TABLE_V[j], *(float(v[j]) for v in largest.values())]
        for j, p in enumerate(POINTS)
    ]
    six = [
        [p.replace("_", " "), *TABLE_VI[j], *(float(v[j]) for v in mean.values())]
        for j, p in enumerate(POINTS)
    ]
    return five, six


def zeta_rows(zeta: np.ndarray) -> list[list[Any]]:
    """Return the rows of Table IV."""
    return [[p.replace("_", " "), float(ZETA[j]), float(zeta[j])] for j, p in enumerate(POINTS)]
