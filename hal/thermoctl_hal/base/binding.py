"""A device of this rig: its profile, its port, and the channels that are bound to roles."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass

from thermoctl.rig.channels import DEFAULT, Channels
from thermoctl_hal.base.profile import Channel, Profile

EXCLUSIVE = ("slcan:", "rtu:", "/")
"""Prefixes of ports that are a path, which only one program can open at a time."""
NETWORK = "socket://"
NO_VALUE = 9.8e37
"""Raw numbers from there on are no reading: devices with SCPI send 9.9E37 or 9.91E37 (overload, no value)."""


@dataclass(frozen=True)
class Bound:
    """A channel in a role: value = raw * scale + offset in the role's unit, allowed inside [low, high]."""

    role: str
    channel: Channel
    scale: float
    offset: float
    low: float
    high: float


def limits_of(channel: Channel) -> tuple[float, float]:
    """Return the range of a channel's readings; by default all below 9.9E37, SCPI's "no reading"."""
    most = NO_VALUE * abs(channel.scale)
    low, high = (max(-most, min(most, v)) if math.isinf(v) else v for v in channel.range)
    return low, high


@dataclass(frozen=True)
class Binding:
    """One device of this rig: its profile, port, address (for a bus that several devices share) and roles."""

    name: str
    profile: Profile
    port: str
    address: int  # node id or Modbus unit; default: the profile's
    bounds: tuple[Bound, ...]
    place: str
    channels: Channels = DEFAULT
    shared: bool = False  # are other devices of this rig on the same port?
    neighbours: tuple[Binding, ...] = ()  # other devices on the same port
    # The axis whose amplifier the device is; empty on a rig without axes, and for devices of several axes.
    axis: str = ""


def port_key(port: str) -> str:
    """Return a key of a port: its real path without interface and bitrate, or its address."""
    if not port.startswith(EXCLUSIVE) or NETWORK in port:
        return re.sub(r"@\d+(,\d+)?$", "", port).removeprefix("rtu:")
    return os.path.realpath(re.sub(r"^(slcan|rtu):|@\d+(,\d+)?$", "", port))
