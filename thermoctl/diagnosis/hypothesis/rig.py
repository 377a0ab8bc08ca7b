"""A plant and its recordings: kinds of quantities, moving inputs and ambient, for placing effects.

Kinds follow from `role`, units and structure of the plant, never from its names. Only a column that the plant
does not read has none of these: then its name gives a guess. If one node is the rate of another, the two are
a velocity and its position, in any unit. The ambient is the reference temperature of heat losses. Each
assumption is a note in the result."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from thermoctl.diagnosis.data.rows import OUTLIER
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Flow, Input, Node, Output, Parameter, Plant
from thermoctl.units import dimension

if TYPE_CHECKING:
    from thermoctl.plant.simulation.simulate import Excitation

SEEN, CORRECT = "seen_", "correct_"  # an observer's inputs and flows (observer.py): no physics
STRAIGHT = "_straight"  # suffix of the linearly interpolated copy of a held input
KELVIN = {"K", "kelvin", "kelvins"}
ZERO_DEGC = 273.15  # K
TEMPERATURE = {"degC", "celsius", "degree_Celsius", "delta_degC", "°C", *KELVIN}
MOVING = ("velocity", "rotation")
FLOWING = ("volume flow", "mass flow")
# Kinds by unit of a node that structure makes a velocity, and of its position.
RATES, PLACES = ("", *MOVING, *FLOWING, "voltage"), ("", "length", "voltage")
JUMP = 3  # longest duration of a sudden change, in samples: a filter before the recording may spread it
# Patterns by which the name of a column that the plant does not read is taken for v, x, i or T. The result
# has a note about each guess.
SOUNDS = {
    "v": r"veloc|speed|rpm|^v$|^vel(_|$)|_vel(_|$)",
    "x": r"posit|stroke|travel|^x$|^pos(_|$)|_pos(_|$)|_[mu]m$",
    "i": r"current|^i(_|$)",
    "T": r"temp|_c$|^t_",
}
MEANINGS = {"v": "velocity", "x": "position", "i": "current", "T": "temperature"}

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
    "volume flow": "m^3/s",
    "mass flow": "kg/s",
}
_ROLE_KINDS = {"ambient": "temperature", "position": "length"}  # every other role is also the name of a kind
# Nodes that an effect added to model a reading (lag, memory of the initial state) are no places.
_READINGS = re.compile(
    r"(lagged|memory|grown)_(sensor_lag|cold_junction_drift|missing_member|expansion_lag)_"
)


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


def _stated(q: Input | Node | Output) -> str:
    """Return the kind of a quantity by its role, or else by its unit; "" where neither states it."""
    return _ROLE_KINDS.get(q.role, q.role) if q.role else kind_of(q.unit)


def _motions(plant: Plant) -> dict[str, str]:
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
    return {
        v: x
        for v, x in positions.items()
        if _stated(plant.nodes[v]) in RATES and _stated(plant.nodes[x]) in PLACES
    }


def _is_clock(d: Excitation, column: np.ndarray) -> bool:
    """Return whether a column is the recording's time, from any zero and in any unit."""
    if len(column) != len(d.t) or len(d.t) < 3 or not np.isfinite(column).all():
        return False
    passed = (column - column[0]) * (d.t[-1] - d.t[0])
    return bool(np.allclose(passed, (d.t - d.t[0]) * (column[-1] - column[0]), 1e-6, 1e-6 * abs(passed[-1])))


class Rig:
    """A plant and its recordings, with the kinds of its quantities.

    - `physics`: the plant without the parts that an observer and effects of readings added
    - `pairs`: by velocity, its position, where the structure of the plant shows it; `position_of`: these, and
      the pairs that units show
    - `temperatures`, `velocities`, `currents`: nodes; `heat_inputs`: inputs that are temperatures
    - `moving_inputs`: those that change; `spare`: recorded columns that the plant does not read
    - `earlier`: do earlier recordings tell what is the same in these?
    - `air`: the ambient; `duration`, `sample`: of the longest recording, and its shortest interval, s"""

    def __init__(
        self,
        plant: Plant,
        drives: Sequence[Excitation],
        columns: Sequence[Mapping[str, np.ndarray]],
        earlier: bool = False,
    ):
        self.plant, self.drives, self.columns = plant, list(drives), list(columns)
        self.earlier = earlier
        self._jumps: dict[str, float] = {}  # by column
        self.physics = p = dataclasses.replace(
            plant,
            inputs={
                k: v for k, v in plant.inputs.items() if not k.endswith(STRAIGHT) and not k.startswith(SEEN)
            },
            flows={k: v for k, v in plant.flows.items() if not k.startswith(CORRECT)},
        )
        self.pairs = _motions(plant)
        self.temperatures = [
            n.name for n in p.nodes.values() if self.kind(n) == "temperature" and not _READINGS.match(n.name)
        ]
        self.currents = [n.name for n in p.nodes.values() if self.kind(n) == "current"]
        driven = {end for f in p.flows.values() for end in (f.source, f.target)}
        moving = [n.name for n in p.nodes.values() if self.kind(n) in MOVING and n.name in driven]
        self.position_of: dict[str, str] = {}
        for f in p.flows.values():
            for v in moving:
                if f.target and f.target != v and ex.names(f.rate) == {v}:
                    self.position_of.setdefault(v, f.target)
        self.position_of |= self.pairs
        self.velocities = list(dict.fromkeys([*moving, *self.pairs]))
        intervals = [float(np.median(np.diff(d.t))) for d in drives if len(d.t) > 1]
        self.duration = max((float(d.t[-1]) for d in drives), default=1.0)
        self.sample = min(intervals, default=1.0)
        self.spare = sorted(c for c in self._unread() if re.fullmatch(r"[A-Za-z_]\w*", c))
        self.moving_inputs = {
            i
            for j, i in enumerate(plant.inputs)
            if i in p.inputs and any(np.ptp(d.u[:, j]) > 0 for d in drives)
        }
        self.heat_inputs = [i for i in p.inputs if self.kind(p.inputs[i]) == "temperature"]
        count = self._ambients()
        # the reference of most losses of heat; among equals the coolest
        self.air = min(count, key=lambda i: (-count[i], self._mean(i)), default=None)

    def _unread(self) -> list[str]:
        """Return the columns that move in every recording and are no part of the plant."""
        p = self.physics
        common = set.intersection(*(set(c) for c in self.columns)) if self.columns else set()
        read = {i.column for i in p.inputs.values()} | {o.column for o in p.outputs.values()}
        known = {*p.nodes, *p.parameters, *p.outputs, *p.inputs, *p.flows}
        moving = [
            c
            for c in common - read - known
            if all(np.isfinite(t[c]).any() and np.ptp(t[c][np.isfinite(t[c])]) > 0 for t in self.columns)
        ]
        return [c for c in moving if not all(map(_is_clock, self.drives, (t[c] for t in self.columns)))]

    def is_smooth(self, column: str) -> bool:
        """Return whether a column is on straight lines: its changes follow each other, and are no jumps."""
        for part in (t[column][np.isfinite(t[column])] for t in self.columns):
            step = np.abs(np.diff(part))
            changed = step > 0
            again = np.mean(changed[1:][changed[:-1]]) if changed[:-1].any() else 0.0
            if again <= 0.5 or step.max() > OUTLIER * 1.4826 * np.median(step[changed]):
                return False
        return True

    def kind(self, q: Input | Node | Output) -> str:
        """Return the kind of a quantity: from its role, its motion, the node that it reads, or its unit."""
        read = str(q.value.value) if isinstance(q, Output) and q.value.op == "name" else q.name
        if q.role is None and not isinstance(q, Input):
            if read in self.pairs.values():
                return "length"
            if read in self.pairs:
                return "velocity"
        return _stated(q)

    def largest_jump(self, reading: Input | Output) -> float:
        """Return the largest change of a reading within JUMP samples, over all recordings."""
        if reading.column not in self._jumps:
            columns = [c[reading.column] for c in self.columns if reading.column in c]
            readings = [v[np.isfinite(v)] for v in columns]
            changes = [np.abs(v[k:] - v[:-k]) for v in readings for k in range(1, JUMP + 1)]
            self._jumps[reading.column] = max((float(d.max(initial=0.0)) for d in changes), default=np.inf)
        return self._jumps[reading.column]

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
                    for i in self._read_in(f.rate) & count.keys():
                        count[i] += 1
            count = {i: n for i, n in count.items() if n or i in stated}
            if count:
                return count
        return {}

    def _read_in(self, e: ex.Expr) -> set[str]:
        """Return the names in an expression, and those that the slow readings among them follow."""
        found = set(ex.names(e))
        slow = [
            f.rate for f in self.physics.flows.values() if f.target in found and _READINGS.match(f.target)
        ]
        return {n.removesuffix(STRAIGHT) for n in found.union(*map(ex.names, slow))}

    def _mean(self, signal: str) -> float:
        if signal in self.plant.parameters:
            return self.plant.parameters[signal].value
        j = list(self.plant.inputs).index(signal)
        return float(np.mean([d.u[:, j].mean() for d in self.drives])) if self.drives else 0.0

    def first_air(self, d: Excitation) -> float:
        """Return the ambient temperature at a recording's start, degC; 0 if there is none."""
        air = self.air or ""
        source = self.plant.parameters.get(air) or self.plant.inputs.get(air)
        start = d.first.get(air, source.value if isinstance(source, Parameter) else 0.0)
        return float(start - zero_of(source.unit) if source else start)

    def signals(self, kind: str, near: str | None = None) -> list[str]:
        """Return names that can stand for v, x, i or T: nodes, inputs and unread columns.

        `near`: the velocity whose signals are wanted. For T, also unread columns without a guess."""
        p = self.physics
        if kind == "v":
            if near in self.velocities:
                return [near]
            names = [*self.velocities, *(i for i in p.inputs if self.kind(p.inputs[i]) in MOVING)]
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
            quantities: list[Node | Input] = [*p.nodes.values(), *p.inputs.values()]
            names = [q.name for q in quantities if self.kind(q) == "current"]
            return (names or self.guessed("i"))[:2]
        warm = [*self.temperatures, *(i for i in self.heat_inputs if i in self.moving_inputs)]
        silent = (c for c in self.spare if not any(c in self.guessed(k) for k in SOUNDS))
        return [*warm, *self.guessed("T"), *silent]

    def coolants(self) -> list[str]:
        """Return the inputs that are a flow of a fluid."""
        return [i.name for i in self.physics.inputs.values() if self.kind(i) in FLOWING]

    def guessed(self, kind: str) -> list[str]:
        """Return the columns that the plant does not read and whose name suggests v, x, i or T."""
        return [c for c in self.spare if re.search(SOUNDS[kind], c, re.I)]

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
            if _stated(self.physics.nodes[v]) not in MOVING:
                out.append(f"'{x}' is taken as a position and '{v}' as its velocity, since '{v}' is its rate")
        unread: dict[str, list[str]] = {}
        for c in self.spare:
            kinds = [MEANINGS[kind] for kind in SOUNDS if c in self.guessed(kind)]
            unread.setdefault(" or a ".join(kinds or ["temperature"]), []).append(f"'{c}'")
        return out + [
            f"columns that the plant does not read are tried in laws and as a {kinds}: {', '.join(columns)}; "
            "an input with a `role` states what it is"
            for kinds, columns in unread.items()
        ]

    def is_motor(self, f: Flow) -> bool:
        """Return whether a flow is a force or a torque that an input or a current drives."""
        moves = f.target in self.velocities or f.source in self.velocities
        return moves and bool(ex.names(f.rate) & self.moving_inputs.union(self.currents))

    def is_pump(self, f: Flow) -> bool:
        """Return whether a flow enters from outside and is neither heat nor a force."""
        return f.source is None and f.target not in (None, *self.temperatures, *self.velocities)

    def drives_of(self, f: Flow) -> list[str]:
        """Return the moving inputs that drive a flow, except temperatures, lengths and velocities."""
        driving = [i for i in self.physics.inputs if i in ex.names(f.rate) & self.moving_inputs]
        return [
            i for i in driving if self.kind(self.physics.inputs[i]) not in ("temperature", "length", *MOVING)
        ]
