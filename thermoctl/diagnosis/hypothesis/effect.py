"""An effect of the catalogue, and the reader of its file, which checks every key.

A wrong key, an unknown name in an expression or a wrong change raises InputError with file, line and column.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import Node, Section, suggest
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.units import dimension

SYMBOLS: Mapping[str, tuple[str, ...]] = {
    "node": ("n",),
    "node_pair": ("m", "n"),
    "temperature_node": ("T",),
    "velocity_node": ("v",),
    "conductance": ("T",),
    "temperature_pair": ("TA", "TB"),
    "heated_pair": ("TA", "TB", "a", "b"),
    "joule_flow": ("T",),
    "motor": ("v",),
    "drive": ("u",),
    "amplifier": ("u",),
    "sensor": ("y",),
    "body_sensor": ("y",),
    "passive_sensor": ("y",),
    "recorded_input": ("y",),
    "reading_in_air": ("y",),
    "position_sensor": ("y",),
    "displacement": ("y",),
    "member": ("y", "T"),
    "bending_pair": ("y", "TA", "TB"),
    "voltage_sensor": ("y",),
    "voltage": ("y", "a"),
    "level_node": ("a", "b"),
    "orifice": (),
    "resistive": (),
    "fixed_node": ("T",),
    "fixed_flow": (),
    "power": (),
    "free_parameter": ("p",),
}
"""The symbols of each place that an effect's expressions may read; its nodes are also ends of flows."""
EVERYWHERE = ("air", "reference", "duration", "sample", "t")
NEEDS = ("x", "v", "i", "T")
SHAPES: Mapping[str, tuple[str, ...]] = {
    "onsets": ("onset",),
    "windows": ("start", "end"),
    **dict.fromkeys(("times", "lags", "delays"), ("tau",)),
    "periods": ("period",),
    "phases": ("phase",),
    **dict.fromkeys(("end_levels", "high_levels", "drive_levels", "small_levels"), ("level",)),
    "speeds": ("speed",),
    "creep_speeds": ("creep",),
    "distances": ("distance",),
}
"""The kinds of shapes, and the names of the values that each kind has in `shape:` and `trial:`."""
UNITS_OF = ("unit_of_y", "unit_of_rate", *(f"unit_of_{signal}" for signal in "vxuaiT"))
"""Units of parameters that depend on the place: those of its reading, its flow, and its signals."""
SIZES = {"times", "lags", "delays", "small_levels"}
"""Kinds of shapes that are a size: at 0 there is no effect."""
FORMS = ("rate", "value", "voltage", "storage", "drive", "resistance", "parameter")
PARTS = {
    "flow": (("rate",), ("from", "into")),
    "node": (("name", "storage", "initial"), ("unit", "initial_sigma")),
    "split": (("from", "into", "share"), ()),
    "spill": (("from", "into", "level", "share"), ()),
}
"""The keys of a change that is a mapping: (required, optional)."""
_STARTS = ("start_of_T", "start_of_y", "start_of_x", "first_air")
OWN = {"rate": "rate", "storage": "storage", "resistance": "R"}
"""By kind of change, the symbol for the plant's own expression that the change replaces."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    - `trial`: its value in screening, an expression of the amplitudes s, s2, s3 and of shapes
    - `shape`: the name of the shape value that it equals
    - `null`: its value where the effect is absent
    - `at_zero`: does 0 turn the effect into the simpler one that it contains?
    - `from_first`: does its value in each recording count from the first one, where it is null?
    - `of`: with 'jump', low and high are multiples of the largest sudden change of the reading"""

    name: str
    unit: str | None
    low: float
    high: float
    null: float
    trial: Expr | None
    shape: str | None = None
    per_recording: bool = False
    typical: float | None = None
    # 'first_air': bounds are relative to the first ambient; 'exponent': null is the outlet's exponent.
    origin: str | None = None
    at_zero: bool = False
    of: str | None = None
    from_first: bool = False

    @property
    def amplitude(self) -> bool:
        """Does its trial value depend on an amplitude?"""
        return _amplitudes(self.trial) > 0


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue."""

    name: str
    title: str
    where: str
    changes: tuple[tuple[Mapping[str, Any], ...], ...]  # the change and its variants
    parameters: tuple[EffectParameter, ...]
    needs: tuple[str, ...] = ()
    shapes: Mapping[str, str] = field(default_factory=dict)
    dims: tuple[tuple[float, ...], ...] = ((1.0,),)
    excited_by: str = ""
    mimics: tuple[str, ...] = ()
    source: str = ""
    caution: str | None = None  # a sentence on the limits of such a finding
    prior: Expr | None = None  # -2 log prior of its parameters, inside their bounds
    contains: str | None = None  # the simpler effect that it is for some values of its parameters
    reads: tuple[str, ...] = ()  # names of nodes and inputs that it reads: an effect for one plant

    @cached_property
    def sizes(self) -> tuple[EffectParameter, ...]:
        """The parameters at whose null values it is absent; a limit of a drive or of a reading has none."""
        amplitudes = tuple(p for p in self.parameters if p.amplitude)
        return amplitudes or tuple(p for p in self.parameters if self.shapes.get(p.shape or "") in SIZES)

    @cached_property
    def in_air(self) -> bool:
        """Does it read the ambient?"""
        origins = any(p.origin == "first_air" for p in self.parameters)
        return origins or bool(re.search(r"\b(first_)?air\b", str(self.changes)))

    def at(self, exponent: float | None) -> Effect | None:
        """Return the entry for an outlet with this exponent in the plant file; None outside its bounds."""
        own = [p for p in self.parameters if p.origin == "exponent"]
        if exponent is None or not own:
            return self
        if not all(p.low <= exponent <= p.high for p in own):
            return None
        here = {"exponent": ex.num(exponent)}
        parameters = tuple(
            dataclasses.replace(p, null=exponent, trial=ex.fill(p.trial, here))
            if p.origin == "exponent" and p.trial
            else p
            for p in self.parameters
        )
        return dataclasses.replace(self, parameters=parameters)

    @property
    def timed(self) -> bool:
        """Does it depend on the time, or have parameters with a value for each recording?"""
        named = re.search(r"\bt\b", str(self.changes))
        return bool(named) or any(p.per_recording for p in self.parameters)


def read(root: Node) -> Effect:
    """Return the effect of a file. Raises InputError with file, line and column at the first mistake."""
    top = Section(root, "an effect file")
    name, where = top.text("effect"), top.text("where", choices=SYMBOLS)
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise top.get("effect").error(f"'{name}': a name of small letters, digits and '_' was expected")
    title, source = top.text("title"), top.text("source")
    excited_by, caution, contains = (top.text(key, "") for key in ("excited_by", "caution", "contains"))
    needs, mimics, reads = _names(top, "needs", NEEDS), _names(top, "mimics"), _names(top, "reads")
    section = top.section("shapes", required=False)
    shapes = {key: section.text(key, choices=SHAPES) for key in section.node.value} if section else {}
    sections = top.sections("parameters")
    given = {n for kind in shapes.values() for n in SHAPES[kind]}
    parameters = tuple(_parameter(q, p, given, sections) for q, p in sections.items())
    dims = _dims(top, max((_amplitudes(p.trial) for p in parameters), default=0))
    symbols = {*SYMBOLS[where], *needs, *reads, *EVERYWHERE, *sections}
    changes = _lists_of_changes(top, symbols, set(sections), where)
    prior = top.given("prior")
    effect = Effect(
        name,
        title,
        where,
        changes,
        parameters,
        needs,
        shapes,
        dims,
        excited_by,
        mimics,
        source,
        caution=caution or None,
        prior=_expression(prior, {*sections, "duration", "first_air"}, "prior") if prior else None,
        contains=contains or None,
        reads=reads,
    )
    top.end()
    return effect


def _names(top: Section, key: str, choices: Sequence[str] = ()) -> tuple[str, ...]:
    """Return a list of names, which may be left out."""
    nodes = top.list(key, required=False)
    for node in nodes:
        if not isinstance(node.value, str) or choices and node.value not in choices:
            expected = f"one of {', '.join(choices)}" if choices else "a name"
            raise node.error(f"{key}: {expected} was expected, found {yamlfile.kind_of(node)}")
    return tuple(str(node.value) for node in nodes)


def _parameter(name: str, p: Section, given: set[str], parameters: Mapping[str, Section]) -> EffectParameter:
    """Read a parameter. `given`: the names of the values of the effect's shapes."""
    low, high = p.number("low", -np.inf), p.number("high", np.inf)
    if not low <= high:  # equal bounds fix the value
        raise p.node.error(f"parameter '{name}': low {low:g} must not be above high {high:g}")
    unit = p.text("unit", "")
    for of in re.findall(r"unit_of\w*", unit):
        if of not in UNITS_OF:
            raise p.get("unit").error(
                f"parameter '{name}': no unit '{of}'{suggest(of, UNITS_OF)}; there are {', '.join(UNITS_OF)}"
            )
    if unit and "unit_of" not in unit:
        try:
            dimension(unit)
        except ValueError as e:
            raise p.get("unit").error(f"parameter '{name}': {e}") from None
    shape, trial = p.given("shape"), p.given("trial")
    if shape is not None and shape.value not in given:
        raise shape.error(
            f"parameter '{name}': shape '{shape.value}' is none of this effect's shapes ({', '.join(sorted(given)) or 'none'})"
        )
    value = None if shape is not None else ex.name("s")
    if trial is not None:
        steps = {f"s{k}" for k in range(2, 10)} | {"s"}
        value = _expression(
            trial, {*steps, *given, "first_air", "exponent", *parameters}, f"trial of '{name}'"
        )
    origin, of = (
        p.text("origin", "none", choices=("none", "first_air", "exponent")),
        p.text("of", "none", choices=("none", "jump")),
    )
    null, typical = p.optional_number("null"), p.optional_number("typical")
    parameter = EffectParameter(
        name,
        unit or None,
        low,
        high,
        null or 0.0,
        value,
        None if shape is None else str(shape.value),
        p.flag("per_recording", False),
        typical,
        None if origin == "none" else origin,
        p.flag("at_zero", False),
        None if of == "none" else of,
        p.flag("from_first", False),
    )
    p.end()
    return parameter


def _dims(top: Section, count: int) -> tuple[tuple[float, ...], ...]:
    """Return the amplitudes of each direction; if the file states none, one direction for each amplitude."""
    rows = top.list("dims", required=False)
    for row in rows:
        if not isinstance(row.value, list) or len(row.value) != count:
            raise row.error(f"dims: rows of {count} numbers were expected, one for each amplitude s, s2 ...")
    return tuple(tuple(row.plain()) for row in rows) or tuple(map(tuple, np.eye(max(count, 1)).tolist()))


def _amplitudes(trial: Expr | None) -> int:
    """Return the number of amplitudes s, or s1, s2, ..., in a trial value."""
    names = ex.names(trial) if trial is not None else ()
    return max((int(n[1:] or 1) for n in names if re.fullmatch(r"s\d*", n)), default=0)


def _expression(node: Node, symbols: Iterable[str], what: str) -> Expr:
    if isinstance(node.value, dict | list):
        raise node.error(f"{what}: an expression was expected, found {yamlfile.kind_of(node)}")
    try:
        read = ex.parse(str(node.value))
    except ex.ExpressionError as e:
        raise node.error(f"{what}: {e}") from None
    allowed = sorted(set(symbols))
    for n in sorted(ex.names(read) - set(allowed)):
        raise node.error(
            f"{what}: '{n}' is not known here{suggest(n, allowed)}; allowed are {', '.join(allowed)}"
        )
    return read


def _lists_of_changes(
    top: Section, symbols: set[str], parameters: set[str], where: str
) -> tuple[tuple[Mapping[str, Any], ...], ...]:
    """Return the change and its variants."""
    variants = top.list("variants", required=False)
    for node in variants:
        if not isinstance(node.value, list):
            raise node.error("variants: a list of changes was expected for each")
    for changes in (top.list("change"), *(v.value for v in variants)):
        if not changes:
            raise top.get("change").error("change: at least one change was expected, such as {flow: {...}}")
        _changes(changes, symbols, parameters, where)
    return tuple(tuple(node.plain()) for node in (top.get("change"), *variants))


def _changes(changes: Sequence[Node], symbols: set[str], parameters: set[str], where: str) -> None:
    made: set[str] = set()
    for item in changes:
        if not isinstance(item.value, dict) or len(item.value) != 1:
            raise item.error("change: one mapping for each change was expected, such as {flow: {...}}")
        ((kind, node),) = item.value.items()
        if kind in FORMS:
            _expression(node, {*symbols, *made, *({OWN[kind]} if kind in OWN else ())}, kind)
        elif kind in PARTS:
            _part(kind, node, {*symbols, *made}, made, parameters, where)
        elif kind in ("straight", "recorded"):
            if node.value not in symbols:
                raise node.error(f"{kind}: a symbol was expected, one of {', '.join(sorted(symbols))}")
        elif kind == "exponent":
            if node.value not in parameters:
                raise node.error(
                    f"exponent: a parameter was expected, one of {', '.join(sorted(parameters))}"
                )
        else:
            kinds = (*FORMS, *PARTS, "straight", "recorded", "exponent")
            raise node.error(
                f"'{kind}' is not a change{suggest(kind, kinds)}; one of {', '.join(kinds)} was expected"
            )


def _part(kind: str, node: Node, symbols: set[str], made: set[str], parameters: set[str], where: str) -> None:
    section = Section(node, kind)
    required, others = PARTS[kind]
    for key in (*required, *others):
        value = section.get(key, key in required)
        if value is None:
            continue
        if key in ("from", "into"):
            ends = sorted({*SYMBOLS[where], *made} - {"u", "y"})
            if value.value not in ends:
                raise value.error(
                    f"{kind}: '{value.value}' is not a node of the place; {', '.join(ends) or 'none'} was expected"
                )
        elif key in ("rate", "storage") or (key == "initial" and value.value not in _STARTS):
            _expression(value, symbols, f"{key} of {kind}")
        elif key in ("share", "level") and value.value not in parameters:
            raise value.error(f"{kind}: {key} is a parameter, one of {', '.join(sorted(parameters))}")
    if kind == "flow" and not {"from", "into"} & set(node.value):
        raise node.error("flow: 'from' or 'into' was expected")
    if kind == "node":
        made.add(section.text("name"))
    section.end()
