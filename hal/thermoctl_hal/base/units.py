"""Units that a channel may have in a role, and the factors to the role's own unit."""

from __future__ import annotations

import math

_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "um": {"um": (1, 0), "nm": (1e-3, 0), "mm": (1e3, 0), "m": (1e6, 0), "in": (25400, 0)},
    "deg": {"deg": (1, 0), "arcsec": (1 / 3600, 0), "rad": (180 / math.pi, 0), "mrad": (0.18 / math.pi, 0)},
    "v": {"V": (1, 0), "mV": (1e-3, 0)},
    "a": {"A": (1, 0), "mA": (1e-3, 0)},
    "c": {"degC": (1, 0), "K": (1, -273.15), "degF": (5 / 9, -160 / 9)},
    "": {"1": (1, 0)},
}
"""Suffix of the role's name -> {unit: (factor, offset)}."""
_DBC_UNITS = {"°C": "degC", "C": "degC", "deg C": "degC", "Celsius": "degC", "µm": "um", "μm": "um"}
"""Spelling of a unit in DBC files -> our spelling, where they differ."""


def role_units(role: str) -> dict[str, tuple[float, float]]:
    """Return the units that convert to a role's own: unit -> (factor, offset)."""
    return _UNITS.get(role.rsplit("_", 1)[-1], _UNITS[""])


def dbc_unit(text: str | None) -> str:
    """Return the unit of a DBC file in our spelling."""
    return _DBC_UNITS.get(text or "", text or "")


def is_convertible(unit: str) -> bool:
    """Return whether another unit of the same quantity is known."""
    return any(unit in units for units in _UNITS.values() if len(units) > 1)
