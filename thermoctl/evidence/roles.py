"""What a quantity is, from the plant's structure and units, never from its name.

A pair of nodes of which one is the rate of the other is a velocity and its position, in any unit. The ambient is the temperature
that losses of heat are counted from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.diagnose.effects import TEMPERATURE, Rig
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.plant.simulate import Excitation


def motions(plant: Plant) -> dict[str, str]:
    """Velocity node: its position node."""
    found = {}
    for f in plant.flows.values():
        if f.rate.op != "name" or f.target is None or f.source is not None or f.rate.value == f.target:
            continue
        v = str(f.rate.value)
        storage = plant.nodes[f.target].storage
        flows = [g for g in plant.flows.values() if f.target in (g.source, g.target)]
        driven = any(v in (g.source, g.target) for g in plant.flows.values())
        if v in plant.nodes and driven and len(flows) == 1 and storage.op == "num" and storage.value == 1:
            found[v] = f.target
    return found


class Structure(Rig):
    """A plant and its recordings as the catalogue sees them, by structure and units."""

    def __init__(
        self, plant: Plant, drives: Sequence[Excitation], columns: Sequence[Mapping[str, np.ndarray]]
    ):
        super().__init__(plant, drives, columns)
        pairs = motions(self.physics)
        self.velocities = [*self.velocities, *(v for v in pairs if v not in self.velocities)]
        self.position_of = {**self.position_of, **pairs}
        self.air = self._coolest()
        for d in self.drives:
            if self.air in plant.parameters:
                d.first.setdefault(str(self.air), plant.parameters[str(self.air)].value)

    def _coolest(self) -> str | None:
        """The temperature that a loss of heat is counted from: an input, or else a parameter."""
        kinds = (
            self.heat_inputs,
            [p.name for p in self.physics.parameters.values() if p.unit in TEMPERATURE],
        )
        for known in kinds:
            for f in self.physics.flows.values():
                ends = {e for e in (f.source, f.target) if e in self.temperatures}
                if len(ends) == 1 and ends <= ex.names(f.rate):
                    for i in known:
                        if i in ex.names(f.rate):
                            return i
        return None

    def signals(self, kind: str, near: str | None = None) -> list[str]:
        """Names that can stand for v, x, i or T: nodes and inputs; for T also any recorded column that the plant does not read."""
        spare, self.spare = self.spare, []
        try:
            found = super().signals(kind, near)
        finally:
            self.spare = spare
        return found + (spare if kind == "T" else [])
