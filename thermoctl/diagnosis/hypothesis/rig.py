"""Kinds of signals, moving inputs and ambient of a plant and its recordings, for placing effects."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.plant import expression as ex
from thermoctl.plant.language import Flow, Input, Node, Output, Parameter, Plant
from thermoctl.units import dimension

if TYPE_CHECKING:
    from thermoctl.plant.simulation.simulate import Excitation

SEEN, CORRECT = "seen_", "correct_"  # an observer's inputs and flows (observer.py): no physics
STRAIGHT = "_straight"  # suffix of the linearly interpolated copy of a held input
KELVIN = {"K", "kelvin"}
ZERO_DEGC = 273.15  # K
TEMPERATURE = {"degC", "celsius", "degree_Celsius", "delta_degC", "°C", *KELVIN}


_KINDS = {
    "temperature": "K",
    "length": "m",
    "velocity": "m/s",
    "current": "A",
    "time": "s",
    "rotation": "1/s",
    "voltage": "V",
    "power": "W",
    "volume": "m^3",
}


@cache
def kind_of(unit: str | None) -> str:
    """Return the kind of quantity that a unit measures, a key of _KINDS; "" for any other."""
    if unit is None:
        return ""
    if unit in TEMPERATURE:
        return "temperature"
    try:
        wanted = dimension(unit)
    except ValueError:
        return ""
    return next((kind for kind, like in _KINDS.items() if dimension(like) == wanted), "")


def zero_of(unit: str | None) -> float:
    """Return the value of 0 degC in a unit of temperature."""
    return ZERO_DEGC if unit in KELVIN else 0.0


_ROLE_KINDS = {"ambient": "temperature", "position": "length"}  # every other role is also the name of a kind


# Nodes that an effect added to model a reading (lag, memory of the initial state) are no places.
_READINGS = re.compile(
    r"(lagged|memory|grown)_(sensor_lag|cold_junction_drift|missing_member|expansion_lag)_"
)


# Patterns by which the name of a column that the plant does not read is taken for v, x, i or T. The result
# has a note about each guess.
SOUNDS = {"v": r"veloc|speed|^v$", "x": r"posit|stroke|travel|^x$", "i": r"current|^i$", "T": r"temp|_c$|^t_"}
MEANINGS = {"v": "velocity", "x": "position", "i": "current", "T": "temperature"}


JUMP = 3  # longest duration of a sudden change, in samples: a filter before the recording may spread it


class Rig:
    """A plant and its recordings: kinds of nodes, moving inputs, ambient, by roles and units."""

    def __init__(
        self, plant: Plant, drives: Sequence[Excitation], columns: Sequence[Mapping[str, np.ndarray]]
    ):
        self.plant, self.drives, self.columns = plant, list(drives), list(columns)
        self._jumps: dict[str, float] = {}  # by column
        p = dataclasses.replace(
            plant,
            inputs={
                k: v for k, v in plant.inputs.items() if not k.endswith(STRAIGHT) and not k.startswith(SEEN)
            },
            flows={k: v for k, v in plant.flows.items() if not k.startswith(CORRECT)},
        )
        self.physics = p
        self.temperatures = [
            n.name for n in p.nodes.values() if self.kind(n) == "temperature" and not _READINGS.match(n.name)
        ]
        self.velocities = [
            n.name
            for n in p.nodes.values()
            if self.kind(n) in ("velocity", "rotation")
            and any(f.target == n.name or f.source == n.name for f in p.flows.values())
        ]
        self.position_of: dict[str, str] = {}
        for f in p.flows.values():
            for v in self.velocities:
                if f.target and f.target != v and ex.names(f.rate) == {v}:
                    self.position_of.setdefault(v, f.target)
        long = [d.t for d in drives if len(d.t) > 1]
        self.duration = max((float(d.t[-1]) for d in drives), default=1.0)  # s, of the longest recording
        self.sample = min(
            (float(np.median(np.diff(t))) for t in long), default=1.0
        )  # s, the shortest interval
        common = set.intersection(*(set(c) for c in columns)) if columns else set()
        taken = {i.column for i in p.inputs.values()} | {o.column for o in p.outputs.values()}
        self.spare = sorted(
            c
            for c in common - taken
            if re.fullmatch(r"[A-Za-z_]\w*", c)
            and c not in p.nodes
            and c not in p.parameters
            and c not in p.outputs
            and c not in p.inputs
            and c not in p.flows
            and all(np.ptp(t[c][np.isfinite(t[c])]) > 0 for t in columns if np.isfinite(t[c]).any())
            and all(np.isfinite(t[c]).any() for t in columns)
        )
        moving = {
            i
            for j, i in enumerate(plant.inputs)
            if i in p.inputs and any(np.ptp(d.u[:, j]) > 0 for d in drives)
        }
        self.moving_inputs = moving
        self.heat_inputs = [i for i in p.inputs if self.kind(p.inputs[i]) == "temperature"]
        named = [
            i
            for i in self.heat_inputs
            if re.search(r"air|amb|room|outdoor|chamber|base|environment", i, re.I)
            and not re.search(r"start|initial", i, re.I)
        ]
        self.air = next(iter(named), None) or self._coolest()

    def largest_jump(self, reading: Input | Output) -> float:
        """Return the largest change of a reading within JUMP samples, over all recordings."""
        if reading.column not in self._jumps:
            columns = [c[reading.column] for c in self.columns if reading.column in c]
            readings = [v[np.isfinite(v)] for v in columns]
            changes = [np.abs(v[k:] - v[:-k]) for v in readings for k in range(1, JUMP + 1)]
            self._jumps[reading.column] = max((float(d.max(initial=0.0)) for d in changes), default=np.inf)
        return self._jumps[reading.column]

    def kind(self, q: Input | Node | Output) -> str:
        """Return the kind of a quantity, from its role or else its unit; "" where neither states it."""
        return _ROLE_KINDS.get(q.role, q.role) if q.role else kind_of(q.unit)

    def _coolest(self) -> str | None:
        """Return the temperature input that is the reference of heat losses."""
        for f in self.physics.flows.values():
            if f.target is None or f.source is None:
                for i in self.heat_inputs:
                    if i in ex.names(f.rate):
                        return i
        return self.heat_inputs[0] if self.heat_inputs else None

    def first_air(self, d: Excitation) -> float:
        """Return the ambient temperature at a recording's start, degC; 0 if there is none."""
        air = self.air or ""
        source = self.plant.parameters.get(air) or self.plant.inputs.get(air)
        start = d.first.get(air, source.value if isinstance(source, Parameter) else 0.0)
        return float(start - zero_of(source.unit) if source else start)

    def signals(self, kind: str, near: str | None = None) -> list[str]:
        """Return names that can stand for v, x, i or T: nodes, inputs and unread columns."""
        p = self.physics
        if kind == "v":
            if near in self.velocities:
                return [near]
            names = [
                *self.velocities,
                *(i for i in p.inputs if self.kind(p.inputs[i]) in ("velocity", "rotation")),
            ]
            return (names or self.guessed("v"))[:3]
        if kind == "x":
            if near in self.position_of:
                return [self.position_of[near]]
            if self.position_of:
                return list(self.position_of.values())
            names = [i for i in p.inputs if self.kind(p.inputs[i]) == "length" and i in self.moving_inputs]
            names += [n.name for n in p.nodes.values() if self.kind(n) == "length"]
            return (names or self.guessed("x"))[:3]
        if kind == "i":
            names = [n.name for n in p.nodes.values() if self.kind(n) == "current"]
            names += [i for i in p.inputs if self.kind(p.inputs[i]) == "current"]
            return (names or self.guessed("i"))[:2]
        names = [*self.temperatures, *(i for i in self.heat_inputs if i in self.moving_inputs)]
        return names + self.guessed("T")

    def guessed(self, kind: str) -> list[str]:
        """Return the columns that the plant does not read and whose name suggests v, x, i or T."""
        return [c for c in self.spare if re.search(SOUNDS[kind], c, re.I)]

    def is_motor(self, f: Flow) -> bool:
        """Return whether a flow is a force or a torque that an input drives."""
        return bool(
            (f.target in self.velocities or f.source in self.velocities)
            and ex.names(f.rate) & self.moving_inputs
        )

    def is_pump(self, f: Flow) -> bool:
        """Return whether a flow enters from outside and is neither heat nor a force."""
        return f.source is None and f.target not in (None, *self.temperatures, *self.velocities)

    def drives_of(self, f: Flow) -> list[str]:
        """Return the moving inputs that drive a flow, except temperatures, lengths and velocities."""
        return [
            i
            for i in self.physics.inputs
            if i in ex.names(f.rate)
            and i in self.moving_inputs
            and self.kind(self.physics.inputs[i]) not in ("temperature", "length", "velocity", "rotation")
        ]
