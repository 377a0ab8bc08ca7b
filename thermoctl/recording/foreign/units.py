"""Names and units as loggers write them: a time in any language, a counter, symbols, brackets, scales."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import yaml

from thermoctl.units import SECONDS, SPELLINGS, conversion, dimension, ratio

WORDS: dict[str, Any] = yaml.load(
    Path(__file__).with_name("words.yaml").read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader)
)
"""Words that loggers use, by kind."""
# Symbols that make `(...)` behind a name a unit; square brackets always hold one.
_SYMBOL = (
    r"(?:degC|degF|deg|%|°|rad|min|h|hr|d|ppm|ppb|bar|psi|mmHg|inHg|lbf|lb|kgf|ft|gallon|rpm|rps|kn|mph|atm|torr|dBm|dB|"
    r"(?:da|[fpnuµmcdhkMGT])?(?:m|g|s|A|K|V|W|J|N|Pa|Hz|Ω|ohm|F|H|C|T|Wh|l|L|mol|bar|VA|var|S|Nm|Ncm|eV|Wb|lx|rad|Ah))"
)
ANGLES = (), dimension("Hz")  # dimensions in which pint takes a radian for 1 and a turn for 2 pi
_POWER = r"(?:(?:\^|\*\*)?-?\d|[²³⁻¹]+)?"
_UNIT = re.compile(rf"1$|(?:1/)?{_SYMBOL}{_POWER}(?:[*/·. ]\(?{_SYMBOL}{_POWER}\)?)*$")
_NAMED = re.compile(r"(.*?\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*(?:\([^()]*\))?[^()]*)\)|\s/\s*(\S+))$")
# `Temp. °C`, `Humidity%RH`; CH1V of an oscilloscope.
_LAST = re.compile(r"(.*[^\s,(\[/])(?:\s*(°\s?[CF]|℃|℉|%\s?RH)|\s+([Dd]eg\.? ?[CF]))$|(CH\d+)([VA])$")
WIDE = str.maketrans("（）［］，：％", "()[],:%")  # as Chinese and Japanese keyboards write them
_SCALE = re.compile(r"(?i)(?:^|[\W_])(celsius|fahrenheit|kelvin)$")
# A number that no letter precedes, and the word behind it.
_FACTOR = re.compile(r"(?:(?<![^\W_])[x×]?|(?<=\de))[\d.,^/-]*\d\s*\*?\s*([^\W\d_]+)")
# ts and rn are Campbell's.
_NO_UNITS = {"", "-", "–", "--", "none", "(none)", "ts", "rn", "0/1", "1/0", *WORDS["pairs"].split()}
_SPELLED = {word: unit for unit, words in SPELLINGS.items() for word in words.split(" | ")}


def spelled(unit: str | None, name: str = "") -> str | None:
    """Return a unit as pint writes it: °C is degC, Volts is V; None where nothing is stated.

    C and F are degrees, but of a charge or a capacity."""
    if unit in ("C", "F") and not re.search(r"(?i)charge|ladung|capa|kapa|^[qc]([_ 0-9]|$)|\bd?q\b", name):
        return f"deg{unit}"
    unit = re.sub(r"\s+", " ", (unit or "").strip()).replace("μ", "µ")
    if unit.lower() in _SPELLED and unit not in ("Grad", "STD", "Std"):
        return _SPELLED[unit.lower()]
    unit = re.sub(r"°\s?C|℃|\bdeg\.? ?C\b", "degC", unit)
    unit = re.sub(r"°\s?F|℉|\bdeg\.? ?F\b", "degF", unit)
    unit = re.sub("Ω|Ω|Ohm", "ohm", unit)
    if _UNIT.match(unit):  # N.m and m/s2
        unit = re.sub(r"(?<=[^\W\d_])[.· ](?=[^\W\d_])", "*", unit)
        unit = re.sub(r"(?<=[^\W\d_])(?=-?\d)", "^", unit)
    return unit if unit.lower() not in _NO_UNITS else None


def time_unit(unit: str) -> str | None:
    """Return the unit of a time in any case: s of `S` and `Sec.`, ms of `MSEC`; None for another unit."""
    words = (unit, unit.lower().rstrip("."))
    return next((short for word in words if (short := spelled(word)) in SECONDS), None)


def interval(text: str) -> float | None:
    """Return the seconds of `0.08s` or `10 ms`; None for another text."""
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*([^\W\d]+)", text.strip())
    unit = time_unit(match[2]) if match else None
    return float(match[1]) * SECONDS[unit] or None if match and unit else None


def known(unit: str) -> bool:
    """Return whether a text is a unit by its symbols or words."""
    written = spelled(unit)
    return written is not None and bool(_UNIT.match(written))


def has_factor(unit: str) -> bool:
    """Return whether a unit of time or another states a factor: `0.1 ms`, `x10 W`, `1/100 s`, `1e3 W`."""
    found = _FACTOR.findall(unit)
    return not known(unit) and any(time_unit(word) or known(word) for word in found)


def split_unit(header: str) -> tuple[str, str | None]:
    """Return name and unit of `T_block [degC]`, `T_block (degC)`, `T_block / °C`; None for no unit."""
    text = header.strip().translate(WIDE)
    match = _NAMED.match(text)
    if not match:
        word = _SCALE.search(text)  # the name keeps it
        return text, spelled(word[1]) if word else None
    name, square, bracket, slash = match.groups()
    unit = (square if square is not None else bracket if bracket is not None else slash).strip()
    if square is not None and known(name) and not (known(unit) or has_factor(unit)):  # °C [Kanal 1] of Testo
        return unit, spelled(name, unit)
    if unit == "h" and re.fullmatch(r"[A-Z]\w?\(h\)", text):  # G(h) of PVGIS: on the horizontal plane
        return text, None
    if unit.isdigit() and (unit != "1" or not text[match.end(1)].isspace()):  # motor[1] is a motor
        return text, None
    if square is None and not known(unit):
        return text, None
    return name.strip(), spelled(unit, name)


def split_words(header: str) -> tuple[str, str | None]:
    """Return name and unit of a header that also may be `Temp, °C (LGR S/N: 7)` or `Spannung in V`.

    HOBOlink has `Temp - °C (S-THB 10253456:1)`, COMSOL `T (degC), Point 1`."""
    text = re.sub(
        r"\s*\((?:(?:LGR|SEN|LBL)[^)]*|-|TimeStep|Hourly|Daily|Monthly|RunPeriod)\)",
        "",
        header.strip().translate(WIDE),
    )
    if match := _LAST.match(text):
        name, unit = match[1] or match[4], match[2] or match[3] or match[5]
        name = re.sub(r"\s+in$", "", name)  # `Temperatur in °C`
        return (text, None) if name == "in" else (name, spelled(unit, name))
    name, unit = split_unit(text)
    if unit is not None:
        return name, unit
    bare = re.sub(r"\s*\([^()]*\d{6}[^()]*\)$", "", text)  # a serial number
    match = re.match(r"(.*?\S)(?:\s*,\s*|\s+in\s+|\s+-\s+)(\S+(?: [CF])?)$", bare)
    if match and known(match[2]) and not re.search(r"\s-\s+\w$", bare):  # `Phase - A`
        return match[1], spelled(match[2], match[1])
    match = re.match(r"(\S.*?)\s+\(([^()]+)\),\s*(.+)$", text)  # T (degC), Point Probe 1
    if match and known(match[2]):
        return f"{match[1]}, {match[3]}", spelled(match[2], match[1])
    return name, unit


def split_slash(header: str) -> tuple[str, str | None]:
    """Return name and unit of a header that also may be `I/mA` or `Capacity/mAh/g`; W/m2 is a unit."""
    first, last = header.partition("/"), header.rpartition("/")
    name, _, unit = first if known(first[2]) else last
    is_name = name == "T" or (name and not known(name))  # T/°C is no tesla
    return (name, spelled(unit, name)) if is_name and known(unit) else split_words(header)


def column_of(name: str, columns: Container[str], units: Mapping[str, str]) -> str | None:
    """Return the column of a name, also of one with its unit as in the file's header; None without one."""
    plain, unit = split_words(name)
    return name if name in columns else plain if plain in columns and unit == units.get(plain) else None


def scale_between(unit: str | None, other: str | None) -> float | None:
    """Return the factor from one unit to another of the same dimension; None if there is none."""
    if unit == other:
        return 1.0
    if (factor := ratio(unit or "", other or "")) is not None:
        return float(factor)
    try:
        if dimension(unit or "") in ANGLES:
            return None
        scale, offset = conversion(unit or "", other or "")
    except ValueError:
        return None
    return scale if offset == 0.0 else None


NAMED, COUNTED = 30, -30  # points for a name of times, for a name of a counter
_TIMES = WORDS["times"].split()
_COUNTERS = WORDS["counters"].split()
_OTHERS = WORDS["other_times"].split()
_UNIT_NAMES = {*WORDS["units"].split()}
MOST_WORDS = 3  # largest number of words in a counter's name
_STEPS = ("step", "index", "number", "no", "nr", "count", "id", "idx")
NO_NAME = re.compile(r"column_\d+$")  # column of a table without a header
_PARTS = re.compile(r"[^\W\d_]+|#|n[°º]", re.UNICODE)


def tokens(name: str) -> list[str]:
    """Return the words of a name in lower case: time, ms of `Time_ms` and of `timeMs`."""
    split = re.sub(r"([a-zäöü])([A-Z])", r"\1 \2", name)
    return [p.lower() for p in _PARTS.findall(split)]


def named(name: str) -> int:
    """Return points for a name: of times in any language, of a counter, of another time than the clock."""
    words = tokens(name)
    if name.strip() == "T":  # t is a time, T a temperature
        return 0
    if any(w in _OTHERS for w in words):
        return -NAMED
    if 1 < len(words) <= MOST_WORDS and words[-1] in _STEPS:  # `Time Step` counts
        return COUNTED
    if re.fullmatch(r"t|ts|t[_ ]?(s|ms|us|ns|min|h|d|sec|msec)", name.strip()):
        return NAMED
    # `data` is a date in Italian, and values in English.
    words = [w for k, w in enumerate(words) if w != "data" or k == 0]
    if any(w in _TIMES for w in words) or re.match(r"(?i)(date|time|zeit|datum|timestamp)", "".join(words)):
        return NAMED
    if "#" in name or any(w in _COUNTERS for w in words[:1]):
        return COUNTED
    return 0


def states_unit_of(name: str, before: str) -> bool:
    """Return whether a column of texts is named as the unit of the one before it: Unit, `Main Unit`."""
    words = set(tokens(re.sub("_of_measurement|^attributes_", "", name)))
    others = words - _UNIT_NAMES
    return named(before) <= 0 and others < words and others <= set(tokens(before))


def is_generic(name: str) -> bool:
    """Return whether a first column's name says that it is what the others are drawn over."""
    return bool(
        re.fullmatch(r"(?i)|column_1|unnamed: 0|x([ _-]?(value|axis|data|wert|achse))?", name.strip())
    )


def unit_of_time(name: str, unit: str | None, is_time: bool = False) -> str | None:
    """Return the unit of time that a header states, in brackets or as a word of the name.

    `is_time`: the column is a time whatever its name, so that S is the second and not the siemens."""
    if unit is not None:
        if is_time or named(name) > 0:
            return time_unit(unit)
        return short if (short := spelled(unit)) in SECONDS else None
    before = re.match(r"(.+?)(?:/| per )", name)
    if before and named(before[1]) <= 0:  # m/s and W per hour are rates
        return None
    words = tokens(name)
    for word in reversed(words):
        short = spelled(word)
        if (
            short in SECONDS
            and (len(word) > 1 or (len(words) > 1 and word == words[-1]))
            and word not in ("tag", "day")
        ):
            return short
    return None
