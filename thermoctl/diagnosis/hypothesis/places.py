"""The places of a plant where a catalogue entry can act, by the entry's kind of place (`where:`)."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name
from thermoctl.plant.language import Flow, Plant

WEIR = 2.6  # largest exponent of an outlet: 5/2 for a notch


@dataclass(frozen=True)
class Place:
    """Where an effect acts: its name in a result, and the plant's expressions for the effect's symbols."""

    where: str
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    nodes: Mapping[str, str] = field(default_factory=dict)  # T, v, a, b ... as ends of flows
    flow: str | None = None
    output: str | None = None
    input: str | None = None
    exponent: float | None = None  # exponent of an outlet, in the plant file

    def parts(self) -> set[str]:
        """Return the nodes and the flow that the effect changes or reads, without those in a reading."""
        named = {str(e.value) for s, e in self.symbols.items() if s != "y" and e.op == "name"}
        return {*self.nodes.values(), *named} | ({self.flow} if self.flow else set())


def _nodes(which: Iterable[str], symbol: str) -> Iterator[Place]:
    for n in which:
        yield Place(n, {symbol: name(n)}, {symbol: n})


def storing(rig: Rig) -> list[str]:
    """Return the nodes that are ends of flows and store something; a position does not."""
    ends = {e for f in rig.physics.flows.values() for e in (f.source, f.target)}
    return [n for n in rig.physics.nodes if n in ends and n not in rig.position_of.values()]


def exchanging(rig: Rig) -> list[tuple[str, str]]:
    """Return the pairs of nodes that may exchange what they hold.

    Flows link them, also through others. Or they have one unit, and their flows one unit, too: chambers
    leak."""
    nodes = storing(rig)
    flows = rig.physics.flows.values()
    pairs = {(f.source, f.target) for f in flows if f.source in nodes and f.target in nodes}
    kinds = {n: (rig.physics.nodes[n].unit, flow_unit(rig.physics, n)) for n in nodes}
    more = {
        (a, b)
        for a, b in combinations(nodes, 2)
        if b in _linked(a, pairs) or kinds[a] == kinds[b] and all(kinds[a])
    }
    return sorted(pairs | {(a, b) for a, b in more if (b, a) not in pairs})


def _linked(node: str, pairs: Collection[tuple[str, str]]) -> set[str]:
    """Return the nodes that pairs link to a node, directly or through others."""
    found, new = set[str](), {node}
    while new:
        found |= new
        new = {n for pair in pairs if found & {*pair} for n in pair} - found
    return found


def flow_unit(plant: Plant, node: str) -> str | None:
    """Return the unit of the flows at a node, None where none is stated."""
    return next((f.unit for f in plant.flows.values() if node in (f.source, f.target) and f.unit), None)


def _node_pairs(rig: Rig) -> Iterator[Place]:
    for m, n in exchanging(rig):
        yield Place(f"{m}-{n}", {"m": name(m), "n": name(n)}, {"m": m, "n": n})


def _conductances(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        read = ex.names(f.rate)
        ends = [e for e in (f.source, f.target) if e in rig.temperatures]
        if ends and read & set(rig.temperatures):
            hot = next(e for e in ends if e in read) if any(e in read for e in ends) else ends[0]
            yield Place(f.name, {"T": name(hot)}, flow=f.name)


def _pairs(rig: Rig) -> Iterator[Place]:
    linked = {frozenset((f.source, f.target)) for f in rig.physics.flows.values()}
    for a, b in combinations(rig.temperatures, 2):
        if frozenset((a, b)) not in linked:
            yield Place(f"{a}-{b}", {"TA": name(a), "TB": name(b)}, {"TA": a, "TB": b})


def _heated_pairs(rig: Rig) -> Iterator[Place]:
    for a in (a for a in rig.temperatures if heats(rig.physics, a, rig)):
        for b in rig.temperatures:
            if a != b:
                yield Place(f"{a}-{b}", {"TA": name(a), "TB": name(b)}, {"a": a, "b": b})


def heats(plant: Plant, node: str, rig: Rig) -> list[Flow]:
    """Return the flows of heat from outside into a node that inputs drive, not temperature differences.

    Temperatures may change such a flow (copper's resistance), but it is zero if the inputs are zero."""
    return [
        f
        for f in plant.flows.values()
        if f.target == node
        and f.source is None
        and not ex.calls_fmu(f.rate)
        and ex.names(f.rate) & rig.moving_inputs
        and not ex.names(f.rate) & set(rig.heat_inputs)
        and (node not in ex.names(f.rate) or _rests(plant, f))
    ]


def _rests(plant: Plant, f: Flow) -> bool:
    """Is a flow zero if all inputs are zero, at any temperatures?"""
    if any(e.op == "delay" for e in ex.walk(f.rate)):
        return False
    values = {p.name: p.value for p in plant.parameters.values()}
    values |= dict.fromkeys([*plant.inputs, "t"], 0.0)
    at = (values | dict.fromkeys(plant.nodes, temperature) for temperature in (10.0, 60.0))
    return all(float(ex.evaluate(f.rate, v)) == 0 for v in at)


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
    for f in filter(rig.is_motor, rig.physics.flows.values()):
        yield Place(f.name, {}, {"v": f.target or f.source or ""}, flow=f.name)


def driven(rig: Rig) -> Iterator[Place]:
    """Yield each input that drives a motor or a pump, named by its flow (in an FMU, by the input)."""
    for f in rig.physics.flows.values():
        if rig.is_motor(f) or rig.is_pump(f):
            for u in rig.drives_of(f):
                yield Place(u if ex.calls_fmu(f.rate) else f.name, {"u": name(u)}, flow=f.name, input=u)


def amplifiers(rig: Rig) -> Iterator[Place]:
    """Yield what amplifiers put out: the inputs that drive a motor or a pump, and what is made of set points.

    A controller makes the flow's whole rate of a set point, and its amplifier limits that."""
    for p in driven(rig):
        rate = rig.physics.flows[p.flow or ""].rate
        made = rig.physics.inputs[p.input or ""].role == "setpoint" and not ex.calls_fmu(rate)
        yield replace(p, symbols={"u": rate}) if made else p


def askable(rig: Rig, place: Place) -> bool:
    """Return whether the expression that an effect at the place would change is known.

    The rate of an FMU is a body's whole balance, not one flow: only an input in it can be changed."""
    return place.input is not None or not place.flow or not ex.calls_fmu(rig.physics.flows[place.flow].rate)


def _sensors(rig: Rig, dimension: str | None = None) -> Iterator[Place]:
    for o in rig.physics.outputs.values():
        if dimension is None or rig.kind(o) == dimension:
            yield Place(o.name, {"y": o.value}, output=o.name)
    used = [*(f.rate for f in rig.plant.flows.values()), *(o.value for o in rig.plant.outputs.values())]
    read = set().union(*map(ex.names, used))
    for i in rig.physics.inputs.values():
        if i.name in rig.moving_inputs & read and (dimension is None or rig.kind(i) == dimension):
            yield Place(i.name, {"y": name(i.name)}, input=i.name)


def _passive(rig: Rig) -> Iterator[Place]:
    """Yield sensors without driving inputs: the place `drive` is for delayed or clipped drives."""
    driving = {p.input for p in driven(rig)}
    yield from (p for p in _sensors(rig) if p.input is None or p.input not in driving)


def _in_moving_air(rig: Rig) -> Iterator[Place]:
    if rig.air in rig.moving_inputs:
        places = (*_sensors(rig, "temperature"), *displacements(rig))
        yield from (p for p in places if p.where != rig.air)


def displacements(rig: Rig) -> list[Place]:
    """Return the lengths that depend on temperatures."""
    warm = {*rig.temperatures, *rig.heat_inputs}
    return [p for p in _sensors(rig, "length") if p.output and ex.names(p.symbols["y"]) & warm]


def _lengths(rig: Rig) -> list[Place]:
    """Return the displacements; where there is none, all lengths of a rig that warms up: any may grow.

    Growth that lags is a node of its own, which a temperature drives."""
    warm = {*rig.temperatures, *rig.heat_inputs}
    driven_by = [(f.target, ex.names(f.rate)) for f in rig.physics.flows.values()]
    grown = {n for n, read in driven_by if read & warm}
    every = [p for p in _sensors(rig, "length") if p.output and not ex.names(p.symbols["y"]) & grown]
    return displacements(rig) or (every if warm else [])


def _members(rig: Rig) -> Iterator[Place]:
    """Yield the bodies whose growth a displacement lacks, not those whose growth it has with a free size."""
    free = {q for q, p in rig.plant.parameters.items() if p.range}
    for displacement in _lengths(rig):
        for node in rig.signals("T"):
            if ex.names(ex.derivative(ex.undelayed(displacement.symbols["y"]), node)) & free:
                continue
            yield Place(node, {**displacement.symbols, "T": name(node)}, output=displacement.output)


def _bending_pairs(rig: Rig) -> Iterator[Place]:
    for displacement in _lengths(rig):
        for a, b in combinations(rig.signals("T"), 2):
            symbols = {**displacement.symbols, "TA": name(a), "TB": name(b)}
            yield Place(f"{a}-{b}", symbols, output=displacement.output)


def _voltages(rig: Rig) -> Iterator[Place]:
    for o in rig.physics.outputs.values():
        if rig.kind(o) == "voltage" and not any(_sources(rig, n) for n in ex.names(o.value)):
            yield Place(o.name, {"y": o.value}, output=o.name)


def _circuits(rig: Rig) -> Iterator[Place]:
    """Yield where a voltage acts: outputs that are voltages or follow from one, nodes that are currents."""
    yield from _voltages(rig)
    yield from _nodes(rig.currents, "a")
    physics = rig.physics
    volts = {i.name for i in physics.inputs.values() if rig.kind(i) == "voltage"}
    for o in physics.outputs.values():
        if rig.kind(o) == "current" and ex.names(o.value) & (volts | _ohms(rig)):
            yield Place(o.name, {"y": o.value}, output=o.name)


def outlet(rig: Rig, f: Flow) -> tuple[Expr, Expr, float] | None:
    """Return the part of an outflow that depends on its vessel's level, the head in it, and its exponent."""
    node = rig.physics.nodes.get(f.source or "")
    if node is None or node.name in (*rig.temperatures, *rig.velocities, *rig.position_of.values()):
        return None
    values = {p.name: p.value for p in rig.physics.parameters.values()}
    for e in ex.walk(f.rate):
        if e.op == "sqrt" and node.name in ex.names(e):
            return e, e.args[0], 0.5
        if e.op == "**" and node.name in ex.names(e.args[0]) and ex.names(e.args[1]) <= values.keys():
            return e, e.args[0], float(ex.evaluate(e.args[1], values))
    head = f.rate
    while head.op in ("*", "/"):
        factors = [a for a in head.args if node.name in ex.names(a)]
        if len(factors) != 1 or (head.op == "/" and factors[0] is not head.args[0]):
            return None
        head = factors[0]
    # Only the unit distinguishes a level with a laminar outlet from any other state that decays.
    if rig.kind(node) not in ("length", "volume") or ex.names(head) & rig.physics.nodes.keys() != {node.name}:
        return None
    return head, head if head.op == "max" else ex.make("max", head, ex.num(0.0)), 1.0


def power(rig: Rig, f: Flow) -> tuple[Expr, float] | None:
    """Return the only power of states in a flow, and its exponent, if no range frees it.

    Up to that of a weir, the exponent of an outlet is physics (`orifice_exponent`)."""
    values = {p.name: p.value for p in rig.physics.parameters.values()}
    states = rig.physics.nodes.keys()
    found = {e for e in ex.walk(f.rate) if e.op == "**" and ex.names(e.args[0]) & states}
    if len(found) != 1:
        return None
    (e,) = found
    if not ex.names(e.args[1]) <= values.keys() or _free(rig, e.args[1]):
        return None
    exponent = float(ex.evaluate(e.args[1], values))
    return None if exponent <= WEIR and outlet(rig, f) else (e, exponent)


def _sources(rig: Rig, node: str) -> bool:
    return any(f.source == node and outlet(rig, f) for f in rig.physics.flows.values())


def _levels(rig: Rig) -> Iterator[Place]:
    for n in rig.physics.nodes:
        if _sources(rig, n):
            after = next((f.target for f in rig.physics.flows.values() if f.source == n and f.target), None)
            yield Place(n, {"a": name(n)}, {"a": n, **({"b": after} if after else {})})


def _orifices(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        if parts := outlet(rig, f):
            yield Place(f.name, flow=f.name, exponent=parts[2])


def _powers(rig: Rig) -> Iterator[Place]:
    for f in rig.physics.flows.values():
        if parts := power(rig, f):
            yield Place(f.name, flow=f.name, exponent=parts[1])


def _ohms(rig: Rig) -> set[str]:
    """Return the parameters that are resistances."""
    return {q for q, p in rig.physics.parameters.items() if p.unit and re.search(r"ohm", p.unit, re.I)}


def _resistive(rig: Rig) -> Iterator[Place]:
    ohms = _ohms(rig)
    for o in rig.physics.outputs.values():
        if ex.names(o.value) & ohms:
            yield Place(o.name, {}, output=o.name)
    for f in rig.physics.flows.values():
        if ex.names(f.rate) & ohms and f.target not in rig.temperatures:
            yield Place(f.name, {}, flow=f.name)


def _free(rig: Rig, e: Expr) -> bool:
    parameters = rig.physics.parameters
    return any(parameters[n].range for n in ex.names(e) & parameters.keys())


def _fixed_nodes(rig: Rig) -> Iterator[Place]:
    """Yield nodes whose storage has no free parameter, except a storage of 1: dn/dt = sum of flows."""
    storages = {n: rig.physics.nodes[n].storage for n in storing(rig)}
    yield from _nodes((n for n, e in storages.items() if e is not ex.ONE and not _free(rig, e)), "T")


def _fixed_flows(rig: Rig) -> Iterator[Place]:
    """Yield flows that depend on their own node or on a parameter, and that have no free parameter."""
    for f in rig.physics.flows.values():
        known = {f.source, f.target} & {*storing(rig)} | rig.physics.parameters.keys()
        if known & ex.names(f.rate) and not _free(rig, f.rate):
            yield Place(f.name, {}, flow=f.name)


def _free_parameters(rig: Rig) -> Iterator[Place]:
    """Yield parameters with a range that recordings share, and that a flow, storage or output reads.

    Parts of one recording have the same values."""
    names = {d.name for d in rig.drives}
    in_parts = any(d.x0 is not None for d in rig.drives)
    if len(names) + rig.earlier < 2 or len(names) < len(rig.drives) or in_parts:
        return
    p = rig.physics
    read = [n.storage for n in p.nodes.values()] + [f.rate for f in p.flows.values()]
    used = set().union(*map(ex.names, [*read, *(o.value for o in p.outputs.values())]))
    for q in p.parameters.values():
        if q.name in used and q.range and not q.per_recording:
            yield Place(q.name, {"p": name(q.name)})


# Places where an effect is an error of a reading.
ERRORS = ("sensor", "body_sensor", "passive_sensor", "recorded_input", "position_sensor")
FAULTS = (*ERRORS, "reading_in_air")  # places that a trusted reading is not (`Plant.trusts`)
PLACES = {
    "node": lambda rig: _nodes(storing(rig), "n"),
    "node_pair": _node_pairs,
    "temperature_node": lambda rig: _nodes(rig.temperatures, "T"),
    "velocity_node": lambda rig: _nodes(rig.velocities, "v"),
    "conductance": _conductances,
    "temperature_pair": _pairs,
    "heated_pair": _heated_pairs,
    "joule_flow": _joule_flows,
    "motor": _motors,
    "drive": driven,
    "amplifier": amplifiers,
    "sensor": _sensors,
    "body_sensor": lambda rig: (p for p in _sensors(rig) if p.where != rig.air),
    "passive_sensor": _passive,
    "recorded_input": lambda rig: (p for p in _sensors(rig) if p.input),
    "reading_in_air": _in_moving_air,
    "position_sensor": lambda rig: _sensors(rig, "length"),
    "displacement": _lengths,
    "member": _members,
    "bending_pair": _bending_pairs,
    "voltage_sensor": _voltages,
    "voltage": _circuits,
    "level_node": _levels,
    "orifice": _orifices,
    "resistive": _resistive,
    "fixed_node": _fixed_nodes,
    "fixed_flow": _fixed_flows,
    "power": _powers,
    "free_parameter": _free_parameters,
}
