"""The plant language: parse, check units, compile, simulate, refit.

The names are loaded when one of them is used: `thermoctl --help` reads this package's table of commands only.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermoctl.plant.files import extended, from_plain, load, loads, save
    from thermoctl.plant.language import Plant

__all__ = ["Plant", "extended", "from_plain", "load", "loads", "save"]


def __getattr__(name: str) -> Any:
    """Return a public name. Raises AttributeError for any other."""
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    home = "language" if name == "Plant" else "files"
    return getattr(importlib.import_module(f"{__name__}.{home}"), name)
