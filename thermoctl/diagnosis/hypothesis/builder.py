"""Build a plant with an effect: apply the changes of a catalogue entry to the plant at a place."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from thermoctl.diagnosis.hypothesis.effect import UNITS_OF, Effect, EffectParameter
from thermoctl.diagnosis.hypothesis.places import ERRORS, Place, heats, outlet
from thermoctl.diagnosis.hypothesis.rig import STRAIGHT, TEMPERATURE, Rig, kind_of, zero_of
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.language import Flow, Input, Node, Output, Parameter, Plant

_form = cache(ex.parse)  # each expression of the catalogue is parsed once


@dataclass
class Placement:
    """An effect at a place, in one of its variants, with one choice of signals."""

    effect: Effect
    place: Place
    rig: Rig
    variant: int = 0
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    label: str = ""

    def own(self, parameter: str) -> str:
        """Return the name in the plant of one of the effect's parameters."""
        return f"{parameter}_{self.effect.name}_{re.sub(r'[^A-Za-z0-9_]', '_', self.place.where)}"

    def bounds(self, p: EffectParameter) -> tuple[float, float]:
        """Return the physical bounds of a parameter, from the catalogue and the recordings."""
        origin = self.rig.first_air(self.rig.drives[0]) if p.origin == "first_air" else 0.0
        unit = 1.0
        if p.of == "jump":
            physics, place = self.rig.physics, self.place
            reading = physics.outputs.get(place.output or "") or physics.inputs[place.input or ""]
            unit = self.rig.largest_jump(reading)
        return origin + unit * p.low, origin + unit * p.high


class Builder:
    """The parts of a plant while the changes of an effect are applied to them."""

    def __init__(self, c: Placement, values: Mapping[str, Any], ranges: Mapping[str, tuple[float, float]]):
        self.c, self.rig, self.base = c, c.rig, c.rig.plant
        self.inputs, self.parameters = dict(self.base.inputs), dict(self.base.parameters)
        self.nodes, self.flows, self.outputs = (
            dict(self.base.nodes),
            dict(self.base.flows),
            dict(self.base.outputs),
        )
        # Nodes that the effect adds: name in the catalogue -> name in the plant.
        self.made: dict[str, str] = {}
        self.symbols: dict[str, Expr] = {**c.place.symbols, **c.symbols}
        if self.rig.air:
            self.symbols.setdefault("air", name(self.rig.air))
        place = c.place
        o = self.base.outputs.get(place.output or "")
        # An effect of physics or of a slow sensor acts before the errors of the sensor's electronics, in
        # whichever order a search adds them.
        self.inside = o.sensed if o and o.sensed and not self._of_electronics() else None
        if self.inside and "y" in place.symbols:
            self.symbols["y"] = self.inside
        y = place.symbols.get("y")
        for symbol in self.symbols.keys() & {"T", "TA", "TB", "air"}:
            self.symbols[symbol] = self._celsius(self.symbols[symbol])
        if y is not None:
            warm = self._unit_of_y() in TEMPERATURE and self.rig.air and self.rig.air not in ex.names(y)
            air = name(self.rig.air or "")
            shift = zero_of(self._unit_of_y()) - zero_of(self._signal_unit(air))
            self.symbols["reference"] = ex.add(air, num(shift)) if warm else num(0.0)
        self.symbols["duration"] = num(self.rig.duration)
        self.symbols["sample"] = num(float(f"{self.rig.sample:.6g}"))
        for e in c.effect.parameters:
            own = c.own(e.name)
            self.symbols[e.name] = name(own)
            value = values.get(e.name, e.null)
            per = value if isinstance(value, dict) else {}
            low, high = ranges.get(e.name) or c.bounds(e)
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
        """Add an input for a recorded column that the plant does not read."""
        if signal in self.rig.spare and signal not in self.inputs:
            self.inputs[signal] = Input(signal, None, signal, False)

    def _celsius(self, e: Expr) -> Expr:
        """Return a temperature in degrees Celsius, the unit of the catalogue's expressions."""
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
        units = {of: self._signal_unit(self.symbols.get(of[-1])) for of in UNITS_OF}
        units |= {"unit_of_y": self._unit_of_y(), "unit_of_rate": rate}
        for key, unit in units.items():
            if key in text:
                if unit is None:
                    return None
                text = text.replace(key, "K" if unit in TEMPERATURE and text != key else unit)
        return re.sub(r"\b(?=[WJ]\b)", self._prefix(), text)

    def _prefix(self) -> str:
        """Return the SI prefix of the heat flows at the place ("m" for mW), or ""."""
        place = self.c.place
        flow = self.base.flows.get(place.flow or "")
        ends = {*place.nodes.values(), *((flow.source, flow.target) if flow else ())}
        units = (f.unit or "" for f in self.base.flows.values() if {f.source, f.target} & ends - {None})
        return next((u[:-1] for u in units if kind_of(u) == "power" and u.endswith("W")), "")

    def expression(self, text: str | float) -> Expr:
        """Return an expression of the catalogue with its symbols replaced by the plant's expressions."""

        def change(e: Expr) -> Expr | None:
            """Return the plant's expression for a symbol of the catalogue."""
            return self.symbols.get(e.value) if e.op == "name" else None

        return ex.substitute(_form(text), change)

    def plant(self) -> Plant:
        """Make the changes, and return the plant with the effect."""
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

    def _of_electronics(self) -> bool:
        """Is the effect an error of a reading without a state of its own?"""
        changes = self.c.effect.changes[self.c.variant]
        return self.c.effect.where in ERRORS and not any("node" in item for item in changes)

    def _put(self, new: Expr) -> None:
        p = self.c.place
        if p.output:
            o = self.outputs[p.output]
            if self.inside:
                self.outputs[p.output] = _changed(o, lambda e: new if e is self.inside else None)
            else:
                sensed = o.sensed or o.value if self._of_electronics() else None
                self.outputs[p.output] = dataclasses.replace(o, value=new, sensed=sensed)
            return

        def change(e: Expr) -> Expr | None:
            """Return the changed reading that replaces the recorded input."""
            return new if e.op == "name" and e.value == p.input else None

        # Initial states keep the input as read: their expressions can hold no node, no time and no delay.
        self.flows = {
            k: dataclasses.replace(f, rate=ex.substitute(f.rate, change)) if k in self.base.flows else f
            for k, f in self.flows.items()
        }
        self.outputs = {k: _changed(o, change) for k, o in self.outputs.items()}

    def _storage(self, form: str) -> None:
        n = self.base.nodes[next(iter(self.c.place.nodes.values()))]
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
                """Return a node's initial state, 0 for the time, and the signal for a delayed signal."""
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
        """Return the standard deviation of `source` at the start, from its nodes' standard deviations."""
        values = {q: p.value for q, p in self.base.parameters.items()}
        source = ex.substitute(source, lambda e: e.args[0] if e.op == "delay" else None)
        total = 0.0
        for n in ex.names(source) & set(self.base.nodes):
            slope = ex.derivative(source, n)
            if ex.names(slope) <= set(values):
                total += (float(ex.evaluate(slope, values)) * (self.base.nodes[n].initial_sigma or 0.0)) ** 2
        return float(np.sqrt(total)) or None

    def _straight(self, symbol: str) -> None:
        """Interpolate held inputs linearly in this symbol.

        Otherwise the lag of a sensor, which is short against a sample, would be a sample late."""

        def change(e: Expr) -> Expr | None:
            """Return the linearly interpolated copy of a held input."""
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
        for f in heats(self.rig.physics, a, self.rig):
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
        # volume a second; the factor 2 / dt brings the level back to its limit within a sample
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
        f = self.base.flows[self.c.place.flow or ""]
        parts = outlet(self.rig, f)
        assert parts is not None  # the place is an outlet
        part, head, _ = parts
        new = ex.make("**", head, name(self.c.own(parameter)))
        rate = ex.substitute(f.rate, lambda e: new if e is part else None)
        self.flows[f.name] = dataclasses.replace(f, rate=rate, unit=None)

    def _resistance(self, form: str) -> None:
        ohms = [q for q, p in self.base.parameters.items() if p.unit and re.search(r"ohm", p.unit, re.I)]

        def change(e: Expr) -> Expr | None:
            """Return the changed expression of a resistance."""
            if e.op == "name" and e.value in ohms:
                self.symbols["R"] = e
                return self.expression(form)
            return None

        p = self.c.place
        if p.output:
            self.outputs[p.output] = _changed(self.base.outputs[p.output], change)
        elif p.flow:
            f = self.base.flows[p.flow]
            self.flows[p.flow] = dataclasses.replace(f, rate=ex.substitute(f.rate, change))


def _changed(o: Output, change: Callable[[Expr], Expr | None]) -> Output:
    """Return an output after a substitution in its value and in the value that its sensor reads."""
    sensed = ex.substitute(o.sensed, change) if o.sensed else None
    return dataclasses.replace(o, value=ex.substitute(o.value, change), sensed=sensed)
