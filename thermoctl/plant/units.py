"""Check the units of a plant by dimension: m equals um, degC counts as K, % and 1 are dimensionless.

A flow's unit must follow from its node (storage times node per second), an expression's from its names. A
bare number and a name without a unit fit anywhere, and so does a product with one of them. Exponents are pure
numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from functools import cache
from typing import Any

from thermoctl.plant import expression as ex
from thermoctl.plant.expression import Expr
from thermoctl.plant.language import Input, Node, Parameter, Plant
from thermoctl.yamlfile import InputError

Dimension = tuple[tuple[str, Fraction], ...]
"""Sorted (base unit, exponent) pairs; () is dimensionless. None stands for 'fits anywhere'."""

# The symbols of most plant files: they do not need pint, whose import takes half a second.
_COMMON = {
    "1": "",
    "%": "",
    "percent": "",
    "dimensionless": "",
    "rad": "",
    "deg": "",
    "m": "m",
    "mm": "m",
    "um": "m",
    "µm": "m",
    "nm": "m",
    "cm": "m",
    "g": "kg",
    "kg": "kg",
    "s": "s",
    "ms": "s",
    "us": "s",
    "min": "s",
    "h": "s",
    "A": "A",
    "mA": "A",
    "K": "K",
    "degC": "K",
    "delta_degC": "K",
    "degF": "K",
    "mK": "K",
    "Hz": "s-1",
    "kHz": "s-1",
    "N": "kg m s-2",
    "mN": "kg m s-2",
    "kN": "kg m s-2",
    "Pa": "kg m-1 s-2",
    "kPa": "kg m-1 s-2",
    "bar": "kg m-1 s-2",
    "J": "kg m2 s-2",
    "kJ": "kg m2 s-2",
    "W": "kg m2 s-3",
    "mW": "kg m2 s-3",
    "kW": "kg m2 s-3",
    "V": "kg m2 s-3 A-1",
    "mV": "kg m2 s-3 A-1",
    "kV": "kg m2 s-3 A-1",
    "ohm": "kg m2 s-3 A-2",
    "mohm": "kg m2 s-3 A-2",
    "H": "kg m2 s-2 A-2",
    "mH": "kg m2 s-2 A-2",
    "F": "kg-1 m-2 s4 A2",
    "C": "s A",
    "T": "kg s-2 A-1",
    "Wb": "kg m2 s-2 A-1",
}
_KELVIN = {
    "K": (1.0, 0.0),
    "degC": (1.0, 273.15),
    "degF": (5 / 9, 459.67 * 5 / 9),
}  # scale, offset to kelvins
_BASES = {
    "[length]": "m",
    "[mass]": "kg",
    "[time]": "s",
    "[current]": "A",
    "[temperature]": "K",
    "[substance]": "mol",
    "[luminosity]": "cd",
}
_TOKEN = re.compile(
    r"\s*(?:(?P<power>\*\*|\^)|(?P<op>[*/()·])|(?P<raised>[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)|"
    r"(?P<number>[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)|(?P<symbol>[^\W\d]\w*|%|°C|°))"
)
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_WRITTEN = {"kg m2 s-2": "J", "kg m2 s-3": "W", "kg m s-2": "N", "kg m2 s-3 A-1": "V", "kg m2 s-3 A-2": "ohm"}
_MAX_LENGTH, _MAX_EXPONENT = 100, 100


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
                _times(_times(storage, units[node.name] or ()), second, -1),
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
                        f"{plant.file}:{flow.at}: {what} has unit {flow.unit} [{_text(unit)}]; "
                        f"{_text(expected)} was expected {why}"
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
                        f"{plant.file}:{flow.at}: rate of '{flow.name}' is [{_text(given)}]; "
                        f"{_text(expected)} was expected {why}"
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
                f"{self.plant.file}:{at}: {what}: '{_short(e)}' is [{_text(given)}], but its place asks for "
                f"[{_text(expected)}] ({why})"
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
            return None if a[0] is None or a[1] is None else _times(a[0], a[1], 1 if op == "*" else -1)
        if op in ("**", "sqrt"):
            return _power(e, a)
        if op in ex.COMPARISONS:
            _alike(a)
            return ()
        if op in ("sign", "step"):
            return ()
        if op in ("exp", "log", "sin", "cos", "tanh"):
            if a[0]:
                raise ValueError(f"the argument of {op}() is [{_text(a[0])}]; it must be dimensionless")
            return ()
        if op == "table":
            _alike(a[: 1 + e.value])
            return _alike(a[1 + e.value :])
        if op == "delay":
            if a[1] is not None and a[1] != (("s", Fraction(1)),):
                raise ValueError(f"the seconds of delay() are [{_text(a[1])}]")
            return a[0]
        raise AssertionError(f"an operation without a rule: {op}")


def _alike(parts: Iterable[Dimension | None]) -> Dimension | None:
    known = [p for p in parts if p is not None]
    for other in known[1:]:
        if other != known[0]:
            raise ValueError(f"[{_text(known[0])}] meets [{_text(other)}]; they must be alike")
    return known[0] if known else None


def _times(a: Dimension, b: Dimension, sign: int = 1) -> Dimension:
    total = dict(a)
    for base, exponent in b:
        total[base] = total.get(base, Fraction(0)) + sign * exponent
    return tuple(sorted((base, exponent) for base, exponent in total.items() if exponent))


def _power(e: Expr, a: list[Dimension | None]) -> Dimension | None:
    if e.op == "**" and a[1]:
        raise ValueError(f"the exponent is [{_text(a[1])}]; it must be dimensionless")
    if not a[0]:
        return a[0]
    exponent = 0.5 if e.op == "sqrt" else _number(e.args[1])
    if exponent is None:
        return None
    return _raised(a[0], exponent)


def _number(e: Expr) -> float | None:
    if e.op == "neg":
        inner = _number(e.args[0])
        return None if inner is None else -inner
    return e.value if e.op == "num" else None


def _raised(base: Dimension, exponent: float) -> Dimension:
    if not abs(exponent) <= _MAX_EXPONENT:
        raise ValueError(f"the exponent {exponent:g} is beyond {_MAX_EXPONENT}")
    k = Fraction(exponent).limit_denominator(10_000)
    return tuple((name, q) for name, power in base if (q := (power * k).limit_denominator(10_000)))


def _text(d: Dimension) -> str:
    """Return text such as kg m2 s-3, with the derived unit if there is one."""
    order = {b: i for i, b in enumerate(_BASES.values())}
    written = " ".join(
        f"{base}{'' if q == 1 else q if q.denominator == 1 else f'^({q})'}"
        for base, q in sorted(d, key=lambda pair: (pair[0] != "kg", order.get(pair[0], 99)))
    )
    return f"{_WRITTEN[written]} = {written}" if written in _WRITTEN else written or "dimensionless"


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


@cache
def dimension(unit: str) -> Dimension:
    """Return the dimension of a unit as pint writes it: 'W/K', 'kW/m^2', 'V**0.5/s', '%', 'N*s/m'.

    Raises ValueError."""
    if len(unit) > _MAX_LENGTH:
        raise ValueError(f"'{unit[:20]}...' is longer than {_MAX_LENGTH} letters")
    tokens, at = [], 0
    text = unit.strip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if not match:
            raise ValueError(
                f"'{unit}' is not a unit: '{text[at]}' was not expected; one such as W/K or N*s/m was"
            )
        tokens.append((match.lastgroup or "", match[match.lastgroup or 0]))
        at = match.end()
    try:
        result, rest = _product(tokens, 0)
    except IndexError:
        raise ValueError(f"'{unit}' is not a unit: it ends too early") from None
    except ValueError as error:
        raise ValueError(f"'{unit}' is not a unit: {error}") from None
    if rest != len(tokens):
        raise ValueError(f"'{unit}' is not a unit: '{tokens[rest][1]}' was not expected")
    return result


def conversion(given: str, wanted: str) -> tuple[float, float]:
    """Return (scale, offset) from a unit to another: wanted = scale * given + offset. Raises ValueError.

    C and F are degrees where a temperature is wanted."""
    if dimension(wanted) == dimension("K"):
        given = {"C": "degC", "F": "degF"}.get(given, given)
    if dimension(given) != dimension(wanted):
        raise ValueError(f"{given} [{_text(dimension(given))}] is no {wanted} [{_text(dimension(wanted))}]")
    if given == wanted:
        return 1.0, 0.0
    if given in _KELVIN and wanted in _KELVIN:
        (a, b), (c, d) = _KELVIN[given], _KELVIN[wanted]
        return a / c, (b - d) / c
    registry = _registry()
    ends = [float(registry.Quantity(x, _spelled(given)).to(_spelled(wanted)).magnitude) for x in (0.0, 1.0)]
    return ends[1] - ends[0], ends[0]


def _spelled(unit: str) -> str:
    plain = unit.replace("°C", "degC").replace("°", "deg").translate(_RAISED)
    return "dimensionless" if plain == "1" else plain


Tokens = list[tuple[str, str]]


def _product(tokens: Tokens, at: int) -> tuple[Dimension, int]:
    total, at = _factor(tokens, at)
    while at < len(tokens) and tokens[at][1] != ")":
        sign = -1 if tokens[at][1] == "/" else 1
        if tokens[at][0] == "op" and tokens[at][1] != "(":
            at += 1
        factor, at = _factor(tokens, at)
        total = _times(total, factor, sign)
    return total, at


def _factor(tokens: Tokens, at: int) -> tuple[Dimension, int]:
    kind, text = tokens[at]
    at += 1
    if text == "(":
        base, at = _product(tokens, at)
        if tokens[at][1] != ")":
            raise ValueError("')' was expected")
        at += 1
    elif kind == "symbol":
        base = _symbol(text)
    elif kind == "number" and text[0] not in "+-":
        base = ()
    else:
        raise ValueError(f"'{text}' was not expected")
    if at < len(tokens) and tokens[at][0] == "raised":
        return _raised(base, float(tokens[at][1].translate(_RAISED))), at + 1
    if at < len(tokens) and tokens[at][0] == "power":
        at += 1
        closing = tokens[at][1] == "("
        at += closing
        if tokens[at][0] != "number":
            raise ValueError(f"the exponent '{tokens[at][1]}' is not a number")
        base = _raised(base, float(tokens[at][1]))
        at += 1
        if closing:
            if tokens[at][1] != ")":
                raise ValueError("')' was expected")
            at += 1
    return base, at


@cache
def _symbol(symbol: str) -> Dimension:
    if symbol in _COMMON:
        pairs = re.findall(r"([A-Za-z]+)(-?\d*)", _COMMON[symbol])
        return tuple(sorted((base, Fraction(int(power or 1))) for base, power in pairs))
    lookup, undefined = _pint()
    try:
        found = lookup(symbol.replace("°C", "degC").replace("°", "deg"))
    except undefined:
        raise ValueError(f"pint knows no unit '{symbol}'") from None
    if not set(found) <= set(_BASES):
        raise ValueError(f"'{symbol}' is no unit of physics that a plant may use")
    return tuple(
        sorted(
            (_BASES[key], Fraction(power).limit_denominator(10_000)) for key, power in found.items() if power
        )
    )


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


@cache
def _pint() -> tuple[Callable[[str], Mapping[str, Any]], tuple[type[Exception], ...]]:
    import pint

    return _registry().get_dimensionality, (
        pint.errors.UndefinedUnitError,
        pint.errors.DefinitionSyntaxError,
        AttributeError,
    )
