"""Why a diagnosis came out as it did, from diagnosis.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SHOWN = 5  # hypotheses


def explain(found: Mapping[str, Any]) -> str:
    """The verdict, the row that fired with its numbers, and the likeliest hypotheses."""
    decision = found["decision"]
    numbers = ", ".join(f"{k} {v:.3g}" for k, v in decision.items() if k != "row" and v is not None)
    lines = [
        f"verdict: {found['verdict']}, because {decision['row']}",
        f"numbers: {numbers}",
        f"{'log evidence':>13}{'prior odds':>12}{'posterior':>11}{'remainder':>11}  hypothesis",
    ]
    for h in found["hypotheses"][:SHOWN]:
        name = " + ".join(h["effects"]) or "no effect"
        lines.append(
            f"{h['log_evidence']:13.1f}{h['log_prior_odds']:12.1f}{h['posterior']:11.3f}{h['remainder']:11.3f}  {name}"
        )
    rest = len(found["hypotheses"]) - SHOWN
    if rest > 0:
        lines.append(
            f"and {rest} more in diagnosis.json"
            + ("; the budget of refits ended the search" if found["truncated"] else "")
        )
    return "\n".join(lines)
