"""The plant file (format thermoctl-plant/1): what the simulation believes, read and checked.

    storage * d(node)/dt = sum(flows into) - sum(flows from)          outputs = what the sensors would read

`load` reads a file, `from_plain` the same from plain dicts (a plant that the diagnosis extended), `Plant.plain` gives
the dicts back and `save` writes them. Every error is one line with file, line, the name at fault and what is allowed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from thermoctl import yamlfile
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.yamlfile import suggest

FORMAT = "thermoctl-plant/1"
MAX_ITEMS = 2_000  # inputs, nodes, ... of one file
_NAME = re.compile(r"[A-Za-z_]\w{0,79}$", re.ASCII)
_RESERVED = {"pi", "t", *ex.FUNCTIONS, *ex.SPECIAL}


@dataclass(frozen=True)
class Input:
    """A recorded column that drives the simulation; `linear`: straight lines between samples, else held."""

    name: str
    unit: str | None = None
    column: str = ""
    linear: bool = False
    line: int = 0


@dataclass(frozen=True)
class Parameter:
    """A number of the physics; `range` is where a refit may move it (None: known); `values` per recording."""

    name: str
    value: float
    unit: str | None = None
    range: tuple[float, float] | None = None
    per_recording: bool = False
    values: Mapping[str, float] = field(default_factory=dict)
    line: int = 0


@dataclass(frozen=True)
class Node:
    """A stored quantity; `initial_sigma` says how uncertain the start is (None: known)."""

    name: str
    storage: Expr
    initial: Expr
    unit: str | None = None
    initial_sigma: float | None = None
    line: int = 0


@dataclass(frozen=True)
class Flow:
    """What leaves node `source` and arrives in node `target` (one of them may be None: the outside)."""

    name: str
    rate: Expr
    source: str | None = None
    target: str | None = None
    unit: str | None = None
    line: int = 0


@dataclass(frozen=True)
class Output:
    """What a sensor would read; `noise` is its random error's standard deviation, `resolution` its step."""

    name: str
    value: Expr
    unit: str | None = None
    column: str = ""
    noise: float | None = None
    resolution: float | None = None
    line: int = 0


@dataclass(frozen=True)
class Plant:
    """A checked plant."""

    title: str
    inputs: Mapping[str, Input]
    parameters: Mapping[str, Parameter]
    nodes: Mapping[str, Node]
    flows: Mapping[str, Flow]
    outputs: Mapping[str, Output]
    file: str = "<plant>"

    def plain(self) -> dict[str, Any]:
        """Plain dicts and lists, as the file holds them; `from_plain` reads them back."""

        def drop(**items: Any) -> dict[str, Any]:
            return {k: v for k, v in items.items() if v is not None and v != {}}

        return {
            "format": FORMAT,
            "title": self.title,
            "inputs": {
                i.name: drop(
                    unit=i.unit,
                    column=None if i.column == i.name else i.column,
                    between_samples="linear" if i.linear else None,
                )
                for i in self.inputs.values()
            },
            "parameters": {
                p.name: drop(
                    value=p.value,
                    unit=p.unit,
                    range=list(p.range) if p.range else None,
                    per_recording=p.per_recording or None,
                    values=dict(p.values),
                )
                for p in self.parameters.values()
            },
            **(
                {
                    "nodes": {
                        n.name: drop(
                            unit=n.unit,
                            storage=_scalar(n.storage),
                            initial=_scalar(n.initial),
                            initial_sigma=n.initial_sigma,
                        )
                        for n in self.nodes.values()
                    }
                }
                if self.nodes
                else {}
            ),
            **(
                {
                    "flows": {
                        f.name: drop(
                            **{"from": f.source, "into": f.target}, rate=_scalar(f.rate), unit=f.unit
                        )
                        for f in self.flows.values()
                    }
                }
                if self.flows
                else {}
            ),
            "outputs": {
                o.name: drop(
                    value=_scalar(o.value),
                    column=None if o.column == o.name else o.column,
                    unit=o.unit,
                    noise=o.noise,
                    resolution=o.resolution,
                )
                for o in self.outputs.values()
            },
        }


def _scalar(e: Expr) -> str | float:
    return e.value if e.op == "num" else str(e)


# ---------------------------------------------------------------------------------------------------------- reading

_KEYS = {
    "": ("format", "title", "inputs", "parameters", "nodes", "flows", "outputs"),
    "inputs": ("unit", "column", "between_samples"),
    "parameters": ("value", "unit", "range", "per_recording", "values"),
    "nodes": ("unit", "storage", "initial", "initial_sigma"),
    "flows": ("from", "into", "rate", "unit"),
    "outputs": ("value", "unit", "column", "noise", "resolution"),
}
_NEEDED = {
    "inputs": (),
    "parameters": ("value",),
    "nodes": ("storage", "initial"),
    "flows": ("rate",),
    "outputs": ("value",),
}


def _mapping(node: yamlfile.Node, what: str, keys: tuple[str, ...]) -> dict[str, yamlfile.Node]:
    if not isinstance(node.value, dict):
        raise node.error(f"{what} must be a mapping with {', '.join(keys)}, not {node.value!r}"[:300])
    for key, value in node.value.items():
        if key not in keys:
            raise value.error(
                f"unknown key '{key}' in {what}; allowed are {', '.join(keys)}{suggest(key, keys)}"
            )
    return node.value


def parse(root: yamlfile.Node) -> Plant:
    """Build a plant from a YAML document; names are checked here, units in `units.check_units`. Raises InputError."""
    top = _mapping(root, "a plant file", _KEYS[""])
    if "format" not in top or top["format"].value != FORMAT:
        raise (top.get("format") or root).error(
            f"'format: {FORMAT}' was expected at the head of a plant file"
        )
    if "outputs" not in top:
        raise root.error("no 'outputs': a plant without outputs cannot be compared with a recording")
    items: dict[str, dict[str, dict[str, yamlfile.Node]]] = {}
    places: dict[str, yamlfile.Node] = {}
    for section in ("inputs", "parameters", "nodes", "flows", "outputs"):
        node = top.get(section)
        items[section] = {}
        if node is None or node.value is None:
            continue
        if not isinstance(node.value, dict):
            raise node.error(f"'{section}' must be a mapping of names")
        if len(node.value) > MAX_ITEMS:
            raise node.error(f"{len(node.value)} {section}; at most {MAX_ITEMS} are read")
        for name, item in node.value.items():
            if not _NAME.match(name):
                raise item.error(
                    f"'{name}' is not a name: letters, digits and _ were expected, a letter first"
                )
            if name in _RESERVED:
                raise item.error(f"'{name}' is a word of the language and cannot name one of the {section}")
            if name in places and not {section, _section_of(items, name)} <= {"flows", "outputs"}:
                raise item.error(
                    f"'{name}' already names one of the {_section_of(items, name)} "
                    f"(line {places[name].line}); names must differ"
                )
            entry = _mapping(
                yamlfile.Node({}, item.file, item.line, item.column) if item.value is None else item,
                f"{section[:-1]} '{name}'",
                _KEYS[section],
            )
            for key in _NEEDED[section]:
                if key not in entry:
                    raise item.error(f"{section[:-1]} '{name}' has no '{key}'")
            items[section][name] = entry
            places.setdefault(name, item)
    if not items["outputs"]:
        raise top["outputs"].error("no outputs: a plant without outputs cannot be compared with a recording")
    line = {name: place.line for name, place in places.items()}
    title = top["title"].value if "title" in top else ""
    if not isinstance(title, str):
        title = str(title)

    inputs = {}
    for name, e in items["inputs"].items():
        between = e["between_samples"].value if "between_samples" in e else "hold"
        if between not in ("hold", "linear"):
            raise e["between_samples"].error(
                f"input '{name}': between_samples must be 'hold' or 'linear', not {between!r}"
            )
        inputs[name] = Input(name, _unit(e), _column(e, name), between == "linear", line[name])
    parameters = {name: _parameter(name, e, line[name]) for name, e in items["parameters"].items()}
    nodes = {
        name: Node(
            name,
            _expr(e["storage"], f"storage of '{name}'"),
            _expr(e["initial"], f"initial of '{name}'"),
            _unit(e),
            _number(e, "initial_sigma", name, low=0.0),
            line[name],
        )
        for name, e in items["nodes"].items()
    }
    flows = {}
    for name, e in items["flows"].items():
        ends = []
        for key in ("from", "into"):
            end = e[key].value if key in e else None
            if end is not None and end not in nodes:
                raise e[key].error(
                    f"flow '{name}': '{end}' is not a node{suggest(str(end), nodes)}; nodes are "
                    f"{', '.join(nodes) or 'absent'}"
                )
            ends.append(end)
        if ends == [None, None]:
            raise places[name].error(
                f"flow '{name}' has neither 'from' nor 'into'; one node at least was expected"
            )
        if ends[0] == ends[1]:
            raise places[name].error(f"flow '{name}' leads from '{ends[0]}' to itself")
        flows[name] = Flow(
            name, _expr(e["rate"], f"rate of '{name}'"), ends[0], ends[1], _unit(e), line[name]
        )
    outputs = {
        name: Output(
            name,
            _expr(e["value"], f"value of '{name}'"),
            _unit(e),
            _column(e, name),
            _number(e, "noise", name, low=0.0),
            _number(e, "resolution", name, low=0.0),
            places[name].line,
        )
        for name, e in items["outputs"].items()
    }
    plant = Plant(title, inputs, parameters, nodes, flows, outputs, root.file)
    _check_names(plant, items)
    _check_use(plant, places)
    return plant


def _section_of(items: dict, name: str) -> str:
    return next((s for s, entries in items.items() if name in entries), "")


def _unit(e: dict[str, yamlfile.Node]) -> str | None:
    node = e.get("unit")
    if node is None or node.value is None:
        return None
    if isinstance(node.value, (int, float)) and node.value == 1:
        return "1"
    if not isinstance(node.value, str):
        raise node.error(f"a unit such as W/K was expected, not {node.value!r}")
    return node.value


def _column(e: dict[str, yamlfile.Node], name: str) -> str:
    node = e.get("column")
    if node is None:
        return name
    if not isinstance(node.value, str) or not node.value:
        raise node.error(f"'{name}': a column's name was expected, not {node.value!r}")
    return node.value


def _number(e: dict[str, yamlfile.Node], key: str, name: str, low: float | None = None) -> float | None:
    node = e.get(key)
    if node is None or node.value is None:
        return None
    value = node.value
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise node.error(f"{key} of '{name}' must be a number, not {value!r}")
    if low is not None and value < low:
        raise node.error(f"{key} of '{name}' is {value}; {low:g} or more was expected")
    return float(value)


def _expr(node: yamlfile.Node, what: str) -> Expr:
    try:
        return ex.parse(node.value)
    except ex.ExpressionError as e:
        raise node.error(f"{what}: {e}") from None


def _parameter(name: str, e: dict[str, yamlfile.Node], line: int) -> Parameter:
    value = _number(e, "value", name)
    if value is None:
        raise e["value"].error(f"value of '{name}' must be a number")
    limits = None
    if "range" in e:
        node = e["range"]
        ends = [v.value for v in node.value] if isinstance(node.value, list) else None
        if (
            ends is None
            or len(ends) != 2
            or any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in ends)
            or not ends[0] < ends[1]
            or not all(abs(v) < 1e300 for v in ends)
        ):
            raise node.error(f"range of '{name}' must be [low, high] with low below high")
        limits = (float(ends[0]), float(ends[1]))
        if not limits[0] <= value <= limits[1]:
            raise e["value"].error(
                f"value of '{name}' is {value:g}, outside its range [{limits[0]:g}, {limits[1]:g}]"
            )
    per = e["per_recording"].value if "per_recording" in e else False
    if not isinstance(per, bool):
        raise e["per_recording"].error(f"per_recording of '{name}' must be true or false")
    values: dict[str, float] = {}
    if "values" in e:
        if not per or not isinstance(e["values"].value, dict):
            raise e["values"].error(
                f"values of '{name}' must map recordings to numbers, and needs per_recording: true"
            )
        for recording, node in e["values"].value.items():
            values[recording] = _number({"values": node}, "values", name) or 0.0
    return Parameter(name, value, _unit(e), limits, per, values, line)


def _check_names(plant: Plant, items: dict) -> None:
    """Every name in every expression exists and may stand where it stands."""
    inputs, parameters, nodes = set(plant.inputs), set(plant.parameters), set(plant.nodes)
    recorded = inputs | set(plant.outputs)
    rules: list[tuple[Expr, yamlfile.Node, str, set[str], str | bool, bool]] = []
    for n in plant.nodes.values():
        entry = items["nodes"][n.name]
        rules += [
            (n.storage, entry["storage"], f"storage of '{n.name}'", parameters | nodes, False, False),
            (n.initial, entry["initial"], f"initial of '{n.name}'", inputs | parameters, False, True),
        ]
    rules += [
        (
            f.rate,
            items["flows"][f.name]["rate"],
            f"rate of '{f.name}'",
            nodes | inputs | parameters | {"t"},
            "inputs",
            False,
        )
        for f in plant.flows.values()
    ]
    rules += [
        (
            o.value,
            items["outputs"][o.name]["value"],
            f"value of '{o.name}'",
            nodes | inputs | parameters | {"t"},
            "all",
            False,
        )
        for o in plant.outputs.values()
    ]
    for expr, place, what, allowed, delays, firsts in rules:
        for e in ex.walk(expr):
            if e.op == "name" and e.value not in allowed:
                known = e.value in inputs | parameters | nodes | {"t"}
                reason = "may not stand there" if known else "is not known" + suggest(e.value, allowed)
                raise place.error(
                    f"{what}: '{e.value}' {reason}; allowed are {', '.join(sorted(allowed))}"[:600]
                )
            if e.op == "first" and not firsts:
                raise place.error(f"{what}: first() may stand in 'initial' only")
            if e.op == "first" and e.value not in recorded:
                raise place.error(
                    f"{what}: first({e.value}): '{e.value}' is neither input nor output{suggest(e.value, recorded)}"
                )
            if e.op == "delay":
                if not delays:
                    raise place.error(f"{what}: delay() may stand in outputs and, on inputs, in rates only")
                if not ex.names(e.args[1]) <= parameters:
                    raise place.error(f"{what}: the seconds of delay() must be a number or parameters")
                if any(inner.op == "delay" for inner in ex.walk(e.args[0])):
                    raise place.error(
                        f"{what}: a delay() within a delay() is not part of the language; add the seconds"
                    )
                if delays == "inputs" and not ex.names(e.args[0]) <= inputs:
                    raise place.error(f"{what}: delay() in a rate may read inputs only")


def _check_use(plant: Plant, places: dict[str, yamlfile.Node]) -> None:
    """Nothing stands in the file that nothing uses."""
    exprs = (
        [e for n in plant.nodes.values() for e in (n.storage, n.initial)]
        + [f.rate for f in plant.flows.values()]
        + [o.value for o in plant.outputs.values()]
    )
    used = set().union(*(ex.names(e) for e in exprs)) | {
        e.value for x in exprs for e in ex.walk(x) if e.op == "first"
    }
    touched = {end for f in plant.flows.values() for end in (f.source, f.target)}
    for name in plant.nodes:
        if name not in touched:
            raise places[name].error(f"node '{name}': no flow touches it; add a flow or remove the node")
    for name in plant.parameters:
        if name not in used:
            raise places[name].error(f"parameter '{name}': nothing uses it; remove it or use it")
    for name in plant.inputs:
        if name not in used:
            raise places[name].error(f"input '{name}': nothing reads it; remove it or use it")
