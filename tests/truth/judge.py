"""What each diagnosis is worth, the figures of a group of cases, and what changed between two runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NotRequired, TypedDict

from tests.proof.score import CONFIDENT, meant, score
from tests.proof.statistics import Share, share
from tests.truth.cases import RIGHT, STRAY, TOLERATED, Case

SURE = 0.99
BANDS = ("large", "middle", "small")
EDGE = 1e-3  # probabilities are taken between this and 1 less this, so that one wrong certainty does not decide the score
Name = tuple[str, str, float, str]  # effect, place, probability, what it is worth


class Row(TypedDict):
    """One judged case, as it is kept. `found`: how many of `wanted` were named with CONFIDENT or more.

    `band`: how large the concealed effect is, where the answer says so.

    `covered`: of the true parameters of right names, how many lie inside their 95 % interval, of how many."""

    group: str
    verdict: str
    wanted: int
    found: int
    names: list[Name]
    covered: tuple[int, int]
    cpu_s: float
    error: str | None
    band: NotRequired[str | None]


def row(case: Case, result: Mapping[str, Any] | None, cpu_s: float, error: str | None) -> Row:
    """Judge one diagnosis; `result` None where it failed with `error`."""
    findings = (result or {}).get("findings", [])
    names: list[Name] = [
        (
            f["effect"],
            f["where"],
            round(float(f["probability"]), 4),
            max(map(case.judge, meant(f)), key=(STRAY, TOLERATED, RIGHT).index),
        )
        for f in findings
    ]
    sure = [n for f in findings if f["probability"] >= CONFIDENT for n in meant(f)]
    scored = score(case.job.name, case.answer, result).parameters if "nearly_the_same" in case.answer else []
    parameters = [p for p in scored if p["named"]]
    return {
        "group": case.group,
        "verdict": (result or {"verdict": "failed"})["verdict"],
        "wanted": len(case.wanted),
        "found": sum(any(is_it(n) for n in sure) for is_it in case.wanted),
        "names": names,
        "covered": (sum(p["covered"] for p in parameters), len(parameters)),
        "cpu_s": cpu_s,
        "error": error,
        "band": case.answer.get("band"),
    }


Figures = dict[str, str]


def figures(rows: Sequence[Row]) -> Figures:
    """Figures of a group as text, each share with its 95 % interval."""
    names = [n for r in rows for n in r["names"]]
    traps = [r for r in rows if not r["wanted"]]
    found, wanted = sum(r["found"] for r in rows), sum(r["wanted"] for r in rows)
    covered = [sum(r["covered"][i] for r in rows) for i in (0, 1)]
    costs = sorted(r["cpu_s"] for r in rows)
    return {
        "cases": str(len(rows)),
        "right names": _text(Share(found, wanted)),
        "large, middle, small": ", ".join(_of_band(rows, band) for band in BANDS),
        "strays at 0.9": str(sum(p >= CONFIDENT and w == STRAY for _, _, p, w in names)),
        "strays": str(sum(w == STRAY for *_, w in names)),
        "traps refused": _text(share(all(p < CONFIDENT for _, _, p, _ in r["names"]) for r in traps)),
        "not wrong at 0.99": _text(share(w != STRAY for _, _, p, w in names if p >= SURE)),
        "not wrong at 0.9": _text(share(w != STRAY for _, _, p, w in names if p >= CONFIDENT)),
        "log score": _mean([_score(p, w) for _, _, p, w in names]),
        "intervals": _text(Share(*covered)),
        "failed": str(sum(r["error"] is not None for r in rows)),
        "CPU s, mean": _mean(costs),
        "median": f"{costs[len(costs) // 2]:.1f}" if costs else "-",
        "longest": f"{costs[-1]:.1f}" if costs else "-",
    }


def _of_band(rows: Sequence[Row], band: str) -> str:
    own = [r for r in rows if r.get("band") == band]
    return f"{sum(r['found'] for r in own)}/{sum(r['wanted'] for r in own)}" if own else "-"


def _score(p: float, worth: str) -> float:
    """Log probability, nats, given to what a name turned out to be."""
    p = min(max(p, EDGE), 1 - EDGE)
    return math.log(1 - p if worth == STRAY else p)


def _mean(x: Sequence[float]) -> str:
    return f"{sum(x) / len(x):.2f}" if x else "-"


def _text(s: Share) -> str:
    if not s.n:
        return "-"
    low, high = s.interval()
    return f"{s.k}/{s.n} ({100 * low:.0f}-{100 * high:.0f} %)"


def changes(old: Mapping[str, Row], new: Mapping[str, Row]) -> Iterator[tuple[str, str, str]]:
    """Yield what changed in each case of both runs: (case, kind, what). Kinds: named, lost, false, cleared, verdict."""
    for case in sorted(set(old) & set(new)):
        before, after = _said(old[case]), _said(new[case])
        came = {k: v for k, v in after.items() if k not in before}
        went = {k: v for k, v in before.items() if k not in after}
        for kind, names, wrong in (
            ("named", came, False),
            ("lost", went, False),
            ("false", came, True),
            ("cleared", went, True),
        ):
            chosen = [
                f"{effect} at {where} ({p:.3f}{', tolerated' if worth == TOLERATED else ''})"
                for (effect, where), (p, worth) in sorted(names.items())
                if (worth == STRAY) == wrong
            ]
            if chosen:
                yield case, kind, ", ".join(chosen)
        was, now = old[case]["verdict"], new[case]["verdict"]
        if was != now:
            yield case, "verdict", f"{was} -> {now}"


def _said(r: Row) -> dict[tuple[str, str], tuple[float, str]]:
    """Names stated with CONFIDENT or more."""
    return {(e, w): (p, worth) for e, w, p, worth in r["names"] if p >= CONFIDENT}
