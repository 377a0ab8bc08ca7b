"""The page of a proof: figures, plots, confusion, results by rig family and effect, each wrong case."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tests.proof.score import Row
from tests.proof.statistics import Share
from tests.proof.summary import BANDS
from tests.proof.tables import lines
from thermoctl.report import page as sheet


def page(content: Mapping[str, Any], rows: Sequence[Row]) -> str:
    """Write one self-contained HTML page of a scored set."""

    def brief(part: str) -> str:
        """Return `content[part]` as an HTML table: a row a group, with the columns of the first group."""
        groups = content[part]
        return sheet.table(
            ["", *next(iter(groups.values()), {})], [[k, *b.values()] for k, b in groups.items()]
        )

    wrong = [
        (
            r.case,
            r.family,
            f"{r.kind} {r.band or ''}",
            _names(r.truth),
            r.verdict,
            _names(r.findings),
            r.error or "",
        )
        for r in rows
        if not _right(r)
    ]
    kinds = ", ".join(f"{n} {k}" for k, n in sorted(Counter(r.kind for r in rows).items()))
    sections = [
        ("Figures", _figures(content)),
        ("Plots", sheet.figure(_plots(content, rows), "Bars are 95 % intervals (Wilson).")),
        ("Called (columns) against true (rows)", _confusion(content["confusion"])),
        ("By rig family", brief("by_family")),
        ("By effect", brief("by_effect")),
        ("Not right", sheet.table(("case", "rig", "kind", "true", "verdict", "found", "error"), wrong)),
    ]
    note = (
        f"{content['figures']['cases']} cases ({kinds}); thermoctl {content['version']} {content['commit'] or ''}. Answers were opened "
        "after the last diagnosis. Red: a goal that is missed."
    )
    return sheet.page("Proof on concealed cases", sections, note)


def _right(r: Row) -> bool:
    if r.kind == "none":
        return not r.detected
    if r.kind == "unknown":
        return r.verdict == "unexplained"
    return r.alike and r.placed is not False


def _figures(content: Mapping[str, Any]) -> str:
    e = html.escape
    body = "".join(
        f"<tr{' class=bad' if reached is False else ''}>"
        + "".join(f"<td>{e(c)}</td>" for c in cells)
        + "</tr>"
        for *cells, reached in lines(content)
    )
    return f"<table><tr><th>figure<th>is<th>95 % interval<th>of<th>goal</tr>{body}</table>"


def _confusion(confusion: Mapping[str, Mapping[str, int]]) -> str:
    e = html.escape
    called = sorted({c for row in confusion.values() for c in row})
    head = "".join(f"<th style='writing-mode:vertical-rl;text-align:left'>{e(c)}</th>" for c in called)
    body = "".join(
        f"<tr><th style='text-align:left'>{e(t)}</th>"
        + "".join(
            f"<td class={'good' if c.removeprefix('ambiguous: ') == t else 'bad'}><b>{row[c]}</b></td>"
            if c in row
            else "<td></td>"
            for c in called
        )
        + "</tr>"
        for t, row in confusion.items()
    )
    return f"<div style='overflow-x:auto'><table><tr><th></th>{head}</tr>{body}</table></div>"


def _names(effects: Sequence[tuple[str, str]]) -> str:
    return ", ".join(f"{a} at {b}" for a, b in effects) or "nothing"


def _plots(content: Mapping[str, Any], rows: Sequence[Row]) -> Figure:
    """Plot detection by size, reliability, held-out gain, parameters, onset and time."""
    figure = Figure(figsize=(12, 6.6), layout="constrained")
    (size, reliable, gain), (wide, onset, clock) = figure.subplots(2, 3)
    _plot_sizes(size, content["shares"])
    _plot_reliability(reliable, content["reliability"])
    gains = [r.gain for r in rows if r.gain is not None and r.detected]
    gain.hist([max(min(g, 1.2), -0.2) for g in gains], bins=28, range=(-0.2, 1.2))
    gain.set(xlabel="share of the oracle's held-out gain", ylabel="cases", title="Held-out gain")
    errors = [p["error"] for r in rows for p in r.parameters]
    wide.hist([min(x, 1.0) for x in errors], bins=20, range=(0, 1))
    wide.set(
        xlabel="relative error (1: that or more)",
        ylabel="parameters",
        title="Effect parameters of right names",
    )
    onset.hist([min(r.onset_error, 0.2) for r in rows if r.onset_error is not None], bins=20, range=(0, 0.2))
    onset.set(xlabel="share of the recording", ylabel="cases", title="Onset error")
    clock.hist([r.seconds for r in rows if r.seconds is not None], bins=30)
    clock.set(xlabel="seconds", ylabel="cases", title="Time per case")
    return figure


def _plot_sizes(axes: Axes, shares: Mapping[str, Any]) -> None:
    for shift, what, label in ((-0.08, "detected", "detected"), (0.08, "exact_name", "exact name")):
        bands = [(k, shares[f"{what}_{b}"]) for k, b in enumerate(reversed(BANDS))]
        bands = [(k, s) for k, s in bands if s["n"]]
        y = [s["share"] for _, s in bands]
        spread = [
            [max(s["share"] - s["low"], 0) for _, s in bands],
            [max(s["high"] - s["share"], 0) for _, s in bands],
        ]
        axes.errorbar([k + shift for k, _ in bands], y, yerr=spread, fmt="o", capsize=3, label=label)
    axes.set(
        xticks=range(3),
        xticklabels=["small\n3–6 σ", "middle\n6–15 σ", "large\n> 15 σ"],
        ylim=(0, 1.05),
        title="By size",
        ylabel="share",
    )
    axes.legend(loc="lower right")


def _plot_reliability(axes: Axes, bins: Sequence[Mapping[str, float]]) -> None:
    axes.plot([0, 1], [0, 1], color="0.8")
    for b in bins:
        low, high = Share(round(b["right"] * b["n"]), int(b["n"])).interval()
        axes.plot([b["probability"]] * 2, [low, high], color="C0", lw=1)
        axes.scatter([b["probability"]], [b["right"]], s=12 + 2 * b["n"], color="C0")
    axes.set(
        xlabel="probability given", ylabel="share right", title="Reliability", xlim=(0, 1.02), ylim=(0, 1.05)
    )
