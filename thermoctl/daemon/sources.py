"""Find the channels that a signal of the recording is computed from."""

from __future__ import annotations

from thermoctl.channels import SIGNAL

SOURCES: dict[str, tuple[str, ...]] = {
    **{signal: (role,) for role, signal in SIGNAL.items()},
    "position_um": ("position_um",),
    "compensated_um": ("position_um",),
    "power_w": ("voltage_v", "current_a"),
    "innovation_c": ("coil_c",),
    "kalman_gain": ("coil_c",),
    "air_rate_k_s": ("air_c",),
}
"""Channels that must be valid for a signal to be valid.

A computed signal may have ABSENT channels: the law does without them.
"""
