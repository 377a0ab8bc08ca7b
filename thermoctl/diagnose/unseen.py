"""Detection limits: the smallest size of each effect that the recordings would have shown."""

from __future__ import annotations

from typing import Any

import numpy as np

from thermoctl.diagnose.candidates import candidates
from thermoctl.diagnose.result import Diagnosis
from thermoctl.diagnose.roles import Structure
from thermoctl.diagnose.screen import screen
from thermoctl.diagnose.screening import ROWS, Plain, Rows

SEEN = 5.0  # standard errors of an effect's size, from which it would have been seen


def not_seen(found: Diagnosis) -> list[dict[str, Any]]:
    """Return by effect and place the smallest size that would have been seen, in the parameter's unit.

    It holds beside a refit of the plant's own parameters. Effects without a size (lags, delays) are left out."""
    null = next(w.fitted for w in found.searched.tried if not w.fitted.hypothesis.effects)
    metric = Rows(Plain(found.case, null, ROWS), found.null.average, True)
    rig = Structure(null.rough_plant, metric.drives, [t.columns for t in found.case.tables])
    out = []
    (directions,) = screen([metric], rig, candidates(rig, found.case.catalogue))
    for d in directions:
        size = next((p for p in d.candidate.effect.parameters if p.amplitude), None)
        if size is None or d.gain <= 0:
            continue
        effect, where = d.candidate.key
        smallest = abs(d.start[size.name] - size.null) / np.sqrt(d.gain) * SEEN
        out.append(
            {
                "effect": effect,
                "where": where,
                "parameter": size.name,
                "smallest": float(f"{smallest:.4g}"),
                "unit": size.unit,
            }
        )
    return sorted(out, key=lambda e: (str(e["effect"]), str(e["where"])))
