"""The reproduction's goals, measured on many rigs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tests.reproduction import tables
from tests.reproduction.rigs import DISTURBANCES
from tests.reproduction.seeds import SeedResult

THREEFOLD = 0.4  # of SISO's repeatability: a ratio of 2.5 or more rounds to the paper's threefold


class Goal(NamedTuple):
    """One goal: the measured value, the required range in words, and whether it is met (yes or NO)."""

    what: str
    measured: float
    wanted: str
    met: str


class Limit(NamedTuple):
    """Limits of the methods on a family of rigs, medians: ratios of 2 s, um, and K."""

    rigs: str
    paper_over_siso: float
    paper_um: float
    largest_k: float
    better_over_paper: float
    worst: float


def goals(seeds: Sequence[SeedResult], disturbed: Sequence[SeedResult]) -> list[Goal]:
    """Measure every goal."""

    def two_s(k: str) -> np.ndarray:
        """Return 2 s of the position of estimator `k` (seeds,), um."""
        return np.array([s.position[k][1] for s in seeds])

    def mean(k: str) -> np.ndarray:
        """Return the absolute mean position of estimator `k` (seeds,), um."""
        return np.abs([s.position[k][0] for s in seeds])

    b, p, s, t, y = (two_s(k) for k in ("better", "paper", "siso", "twelve", "bayes"))
    median = np.median
    filtered = {k: median([x.temperature[k][0] for x in seeds]) for k in ("paper", "better")}
    return [
        _goal("uncompensated mean, median seed, um", median(mean("uncompensated")), 10, 5),
        _goal("uncompensated 2 s, median seed, um", median(two_s("uncompensated")), 15, 5),
        _goal("paper's method 2 s / SISO 2 s, median (about a third)", median(p / s), THREEFOLD),
        *(
            _goal(
                f"largest filtered error, {name} method, median, % of range",
                100 * filtered[k] / tables.RANGE_K,
                1.8,
            )
            for k, name in (("paper", "paper's"), ("better", "better"))
        ),
        _goal("better 2 s / paper's, median seed", median(b / p), 0.45),
        _goal("better 2 s / paper's, worst seed", np.max(b / p), 0.6),
        _goal("Bayes bound 2 s / paper's, worst seed: what no estimator can beat", np.max(y / p), None),
        _goal("better 2 s / SISO 2 s, median", median(b / s), 0.2),
        _goal("better |mean| / paper's |mean|, medians", median(mean("better")) / median(mean("paper")), 0.4),
        _goal("better 2 s / that of 12 sensors, median", median(b / t), 1.5),
        _goal("better 2 s / Bayes bound, median", median(b / y), None),
        *_disturbed_goals(disturbed),
    ]


def _disturbed_goals(disturbed: Sequence[SeedResult]) -> list[Goal]:
    """Require that the better method is not worse than the paper's on disturbed rigs."""
    rows = []
    for name in DISTURBANCES:
        found = [d.position for d in disturbed if d.disturbance == name]
        if found:
            worst = max(v["better"][1] / v["paper"][1] if np.isfinite(v["paper"][1]) else 0.0 for v in found)
            what = f"{name.replace('_', ' ')}: better 2 s / paper's, worst of {len(found)} rigs"
            rows.append(_goal(what, worst, 1.0))
    return rows


def _goal(what: str, value: float, high: float | None, low: float = 0.0) -> Goal:
    """Make one goal; `high` None: the value is only printed."""
    if high is None:
        return Goal(what, float(value), "printed", "yes")
    wanted = f"{low:g} to {high:g}" if low else f"<= {high:g}"
    return Goal(what, float(value), wanted, "yes" if low <= value <= high else "NO")


def limits(families: Mapping[str, Sequence[SeedResult]]) -> list[Limit]:
    """Compare families of rigs by the limits of both methods."""
    out = []
    for name, results in families.items():
        p, s, b = (np.array([r.position[k][1] for r in results]) for k in ("paper", "siso", "better"))
        largest = [r.temperature["paper"][0] for r in results]
        better, siso = b / p, p / s
        out.append(
            Limit(
                name,
                float(np.median(siso)),
                float(np.median(p)),
                float(np.median(largest)),
                float(np.median(better)),
                float(np.max(better)),
            )
        )
    return out
