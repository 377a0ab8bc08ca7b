"""A device of this rig: its profile, its port, and the channels that are bound to roles."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

from thermoctl.rig.channels import DEFAULT, Channels
from thermoctl_hal.base.profile import Channel, Profile

EXCLUSIVE = ("slcan:", "rtu:", "/")
"""Prefixes of ports that are a path, which only one program can open at a time."""
NETWORK = "socket://"


@dataclass(frozen=True)
class Bound:
    """A channel in a role: value = raw * scale + offset in the role's unit, allowed inside [low, high]."""

    role: str
    channel: Channel
    scale: float
    offset: float
    low: float
    high: float


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
    shared: bool = False  # other devices of this rig are on the same port
    neighbours: tuple[Binding, ...] = ()  # the other devices of the port
    axis: str = ""  # whose amplifier it is; empty on a rig without axes, and for devices of several axes


def port_key(port: str) -> str:
    """Return what a port opens: the path without interface and bitrate, links followed; or its address."""
    if not port.startswith(EXCLUSIVE) or NETWORK in port:
        return re.sub(r"@\d+(,\d+)?$", "", port).removeprefix("rtu:")
    return os.path.realpath(re.sub(r"^(slcan|rtu):|@\d+(,\d+)?$", "", port))
