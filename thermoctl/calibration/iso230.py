"""Positioning accuracy after ISO 230-2.

Deviation x_ij = P_ij - P_i of the j-th approach to target i from one direction; n approaches, m targets:

    mean unidirectional deviation     x_i = 1/n sum_j x_ij
    estimator of repeatability        s_i = sqrt(1/(n-1) sum_j (x_ij - x_i)^2)
    written as x +- 2 s
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.table import Table

FEWEST = 2  # approaches to a target, by the standard's estimator of repeatability
SETTLE_S = 2.0  # settling time after arrival, before an approach is read
SETTLED = 10  # first samples, whose mean error is taken as zero
AT_TARGET_UM = 1e-6  # largest distance of reference and setpoint at rest


@dataclass(frozen=True)
class Direction:
    """One direction of approach: targets (m,) um, mean (m,), s (m,), n (m,)."""

    targets: np.ndarray
    mean: np.ndarray
    s: np.ndarray
    n: np.ndarray


def unidirectional(targets_um: np.ndarray, deviations_um: np.ndarray) -> Direction:
    """Compute the figures of one direction from pairs (target, deviation) of every approach.

    Raises InputError below two approaches."""
    unique = np.unique(targets_um)
    groups = [deviations_um[targets_um == v] for v in unique]
    if any(len(g) < FEWEST for g in groups):
        raise InputError("ISO 230-2 needs at least two approaches to every target")
    return Direction(
        unique,
        np.array([g.mean() for g in groups]),
        np.array([g.std(ddof=1) for g in groups]),
        np.array([len(g) for g in groups]),
    )


def mean_and_two_s(error_um: np.ndarray) -> tuple[float, float]:
    """Compute mean and 2 s of an error that is recorded continuously, as in the paper."""
    e = error_um[np.isfinite(error_um)]
    return float(e.mean()), float(2 * e.std(ddof=1))


def approaches(setpoint_um: np.ndarray, settle: int) -> list[tuple[int, float, int]]:
    """Find the stops of the motion.

    Return (index `settle` samples after arrival, target, direction +1 or -1) of each."""
    still = np.concatenate([[False], setpoint_um[1:] == setpoint_um[:-1]])
    out, last = [], 0
    for k in range(1, len(still)):
        if not still[k]:
            last = 1 if setpoint_um[k] > setpoint_um[k - 1] else -1
        elif not still[k - 1] and k + settle < len(still) and still[k : k + settle].all():
            out.append((k + settle, float(setpoint_um[k]), last))
    return out


def figures(table: Table, path: str) -> list[str]:
    """Show the figures of a recording as lines: of the error at rest, and by target and direction.

    Raises InputError for a recording without the reference encoder."""
    for n in ("output_reference_um", "setpoint_um"):
        if n not in table.columns:
            raise InputError(
                f"{path}: column '{n}' is missing; only a recording with the reference encoder can be judged"
            )
    setpoint, output = table.columns["setpoint_um"], table.columns["output_reference_um"]
    reference = table.columns.get("reference_um", setpoint)
    error = output - reference
    error = error - np.nanmean(error[:SETTLED])
    rest = np.abs(reference - setpoint) < AT_TARGET_UM
    mean, two_s = mean_and_two_s(error[rest])
    lines = [
        f"{path}: {mean:+.3f} +- {two_s:.3f} um (mean deviation, 2 s, {int(rest.sum())} samples at rest)"
    ]
    stops = approaches(reference, max(1, round(SETTLE_S / np.median(np.diff(table.t)))))
    for way, word in ((1, "upwards"), (-1, "downwards")):
        targets = np.round([v for _, v, d in stops if d == way], 3)
        deviations = np.round([error[k] for k, _, d in stops if d == way], 3)
        several = np.array([np.sum(targets == v) >= FEWEST for v in targets], dtype=bool)
        if several.any():
            d = unidirectional(targets[several], deviations[several])
            lines += [
                f"  {word} to {v:g} um: {m:+.3f} +- {2 * s:.3f} um, {n} approaches"
                for v, m, s, n in zip(d.targets, d.mean, d.s, d.n, strict=True)
            ]
    return lines
