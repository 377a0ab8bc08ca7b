"""Units that a channel may have in a role, and the factors to the role's own unit."""

from __future__ import annotations

import math
import re
import unicodedata

from thermoctl.units import SPELLINGS

_MARKS = r"[\s._\[\](){}]"
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "um": {"um": (1, 0), "nm": (1e-3, 0), "mm": (1e3, 0), "m": (1e6, 0), "in": (25400, 0)},
    "deg": {"deg": (1, 0), "arcsec": (1 / 3600, 0), "rad": (180 / math.pi, 0), "mrad": (0.18 / math.pi, 0)},
    "v": {"V": (1, 0), "mV": (1e-3, 0)},
    "a": {"A": (1, 0), "mA": (1e-3, 0)},
    "c": {"degC": (1, 0), "K": (1, -273.15), "degF": (5 / 9, -160 / 9)},
    "": {"1": (1, 0)},
}
"""Suffix of the role's name -> {unit: (factor, offset)}."""
_SHORT = {
    "degC": "c degcelsius grdc centigrade",
    "degF": "f degfahrenheit degreef degreesfahrenheit gradf grdf",
    "K": "degk",
    "rpm": "1/min min-1",
}
"""Unit -> further spellings that only device files have."""
_OTHERS = ("rpm", "Pa", "bar", "%")
"""Units of quantities that no role has."""
_KNOWN = {unit.lower(): unit for unit in (*_OTHERS, "V", "A", "K", "deg", "degC", "degF")}
_KNOWN |= {re.sub(_MARKS, "", s): unit for unit, words in SPELLINGS.items() for s in words.split(" | ")}
_KNOWN |= {spelling: unit for unit, spellings in _SHORT.items() for spelling in spellings.split()}
_WORDS = {"micro": "u", "milli": "m", "kilo": "k", "nano": "n", "centi": "c", "mega": "M"}
_PREFIXED = {p + u: p + u for p in "numckM" for u in ("m", "V", "A", "rad", "K", "Pa", "bar")}
"""Units with a prefix, which are written exactly so: mV is not MV."""
_DEGREES = "°˚\ufffd"  # the degree sign, its look-alikes, and a sign that no encoding knew


def role_units(role: str) -> dict[str, tuple[float, float]]:
    """Return the units that convert to a role's own: unit -> (factor, offset)."""
    return _UNITS.get(role.rsplit("_", 1)[-1], _UNITS[""])


def dbc_unit(text: str | None) -> str:
    """Return the unit of a DBC file in our spelling; an unknown unit is returned as it is."""
    plain = (
        unicodedata.normalize("NFKC", (text or "").replace("º", "°").replace("ᵒ", "°"))
        .replace("Â", "")
        .replace("μ", "u")
        .replace("µ", "u")
    )
    plain = re.sub(_MARKS, "", plain)
    for word, prefix in _WORDS.items():
        if plain.lower().startswith(word) and len(plain) > len(word):
            unit = dbc_unit(plain[len(word) :])
            plain = prefix + unit if prefix + unit in _PREFIXED else plain
    if plain in _PREFIXED:
        return _PREFIXED[plain]
    is_degree = len(plain) > 1 and plain[0] in _DEGREES
    key = ("deg" + plain[1:] if is_degree else plain).lower()
    return "um" if key in ("micron", "microns") else _KNOWN.get(key, text or "")


def is_convertible(unit: str) -> bool:
    """Return whether a unit is known, so that readings in another unit can be converted."""
    return unit in _OTHERS or unit in _PREFIXED or any(unit in u for u in _UNITS.values() if len(u) > 1)
