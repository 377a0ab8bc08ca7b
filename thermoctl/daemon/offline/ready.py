"""Find what would keep a rig from being armed, from its files alone, for `thermoctl check`."""

from __future__ import annotations

import re
from collections.abc import Iterator

from thermoctl.configuration.settings import AXES, Settings
from thermoctl.files.yamlfile import Node, load
from thermoctl_hal.base.binding import Bound
from thermoctl_hal.rig.make import bindings

PLACEHOLDER = re.compile(r"X{4,}|Y{4,}|<[^>]*>")
"""Text of a template's port that stands for the user's own."""
SIMULATED = ("amplifier_state", "amplifier_fault")
"""Roles that the simulated amplifier gives besides the plant's outputs."""


def obstacles(settings: Settings) -> Iterator[tuple[bool, str]]:
    """List what keeps this rig, or one axis, from being armed: (True, sentence with file:line:column).

    (False, sentence): the same for a channel that is not required, which gives a lasting warning. Raises
    InputError."""
    protection, period_s = settings.protection, settings.loop.period_s
    if protection.late_s <= period_s:
        late = (
            f"protection.late_s: {protection.late_s:g} s is not longer than loop.period_s ({period_s:g} s): every tick "
            "is late; write at least 3 periods"
        )
        yield True, _at(settings, ("protection", "late_s"), late)
    if settings.hal.backend == "simulated":
        from thermoctl_hal.simulated.rig import make_rig  # loads the plant's packages

        yield from _unbound(settings, {*make_rig(settings).index, *SIMULATED}, "output of the plant")
    if settings.hal.backend != "devices":
        return
    for node in settings.hal.devices:
        port = node.value.get("port")
        if port is not None and (placeholder := PLACEHOLDER.search(str(port.value))):
            stands = f"'{placeholder[0]}' stands for your own adapter; `ls /dev/serial/by-id` shows its name"
            yield True, str(port.error(f"port: {stands}"))
    bound = [b for device in bindings(settings) for b in device.bounds]
    yield from _unbound(settings, {b.role for b in bound}, "device of hal.devices")
    for b in bound:
        yield from ((b.role in protection.required, line) for line in _never_valid(settings, b))


def _unbound(settings: Settings, given: set[str], giver: str) -> Iterator[tuple[bool, str]]:
    """List the required channels that nothing gives."""
    required = settings.protection.required
    missing = [role for role in required if role not in given]
    if not missing:
        return
    place = _place(settings, ("protection", "required"))
    default = "" if isinstance(place.value, list) else " (the default)"
    left = ", ".join(role for role in required if role in given)
    what = (
        f"protection.required names {', '.join(missing)}{default}, but no {giver} has "
        f"{'this role' if len(missing) == 1 else 'these roles'}: the rig could never be armed; bind one, or, where "
        f"none is fitted, write required: [{left}]"
    )
    yield True, str(place.error(what))


def _never_valid(settings: Settings, b: Bound) -> Iterator[str]:
    """List the limits by which a device that works as its profile says is never valid for long."""
    p, due_s = settings.protection, 1.0 / b.channel.rate_hz
    for key, limits in (("stale_s", p.stale_s), ("frozen_s", p.frozen_s)):
        if (limit := limits.get(b.role)) is not None and limit < due_s:
            yield _at(
                settings,
                ("protection", key),
                f"protection.{key}.{b.role}: {limit:g} s is shorter than the time between two readings, {due_s:g} s "
                f"(rate_hz: {b.channel.rate_hz:g} in {b.channel.place}); write at least {3 * due_s:.2g} s",
            )
    low, high = p.low.get(b.role, b.low), p.high.get(b.role, b.high)
    if low > b.high or high < b.low:
        yield _at(
            settings,
            ("protection", "low" if low > b.high else "high"),
            f"protection.low..high of {b.role} ({low:g}..{high:g}) has nothing in common with the device's range "
            f"({b.low:g}..{b.high:g}, {b.channel.place}): no reading is valid",
        )


def _at(settings: Settings, keys: tuple[str, ...], sentence: str) -> str:
    return str(_place(settings, keys).error(sentence))


def _place(settings: Settings, keys: tuple[str, ...]) -> Node:
    """Return the node of an option: the axis' own, else the rig's, else the nearest section that is there."""
    root = load(settings.path)
    own = root.value[AXES].value[settings.axis] if settings.axis else root
    nodes = [_walk(start, keys) for start in (own, root)]
    return max(nodes, key=lambda f: f[0])[1]


def _walk(node: Node, keys: tuple[str, ...]) -> tuple[int, Node]:
    for depth, key in enumerate(keys):
        if not isinstance(node.value, dict) or key not in node.value:
            return depth, node
        node = node.value[key]
    return len(keys), node
