"""Protection limits switched off, for tests that set the one they test."""

from __future__ import annotations

from dataclasses import fields
from math import inf
from typing import Any

from thermoctl.control.limits import Limits

KEPT = ("coil_rate_time_s", "innovation_time_s", "power_time_s", "idle_s", "amplifier_s", "agree_time_s")
"""Times, which are no limits by themselves."""
OFF: dict[str, Any] = {
    f.name: inf
    for f in fields(Limits)
    if f.default != 0.0 and f.name not in (*KEPT, "resistance_tolerance", "resistance_v")
} | {"following_s": 0.0}
