"""Check the units of a plant by dimension: m equals um, degC counts as K, % and 1 are dimensionless.

Bring recordings to a plant's units, and back.

A flow's unit must follow from its node (storage times node per second), an expression's from its names. A
bare number and a name without a unit fit anywhere, and so does a product with one of them. Exponents are pure
numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction

import numpy as np

from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.plant.language import Input, Node, Output, Parameter, Plant
from thermoctl.recording.foreign.units import column_of
from thermoctl.recording.table import Table
from thermoctl.units import Dimension, conversion, described, dimension, raised, times


def check_units(plant: Plant) -> None:
    """Raise InputError (file:line, both dimensions) at the first unit or expression that does not fit."""
    units: dict[str, Dimension | None] = {"t": (("s", Fraction(1)),)}
    readings: dict[str, Dimension | None] = {}
    named: list[Input | Parameter | Node] = [
        *plant.inputs.values(),
        *plant.parameters.values(),
        *plant.nodes.values(),
    ]
    for item in named:
        units[item.name] = readings[item.name] = _declared(plant, item.name, item.unit, item.at)
    for output in plant.outputs.values():
        readings[output.name] = _declared(plant, output.name, output.unit, output.at)
    for read in plant.readings():
        if read.conversion and read.conversion.unit and read.unit:
            try:
                conversion(read.conversion.unit, read.unit)
            except ValueError as error:
                raise InputError(f"{plant.file}:{read.at}: column of '{read.name}': {error}") from None
    check = _Check(plant, units, readings)
    second = (("s", Fraction(1)),)
    rates: dict[str, tuple[Dimension, str]] = {}
    for node in plant.nodes.values():
        storage = check.expression(node.storage, f"storage of '{node.name}'", node.at)
        check.place(node.initial, f"initial of '{node.name}'", node.at, units[node.name], f"{node.unit}")
        if storage is not None and units[node.name] is not None:
            rates[node.name] = (
                times(times(storage, units[node.name] or ()), second, -1),
                f"from node '{node.name}', storage times node per second",
            )
    for flow in plant.flows.values():
        what = f"flow '{flow.name}'"
        unit = _declared(plant, what, flow.unit, flow.at)
        for end in filter(None, (flow.source, flow.target)):
            # A storage that is a bare number takes its dimension from the first flow that has one.
            if unit is not None:
                expected, why = rates.setdefault(end, (unit, f"as the other flows of node '{end}'"))
                if expected != unit:
                    raise InputError(
                        f"{plant.file}:{flow.at}: {what} has unit {flow.unit} [{described(unit)}]; "
                        f"{described(expected)} was expected {why}"
                    )
        expected_rate, why = (
            (unit, f"{flow.unit}")
            if unit is not None
            else next((rates[end] for end in (flow.source, flow.target) if end in rates), (None, ""))
        )
        given = check.place(flow.rate, f"rate of '{flow.name}'", flow.at, expected_rate, why)
        for end in filter(None, (flow.source, flow.target)):
            if unit is None and given is not None:
                expected, why = rates.setdefault(end, (given, f"as the other flows of node '{end}'"))
                if expected != given:
                    raise InputError(
                        f"{plant.file}:{flow.at}: rate of '{flow.name}' is [{described(given)}]; "
                        f"{described(expected)} was expected {why}"
                    )
    for output in plant.outputs.values():
        check.place(
            output.value, f"value of '{output.name}'", output.at, readings[output.name], f"{output.unit}"
        )


class _Check:
    """Dimensions of expressions, every shared part once."""

    def __init__(
        self, plant: Plant, units: dict[str, Dimension | None], readings: dict[str, Dimension | None]
    ):
        self.plant, self.units, self.readings = plant, units, readings
        self.known: dict[int, Dimension | None] = {}

    def place(self, e: Expr, what: str, at: str, expected: Dimension | None, why: str) -> Dimension | None:
        """Return the dimension of an expression. Raises InputError if it is known and not `expected`."""
        given = self.expression(e, what, at)
        if given is not None and expected is not None and given != expected:
            raise InputError(
                f"{self.plant.file}:{at}: {what}: '{_short(e)}' is [{described(given)}], but its place asks for "
                f"[{described(expected)}] ({why})"
            )
        return given if given is not None else expected

    def expression(self, root: Expr, what: str, at: str) -> Dimension | None:
        """Return the dimension of an expression, None where it fits anywhere.

        Raises InputError where its parts do not agree."""
        for e in ex.walk(root):
            if id(e) not in self.known:
                try:
                    self.known[id(e)] = self._of(e, [self.known[id(a)] for a in e.args])
                except ValueError as error:
                    raise InputError(f"{self.plant.file}:{at}: {what}: in '{_short(e)}' {error}") from None
        return self.known[id(root)]

    def _of(self, e: Expr, a: list[Dimension | None]) -> Dimension | None:
        op = e.op
        if op in ("num", "fmu"):
            return None
        if op == "name":
            return self.units.get(e.value)
        if op == "first":
            return self.readings.get(e.value)
        if op in ("+", "min", "max"):
            return _alike(a)
        if op in ("neg", "abs"):
            return a[0]
        if op in ("*", "/"):
            return None if a[0] is None or a[1] is None else times(a[0], a[1], 1 if op == "*" else -1)
        if op in ("**", "sqrt"):
            return _power(e, a)
        if op in ex.COMPARISONS:
            _alike(a)
            return ()
        if op in ("sign", "step"):
            return ()
        if op in ("exp", "log", "sin", "cos", "tanh"):
            if a[0]:
                raise ValueError(f"the argument of {op}() is [{described(a[0])}]; it must be dimensionless")
            return ()
        if op == "table":
            _alike(a[: 1 + e.value])
            return _alike(a[1 + e.value :])
        if op == "delay":
            if a[1] is not None and a[1] != (("s", Fraction(1)),):
                raise ValueError(f"the seconds of delay() are [{described(a[1])}]")
            return a[0]
        raise AssertionError(f"an operation without a rule: {op}")


def _alike(parts: Iterable[Dimension | None]) -> Dimension | None:
    stated = [p for p in parts if p is not None]
    for other in stated[1:]:
        if other != stated[0]:
            raise ValueError(f"[{described(stated[0])}] meets [{described(other)}]; they must be alike")
    return stated[0] if stated else None


def _power(e: Expr, a: list[Dimension | None]) -> Dimension | None:
    if e.op == "**" and a[1]:
        raise ValueError(f"the exponent is [{described(a[1])}]; it must be dimensionless")
    if not a[0]:
        return a[0]
    exponent = 0.5 if e.op == "sqrt" else _number(e.args[1])
    if exponent is None:
        return None
    return raised(a[0], exponent)


def _number(e: Expr) -> float | None:
    if e.op == "neg":
        inner = _number(e.args[0])
        return None if inner is None else -inner
    return e.value if e.op == "num" else None


def _short(e: Expr) -> str:
    text = str(e)
    return text if len(text) <= 80 else text[:77] + "..."


def _declared(plant: Plant, what: str, unit: str | None, at: str) -> Dimension | None:
    if unit is None:
        return None
    try:
        return dimension(unit)
    except ValueError as error:
        raise InputError(f"{plant.file}:{at}: unit of {what}: {error}") from None


def in_plant_units(plant: Plant, table: Table) -> Table:
    """Return a table with the columns that the plant reads in its units; each conversion is a note.

    The plant file's `column` decides (scale and offset, or a unit), else the unit in the file's header. A
    table that is in the plant's units already is returned as it is. Raises InputError for a wrong unit."""
    if not table.recorded:
        return table
    columns, units, notes = dict(table.columns), dict(table.units), list(table.notes)
    done: dict[str, tuple[float, float]] = {}
    for item in plant.readings():
        name = column_of(item.column, columns, units)
        if name is None:
            continue
        if name != item.column:  # the plant names the header with its unit
            columns[item.column], units[item.column] = columns.pop(name), units.pop(name, "")
        scale, offset = change = _conversion(plant, table, item, units.get(item.column))
        if done.setdefault(item.column, change) != change:
            raise InputError(
                f"{plant.file}:{item.at}: column '{item.column}' is read in two units; one unit was expected"
            )
        if change == (1.0, 0.0):
            continue
        columns[item.column] = scale * table.columns.get(item.column, columns[item.column]) + offset
        shown = f"{scale:g} * {item.column}" + (f" {offset:+g}" if offset else "")
        given = (item.conversion.unit if item.conversion else None) or units.get(item.column)
        by = f" ({given} to {item.unit})" if given else ""
        notes.append(f"'{item.name}' = {shown}{by}")
    return replace(table, columns=columns, notes=tuple(notes), recorded=False)


def as_recorded(plant: Plant, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return columns in the plant's units, converted back to the units in which the plant reads a file."""
    converted = dict(columns)
    for item in plant.readings():
        if item.conversion and item.column in converted:
            scale, offset = _stated(item)
            converted[item.column] = (columns[item.column] - offset) / scale
    return converted


def _stated(item: Input | Output) -> tuple[float, float]:
    c = item.conversion
    assert c is not None
    return conversion(c.unit, item.unit) if c.unit and item.unit else (c.scale, c.offset)


def _conversion(plant: Plant, table: Table, item: Input | Output, header: str | None) -> tuple[float, float]:
    if item.conversion:
        return _stated(item)
    if not header or not item.unit or header == item.unit:
        return 1.0, 0.0
    try:
        return conversion(header, item.unit)
    except ValueError as e:
        raise InputError(
            f"{table.path}: column '{item.column}' (for '{item.name}' of {plant.file}): {e}; correct the header, "
            f"or state the column's unit in the plant file: column: {{name: {item.column}, unit: ...}}"
        ) from None
