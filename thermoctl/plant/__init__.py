"""The plant language: parse, check units, compile, simulate, refit."""

from thermoctl.plant.files import extended, from_plain, load, loads, save
from thermoctl.plant.language import Plant

__all__ = ["Plant", "extended", "from_plain", "load", "loads", "save"]
