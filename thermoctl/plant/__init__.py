"""The plant language: parse, check units, compile, simulate, refit."""

from thermoctl.plant.language import Plant, from_plain, load, loads, save

__all__ = ["Plant", "from_plain", "load", "loads", "save"]
