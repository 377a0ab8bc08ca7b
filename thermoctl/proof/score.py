"""Figures of a diagnosis against sealed answers: pure functions from (answer, result) pairs to rates with intervals.

Detection, false alarms and all shares carry Wilson's 95 % interval

    (p + z^2/2n +- z sqrt(p (1-p)/n + z^2/4n^2)) / (1 + z^2/n),  z = 1.96

Calibration: the expected error  ECE = sum_b (n_b/n) |mean probability_b - share right_b|  over ten bins of width 0.1.
Detection over size s, in sigmas of an ideal single test (the curve of MIL-HDBK-1823A), by maximum likelihood on a grid,

    P(found | s) = 1 / (1 + (half / s)^slope),  95 % interval of `half`: where twice the log likelihood has fallen by 3.84
Held-out gain: with e the mean over outputs of (rms / oracle's rms)^2 on data that took no part,

    share = (e_refit - e_after) / (e_refit - 1)      1: as good as the true physics; 0: no better than a refit alone.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from thermoctl.yamlfile import InputError

SYMMETRIC = ("missing_link", "bending")  # `a-b` and `b-a` name the same place
BANDS = ("large", "middle", "small")
NAMING = ("explained", "partly_explained", "ambiguous")  # verdicts that state a name
CONFIDENT = 0.9  # a name given with at least this probability counts as stated with confidence

# the figures to reach (issue "The proof"): name -> (figure, at least / at most)
GOALS = {
    "false_alarms": (0.02, "most"),
    "detected_large": (0.98, "least"),
    "detected_middle": (0.90, "least"),
    "detected_small": (0.50, "least"),
    "right_when_named": (0.95, "least"),
    "inside_the_set": (0.97, "least"),
    "place_right": (0.92, "least"),
    "unknown_called_unknown": (0.80, "least"),
    "confidently_misnamed": (0.05, "most"),
    "gain_median": (0.90, "least"),
    "gain_worst_tenth": (0.70, "least"),
    "calibration_error": (0.05, "most"),
    "seconds_longest": (180.0, "most"),
}


@dataclass(frozen=True)
class Share:
    """k of n, with Wilson's 95 % interval; the share of nothing is None."""

    k: int
    n: int

    @property
    def value(self) -> float | None:
        """k / n."""
        return self.k / self.n if self.n else None

    def interval(self, z: float = 1.959964) -> tuple[float, float]:
        """Wilson's interval."""
        if not self.n:
            return 0.0, 1.0
        p, n = self.k / self.n, self.n
        centre = p + z * z / (2 * n)
        half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(0.0, (centre - half) / (1 + z * z / n)), min(1.0, (centre + half) / (1 + z * z / n))

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        low, high = self.interval()
        return {"k": self.k, "n": self.n, "share": self.value, "low": low, "high": high}


def share(flags: Iterable[bool]) -> Share:
    """How many of the flags are true."""
    given = list(flags)
    return Share(sum(map(bool, given)), len(given))


@dataclass
class Row:
    """One scored case. `called` is what the diagnosis said in one word: an effect, `none` or `unknown`."""

    case: str
    family: str
    kind: str
    band: str | None
    size: float | None  # sigmas of an ideal single test that are left of the effect after a refit
    colour: str | None  # of the noise
    truth: list[tuple[str, str]]
    verdict: str
    called: str
    findings: list[tuple[str, str]]
    detected: bool
    named: bool
    exact: bool  # every finding is a true effect by name, and every true effect is found
    alike: bool  # the same, a name that the data cannot tell from the true one allowed
    placed: bool | None  # every rightly named finding sits at the right place; None without one
    inside: bool | None  # every true effect (or its like) is among findings and alternatives
    inside_exact: bool | None
    set_size: int
    confident: bool
    onset_error: float | None  # share of the recording's length
    gain: float | None
    seconds: float | None
    error: str | None
    world: str = "closed"  # open: with small misfits that nobody will name
    strays: int = 0  # findings that are neither a true effect nor one that the data cannot tell from it
    calibration: list[tuple[float, bool]] = field(default_factory=list)
    parameters: list[dict[str, Any]] = field(default_factory=list)


def _same_place(effect: str, a: str, b: str) -> bool:
    return a == b or (
        effect in SYMMETRIC and "-" in a and tuple(a.split("-")) == tuple(reversed(b.split("-")))
    )


def score(
    case: str,
    answer: Mapping[str, Any],
    result: Mapping[str, Any] | None,
    seconds: float | None = None,
    error: str | None = None,
    duration_s: float | None = None,
) -> Row:
    """Compare one diagnosis.json (None where the diagnosis failed: `error` says why) with its answer."""
    for key in ("verdict", "effects", "nearly_the_same"):
        if key not in answer:
            raise InputError(
                f"answer of case {case}: `{key}` is missing; expected verdict, effects and nearly_the_same"
            )
    truth = [(str(e), str(w)) for e, w in answer["effects"]]
    kind = answer.get("kind") or (
        "none" if not truth else "unknown" if truth[0][0] == "?" else "one" if len(truth) == 1 else "pair"
    )
    alike_names = set(answer["nearly_the_same"])
    alike_places = [(e, w) for e, w in answer.get("nearly_the_same_places", [])]
    also = [(e, w) for e, w in answer.get("also_right", [])]
    result = result or {"verdict": "failed", "findings": [], "alternatives": [], "fit": {}}
    findings = [(f["effect"], f["where"]) for f in result["findings"]]
    alternatives = [(f["effect"], f["where"]) for f in result["alternatives"]]
    verdict = result["verdict"]
    true_names = Counter(e for e, _ in truth)

    def near(found: tuple[str, str], true: tuple[str, str]) -> bool:
        return found[0] == true[0] or found[0] in alike_names or found in alike_places

    def at(found: tuple[str, str]) -> bool:
        return (
            any(_same_place(found[0], found[1], w) for _, w in truth)
            or found in alike_places
            or found in also
            or any(_same_place(e, found[1], w) and e == found[0] for e, w in alike_places)
        )

    named = verdict in NAMING and bool(findings)
    exact = bool(truth) and Counter(e for e, _ in findings) == true_names
    alike = bool(truth) and len(findings) == len(truth) and _matched(findings, truth, near)
    right_by_name = [f for f in findings if any(near(f, t) for t in truth)]
    everything = findings + alternatives
    probabilities = [
        (
            float(f["probability"]),
            # exactly: explanations exclude each other
            any(f["effect"] == e and _same_place(e, f["where"], w) for e, w in truth)
            or (f["effect"], f["where"]) in also,
        )
        for f in [*result["findings"], *result["alternatives"]]
    ]
    called = (
        "failed"
        if verdict == "failed"
        else "none"
        if verdict == "consistent"
        else findings[0][0]
        if findings and verdict != "unexplained"
        else "unknown"
    )
    return Row(
        case=case,
        family=str(answer.get("family", "")),
        kind=kind,
        band=answer.get("band"),
        size=answer["snr"][0] if kind == "one" and answer.get("snr") else None,
        colour=answer.get("colour"),
        truth=truth,
        verdict=verdict,
        called=called,
        findings=findings,
        detected=verdict not in ("consistent", "failed"),
        named=named,
        exact=exact,
        alike=alike,
        placed=all(map(at, right_by_name)) if right_by_name else None,
        inside=all(any(near(f, t) for f in everything) for t in truth)
        if truth and kind != "unknown"
        else None,
        inside_exact=all(t[0] in {e for e, _ in everything} for t in truth)
        if truth and kind != "unknown"
        else None,
        set_size=len({e for e, _ in everything}),
        confident=any(float(f["probability"]) >= CONFIDENT for f in result["findings"]),
        onset_error=_onset(answer.get("onset"), result["findings"], duration_s),
        gain=_gain(result.get("fit", {}), answer.get("oracle_rms")),
        seconds=seconds,
        error=error,
        world=str(answer.get("world", "closed")),
        strays=sum(not any(near(f, t) for t in truth) for f in findings),
        calibration=probabilities,
        parameters=_parameters(truth, answer.get("parameters", []), result["findings"]),
    )


def _matched(findings: Sequence, truth: Sequence, near) -> bool:
    """A one-to-one matching of few findings to few truths exists."""
    if not findings:
        return True
    return any(
        near(findings[0], t) and _matched(findings[1:], [*truth[:i], *truth[i + 1 :]], near)
        for i, t in enumerate(truth)
    )


def _onset(
    true: float | None, findings: Sequence[Mapping[str, Any]], duration_s: float | None
) -> float | None:
    starts = [f["when"][0][0] for f in findings if f.get("when")]
    if true is None or not starts or not duration_s:
        return None
    return min(abs(s - true) for s in starts) / duration_s


def _gain(fit: Mapping[str, Any], oracle: Mapping[str, float] | None) -> float | None:
    """The share of the oracle's held-out gain; None where a refit alone is within 1 % of the oracle."""
    before, after = fit.get("held_out_refit_only") or {}, fit.get("held_out_after") or {}
    outputs = [o for o in (oracle or {}) if before.get(o) is not None and after.get(o) is not None]
    if not outputs or oracle is None:
        return None
    e_before = sum((before[o] / oracle[o]) ** 2 for o in outputs) / len(outputs)
    e_after = sum((after[o] / oracle[o]) ** 2 for o in outputs) / len(outputs)
    return (e_before - e_after) / (e_before - 1) if e_before > 1.02 else None


def _parameters(
    truth: Sequence[tuple[str, str]],
    true: Sequence[Mapping[str, float]],
    findings: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Relative error and 95 % coverage of the parameters of rightly named findings (`A_1` is `A`)."""
    rows = []
    for (effect, _), values in zip(truth, true, strict=False):
        found = next((f for f in findings if f["effect"] == effect), None)
        if found is None:
            continue
        for name, value in values.items():
            estimate = next(
                (p for n, p in found["parameters"].items() if n == name or n.startswith(f"{name}_")), None
            )
            if estimate is not None and value:
                wide = 1.96 * (estimate["sd"] or 0.0)
                rows.append(
                    {
                        "effect": effect,
                        "parameter": name,
                        "error": abs(estimate["value"] / value - 1),
                        "covered": abs(estimate["value"] - value) <= wide,
                    }
                )
    return rows


def reliability(
    pairs: Sequence[tuple[float, bool]], bins: int = 10
) -> tuple[list[dict[str, float]], float | None]:
    """Reliability diagram [{probability, right, n}] over bins of equal width, and the expected calibration error."""
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
    """The calibration error that so few findings would show in the mean if their probabilities were exactly right."""
    rng = random.Random(5)
    errors = [reliability([(p, rng.random() < p) for p, _ in pairs])[1] for _ in range(draws)]
    given = [e for e in errors if e is not None]
    return sum(given) / len(given) if given else None


def found_by_size(sizes: Sequence[float], found: Sequence[bool]) -> dict[str, float] | None:
    """The size found half of the time with its 95 % interval (`low`, `high`), the one found nine times in ten, and the slope;
    None for fewer than ten sizes or where all or none were found."""
    if len(sizes) < 10 or all(found) or not any(found):
        return None
    half, slope = np.geomspace(0.5, 100.0, 400), np.geomspace(0.5, 30.0, 60)
    s, hit = np.log(np.asarray(sizes, float)), np.asarray(found, bool)
    odds = slope[None, :, None] * (s - np.log(half)[:, None, None])
    likely = -np.logaddexp(0.0, np.where(hit, -odds, odds)).sum(axis=2)
    i, j = np.unravel_index(int(np.argmax(likely)), likely.shape)
    inside = half[2 * (likely.max() - likely.max(axis=1)) <= 3.84]
    return {
        "half": float(half[i]),
        "low": float(inside[0]),
        "high": float(inside[-1]),
        "nine_in_ten": float(half[i] * 9 ** (1 / slope[j])),
        "slope": float(slope[j]),
        "n": len(sizes),
    }


def _quantile(values: Iterable[float | None], q: float) -> float | None:
    given = sorted(v for v in values if v is not None)
    if not given:
        return None
    at = q * (len(given) - 1)
    low = int(at)
    return given[low] + (at - low) * (given[min(low + 1, len(given) - 1)] - given[low])


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """All figures of a set, ready for JSON: `figures` (one number each), `shares` (with intervals), tables; those of the
    cases with unnamed misfits apart, under `open_world`."""
    opened = open_world([r for r in rows if r.world == "open"])
    rows = [r for r in rows if r.world != "open"]
    null = [r for r in rows if r.kind == "none"]
    single = [r for r in rows if r.kind == "one"]
    known = [r for r in rows if r.kind not in ("none", "unknown")]
    unknown = [r for r in rows if r.kind == "unknown"]
    two = [r for r in rows if r.kind in ("pair", "cancel")]
    stated = [r for r in rows if r.verdict in ("explained", "partly_explained") and r.findings]
    banded = single if any(r.band for r in single) else known
    bands: dict[str, list[Row]] = {b: [r for r in banded if r.band == b] for b in BANDS}
    shares = {
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
        "onset_within_2_percent": share(r.onset_error <= 0.02 for r in known if r.onset_error is not None),
        "unknown_called_unknown": share(r.verdict == "unexplained" for r in unknown),
        "confidently_misnamed": share(r.verdict in NAMING[:2] and r.confident for r in unknown),
        "pairs_both_right": share(r.alike for r in two),
        "pairs_one_right": share(any(f[0] in {e for e, _ in r.truth} for f in r.findings) for r in two),
        "interval_coverage": share(p["covered"] for r in rows for p in r.parameters),
        "failed": share(r.verdict == "failed" for r in rows),
    }
    sized = [(r.size, r.detected, r.colour) for r in single if r.size]
    by_size = {
        name: found_by_size([z for z, _, _ in group], [d for _, d, _ in group])
        for name, group in (
            ("all", sized),
            ("white", [g for g in sized if g[2] == "white"]),
            ("coloured", [g for g in sized if g[2] not in (None, "white")]),
        )
    }
    given = [x for r in rows for x in r.calibration]
    table, ece = reliability(given)
    gains = [r.gain for r in known if r.detected and r.findings]
    figures = {k: s.value for k, s in shares.items()} | {
        "cases": len(rows),
        "calibration_error": ece,
        "calibration_error_by_chance": by_chance(given),
        **{f"half_found_at_{name}": c["half"] if c else None for name, c in by_size.items()},
        "gain_median": _quantile(gains, 0.5),
        "gain_worst_tenth": _quantile(gains, 0.1),
        "seconds_median": _quantile((r.seconds for r in rows), 0.5),
        "seconds_longest": max((r.seconds for r in rows if r.seconds is not None), default=None),
        "set_size_when_ambiguous": (
            sum(a) / len(a) if (a := [r.set_size for r in rows if r.verdict == "ambiguous"]) else None
        ),
        "parameter_error_median": _quantile((p["error"] for r in rows for p in r.parameters), 0.5),
    }
    confusion: dict[str, Counter[str]] = {}
    for r in rows:
        true = (
            "none"
            if not r.truth
            else "unknown"
            if r.truth[0][0] == "?"
            else r.truth[0][0]
            if len(r.truth) == 1
            else "two"
        )
        confusion.setdefault(true, Counter())[
            ("ambiguous: " if r.verdict == "ambiguous" else "") + r.called
        ] += 1
    return {
        "figures": figures,
        "shares": {k: s.plain() for k, s in shares.items()},
        "goals": {
            k: {"goal": g, "at": side, "is": figures.get(k), "reached": _reached(figures.get(k), g, side)}
            for k, (g, side) in GOALS.items()
        },
        "open_world": opened,
        "reliability": table,
        "found_by_size": by_size,
        "confusion": {t: dict(c) for t, c in sorted(confusion.items())},
        "by_family": {
            f: _brief([r for r in rows if r.family == f]) for f in sorted({r.family for r in rows})
        },
        "by_effect": {
            e: _brief([r for r in single if r.truth[0][0] == e])
            for e in sorted({r.truth[0][0] for r in single})
        },
    }


def open_world(rows: Sequence[Row]) -> dict[str, Any]:
    """Figures of the cases that hold small misfits which nobody will name; empty without any."""
    if not rows:
        return {}
    visible = [r for r in rows if r.kind == "one" and r.band in ("large", "middle")]
    null = [r for r in rows if r.kind == "none"]
    given = [x for r in rows for x in r.calibration]
    shares = {
        "named_and_placed": share(r.alike and bool(r.placed) for r in visible),
        "truth_among_findings": share(bool(r.named and r.inside) for r in visible),
        "without_strays": share(r.strays == 0 for r in rows),
        "nothing_named_where_nothing_is": share(not r.findings for r in null),
        "unknown_not_named": share(not r.named for r in rows if r.kind == "unknown"),
    }
    return {
        "cases": len(rows),
        "shares": {k: s.plain() for k, s in shares.items()},
        "strays_per_diagnosis": sum(r.strays for r in rows) / len(rows),
        "calibration_error": reliability(given)[1],
        "gain_median": _quantile((r.gain for r in visible if r.findings), 0.5),
    }


def _reached(value: float | None, goal: float, side: str) -> bool | None:
    return None if value is None else value >= goal - 1e-12 if side == "least" else value <= goal + 1e-12


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


def plain(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows for JSON."""
    return [asdict(r) for r in rows]
