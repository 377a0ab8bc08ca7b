"""The configuration: every option with unit, range, default, meaning, and whether a change needs a restart.

One YAML file describes a rig. `load_settings` reads it strictly. Errors are: an unknown key, a wrong type, a
value out of range, a wrong unit, a duplicate key, a missing key. The message names file, line and column, the
expectation and the nearest known name. A number may carry a unit ("5 ms", "1 mm/min"); it is converted to the
option's unit.

The dataclasses below are the table; `options()` lists it for the reference page and for `reload`.
"""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from thermoctl.control.limits import Limits
from thermoctl.files.yamlfile import (
    InputError,
    Node,
    Section,
    decimal_comma,
    kind_of,
    load,
    loads,
    number_of,
    suggest,
)
from thermoctl.rig.channels import (
    CODES,
    DEFAULT,
    AxesChannels,
    Channels,
    Point,
    read_points,
    read_shared_points,
)
from thermoctl.rig.option import Option, option
from thermoctl.rig.signals import Row, of_channels
from thermoctl.units import conversion, ratio

TEMPERATURES = "temperatures_c"
"""In a mapping of limits: default for the temperatures of all points without an entry of their own."""
COIL_CHANNEL = "coil_c"
"""The default of protection.required; a coil of another name takes its place."""


@dataclass(frozen=True)
class RigSettings:
    """The rig's name."""

    name: str = option("name of the rig in recordings and on pages", "rig", restart=True)
    drawing: str = option(
        "SVG file of the dashboard's drawing, relative to this file; an element with data-p: POINT is coloured by that "
        "point's temperature; empty: a box a point, or the paper's actuator where `points` is not given",
        "",
        restart=True,
    )


@dataclass(frozen=True)
class LoopSettings:
    """The control loop: one tick a period."""

    period_s: float = option("period of the tick", 0.001, "s", 2e-4, 0.1, restart=True)
    cpu: int = option(
        "number of the processor that runs the loop; -1 leaves the choice to the scheduler",
        -1,
        "1",
        -1,
        1023,
        restart=True,
    )
    priority: int = option(
        "SCHED_FIFO priority of the loop; 0 switches real-time scheduling off", 80, "1", 0, 99, restart=True
    )
    spin_s: float = option(
        "time before each deadline in which the loop polls the clock instead of sleeping; it lowers the lateness "
        "and keeps the processor busy",
        0.0,
        "s",
        0.0,
        5e-4,
        restart=True,
    )
    pace: str = option(
        "what starts a tick. clock: the period. device: each frame of the position encoder, or the period after two "
        "periods without a frame. tick: the period, and each tick counts as exactly one period; a simulated rig then "
        "runs slower on a stalled machine instead of faulting",
        "clock",
        restart=True,
        choices=("clock", "device", "tick"),
    )
    reference: bool = option(
        "run an idle loop with the same clock beside the control loop; `thermoctl latency` compares both",
        False,
        restart=True,
    )


@dataclass(frozen=True)
class ControlSettings:
    """The position controller, equation (41)."""

    mode: str = option(
        "what the amplifier takes. torque: the controller's output as a current, voltage or force. velocity: the same as a "
        "speed, um/s. position: a target position, um; the drive closes the loop and the compensation shifts its target",
        "torque",
        restart=True,
        choices=("torque", "velocity", "position"),
    )
    kp: float = option("proportional gain: drive per um of position error", unit="1/um", low=0.0, high=1e3)
    ti_s: float = option("integral time of the controller", unit="s", low=1e-5, high=1e6)
    td_s: float = option("derivative time of the controller; 0 switches the term off", 0.0, "s", 0.0, 1e3)
    output_limit: float = option(
        "largest absolute drive, in the amplifier's unit; with mode: position the largest absolute target, um",
        unit="1",
        low=0.0,
        high=1e6,
    )
    setpoint_rate_um_s: float = option(
        "largest speed of the reference on its way to a new setpoint (default: 1 mm/min)",
        1000.0 / 60.0,
        "um/s",
        1e-3,
        1e6,
    )
    setpoint_low_um: float = option("smallest setpoint that is accepted", -1e6, "um", -1e6, 1e6)
    setpoint_high_um: float = option("largest setpoint that is accepted", 1e6, "um", -1e6, 1e6)
    moving_average: int = option(
        "number of position readings that are averaged for the controller; 1: no averaging", 1, "1", 1, 64
    )


@dataclass(frozen=True)
class CompensationSettings:
    """The estimate of the thermal error, and its compensation."""

    model: str = option(
        "model file from `thermoctl identify`, or folder of calibrations, relative to this file; empty: no estimate "
        "and no compensation",
        "",
        restart=True,
    )
    enable: bool = option("correct the position by the estimated thermal error", True)
    tune: bool = option(
        "learn the expansion model online while the reference encoder is connected; a better model is saved as a new "
        "calibration in the folder `model`",
        False,
        restart=True,
    )
    bound_um: float = option(
        "largest absolute compensation; a larger estimate is clipped", 50.0, "um", 0.0, 1e4
    )
    slew_um_s: float = option(
        "largest rate of change of the compensation while armed", 1.0, "um/s", 1e-4, 1e4
    )


@dataclass(frozen=True)
class ReadingLimits:
    """Limits of each channel's readings: mappings channel: limit."""

    required: tuple[str, ...] = option(
        "channels that must be valid: an invalid one disables the amplifier; an invalid reading of any other channel "
        "is a warning",
        ("position_um", "voltage_v", "current_a", COIL_CHANNEL),
    )
    low: dict[str, float] = option(
        "smallest valid reading by channel, in the channel's unit; a smaller one is invalid", factory=dict
    )
    high: dict[str, float] = option(
        "largest valid reading by channel, in the channel's unit; a larger one is invalid", factory=dict
    )
    rate: dict[str, float] = option(
        "largest valid change per second by channel, in the channel's unit. Temperatures are compared over at least "
        "0.1 s and must exceed it twice in a row",
        factory=dict,
        low=0.0,
    )
    stale_s: dict[str, float] = option(
        "longest time without a new reading, by channel", factory=dict, unit="s", low=0.0
    )
    frozen_s: dict[str, float] = option(
        "longest time with exactly the same reading, by channel", factory=dict, unit="s", low=0.0
    )


@dataclass(frozen=True)
class ProtectionSettings(Limits, ReadingLimits):
    """Conditions that disable the amplifier.

    The options `low` to `frozen_s` are mappings of channel: limit. A channel without an entry has no limit.
    The entry `temperatures_c` sets the limit of every temperature without an entry of its own."""

    on_other_axis_fault: str = option(
        "what this axis does when another axis of the rig (`axes`) goes to FAULT. disarm: it goes to FAULT, too "
        "(other_axis), and cannot be armed before the other one is acknowledged. go_on: nothing",
        "disarm",
        restart=True,
        choices=("disarm", "go_on"),
    )


@dataclass(frozen=True)
class RecordingSettings:
    """The recorder."""

    enable: bool = option("record every tick", True, restart=True)
    directory: str = option("folder of the recordings, relative to this file", "../recordings", restart=True)
    file_mb: float = option(
        "size at which a new recording file is started", 512.0, "MB", 1.0, 1e5, restart=True
    )
    file_s: float = option(
        "time after which a new recording file is started", 3600.0, "s", 1.0, 1e6, restart=True
    )
    budget_gb: float = option(
        "disk space for recordings of every tick; the oldest files are deleted when it is used up",
        20.0,
        "GB",
        0.001,
        1e6,
        restart=True,
    )
    tier_budget_gb: float = option(
        "disk space for the 10 Hz recordings (least, mean and largest value of each signal); the oldest files are "
        "deleted when it is used up",
        5.0,
        "GB",
        0.001,
        1e6,
        restart=True,
    )


@dataclass(frozen=True)
class HalSettings:
    """The hardware, or its simulation."""

    backend: str = option(
        "source of readings: a simulated plant, or devices", restart=True, choices=("simulated", "devices")
    )
    plant: str = option(
        "plant file of back end `simulated`, relative to this file; the compensator's model assumes this plant",
        "",
        restart=True,
    )
    truth: str = option(
        "plant file that back end `simulated` simulates instead of `plant`, to give the compensator a wrong model; "
        "empty: simulate `plant`",
        "",
        restart=True,
    )
    drive_input: str = option("name of the plant's input that the amplifier drives", "drive", restart=True)
    inputs: Node | None = option(
        "course of the other plant inputs: name: {mean, swing, period_s, noise, resolution}",
        None,
        restart=True,
    )
    roles: dict[str, str] = option(
        "channel role of each plant output whose name is not a role: output: role", factory=dict, restart=True
    )
    seed: int = option("seed of the simulated sensors' noise", 1, "1", 0, 2**31, restart=True)
    sensor_period_s: float = option(
        "sampling period of the simulated temperature sensors", 0.1, "s", 1e-3, 60.0, restart=True
    )
    run_dir: str = option(
        "folder of the virtual rig's control socket and reference recording, relative to this file",
        "../run/wire",
        restart=True,
    )
    devices: tuple[Node, ...] = option(
        "devices of back end `devices`: each with its profile, port and channel roles", (), restart=True
    )
    faults: tuple[Node, ...] = option(
        "faults that are injected into the readings, for tests", (), restart=True
    )


@dataclass(frozen=True)
class SocketSettings:
    """The command socket."""

    path: str = option(
        "path of the Unix socket, relative to this file; lock, log and saved estimates are written beside it",
        "../run/thermoctl.sock",
        restart=True,
    )
    group: str = option(
        "group whose members may connect and give commands; empty: that of the daemon's user",
        "",
        restart=True,
    )


@dataclass(frozen=True)
class Settings:
    """A whole configuration; `path` is the file it came from, `channels` those of its points.

    A rig file with `axes` gives two kinds of settings. The settings of one axis have the same fields as
    those of a rig without axes; `axis` is its name, `rig_socket` the rig's socket. The settings of the whole
    rig have `axes` and the channels of all axes. Their sections `control`, `compensation` and `protection`
    are those of the first axis. `given` lists the options that the file has, as section.key."""

    path: str
    rig: RigSettings
    loop: LoopSettings
    control: ControlSettings
    compensation: CompensationSettings
    protection: ProtectionSettings
    recording: RecordingSettings
    hal: HalSettings
    socket: SocketSettings
    channels: Channels = DEFAULT
    axis: str = ""
    rig_socket: str = ""
    axes: tuple[Settings, ...] = ()
    given: frozenset[str] = frozenset()

    @property
    def parts(self) -> tuple[Settings, ...]:
        """Return the settings of each axis; of a rig without axes its own."""
        return self.axes or (self,)

    def value(self, key: str) -> Any:
        """Return the value of an option, by section.key."""
        section, name = key.split(".")
        return getattr(getattr(self, section), name)

    def of_axis(self, name: str) -> Settings:
        """Return the settings of one axis. Raises InputError for an unknown name."""
        for part in self.axes:
            if part.axis == name:
                return part
        names = [part.axis for part in self.axes]
        known = f"expected one of {', '.join(names)}" if names else "this rig has no axes"
        raise InputError(f"{self.path}: no axis '{name}'{suggest(name, names)}; {known}")

    @property
    def row(self) -> Row:
        """Return the signals of this rig's record rows."""
        return of_channels(self.channels)


POINTS = "points"
"""Key of the declaration of the temperature points."""
AXES = "axes"
"""Key of the declaration of the axes."""
OF_AN_AXIS = ("control", "compensation", "protection", "hal")
"""Sections whose keys an axis may set for itself; of `hal` those of simulated rigs and injected faults."""
SHARED_CHANNELS = ("air_c", "supply_v")
"""Channels that one device may give to all axes, besides those of the rig's points."""
SECTIONS: dict[str, type] = {
    "rig": RigSettings,
    "loop": LoopSettings,
    "control": ControlSettings,
    "compensation": CompensationSettings,
    "protection": ProtectionSettings,
    "recording": RecordingSettings,
    "hal": HalSettings,
    "socket": SocketSettings,
}


def options() -> Iterator[tuple[str, dataclasses.Field[Any], Option]]:
    """List every option as (section.key, dataclass field, Option), in order."""
    for section, cls in SECTIONS.items():
        for f in dataclasses.fields(cls):
            yield f"{section}.{f.name}", f, f.metadata["option"]


def changed(old: Settings, new: Settings) -> list[tuple[str, bool]]:
    """List the options that differ, each with whether the change needs a restart."""
    differing = [
        (key, row.restart) for key, _, row in options() if _plain(old.value(key)) != _plain(new.value(key))
    ]
    if old.channels != new.channels:
        differing.append((POINTS, True))
    return differing


def with_live(current: Settings, new: Settings) -> Settings:
    """Return the current settings with the new values of all options that need no restart."""
    live: dict[str, dict[str, Any]] = {section: {} for section in SECTIONS}
    for key, f, row in options():
        if not row.restart:
            live[key.split(".")[0]][f.name] = new.value(key)
    sections = {s: dataclasses.replace(getattr(current, s), **values) for s, values in live.items()}
    return dataclasses.replace(current, **sections)


def effective(settings: Settings) -> str:
    """Write every option with the value in force, as YAML that `load_settings` reads (absolute paths)."""
    values: dict[str, dict[str, Any]] = {POINTS: settings.channels.plain()}
    for key, _, _ in options():
        section, name = key.split(".")
        value = _plain(settings.value(key))
        if value is not None:
            values.setdefault(section, {})[name] = dict(value) if isinstance(value, Mapping) else value
    return yaml.safe_dump(values, sort_keys=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Node):
        return value.plain()
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def load_settings(path: str | Path, axis: str = "") -> Settings:
    """Read and check a configuration, of one axis where the rig has several: `axis`, or PATH#AXIS.

    Raises InputError with file:line:column for the first error, or where an axis must be chosen."""
    file, _, named = str(path).rpartition("#") if not Path(path).exists() else (str(path), "", "")
    rig = load_rig(file or path)
    if axis := axis or (named if file else ""):
        return rig.of_axis(axis)
    if rig.axes:
        names = ", ".join(part.axis for part in rig.axes)
        raise InputError(f"{path}: this rig has the axes {names}; name one by --axis")
    return rig


_ANYTHING = """control: {kp: 1, ti_s: 1, td_s: 0, output_limit: 1}
protection: {required: []}
hal: {backend: simulated, plant: none}
"""


def for_stopping(path: str, socket: str = "", axes: Sequence[str] = ()) -> Settings:
    """Return settings that hold the sockets of a file, which may have mistakes elsewhere, or be gone.

    `socket`, `axes`: those of the running daemon, if they are known. The settings serve to disarm and stop
    it, and nothing else. Raises InputError."""
    file, _, axis = path.rpartition("#") if "#" in path and not Path(path).exists() else (path, "", "")
    text = Path(file).read_text(errors="replace") if Path(file).is_file() else ""
    section = {m[1]: m[0] for m in re.finditer(r"(?ms)^(socket|axes):.*?(?=^[^\s#]|\Z)", text)}
    rig = _settings(loads(_ANYTHING + section.get("socket", ""), file), file, DEFAULT)
    indent = re.search(r"\n( +)[a-z]", section.get("axes", ""))
    names = re.findall(rf"(?m)^{indent[1]}({_AXIS.pattern}):", section["axes"]) if indent else []
    if socket:
        rig, names = dataclasses.replace(rig, socket=dataclasses.replace(rig.socket, path=socket)), list(axes)
    rig = dataclasses.replace(rig, axes=tuple(_named(rig, name, len(names)) for name in names))
    return rig.of_axis(axis) if axis else rig


def load_rig(path: str | Path) -> Settings:
    """Read and check a configuration: that of the whole rig, where it has axes. Raises InputError."""
    node, folder = load(path), Path(path).absolute().parent
    root = Section(node, "configuration")
    root.asked.update(SECTIONS)
    points, axes = root.given(POINTS), root.given(AXES)
    root.end()
    if axes is None:
        return _settings(node, path, DEFAULT if points is None else _points(points, folder))
    shared = () if points is None else read_shared_points(points, folder)
    if not axes.value or not isinstance(axes.value, dict):
        raise axes.error("axes: a mapping NAME: {points, control, compensation, protection} was expected")
    rig = node.value.get("rig")
    if rig is None or "name" not in (rig.value or {}):
        raise axes.error("axes: 'rig.name' is missing: the recordings of each axis are named RIG-AXIS")
    parts = []
    for name, item in axes.value.items():
        own = Section(item, f"axes.{name}")
        own.asked.update(OF_AN_AXIS)
        if not _AXIS.fullmatch(name):
            raise item.error(f"axes: '{name[:60]}': small letters and digits were expected, a letter first")
        declared = own.given(POINTS)
        own.end()
        if declared is None and points is not None:
            raise item.error(
                f"axes.{name}.points is missing: the axis' own points, one of them with role: coil"
            )
        channels = DEFAULT if declared is None else _points(declared, folder, shared)
        part = _settings(_axis_node(node, name, item), path, channels)
        parts.append(_named(part, name, len(axes.value)))
    union = AxesChannels(
        (),
        tuple((part.axis, part.channels) for part in parts),
        (*SHARED_CHANNELS, *(f"{p.name}_c" for p in shared)),
    )
    first, hal = parts[0], node.value.get("hal")
    whole = _settings(_axis_node(node, first.axis, axes.value[first.axis]), path, first.channels)
    devices = _section("hal", HalSettings, hal, node, union).devices
    for device in devices:
        _check_roles(device, union)
    return dataclasses.replace(
        whole, hal=dataclasses.replace(whole.hal, devices=devices), channels=union, axes=tuple(parts)
    )


_AXIS = re.compile(r"[a-z][a-z0-9]*")


def _named(part: Settings, axis: str, count: int) -> Settings:
    """Return an axis' settings with its own name, socket and folder, and its share of the disk space."""
    path, recording = Path(part.socket.path), part.recording
    return dataclasses.replace(
        part,
        axis=axis,
        rig_socket=part.socket.path,
        rig=dataclasses.replace(part.rig, name=f"{part.rig.name}-{axis}"),
        socket=dataclasses.replace(part.socket, path=str(path.with_name(f"{path.stem}-{axis}{path.suffix}"))),
        recording=dataclasses.replace(
            recording,
            directory=str(Path(recording.directory) / axis),
            budget_gb=recording.budget_gb / count,
            tier_budget_gb=recording.tier_budget_gb / count,
        ),
    )


def _axis_node(root: Node, axis: str, own: Node) -> Node:
    """Return one axis' configuration: the rig's sections, the axis' keys over them, its devices only."""
    sections = {k: v for k, v in root.value.items() if k not in (AXES, POINTS)}
    for name in OF_AN_AXIS:
        if name in own.value:
            sections[name] = _over(sections[name], own.value[name]) if name in sections else own.value[name]
    hal = sections.get("hal")
    if hal is not None and isinstance(hal.value, dict) and isinstance(hal.value.get("devices"), Node):
        listed = hal.value["devices"]
        if isinstance(listed.value, list):
            mine = [d for d in (_device_of(device, axis) for device in listed.value) if d is not None]
            devices = dataclasses.replace(listed, value=mine)
            sections["hal"] = dataclasses.replace(hal, value={**hal.value, "devices": devices})
    return dataclasses.replace(root, value=sections)


def _over(common: Node, own: Node) -> Node:
    """Return `common` with the keys of `own` in place of its own; mappings in them key by key."""
    if not (isinstance(common.value, dict) and isinstance(own.value, dict)):
        return own
    merged = {**common.value}
    for key, value in own.value.items():
        merged[key] = _over(merged[key], value) if key in merged else value
    return dataclasses.replace(own, value=merged)


def _device_of(device: Node, axis: str) -> Node | None:
    """Return a device with the roles that it has for this axis, without the axis' name; None without any."""
    roles = device.value.get("roles") if isinstance(device.value, dict) else None
    if roles is None or not isinstance(roles.value, dict):
        return device
    mine = {}
    for channel, role in roles.value.items():
        of, dot, plain = str(role.value).rpartition(".")
        if not dot or of == axis:
            mine[channel] = dataclasses.replace(role, value=plain) if dot else role
    if not mine:
        return None
    return dataclasses.replace(
        device, value={**device.value, "roles": dataclasses.replace(roles, value=mine)}
    )


def _check_roles(device: Node, channels: AxesChannels) -> None:
    """Raise InputError for a role that no axis has, or that needs its axis."""
    roles = device.value.get("roles") if isinstance(device.value, dict) else None
    if roles is None or not isinstance(roles.value, dict):
        return
    for role in roles.value.values():
        if role.value not in channels.index:
            axes = [f"{a}.{role.value}" for a in channels.parts if f"{a}.{role.value}" in channels.index]
            expected = f"write {' or '.join(axes)}" if axes else f"roles: {', '.join(channels.index)}"
            raise role.error(
                f"roles: '{role.value}' is no role of all axes{'' if axes else suggest(str(role.value), channels.index)}; "
                f"{expected}"
            )


def _settings(node: Node, path: str | Path, channels: Channels) -> Settings:
    """Read the sections of a rig without axes, or of one axis."""
    root, folder = Section(node, "configuration"), Path(path).absolute().parent
    present = {name: root.given(name) for name in SECTIONS}
    sections = {
        name: _section(name, cls, present[name], root.node, channels) for name, cls in SECTIONS.items()
    }
    given = frozenset(f"{name}.{key}" for name, node in present.items() if node for key in node.value)
    settings = Settings(path=str(path), **sections, channels=channels, given=given)
    _check_together(settings, root.node)
    return dataclasses.replace(
        settings,
        socket=dataclasses.replace(settings.socket, path=_below(folder, settings.socket.path)),
        recording=dataclasses.replace(
            settings.recording, directory=_below(folder, settings.recording.directory)
        ),
        compensation=dataclasses.replace(
            settings.compensation, model=_below(folder, settings.compensation.model)
        ),
    )


def _points(node: Node, folder: Path, shared: Iterable[Point] = ()) -> Channels:
    """Read `points`. Raises InputError also where a name would give two signals of one name."""
    channels = read_points(node, folder, shared)
    if twice := of_channels(channels).duplicates():
        raise node.error(
            f"points: two signals would have the name {twice[0]}; choose another name for the point"
        )
    return channels


def _below(folder: Path, path: str) -> str:
    return str((folder / path).resolve()) if path else ""


class _Options(Section):
    """A mapping of the configuration; its errors name an option as section.key."""

    def __init__(self, node: Node, what: str, channels: Channels) -> None:
        super().__init__(node, what)
        self.channels = channels

    def label(self, key: str) -> str:
        """Return section.key."""
        return f"{self.what}.{key}"


def _section(name: str, cls: type, node: Node | None, root: Node, channels: Channels) -> Any:
    """Read one section into its dataclass; `root` is the place of the error where the section is missing."""
    place = root if node is None else node
    section = _Options(node or dataclasses.replace(root, value={}), name, channels)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    section.asked.update(fields)
    section.end()
    kinds = typing.get_type_hints(cls)
    for key, f in fields.items():
        no_default = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if no_default and key not in section.node.value:
            raise place.error(f"'{name}.{key}' is missing: {f.metadata['option'].meaning}")
    given = {
        key: _value(section, key, kinds[key], fields[key].metadata["option"]) for key in section.node.value
    }
    if cls is ProtectionSettings and "required" not in given:
        default = ProtectionSettings().required
        given["required"] = tuple(channels.coil if c == COIL_CHANNEL else c for c in default)
    return cls(**given)


def _value(section: _Options, key: str, kind: Any, row: Option) -> Any:
    """Read one option, checked and converted to its type."""
    node, label = section.get(key), section.label(key)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is bool:
        return section.flag(key, False)
    if kind is str:
        return section.text(key, choices=row.choices)
    if kind in (int, float):
        return _number(node, label, row, whole=kind is int)
    if origin is dict:
        mapping = _Options(node, label, section.channels)
        is_text = inner[1] is str
        return {n: mapping.text(n) for n in mapping.node.value} if is_text else _limits(mapping, row)
    if origin is tuple and inner[0] is Node:
        return tuple(section.list(key))
    if origin is tuple:
        return tuple(_channel(label, item.value, item, section.channels) for item in section.list(key))
    if origin is types.UnionType:  # Node | None: the reader of that section checks it
        return node
    raise TypeError(f"{label}: no rule for {kind}")


def _number(node: Node, label: str, row: Option, whole: bool = False) -> float:
    unit = "" if row.unit == "1" else row.unit
    if isinstance(node.value, str):
        node = dataclasses.replace(node, value=_with_unit(label, node.value, unit, node))
    value = number_of(node, label, row.low, row.high, unit)
    if whole and not value.is_integer():
        raise node.error(f"{label}: a whole number was expected, found {kind_of(node)}")
    return int(value) if whole else value


_WITH_UNIT = re.compile(r"\s*([-+]?[\d./]+(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*")  # any blank, also U+00A0


def _with_unit(label: str, text: str, unit: str, node: Node) -> float:
    """Convert text such as '5 ms' to the option's unit; a number alone has that unit."""
    match = _WITH_UNIT.fullmatch(text)
    try:
        value, given = Fraction(match[1] if match else text), match[2] if match else ""
    except (ValueError, ZeroDivisionError):
        said = decimal_comma(text) or f"a number in {unit or 'no unit'} was expected, not '{text}'"
        raise node.error(f"{label}: {said}") from None
    try:
        if (factor := ratio(given, unit) if given else 1) is not None:
            return float(value * factor)
        scale, offset = conversion(given, unit or "1")
        return scale * float(value) + offset
    except ValueError as e:
        raise node.error(
            f"{label}: '{text}': the unit does not fit ({e}); expected {unit or 'no unit'}"
        ) from None


def _limits(mapping: _Options, row: Option) -> dict[str, float]:
    """Read a limit by channel; a channel's own entry wins over TEMPERATURES."""
    limits = {}
    names: dict[str, Node] = mapping.node.value
    for name in sorted(names, key=lambda name: name != TEMPERATURES):
        number = _number(names[name], mapping.label(name), row)
        for channel in mapping.channels.temperatures if name == TEMPERATURES else (name,):
            limits[_channel(mapping.what, channel, names[name], mapping.channels)] = number
    return limits


def _channel(label: str, name: Any, node: Node, channels: Channels) -> str:
    names = channels.names
    if name not in names:
        raise node.error(
            f"{label}: no channel '{name}'{suggest(str(name), names)}; expected one of {', '.join(names)}"
        )
    return str(name)


def _check_together(settings: Settings, root: Node) -> None:
    """Check the conditions between options. Raises InputError."""

    def place(section: str, key: str) -> Node:
        """Return the node of an option, or of its section or the file where it is not given."""
        node: Node = root.value.get(section, root)
        return node.value.get(key, node) if isinstance(node.value, dict) else node

    control, hal, protection = settings.control, settings.hal, settings.protection
    if control.setpoint_low_um >= control.setpoint_high_um:
        raise place("control", "setpoint_high_um").error(
            "control.setpoint_high_um must be above setpoint_low_um"
        )
    for name in set(protection.low) & set(protection.high):
        if protection.low[name] >= protection.high[name]:
            raise place("protection", "high").error(
                f"protection.high.{name} must be above protection.low.{name}"
            )
    for name in CODES:
        if name in protection.frozen_s:
            raise place("protection", "frozen_s").error(
                f"protection.frozen_s.{name}: this reading is constant in normal operation; limit supply_v instead, an "
                "analogue reading of the same frame"
            )
    if control.mode == "position" and "position_um" not in protection.required:
        raise place("protection", "required").error(
            "control.mode: position needs position_um in protection.required: the first target is the measured position"
        )
    needed = {"simulated": "plant", "devices": "devices"}[hal.backend]
    if not getattr(hal, needed):
        raise place("hal", "backend").error(f"hal.{needed} is missing: back end '{hal.backend}' needs it")
    backend = {"device": "devices", "tick": "simulated"}.get(settings.loop.pace, hal.backend)
    if hal.backend != backend:
        raise place("loop", "pace").error(
            f"loop.pace: {settings.loop.pace} needs hal.backend: {backend}, found '{hal.backend}'; set pace: clock"
        )


__all__ = ["InputError", "Option", "Settings", "changed", "load_rig", "load_settings", "options"]
