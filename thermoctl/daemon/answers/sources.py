"""Find the channels that a signal of the recording is computed from."""

from __future__ import annotations

from thermoctl.rig.channels import FIXED, Channels

FIXED_SOURCES: dict[str, tuple[str, ...]] = {
    **{c.signal: (c.role,) for c in FIXED},
    "position_um": ("position_um",),
    "compensated_um": ("position_um",),
    "power_w": ("voltage_v", "current_a"),
    "air_rate_k_s": ("air_c",),
}
"""Channels that must be valid for a signal of every rig to be valid.

A computed signal may have ABSENT channels: the law does without them.
"""


def sources(channels: Channels) -> dict[str, tuple[str, ...]]:
    """Return, by signal, the channels that it is computed from, for a rig with these channels."""
    return {
        **FIXED_SOURCES,
        **{role: (role,) for role in channels.temperatures},
        "innovation_c": (channels.coil,),
        "kalman_gain": (channels.coil,),
    }
