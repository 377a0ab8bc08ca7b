"""Find which active fault is the cause, and which follow from it. Pure.

The loop gives the onsets (ring.Remarks). A fault follows from a cause that FOLLOWS lists, or from a lost
device's fault of the same moment:

    late ticks            -> all that is measured over time: ages, jumps, following, saturation, amplifier
    a lost reading        -> its own other kinds, and all that is computed from it
    the amplifier         -> all that it drives: following, saturation, current, voltage
    any trip              -> the amplifier is disabled, the stage moves: position_ and electrical_disagrees
    two readings together -> readings lost within TOGETHER_S have one cause (a module, a bus, a supply)

A cause may be detected up to BEFORE_S after its consequence (a filter, a slower bus). A fault more than
WITHIN_S after a cause is a case of its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from thermoctl.control.faults import BIT, BY_NAME, KINDS
from thermoctl.rig.channels import GROUPS, Channels

WITHIN_S, BEFORE_S, TOGETHER_S = 5.0, 1.0, 0.15


def _of(*groups: str) -> set[str]:
    return {name for group in groups for kind in KINDS if (name := f"{group}_{kind}") in BIT}


_MOTION = {"following_error", "drive_saturated", "position_disagrees"}
_THERMAL = {"coil_disagrees", "monitored_disagrees", "compensation_slewing", "compensation_bound"}
_ELECTRIC = {"electrical_disagrees", "amplifier_not_following", "power_limit", "coil_stuck_on"}
_AFTER_TRIP = {"position_disagrees", "electrical_disagrees"}
_TIMED = {name for name in _of(*GROUPS) if name.endswith(("_stale", "_rate"))}

FOLLOWS: dict[str, set[str]] = {
    "loop_late": _TIMED
    | _MOTION
    | _THERMAL
    | _of("amplifier")
    | {"amplifier_not_following", "amplifier_fault", "electrical_disagrees"},
    "amplifier_write": _of("amplifier", "current", "voltage") | _MOTION | {"amplifier_not_following"},
    "amplifier_fault": _of("current", "voltage")
    | _MOTION
    | _ELECTRIC
    | {"amplifier_rate", "amplifier_range"},
    **dict.fromkeys(_of("amplifier"), _MOTION | _ELECTRIC | _of("current", "voltage")),
    "amplifier_stopped": _MOTION | _ELECTRIC | _of("current", "voltage"),
    "amplifier_not_following": _MOTION | {"electrical_disagrees", "current_range", "voltage_range"},
    **dict.fromkeys(_of("position"), _MOTION | {"monitored_disagrees", "coil_heating_rate", "power_limit"}),
    **dict.fromkeys(
        _of("voltage", "current"), _ELECTRIC | _THERMAL | {"position_disagrees", "coil_overtemperature_model"}
    ),
    **dict.fromkeys(
        _of("coil", "air"),
        _THERMAL | {"coil_overtemperature_model", "coil_heating_rate", "electrical_disagrees"},
    ),
    **dict.fromkeys(_of("monitored"), {"monitored_disagrees"}),
    "electrical_disagrees": _THERMAL | {"amplifier_not_following", "power_limit"},
    "position_disagrees": {"following_error", "drive_saturated", "monitored_disagrees"},
    "following_error": {"drive_saturated", "coil_heating_rate", "power_limit"},
    "drive_saturated": {"following_error", "coil_heating_rate", "power_limit"},
    "coil_disagrees": {"monitored_disagrees", "compensation_bound", "compensation_slewing"},
    "coil_overtemperature": {"coil_overtemperature_model", "coil_heating_rate"},
    "compensation_bound": {"compensation_slewing"},
}
"""Cause -> the faults that follow from it."""
for _name in _of(*GROUPS):  # from a fault of a reading, its faults of later kinds follow
    _group, _kind = _name.rsplit("_", 1)
    FOLLOWS[_name] = FOLLOWS.get(_name, set()) | {
        f"{_group}_{k}" for k in KINDS if KINDS.index(k) > KINDS.index(_kind) and f"{_group}_{k}" in BIT
    }

LATE_MAY_CAUSE = FOLLOWS["loop_late"]
"""Faults that late ticks of the second before may have caused."""


@dataclass(frozen=True)
class Standing:
    """An active fault: name, onset (t_s, tick), and the machine's largest delay in the second before, s."""

    name: str
    t_s: float
    tick: int
    late_s: float = 0.0

    @property
    def may_be_late(self) -> bool:
        """True when late ticks may have caused this fault."""
        return self.late_s > 0.0 and self.name in LATE_MAY_CAUSE

    @property
    def is_timed(self) -> bool:
        """True for a fault that late ticks alone produce: a reading too old, or changed too much."""
        return self.name in _TIMED


def channels_of(name: str, channels: Channels) -> tuple[str, ...]:
    """Return the channels that can raise fault `name`; () if it is not a fault of a reading."""
    return channels.in_group(BY_NAME[name].group)


def _lost(name: str) -> bool:
    return BY_NAME[name].kind in ("error", "stale")


def follows(fault: Standing, cause: Standing) -> bool:
    """Return whether `fault` follows from `cause`."""
    after_s = fault.t_s - cause.t_s
    if _lost(fault.name) and _lost(cause.name) and 0.0 <= after_s <= TOGETHER_S:
        return True
    if fault.name in _AFTER_TRIP and BY_NAME[cause.name].severity != "warning" and 0.0 < after_s <= WITHIN_S:
        return True
    return fault.name in FOLLOWS.get(cause.name, ()) and -BEFORE_S <= after_s <= WITHIN_S


def _trips(name: str, trips: int) -> bool:
    return bool(trips >> BIT[name] & 1)


def in_order(standing: Iterable[Standing], trips: int) -> list[tuple[Standing, str]]:
    """Return (fault, name of its cause or ''), each cause followed by its consequences.

    Causes are ordered by time, those that tripped first. trips: the bits of the faults that disabled the
    amplifier, or keep it disabled."""
    left = sorted(standing, key=lambda f: (f.t_s, -_reach(f.name), BIT[f.name]))
    heads = [
        f
        for k, f in enumerate(left)
        if not any(follows(f, c) and (j < k or not follows(c, f)) for j, c in enumerate(left) if j != k)
    ]
    heads = heads or left[:1]  # faults that cause each other: the first one
    cases: dict[str, list[Standing]] = {h.name: [] for h in heads}
    for f in left:
        if f.name in cases:
            continue
        cause = next((h for h in heads if follows(f, h)), None)  # directly, or through another one
        if cause is None:
            cause = next((h for h in heads if any(follows(f, c) and follows(c, h) for c in left)), heads[0])
        cases[cause.name].append(f)
    heads.sort(key=lambda h: (not any(_trips(f.name, trips) for f in (h, *cases[h.name])), h.t_s))
    return [(f, "" if f is h else h.name) for h in heads for f in (h, *cases[h.name])]


def _reach(name: str) -> int:
    """Rank the faults of one tick: the cause is the one with the most consequences."""
    return len(FOLLOWS.get(name, ())) + (100 if name == "loop_late" else name.startswith("coil_"))


def severity_of(name: str, trips: int) -> str:
    """Return the severity; a reading's fault is a warning unless its channel is required."""
    severity = BY_NAME[name].severity
    return "warning" if BY_NAME[name].group and not _trips(name, trips) else severity
