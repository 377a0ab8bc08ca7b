"""Laws of different rigs side by side: an exponent that repeats is physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table
from scipy.special import chdtrc

WIDE = 1.96  # standard deviations to either side of a 95 % interval
CHANCE = 0.05  # values differ if the probability of differences as large by chance is below this

Term = tuple[str, str, tuple[str, ...], str]  # place, form, signals, name of a shape


@dataclass(frozen=True)
class Shared:
    """An exponent, threshold or length that terms of one form over the same signals have in several rigs.

    - `values`: value and standard deviation by rig
    - `mean`, `sd`: of all rigs, weighted; `same`: whether the values differ by chance only"""

    term: Term
    values: Mapping[str, tuple[float, float]]
    mean: float
    sd: float
    same: bool

    @property
    def text(self) -> str:
        """Return the comparison in a sentence."""
        place, form, signals, shape = self.term
        what = f"{shape} of the {form.replace('_', ' ')} in {', '.join(signals)} at {place}"
        each = ", ".join(f"{rig} {v:.3g} ± {WIDE * sd:.2g}" for rig, (v, sd) in self.values.items())
        if self.same:
            return f"{what}: {self.mean:.3g} ± {WIDE * self.sd:.2g} in {len(self.values)} rigs ({each})"
        return f"{what}: not the same in {len(self.values)} rigs ({each})"


def shared(laws: Mapping[str, Mapping[str, Any]]) -> list[Shared]:
    """Return the shapes of terms that two or more rigs have. `laws`: `remainder.law` of each rig's result."""
    by_term: dict[Term, dict[str, tuple[float, float]]] = {}
    for rig, law in laws.items():
        for t in law.get("forms", ()):
            for shape, name in t["shapes"].items():
                p = law["parameters"][name]
                if p["sd"]:
                    key = (law["where"], t["form"], tuple(t["variables"]), shape)
                    by_term.setdefault(key, {})[rig] = (p["value"], p["sd"])
    return [_shared(term, values) for term, values in by_term.items() if len(values) > 1]


def _shared(term: Term, values: Mapping[str, tuple[float, float]]) -> Shared:
    v, sd = np.array(list(values.values())).T
    weight = 1 / sd**2
    mean = float(weight @ v / weight.sum())
    spread = float(weight @ (v - mean) ** 2)
    return Shared(
        term, values, mean, float(weight.sum() ** -0.5), float(chdtrc(len(v) - 1, spread)) >= CHANCE
    )


def side_by_side(laws: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table of laws, one row for each rig."""
    table = Table("rig", "law", "where", "95 %", "closes", box=None, header_style="bold")
    for rig, law in laws.items():
        intervals = [
            f"{name} {p['value']:.3g} ± {WIDE * p['sd']:.2g}"
            for t in law.get("forms", ())
            for name in t["shapes"].values()
            if (p := law["parameters"][name])["sd"]
        ]
        closed = f"{100 * law['share_closed']:.0f} %"
        table.add_row(rig, law["expression"], law["where"], "\n".join(intervals), closed)
    return table


def comparisons(laws: Mapping[str, Mapping[str, Any]]) -> Sequence[str]:
    """Return a sentence for each parameter that laws of several rigs share: do its values agree?"""
    return [s.text for s in shared(laws)]
