"""Statistics of a proof: shares with intervals, calibration of probabilities, detection over size.

Detection, false alarms and all shares carry Wilson's 95 % interval

    (p + z^2/2n +- z sqrt(p (1-p)/n + z^2/4n^2)) / (1 + z^2/n),  z = 1.96

Calibration: the expected error over ten bins b of width 0.1

    ECE = sum_b (n_b/n) |mean probability_b - share right_b|

Detection over size s, in sigmas of an ideal single test, is the curve of MIL-HDBK-1823A

    P(found | s) = 1 / (1 + (half / s)^slope)

by maximum likelihood on a grid. The 95 % interval of `half` ends where twice the log likelihood has fallen by
3.84.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Z_95 = 1.959964  # standard normal quantile of a two-sided 95 % interval
CHI2_95 = 3.84  # 95 % point of chi squared with one degree of freedom
FEWEST_SIZES = 10  # fewest sizes for a detection curve


@dataclass(frozen=True)
class Share:
    """k of n, with Wilson's 95 % interval; the share of nothing is None."""

    k: int
    n: int

    @property
    def value(self) -> float | None:
        """Return k / n."""
        return self.k / self.n if self.n else None

    def interval(self, z: float = Z_95) -> tuple[float, float]:
        """Compute Wilson's interval."""
        if not self.n:
            return 0.0, 1.0
        p, n = self.k / self.n, self.n
        centre = p + z * z / (2 * n)
        half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(0.0, (centre - half) / (1 + z * z / n)), min(1.0, (centre + half) / (1 + z * z / n))

    def plain(self) -> dict[str, Any]:
        """Return count, share and confidence interval as a dict for JSON."""
        low, high = self.interval()
        return {"k": self.k, "n": self.n, "share": self.value, "low": low, "high": high}


def share(flags: Iterable[bool]) -> Share:
    """Count the flags that are true."""
    given = list(flags)
    return Share(sum(map(bool, given)), len(given))


def reliability(
    pairs: Sequence[tuple[float, bool]], bins: int = 10
) -> tuple[list[dict[str, float]], float | None]:
    """Compute the reliability diagram [{probability, right, n}] over bins of equal width.

    Also the calibration error."""
    groups: dict[int, list[tuple[float, bool]]] = {}
    for p, right in pairs:
        groups.setdefault(min(int(p * bins), bins - 1), []).append((p, right))
    table = [
        {"probability": sum(p for p, _ in g) / len(g), "right": sum(r for _, r in g) / len(g), "n": len(g)}
        for _, g in sorted(groups.items())
    ]
    if not pairs:
        return table, None
    return table, sum(b["n"] * abs(b["probability"] - b["right"]) for b in table) / len(pairs)


def by_chance(pairs: Sequence[tuple[float, bool]], draws: int = 400) -> float | None:
    """Compute the mean calibration error that so few findings have with exact probabilities."""
    rng = random.Random(5)
    errors = [reliability([(p, rng.random() < p) for p, _ in pairs])[1] for _ in range(draws)]
    given = [e for e in errors if e is not None]
    return sum(given) / len(given) if given else None


def found_by_size(sizes: Sequence[float], found: Sequence[bool]) -> dict[str, float] | None:
    """Fit the detection probability as a logistic function of log size.

    - `half`: size at probability 0.5; `low`, `high`: its 95 % interval
    - `nine_in_ten`: size at probability 0.9
    - `slope`: of the log odds over log size; `n`: number of sizes

    None for fewer than FEWEST_SIZES sizes, or where all or none were found."""
    if len(sizes) < FEWEST_SIZES or all(found) or not any(found):
        return None
    half, slope = np.geomspace(0.5, 100.0, 400), np.geomspace(0.5, 30.0, 60)
    s, hit = np.log(np.asarray(sizes, float)), np.asarray(found, bool)
    odds = slope[None, :, None] * (s - np.log(half)[:, None, None])
    likely = -np.logaddexp(0.0, np.where(hit, -odds, odds)).sum(axis=2)
    i, j = np.unravel_index(int(np.argmax(likely)), likely.shape)
    inside = half[2 * (likely.max() - likely.max(axis=1)) <= CHI2_95]
    return {
        "half": float(half[i]),
        "low": float(inside[0]),
        "high": float(inside[-1]),
        "nine_in_ten": float(half[i] * 9 ** (1 / slope[j])),
        "slope": float(slope[j]),
        "n": len(sizes),
    }


def quantile(values: Iterable[float | None], q: float) -> float | None:
    """Interpolate the q quantile of the values that are not None; None without any."""
    given = sorted(v for v in values if v is not None)
    if not given:
        return None
    at = q * (len(given) - 1)
    low = int(at)
    return given[low] + (at - low) * (given[min(low + 1, len(given) - 1)] - given[low])
