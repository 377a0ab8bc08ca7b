"""An effect at a place, and the plant with it: the changes of a catalogue entry are applied to the plant."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from thermoctl.diagnosis.hypothesis.effect import UNITS_OF, Effect, EffectParameter
from thermoctl.diagnosis.hypothesis.places import ERRORS, Place, heats, outlet, power
from thermoctl.diagnosis.hypothesis.rig import STRAIGHT, TEMPERATURE, Rig, kind_of, zero_of
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.plant.fitting.residuals import Prior
from thermoctl.plant.language import Flow, Input, Node, Output, Parameter, Plant
from thermoctl.units import without_brackets

_form = cache(ex.parse)  # each expression of the catalogue is parsed once
LONGEST = 78  # characters of a node's name

TINY = 1e-9  # least size of a state that is raised to a power below zero


@dataclass
class Candidate:
    """An effect at a place, in one of its variants, with one choice of the signals that it needs.

    `symbols`: these signals. `label`: of variant, choice and clock. `begins`: by recording, when it begins on
    the effect's clock, s ("" is any other one); empty where that clock begins with each."""

    effect: Effect
    place: Place
    rig: Rig
    variant: int = 0
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    label: str = ""
    begins: Mapping[str, float] = field(default_factory=dict)
    clocks: int = 1  # number of clocks that the effect may have in these recordings

    @property
    def key(self) -> tuple[str, str]:
        """Return (effect, place), the names in the result."""
        return self.effect.name, self.place.where

    @property
    def shared(self) -> bool:
        """Return whether it is the same in every recording."""
        return not self.begins and not any(p.per_recording for p in self.effect.parameters)

    @property
    def in_plant(self) -> str:
        """Return effect and place as one name, another one where the plant holds such an effect already."""
        label = f"{self.effect.name}_{re.sub(r'[^A-Za-z0-9_]', '_', self.place.where)}"
        while any(f"{p.name}_{label}" in self.rig.plant.parameters for p in self.effect.parameters):
            label += "_2"
        return label

    def own(self, parameter: str) -> str:
        """Return the name in the plant of one of the effect's parameters, or of a node that it adds."""
        return f"{parameter}_{self.in_plant}"

    def own_in(self, plant: Plant) -> dict[str, str]:
        """Return the names of those parameters of the effect that the plant has, by parameter."""
        own = {p.name: self.own(p.name) for p in self.effect.parameters}
        return {p: q for p, q in own.items() if q in plant.parameters}

    @property
    def reading(self) -> Output | Input | None:
        """Return the output or recorded input at the place, None where it is none."""
        plant, place = self.rig.plant, self.place
        return plant.outputs.get(place.output or "") or plant.inputs.get(place.input or "")

    def bounds(self, p: EffectParameter) -> tuple[float, float]:
        """Return the physical bounds of a parameter, from the catalogue and the recordings."""
        origin = self.rig.first_air(self.rig.drives[0]) if p.origin == "first_air" else 0.0
        unit = self.rig.largest_jump(self.reading) if p.of == "jump" and self.reading else 1.0
        return origin + unit * p.low, origin + unit * p.high

    @property
    def jumps(self) -> bool:
        """Does the reading depend on held inputs, which change in steps?"""
        y, inputs = self.place.symbols.get("y"), self.rig.plant.inputs
        return y is not None and any(
            i in self.rig.moving_inputs and not inputs[i].linear for i in ex.names(y)
        )

    def beliefs(self, plant: Plant) -> list[Prior]:
        """Return the priors of the effect's parameters in `plant`, for each recording."""
        if self.effect.prior is None:
            return []
        # a parameter that all recordings share has one prior, of which each recording gets an equal part
        share = 1.0 if any(p.per_recording for p in self.effect.parameters) else 1.0 / len(self.rig.drives)
        known, out = {p: name(q) for p, q in self.own_in(plant).items()}, []
        for d in self.rig.drives:
            recorded = {"duration": num(float(d.t[-1] - d.t[0])), "first_air": num(self.rig.first_air(d))}
            prior = ex.fill(self.effect.prior, {**recorded, **known})
            out.append(Prior(d.name, ex.mul(num(share), prior)))
        return out

    def extend(
        self, values: Mapping[str, float], ranges: Mapping[str, tuple[float, float]] | None = None
    ) -> Plant:
        """Return the plant with the effect. `values`, `ranges`: by parameter of the effect."""
        return _Builder(self, values, ranges or {}).plant()


class _Builder:
    """The parts of a plant while the changes of an effect are applied to them.

    - `base`: the plant without the effect
    - `symbols`: by symbol of the catalogue's expressions, the plant's expression
    - `made`: by name in the catalogue, the name of each node that the effect adds
    - `inside`: the value that the sensor reads, if the effect acts there. An effect of physics or of a slow
      sensor acts before the errors of the sensor's electronics, in whichever order a search adds them"""

    def __init__(self, c: Candidate, values: Mapping[str, float], ranges: Mapping[str, tuple[float, float]]):
        self.c, self.place, self.rig, self.base = c, c.place, c.rig, c.rig.plant
        self.inputs, self.parameters = dict(self.base.inputs), dict(self.base.parameters)
        self.nodes, self.flows = dict(self.base.nodes), dict(self.base.flows)
        self.outputs, self.made = dict(self.base.outputs), dict[str, str]()
        output = self.base.outputs.get(c.place.output or "")
        self.inside = output.sensed if output and not self._of_electronics() else None
        self.symbols = self._symbols()
        for p in c.effect.parameters:
            value, span = values.get(p.name, p.null), ranges.get(p.name) or c.bounds(p)
            self.parameters[c.own(p.name)] = self._own_parameter(p, float(value), *span)
            self.symbols[p.name] = name(c.own(p.name))
        for e in (*c.symbols.values(), *c.place.symbols.values()):
            for column in ex.names(e) & {*self.rig.spare}:
                self.inputs.setdefault(column, Input(column, None, column, self.rig.is_smooth(column)))

    def _of_electronics(self) -> bool:
        """Is the effect an error of a reading without a state of its own?"""
        changes = self.c.effect.changes[self.c.variant]
        return self.c.effect.where in ERRORS and not any("node" in item for item in changes)

    def _symbols(self) -> dict[str, Expr]:
        """Return the expressions of the place and of the recordings. Temperatures are in degrees Celsius."""
        air, y = self.rig.air, self.place.symbols.get("y")
        symbols: dict[str, Expr] = {**self.place.symbols, **self.c.symbols}
        if air:
            symbols.setdefault("air", name(air))
        if self.inside and y:
            symbols["y"] = self.inside
        for symbol in symbols.keys() & {"T", "TA", "TB", "air"}:
            e = symbols[symbol]
            symbols[symbol] = ex.add(e, num(-zero_of(self._unit_of(e))))
        if y:
            symbols["reference"] = num(0.0)
            unit = self._unit_of_y()
            if air and unit in TEMPERATURE and air not in ex.names(y):
                shift = zero_of(unit) - zero_of(self._unit_of(name(air)))
                symbols["reference"] = ex.add(name(air), num(shift))
        symbols["duration"] = num(self.rig.duration)
        # a parameter, since a bare number of 1 s would vanish from a product, and its unit with it
        sample = Parameter(self.c.own("sample"), float(f"{self.rig.sample:.6g}"), "s")
        self.parameters[sample.name], symbols["sample"] = sample, name(sample.name)
        if begins := self.c.begins:
            values = {r: v for r, v in begins.items() if r}
            begin = Parameter(self.c.own("begin"), begins[""], "s", None, True, values)
            self.parameters[begin.name], symbols["t"] = begin, ex.add(name("t"), name(begin.name))
        return symbols

    def _own_parameter(self, p: EffectParameter, value: float, low: float, high: float) -> Parameter:
        limits = (low, high) if np.isfinite(low) and np.isfinite(high) and low < high else None
        if limits:
            value = min(max(value, low), high)
        first = (self.rig.drives[0].name,) if p.from_first and not self.rig.earlier else ()
        null = dict.fromkeys(first, p.null)
        own = Parameter(self.c.own(p.name), value, self._unit(p.unit), limits, p.per_recording, null)
        return dataclasses.replace(own, known=first)

    def _unit_of_y(self) -> str | None:
        reading = self.c.reading
        return reading.unit if reading else None

    def _unit_of(self, e: Expr | None) -> str | None:
        """Return the unit of a node, an input or a parameter; None for any other expression."""
        if e is None or e.op != "name":
            return None
        for table in (self.base.nodes, self.base.inputs, self.base.parameters):
            if e.value in table:
                return table[e.value].unit
        return None

    def _unit(self, text: str | None) -> str | None:
        """Return the unit of a parameter; None where the plant does not state a unit that it depends on."""
        if text is None or not self.c.effect.where:  # a law states the units of this plant
            return text
        node = self.place.nodes.get("v") or self.place.nodes.get("a")
        flows = (f for f in self.base.flows.values() if node and node in (f.source, f.target))
        rate = next((f.unit for f in flows if f.unit), None)
        units = {of: self._unit_of(self.symbols.get(of[-1])) for of in UNITS_OF}
        units |= {"unit_of_y": self._unit_of_y() or rate, "unit_of_rate": rate}
        if self.place.flow and self.symbols.get("u") is self._changed_flow.rate:
            units["unit_of_u"] = self._changed_flow.unit
        for key, unit in units.items():
            if key in text:
                if unit is None:
                    return None
                text = text.replace(key, "K" if unit in TEMPERATURE and text != key else unit)
        return without_brackets(self._in_heat(text))

    def _in_heat(self, text: str) -> str:
        """Return a unit with W and J as the heat flows at the place have them: mW and mJ, W/m^2 and J/m^2."""
        flow = self.base.flows.get(self.place.flow or "")
        ends = {*self.place.nodes.values(), *((flow.source, flow.target) if flow else ())}
        units = [f.unit for f in self.base.flows.values() if f.unit and {f.source, f.target} & ends - {None}]
        if heat := next((u for u in units if kind_of(u) == "power" and u.endswith("W")), None):
            return re.sub(r"\b(?=[WJ]\b)", heat[:-1], text)
        if not units or kind_of(units[0]) == "power":
            return text
        return re.sub(r"\bJ\b", f"({units[0]}) * s", re.sub(r"\bW\b", f"({units[0]})", text))

    def expression(self, text: str | float) -> Expr:
        """Return an expression of the catalogue with its symbols replaced by the plant's expressions."""
        return ex.fill(_form(text), self.symbols)

    def plant(self) -> Plant:
        """Make the changes, and return the plant with the effect and the parameters that it uses."""
        for item in self.c.effect.changes[self.c.variant]:
            ((kind, what),) = item.items()
            getattr(self, f"_{kind}")(what)
        used = set[str]().union(
            *(ex.names(n.storage) | ex.names(n.initial) for n in self.nodes.values()),
            *(ex.names(f.rate) for f in self.flows.values()),
            *(ex.names(o.value) for o in self.outputs.values()),
        )
        return dataclasses.replace(
            self.base,
            inputs=self.inputs,
            parameters={k: p for k, p in self.parameters.items() if k in used},
            nodes=self.nodes,
            flows=self.flows,
            outputs=self.outputs,
        )

    # A method for each kind of change, `_` and its key in an effect file (docs/reference/effect-files.md).

    def _flow(self, what: Mapping[str, Any]) -> None:
        ends = {**self.made, **self.place.nodes}
        source, target = ends.get(what.get("from", "")), ends.get(what.get("into", ""))
        self._new_flow(self.c.in_plant, self.expression(what["rate"]), source, target, None)

    def _new_flow(
        self, label: str, rate: Expr, source: str | None, target: str | None, unit: str | None
    ) -> None:
        while label in self.flows or label in self.nodes or label in self.outputs:
            label += "_2"
        self.flows[label] = Flow(label, rate, source, target, unit)

    def _rate(self, form: str) -> None:
        f = self._changed_flow
        self.symbols["rate"] = f.rate
        self.flows[f.name] = dataclasses.replace(f, rate=self.expression(form))

    @property
    def _changed_flow(self) -> Flow:
        return self.base.flows[self.place.flow or ""]

    def _value(self, form: str) -> None:
        """Change what is read: an output, or a recorded input wherever a flow or an output reads it.

        Initial states keep the input as read: their expressions can hold no node, no time and no delay."""
        new, output = self.expression(form), self.place.output
        if output and self.inside:
            o = self.outputs[output]
            self.outputs[output] = _changed(
                o, lambda e: ex.substitute(e, lambda part: new if part is self.inside else None)
            )
        elif output:
            o = self.outputs[output]
            sensed = o.sensed or o.value if self._of_electronics() else None
            self.outputs[output] = dataclasses.replace(o, value=new, sensed=sensed)
        else:
            swap = {self.place.input or "": new}
            for f in self.base.flows.values():
                self.flows[f.name] = dataclasses.replace(
                    self.flows[f.name], rate=ex.fill(self.flows[f.name].rate, swap)
                )
            self.outputs = {k: _changed(o, lambda e: ex.fill(e, swap)) for k, o in self.outputs.items()}

    def _voltage(self, form: str) -> None:
        """Add a voltage to a reading, or take it from what drives the current of a node."""
        if self.place.output:
            self._value(f"y + {form}")
        else:
            self._new_flow(self.c.in_plant, self.expression(form), self.place.nodes["a"], None, None)

    def _storage(self, form: str) -> None:
        n = self.base.nodes[next(iter(self.place.nodes.values()))]
        self.symbols["storage"] = n.storage
        self.nodes[n.name] = dataclasses.replace(n, storage=self.expression(form))

    def _parameter(self, form: str) -> None:
        """Change a parameter wherever a storage, a flow or an output reads it."""
        swap = {self.place.where: self.expression(form)}
        self.nodes = {
            k: dataclasses.replace(n, storage=ex.fill(n.storage, swap)) for k, n in self.nodes.items()
        }
        self.flows = {k: dataclasses.replace(f, rate=ex.fill(f.rate, swap)) for k, f in self.flows.items()}
        self.outputs = {k: _changed(o, lambda e: ex.fill(e, swap)) for k, o in self.outputs.items()}

    def _node(self, what: Mapping[str, Any]) -> None:
        label = self.c.own(what["name"])[:LONGEST]
        self.made[what["name"]] = label
        self.symbols[what["name"]] = name(label)
        text, spread = str(what["initial"]), what.get("initial_sigma")
        if text.startswith("start_of_"):
            signal = ex.undelayed(self.symbols[text[-1]])
            starts = {n.name: n.initial for n in self.base.nodes.values()}
            initial = ex.fill(signal, {**starts, "t": num(0.0)})
            spread = spread or self._spread_at_start(signal)
        else:
            initial = self.symbols["air"] if text == "first_air" else self.expression(text)
        storage, unit = self.expression(what["storage"]), self._unit(what.get("unit"))
        self.nodes[label] = Node(label, storage, initial, unit, spread)

    def _spread_at_start(self, signal: Expr) -> float | None:
        """Return the standard deviation of a signal at the start, from its nodes' standard deviations."""
        values = {q: p.value for q, p in self.base.parameters.items()}
        total = 0.0
        for n in ex.names(signal) & set(self.base.nodes):
            slope = ex.derivative(signal, n)
            if ex.names(slope) <= set(values):
                total += (float(ex.evaluate(slope, values)) * (self.base.nodes[n].initial_sigma or 0.0)) ** 2
        return float(np.sqrt(total)) or None

    def _recorded(self, symbol: str) -> None:
        """Change nothing: the symbol is a recorded input, which is known ahead (`candidates`)."""

    def _straight(self, symbol: str) -> None:
        """Interpolate held inputs linearly in this symbol.

        Otherwise the lag of a sensor, which is short against a sample, would be a sample late."""
        e, twins = self.symbols[symbol], dict[str, Expr]()
        for i in self.base.inputs.values():
            if i.name in ex.names(e) and not i.linear:
                twin = f"{i.name}{STRAIGHT}"
                self.inputs[twin] = dataclasses.replace(i, name=twin, column=i.column or i.name, linear=True)
                twins[i.name] = name(twin)
        self.symbols[symbol] = ex.fill(e, twins)

    def _split(self, what: Mapping[str, Any]) -> None:
        """Lead a share of the heat into a node to another one."""
        share = name(self.c.own(what["share"]))
        a, b = self.place.nodes["a"], self.place.nodes["b"]
        for f in heats(self.rig.physics, a, self.rig):
            self.flows[f.name] = dataclasses.replace(f, rate=ex.mul(f.rate, ex.add(ex.ONE, ex.neg(share))))
            self._new_flow(f"{f.name}_to_{b}", ex.mul(f.rate, share), None, b, f.unit)

    def _drive(self, form: str) -> None:
        f, new = self._changed_flow, self.expression(form)
        rate = new if self.symbols["u"] is f.rate else ex.fill(f.rate, {self.place.input or "": new})
        self.flows[f.name] = dataclasses.replace(f, rate=rate)

    def _spill(self, what: Mapping[str, Any]) -> None:
        """Let what is above a level flow over: a share into the next node, if there is one, the rest out.

        The factor 2 / sample brings the level back to its limit within a sample."""
        a, b = self.place.nodes["a"], self.place.nodes.get("b")
        over = self.expression(f"2 * max(a - {what['level']}, 0) / sample")
        over = ex.mul(over, self.base.nodes[a].storage)  # volume a second
        unit = next((f.unit for f in self.base.flows.values() if f.source == a), None)
        if b:
            share = name(self.c.own(what["share"]))
            self._new_flow(f"spill_{a}_{b}", ex.mul(over, share), a, b, unit)
            over = ex.mul(over, ex.add(ex.ONE, ex.neg(share)))
        self._new_flow(f"spill_{a}_out", over, a, None, unit)

    def _exponent(self, parameter: str) -> None:
        """Change the exponent n of a power, or of an outlet's head.

        x**n abs(x)**(N - n) has the sign of x**n."""
        f, own = self._changed_flow, name(self.c.own(parameter))
        if found := power(self.rig, f):
            part, n = found
            size = ex.make("max", ex.make("abs", part.args[0]), ex.num(TINY))
            new = ex.mul(part, ex.make("**", size, ex.add(own, ex.num(-n))))
        else:
            parts = outlet(self.rig, f)
            assert parts is not None  # the place is a power or an outlet
            part, new = parts[0], ex.make("**", parts[1], own)
        rate = ex.substitute(f.rate, lambda e: new if e is part else None)
        self.flows[f.name] = dataclasses.replace(f, rate=rate, unit=None)

    def _resistance(self, form: str) -> None:
        """Change each resistance in an output or a flow; R is the symbol of each in turn."""
        ohms = [q for q, p in self.base.parameters.items() if p.unit and re.search(r"ohm", p.unit, re.I)]
        changed = {q: ex.fill(_form(form), {**self.symbols, "R": name(q)}) for q in ohms}
        if output := self.place.output:
            self.outputs[output] = _changed(self.base.outputs[output], lambda e: ex.fill(e, changed))
        else:
            f = self._changed_flow
            self.flows[f.name] = dataclasses.replace(f, rate=ex.fill(f.rate, changed))


def _changed(o: Output, change: Callable[[Expr], Expr]) -> Output:
    """Return an output with its value, and the value that its sensor reads, changed."""
    return dataclasses.replace(o, value=change(o.value), sensed=change(o.sensed) if o.sensed else None)
