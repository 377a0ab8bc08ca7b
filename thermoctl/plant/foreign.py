"""A plant from an FMU: its states, inputs, outputs and parameters, completed by a map.

    d(state)/dt = fmu(derivative, states, inputs, parameters),    output = fmu(output, ...)

The map has the sections `inputs`, `states`, `outputs` and `parameters`, with the FMU's names as keys. An
entry's keys are those of a plant file (docs/how-to/diagnose.md, "An FMU as the plant").
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.files.yamlfile import Node, kind_of, number_of, suggest
from thermoctl.plant.language import FORMAT
from thermoctl.plant.native.fmu import Fmu, Variable, opened
from thermoctl.plant.parse import RESERVED
from thermoctl.units import dimension

SECTIONS = ("title", "inputs", "states", "outputs", "parameters")
EXAMPLES = {
    "inputs": "{column: heat}",
    "states": "{initial: 20}",
    "outputs": "{column: T}",
    "parameters": "{range: [0.1, 10]}",
}
EXPRESSIONS = ("storage", "initial", "value")
PROBES = 5  # random points at which an output that is a state's reading must equal the state


def plant_node(path: str | Path, mapped: Node | None = None) -> Node:
    """Return the plant file of an FMU as a YAML document. Raises InputError."""
    fmu = opened(str(path))
    mapped = mapped or Node({}, str(path), 0, 0)
    if not isinstance(mapped.value, dict):
        raise mapped.error("a map of an FMU was expected, with sections " + ", ".join(SECTIONS))
    for key, node in mapped.value.items():
        if key not in SECTIONS:
            raise node.error(
                f"'{key}' is no section of a map{suggest(key, SECTIONS)}; {', '.join(SECTIONS)} are"
            )
    return _Plant(fmu, mapped).document()


class _Plant:
    def __init__(self, fmu: Fmu, mapped: Node):
        self.fmu, self.mapped = fmu, mapped
        self.place = Node(None, str(fmu.path), 0, 0)
        self.given = {
            kind: self._section(kind, variables)
            for kind, variables in (
                ("inputs", fmu.inputs),
                ("states", fmu.states),
                ("outputs", fmu.outputs),
                ("parameters", fmu.parameters),
            )
        }
        taken = set(RESERVED)
        self.names = _names([*fmu.inputs, *fmu.states, *fmu.parameters], taken)
        self.readings = _names(fmu.outputs, taken)
        read = self._words()
        self.parameters = {
            n: v
            for n, v in fmu.parameters.items()
            if n in self.given["parameters"] or _range(v) or self.names[n] in read
        }
        self.constants = {
            n: e.value.pop("constant") for n, e in self.given["inputs"].items() if "constant" in e.value
        }

    def _section(self, kind: str, variables: Iterable[str]) -> dict[str, Node]:
        node = self.mapped.value.get(kind)
        if node is None or node.value is None:
            return {}
        if not isinstance(node.value, dict):
            raise node.error(f"'{kind}' must be a mapping of the FMU's names")
        for name, entry in node.value.items():
            if name not in variables:
                raise entry.error(
                    f"{self.fmu.path} has no {kind[:-1]} '{name}'{suggest(name, variables)}; "
                    f"there are {', '.join(variables) or 'none'}"[:600]
                )
            if not isinstance(entry.value, dict | None):
                raise entry.error(
                    f"{name}: keys and values such as {EXAMPLES[kind]} were expected, found {kind_of(entry)}"
                )
            if (constant := (entry.value or {}).get("constant")) is not None:
                number_of(constant, f"constant of '{name}'")
        return {k: Node(dict(v.value or {}), v.file, v.line, v.column) for k, v in node.value.items()}

    def _words(self) -> set[str]:
        """Return the names in the map's expressions."""
        entries = [*self.given["states"].values(), *self.given["outputs"].values()]
        texts = [str(q.value) for e in entries for k, q in e.value.items() if k in EXPRESSIONS]
        return {word for text in texts for word in re.findall(r"[A-Za-z_]\w*", text)}

    def document(self) -> Node:
        """Return the plant file; where the map has a key, its value replaces the FMU's."""
        fmu, names = self.fmu, self.names
        inputs = {
            names[n]: self._entry("inputs", n, self._input(v))
            for n, v in fmu.inputs.items()
            if n not in self.constants
        }
        same = self._readings()
        outputs = {}
        for n, v in fmu.outputs.items():
            value = names[same[n]] if n in same else self._call(n)
            outputs[self.readings[n]] = self._entry("outputs", n, {"value": value, "column": n, **_unit(v)})
        flows, nodes = {}, {}
        for n, v in fmu.states.items():
            entry = self._entry("states", n, {"storage": 1, "initial": v.start, **_unit(v)})
            storage = entry.value["storage"].value
            nodes[names[n]] = entry
            rate = self._call(fmu.derivatives[n])
            flows[f"change_of_{names[n]}"] = {
                "into": names[n],
                "rate": rate if storage == 1 else f"({storage}) * {rate}",
            }
        parameters = {
            names[n]: self._entry("parameters", n, {"value": v.start, **_unit(v), **_range(v)})
            for n, v in self.parameters.items()
        }
        title = self.mapped.value.get("title")
        return self._node(
            {
                "format": FORMAT,
                "title": title or self.fmu.path.stem,
                "inputs": inputs,
                "parameters": parameters,
                **({"nodes": nodes, "flows": flows} if nodes else {}),
                "outputs": outputs,
            }
        )

    def _input(self, v: Variable) -> dict[str, Any]:
        return {"column": v.name, "between_samples": "hold" if v.discrete else "linear", **_unit(v)}

    def _entry(self, kind: str, name: str, defaults: Mapping[str, Any]) -> Node:
        given = self.given[kind].get(name, Node({}, self.place.file, 0, 0))
        content = {**{k: self._node(v) for k, v in defaults.items()}, **given.value}
        return Node(content, given.file, given.line, given.column)

    def _node(self, value: Any) -> Node:
        if isinstance(value, Node):
            return value
        if isinstance(value, Mapping):
            value = {k: self._node(v) for k, v in value.items()}
        elif isinstance(value, list):
            value = [self._node(v) for v in value]
        return Node(value, self.place.file, 0, 0)

    def _call(self, result: str) -> str:
        """Return the expression of a result, with the states and inputs that it depends on."""
        fmu = self.fmu
        read = [n for n in (*fmu.states, *fmu.inputs) if n in fmu.depends[result]]
        values = {n: str(self.constants[n].value) if n in self.constants else self.names[n] for n in read}
        values |= {n: self.names[n] for n in self.parameters}
        return f'fmu("{fmu.path}", "{result}"' + "".join(f', "{n}", {v}' for n, v in values.items()) + ")"

    def _readings(self) -> dict[str, str]:
        """Return outputs that are a state's reading, and the state: equal at random points."""
        fmu, random = self.fmu, np.random.default_rng(0)
        free = {**fmu.states, **fmu.inputs}
        points = {
            n: v.start + (abs(v.start) or 1.0) * random.uniform(-0.1, 0.1, PROBES) for n, v in free.items()
        }
        state_of = {}
        for output in fmu.outputs:
            y = fmu.evaluate(output, tuple(points), [0.0, *points.values()])
            for state in fmu.states:
                if state in fmu.depends[output] and np.array_equal(y, points[state]):
                    state_of[output] = state
        return state_of


def _range(v: Variable) -> dict[str, list[float]]:
    """Return the range of a refit, where the description gives both ends."""
    low, high = v.range or (np.inf, -np.inf)
    return {"range": [low, high]} if low < high and low <= v.start <= high else {}


def _names(variables: Iterable[str], taken: set[str]) -> dict[str, str]:
    """Return a name of the plant language for each variable of the FMU; they differ."""
    out: dict[str, str] = {}
    for variable in variables:
        plain = re.sub(r"\W", "_", variable, flags=re.ASCII).strip("_") or "x"
        plain = plain if plain[0].isalpha() else f"x_{plain}"
        name, k = plain, 1
        while name in taken:
            k += 1
            name = f"{plain}_{k}"
        taken.add(name)
        out[variable] = name
    return out


def _unit(v: Variable) -> dict[str, str]:
    """Return the unit as the plant language has it; none where the FMU's is no unit of physics."""
    try:
        return {"unit": v.unit} if v.unit and dimension(v.unit) is not None else {}
    except ValueError:
        return {}


__all__ = ["plant_node"]
