"""The figures of a proof as lines and as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

from tests.proof.recordings import Entry

Line = tuple[
    str, str, str, str, str, bool | None
]  # figure, value, 95 % interval, of, goal, whether it is reached

_TITLES = {
    "false_alarms": "false alarms on nothing missing",
    "detected_large": "detected, large",
    "detected_middle": "detected, middle",
    "detected_small": "detected, small",
    "exact_name": "exact name",
    "name_or_its_like": "name, or one the data cannot tell from it",
    "right_when_named": "right when it names (or its like)",
    "right_when_named_exactly": "right when it names, exactly",
    "inside_the_set": "truth (or its like) inside the set",
    "inside_the_set_exactly": "truth itself inside the set",
    "place_right": "place right",
    "onset_within_2_percent": "onset within 2 % of the record",
    "unknown_called_unknown": "unknown called unknown",
    "confidently_misnamed": "unknown named with confidence",
    "pairs_both_right": "pairs: both right",
    "pairs_one_right": "pairs: at least one right",
    "interval_coverage": "95 % intervals of names that hold the parameter",
    "interval_coverage_all": "the same, of all right findings",
    "failed": "diagnosis failed",
}
_NUMBERS = {
    "half_found_at_all": "found half of the time, sigmas of an ideal test",
    "half_found_at_white": "the same in white noise",
    "half_found_at_coloured": "the same in coloured noise",
    "half_found_at_learnt": "the same in sigmas of an ideal test that has to learn the noise",
    "calibration_error": "calibration error of the probabilities",
    "calibration_error_by_chance": "the same by chance alone",
    "gain_median": "held-out gain, share of the oracle's, median",
    "gain_worst_tenth": "held-out gain, worst tenth",
    "parameter_error_median": "effect parameter error, median",
    "set_size_when_ambiguous": "names in an ambiguous set",
    "cpu_s_median": "CPU s a case, median",
    "cpu_s_longest": "CPU s a case, longest",
}


def table(content: Mapping[str, Any]) -> Table:
    """Show the figures of a proof."""
    cases = content["figures"]["cases"] + content["open_world"].get("cases", 0)
    t = Table(title=f"{cases} cases, thermoctl {content['version']} ({content['commit']})")
    t.add_column("figure")
    for title in ("is", "95 % interval", "of", "goal"):
        t.add_column(title, justify="right")
    for line in lines(content):
        t.add_row(*line[:5], style="red" if line[5] is False else None)
    return t


def lines(content: Mapping[str, Any]) -> Iterator[Line]:
    """Yield each measured figure with its interval, its number of cases and its goal."""
    yield from _shares(content, _TITLES)
    for key, title in _NUMBERS.items():
        value = content["figures"][key]
        if value is not None:
            curve = content["found_by_size"].get(key.removeprefix("half_found_at_"))
            wide, of = (f"{curve['low']:.1f}–{curve['high']:.1f}", str(curve["n"])) if curve else ("", "")
            yield title, f"{value:.3g}", wide, of, *_goal(content, key, "")
    if opened := content["open_world"]:
        yield from _shares(opened, {k: f"open world: {k.replace('_', ' ')}" for k in opened["shares"]})
        for key, value in opened["figures"].items():
            if value is not None:
                title = f"open world: {key.replace('_', ' ')}"
                yield title, f"{value:.3g}", "", str(opened["cases"]), *_goal(opened, key, "")


def _shares(content: Mapping[str, Any], titles: Mapping[str, str]) -> Iterator[Line]:
    for key, title in titles.items():
        s = content["shares"][key]
        if s["n"]:
            wide = f"{100 * s['low']:.0f}–{100 * s['high']:.0f} %"
            yield title, f"{100 * s['share']:.1f} %", wide, f"{s['k']}/{s['n']}", *_goal(content, key, " %")


def _goal(content: Mapping[str, Any], key: str, unit: str) -> tuple[str, bool | None]:
    """Return the goal as text and whether it is reached; ('', None) where there is none."""
    g = content["goals"].get(key)
    if g is None:
        return "", None
    return f"{'≥' if g['at'] == 'least' else '≤'} {g['goal'] * (100 if unit else 1):g}{unit}", g["reached"]


def real_table(entries: Sequence[Entry]) -> Table:
    """Show the diagnoses of real recordings; an effect that was to be found and was not has probability 0."""
    t = Table(title="Real recordings, each from its naive plant")
    for title in (
        "rig",
        "verdict",
        "found",
        "strays",
        "held-out ratio",
        "closed",
        "CPU s",
        "effect at place",
    ):
        t.add_column(title)
    for x in entries:
        hits = f"{sum(p > 0 for p in x.hits)}/{len(x.hits)}"
        if x.hits:
            hits += " (" + " ".join(f"{p:.2f}" for p in x.hits) + ")"
        found = "\n".join(f"{a} at {b} ({p:.2f})" for a, b, p in x.findings) or (x.error or "")
        closed = "–" if x.share_closed is None else f"{100 * x.share_closed:.0f} %"
        ratio = "–" if x.ratio is None else f"{x.ratio:.2f}"
        t.add_row(x.name, x.verdict, hits, str(len(x.strays)), ratio, closed, f"{x.cpu_s or 0:.0f}", found)
    return t
