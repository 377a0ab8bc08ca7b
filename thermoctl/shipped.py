"""Where the files lie that come with the program.

Beside the package in a checkout, under share/thermoctl where a wheel put them.
"""

from __future__ import annotations

import sys
from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[1]


def shipped(folder: str) -> Path:
    """Return a folder of the distribution's, such as `config/effects` or `systemd`."""
    here = _CHECKOUT / folder
    return here if here.is_dir() else Path(sys.prefix) / "share/thermoctl" / folder
