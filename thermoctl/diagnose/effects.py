"""The catalogue of left-out physics: read from files, laid over a plant at every place where an entry can sit.

An entry (config/effects/*.yaml, and a user's own folder) names the kind of place, the change it makes in the plant language
and its parameters. `candidates` lists every entry at every place of a plant; `Candidate.extend` gives the plant with it.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl import yamlfile
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.language import Flow, Input, Node, Output, Parameter, Plant
from thermoctl.plant.refit import Prior
from thermoctl.plant.simulate import Excitation, Simulation
from thermoctl.plant.units import dimension
from thermoctl.shipped import shipped

CATALOGUE = shipped("config/effects")
_KEYS = (
    "effect",
    "title",
    "where",
    "needs",
    "reads",
    "change",
    "variants",
    "shapes",
    "parameters",
    "dims",
    "prior",
    "caution",
    "excited_by",
    "mimics",
    "source",
)
_SHAPES = (
    "onsets",
    "windows",
    "times",
    "lags",
    "delays",
    "periods",
    "phases",
    "end_levels",
    "high_levels",
    "drive_levels",
    "small_levels",
    "speeds",
    "creep_speeds",
    "distances",
)
STRAIGHT = "_straight"  # what an input that holds is called where it goes on straight lines
KELVIN = {"K", "kelvin"}
ZERO_DEGC = 273.15  # K
TEMPERATURE = {"degC", "celsius", "degree_Celsius", "delta_degC", "°C", *KELVIN}


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect. `trial`: its value in screening as an expression of the amplitudes s, s2, s3 and of
    shapes; `shape`: the shape that it is; `null`: where the effect is absent."""

    name: str
    unit: str | None
    low: float
    high: float
    null: float
    trial: Expr | None
    shape: str | None
    per_recording: bool
    typical: float | None
    origin: str | None  # 'first_air': low and high are relative to the first ambient temperature

    @property
    def amplitude(self) -> bool:
        """Does it scale with an amplitude of the screening?"""
        return self.trial is not None and any(re.fullmatch(r"s\d?", n) for n in ex.names(self.trial))


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue."""

    name: str
    title: str
    where: str
    needs: tuple[str, ...]
    changes: tuple[tuple[Mapping[str, Any], ...], ...]  # the change and its variants
    shapes: Mapping[str, str]
    parameters: tuple[EffectParameter, ...]
    dims: tuple[tuple[float, ...], ...]
    excited_by: str
    mimics: tuple[str, ...]
    source: str
    caution: str | None = None  # what a finding of it cannot tell, in words
    prior: Expr | None = None  # -2 log of how likely its parameters' values are, beyond their bounds
    reads: tuple[str, ...] = ()  # nodes and inputs by name: an effect of one's own rig


def catalogue(folders: Sequence[Path] = (CATALOGUE,)) -> dict[str, Effect]:
    """All entries of these folders, a later one replacing an earlier one of the same name. Raises InputError."""
    found = {}
    for folder in folders:
        files = sorted(Path(folder).glob("*.yaml"))
        if not files:
            raise yamlfile.InputError(f"{folder}: no effect files (*.yaml) here")
        for file in files:
            effect = _read(yamlfile.load(file))
            found[effect.name] = effect
    return found


def _read(root: yamlfile.Node) -> Effect:
    top = root.value
    if not isinstance(top, dict):
        raise root.error("an effect file must be a mapping")
    for key, node in top.items():
        if key not in _KEYS:
            raise node.error(
                f"unknown key '{key}'; allowed are {', '.join(_KEYS)}{yamlfile.suggest(key, _KEYS)}"
            )
    for key in ("effect", "title", "where", "change", "parameters", "source"):
        if key not in top:
            raise root.error(f"an effect needs '{key}'")
    if top["where"].value not in PLACES:
        raise top["where"].error(
            f"where must be one of {', '.join(PLACES)}{yamlfile.suggest(str(top['where'].value), PLACES)}"
        )
    shapes = top["shapes"].plain() if "shapes" in top else {}
    for key, kind in shapes.items():
        if kind not in _SHAPES:
            raise top["shapes"].value[key].error(f"a shape must be one of {', '.join(_SHAPES)}")
    parameters = []
    amplitudes = 0
    for key, node in top["parameters"].value.items():
        p = node.plain()
        if not isinstance(p, dict):
            raise node.error(f"parameter '{key}' must be a mapping")
        try:
            trial = ex.parse(str(p["trial"])) if "trial" in p else None if "shape" in p else ex.parse("s")
        except ex.ExpressionError as e:
            raise node.error(str(e)) from None
        if trial is not None:
            amplitudes = max(
                [amplitudes, *(int(n[1:] or 1) for n in ex.names(trial) if re.fullmatch(r"s\d?", n))]
            )
        parameters.append(
            EffectParameter(
                key,
                p.get("unit"),
                float(p.get("low", -np.inf)),
                float(p.get("high", np.inf)),
                float(p.get("null", 0.0)),
                trial,
                p.get("shape"),
                bool(p.get("per_recording")),
                p.get("typical"),
                p.get("origin"),
            )
        )
    try:
        prior = ex.parse(str(top["prior"].value)) if "prior" in top else None
    except ex.ExpressionError as e:
        raise top["prior"].error(str(e)) from None
    dims = (
        tuple(map(tuple, top["dims"].plain()))
        if "dims" in top
        else tuple(tuple(1.0 if i == k else 0.0 for i in range(amplitudes)) for k in range(amplitudes))
        or ((1.0,),)
    )
    for node in [top["change"], *(top["variants"].value if "variants" in top else [])]:
        for item in node.value if isinstance(node.value, list) else []:
            if (
                not isinstance(item.value, dict)
                or len(item.value) != 1
                or next(iter(item.value)) not in _CHANGES
            ):
                raise item.error(f"a change must be one of {', '.join(_CHANGES)}")
    changes = (
        tuple(top["change"].plain()),
        *(tuple(v) for v in (top["variants"].plain() if "variants" in top else [])),
    )
    return Effect(
        top["effect"].value,
        top["title"].value,
        top["where"].value,
        tuple(top["needs"].plain()) if "needs" in top else (),
        changes,
        shapes,
        tuple(parameters),
        dims,
        top["excited_by"].value if "excited_by" in top else "",
        tuple(top["mimics"].plain()) if "mimics" in top else (),
        top["source"].value,
        top["caution"].value if "caution" in top else None,
        prior,
        tuple(top["reads"].plain()) if "reads" in top else (),
    )


# ---------------------------------------------------------------------------------------------------------- the rig

_KINDS = {
    "temperature": "K",
    "length": "m",
    "velocity": "m/s",
    "current": "A",
    "time": "s",
    "rotation": "1/s",
    "voltage": "V",
    "power": "W",
}


@cache
def _dimension(unit: str | None) -> str:
    if unit is None:
        return ""
    if unit in TEMPERATURE:
        return "temperature"
    try:
        found = dimension(unit)
    except ValueError:
        return ""
    return next((kind for kind, like in _KINDS.items() if dimension(like) == found), "")


def zero_of(unit: str | None) -> float:
    """The reading of 0 degC in a unit of temperature."""
    return ZERO_DEGC if unit in KELVIN else 0.0


_ROLE_KINDS = {"ambient": "temperature", "position": "length"}  # the other roles are kinds of their own


# Nodes that an effect brought to model a reading (lag, memory of the start): no body, so no physics can sit there.
_READINGS = re.compile(
    r"(lagged|memory|grown)_(sensor_lag|cold_junction_drift|missing_member|expansion_lag)_"
)


class Rig:
    """A plant and its recordings as the catalogue sees them: which node is a temperature, what moves, what is air."""

    def __init__(
        self, plant: Plant, drives: Sequence[Excitation], columns: Sequence[Mapping[str, np.ndarray]]
    ):
        self.plant, self.drives, self.columns = plant, list(drives), list(columns)
        # What an observer (observer.py) added is no physics that an effect could sit in.
        p = dataclasses.replace(
            plant,
            inputs={
                k: v
                for k, v in plant.inputs.items()
                if not k.startswith("seen_") and not k.endswith(STRAIGHT)
            },
            flows={k: v for k, v in plant.flows.items() if not k.startswith("correct_")},
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

    def kind(self, q: Input | Node | Output) -> str:
        """Return the kind of a quantity, from its role or else its unit; empty where neither has one."""
        return _ROLE_KINDS.get(q.role, q.role) if q.role else _dimension(q.unit)

    def _coolest(self) -> str | None:
        """The temperature input that losses of heat are counted from."""
        for f in self.physics.flows.values():
            if f.target is None or f.source is None:
                for i in self.heat_inputs:
                    if i in ex.names(f.rate):
                        return i
        return self.heat_inputs[0] if self.heat_inputs else None

    def first_air(self, d: Excitation) -> float:
        """The ambient at a recording's start, degC; 0 without one."""
        air = self.air or ""
        known = self.plant.parameters.get(air) or self.plant.inputs.get(air)
        start = d.first.get(air, known.value if isinstance(known, Parameter) else 0.0)
        return float(start - zero_of(known.unit) if known else start)

    def signals(self, kind: str, near: str | None = None) -> list[str]:
        """Names that can stand for v, x, i or T: nodes, inputs, recorded columns (which become inputs)."""
        p = self.physics
        if kind == "v":
            if near in self.velocities:
                return [near]
            found = [
                *self.velocities,
                *(i for i in p.inputs if self.kind(p.inputs[i]) in ("velocity", "rotation")),
            ]
            return (found or [c for c in self.spare if re.search(r"veloc|speed|^v$", c, re.I)])[:3]
        if kind == "x":
            if near in self.position_of:
                return [self.position_of[near]]
            if self.position_of:
                return list(self.position_of.values())
            found = [i for i in p.inputs if self.kind(p.inputs[i]) == "length" and i in self.moving_inputs]
            found += [n.name for n in p.nodes.values() if self.kind(n) == "length"]
            return (found or [c for c in self.spare if re.search(r"posit|stroke|travel|^x$", c, re.I)])[:3]
        if kind == "i":
            found = [n.name for n in p.nodes.values() if self.kind(n) == "current"]
            found += [i for i in p.inputs if self.kind(p.inputs[i]) == "current"]
            return (found or [c for c in self.spare if re.search(r"current|^i$", c, re.I)])[:2]
        found = [*self.temperatures, *(i for i in self.heat_inputs if i in self.moving_inputs)]
        return found + [c for c in self.spare if re.search(r"temp|_c$|^t_", c, re.I)]

    def is_motor(self, f: Flow) -> bool:
        """A flow of force that an input drives."""
        return bool(
            (f.target in self.velocities or f.source in self.velocities)
            and ex.names(f.rate) & self.moving_inputs
        )

    def is_pump(self, f: Flow) -> bool:
        """A flow from outside, of something else than heat or force, that an input drives."""
        return f.source is None and f.target not in (None, *self.temperatures, *self.velocities)

    def drives_of(self, f: Flow) -> list[str]:
        """The inputs that drive a flow (temperatures, positions and references aside)."""
        return [
            i
            for i in self.physics.inputs
            if i in ex.names(f.rate)
            and i in self.moving_inputs
            and self.kind(self.physics.inputs[i]) not in ("temperature", "length", "velocity", "rotation")
        ]


# ---------------------------------------------------------------------------------------------------------- places


@dataclass(frozen=True)
class Place:
    """Where an effect sits, by the name that a result gives, and what its symbols stand for there."""

    where: str
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    nodes: Mapping[str, str] = field(default_factory=dict)  # T, v, a, b ... as ends of flows
    flow: str | None = None
    output: str | None = None
    input: str | None = None

    def parts(self) -> set[str]:
        """The nodes and the flow that it names (not those that a reading is made of)."""
        named = {str(e.value) for s, e in self.symbols.items() if s != "y" and e.op == "name"}
        return {*self.nodes.values(), *named} | ({self.flow} if self.flow else set())


def _nodes(rig: Rig, which: Sequence[str], symbol: str) -> Iterator[Place]:
    for n in which:
        yield Place(n, {symbol: name(n)}, {symbol: n})


def _temperature_nodes(rig: Rig) -> Iterator[Place]:
    if rig.air:
        yield from _nodes(rig, rig.temperatures, "T")


def _velocity_nodes(rig: Rig) -> Iterator[Place]:
    yield from _nodes(rig, rig.velocities, "v")


def _storing(rig: Rig) -> list[str]:
    """The nodes that a flow can fill; a position stores nothing."""
    ends = {e for f in rig.physics.flows.values() for e in (f.source, f.target)}
    return [n for n in rig.physics.nodes if n in ends and n not in rig.position_of.values()]


def _exchanging(rig: Rig) -> Iterator[Place]:
    nodes = set(_storing(rig))
    for f in rig.physics.flows.values():
        if f.source in nodes and f.target in nodes:
            ends = {"m": f.source, "n": f.target}
            yield Place(f"{f.source}-{f.target}", {k: name(str(v)) for k, v in ends.items()}, ends)


def _conductances(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        read = ex.names(f.rate)
        ends = [e for e in (f.source, f.target) if e in rig.temperatures]
        if ends and read & set(rig.temperatures):
            hot = next(e for e in ends if e in read) if any(e in read for e in ends) else ends[0]
            yield Place(f.name, {"T": name(hot)}, flow=f.name)


def _pairs(rig: Rig) -> Iterator[Place]:
    linked = {frozenset((f.source, f.target)) for f in rig.physics.flows.values()}
    for k, a in enumerate(rig.temperatures):
        for b in rig.temperatures[k + 1 :]:
            if frozenset((a, b)) not in linked:
                yield Place(f"{a}-{b}", {"TA": name(a), "TB": name(b)}, {"TA": a, "TB": b})


def _heated_pairs(rig: Rig) -> Iterator[Place]:
    for a in rig.temperatures:
        if not _heats(rig.physics, a, rig):
            continue
        for b in rig.temperatures:
            if a != b:
                yield Place(f"{a}-{b}", {"TA": name(a), "TB": name(b)}, {"a": a, "b": b})


def _heats(plant: Plant, node: str, rig: Rig) -> list[Flow]:
    """Flows of heat from outside into a node that follow inputs, not temperatures of the network: where these change it (copper's
    resistance), there is none of it while the inputs rest."""
    return [
        f
        for f in plant.flows.values()
        if f.target == node
        and f.source is None
        and ex.names(f.rate) & rig.moving_inputs
        and not ex.names(f.rate) & set(rig.heat_inputs)
        and (node not in ex.names(f.rate) or _rests(plant, f))
    ]


def _rests(plant: Plant, f: Flow) -> bool:
    """Is a flow nothing while all inputs are zero, whatever the temperatures?"""
    if any(e.op == "delay" for e in ex.walk(f.rate)):
        return False
    at = {
        **{p.name: p.value for p in plant.parameters.values()},
        **dict.fromkeys(plant.inputs, 0.0),
        "t": 0.0,
    }
    return all(float(ex.evaluate(f.rate, {**at, **dict.fromkeys(plant.nodes, T)})) == 0 for T in (10.0, 60.0))


def _joule_flows(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        squares = [
            e
            for e in ex.walk(f.rate)
            if (e.op == "**" and e.args[1].op == "num" and e.args[1].value == 2)
            or (e.op == "*" and e.args[0] is e.args[1])
        ]
        if f.target in rig.temperatures and f.source is None and squares and f.target not in ex.names(f.rate):
            yield Place(f.name, {"T": name(f.target)}, flow=f.name)


def _motors(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        if rig.is_motor(f):
            yield Place(f.name, {}, {"v": f.target or f.source or ""}, flow=f.name)


def _drives(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        if rig.is_motor(f) or rig.is_pump(f):
            for u in rig.drives_of(f):
                yield Place(f.name, {"u": name(u)}, flow=f.name, input=u)


def _sensors(rig: Rig, dimension: str | None = None) -> Iterator[Place]:
    for o in rig.physics.outputs.values():
        if dimension is None or rig.kind(o) == dimension:
            yield Place(o.name, {"y": o.value}, output=o.name)
    used = [*(f.rate for f in rig.plant.flows.values()), *(o.value for o in rig.plant.outputs.values())]
    read = set().union(*map(ex.names, used))
    for i in rig.physics.inputs.values():
        if i.name in rig.moving_inputs & read and (dimension is None or rig.kind(i) == dimension):
            yield Place(i.name, {"y": name(i.name)}, input=i.name)


def _displacements(rig: Rig) -> Iterator[Place]:
    warm = set(rig.temperatures) | set(rig.heat_inputs)
    for o in rig.physics.outputs.values():
        if rig.kind(o) == "length" and ex.names(o.value) & warm:
            yield Place(o.name, {"y": o.value}, output=o.name)


def _members(rig: Rig) -> Iterator[Place]:
    for at in _displacements(rig):
        for T in rig.signals("T"):
            yield Place(T, {**at.symbols, "T": name(T)}, output=at.output)


def _bending_pairs(rig: Rig) -> Iterator[Place]:
    for at in _displacements(rig):
        T = rig.signals("T")
        for k, a in enumerate(T):
            for b in T[k + 1 :]:
                yield Place(f"{a}-{b}", {**at.symbols, "TA": name(a), "TB": name(b)}, output=at.output)


def _voltages(rig: Rig) -> Iterator[Place]:
    for o in rig.physics.outputs.values():
        if rig.kind(o) == "voltage" and not any(_sources(rig, n) for n in ex.names(o.value)):
            yield Place(o.name, {"y": o.value}, output=o.name)
    for n in rig.physics.nodes.values():
        if rig.kind(n) == "current":
            yield Place(n.name, {}, {"a": n.name})


def _sources(rig: Rig, node: str) -> bool:
    return any(
        f.source == node and any(e.op in ("sqrt", "**") and node in ex.names(e) for e in ex.walk(f.rate))
        for f in rig.physics.flows.values()
    )


def _levels(rig: Rig) -> Iterator[Place]:
    for n in rig.physics.nodes:
        if _sources(rig, n):
            after = next((f.target for f in rig.physics.flows.values() if f.source == n and f.target), None)
            yield Place(n, {"a": name(n)}, {"a": n, **({"b": after} if after else {})})


def _orifices(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        if f.source and any(
            e.op == "sqrt" or (e.op == "**" and e.args[1].op == "num" and e.args[1].value == 0.5)
            for e in ex.walk(f.rate)
            if f.source in ex.names(e)
        ):
            yield Place(f.name, {}, flow=f.name)


def _resistive(rig: Rig) -> Iterator[Place]:
    ohms = {q for q, p in rig.physics.parameters.items() if p.unit and re.search(r"ohm", p.unit, re.I)}
    for o in rig.physics.outputs.values():
        if ex.names(o.value) & ohms:
            yield Place(o.name, {}, output=o.name)
    for f in rig.physics.flows.values():
        if ex.names(f.rate) & ohms and f.target not in rig.temperatures:
            yield Place(f.name, {}, flow=f.name)


PLACES = {
    "node": lambda rig: _nodes(rig, _storing(rig), "n"),
    "node_pair": _exchanging,
    "temperature_node": _temperature_nodes,
    "velocity_node": _velocity_nodes,
    "conductance": _conductances,
    "temperature_pair": _pairs,
    "heated_pair": _heated_pairs,
    "joule_flow": _joule_flows,
    "motor": _motors,
    "drive": _drives,
    "sensor": _sensors,
    "reading_in_air": lambda rig: (*_sensors(rig, "temperature"), *_displacements(rig)),
    "position_sensor": lambda rig: _sensors(rig, "length"),
    "displacement": _displacements,
    "member": _members,
    "bending_pair": _bending_pairs,
    "voltage_sensor": _voltages,
    "level_node": _levels,
    "orifice": _orifices,
    "resistive": _resistive,
}


# ------------------------------------------------------------------------------------------------------- candidates


@dataclass
class Candidate:
    """An effect at a place, in one of its variants, with one choice of signals. `prefix` makes its names unique."""

    effect: Effect
    place: Place
    rig: Rig
    variant: int = 0
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    label: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """(effect, where): what a result names."""
        return self.effect.name, self.place.where

    def bounds(self, p: EffectParameter) -> tuple[float, float]:
        """Where physics lets a parameter be."""
        origin = self.rig.first_air(self.rig.drives[0]) if p.origin == "first_air" else 0.0
        return origin + p.low, origin + p.high

    @property
    def jumps(self) -> bool:
        """Does what a sensor reads hold inputs that go in steps?"""
        y, inputs = self.place.symbols.get("y"), self.rig.plant.inputs
        return y is not None and any(
            i in self.rig.moving_inputs and not inputs[i].linear for i in ex.names(y)
        )

    def beliefs(self, plant: Plant) -> list[Prior]:
        """What physics says of the effect's parameters in `plant`, for each recording."""
        if self.effect.prior is None:
            return []
        # what has no value of its own in each recording is believed once
        share = 1.0 if any(p.per_recording for p in self.effect.parameters) else 1.0 / len(self.rig.drives)
        out = []
        for d in self.rig.drives:
            known = {
                "duration": num(float(d.t[-1] - d.t[0])),
                "first_air": num(self.rig.first_air(d)),
                **{
                    p.name: name(self.own(p.name))
                    for p in self.effect.parameters
                    if self.own(p.name) in plant.parameters
                },
            }

            def told(e: Expr, known: Mapping[str, Expr] = known) -> Expr | None:
                return known.get(str(e.value)) if e.op == "name" else None

            out.append(Prior(d.name, ex.mul(num(share), ex.substitute(self.effect.prior, told))))
        return out

    def surprise(self, plant: Plant) -> float:
        """-2 log of how likely the values are that `plant` holds for the effect, over all recordings."""
        total = 0.0
        for b in self.beliefs(plant):
            total += float(
                ex.evaluate(
                    b.neg2_log,
                    {
                        n: plant.parameters[n].values.get(b.recording, plant.parameters[n].value)
                        for n in ex.names(b.neg2_log)
                    },
                )
            )
        return total

    def own(self, parameter: str) -> str:
        """The plant's name of one of the effect's parameters."""
        return f"{parameter}_{self.effect.name}_{re.sub(r'[^A-Za-z0-9_]', '_', self.place.where)}"

    def extend(
        self, values: Mapping[str, Any], ranges: Mapping[str, tuple[float, float]] | None = None
    ) -> Plant:
        """The plant with the effect, its parameters (effect's names) at `values` (a number, or one per recording name)."""
        return _Builder(self, values, ranges or {}).plant()


def candidates(rig: Rig, effects: Mapping[str, Effect]) -> list[Candidate]:
    """Every effect at every place it can sit, with every choice of the signals it needs."""
    out = []
    driving = {place.input for place in _drives(rig)}
    for effect in effects.values():
        if not set(effect.reads) <= rig.plant.nodes.keys() | rig.plant.inputs.keys():
            continue
        for place in PLACES[effect.where](rig):
            near = place.nodes.get("v")
            choices: list[dict[str, Expr]] = [{}]
            for need in effect.needs:
                if need in place.symbols:
                    continue
                found = rig.signals(need, near)
                if need == "T" and effect.where == "displacement":
                    found = sorted(ex.names(place.symbols["y"]) & set(found)) or found
                choices = [{**c, need: name(s)} for c in choices for s in found if s != place.where]
            for variant in range(len(effect.changes)):
                for k, choice in enumerate(choices):
                    candidate = Candidate(effect, place, rig, variant, choice, f"{variant}{k}")
                    if effect.name == "cold_junction_drift" and (
                        not rig.air or rig.air not in rig.moving_inputs or place.where == rig.air
                    ):
                        continue
                    if effect.name == "sensor_gain" and place.where == rig.air:
                        continue
                    if effect.name == "sensor_lag" and variant and not candidate.jumps:
                        continue  # on straight lines it is the same
                    if effect.name in ("sensor_delay", "sensor_saturation") and place.input in driving:
                        continue  # a drive that acts late or is clipped is the actuator's entry
                    out.append(candidate)
    return out


_CHANGES = (
    "flow",
    "rate",
    "value",
    "storage",
    "node",
    "split",
    "drive",
    "spill",
    "exponent",
    "resistance",
    "straight",
)


_form = cache(ex.parse)  # the catalogue's forms are read once


class _Builder:
    def __init__(self, c: Candidate, values: Mapping[str, Any], ranges: Mapping[str, tuple[float, float]]):
        self.c, self.rig, self.base = c, c.rig, c.rig.plant
        self.inputs, self.parameters = dict(self.base.inputs), dict(self.base.parameters)
        self.nodes, self.flows, self.outputs = (
            dict(self.base.nodes),
            dict(self.base.flows),
            dict(self.base.outputs),
        )
        self.made: dict[str, str] = {}  # nodes that the effect brings: its own name to the plant's
        self.symbols: dict[str, Expr] = {**c.place.symbols, **c.symbols}
        if self.rig.air:
            self.symbols.setdefault("air", name(self.rig.air))
        place = c.place
        y = place.symbols.get("y")
        for symbol in self.symbols.keys() & {"T", "TA", "TB", "air"}:
            self.symbols[symbol] = self._celsius(self.symbols[symbol])
        if y is not None:
            warm = self._unit_of_y() in TEMPERATURE and self.rig.air and self.rig.air not in ex.names(y)
            air = name(self.rig.air or "")
            shift = zero_of(self._unit_of_y()) - zero_of(self._signal_unit(air))
            self.symbols["reference"] = ex.add(air, num(shift)) if warm else num(0.0)
        dts = [float(np.median(np.diff(d.t))) for d in self.rig.drives if len(d.t) > 1]
        self.symbols["duration"] = num(max((float(d.t[-1]) for d in self.rig.drives), default=1.0))
        self.symbols["sample"] = num(float(f"{min(dts):.6g}") if dts else 1.0)
        for e in c.effect.parameters:
            own = c.own(e.name)
            self.symbols[e.name] = name(own)
            value = values.get(e.name, e.null)
            per = value if isinstance(value, dict) else {}
            low, high = ranges.get(e.name, (e.low, e.high))
            mean = float(np.mean(list(per.values()))) if per else float(value)
            limits = (low, high) if np.isfinite(low) and np.isfinite(high) and low < high else None
            if limits:
                mean = min(max(mean, low), high)
            self.parameters[own] = Parameter(
                own, mean, self._unit(e.unit), limits, e.per_recording, dict(per) if e.per_recording else {}
            )
        self.suffix = f"_{c.effect.name}_{re.sub(r'[^A-Za-z0-9_]', '_', place.where)}"
        for s in c.symbols.values():
            for n in ex.names(s):
                self._record(n)
        for n in set().union(*(ex.names(s) for s in place.symbols.values())) if place.symbols else ():
            self._record(n)

    def _record(self, signal: str) -> None:
        """A recorded column that the plant did not read becomes an input."""
        if signal in self.rig.spare and signal not in self.inputs:
            self.inputs[signal] = Input(signal, None, signal, False)

    def _celsius(self, e: Expr) -> Expr:
        """A temperature as the catalogue's forms count it."""
        return ex.add(e, num(-zero_of(self._signal_unit(e))))

    def _unit_of_y(self) -> str | None:
        p = self.c.place
        return (
            self.base.outputs[p.output].unit
            if p.output
            else self.base.inputs[p.input].unit
            if p.input
            else None
        )

    def _signal_unit(self, e: Expr | None) -> str | None:
        if e is None or e.op != "name":
            return None
        for table in (self.base.nodes, self.base.inputs, self.base.parameters):
            if e.value in table:
                return table[e.value].unit
        return None

    def _unit(self, text: str | None) -> str | None:
        if text is None:
            return None
        node = self.c.place.nodes.get("v")
        rate = None
        if node:
            rate = next(
                (f.unit for f in self.base.flows.values() if node in (f.source, f.target) and f.unit), None
            )
        known = {
            "unit_of_y": self._unit_of_y(),
            "unit_of_rate": rate,
            "unit_of_v": self._signal_unit(self.symbols.get("v")),
            "unit_of_x": self._signal_unit(self.symbols.get("x")),
            "unit_of_u": self._signal_unit(self.symbols.get("u")),
            "unit_of_a": self._signal_unit(self.symbols.get("a")),
        }
        for key, unit in known.items():
            if key in text:
                if unit is None:
                    return None
                text = text.replace(key, "K" if unit in TEMPERATURE and text != key else unit)
        return re.sub(r"\b(?=[WJ]\b)", self._prefix(), text)

    def _prefix(self) -> str:
        """The m of mW where the heat flows of the place are counted so."""
        place = self.c.place
        flow = self.base.flows.get(place.flow or "")
        ends = {*place.nodes.values(), *((flow.source, flow.target) if flow else ())}
        units = (f.unit or "" for f in self.base.flows.values() if {f.source, f.target} & ends - {None})
        return next((u[:-1] for u in units if _dimension(u) == "power" and u.endswith("W")), "")

    def expression(self, text: str | float) -> Expr:
        """A form of the catalogue with its symbols filled in."""

        def change(e: Expr) -> Expr | None:
            return self.symbols.get(e.value) if e.op == "name" else None

        return ex.substitute(_form(text), change)

    def plant(self) -> Plant:
        for item in self.c.effect.changes[self.c.variant]:
            ((kind, what),) = item.items()
            getattr(self, f"_{kind}")(what)
        return dataclasses.replace(
            self.base,
            inputs=self.inputs,
            parameters=self._used(),
            nodes=self.nodes,
            flows=self.flows,
            outputs=self.outputs,
        )

    def _used(self) -> dict[str, Parameter]:
        exprs = (
            [e for n in self.nodes.values() for e in (n.storage, n.initial)]
            + [f.rate for f in self.flows.values()]
            + [o.value for o in self.outputs.values()]
        )
        used = set().union(*(ex.names(e) for e in exprs))
        return {k: p for k, p in self.parameters.items() if k in used}

    def _flow(self, what: Mapping[str, Any]) -> None:
        label = f"{self.c.effect.name}_{self.c.place.where}".replace("-", "_")
        while label in self.flows or label in self.nodes or label in self.outputs:
            label += "_2"
        ends = {
            k: self.c.place.nodes.get(what[k]) or self.made.get(what[k]) if k in what else None
            for k in ("from", "into")
        }
        self.flows[label] = Flow(label, self.expression(what["rate"]), ends["from"], ends["into"], None)

    def _rate(self, form: str) -> None:
        f = self.base.flows[self.c.place.flow or ""]
        self.symbols["rate"] = f.rate
        self.flows[f.name] = dataclasses.replace(f, rate=self.expression(form))

    def _value(self, form: str) -> None:
        self._put(self.expression(form))

    def _put(self, new: Expr) -> None:
        p = self.c.place
        if p.output:
            self.outputs[p.output] = dataclasses.replace(self.outputs[p.output], value=new)
            return

        def change(e: Expr) -> Expr | None:
            return new if e.op == "name" and e.value == p.input else None

        # The start stays as read: an expression of inputs at the first sample knows no node, no time and no delay.
        self.flows = {
            k: dataclasses.replace(f, rate=ex.substitute(f.rate, change)) if k in self.base.flows else f
            for k, f in self.flows.items()
        }
        self.outputs = {
            k: dataclasses.replace(o, value=ex.substitute(o.value, change)) for k, o in self.outputs.items()
        }

    def _storage(self, form: str) -> None:
        n = self.base.nodes[self.c.place.nodes["T"]]
        self.symbols["storage"] = n.storage
        self.nodes[n.name] = dataclasses.replace(n, storage=self.expression(form))

    def _node(self, what: Mapping[str, Any]) -> None:
        label = what["name"] + self.suffix
        label = label[:78]
        self.made[what["name"]] = label
        self.symbols[what["name"]] = name(label)
        special = {"start_of_T": "T", "start_of_y": "y", "start_of_x": "x"}
        text = str(what["initial"])
        spread = what.get("initial_sigma")
        if text in special:
            source = self.symbols[special[text]]
            spread = spread or self._spread_at_start(source)

            def start(e: Expr) -> Expr | None:
                return (
                    self.base.nodes[e.value].initial
                    if e.op == "name" and e.value in self.base.nodes
                    else num(0.0)
                    if e.op == "name" and e.value == "t"
                    else e.args[0]
                    if e.op == "delay"
                    else None
                )

            initial = ex.substitute(source, start)
        elif text == "first_air":
            initial = self.symbols["air"]
        else:
            initial = self.expression(what["initial"])
        self.nodes[label] = Node(
            label, self.expression(what["storage"]), initial, self._unit(what.get("unit")), spread
        )

    def _spread_at_start(self, source: Expr) -> float | None:
        """How uncertain the start of what begins where `source` does is: as uncertain as the nodes in it."""
        known = {q: p.value for q, p in self.base.parameters.items()}
        source = ex.substitute(source, lambda e: e.args[0] if e.op == "delay" else None)
        total = 0.0
        for n in ex.names(source) & set(self.base.nodes):
            slope = ex.derivative(source, n)
            if ex.names(slope) <= set(known):
                total += (float(ex.evaluate(slope, known)) * (self.base.nodes[n].initial_sigma or 0.0)) ** 2
        return float(np.sqrt(total)) or None

    def _straight(self, symbol: str) -> None:
        """Inputs that hold go on straight lines in this symbol: a sensor's lag is short against a sample, and would otherwise be a
        sample late."""

        def change(e: Expr) -> Expr | None:
            i = self.base.inputs.get(e.value) if e.op == "name" else None
            if i is None or i.linear:
                return None
            twin = f"{i.name}{STRAIGHT}"
            self.inputs[twin] = dataclasses.replace(i, name=twin, column=i.column or i.name, linear=True)
            return name(twin)

        self.symbols[symbol] = ex.substitute(self.symbols[symbol], change)

    def _split(self, what: Mapping[str, Any]) -> None:
        share = name(self.c.own(what["share"]))
        a, b = self.c.place.nodes["a"], self.c.place.nodes["b"]
        for f in _heats(self.rig.physics, a, self.rig):
            self.flows[f.name] = dataclasses.replace(f, rate=ex.mul(f.rate, ex.add(ex.ONE, ex.neg(share))))
            label = f"{f.name}_to_{b}"
            self.flows[label] = Flow(label, ex.mul(f.rate, share), None, b, f.unit)

    def _drive(self, form: str) -> None:
        new, u, f = self.expression(form), self.c.place.input, self.base.flows[self.c.place.flow or ""]
        self.flows[f.name] = dataclasses.replace(
            f, rate=ex.substitute(f.rate, lambda e: new if e.op == "name" and e.value == u else None)
        )

    def _spill(self, what: Mapping[str, Any]) -> None:
        a, b = self.c.place.nodes["a"], self.c.place.nodes.get("b")
        dt = self.symbols["sample"].value
        over = ex.parse(f"max({a} - {self.c.own(what['level'])}, 0) * {2.0 / dt!r}")
        share = name(self.c.own(what["share"]))
        # spilled volume by time: level * storage / time; the rate is stiff enough to hold the level within a sample
        over = ex.mul(over, self.base.nodes[a].storage)
        unit = next((f.unit for f in self.base.flows.values() if f.source == a), None)
        if b:
            self.flows[f"spill_{a}_{b}"] = Flow(f"spill_{a}_{b}", ex.mul(over, share), a, b, unit)
            self.flows[f"spill_{a}_out"] = Flow(
                f"spill_{a}_out", ex.mul(over, ex.add(ex.ONE, ex.neg(share))), a, None, unit
            )
        else:
            self.flows[f"spill_{a}_out"] = Flow(f"spill_{a}_out", over, a, None, unit)

    def _exponent(self, parameter: str) -> None:
        n = name(self.c.own(parameter))
        f = self.base.flows[self.c.place.flow or ""]

        def change(e: Expr) -> Expr | None:
            if f.source not in ex.names(e):
                return None
            if e.op == "sqrt":
                return ex.make("**", e.args[0], n)
            return (
                ex.make("**", e.args[0], n)
                if e.op == "**" and e.args[1].op == "num" and e.args[1].value == 0.5
                else None
            )

        self.flows[f.name] = dataclasses.replace(f, rate=ex.substitute(f.rate, change), unit=None)

    def _resistance(self, form: str) -> None:
        ohms = [q for q, p in self.base.parameters.items() if p.unit and re.search(r"ohm", p.unit, re.I)]

        def change(e: Expr) -> Expr | None:
            if e.op == "name" and e.value in ohms:
                self.symbols["R"] = e
                return self.expression(form)
            return None

        p = self.c.place
        if p.output:
            o = self.base.outputs[p.output]
            self.outputs[p.output] = dataclasses.replace(o, value=ex.substitute(o.value, change))
        elif p.flow:
            f = self.base.flows[p.flow]
            self.flows[p.flow] = dataclasses.replace(f, rate=ex.substitute(f.rate, change))


# ---------------------------------------------------------------------------------------------------------- shapes

SLOW_TURNS, FINE_TURNS = (
    60.0,
    4000,
)  # periods over the span: each looked at up to the first, the strongest up to the second


def _fine_turns(x: np.ndarray, errors: Sequence[np.ndarray], span: float, count: int = 16) -> np.ndarray:
    """The strongest numbers of turns beyond SLOW_TURNS in output errors (N,) per recording, over the signal x of all of them:
    peaks of their spectrum over x. What moves slowly in time is taken off first."""
    fast = []
    for e in errors:
        e = np.nan_to_num(e)
        total = np.concatenate([[0.0], np.cumsum(e)])
        half = max(len(e) // 200, 4)
        low, high = np.maximum(np.arange(len(e)) - half, 0), np.minimum(np.arange(len(e)) + half + 1, len(e))
        fast.append(e - (total[high] - total[low]) / (high - low))
    e = np.concatenate(fast)
    e = np.clip(e, *(np.array([-8, 8]) * (1.4826 * float(np.median(np.abs(e))) or np.inf)))
    good = np.isfinite(x)
    if not good.any():
        return np.zeros(0)
    bins = 8 * FINE_TURNS
    index = np.clip(((x[good] - np.min(x[good])) / span * bins).astype(int), 0, bins - 1)
    power = np.abs(np.fft.rfft(np.bincount(index, e[good], bins), 4 * bins))[
        : 4 * FINE_TURNS
    ]  # by a quarter of a turn
    power[: int(4 * SLOW_TURNS)] = 0.0
    peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    return peaks[np.argsort(-power[peaks])[:count]] / 4


def shape_grid(
    kind: str, candidate: Candidate, runs: Sequence[Simulation], onsets: int = 24
) -> list[dict[str, float]]:
    """The values of a shape to look at in screening. Beside them `picked_from`: of how many the residual itself picked this one, and
    `longest`: beyond which a period would not have come once."""
    rig = candidate.rig
    duration = max(float(d.t[-1]) for d in rig.drives)
    dt = min(float(np.median(np.diff(d.t))) for d in rig.drives if len(d.t) > 1)

    def signal(e: Expr) -> np.ndarray:
        parts = []
        for d, run, columns in zip(rig.drives, runs, rig.columns, strict=True):
            values = {
                **{c: columns[c] for c in rig.spare},
                **dict(zip(rig.plant.inputs, d.u.T, strict=False)),
                **dict(zip(rig.plant.nodes, run.x.T, strict=True)),
                "t": d.t,
                **{q: p.value for q, p in rig.plant.parameters.items()},
            }
            parts.append(np.broadcast_to(np.asarray(ex.evaluate(e, values), float), d.t.shape))
        return np.concatenate(parts)

    if kind == "onsets":
        return [{"onset": float(v)} for v in np.linspace(0, duration, onsets + 2)[1:-1]]
    if kind == "windows":
        edges = np.linspace(0, duration, onsets + 1)
        return [
            {"start": float(a), "end": float(b)} for k, a in enumerate(edges[:-1]) for b in edges[k + 1 :]
        ]
    if kind == "times":
        return [{"tau": float(v)} for v in np.geomspace(3 * dt, 0.6 * duration, 12)]
    if kind == "lags":
        return [{"tau": float(v)} for v in np.geomspace(0.5 * dt, 0.1 * duration, 10)]
    if kind == "delays":
        return [{"tau": float(v)} for v in np.geomspace(0.3 * dt, 0.03 * duration, 9)]
    symbols = {**candidate.place.symbols, **candidate.symbols}
    if kind in ("periods", "phases", "distances"):
        x = signal(symbols["x"]) if "x" in symbols else np.array([0.0, 1.0])
        if kind == "distances" and "x" not in symbols:
            v = candidate.place.nodes.get("v")
            position = rig.position_of.get(v or "")
            x = signal(name(position)) if position else x
        span = float(np.ptp(x[np.isfinite(x)])) or 1.0
        if kind == "periods":
            # neighbouring periods differ by a quarter of a turn over the span
            slow = [{"period": float(span / n), "longest": span} for n in np.arange(1.0, SLOW_TURNS, 0.25)]
            errors = [d.y - run.y for d, run in zip(rig.drives, runs, strict=True)]
            if candidate.place.output:
                j = list(rig.plant.outputs).index(candidate.place.output)
                fine = _fine_turns(x, [e[:, j] for e in errors], span)
                return slow + [
                    {"period": float(span / n), "longest": span, "picked_from": 4.0 * FINE_TURNS}
                    for n in fine
                ]
            return slow
        if kind == "phases":
            return [{"phase": 0.0}, {"phase": float(np.pi / 2)}]
        return [{"distance": float(v)} for v in np.geomspace(1e-3 * span, 0.5 * span, 8)]
    if kind in ("speeds", "creep_speeds"):
        v = np.abs(signal(symbols["v"]))
        top = float(np.nanmax(v)) or 1.0
        if kind == "creep_speeds":  # the speed below which dry friction gives way smoothly
            return [{"creep": 1e-3 * top}]
        return [{"speed": float(q)} for q in np.geomspace(0.01 * top, 0.6 * top, 8)]
    target = symbols.get("y") or symbols.get("u") or symbols.get("a")
    z = signal(target) if target is not None else np.array([0.0, 1.0])
    z = z[np.isfinite(z)]
    if kind == "drive_levels":
        return [
            {"level": float(v)}
            for v in np.unique(np.quantile(np.abs(z), [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98]))
        ]
    if kind == "small_levels":
        top = float(np.max(np.abs(z))) or 1.0
        return [{"level": float(v)} for v in np.geomspace(0.001 * top, 0.6 * top, 14)]
    quantiles = [0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.94, 0.97, 0.99]
    if kind == "end_levels" and candidate.variant == 1:
        quantiles = [1 - q for q in quantiles]
    return [{"level": float(v)} for v in np.unique(np.quantile(z, quantiles))]
