"""Parameters of the law for tests: limits switched off, and a number for each channel."""

from __future__ import annotations

from dataclasses import fields
from math import inf
from typing import Any

import numpy as np

from thermoctl.control.limits import Limits
from thermoctl.rig.channels import CHANNELS, INDEX

KEPT = ("coil_rate_time_s", "innovation_time_s", "power_time_s", "idle_s", "amplifier_s", "agree_time_s")
"""Times, which are no limits by themselves."""
OFF: dict[str, Any] = {
    f.name: inf
    for f in fields(Limits)
    if f.default != 0.0 and f.name not in (*KEPT, "resistance_tolerance", "resistance_v")
} | {"following_s": 0.0}


def channels(default: float, **given: float) -> np.ndarray:
    """Return `default` for every channel but those that are given."""
    array = np.full(len(CHANNELS), float(default))
    for name, number in given.items():
        array[INDEX[name]] = number
    return array
