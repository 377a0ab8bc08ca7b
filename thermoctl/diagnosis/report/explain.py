"""The reasons of a diagnosis in a screen of lines, from diagnosis.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thermoctl.diagnosis.report import figures
from thermoctl.diagnosis.report.words import what_next

NOTHING = ": it promised nothing in any screening, or has not this place (`thermoctl effects` lists names)"
SHOWN, LOST = 4, 3  # largest number of hypotheses; largest number of effects that were tried and lost


def explain(result: Mapping[str, Any]) -> str:
    """Return the verdict, its row and numbers, the likeliest hypotheses, the lost effects, the next step."""
    lines = [f"verdict: {result['verdict']}, because {result['decision']['row']}"]
    lines += [f"    {value:>10}  {meaning}" for meaning, value in figures.decision_rows(result)[1]]
    heads, rows = figures.hypothesis_rows(result)
    table = (heads, *rows[:SHOWN])
    widths = [max(16, 2 + max(map(len, column))) for column in zip(*table, strict=True)][1:]
    lines += ["".join(map(str.rjust, row[1:], widths)) + f"  {row[0]}" for row in table]
    lost = "; ".join(
        f"{row[0]} ({row[1]})" for row in figures.lost_rows(result)[1][: min(LOST, len(result["lost"]))]
    )
    lines.append(f"tried and lost: {lost or 'nothing'}")
    budget = "; the budget of refits ended the search" if result["truncated"] else ""
    lines.append(f"hypotheses not shown: {max(len(rows) - SHOWN, 0)} (in diagnosis.json){budget}")
    lines.append(f"what next: {what_next(result)}")
    return "\n".join(lines)


def why(result: Mapping[str, Any], asked: str) -> str:
    """Return in one line why an effect, `NAME` or `NAME at PLACE`, is or is not a finding.

    A name may be written as the reports print it, with blanks."""
    spoken = asked.replace("_", " ")

    def is_asked(entry: str) -> bool:
        """Return whether an `effect at place` is the one that was asked for."""
        plain = entry.replace("_", " ")
        return spoken in (plain, plain.partition(" at ")[0])

    laws = figures.every_law(result)
    for f in (*result["findings"], *({"effect": "law", **law} for law in laws)):
        if is_asked(name := f"{f['effect']} at {f['where']}"):
            sure, confirmed = (figures.chance(f[k]) for k in ("probability", "confirmed"))
            return f"{name}: a finding, probability {sure}; that other data confirm it {confirmed}"
    for e in result["lost"]:
        if is_asked(name := f"{e['effect']} at {e['where']}"):
            beside = f" beside {' and '.join(e['beside'])}" if e["beside"] else ""
            return (
                f"{name}: refitted{beside}; {e['reason']} (probability {figures.chance(e['probability'])}, "
                f"log odds {figures.below(e['below_best'])})"
            )
    for r in result["refused"]:
        for name in filter(is_asked, r["effects"]):
            beside = " and ".join(e for e in r["effects"] if e != name)
            return f"{name}: {r['reason']}{f', beside {beside}' if beside else ''}"
    promised = {name: gain for name, gain in result["promised"].items() if is_asked(name)}
    if promised:
        name = max(promised, key=lambda n: promised[n])
        return f"{name}: not refitted; to first order it gains at most {promised[name]:.1f} nats, others promised more"
    name = asked.partition(" at ")[0].replace(" ", "_")
    if name in result.get("placeless", ()):
        return f"{asked}: it has no place in this plant; `thermoctl effects show {name}` says where it acts"
    return f"{asked}{NOTHING}"
