"""Parse a plant file's text to a `Plant`: keys, numbers, names, and the names that an expression may use.

Units are checked afterwards (units.py); files.py does both. Every error gives file, line and column, the
faulty name and the allowed ones.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

from thermoctl.files.yamlfile import Node as YamlNode
from thermoctl.files.yamlfile import Section, kind_of, number_of, suggest
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.plant.language import (
    FORMAT,
    ROLES,
    Conversion,
    Flow,
    Input,
    Node,
    Output,
    Parameter,
    Plant,
    SensorNoise,
)
from thermoctl.units import dimension

MAX_ITEMS = 2_000  # inputs, nodes, ... of one file
SECTIONS = ("inputs", "parameters", "nodes", "flows", "outputs")
_NAME = re.compile(r"[A-Za-z_]\w{0,79}$", re.ASCII)
RESERVED = {"pi", "t", *ex.FUNCTIONS, *ex.SPECIAL}

Items = dict[str, dict[str, Section]]
"""Entries of each section of the file, by section and name."""


def parse(root: YamlNode) -> Plant:
    """Build a plant from a YAML document; units are not checked here. Raises InputError."""
    top = Section(root, "a plant file")
    form = top.get("format", False)
    if form is None or form.value != FORMAT:
        raise (form or root).error(f"'format: {FORMAT}' was expected at the head of a plant file")
    title = top.given("title")
    if title is not None and isinstance(title.value, (dict, list)):
        raise title.error(f"title: text was expected, found {kind_of(title)}")
    if top.get("outputs", False) is None:
        raise root.error("no 'outputs': a plant without outputs cannot be compared with a recording")
    trusted = top.text("sensors", "", ("trusted",)) == "trusted"
    items = _items(top)
    if not items["outputs"]:
        raise top.get("outputs").error(
            "no outputs: a plant without outputs cannot be compared with a recording"
        )
    top.end()
    nodes = {name: _node(name, s) for name, s in items["nodes"].items()}
    plant = Plant(
        "" if title is None else str(title.value),
        {name: _input(name, s) for name, s in items["inputs"].items()},
        {name: _parameter(name, s) for name, s in items["parameters"].items()},
        nodes,
        {name: _flow(name, s, nodes) for name, s in items["flows"].items()},
        {name: _output(name, s) for name, s in items["outputs"].items()},
        root.file,
        trusted,
    )
    _check_names(plant, items)
    _check_use(plant, items)
    return plant


def _items(top: Section) -> Items:
    """Return the entries of each section, under names that are valid and differ."""
    items: Items = {}
    section_of: dict[str, str] = {}
    for section in SECTIONS:
        items[section] = {}
        node = top.given(section)
        if node is None:
            continue
        if not isinstance(node.value, dict):
            raise node.error(f"'{section}' must be a mapping of names")
        if len(node.value) > MAX_ITEMS:
            raise node.error(f"{len(node.value)} {section}; at most {MAX_ITEMS} are read")
        for name, item in node.value.items():
            _check_name(name, item, section)
            first = section_of.setdefault(name, section)
            if first != section and {section, first} != {"flows", "outputs"}:
                line = items[first][name].node.line
                raise item.error(
                    f"'{name}' already names one of the {first} (line {line}); names must differ"
                )
            empty = YamlNode({}, item.file, item.line, item.column)
            items[section][name] = Section(
                empty if item.value is None else item, f"{section[:-1]} '{name}'", of=name
            )
    return items


def _check_name(name: str, item: YamlNode, section: str) -> None:
    if not _NAME.match(name):
        raise item.error(f"'{name}' is not a name: letters, digits and _ were expected, a letter first")
    if name in RESERVED:
        raise item.error(f"'{name}' is a word of the language and cannot name one of the {section}")


# ------------------------------------------------------------------------------------ one function a section


def _input(name: str, s: Section) -> Input:
    stated = s.get("between_samples", False) is not None
    linear = s.text("between_samples", "hold", ("hold", "linear")) == "linear"
    column, conversion = _column(s, name)
    trusted = s.flag("trusted", False)
    item = Input(name, _unit(s), column, linear, _role(s), conversion, stated, trusted, _at(s))
    s.end()
    return item


def _parameter(name: str, s: Section) -> Parameter:
    if s.get("value").value == "?":
        unit = s.text("unit", "")
        raise s.get("value").error(
            f"value of '{name}' is not known yet: write the number for the question mark"
            + (f", in {unit}" if unit else "")
        )
    value = s.number("value")
    limits = s.interval("range") if s.get("range", False) is not None else None
    if limits is not None and not limits[0] <= value <= limits[1]:
        raise s.get("value").error(
            f"value of '{name}' is {value:g}, outside its range [{limits[0]:g}, {limits[1]:g}]"
        )
    per_recording = s.flag("per_recording", False)
    values: dict[str, float] = {}
    node = s.get("values", False)
    if node is not None:
        if not per_recording or not isinstance(node.value, dict):
            raise node.error(
                f"values of '{name}' must map recordings to numbers, and needs per_recording: true"
            )
        values = {recording: number_of(v, f"values of '{name}'") for recording, v in node.value.items()}
    item = Parameter(name, value, _unit(s), limits, per_recording, values, _at(s))
    s.end()
    return item


def _node(name: str, s: Section) -> Node:
    item = Node(
        name,
        _expression(s, "storage"),
        _expression(s, "initial"),
        _unit(s),
        s.optional_number("initial_sigma", low=0.0),
        _role(s),
        _at(s),
    )
    s.end()
    return item


def _flow(name: str, s: Section, nodes: Iterable[str]) -> Flow:
    nodes = list(nodes)
    rate = _expression(s, "rate")
    source, target = (_end(s, key, nodes) for key in ("from", "into"))
    if source is None and target is None:
        raise s.node.error(f"flow '{name}' has neither 'from' nor 'into'; one node at least was expected")
    if source == target:
        raise s.node.error(f"flow '{name}' leads from '{source}' to itself")
    item = Flow(name, rate, source, target, _unit(s), _at(s))
    s.end()
    return item


def _end(s: Section, key: str, nodes: list[str]) -> str | None:
    node = s.given(key)
    if node is None:
        return None
    if node.value not in nodes:
        raise node.error(
            f"{s.what}: '{node.value}' is not a node{suggest(str(node.value), nodes)}; "
            f"nodes are {', '.join(nodes) or 'absent'}"
        )
    return str(node.value)


def _output(name: str, s: Section) -> Output:
    column, conversion = _column(s, name)
    item = Output(
        name,
        _expression(s, "value"),
        _unit(s),
        column,
        _noise(s),
        s.optional_number("resolution", low=0.0),
        _role(s),
        conversion,
        s.flag("trusted", False),
        _at(s),
    )
    s.end()
    return item


def _noise(s: Section) -> float | SensorNoise | None:
    node = s.given("noise")
    if node is None or not isinstance(node.value, dict):
        return s.optional_number("noise", low=0.0)
    parts = Section(node, s.label("noise"), of=f"noise of {s.of}")
    white = parts.number("white", low=0.0)
    drift = time = flicker = None
    if "flicker" in node.value:
        flicker = parts.number("flicker", low=0.0)
    elif "drift" in node.value or "time" in node.value:
        drift, time = parts.number("drift", low=0.0), parts.number("time", low=0.0)
        if time == 0:
            raise parts.get("time").error(f"{parts.label('time')}: a time constant above 0 s was expected")
    noise = SensorNoise(white, drift, time, flicker, parts.optional_number("sd", low=0.0))
    parts.end()
    return noise


def _role(s: Section) -> str | None:
    return s.text("role", "", ROLES) or None


def _at(s: Section) -> str:
    return f"{s.node.line}:{s.node.column}"


def _unit(s: Section) -> str | None:
    node = s.given("unit")
    if node is None:
        return None
    if isinstance(node.value, (int, float)) and node.value == 1:
        return "1"
    if not isinstance(node.value, str):
        raise node.error(f"{s.label('unit')}: a unit such as W/K was expected, found {kind_of(node)}")
    return node.value


def _column(s: Section, name: str) -> tuple[str, Conversion | None]:
    """Return the column's name, and the conversion of its values to the plant's unit (None: not given)."""
    node = s.get("column", False)
    if node is None:
        return name, None
    if isinstance(node.value, dict):
        c = Section(node, f"column '{name}'", of=f"column of {s.of}")
        column = c.text("name", name)
        unit = _unit(c)
        if unit is not None and s.given("unit") is None:
            raise node.error(
                f"{s.what}: the column's unit is given, its own is not; a 'unit' beside it was expected"
            )
        conversion = Conversion(unit, c.number("scale", 1.0), c.number("offset", 0.0))
        c.end()
        if conversion.scale == 0 or (unit and {"scale", "offset"} & set(node.value)):
            raise node.error(
                f"{s.label('column')}: either 'unit', or 'scale' (not 0) and 'offset' were expected"
            )
        return column, conversion
    if not isinstance(node.value, str) or not node.value:
        raise node.error(f"{s.label('column')}: a column's name was expected, found {kind_of(node)}")
    return node.value, None


def _expression(s: Section, key: str) -> Expr:
    node = s.get(key)
    try:
        return ex.parse(node.value)
    except ex.ExpressionError as e:
        raise node.error(f"{s.label(key)}: {e}") from None


# --------------------------------------------------------------------------------------- names and their use


@dataclass(frozen=True)
class _Place:
    """An expression of the file, and the names and functions allowed in it.

    `delays`: the arguments allowed in delay(): 'no', 'inputs' or 'all'."""

    what: str
    expression: Expr
    node: YamlNode
    names: set[str]
    delays: str = "no"
    first: bool = False


def _places(plant: Plant, items: Items) -> list[_Place]:
    inputs, parameters, nodes = set(plant.inputs), set(plant.parameters), set(plant.nodes)
    everything = nodes | inputs | parameters | {"t"}

    def place(section: str, name: str, key: str, e: Expr, names: set[str], *rules: str) -> _Place:
        """Return an expression's place; `rules`: 'inputs' or 'all' for delay(), 'first' to allow first()."""
        s = items[section][name]
        delays = next((r for r in rules if r in ("inputs", "all")), "no")
        return _Place(s.label(key), e, s.get(key), names, delays, "first" in rules)

    places = []
    for n in plant.nodes.values():
        places.append(place("nodes", n.name, "storage", n.storage, parameters | inputs | nodes))
        places.append(place("nodes", n.name, "initial", n.initial, inputs | parameters, "first"))
    places += [place("flows", f.name, "rate", f.rate, everything, "inputs") for f in plant.flows.values()]
    places += [place("outputs", o.name, "value", o.value, everything, "all") for o in plant.outputs.values()]
    return places


def _check_names(plant: Plant, items: Items) -> None:
    """Refuse a name that does not exist, or that is not allowed in its expression."""
    for p in _places(plant, items):
        for e in ex.walk(p.expression):
            if e.op == "name" and e.value not in p.names:
                exists = e.value in {*plant.inputs, *plant.parameters, *plant.nodes, "t"}
                reason = "may not stand there" if exists else "is not known" + _meant(e.value, plant, p.names)
                raise p.node.error(
                    f"{p.what}: '{e.value}' {reason}; allowed are {', '.join(sorted(p.names))}"[:600]
                )
            if e.op == "first":
                _check_first(e, p, plant)
            if e.op == "delay":
                _check_delay(e, p, plant)


def _check_first(e: Expr, p: _Place, plant: Plant) -> None:
    if not p.first:
        raise p.node.error(f"{p.what}: first() may stand in 'initial' only")
    recorded = {r.name for r in plant.readings()}
    if e.value not in recorded:
        raise p.node.error(
            f"{p.what}: first({e.value}): '{e.value}' is neither input nor output{_meant(e.value, plant, recorded)}"
        )


def _meant(name: str, plant: Plant, allowed: set[str]) -> str:
    """Return, for an error, the input or output whose column has this name; else a similar name."""
    reader = next((r.name for r in plant.readings() if r.column == name and r.name in allowed), None)
    return f"; it is the column of '{reader}': write '{reader}'" if reader else suggest(name, allowed)


def _check_delay(e: Expr, p: _Place, plant: Plant) -> None:
    signal, seconds = e.args
    if p.delays == "no":
        raise p.node.error(f"{p.what}: delay() may stand in outputs and, on inputs, in rates only")
    if not ex.names(seconds) <= set(plant.parameters):
        raise p.node.error(f"{p.what}: the seconds of delay() must be a number or parameters")
    if any(inner.op == "delay" for inner in ex.walk(signal)):
        raise p.node.error(
            f"{p.what}: a delay() within a delay() is not part of the language; add the seconds"
        )
    if p.delays == "inputs" and not ex.names(signal) <= set(plant.inputs):
        raise p.node.error(f"{p.what}: delay() in a rate may read inputs only")
    if not (least := _least(seconds, plant)) >= 0 and not ex.names(signal) <= set(plant.inputs):
        raise p.node.error(
            f"{p.what}: the seconds of delay() reach {least:g}; 0 at least was expected, over the whole range of a parameter, "
            "where it reads more than recorded inputs"
        )


def _least(seconds: Expr, plant: Plant) -> float:
    """Return the least value of an expression at the least and largest values of its parameters."""
    used = [plant.parameters[n] for n in sorted(ex.names(seconds))]
    ends = [(p.value, *(p.range or ()), *p.values.values()) for p in used]
    ends = [(min(v), max(v)) for v in ends]
    found = (ex.evaluate(seconds, dict(zip([p.name for p in used], v, strict=True))) for v in product(*ends))
    return float(min(found))


def _check_use(plant: Plant, items: Items) -> None:
    """Refuse a node that no flow touches, and a parameter or input that no expression reads.

    An input with a role, or a fluid's flow, may wait for an effect that reads it."""
    expressions = [p.expression for p in _places(plant, items)]
    used = set().union(*(ex.names(e) for e in expressions)) | {
        e.value for x in expressions for e in ex.walk(x) if e.op == "first"
    }
    touched = {end for f in plant.flows.values() for end in (f.source, f.target)}
    for name, s in items["nodes"].items():
        if name not in touched:
            raise s.node.error(f"node '{name}': no flow touches it; add a flow or remove the node")
    for name, s in items["parameters"].items():
        if name not in used:
            raise s.node.error(f"parameter '{name}': nothing uses it; remove it or use it")
    for name, s in items["inputs"].items():
        i = plant.inputs[name]
        if name not in used and i.role is None and not _is_flow(i.unit):
            raise s.node.error(f"input '{name}': nothing reads it; use it, give it a role, or remove it")


def _is_flow(unit: str | None) -> bool:
    """Return whether a unit is of a fluid's flow, for which there is no role."""
    try:
        return unit is not None and dimension(unit) in map(dimension, ("m^3/s", "kg/s"))
    except ValueError:
        return False
