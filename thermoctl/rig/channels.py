"""Define every channel once; a channel is one reading from a device.

A rig file declares its temperature points; `Channels` gives the channels of this declaration. All arrays over
channels have its order: the channels of an axis, the air, then the points, the coil first. Back ends,
protection limits, fault bits, the law's indices, the recording's signals and `status` derive from it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Any

from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError, Node, Section, load

OK, STALE, ERROR, ABSENT = range(4)
STATUS_NAMES = ("OK", "STALE", "ERROR", "ABSENT")
"""Status of a reading. ERROR: its device reports it as invalid, or is lost. ABSENT: no device has this role.
"""

AMP_OFFLINE, AMP_DISABLED, AMP_ENABLED, AMP_FAULT, AMP_QUICK_STOP = (float(k) for k in range(5))
AMPLIFIER_STATES = ("offline", "disabled", "enabled", "fault", "quick stop")
"""Values of `amplifier_state`. Offline: starting up, or lost. Disabled: powered and not driving."""

GROUPS = {
    "position": "position encoder",
    "monitored": "output reference or one of the other temperatures",
    "voltage": "coil voltage",
    "current": "coil current",
    "air": "chamber air temperature",
    "coil": "coil temperature",
    "amplifier": "the amplifier's report of itself",
}
"""Groups of channels that share their fault bits, with the group's name in messages.

The law only watches the `monitored` channels when the coil's sensor alone corrects the estimate.
"""

MAX_POINTS = 64
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_LONGEST = 40  # characters of a point's name: it is part of column names and of tables on terminals


@dataclass(frozen=True)
class Channel:
    """One channel: `role` in the configuration, `unit` as pint reads it ('1' for a number), fault `group`.

    `low` and `high` bound a plausible reading. `signal` is its column in a recording (default: the role).
    `point` is the name of a temperature point. A `thermal` sensor follows its body slowly, and its
    delay is recorded. A `code` is a state or an error number: it is constant in normal operation, so it is
    never checked for `frozen`."""

    role: str
    unit: str
    group: str
    meaning: str
    low: float = -inf
    high: float = inf
    signal: str = ""
    point: str = ""
    thermal: bool = False
    code: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "signal", self.signal or self.role)


FIXED = (
    Channel("position_um", "um", "position", "position encoder", signal="position_raw_um"),
    Channel(
        "output_reference_um",
        "um",
        "monitored",
        "second encoder at the output, for proof only; the controller does not use it",
    ),
    Channel("voltage_v", "V", "voltage", "coil voltage"),
    Channel("current_a", "A", "current", "coil current"),
    Channel("supply_v", "V", "amplifier", "the amplifier's supply", 0.0),
    Channel(
        "amplifier_state",
        "1",
        "amplifier",
        ", ".join(f"{k} {state}" for k, state in enumerate(AMPLIFIER_STATES)),
        0.0,
        len(AMPLIFIER_STATES) - 1.0,
        code=True,
    ),
    Channel("amplifier_fault", "1", "amplifier", "the amplifier's own error code; 0 none", 0.0, code=True),
    Channel("air_c", "degC", "air", "chamber air", -40.0, 80.0, thermal=True),
)
"""The channels that every axis has; the points follow. The air is the last of them: thermal channels must be
neighbours."""

AT = {c.role: i for i, c in enumerate(FIXED)}
"""Index of each fixed channel, the same in every rig."""
COIL = len(FIXED)
"""Index of the coil's temperature: the coil is the first point."""
CODES = tuple(c.role for c in FIXED if c.code)


@dataclass(frozen=True)
class Point:
    """A temperature point: `name` (its channel is NAME_c), `label` for views, role `coil` or ''."""

    name: str
    label: str = ""
    role: str = ""

    @property
    def words(self) -> str:
        """Return the label, or the name with blanks."""
        return self.label or self.name.replace("_", " ")


@dataclass(frozen=True)
class Channels:
    """The channels of one axis: those that every axis has, and one a point; the coil is the first point."""

    points: tuple[Point, ...]

    @cached_property
    def table(self) -> tuple[Channel, ...]:
        """Return the channels in the arrays' order."""
        return (*FIXED, *(_channel(p) for p in self.points))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the channels' roles."""
        return tuple(c.role for c in self.table)

    @cached_property
    def index(self) -> dict[str, int]:
        """Return the index of each role."""
        return {role: i for i, role in enumerate(self.names)}

    @cached_property
    def signal(self) -> dict[str, str]:
        """Return each channel's column in a recording."""
        return {c.role: c.signal for c in self.table}

    @cached_property
    def point_names(self) -> tuple[str, ...]:
        """Return the points' names, the coil first."""
        return tuple(p.name for p in self.points)

    @cached_property
    def temperatures(self) -> tuple[str, ...]:
        """Return the points' channels."""
        return tuple(c.role for c in self.table if c.point)

    @property
    def coil(self) -> str:
        """Return the channel of the coil's temperature."""
        return self.temperatures[0]

    @cached_property
    def labels(self) -> dict[str, str]:
        """Return each point's words for views."""
        return {p.name: p.words for p in self.points}

    def in_group(self, group: str) -> tuple[str, ...]:
        """Return the channels whose faults are those of `group`."""
        return tuple(c.role for c in self.table if group and c.group == group)

    def plain(self) -> dict[str, dict[str, str]]:
        """Return the declaration as a rig file has it."""
        return {p.name: {k: v for k, v in (("role", p.role), ("label", p.label)) if v} for p in self.points}

    def text(self) -> str:
        """Return the declaration as text that `of_text` reads."""
        return json.dumps(self.plain())


@dataclass(frozen=True)
class AxesChannels(Channels):
    """The channels of all axes in one sample: those of the first axis, then those of the next.

    A role is AXIS.CHANNEL. A channel of `shared` also has a role without an axis. Its reading is stored in
    the first axis' place, and copied to its places in the other axes."""

    axes: tuple[tuple[str, Channels], ...] = ()
    shared: tuple[str, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the channels' roles, each with its axis."""
        return tuple(f"{axis}.{role}" for axis, channels in self.axes for role in channels.names)

    @cached_property
    def index(self) -> dict[str, int]:
        """Return the index of each role; a shared role has its place in the first axis."""
        by_role = {role: i for i, role in enumerate(self.names)}
        return by_role | {role: by_role[f"{self.axes[0][0]}.{role}"] for role in self.shared}

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Return each axis' place in the sample."""
        ends = [0]
        for _, channels in self.axes:
            ends.append(ends[-1] + len(channels.names))
        return {axis: slice(a, b) for (axis, _), a, b in zip(self.axes, ends[:-1], ends[1:], strict=True)}

    def copies(self, role: str) -> list[int]:
        """Return the further indices that a reading in `role` belongs to: none for a role of one axis."""
        return [self.index[f"{axis}.{role}"] for axis, _ in self.axes[1:]] if role in self.shared else []


def _channel(point: Point) -> Channel:
    """Return the temperature of one point."""
    group = "coil" if point.role == "coil" else "monitored"
    return Channel(
        f"{point.name}_c",
        "degC",
        group,
        f"{point.words}: measured",
        -40.0,
        200.0,
        point=point.name,
        thermal=True,
    )


def of_points(points: Iterable[Point]) -> Channels:
    """Return the channels of these points; the coil's comes first."""
    return Channels(tuple(sorted(points, key=lambda p: p.role != "coil")))


def of_names(points: tuple[str, ...]) -> Channels:
    """Return the channels of points of these names, the coil first; without a name the paper's."""
    return of_points(Point(p, role="" if k else "coil") for k, p in enumerate(points)) if points else DEFAULT


def of_text(text: str) -> Channels:
    """Return the channels of a text that `Channels.text` wrote."""
    points: dict[str, dict[str, Any]] = json.loads(text)
    return of_points(Point(name, **keys) for name, keys in points.items())


def read_points(node: Node, folder: Path, shared: Iterable[Point] = ()) -> Channels:
    """Read `points` of a rig file: a mapping name: {role, label}, or the path of a file that holds one.

    `folder` is what the path is relative to; shared: further points, those of all axes. Raises InputError
    for a name that is not a plain word or stands in both, no coil or several, more than MAX_POINTS."""
    points = [*_listed(node, folder), *shared]
    if twice := {p.name for p in points if [q.name for q in points].count(p.name) > 1}:
        raise node.error(f"points: '{min(twice)}' is a point of all axes already; choose another name")
    coils = [p.name for p in points if p.role == "coil"]
    if len(coils) != 1:
        raise node.error(
            f"points: one point with role: coil was expected (it takes the power, and its sensor corrects the "
            f"estimates), found {', '.join(coils) or 'none'}"
        )
    if len(points) > MAX_POINTS:
        raise node.error(f"points: {len(points)}; at most {MAX_POINTS} were expected")
    return of_points(points)


def read_shared_points(node: Node, folder: Path) -> tuple[Point, ...]:
    """Read `points` of a rig file with axes: points of all axes, none of them a coil. Raises InputError."""
    points = _listed(node, folder)
    if coils := [p.name for p in points if p.role]:
        raise node.error(
            f"points: {coils[0]} is a coil: every axis has its own; declare it in axes.NAME.points"
        )
    return tuple(points)


def _listed(node: Node, folder: Path) -> list[Point]:
    """Read a mapping of points, or the file that holds it."""
    if isinstance(node.value, str):
        node = load(folder / node.value)
    points: list[Point] = []
    for name, item in Section(node, "points").node.value.items():
        if not _NAME.fullmatch(name) or len(name) > _LONGEST:
            raise item.error(
                f"points: '{name[:60]}': small letters, digits and single underscores were expected, a letter first, "
                f"at most {_LONGEST} characters"
            )
        s = Section(replace(item, value={}) if item.value is None else item, name, name)
        points.append(Point(name, s.text("label", ""), s.text("role", "", choices=("", "coil"))))
        s.end()
    return points


def points_of_file(path: str | Path) -> Channels:
    """Return the channels of a rig file, or of a file of points only. Raises InputError."""
    root = load(path)
    rig = isinstance(root.value, dict) and "hal" in root.value
    if rig and "points" not in root.value:
        return DEFAULT
    return read_points(root.value["points"] if rig else root, Path(path).absolute().parent)


def _shipped() -> Channels:
    path = shipped("config/points") / "actuator.yaml"
    try:
        return read_points(load(path), path.parent)
    except InputError as e:
        raise ImportError(f"thermoctl is not installed whole: {e}") from None


DEFAULT = _shipped()
"""The channels of a rig file without `points`: the paper's actuator."""

CHANNELS, INDEX, TEMPERATURES = DEFAULT.names, DEFAULT.index, DEFAULT.temperatures
"""Of the paper's actuator only: a rig's own are `settings.channels`."""
