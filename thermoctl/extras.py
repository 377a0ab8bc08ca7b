"""Packages that come with an extra of the installation, and the line that names the extra to install."""

from __future__ import annotations

import importlib
from typing import Any

from thermoctl.files.yamlfile import InputError

EXTRAS = {
    "rig": {
        "serial": "pyserial",
        "can": "python-can",
        "pymodbus": "pymodbus",
        "canopen": "canopen",
        "cantools": "cantools",
    },
    "ethercat": {"pysoem": "pysoem"},
    "report": {"matplotlib": "matplotlib"},
    "formats": {
        "asammdf": "asammdf",
        "h5py": "h5py",
        "matio": "mat-io",
        "mcap": "mcap",
        "nptdms": "npTDMS",
        "openpyxl": "openpyxl",
    },
    "mqtt": {"paho": "paho-mqtt"},
    "fmu": {"fmpy": "FMPy"},
    "fleet": {"dask": "dask", "distributed": "distributed", "fsspec": "fsspec"},
}
"""The package to install by the name that is imported, for each extra of pyproject.toml."""


def lacking(error: ImportError) -> str | None:
    """Return what to install for a failed import; None where no extra brings the module."""
    module = (error.name or "").partition(".")[0]
    for extra, packages in EXTRAS.items():
        if module in packages:
            return f"needs the package '{packages[module]}': pip install 'thermoctl[{extra}]'"
    return None


def load(module: str, purpose: object) -> Any:
    """Import a module of an extra. Raises InputError, which begins with what needs it."""
    try:
        return importlib.import_module(module)
    except ImportError as e:
        if (line := lacking(e)) is None:
            raise
        raise InputError(f"{purpose}: {line}") from None
