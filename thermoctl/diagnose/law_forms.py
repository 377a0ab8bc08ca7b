"""The library of laws: forms (config/laws.yaml) over signals at a place, written in the plant language.

A term is one form over one or two signals. A signal is divided by its typical size Z, a known parameter
with the signal's unit. So the size A of a term has the unit of the flow."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from thermoctl import yamlfile
from thermoctl.diagnose.catalogue import Effect, EffectParameter
from thermoctl.diagnose.rig import TEMPERATURE, zero_of
from thermoctl.diagnose.roles import Structure
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num
from thermoctl.shipped import shipped

TOTAL = "total"  # a memory that keeps all: an integral

Values = Mapping[str, np.ndarray | float]


@dataclass(frozen=True)
class Shape:
    """A parameter of a form beside its size: values to try first, range, unit.

    `of` 'duration': the values are shares of the longest run."""

    values: tuple[float, ...]
    range: tuple[float, float]
    unit: str | None = None
    of: str | None = None


@dataclass(frozen=True)
class Form:
    """One form of the library."""

    name: str
    text: Expr
    of: str
    sizes: tuple[str, ...]
    shapes: Mapping[str, Shape]
    memory: str | None
    odd: bool  # reverses with its signal


@cache
def library() -> tuple[Form, ...]:
    """Return the forms of config/laws.yaml. Raises InputError."""
    root, out = yamlfile.load(shipped("config") / "laws.yaml"), []
    for key, node in root.value.items():
        p: dict[str, Any] = node.plain()
        try:
            text = ex.parse(p["text"])
        except ex.ExpressionError as e:
            raise node.error(str(e)) from None
        shapes = {
            k: Shape(
                tuple(map(float, s["values"])),
                (float(s["range"][0]), float(s["range"][1])),
                s.get("unit"),
                s.get("of"),
            )
            for k, s in p.get("shapes", {}).items()
        }
        out.append(
            Form(
                key,
                text,
                p.get("of", "any"),
                tuple(p.get("sizes", ("A",))),
                shapes,
                p.get("memory"),
                p.get("odd", False),
            )
        )
    return tuple(out)


@dataclass(frozen=True)
class Place:
    """Where a law acts: a node (`source` None: from outside), or two nodes that exchange the flow."""

    target: str
    source: str | None = None

    @property
    def where(self) -> str:
        """Its name in a result."""
        return f"{self.source}-{self.target}" if self.source else self.target

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes that it changes."""
        return (self.source, self.target) if self.source else (self.target,)


@dataclass(frozen=True)
class Signal:
    """A signal of the plant: an expression, its unit, its typical size.

    `drives`: a difference or a velocity that drives the flow at its place, and reverses it."""

    label: str
    value: Expr
    unit: str | None
    size: float = 1.0
    centre: float = 0.0
    kelvin: float | None = None  # offset to kelvins; None: no absolute temperature
    position: bool = False
    drives: bool = False
    recorded: bool = False


def places(rig: Structure) -> list[Place]:
    """Return every node that stores something, and every pair of nodes that exchange a flow."""
    positions = set(rig.pairs.values())
    flows = rig.physics.flows.values()
    nodes = [
        n for n in rig.physics.nodes if n not in positions and any(n in (f.source, f.target) for f in flows)
    ]
    pairs = {(f.source, f.target) for f in flows if f.source in nodes and f.target in nodes}
    return [*map(Place, nodes), *(Place(b, a) for a, b in sorted(pairs))]


def signals(rig: Structure, place: Place, runs: Sequence[Values]) -> list[Signal]:
    """Return what a law at a place may depend on, each with its typical size over the runs."""
    p, out = rig.physics, []
    positions = set(rig.pairs.values())
    near = [*place.nodes, *(rig.pairs[n] for n in place.nodes if n in rig.pairs)]

    def absolute(n: str, unit: str | None) -> None:
        if unit in TEMPERATURE:
            out.append(Signal(n, name(n), "K", kelvin=273.15 - zero_of(unit)))
        else:
            own = n in place.nodes and n in rig.velocities and not place.source
            out.append(Signal(n, name(n), unit, position=n in positions, drives=own, recorded=n in p.inputs))

    def difference(a: str, b: str) -> None:
        unit = _difference(p.nodes[a].unit)
        out.append(Signal(f"{a} - {b}", ex.add(name(a), ex.neg(name(b))), unit, drives=True))

    for n in near:
        if rig.air and n in rig.temperatures:
            difference(n, rig.air)
        absolute(n, p.nodes[n].unit)
    if place.source and p.nodes[place.source].unit == p.nodes[place.target].unit:
        difference(place.source, place.target)
    for n in p.nodes:
        if n not in near:
            absolute(n, p.nodes[n].unit)
            linked = any({n, place.target} == {f.source, f.target} for f in p.flows.values())
            if linked and not place.source and p.nodes[n].unit == p.nodes[place.target].unit:
                difference(place.target, n)
    for i in sorted(rig.moving_inputs):
        if i != rig.air and not i.endswith("_start"):
            absolute(i, p.inputs[i].unit)
    return [s for s in (_sized(s, runs) for s in out) if s is not None]


def _difference(unit: str | None) -> str | None:
    return "K" if unit in TEMPERATURE else unit


def _sized(s: Signal, runs: Sequence[Values]) -> Signal | None:
    values = np.concatenate([np.atleast_1d(np.asarray(ex.evaluate(s.value, v), float)) for v in runs])
    centre = float(np.mean(values)) if s.kelvin is not None or s.position else 0.0
    size = float(np.sqrt(np.mean((values - centre) ** 2)))
    if not np.isfinite(size) or float(np.ptp(values)) <= 1e-9 * max(size, 1e-300):
        return None
    return replace(s, size=float(f"{size:.3g}"), centre=float(f"{centre:.4g}"))


@dataclass(frozen=True)
class Term:
    """A form over signals at values of its shapes. `number` keeps the parameters of several terms apart."""

    form: Form
    signals: tuple[Signal, ...]
    shapes: Mapping[str, float] = field(default_factory=dict)
    duration: float = 1.0  # of the longest run, s

    @property
    def variables(self) -> frozenset[str]:
        """The signals that it depends on."""
        return frozenset(s.label for s in self.signals)

    @property
    def reverses(self) -> bool | None:
        """Return whether the term reverses with what drives the flow; None where nothing demands it."""
        return self.form.odd if len(self.signals) == 1 and self.signals[0].drives else None

    def expression(self, number: int) -> Expr:
        """Return the term with its parameters A, n, ... named A1, n1, ... and its signals filled in."""
        own = {
            q: name(f"{q}{number}")
            for q in (*self.form.sizes, *self.form.shapes, *(("m",) if self.form.memory else ()))
        }
        symbols = dict(own)
        for k, (symbol, s) in enumerate(zip("zw", self.signals, strict=False)):
            symbols[symbol] = self.normal(s, f"{'ZW'[k]}{number}")
            if s.kelvin is not None and symbol == "z":
                symbols["T"] = ex.add(s.value, num(s.kelvin))
        return ex.substitute(self.form.text, lambda e: symbols.get(str(e.value)) if e.op == "name" else None)

    @staticmethod
    def normal(s: Signal, scale: str) -> Expr:
        """Return a signal without unit: (value - centre) / scale."""
        value = ex.add(s.value, num(-s.centre)) if s.centre else s.value
        return ex.div(value, name(scale))

    def scales(self, number: int) -> dict[str, Signal]:
        """Return the known parameters Z1, W1 that hold the signals' typical sizes."""
        used = ex.names(self.expression(number)) | (
            ex.names(self.lagged(number)) if self.form.memory else set()
        )
        return {f"{'ZW'[k]}{number}": s for k, s in enumerate(self.signals) if f"{'ZW'[k]}{number}" in used}

    def lagged(self, number: int) -> Expr:
        """Return what drives the memory of the term."""
        return self.normal(self.signals[0], f"Z{number}")

    @property
    def integrates(self) -> bool:
        """Return whether the memory is an integral."""
        return self.form.memory == TOTAL

    def filling(self, number: int) -> str:
        """Return the rate of the memory: of first order, or of an integral."""
        z = self.lagged(number)
        if self.integrates:
            return f"({z}) / {self.duration:.4g}"
        return f"({z} - m{number}) / {self.form.memory}{number}"

    def memory_text(self, number: int) -> str:
        """Return the memory of the term in words."""
        z = readable(self.lagged(number))
        if self.integrates:
            return f"the integral of {z} since the start, over {self.duration:.4g} s"
        return f"{z}, delayed by a first-order lag of {self.form.memory}{number}"

    def values(self, run: Values, t: np.ndarray) -> np.ndarray:
        """Return the term (N, sizes) along a trajectory, for sizes of one."""
        known: dict[str, Any] = {**run, **{f"{k}1": v for k, v in self.shapes.items()}}
        known |= {k: s.size for k, s in self.scales(1).items()}
        if self.form.memory:
            z = np.broadcast_to(np.asarray(ex.evaluate(self.lagged(1), known), float), t.shape)
            known["m1"] = (
                _total(t, z) / self.duration if self.integrates else _lag(t, z, self.shapes[self.form.memory])
            )
        e = self.expression(1)
        out = []
        for q in self.form.sizes:
            one = {f"{o}1": float(o == q) for o in self.form.sizes}
            with np.errstate(all="ignore"):
                out.append(np.broadcast_to(np.asarray(ex.evaluate(e, {**known, **one}), float), t.shape))
        return np.stack(out, axis=1)


def _lag(t: np.ndarray, z: np.ndarray, tau: float) -> np.ndarray:
    out = np.empty(len(t))
    value = out[0] = z[0]
    for k, a in enumerate(np.exp(-np.diff(t) / tau).tolist(), 1):
        value = a * value + (1 - a) * z[k - 1]
        out[k] = value
    return out


def _total(t: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(z[:-1] * np.diff(t))])


def terms(found: Sequence[Signal], duration: float) -> Iterator[Term]:
    """Yield every form over these signals at each of its first values."""
    for form in library():
        if form.of == "none":
            yield Term(form, (), {}, duration)
            continue
        for s in found:
            fits = {"absolute": s.kelvin is not None, "position": s.position, "input": s.recorded}
            if not fits.get(form.of, True):
                continue
            for w in found if form.of == "two" else (s,):
                if form.of == "two" and (w is s or (form.name == "product" and w.label < s.label)):
                    continue
                for shapes in _grid(form, duration):
                    yield Term(form, (s, w) if form.of == "two" else (s,), shapes, duration)


def _grid(form: Form, duration: float) -> Iterator[dict[str, float]]:
    if not form.shapes:
        yield {}
    for key, shape in form.shapes.items():  # one shape each
        for v in shape.values:
            yield {key: v * (duration if shape.of == "duration" else 1.0)}


def law_effect(law: Sequence[Term], place: Place, unit: str | None) -> Effect:
    """Return the entry of a law at a place, as the catalogue would hold it."""
    changes: list[dict[str, Any]] = []
    parameters: list[EffectParameter] = []
    rate: Expr = ex.ZERO
    for k, term in enumerate(law, 1):
        rate = ex.add(rate, term.expression(k))
        parameters += [_parameter(f"{q}{k}", unit, ex.parse("s"), 0.0) for q in term.form.sizes]
        parameters += [
            _parameter(f"{q}{k}", s.unit, None, term.shapes[q]) for q, s in term.form.shapes.items()
        ]
        parameters += [_parameter(q, s.unit, None, s.size) for q, s in term.scales(k).items()]
        if term.form.memory:
            lagged = term.lagged(k)
            changes.append(
                {
                    "node": {
                        "name": f"m{k}",
                        "storage": 1,
                        "initial": str(_at_start(lagged)),
                        "initial_sigma": 0.1,
                    }
                }
            )
            changes.append({"flow": {"into": f"m{k}", "rate": term.filling(k)}})
    ends = {"into": "target", **({"from": "source"} if place.source else {})}
    changes.append({"flow": {**ends, "rate": str(rate)}})
    return Effect(
        "law",
        "A law that the recordings propose",
        "",
        (),
        (tuple(changes),),
        {},
        tuple(parameters),
        ((1.0,),),
        "",
        (),
        "",
    )


def _at_start(e: Expr) -> Expr:
    return ex.ZERO if ex.names(e) else e


def _parameter(label: str, unit: str | None, trial: Expr | None, null: float) -> EffectParameter:
    return EffectParameter(label, unit, -np.inf, np.inf, null, trial, None, False, None, None)


def readable(e: Expr) -> str:
    """Return an expression as text without the guard of a power."""
    return re.sub(r"max\((abs\((?:[^()]|\([^()]*\))*\)), 1e-0?6\)", r"\1", str(e))
