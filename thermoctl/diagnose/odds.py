"""Prior odds of a hypothesis, from the classes of its effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.diagnose.candidates import Candidate
from thermoctl.diagnose.fit import Placed
from thermoctl.diagnose.limits import Limits

EVENTS = ("onsets", "windows")  # shapes that happen at one moment


def odds(effects: Sequence[Placed], where: Mapping[str, set[str]], limits: Limits) -> float:
    """Return the log prior odds of a hypothesis against no effect.

    The odds are shared equally among the entries, and each entry's among its places."""
    total = 0.0
    for e in effects:
        c = e.candidate
        share = len(where) * len(where.get(c.effect.name, {c.place.where}))
        total += np.log(limits.missing / (1 - limits.missing) / share) + np.log(_class(c, limits))
    return float(total)


def _class(c: Candidate, limits: Limits) -> float:
    """Odds of an entry's class against constant physics."""
    event = any(kind in EVENTS for kind in c.effect.shapes.values()) or any(
        p.per_recording for p in c.effect.parameters
    )
    return (limits.rare if event else 1.0) * (
        limits.rare if c.place.input and c.effect.where != "drive" else 1.0
    )
