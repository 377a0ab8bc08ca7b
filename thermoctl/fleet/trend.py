"""Rigs over time: which parameters drift, which model no longer fits, and what to do about it.

A straight line is fitted to a parameter's estimates. The parameter drifts when the slope exceeds DRIFT_SIGMA
standard errors and the total change exceeds DRIFT_SHARE. A model no longer fits when the newest recording's
misfit is above FIT_LIMIT. If a refit removes the misfit, identify again; else physics is missing: diagnose.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoctl.control import faults
from thermoctl.fleet.health import Summary
from thermoctl.recording.dates import MONTH_S, line

DRIFT_SIGMA, DRIFT_SHARE, FIT_LIMIT = 4.0, 0.05, 3.0


@dataclass(frozen=True)
class Drift:
    """A straight line through a parameter's estimates.

    Change per 30 days, its standard error, share of the mean."""

    per_month: float
    sigma: float
    share: float
    drifts: bool


@dataclass(frozen=True)
class RigHealth:
    """One rig over all its recordings, oldest first, and what to do about it."""

    name: str
    summaries: tuple[Summary, ...]
    drifts: dict[str, Drift]
    advice: tuple[str, ...]


def judge(summaries: Iterable[Summary]) -> list[RigHealth]:
    """Group summaries of any rigs in any order by rig, and assess each."""
    by_rig: dict[str, list[Summary]] = {}
    for s in summaries:
        by_rig.setdefault(s.rig, []).append(s)
    return [
        _judged(name, sorted(group, key=lambda s: (math.isnan(s.begin_s), s.begin_s, s.path)))
        for name, group in sorted(by_rig.items())
    ]


def _judged(name: str, group: list[Summary]) -> RigHealth:
    good = [s for s in group if not s.error]
    names = list(dict.fromkeys(p for s in good for p in s.estimates))
    drifts = {
        p: drift(
            [s.begin_s for s in good if p in s.estimates], [s.estimates[p] for s in good if p in s.estimates]
        )
        for p in names
    }
    advice = [f"{Path(s.path).name}: {s.error}" for s in group if s.error]
    if good:
        advice += _advice(good[-1], drifts)
    return RigHealth(name, tuple(group), drifts, tuple(advice))


def _advice(newest: Summary, drifts: dict[str, Drift]) -> list[str]:
    lines = []
    if newest.misfit > FIT_LIMIT:
        cure = (
            "new values fit, identify again"
            if newest.misfit_refitted <= FIT_LIMIT
            else f"look for what is missing: thermoctl diagnose {newest.path}"
        )
        lines.append(
            f"the model no longer fits ({newest.worst}: {newest.misfit:.1f} times its noise): {cure}"
        )
    lines += [
        f"{p} drifts by {d.per_month:+.3g} a month ({100 * d.share:+.1f} % in the time seen)"
        for p, d in drifts.items()
        if d.drifts
    ]
    known = [faults.BY_NAME[f] for f in newest.faults if f in faults.BY_NAME]
    lines += [f"fault {f.name}: {f.remedy}" for f in known if f.severity != "warning"]
    return lines + [f"fault {f}: of another version" for f in newest.faults if f not in faults.BY_NAME]


def drift(times_s: Sequence[float], estimates: Sequence[tuple[float, float]]) -> Drift:
    """Check a parameter's estimates (value, standard error) over time; fewer than three never drift."""
    slope, sigma = line(times_s, estimates)
    value, sd = np.array(estimates, dtype=float).reshape(-1, 2).T
    mean = np.average(value, weights=np.maximum(sd, 1e-300) ** -2.0) if len(value) else 0.0
    share = slope * float(np.ptp(times_s)) / MONTH_S / abs(mean) if mean else 0.0
    drifts = abs(slope) > DRIFT_SIGMA * sigma and abs(share) > DRIFT_SHARE
    return Drift(slope, sigma, float(share), bool(drifts))
