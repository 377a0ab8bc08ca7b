"""thermoctl: thermal compensation of a precision linear actuator, and diagnosis of missing physics.

    import thermoctl as tc
    plant = tc.load_plant("plant.yaml")
    result = tc.diagnose(plant, ["run_1.csv", frame])

The functions are those of `thermoctl.api`, loaded when one of them is used. `__init__.pyi` lists them.
"""

import importlib
import re
from pathlib import Path
from typing import Any

__version__ = "0.1.0"
_API = re.findall(r" as (\w+)$", Path(__file__).with_suffix(".pyi").read_text(), re.MULTILINE)


def __getattr__(name: str) -> Any:
    """Return a name of the Python interface. Raises AttributeError for any other."""
    if name not in _API:
        raise AttributeError(f"module 'thermoctl' has no attribute '{name}'")
    return getattr(importlib.import_module("thermoctl.api"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return ["__version__", *_API]
