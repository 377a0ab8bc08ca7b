"""Read bindings: each item of `hal.devices` binds a profile to a port, and its channels to roles.

Also the checks that need every binding of a rig at once.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from thermoctl.files.yamlfile import InputError, Node, Section, kind_of, suggest
from thermoctl.rig.channels import DEFAULT, AxesChannels, Channels
from thermoctl_hal.base.binding import Binding, Bound, limits_of, port_key
from thermoctl_hal.base.profile import BinaryFrame, BusSpec, Cia402, Dbc, Modbus, Profile, Register, TextLine
from thermoctl_hal.base.units import role_units
from thermoctl_hal.can.eds import read_eds
from thermoctl_hal.can.set_up import Objects
from thermoctl_hal.ethercat.read import LONGEST_WATCHDOG_S, Ethercat
from thermoctl_hal.modbus.read import register_hint
from thermoctl_hal.profiles.buses import BUSES
from thermoctl_hal.profiles.read import load_profile

LAST_ON_A_LINE, LAST_ON_TCP = 247, 255  # units of Modbus; a gateway's own is 255
FREE = ("socketcan", "virtual", "udp_multicast")
"""CAN interfaces that any number of devices may open."""


def resolve_port(port: str, folder: Path) -> str:
    """Return the port with a relative path ('../run/encoder', 'slcan:./can') taken from `folder`."""
    match = re.fullmatch(r"((?:slcan:|rtu:)?)(\.\.?/.*)", port)
    if match is None:
        return port
    path = Path(match[2])  # do not follow the last part: the port is the link itself, not its present target
    return f"{match[1]}{(folder / path.parent).resolve() / path.name}"


def bind(node: Node, folder: Path, channels: Channels = DEFAULT) -> Binding:
    """Read one item of `hal.devices`; `channels`: those of the rig.

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
        aged = {n: replace(c, stale_after_s=stale) for n, c in profile.channels.items()}
        profile = replace(profile, channels=aged)
    bounds = tuple(
        _bound(profile, name, role, channels)
        for name, role in Section(s.get("roles"), "roles").node.value.items()
    )
    spec = profile.bus_spec
    if isinstance(spec, Cia402):
        address = s.integer("address", spec.address, 1, 126)
        profile = replace(profile, bus_spec=_drive_of_this_rig(s, spec, address))
        if profile.amplifier is not None:
            counts = profile.amplifier.counts
            Objects(spec, profile.file, address).within(
                spec.command, "drive: 'limits' / 'scale'", min(counts), max(counts)
            )
    elif isinstance(spec, Ethercat):
        address = s.integer("address", spec.address, 1, 199)
        if (watchdog := s.number("watchdog_s", 0.0, 1e-3, LONGEST_WATCHDOG_S)) > 0.0:
            profile = replace(profile, bus_spec=replace(spec, watchdog_s=watchdog))
    else:
        address = _address(s, spec)
        for key in ("watchdog_s", "master_id"):
            if (found := s.get(key, False)) is not None:
                raise found.error(f"{key}: a {profile.bus} device has none")
    port = _port(s, profile, folder)
    name = s.text("name", profile.model)
    axis = _axis(s, bounds, channels) if profile.amplifier is not None else ""
    s.end()
    return Binding(name, profile, port, address, bounds, node.place, channels, axis=axis)


def _port(s: Section, profile: Profile, folder: Path) -> str:
    """Return the port. Raises InputError where the profile's bus has no such port."""
    text = s.text("port")
    pattern, words = BUSES[profile.bus].ports
    if not re.fullmatch(pattern, text):
        raise s.get("port").error(
            f"port: '{text}' is no port of a {profile.bus} device; {words} was expected"
        )
    return resolve_port(text, folder)


def _axis(s: Section, bounds: Iterable[Bound], channels: Channels) -> str:
    """Return the axis that an amplifier drives: that of its roles. Raises InputError for none or several."""
    if not isinstance(channels, AxesChannels):
        return ""
    axes = {b.role.partition(".")[0] for b in bounds}
    if len(axes) != 1 or not axes <= set(channels.parts):
        raise s.node.error(
            f"roles: an amplifier has roles of the one axis that it drives, written AXIS.CHANNEL (axes: "
            f"{', '.join(channels.parts)}); found {', '.join(b.role for b in bounds) or 'none'}"
        )
    return axes.pop()


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


def _bound(profile: Profile, name: str, role: Node, channels: Channels) -> Bound:
    channel = profile.channels.get(name)
    if channel is None:
        raise role.error(
            f"roles: {profile.model} has no channel '{name}'{suggest(name, profile.channels)}; "
            f"it has {', '.join(profile.channels)}"
        )
    if not isinstance(role.value, str):
        raise role.error(f"roles: the role of '{name}' was expected, found {kind_of(role)}")
    if role.value not in channels.index:
        raise role.error(
            f"roles: '{role.value}' is no role{suggest(role.value, channels.index)}; "
            f"roles: {', '.join(channels.index)}"
        )
    units = role_units(role.value)
    if channel.unit not in units:
        raise role.error(
            f"roles: channel '{channel.name}' is in {channel.unit}, the role {role.value} takes "
            f"{' or '.join(units)}"
        )
    factor, shift = units[channel.unit]
    low, high = limits_of(channel)
    return Bound(
        role.value,
        channel,
        channel.scale * factor,
        channel.offset * factor + shift,
        low * factor + shift,
        high * factor + shift,
    )


def _address(s: Section, spec: BusSpec) -> int:
    """Return the unit of a Modbus device, the node of a CAN device. Raises InputError."""
    modbus = isinstance(spec, Modbus)
    far = isinstance(spec, Dbc) or (modbus and s.text("port").startswith("tcp:"))
    address = s.integer("address", spec.address, 0, LAST_ON_TCP if far else LAST_ON_A_LINE)
    if modbus and address == 0 and not far:
        raise s.node.error(
            f"address: 0 is the broadcast, which no unit answers; give the unit's own, 1 .. {LAST_ON_A_LINE}"
        )
    if address > LAST_ON_A_LINE and not far:
        raise s.node.error(f"address: {address} is outside 0 .. {LAST_ON_A_LINE} of a serial line")
    return address


def check_rig(bindings: Iterable[Binding]) -> list[Binding]:
    """Return the bindings with `shared` and `neighbours` set where several are on one port.

    Raises InputError where two share a role or the command, or a port that they cannot share."""
    bindings = list(bindings)
    claimed: dict[str, Binding] = {}
    for b in bindings:
        drive = [f"{b.axis}.drive" if b.axis else "drive"] if b.profile.amplifier else []
        places = [r for x in b.bounds for r in (b.channels.index[x.role], *_copies(b.channels, x.role))]
        for role in [*(b.channels.names[k] for k in places), *drive]:
            if role in claimed:
                raise InputError(
                    f"{b.place}: '{role}' is given by {b.name} and by {claimed[role].name} "
                    f"({claimed[role].place}); keep one of them"
                )
            claimed[role] = b
    checked = []
    for k, b in enumerate(bindings):
        others = [o for o in bindings if o is not b and port_key(o.port) == port_key(b.port)]
        for o in others:
            if o in bindings[:k]:
                _check_shared(o, b)
        shared = bool(others) and b.port.split(":")[0] not in FREE
        checked.append(replace(b, shared=shared, neighbours=tuple(others)))
    return checked


def _copies(channels: Channels, role: str) -> list[int]:
    return channels.copies(role) if isinstance(channels, AxesChannels) else []


def _check_shared(first: Binding, second: Binding) -> None:
    """Raise InputError where two devices cannot share their port."""
    both = f"{second.place}: {second.name} and {first.name} ({first.place}) share {second.port}"
    bus = second.profile.bus.split("-")[0]
    if first.profile.bus.split("-")[0] != bus:
        raise InputError(
            f"{both}, but one is a {first.profile.bus} device and one a {second.profile.bus} device: "
            "give each a port of its own"
        )
    if bus == "can":
        _check_can_bus(first, second, both)
        return
    if bus == "ethercat" and first.address == second.address:
        raise InputError(f"{both}, and both are slave {first.address}: give each its own 'address'")
    if first.profile.line != second.profile.line and not second.port.startswith("tcp:"):
        raise InputError(f"{both}, but their profiles' 'line' differs: one line has one baud rate and format")
    for b in (first, second):
        if b.profile.amplifier is not None and isinstance(b.profile.bus_spec, BinaryFrame | TextLine):
            raise InputError(f"{both}, but {b.name} is an amplifier: give it a line of its own")
        if isinstance(b.profile.bus_spec, BinaryFrame | TextLine) and not b.profile.bus_spec.request:
            raise InputError(
                f"{both}, but {b.name} sends without being asked (its profile has no 'request'): "
                "only devices that are asked can share a line"
            )


def _check_can_bus(first: Binding, second: Binding, both: str) -> None:
    if first.port != second.port and not first.port.startswith(FREE):
        raise InputError(f"{both}, but write it differently ({first.port}): one bus has one bitrate")
    one, other = first.profile.bus_spec, second.profile.bus_spec
    if isinstance(one, Cia402) and isinstance(other, Cia402):
        if first.address == second.address:
            raise InputError(f"{both}, and both have node id {first.address}: give each its own 'address'")
        if one.master_id == other.master_id:
            raise InputError(f"{both}, and both have master_id {one.master_id}: give each its own")


def file_warnings(bindings: Iterable[Binding]) -> list[str]:
    """Return a line for each DBC or EDS file that was read in spite of a fault."""
    lines = []
    for b in bindings:
        spec = b.profile.bus_spec
        warning = spec.warning if isinstance(spec, Dbc) else ""
        if isinstance(spec, Cia402) and spec.eds is not None:
            warning = read_eds(spec.eds).warning
        if warning and warning not in lines:
            lines.append(warning)
    return lines


def rig_notes(bindings: Iterable[Binding]) -> list[str]:
    """Return a line for each setting that is allowed but probably a mistake (for `thermoctl check`)."""
    notes = []
    bindings = list(bindings)
    if not any(b.profile.amplifier for b in bindings):
        notes.append(
            "no device takes the command (a profile with 'drive'): this rig measures, it cannot be driven"
        )
    for b in bindings:
        amplifier = b.profile.amplifier
        if amplifier is not None and amplifier.watchdog_s is None:
            notes.append(
                f"{b.place}: {b.name} cannot stop by itself (watchdog_s: none): when this computer dies or the cable "
                "breaks, it keeps its last command; cut its enable input or supply by a hardware watchdog"
            )
        if amplifier is not None and amplifier.command is not None and amplifier.state is None:
            notes.append(
                f"{b.place}: {b.name} does not report its state: the daemon cannot see that it stopped or refused; "
                "compare its current with the command (protection.current_per_drive)"
            )
        for x in b.bounds:
            if isinstance(x.channel.source, Register) and (hint := register_hint(x.channel.source.address)):
                notes.append(f"{x.channel.place}: register {x.channel.source.address}: {hint}")
    return notes
