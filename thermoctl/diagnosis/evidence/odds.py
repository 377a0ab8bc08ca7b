"""Prior odds of a hypothesis, from the classes of its effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.diagnosis.evidence.fit import Placed
from thermoctl.diagnosis.hypothesis.candidates import Candidate
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.hypothesis.places import FAULTS
from thermoctl.diagnosis.limits import Thresholds


def odds(effects: Sequence[Placed], where: Mapping[str, set[str]], limits: Thresholds) -> float:
    """Return the log prior odds of a hypothesis against no effect.

    The odds are shared equally among the entries, each entry's among its places, and an event's among the
    clocks that it may have (`candidates`). A law states its own."""
    total = sum(e.log_odds or 0.0 for e in effects)
    for e in (e for e in effects if e.log_odds is None):
        c = e.candidate
        share = max(len(where), 1) * len(where.get(c.effect.name, {c.place.where})) * c.clocks
        total += np.log(limits.missing / (1 - limits.missing) / share)
        total += (rare(c.effect, bool(c.place.input)) + _undone(c)) * np.log(limits.rare)
    return float(total)


def rare(effect: Effect, of_input: bool) -> int:
    """Return by how many factors `rare` an effect is less likely than constant physics.

    One if it depends on the time itself, and one more if it is a fault of a recorded input."""
    return effect.timed + (of_input and effect.where in FAULTS)


def _undone(c: Candidate) -> bool:
    """Return whether an effect undoes the lag of an input: a derivative follows almost anything."""
    return any("recorded" in change for change in c.effect.changes[c.variant])
