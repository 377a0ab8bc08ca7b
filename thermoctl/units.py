"""Units: the dimension of a unit as text, and the factor from one to another.

    dimension("kW/m^2")        (("kg", 1), ("s", -3))
    conversion("degF", "K")    (5/9, 255.37): K = 5/9 degF + 255.37

The one table of units, for options, plants, recordings and columns. Its symbols need no pint, whose import
takes half a second.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import cache
from typing import Any

Dimension = tuple[tuple[str, Fraction], ...]
"""Sorted (base unit, exponent) pairs; () is dimensionless. None stands for 'fits anywhere'."""

_COMMON = {  # dimension: its symbols, each with its size in SI units; 0: pint has it
    "": "1 1 dimensionless 1 rad 1 mrad 1/1000 urad 1e-6 deg 0 % 1/100 percent 1/100",
    "m": "m 1 cm 1/100 mm 1/1000 um 1e-6 µm 1e-6 nm 1e-9",
    "kg": "kg 1 g 1/1000",
    "s": "s 1 ms 1/1000 us 1e-6 ns 1e-9 min 60 h 3600 d 86400",
    "A": "A 1 mA 1/1000",
    "K": "K 1 mK 1/1000 delta_degC 1 degC 0 degF 0",
    "s-1": "Hz 1 mHz 1/1000 kHz 1000 MHz 1000000 GHz 1e9",
    "kg m s-2": "N 1 mN 1/1000 kN 1000",
    "kg m-1 s-2": "Pa 1 kPa 1000 bar 100000",
    "kg m2 s-2": "J 1 kJ 1000 Wh 3600 kWh 3600000",
    "kg m2 s-3": "W 1 mW 1/1000 kW 1000 MW 1000000 VA 1 kVA 1000 var 1 kvar 1000",
    "kg m2 s-3 A-1": "V 1 mV 1/1000 kV 1000",
    "kg m2 s-3 A-2": "ohm 1 mohm 1/1000",
    "kg m2 s-2 A-2": "H 1 mH 1/1000",
    "kg-1 m-2 s4 A2": "F 1",
    "s A": "C 1",
    "kg s-2 A-1": "T 1",
    "kg m2 s-2 A-1": "Wb 1",
}
SYMBOLS = {
    symbol: (of, Fraction(size))
    for of, symbols in _COMMON.items()
    for symbol, size in zip(symbols.split()[::2], symbols.split()[1::2], strict=True)
}
"""Symbol: (dimension as text, size in SI units, 0 where only pint has it)."""
SECONDS = {symbol: float(size) for symbol, (of, size) in SYMBOLS.items() if of == "s"}
"""Seconds of a unit of time."""
SPELLINGS = {
    "degC": "celsius | °c | ℃ | degc | deg c | deg. c | grad c | degree c | degrees c | degree "
    "celsius | degrees celsius | deg_c | ºc | ˚c | oc | â°c | �c | c° | º c | grd c "
    "| degree_c | degrees_c | degree_celsius | degrees_celsius | °с | ° с",
    "degF": "fahrenheit | °f | ℉ | degf | deg f | deg. f | degree_f | degrees_f | degree_fahrenheit",
    "K": "kelvin | °k",
    "deg": "° | grad | degree | degrees",
    "h": "hr | hrs | hour | hours | stunde | stunden | std | heure | heures | hora | horas | ore | "
    "uur | 小时 | ч | час | часов | godz | godz. | timmar | timme | hod | hodin",
    "ohm": "ohms | ω | ом",
    "V": "в | volt | volts | vdc | vac | vrms | v dc | v ac | v rms | v_rms | dc v | ac v",
    "mV": "мв | millivolt | millivolts | mvdc | mvac | mv dc | mv ac",
    "A": "а | ampere | amperes | amp | amps | arms | a dc | a ac | a rms | a_rms",
    "mA": "ма | milliampere | milliamperes | milliamp | milliamps | ma dc | ma ac",
    "W": "watt | watts | вт",
    "kW": "kw | квт",
    "kWh": "kwh | квтч | квт·ч",
    "var": "var",
    "kvar": "kvar",
    "%": "percent | pct | %rh | % rh | rh% | rh % | %rf | % rf | %r.h. | % r.h. | %r.f. | % r.f.",
    "rpm": "rpm | u/min | upm | r/min | rev/min | revs/min | об/мин | tr/min | giri/min",
    "rps": "rps | u/s | r/s | rev/s | revs/s | tr/s",
    "bar": "bar | barg | bara | bar(g) | bar(a)",
    "psi": "psi | psig | psia",
    "kPa": "kpa | kpa(g) | kpa(a) | кпа",
    "MPa": "мпа",
    "hPa": "hpa",
    "L/min": "lpm | slpm | sl/min | nl/min | ln/min",
    "mL/min": "sccm",
    "ft^3/min": "cfm | scfm",
    "gallon/min": "gpm",
    "count": "count | counts | tick | ticks | inc | incr | lsb | digit | digits",
    "N": "newton | н",
    "Hz": "hertz | гц",
    "mm": "мм",
    "m": "м | meter | metre | meters | metres",
    "s": "second | seconds | sec | secs | sekunde | sekunden | sek | secondes | seconde | segundos "
    "| segundo | seg | secondi | seconden | sekunder | 秒 | сек | сек. | с | 초 | saniye | sekund",
    "ms": "millisecond | milliseconds | msec | msecs | millis | millisekunden | мс | millisecondes "
    "| milisegundos | 毫秒 | ミリ秒 | 밀리초",
    "us": "microsecond | microseconds | usec | micros | µsec | mikrosekunden | µs | мкс | 微秒",
    "ns": "nanosecond | nanoseconds | nsec | nanos",
    "min": "minute | minutes | mins | minuten | minutos | minuti | 分 | мин | мин. | 분 | dakika | minuter | minuty",
    "d": "day | days | tag | tage | jour | jours | días | dias | giorni | dagen | 天",
    "rad": "radian | radians | rads",
    "arcsec": "arcsecond | arcseconds",
    "in": "inch | inches",
    "Pa": "pascal | па",
}
"""Unit: its spellings by loggers and in device files, in lower case, separated by |."""
# Scale and offset to kelvins.
_KELVIN = {"K": (1.0, 0.0), "degC": (1.0, 273.15), "degF": (5 / 9, 459.67 * 5 / 9)}
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
_COMMON_PART = re.compile(r"([*/]?)(%|1|[A-Za-zµ]\w*)(?:(?:\*\*|\^)(\d+(?:\.\d+)?))?")
_COMMON_UNIT = re.compile(f"(?:{_COMMON_PART.pattern})+")
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_WRITTEN = {"kg m2 s-2": "J", "kg m2 s-3": "W", "kg m s-2": "N", "kg m2 s-3 A-1": "V", "kg m2 s-3 A-2": "ohm"}
_MAX_LENGTH, _MAX_EXPONENT = 100, 100


@cache
def dimension(unit: str) -> Dimension:
    """Return the dimension of a unit as pint writes it: 'W/K', 'kW/m^2', 'V**0.5/s', '%', 'N*s/m'.

    Raises ValueError."""
    if len(unit) > _MAX_LENGTH:
        raise ValueError(f"'{unit[:20]}...' is longer than {_MAX_LENGTH} letters")
    tokens, position = [], 0
    text = unit.strip()
    while position < len(text):
        match = _TOKEN.match(text, position)
        if not match:
            raise ValueError(
                f"'{unit}' is not a unit: '{text[position]}' was not expected; one such as W/K or N*s/m was"
            )
        tokens.append((match.lastgroup or "", match[match.lastgroup or 0]))
        position = match.end()
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
        raise ValueError(
            f"{given} [{described(dimension(given))}] is no {wanted} [{described(dimension(wanted))}]"
        )
    if given == wanted:
        return 1.0, 0.0
    if given in _KELVIN and wanted in _KELVIN:
        (a, b), (c, d) = _KELVIN[given], _KELVIN[wanted]
        return a / c, (b - d) / c
    if (factor := ratio(given, wanted)) is not None:
        return float(factor), 0.0
    registry = _registry()
    ends = [float(registry.Quantity(x, _spelled(given)).to(_spelled(wanted)).magnitude) for x in (0.0, 1.0)]
    return ends[1] - ends[0], ends[0]


def ratio(given: str, wanted: str) -> Fraction | None:
    """Return the size of a common unit in another one, `mm/min` included; None where pint has to tell."""
    factor = Fraction(1)
    ours, theirs = wanted.split("/"), given.split("/")
    for power, one, other in zip((1, -1), theirs, ours, strict=False):
        (kind, size), (of, per) = SYMBOLS.get(one, ("?", 0)), SYMBOLS.get(other, ("!", 0))
        if kind != of or not size or not per:
            return None
        factor *= (Fraction(size) / per) ** power
    return factor if len(ours) == len(theirs) <= 2 else None


def size_of(unit: str) -> float | None:
    """Return the size of a unit in SI units, a degree as a kelvin; None where it has an offset or no size."""
    if not _COMMON_UNIT.fullmatch(unit):
        return _size_by_pint(unit)
    size = 1.0
    for sign, symbol, power in _COMMON_PART.findall(unit):
        one = 1.0 if symbol == "degC" else float(SYMBOLS.get(symbol, ("", 0))[1])
        if not one:
            return _size_by_pint(unit)
        size *= one ** (float(power or 1) * (-1 if sign == "/" else 1))
    return size


def _size_by_pint(unit: str) -> float | None:
    registry = _registry()
    try:
        ends = [registry.Quantity(x, _spelled(unit)).to_base_units().magnitude for x in (0.0, 1.0)]
    except _pint()[1]:
        return None
    return float(ends[1]) if ends[0] == 0 else None


def without_brackets(unit: str) -> str:
    """Return V*s/A for '(V) * s / (A)'; a unit with a factor such as 10 stays as it is."""
    tokens = [(m.lastgroup or "", m[m.lastgroup or 0]) for m in _TOKEN.finditer(unit.strip())]
    before = [("", ""), *tokens]
    if "(" not in unit or any(
        kind == "number" and text != "1" and before[k][0] != "power" for k, (kind, text) in enumerate(tokens)
    ):
        return unit
    powers, _ = _product(tokens, 0, lambda symbol: ((symbol, Fraction(1)),))
    shown = [(s, p > 0, "" if abs(p) == 1 else f"**{float(abs(p)):g}") for s, p in powers]
    over = "*".join(s + power for s, above, power in shown if above)
    return (over or "1") + "".join(f"/{s}{power}" for s, above, power in shown if not above)


def _spelled(unit: str) -> str:
    plain = unit.replace("°C", "degC").replace("°", "deg").translate(_RAISED)
    return "dimensionless" if plain == "1" else plain


Tokens = list[tuple[str, str]]
Leaf = Callable[[str], Dimension]


def _product(tokens: Tokens, position: int, leaf: Leaf | None = None) -> tuple[Dimension, int]:
    total, position = _factor(tokens, position, leaf)
    while position < len(tokens) and tokens[position][1] != ")":
        sign = -1 if tokens[position][1] == "/" else 1
        if tokens[position][0] == "op" and tokens[position][1] != "(":
            position += 1
        factor, position = _factor(tokens, position, leaf)
        total = times(total, factor, sign)
    return total, position


def _factor(tokens: Tokens, position: int, leaf: Leaf | None) -> tuple[Dimension, int]:
    kind, text = tokens[position]
    position += 1
    if text == "(":
        base, position = _product(tokens, position, leaf)
        if tokens[position][1] != ")":
            raise ValueError("')' was expected")
        position += 1
    elif kind == "symbol":
        base = (leaf or _symbol)(text)
    elif kind == "number" and text[0] not in "+-":
        base = ()
    else:
        raise ValueError(f"'{text}' was not expected")
    if position < len(tokens) and tokens[position][0] == "raised":
        return raised(base, float(tokens[position][1].translate(_RAISED))), position + 1
    if position < len(tokens) and tokens[position][0] == "power":
        position += 1
        closing = tokens[position][1] == "("
        position += closing
        if tokens[position][0] != "number":
            raise ValueError(f"the exponent '{tokens[position][1]}' is not a number")
        base = raised(base, float(tokens[position][1]))
        position += 1
        if closing:
            if tokens[position][1] != ")":
                raise ValueError("')' was expected")
            position += 1
    return base, position


@cache
def _symbol(symbol: str) -> Dimension:
    if symbol in SYMBOLS:
        pairs = re.findall(r"([A-Za-z]+)(-?\d*)", SYMBOLS[symbol][0])
        return tuple(sorted((base, Fraction(int(power or 1))) for base, power in pairs))
    lookup, undefined = _pint()
    try:
        powers = lookup(symbol.replace("°C", "degC").replace("°", "deg"))
    except undefined:
        raise ValueError(f"pint knows no unit '{symbol}'") from None
    if not set(powers) <= set(_BASES):
        raise ValueError(f"'{symbol}' is no unit of physics that a plant may use")
    return tuple(
        sorted(
            (_BASES[key], Fraction(power).limit_denominator(10_000)) for key, power in powers.items() if power
        )
    )


@cache
def _registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry(on_redefinition="ignore")
    registry.define("newton_meter = newton * meter = Nm")  # pint's Nm measures yarn
    registry.define("newton_centimeter = newton_meter / 100 = Ncm")
    return registry


@cache
def _pint() -> tuple[Callable[[str], Mapping[str, Any]], tuple[type[Exception], ...]]:
    import pint

    return _registry().get_dimensionality, (
        pint.errors.UndefinedUnitError,
        pint.errors.DefinitionSyntaxError,
        AttributeError,
    )


def times(a: Dimension, b: Dimension, sign: int = 1) -> Dimension:
    """Return the dimension of a product, or with sign -1 of a quotient."""
    total = dict(a)
    for base, exponent in b:
        total[base] = total.get(base, Fraction(0)) + sign * exponent
    return tuple(sorted((base, exponent) for base, exponent in total.items() if exponent))


def raised(base: Dimension, exponent: float) -> Dimension:
    """Return the dimension of a power. Raises ValueError for an exponent beyond _MAX_EXPONENT."""
    if not abs(exponent) <= _MAX_EXPONENT:
        raise ValueError(f"the exponent {exponent:g} is beyond {_MAX_EXPONENT}")
    k = Fraction(exponent).limit_denominator(10_000)
    return tuple((name, q) for name, power in base if (q := (power * k).limit_denominator(10_000)))


def described(d: Dimension) -> str:
    """Return text such as kg m2 s-3, with the derived unit if there is one."""
    order = {b: i for i, b in enumerate(_BASES.values())}
    written = " ".join(
        f"{base}{'' if q == 1 else q if q.denominator == 1 else f'^({q})'}"
        for base, q in sorted(d, key=lambda pair: (pair[0] != "kg", order.get(pair[0], 99)))
    )
    return f"{_WRITTEN[written]} = {written}" if written in _WRITTEN else written or "dimensionless"


def readable_time(seconds: float) -> str:
    """Return a time in its largest unit of which it has two: 90 s, 12.5 min, 3.1 h, 5 days, 40 years."""
    sizes = {"years": 365.2425 * SECONDS["d"], "days": SECONDS["d"], "h": SECONDS["h"], "min": SECONDS["min"]}
    name, size = next(((n, s) for n, s in sizes.items() if seconds >= 2 * s), ("s", 1.0))
    return f"{seconds / size:.3g} {name}"
