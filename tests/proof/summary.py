"""Figures of a scored set: numbers with interval and goal, and tables by family and effect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from tests.proof.score import NAMING, Row
from tests.proof.statistics import Share, by_chance, found_by_size, quantile, reliability, share

BANDS = ("large", "middle", "small")  # of an effect's size: above 15, 6 to 15, 3 to 6 sigmas
ONSET_SHARE = 0.02  # share of the recording's length: an onset with a smaller error counts as right

# name -> (figure, at least / at most)
Goals = Mapping[str, tuple[float, str]]
GOALS: Goals = {
    "false_alarms": (0.01, "most"),
    "detected_large": (0.99, "least"),
    "detected_middle": (0.96, "least"),
    "detected_small": (0.45, "least"),
    "right_when_named": (0.97, "least"),
    "inside_the_set": (0.98, "least"),
    "place_right": (0.95, "least"),
    "unknown_called_unknown": (0.90, "least"),
    "confidently_misnamed": (0.03, "most"),
    "interval_coverage": (0.93, "least"),
    "gain_median": (0.95, "least"),
    "gain_worst_tenth": (0.75, "least"),
    "calibration_error": (0.03, "most"),
    "cpu_s_median": (8.0, "most"),
    "cpu_s_longest": (120.0, "most"),
}
OPEN_GOALS: Goals = {
    "named_and_placed": (0.90, "least"),
    "nothing_named_where_nothing_is": (0.95, "least"),
    "strays_per_diagnosis": (0.1, "most"),
    "calibration_error": (0.05, "most"),
    "gain_median": (0.90, "least"),
}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Compute all figures of a set for JSON.

    `figures` (one number each), `shares` (with intervals) and tables. Cases with small misfits of no known
    name are separate, under `open_world`.
    """
    opened = open_world([r for r in rows if r.world == "open"])
    rows = [r for r in rows if r.world != "open"]
    single = [r for r in rows if r.kind == "one"]
    shares, sizes = _shares(rows), _by_size(single)
    given = [x for r in rows for x in r.calibration]
    bins, calibration_error = reliability(given)
    figures = {k: s.value for k, s in shares.items()} | _numbers(rows)
    figures |= {
        "calibration_error": calibration_error,
        "calibration_error_by_chance": by_chance(given),
        **{f"half_found_at_{name}": c["half"] if c else None for name, c in sizes.items()},
    }
    return {
        "figures": figures,
        "shares": {k: s.plain() for k, s in shares.items()},
        "goals": _against(figures, GOALS),
        "open_world": opened,
        "reliability": bins,
        "found_by_size": sizes,
        "confusion": _confusion(rows),
        "by_family": _grouped(rows, [r.family for r in rows]),
        "by_effect": _grouped(single, [r.truth[0][0] for r in single]),
    }


def _shares(rows: Sequence[Row]) -> dict[str, Share]:
    null = [r for r in rows if r.kind == "none"]
    single = [r for r in rows if r.kind == "one"]
    known = [r for r in rows if r.kind not in ("none", "unknown")]
    unknown = [r for r in rows if r.kind == "unknown"]
    two = [r for r in rows if r.kind in ("pair", "cancel")]
    stated = [r for r in rows if r.verdict in ("explained", "partly_explained") and r.findings]
    banded = single if any(r.band for r in single) else known
    bands: dict[str, list[Row]] = {b: [r for r in banded if r.band == b] for b in BANDS}
    return {
        "false_alarms": share(r.detected for r in null),
        **{f"detected_{b}": share(r.detected for r in g) for b, g in bands.items()},
        "detected": share(r.detected for r in known + unknown),
        "named": share(r.named for r in known),
        "right_when_named": share(r.alike for r in stated),
        "right_when_named_exactly": share(r.exact for r in stated),
        "exact_name": share(r.exact for r in known),
        **{f"exact_name_{b}": share(r.exact for r in g) for b, g in bands.items()},
        "name_or_its_like": share(r.alike for r in known),
        "inside_the_set": share(bool(r.inside) for r in known if r.detected),
        "inside_the_set_exactly": share(bool(r.inside_exact) for r in known if r.detected),
        "place_right": share(bool(r.placed) for r in known if r.placed is not None),
        "onset_within_2_percent": share(
            r.onset_error <= ONSET_SHARE for r in known if r.onset_error is not None
        ),
        "unknown_called_unknown": share(r.verdict == "unexplained" for r in unknown),
        "confidently_misnamed": share(r.verdict in NAMING[:2] and r.confident for r in unknown),
        "pairs_both_right": share(r.alike for r in two),
        "pairs_one_right": share(any(f[0] in {e for e, _ in r.truth} for f in r.findings) for r in two),
        "interval_coverage": share(p["covered"] for r in rows for p in r.parameters if p["named"]),
        "interval_coverage_all": share(p["covered"] for r in rows for p in r.parameters),
        "failed": share(r.verdict == "failed" for r in rows),
    }


def _by_size(single: Sequence[Row]) -> dict[str, dict[str, float] | None]:
    """Fit the size that is found half of the time, in all, in white and in coloured noise.

    `learnt`: in all, in sigmas of a test that has to learn the noise."""
    sized = [(r.size, r) for r in single if r.size]
    groups = {
        "all": sized,
        "white": [(size, r) for size, r in sized if r.colour == "white"],
        "coloured": [(size, r) for size, r in sized if r.colour not in (None, "white")],
        "learnt": [(r.learnt, r) for r in single if r.learnt],
    }
    return {
        name: found_by_size([size for size, _ in group], [r.detected for _, r in group])
        for name, group in groups.items()
    }


def _numbers(rows: Sequence[Row]) -> dict[str, float | None]:
    gains = [r.gain for r in rows if r.kind not in ("none", "unknown") and r.detected and r.findings]
    ambiguous = [r.set_size for r in rows if r.verdict == "ambiguous"]
    return {
        "cases": len(rows),
        "gain_median": quantile(gains, 0.5),
        "gain_worst_tenth": quantile(gains, 0.1),
        "cpu_s_median": quantile((r.cpu_s for r in rows), 0.5),
        "cpu_s_longest": max((r.cpu_s for r in rows if r.cpu_s is not None), default=None),
        "set_size_when_ambiguous": sum(ambiguous) / len(ambiguous) if ambiguous else None,
        "parameter_error_median": quantile((p["error"] for r in rows for p in r.parameters), 0.5),
    }


def _confusion(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    """Count the diagnosed names of each true effect (confusion matrix)."""
    counts: dict[str, Counter[str]] = {}
    for r in rows:
        called = ("ambiguous: " if r.verdict == "ambiguous" else "") + r.called
        counts.setdefault(_true_name(r), Counter())[called] += 1
    return {t: dict(c) for t, c in sorted(counts.items())}


def _true_name(r: Row) -> str:
    if not r.truth:
        return "none"
    if r.truth[0][0] == "?":
        return "unknown"
    return r.truth[0][0] if len(r.truth) == 1 else "two"


def _grouped(rows: Sequence[Row], keys: Sequence[str]) -> dict[str, dict[str, int]]:
    return {
        key: _brief([r for r, k in zip(rows, keys, strict=True) if k == key]) for key in sorted(set(keys))
    }


def open_world(rows: Sequence[Row]) -> dict[str, Any]:
    """Compute the figures of the cases with small misfits of no known name; empty without any."""
    if not rows:
        return {}
    visible = [r for r in rows if r.kind == "one" and r.band in ("large", "middle")]
    null = [r for r in rows if r.kind == "none"]
    given = [x for r in rows for x in r.calibration]
    shares = {
        "named_and_placed": share(r.alike and bool(r.placed) for r in visible),
        "truth_among_findings": share(bool(r.named and r.inside) for r in visible),
        "without_strays": share(r.strays == 0 for r in rows),
        "nothing_named_where_nothing_is": share(len(r.findings) == r.of_misfits for r in null),
        "unknown_not_named": share(not r.named for r in rows if r.kind == "unknown"),
    }
    figures = {
        "strays_per_diagnosis": sum(r.strays for r in rows) / len(rows),
        "names_of_misfits": sum(r.of_misfits for r in rows),
        "calibration_error": reliability(given)[1],
        "calibration_error_by_chance": by_chance(given),
        "gain_median": quantile((r.gain for r in visible if r.findings), 0.5),
    }
    return {
        "cases": len(rows),
        "shares": {k: s.plain() for k, s in shares.items()},
        "figures": figures,
        "goals": _against(figures | {k: s.value for k, s in shares.items()}, OPEN_GOALS),
    }


def _against(figures: Mapping[str, float | None], goals: Goals) -> dict[str, dict[str, Any]]:
    """Compare figures with their goals; a figure that could not be measured reaches and misses none."""
    return {
        k: {"goal": g, "at": side, "is": figures.get(k), "reached": _reached(figures.get(k), g, side)}
        for k, (g, side) in goals.items()
    }


def _reached(value: float | None, goal: float, side: str) -> bool | None:
    if value is None:
        return None
    return value >= goal - 1e-12 if side == "least" else value <= goal + 1e-12


def _brief(rows: Sequence[Row]) -> dict[str, int]:
    return {
        "cases": len(rows),
        "detected": sum(r.detected and r.kind != "none" for r in rows),
        "exact": sum(r.exact for r in rows),
        "alike": sum(r.alike for r in rows),
        "inside": sum(bool(r.inside) for r in rows),
        "placed": sum(bool(r.placed) for r in rows),
        "false_alarms": sum(r.detected and r.kind == "none" for r in rows),
        "failed": sum(r.verdict == "failed" for r in rows),
    }
