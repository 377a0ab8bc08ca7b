"""Why a diagnosis came out as it did, in ten lines, from diagnosis.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thermoctl.diagnosis.report.words import what_next

SHOWN, LOST = 4, 3  # hypotheses; effects that were tried and lost


def explain(found: Mapping[str, Any]) -> str:
    """Return the verdict, its row and numbers, the likeliest hypotheses, the lost effects, the next step."""
    decision = found["decision"]
    numbers = ", ".join(f"{k} {v:.3g}" for k, v in decision.items() if k != "row" and v is not None)
    lines = [
        f"verdict: {found['verdict']}, because {decision['row']}",
        f"numbers: {numbers}",
        f"{'log evidence':>13}{'prior odds':>12}{'posterior':>11}{'stands out':>11}{'remainder':>11}  hypothesis",
    ]
    for h in found["hypotheses"][:SHOWN]:
        name = " + ".join(h["effects"]) or "no effect"
        stands = "-" if not h["effects"] else "no" if h["physics"] is None else f"{min(h['physics']):.3f}"
        lines.append(
            f"{h['log_evidence']:13.1f}{h['log_prior_odds']:12.1f}{h['posterior']:11.3f}{stands:>11}"
            f"{h['remainder']:11.3f}  {name}"
        )
    lost = "; ".join(f"{e['effect']} at {e['where']} ({e['reason']})" for e in found["lost"][:LOST])
    lines.append(f"tried and lost: {lost or 'nothing'}")
    rest = len(found["hypotheses"]) - SHOWN
    budget = "; the budget of refits ended the search" if found["truncated"] else ""
    lines.append(f"hypotheses not shown: {max(rest, 0)} (in diagnosis.json){budget}")
    lines.append(f"what next: {what_next(found)}")
    return "\n".join(lines)


def why(found: Mapping[str, Any], asked: str) -> str:
    """Return in one line why an effect, `NAME` or `NAME at PLACE`, is a finding or none."""

    def is_asked(entry: str) -> bool:
        """Return whether an `effect at place` is the one that was asked for."""
        return asked in (entry, entry.partition(" at ")[0])

    for f in found["findings"]:
        if is_asked(name := f"{f['effect']} at {f['where']}"):
            return (
                f"{name}: a finding, probability {f['probability']:.3f}, confirmed with {f['confirmed']:.3f}"
            )
    for e in found["lost"]:
        if is_asked(name := f"{e['effect']} at {e['where']}"):
            beside = f" beside {' and '.join(e['beside'])}" if e["beside"] else ""
            return (
                f"{name}: refitted{beside}; {e['reason']} (probability {e['probability']:.3f}, "
                f"{e['below_best']:.1f} nats below the result)"
            )
    for r in found["refused"]:
        for name in filter(is_asked, r["effects"]):
            beside = " and ".join(e for e in r["effects"] if e != name)
            return f"{name}: {r['reason']}{f', beside {beside}' if beside else ''}"
    promised = {name: gain for name, gain in found["promised"].items() if is_asked(name)}
    if promised:
        name = max(promised, key=lambda n: promised[n])
        return f"{name}: not refitted; to first order it gains at most {promised[name]:.1f} nats, others promised more"
    return f"{asked}: it promised nothing in any screening, or has no place in this plant (`thermoctl effects` lists names)"
