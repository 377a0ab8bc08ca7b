"""The latency timer of FTDI adapters, as the system's files state it."""

from __future__ import annotations

import os
from pathlib import Path


def set_latency_timer(path: str, ms: int, sys_root: str = "/sys") -> bool:
    """Set an FTDI adapter's latency timer; by default it holds bytes back for up to 16 ms.

    False when the port has no such timer or the system refuses."""
    try:
        _latency_timer(path, sys_root).write_text(str(ms))
        return True
    except OSError:
        return False


def latency_timer_ms(path: str, sys_root: str = "/sys") -> int | None:
    """Return the FTDI latency timer in ms, None when the port has no such timer (for doctor)."""
    try:
        return int(_latency_timer(path, sys_root).read_text())
    except (OSError, ValueError):
        return None


def _latency_timer(path: str, sys_root: str) -> Path:
    adapter = os.path.basename(os.path.realpath(path))
    return Path(sys_root, "bus/usb-serial/devices", adapter, "latency_timer")
