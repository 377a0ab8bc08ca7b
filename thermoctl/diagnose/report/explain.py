"""Why a diagnosis came out as it did, in ten lines, from diagnosis.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thermoctl.diagnose.report.words import what_next

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
