"""Bindings: each item of `hal.devices` binds a profile to a port, and its channels to roles.

Also the checks that need every binding of a rig at once.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from hal.backend import ROLES
from hal.profile import Channel, Cia402, Modbus, Profile, Register
from hal.read_profile import load_profile
from hal.units import role_units
from thermoctl.yamlfile import InputError, Node, Section, suggest

EXCLUSIVE = ("slcan:", "rtu:", "/")
"""Prefixes of ports that only one program can open at a time."""
_MANUAL_BASES = ((30001, "input"), (40001, "holding"))
_MANUAL_REGISTERS = 9999
"""Manuals often number input registers 30001..39999 and holding registers 40001..49999, from address 0."""


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


def resolve_port(port: str, folder: Path) -> str:
    """Return the port with a relative path ('../run/encoder', 'slcan:./can') taken from `folder`."""
    match = re.fullmatch(r"((?:slcan:|rtu:)?)(\.\.?/.*)", port)
    if match is None:
        return port
    path = Path(match[2])  # do not follow the last part: the port is the link itself, not its present target
    return f"{match[1]}{(folder / path.parent).resolve() / path.name}"


def bind(node: Node, folder: Path) -> Binding:
    """Read one item of `hal.devices`.

    {profile, port, roles: {channel: role}, name?, address?, stale_after_s?, watchdog_s?, master_id?};
    `profile` is relative to `folder`. stale_after_s and watchdog_s replace the profile's values on a machine
    that is too slow for them. master_id replaces our node id when another device of the bus has it. Raises
    InputError: unknown channel, unknown role, unit that does not fit the role."""
    s = Section(node, "device")
    path = folder / s.text("profile")
    if not path.is_file():
        raise s.get("profile").error(f"profile: {path} cannot be read: no such file")
    profile = load_profile(path)
    if (stale := s.number("stale_after_s", 0.0, 1e-4, 3600.0)) > 0.0:
        channels = {n: replace(c, stale_after_s=stale) for n, c in profile.channels.items()}
        profile = replace(profile, channels=channels)
    bounds = tuple(
        _bound(profile, name, role) for name, role in Section(s.get("roles"), "roles").node.value.items()
    )
    spec = profile.bus_spec
    if isinstance(spec, Cia402):
        address = s.integer("address", spec.node_id, 1, 126)
        profile = replace(profile, bus_spec=_drive_of_this_rig(s, spec, address))
    else:
        address = s.integer("address", spec.unit_id if isinstance(spec, Modbus) else 0, 0, 247)
        for key in ("watchdog_s", "master_id"):
            if (found := s.get(key, False)) is not None:
                raise found.error(f"{key}: a {profile.bus} device has none")
    port = resolve_port(s.text("port"), folder)
    binding = Binding(s.text("name", profile.model), profile, port, address, bounds, node.place)
    s.end()
    return binding


def _drive_of_this_rig(s: Section, spec: Cia402, node: int) -> Cia402:
    """Return the drive's description with the binding's watchdog and our own node id.

    Our node id is the binding's, else the profile's, else 127 - the drive's."""
    watchdog = s.number("watchdog_s", spec.watchdog_s, 2 * spec.heartbeat_s, 10.0)
    master = s.integer("master_id", spec.master_id or 127 - node, 1, 127)
    if master == node:
        raise s.node.error(
            f"master_id: {master} is the drive's own node id; the drive would watch itself: choose one that is "
            "free on the bus"
        )
    return replace(spec, watchdog_s=watchdog, master_id=master)


def _bound(profile: Profile, name: str, role: Node) -> Bound:
    channel = profile.channels.get(name)
    if channel is None:
        raise role.error(
            f"roles: {profile.model} has no channel '{name}'{suggest(name, profile.channels)}; "
            f"it has {', '.join(profile.channels)}"
        )
    if role.value not in ROLES:
        raise role.error(
            f"roles: '{role.value}' is no role{suggest(role.value, ROLES)}; roles: {', '.join(ROLES)}"
        )
    units = role_units(role.value)
    if channel.unit not in units:
        raise role.error(
            f"roles: channel '{channel.name}' is in {channel.unit}, the role {role.value} takes "
            f"{' or '.join(units)}"
        )
    factor, shift = units[channel.unit]
    return Bound(
        role.value,
        channel,
        channel.scale * factor,
        channel.offset * factor + shift,
        channel.range[0] * factor + shift,
        channel.range[1] * factor + shift,
    )


def check_rig(bindings: Iterable[Binding]) -> None:
    """Raise InputError where two devices share a role, the command or an exclusive port."""
    claimed: dict[str, Binding] = {}
    opened: dict[str, Binding] = {}
    for b in bindings:
        if (first := opened.setdefault(_exclusive_port(b), b)) is not b and b.port.startswith(EXCLUSIVE):
            raise InputError(
                f"{b.place}: {b.name} and {first.name} ({first.place}) both open {b.port}, which one device can "
                "open once; give each an adapter of its own, or read both as channels of one profile"
            )
        for role in [x.role for x in b.bounds] + (["drive"] if b.profile.amplifier else []):
            if role in claimed:
                raise InputError(
                    f"{b.place}: '{role}' is given by {b.name} and by {claimed[role].name} "
                    f"({claimed[role].place}); keep one of them"
                )
            claimed[role] = b


def _exclusive_port(b: Binding) -> str:
    """Return the port without interface and bitrate, links followed: one device may have it."""
    if not b.port.startswith(EXCLUSIVE):
        return b.port
    return os.path.realpath(re.sub(r"^(slcan|rtu):|@\d+$", "", b.port))


def rig_notes(bindings: Iterable[Binding]) -> list[str]:
    """Return a line for each setting that is allowed but probably a mistake (for `thermoctl check`)."""
    notes = []
    bindings = list(bindings)
    if not any(b.profile.amplifier for b in bindings):
        notes.append(
            "no device takes the command (a can-cia402 profile with 'drive'): this rig measures, it cannot be driven"
        )
    for b in bindings:
        for x in b.bounds:
            if isinstance(x.channel.source, Register) and (hint := register_hint(x.channel.source.address)):
                notes.append(f"{x.channel.place}: register {x.channel.source.address}: {hint}")
    return notes


def register_hint(address: int) -> str:
    """Return the kind and address meant by a manual that counts registers from 30001 or 40001, else ''."""
    for base, kind in _MANUAL_BASES:
        if base <= address < base + _MANUAL_REGISTERS:
            return (
                f"addresses count from 0; where the manual calls it {address}, it is kind: {kind}, "
                f"register: {address - base}"
            )
    return ""
