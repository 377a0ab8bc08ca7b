"""Find the files that come with the program.

They lie beside the package in a checkout, and under share/thermoctl after installation from a wheel.
"""

from __future__ import annotations

import sys
from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[1]


def shipped(folder: str) -> Path:
    """Return a folder of these files, such as `config/effects` or `systemd`."""
    here = _CHECKOUT / folder
    return here if here.is_dir() else Path(sys.prefix) / "share/thermoctl" / folder
