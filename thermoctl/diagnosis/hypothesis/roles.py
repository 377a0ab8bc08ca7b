"""Kinds of quantities from `role`, units and structure of the plant, never from its names.

Only a column that the plant does not read has none of these: then its name gives a guess.
If one node is the rate of another, the two are a velocity and its position, in any unit. The ambient is the
reference temperature of heat losses. Each assumption is a note in the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.diagnosis.hypothesis.rig import MEANINGS, SOUNDS, TEMPERATURE, Rig
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Input, Node, Output, Plant

if TYPE_CHECKING:
    from thermoctl.plant.simulation.simulate import Excitation

RATES = ("", "velocity", "rotation", "voltage")  # kinds by unit of a node that structure makes a velocity
PLACES = ("", "length", "voltage")  # kinds by unit of its position


def motions(plant: Plant) -> dict[str, str]:
    """Return velocity nodes and their position nodes: the integral of a multiple of the velocity."""
    values = {p.name: p.value for p in plant.parameters.values()}
    positions = {}
    for x in plant.nodes.values():
        flows = [f for f in plant.flows.values() if x.name in (f.source, f.target)]
        if len(flows) != 1 or flows[0].target != x.name or flows[0].source is not None:
            continue
        rate, read = flows[0].rate, ex.names(flows[0].rate) - values.keys()
        if any(e.op == "delay" for e in ex.walk(rate)):
            continue  # not the present velocity
        for v in plant.nodes.keys() & read - {x.name}:
            driven = any(v in (f.source, f.target) for f in plant.flows.values())
            constant = ex.names(x.storage) | ex.names(ex.derivative(rate, v)) <= values.keys()
            if read == {v} and driven and constant and ex.evaluate(rate, {**values, v: 0.0}) == 0:
                positions[v] = x.name
    return positions


class Structure(Rig):
    """A plant and its recordings: kinds of nodes, moving inputs, ambient, by roles, units and structure."""

    def __init__(
        self, plant: Plant, drives: Sequence[Excitation], columns: Sequence[Mapping[str, np.ndarray]]
    ):
        pairs = motions(plant)
        self.pairs: dict[str, str] = {}
        kinds = {n.name: self.kind(n) for n in plant.nodes.values()}
        self.pairs = {v: x for v, x in pairs.items() if kinds[v] in RATES and kinds[x] in PLACES}
        super().__init__(plant, drives, columns)
        self.velocities = [*self.velocities, *(v for v in self.pairs if v not in self.velocities)]
        self.position_of = {**self.position_of, **self.pairs}
        self.air = self._coolest()

    def kind(self, q: Input | Node | Output) -> str:
        """Return the kind of a quantity: from its role, its motion, the node that it reads, or its unit."""
        read = str(q.value.value) if isinstance(q, Output) and q.value.op == "name" else q.name
        if q.role is None and not isinstance(q, Input):
            if read in self.pairs.values():
                return "length"
            if read in self.pairs:
                return "velocity"
        return super().kind(q)

    def _ambients(self) -> dict[str, int]:
        """Return the reference temperatures of heat losses: name -> number of losses."""
        stated = [i.name for i in self.physics.inputs.values() if i.role == "ambient"]
        sources = (
            stated or self.heat_inputs,
            [p.name for p in self.physics.parameters.values() if p.unit in TEMPERATURE],
        )
        for names in sources:
            count = dict.fromkeys(names, 0)
            for f in self.physics.flows.values():
                ends = {e for e in (f.source, f.target) if e in self.temperatures}
                if len(ends) == 1 and ends <= ex.names(f.rate):
                    for i in ex.names(f.rate) & count.keys():
                        count[i] += 1
            count = {i: n for i, n in count.items() if n or i in stated}
            if count:
                return count
        return {}

    def _coolest(self) -> str | None:
        """Return the ambient: the reference temperature of most heat losses; among equals the coolest."""
        count = self._ambients()
        return min(count, key=lambda i: (-count[i], self._mean(i)), default=None)

    def _mean(self, signal: str) -> float:
        if signal in self.plant.parameters:
            return self.plant.parameters[signal].value
        j = list(self.plant.inputs).index(signal)
        return float(np.mean([d.u[:, j].mean() for d in self.drives])) if self.drives else 0.0

    def guesses(self) -> list[str]:
        """Return the assumptions about quantities that the plant file does not state."""
        out = []
        count = self._ambients()
        if self.air and len(count) > 1:
            out.append(
                f"'{self.air}' is taken as the ambient, since most losses of heat are counted from it "
                f"(also possible: {', '.join(sorted(count.keys() - {self.air}))}); `role: ambient` states it"
            )
        for v, x in self.pairs.items():
            if super().kind(self.physics.nodes[v]) not in ("velocity", "rotation"):
                out.append(f"'{x}' is taken as a position and '{v}' as its velocity, since '{v}' is its rate")
        for c in self.spare:
            kinds = [MEANINGS[kind] for kind in SOUNDS if c in self.guessed(kind)]
            out.append(
                f"the plant does not read the column '{c}': it may be a {' or a '.join(kinds or ['temperature'])}; "
                "an input with a `role` states what it is"
            )
        return out

    def signals(self, kind: str, near: str | None = None) -> list[str]:
        """Return names that can stand for v, x, i or T; for T also unread columns without a guess."""
        names = super().signals(kind, near)
        if kind == "T":
            names += [c for c in self.spare if not any(c in self.guessed(k) for k in SOUNDS)]
        return names
