"""The signals that a law may depend on, and the places where it may act."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermoctl.diagnosis.hypothesis.places import exchanging, storing
from thermoctl.diagnosis.hypothesis.rig import TEMPERATURE, Rig, zero_of
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.language import Flow, Plant
from thermoctl.units import conversion, dimension

FOLLOWS = 0.9  # share of a column's variance that a node or an output shows, above which it may be a reading
ALIKE = 1 - 1e-6  # correlation about zero from which two signals are one
HOME = 0.1  # share of a position's range up to which its zero is near
DRAWS = 5  # number of values of all names for which two rates are compared
QUANTILES = 21  # number of quantiles of a signal, 5 % apart

Values = Mapping[str, np.ndarray | float]


@dataclass(frozen=True)
class Place:
    """Where a law acts.

    - flow: into the node `target` from outside, or from the node `source`
    - storage: of the node `target`
    - conversion: several flows of the plant file that are always in proportion, `of`. For each unit into
      the target a share, an expression of parameters, goes into other nodes: `shares`
    - parameter: one in several flows, `of`. It changes each of the nodes by its share for each unit
    - reading: added to the output `target`"""

    target: str
    source: str | None = None
    part: str = "flow"
    of: tuple[str, ...] = ()
    shares: tuple[tuple[str, Expr], ...] = ()

    @property
    def where(self) -> str:
        """Return its name in a result."""
        if self.part == "storage":
            return f"storage of {self.target}"
        if self.of:
            return " and ".join(self.of)
        return f"{self.source}-{self.target}" if self.source else self.target

    @property
    def nodes(self) -> tuple[str, ...]:
        """Return the nodes that it changes."""
        return tuple(n for n, _ in reversed(self.ends))

    @property
    def ends(self) -> tuple[tuple[str, Expr], ...]:
        """Return the nodes that it changes, the target first, each with its share of the flow."""
        if self.part in ("parameter", "reading"):
            return self.shares
        source = ((self.source, num(-1.0)),) if self.source else ()
        return ((self.target, ex.ONE), *source, *self.shares)


@dataclass(frozen=True)
class Signal:
    """A signal of the plant: an expression, its unit, its typical size.

    `visited`: its evenly spaced quantiles, as (value - centre) / size. `drives`: is it a difference or a
    velocity that drives the flow at its place, so that the flow reverses with it? `daily`: is it the time of
    day? Its size then is a day. `reading`: is it what a sensor reads, whose error the law is?"""

    label: str
    value: Expr
    unit: str | None
    size: float = 1.0
    centre: float = 0.0
    visited: tuple[float, ...] = (-1.0, 1.0)
    kelvin: float | None = None  # offset to kelvins; None: no absolute temperature
    position: bool = False
    drives: bool = False
    recorded: bool = False
    daily: bool = False
    reading: bool = False

    def along(self, run: Values, t: np.ndarray) -> np.ndarray:
        """Return its values (N,) along a trajectory."""
        values = ex.series(self.value, run, t)
        return values % self.size if self.daily else values


def places(rig: Rig) -> list[Place]:
    """Return the places of laws: flows into and between nodes, storages, conversions, parameters, readings.

    A storage of 1 is a definition: dn/dt is the sum of the flows. A reading that is trusted has no law."""
    nodes = storing(rig)
    stored = [Place(n, None, "storage") for n in nodes if rig.physics.nodes[n].storage is not ex.ONE]
    joined = conversions(rig.physics, nodes)
    flows = [*map(Place, nodes), *(Place(b, a) for a, b in exchanging(rig))]
    read = [Place(o, None, "reading") for o in rig.physics.outputs if not rig.plant.trusts(o)]
    return [*flows, *stored, *joined, *shared(rig.physics, nodes, joined), *read]


def shared(plant: Plant, nodes: Sequence[str], joined: Sequence[Place]) -> list[Place]:
    """Return the free parameters in several flows, each of which it changes in proportion, as places.

    A brake's friction slows the wheel and heats the disc: if it depends on the temperature, both change.
    `joined`: conversions; a parameter of one of them is none."""
    fixed = {*(n.storage for n in plant.nodes.values()), *(o.value for o in plant.outputs.values())}
    out = list[Place]()
    for q in (q for q, p in plant.parameters.items() if p.range):
        flows = [f for f in plant.flows.values() if q in ex.names(f.rate)]
        known = len(flows) < 2 or any({f.name for f in flows} <= {*p.of} for p in joined)
        if known or any(q in ex.names(e) for e in fixed) or any(map(_is_closed, flows)):
            continue
        shares = dict[str, Expr]()
        for f in flows:
            slope = ex.derivative(f.rate, q)
            for n, share in ((f.source, ex.neg(slope)), (f.target, slope)):
                if n:
                    shares[n] = ex.add(shares.get(n, ex.ZERO), share)
        if shares.keys() <= {*nodes} and not any(q in ex.names(e) for e in shares.values()):
            out.append(Place(next(iter(shares)), None, "parameter", (q,), tuple(shares.items())))
    return out


def _is_closed(f: Flow) -> bool:
    """Return whether the slope of a flow by a parameter is unknown: an FMU's, or that of a delay."""
    return ex.calls_fmu(f.rate) or any(e.op == "delay" for e in ex.walk(f.rate))


def conversions(plant: Plant, nodes: Sequence[str]) -> list[Place]:
    """Return the flows into and out of some nodes that are always in proportion, as places.

    Prey that is eaten and predators that grow are two flows of one rate. So are water that evaporates and
    the heat that it takes. The factor is a parameter, one over it, or a number."""
    able = [
        f
        for f in plant.flows.values()
        if {f.source, f.target} - {None} <= {*nodes} and not ex.calls_fmu(f.rate)
    ]
    out, taken = list[Place](), set[str]()
    for first in sorted(able, key=lambda f: f.target is None):
        if first.name in taken:
            continue
        joined, shares = [first.name], dict[str, Expr]()
        for f in able:
            factor = None if f is first or f.name in taken else _factor(plant, first.rate, f.rate)
            if factor is None or {f.source, f.target} & {first.source, first.target, *shares} - {None}:
                continue
            joined.append(f.name)
            shares |= {n: q for n, q in ((f.source, ex.neg(factor)), (f.target, factor)) if n}
        if shares:
            if first.target is None:
                shares = {n: ex.neg(q) for n, q in shares.items()}
            target = first.target or str(first.source)
            source = first.source if first.target else None
            out.append(Place(target, source, "flow", tuple(joined), tuple(shares.items())))
            taken |= {*joined}
    return out


def _factor(plant: Plant, a: Expr, b: Expr) -> Expr | None:
    """Return b / a if it is a parameter, one over a parameter, or a number for all values; else None."""
    read = sorted(ex.names(a) | ex.names(b))
    drawn = np.random.default_rng(0).uniform(0.5, 2.0, (len(read), DRAWS))
    values = dict(zip(read, drawn, strict=True))
    try:
        each = [[ex.evaluate(e, dict(zip(read, v, strict=True))) for v in drawn.T] for e in (a, b)]
    except ex.ExpressionError:
        return None  # it reads a delay
    with np.errstate(all="ignore"):
        ratio = np.divide(each[1], each[0])
    if not np.all(np.isfinite(ratio) & (ratio != 0)):
        return None
    own = {q: v for q, v in values.items() if q in plant.parameters}
    known = [(num(float(ratio.flat[0])), ratio.flat[0])]
    known += [(name(q), v) for q, v in own.items()] + [
        (ex.div(ex.ONE, name(q)), 1 / v) for q, v in own.items()
    ]
    return next((e for e, v in known if np.allclose(ratio, v, 1e-9, 0.0)), None)


def signals(rig: Rig, place: Place, runs: Sequence[Values]) -> list[Signal]:
    """Return the signals that a law at a place may depend on, each with its typical size over the runs.

    The error of a reading depends on what is read. A storage depends on states, not on inputs."""
    p, out = rig.physics, []
    if place.part == "reading":
        o = p.outputs[place.target]
        own = Signal(o.name, o.sensed or o.value, "K" if o.unit in TEMPERATURE else o.unit, reading=True)
        return [s for s in [_sized(own, runs)] if s]
    near = [*place.nodes, *(rig.pairs[n] for n in place.nodes if n in rig.pairs)]
    for n in near:
        out += [_between(rig, place, n, i) for i in _beside(rig, n)]
        out.append(_absolute(rig, place, n, p.nodes[n].unit))
    out += _across(rig, place)
    for n in (n for n in p.nodes if n not in near):
        out.append(_absolute(rig, place, n, p.nodes[n].unit))
        linked = any({n, place.target} == {f.source, f.target} for f in p.flows.values())
        if linked and not place.source and p.nodes[n].unit == p.nodes[place.target].unit:
            out.append(_between(rig, place, place.target, n))
    clocks = {i for i, q in p.inputs.items() if q.role == "time_of_day"}
    for i in sorted(rig.moving_inputs - clocks):
        if not i.endswith("_start"):
            out.append(_absolute(rig, place, i, p.inputs[i].unit))
    out += [Signal(c, name(c), None, recorded=True) for c in rig.spare if not _follows(c, p, runs)]
    sized = [_sized(s, runs) for s in out] + [_daily(i, p.inputs[i].unit, runs) for i in sorted(clocks)]
    barred = {*p.inputs} if place.part == "storage" else set[str]()
    return [s for s in sized if s is not None and not ex.names(s.value) & barred]


def rates(plant: Plant, place: Place, runs: Sequence[Values], beside: Sequence[Signal]) -> list[Signal]:
    """Return the plant file's flows at a place that no signal `beside` them is in proportion to.

    As factors of a law: inhibition, fouling and wear change a flow that the plant has."""
    if place.part != "flow":
        return []
    ends = {place.target, place.source} - {None}
    known = [_values(s.value, runs) for s in beside]

    def alike(rate: Expr) -> bool:
        """Return whether a known signal is in proportion to a flow."""
        v = _values(rate, runs)
        return any(abs(v @ w) > ALIKE * np.linalg.norm(v) * np.linalg.norm(w) for w in known)

    at = [f for f in plant.flows.values() if ends <= {f.source, f.target} and not ex.calls_fmu(f.rate)]
    sized = [_sized(Signal(f.name, f.rate, f.unit), runs) for f in at if not alike(f.rate)]
    return [s for s in sized if s is not None]


def _follows(column: str, p: Plant, runs: Sequence[Values]) -> bool:
    """Return whether an unread column follows a node or an output, so that it may be a reading of it.

    A law of such a column would lead the plant to its own recording."""
    read = [*map(name, (column, *p.nodes)), *(o.value for o in p.outputs.values())]
    values = [_values(e, runs) for e in read]
    with np.errstate(all="ignore"):
        alike = np.corrcoef(values)[0, 1:] ** 2
    return bool(np.any(alike > FOLLOWS))


def _beside(rig: Rig, n: str) -> list[str]:
    """Return the inputs from which the distance of a node may drive a flow: its unit, in no flow of it.

    For a body, the recorded temperatures: the ambient, those of its flows, and others that move."""
    rates = [ex.names(f.rate) for f in rig.physics.flows.values() if n in (f.source, f.target)]
    if n not in rig.temperatures:
        unit, inputs = rig.physics.nodes[n].unit, rig.physics.inputs
        others = rig.moving_inputs - set().union(*rates)
        return sorted(i for i in others if unit and inputs[i].unit == unit)
    exchanged = {i for read in rates if n in read for i in read & {*rig.heat_inputs}}
    moving = rig.moving_inputs & {*rig.heat_inputs}
    return sorted(moving | exchanged | ({rig.air} if rig.air else set()), key=lambda i: (i != rig.air, i))


def _absolute(rig: Rig, place: Place, n: str, unit: str | None) -> Signal:
    """Return a node or an input as a signal."""
    if unit in TEMPERATURE:
        return Signal(n, name(n), "K", kelvin=273.15 - zero_of(unit))
    own = n in place.nodes and n in rig.velocities and not place.source and place.part == "flow"
    is_position = n in rig.pairs.values()
    return Signal(n, name(n), unit, position=is_position, drives=own, recorded=n in rig.physics.inputs)


def _across(rig: Rig, place: Place) -> list[Signal]:
    """Return the differences between the ends of a flow: nodes, positions, fourth powers of temperatures."""
    nodes, out = rig.physics.nodes, list[Signal]()
    ends = [place.source or "", place.target]
    for a, b in (ends, [rig.pairs.get(n, "") for n in ends]):
        if a and b and nodes[a].unit == nodes[b].unit:
            out.append(_between(rig, place, a, b))
            if (unit := nodes[a].unit) in TEMPERATURE:
                fourth = [ex.power(ex.add(name(n), num(273.15 - zero_of(unit))), num(4.0)) for n in (a, b)]
                radiated = ex.add(fourth[0], ex.neg(fourth[1]))
                out.append(Signal(f"{a}^4 - {b}^4", radiated, "K**4", drives=place.part == "flow"))
    return out


def _between(rig: Rig, place: Place, a: str, b: str) -> Signal:
    """Return the difference of two nodes as a signal."""
    unit = rig.physics.nodes[a].unit
    difference = ex.add(name(a), ex.neg(name(b)))
    return Signal(f"{a} - {b}", difference, "K" if unit in TEMPERATURE else unit, drives=place.part == "flow")


def _daily(clock: str, unit: str | None, runs: Sequence[Values]) -> Signal | None:
    """Return the time of day as a signal; None where the runs do not visit each of its hours."""
    if unit is None or dimension(unit) != dimension("s"):
        return None
    day = conversion("day", unit)[0]
    hours = np.floor(24 * np.concatenate([np.atleast_1d(run[clock]) for run in runs]) / day) % 24
    return Signal(clock, name(clock), unit, day, daily=True) if len(np.unique(hours)) == 24 else None


def _values(e: Expr, runs: Sequence[Values]) -> np.ndarray:
    """Return the values of an expression along all runs, one after another."""
    return np.concatenate([ex.series(e, run, np.atleast_1d(run["t"])) for run in runs])


def _sized(s: Signal, runs: Sequence[Values]) -> Signal | None:
    values = _values(s.value, runs)
    reach = HOME * float(np.ptp(values))  # a position counts from its zero where it comes near it
    away = s.position and not values.min() - reach < 0 < values.max() + reach
    centre = float(np.mean(values)) if s.kelvin is not None or s.reading or away else 0.0
    size = float(np.sqrt(np.mean((values - centre) ** 2)))
    if not np.isfinite(size) or float(np.ptp(values)) <= 1e-9 * max(size, 1e-300):
        return None
    size, centre = float(f"{size:.3g}"), float(f"{centre:.4g}")
    visited = (np.quantile(values, np.linspace(0, 1, QUANTILES)) - centre) / size
    return replace(s, size=size, centre=centre, visited=tuple(visited.tolist()))
