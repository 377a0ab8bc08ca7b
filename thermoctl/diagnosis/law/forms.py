"""The library of laws: forms (config/laws.yaml) over signals at a place, written in the plant language.

A term is one form over one or two signals. A signal is divided by its typical size Z, a fixed parameter
with the signal's unit. So the size A of a term has the unit of the flow."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from thermoctl.diagnosis.hypothesis.effect import Effect, EffectParameter
from thermoctl.diagnosis.law.memory import MEMORIES
from thermoctl.diagnosis.law.signals import Place, Signal, Values
from thermoctl.files import yamlfile
from thermoctl.files.shipped import shipped
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr, name, num

LAW = "law"  # name of a law among the effects of a hypothesis
MARK = "plant_"  # before a name of the plant in the expressions of a law
SYMMETRIC = ("product", "powers")  # forms in which the two signals change places
NEGLIGIBLE = 0.2  # share of its typical size down to which a signal counts as nowhere negative


@dataclass(frozen=True)
class Shape:
    """A parameter of a form that is not a size: values to try first, range, unit.

    With `of` 'duration' the values are shares of the longest recording, with 'visited' quantiles of the
    signal."""

    values: tuple[float, ...]
    range: tuple[float, float]
    unit: str | None = None
    of: str | None = None

    def scaled(self, values: Sequence[float], s: Signal | None, duration: float) -> tuple[float, ...]:
        """Return values, or bounds, in the unit of the form's parameter."""
        if self.of == "duration":
            return tuple(v * duration for v in values)
        if self.of == "visited" and s:
            return tuple(np.interp(values, np.linspace(0, 1, len(s.visited)), s.visited).tolist())
        return tuple(values)


@dataclass(frozen=True)
class Form:
    """One form of the library."""

    name: str
    text: Expr
    shapes: Mapping[str, Shape]
    of: str = "any"
    sizes: tuple[str, ...] = ("A",)
    memory: str | None = None
    odd: bool = False  # does the term change its sign with its signal?
    limit: str | None = None  # the form that it becomes at the upper bound of a shape
    twin: str | None = None  # the form that it equals where its signal is nowhere negative


@cache
def library() -> tuple[Form, ...]:
    """Return the forms of config/laws.yaml. Raises InputError."""
    root, out = yamlfile.load(shipped("config") / "laws.yaml"), []
    for key, node in root.value.items():
        p: dict[str, Any] = node.plain()
        try:
            p["text"] = ex.parse(p["text"])
        except ex.ExpressionError as e:
            raise node.error(str(e)) from None
        p["shapes"] = {q: _shape(**s) for q, s in p.get("shapes", {}).items()}
        p["sizes"] = tuple(p.get("sizes", Form.sizes))
        out.append(Form(key, **p))
    return tuple(out)


def _shape(values: Sequence[float], range: Sequence[float], **others: str) -> Shape:
    return Shape(tuple(map(float, values)), (float(range[0]), float(range[1])), **others)


@dataclass(frozen=True)
class Term:
    """A form over signals at values of its shapes. The suffix `number` of its parameters counts the terms."""

    form: Form
    signals: tuple[Signal, ...]
    shapes: Mapping[str, float] = field(default_factory=dict)
    duration: float = 1.0  # s, of the longest recording
    sample: float = 1.0  # interval between samples, s

    @property
    def variables(self) -> frozenset[str]:
        """Return the labels of the signals that it depends on."""
        return frozenset(s.label for s in self.signals)

    @property
    def reverses(self) -> bool | None:
        """Return whether the term reverses with the signal that drives the flow; None if none drives it."""
        return self.form.odd if len(self.signals) == 1 and self.signals[0].drives else None

    def expression(self, number: int) -> Expr:
        """Return the term with its parameters A, n, ... named A1, n1, ... and its signals filled in."""
        symbols = {q: name(f"{q}{number}") for q in (*self.form.sizes, *self.form.shapes, "m")}
        for symbol, s in zip("zw", self.signals, strict=False):
            symbols[symbol] = self.normal(s, f"{symbol.upper()}{number}")
        if self.signals and self.signals[0].kelvin is not None:
            symbols["T"] = ex.add(self.signals[0].value, num(self.signals[0].kelvin))
        return ex.fill(self.form.text, symbols)

    @staticmethod
    def normal(s: Signal, scale: str) -> Expr:
        """Return a signal without unit: (value - centre) / scale."""
        value = ex.add(s.value, num(-s.centre)) if s.centre else s.value
        return ex.div(value, name(scale))

    def scales(self, number: int) -> dict[str, Signal]:
        """Return the fixed parameters Z1, W1 with the signals whose typical sizes they hold."""
        used = ex.names(self.expression(number))
        if self.form.memory:
            used |= ex.names(self.lagged(number))
        scales = zip((f"Z{number}", f"W{number}"), self.signals, strict=False)
        return {scale: s for scale, s in scales if scale in used}

    def lagged(self, number: int) -> Expr:
        """Return the input of the term's memory: its first signal without unit."""
        return self.normal(self.signals[0], f"Z{number}")

    def filling(self, number: int) -> Expr:
        """Return the rate of change of the term's memory."""
        symbols = {k: name(f"{k}{number}") for k in ("m", *self.form.shapes)}
        symbols |= {"z": self.lagged(number), **{k: num(float(f"{v:.4g}")) for k, v in self.clock.items()}}
        return ex.fill(ex.parse(MEMORIES[self.form.memory or ""].rate), symbols)

    def memory_text(self, number: int) -> str:
        """Return the memory of the term in words."""
        words = {k: f"{k}{number}" for k in self.form.shapes} | {k: f"{v:.4g}" for k, v in self.clock.items()}
        return MEMORIES[self.form.memory or ""].words.format(z=readable(self.lagged(number)), **words)

    @property
    def clock(self) -> dict[str, float]:
        """Return the times that the rate of a memory may depend on, s."""
        return {"duration": self.duration, "sample": self.sample}

    def values(self, run: Values, t: np.ndarray) -> np.ndarray:
        """Return the values (N, sizes) of the term along a trajectory, one column for each size at 1."""
        shapes = {q: np.array([v]) for q, v in self.shapes.items()}
        return Family(self.form, self.signals, shapes, self.duration, self.sample).values(run, t)


@dataclass(frozen=True, eq=False)
class Family:
    """A form over signals, at k values of each of its shapes (k,)."""

    form: Form
    signals: tuple[Signal, ...]
    shapes: Mapping[str, np.ndarray]
    duration: float
    sample: float

    @property
    def count(self) -> int:
        """Number of terms."""
        return len(next(iter(self.shapes.values()), (0,)))

    def term(self, k: int) -> Term:
        """Return the term with the k-th values."""
        shapes = {q: float(v[k]) for q, v in self.shapes.items()}
        return Term(self.form, self.signals, shapes, self.duration, self.sample)

    def values(self, run: Values, t: np.ndarray) -> np.ndarray:
        """Return the values (N, count * sizes) of all terms along a trajectory, each size at 1."""
        symbols: dict[str, Any] = {**self.shapes, "pi": np.pi}
        for symbol, s in zip("zw", self.signals, strict=False):
            value = s.along(run, t)
            symbols[symbol] = ((value - s.centre) / s.size)[:, None]
            if symbol == "z" and s.kelvin is not None:
                symbols["T"] = (value + s.kelvin)[:, None]
        if self.form.memory:
            symbols["m"] = MEMORIES[self.form.memory].along(t, symbols["z"][:, 0], self.shapes, self.duration)
        out = np.empty((len(t), self.count, len(self.form.sizes)))
        for k, q in enumerate(self.form.sizes):
            one = {o: float(o == q) for o in self.form.sizes}
            with np.errstate(all="ignore"):
                out[:, :, k] = ex.evaluate(self.form.text, {**symbols, **one})
        return out.reshape(len(t), -1)


def families(
    first: Sequence[Signal], every: Sequence[Signal], duration: float, sample: float
) -> list[Family]:
    """Return every form over each signal of `first`, at all combinations of its shapes' first values.

    `every`: possible second signals."""
    out = []
    for form in library():
        if form.of == "none":
            out.append(Family(form, (), {}, duration, sample))
            continue
        for z in first:
            fits = {
                "absolute": z.kelvin is not None,
                "warmed": z.kelvin is not None,
                "position": z.position,
                "gap": z.position,
                "input": z.recorded,
                "spent": z.recorded,
                "loaded": z.drives,
                "reading": z.reading,
            }
            if form.twin and z.visited[0] >= -NEGLIGIBLE:
                continue  # the recordings cannot tell the two apart
            if z.daily if form.of in ("time_of_day", "timed") else fits.get(form.of, True) and not z.daily:
                shapes = combined({q: s.scaled(s.values, z, duration) for q, s in form.shapes.items()})
                out += [Family(form, pair, shapes, duration, sample) for pair in _pairs(form, z, every)]
    return [f for f in out if f.count]  # a signal with one value only has no two thresholds


def _pairs(form: Form, z: Signal, every: Sequence[Signal]) -> list[tuple[Signal, ...]]:
    """Return the tuples of signals that a form may have with z as the first one."""
    if form.of not in ("two", "warmed", "gap", "driven", "loaded", "timed", "spent"):
        return [(z,)]
    second = [w for w in every if w != z and not w.daily and (w.drives or form.of != "driven")]
    return [(z, w) for w in second if form.name not in SYMMETRIC or z.label < w.label]


def combined(values: Mapping[str, Sequence[float] | np.ndarray]) -> dict[str, np.ndarray]:
    """Return all combinations of values, by name (k,), without combinations of equal values."""
    if not values:
        return {}
    chosen = [v for v in itertools.product(*values.values()) if len(v) == len(set(v))]
    return dict(zip(values, np.reshape(chosen, (-1, len(values))).T, strict=True))


def of_plant(e: Expr) -> Expr:
    """Return an expression with the plant's names marked: an effect has symbols such as air and s1, too."""
    return ex.fill(e, {n: name(MARK + n) for n in ex.names(e)})


def law_effect(law: Sequence[Term], place: Place, unit: str | None) -> Effect:
    """Return a law at a place as an entry of the catalogue. It reads the plant's names as `of_plant`."""
    changes: list[dict[str, Any]] = []
    parameters: list[EffectParameter] = []
    rate: Expr = ex.ZERO
    for k, bare in enumerate(law, 1):
        own = tuple(replace(s, value=of_plant(s.value)) for s in bare.signals)
        term = replace(bare, signals=own)
        rate = ex.add(rate, term.expression(k))
        parameters += [_parameter(f"{q}{k}", unit, ex.parse("s"), 0.0) for q in term.form.sizes]
        parameters += [
            _parameter(f"{q}{k}", s.unit, None, term.shapes[q]) for q, s in term.form.shapes.items()
        ]
        parameters += [_parameter(q, s.unit, None, s.size) for q, s in term.scales(k).items()]
        if term.form.memory:
            memory = MEMORIES[term.form.memory]
            node = {"name": f"m{k}", "storage": 1, "initial": memory.start}
            changes.append({"node": {**node, "initial_sigma": memory.start_sigma}})
            changes.append({"flow": {"into": f"m{k}", "rate": str(term.filling(k))}})
    if place.part == "reading":
        changes.append({"value": str(ex.add(name("y"), rate))})
    elif place.part == "storage":
        changes.append({"storage": str(ex.add(name("storage"), rate))})
    else:
        for k, (_, share) in enumerate(place.shares, 1):
            changes.append({"flow": {"into": f"other{k}", "rate": str(ex.mul(of_plant(share), rate))}})
        if place.part == "flow":
            ends = {"into": "target", **({"from": "source"} if place.source else {})}
            changes.append({"flow": {**ends, "rate": str(rate)}})
    return Effect(LAW, "A law that the recordings propose", "", (tuple(changes),), tuple(parameters))


def _parameter(label: str, unit: str | None, trial: Expr | None, null: float) -> EffectParameter:
    return EffectParameter(label, unit, -np.inf, np.inf, null, trial)


def readable(e: Expr) -> str:
    """Return an expression as text without the guard of a power."""
    return re.sub(r"max\((abs\((?:[^()]|\([^()]*\))*\)), 1e-0?6\)", r"\1", str(e))
