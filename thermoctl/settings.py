"""The configuration: every option once, with unit, range, default, meaning, and whether a change needs a restart.

One YAML file describes a rig. `load_settings` reads it strictly: an unknown key, a value of the wrong kind or out of range,
a unit that does not fit, a duplicate or a missing key is an error with file, line and column, what was expected and, where
something is close, "did you mean". A number may carry a unit ("5 ms", "1 mm/min"): it is converted to the option's own.

The dataclasses below are the table; `options()` lists it for the reference page and for `reload`.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from thermoctl import channels
from thermoctl.channels import CHANNELS
from thermoctl.control.limits import Limits
from thermoctl.option import Option, option
from thermoctl.yamlfile import InputError, Node, load, suggest

TEMPERATURES = "temperatures_c"
"""In a mapping of limits: all twelve temperatures that are not named themselves."""


@dataclass(frozen=True)
class RigSettings:
    """What this rig is called."""

    name: str = option("a name for recordings and pages", "rig", restart=True)


@dataclass(frozen=True)
class LoopSettings:
    """The tick."""

    period_s: float = option("period of the tick", 0.001, "s", 2e-4, 0.1, restart=True)
    cpu: int = option(
        "processor the loop is pinned to; -1: wherever the scheduler likes", -1, "1", -1, 1023, restart=True
    )
    priority: int = option("SCHED_FIFO priority; 0: no real-time scheduling", 80, "1", 0, 99, restart=True)
    spin_s: float = option(
        "how long before a deadline the loop waits burning the processor", 0.0, "s", 0.0, 5e-4, restart=True
    )
    pace: str = option(
        "what starts a tick: the clock, or the position encoder's frame (the clock, when none came for two "
        "periods); tick: the clock, but each tick counts as one period, so that a simulated rig on a machine that "
        "stalls runs slower instead of faulting",
        "clock",
        restart=True,
        choices=("clock", "device", "tick"),
    )
    reference: bool = option(
        "run an idle loop of the same clock beside it, for `thermoctl latency`", False, restart=True
    )


@dataclass(frozen=True)
class ControlSettings:
    """The position loop, equation (41)."""

    kp: float = option("proportional gain, drive unit per um of error", unit="1/um", low=0.0, high=1e3)
    ti_s: float = option("integral time", unit="s", low=1e-5, high=1e6)
    td_s: float = option("derivative time", 0.0, "s", 0.0, 1e3)
    output_limit: float = option("largest drive, in the amplifier's unit", unit="1", low=0.0, high=1e6)
    setpoint_rate_um_s: float = option(
        "how fast the reference follows the setpoint (1 mm/min)", 1000.0 / 60.0, "um/s", 1e-3, 1e6
    )
    setpoint_low_um: float = option("smallest setpoint taken", -1e6, "um", -1e6, 1e6)
    setpoint_high_um: float = option("largest setpoint taken", 1e6, "um", -1e6, 1e6)
    moving_average: int = option("frames of the position encoder in its mean", 1, "1", 1, 64)


@dataclass(frozen=True)
class CompensationSettings:
    """The thermal error and its compensation."""

    model: str = option(
        "model file made by identification, relative to this file; empty: no compensation", "", restart=True
    )
    enable: bool = option("act on the estimated thermal error", True)
    tune: bool = option(
        "learn the expansion model while the reference encoder is there; better ones become calibrations in the folder `model`",
        False,
        restart=True,
    )
    bound_um: float = option("largest believable thermal error", 50.0, "um", 0.0, 1e4)
    slew_um_s: float = option("fastest change of the compensation while armed", 1.0, "um/s", 1e-4, 1e4)


@dataclass(frozen=True)
class ReadingLimits:
    """Limits of each channel's readings: mappings channel: limit."""

    required: tuple[str, ...] = option(
        "channels that must be valid: an invalid one disables the amplifier; an invalid reading of any other channel "
        "is a warning",
        ("position_um", "voltage_v", "current_a", "coil_c"),
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
    """Limits that disable the amplifier when they are exceeded.

    The options `low` to `frozen_s` are mappings of channel: limit. A channel without an entry has no limit. The entry
    `temperatures_c` sets the limit of every temperature without an entry of its own."""


@dataclass(frozen=True)
class RecordingSettings:
    """The recorder."""

    enable: bool = option("record every tick", True, restart=True)
    directory: str = option("where recordings go, relative to this file", "../recordings", restart=True)
    file_mb: float = option("a new file after this much", 512.0, "MB", 1.0, 1e5, restart=True)
    file_s: float = option("a new file after this long", 3600.0, "s", 1.0, 1e6, restart=True)
    budget_gb: float = option(
        "disk budget of the full rate; the oldest files go", 20.0, "GB", 0.001, 1e6, restart=True
    )
    tier_budget_gb: float = option(
        "disk budget of the 10 Hz tier (min, mean, max)", 5.0, "GB", 0.001, 1e6, restart=True
    )


@dataclass(frozen=True)
class HalSettings:
    """The hardware."""

    backend: str = option(
        "what stands behind the loop", restart=True, choices=("simulated", "devices", "replay")
    )
    plant: str = option(
        "plant file that the compensator believes in, relative to this file", "", restart=True
    )
    truth: str = option("plant file that plays the hardware, when it is another", "", restart=True)
    drive_input: str = option("the plant's input that the amplifier moves", "drive", restart=True)
    inputs: Node | None = option(
        "other plant inputs: name: {mean, swing, period_s, noise, resolution}", None, restart=True
    )
    roles: dict[str, str] = option(
        "plant output: channel role, where they differ in name", factory=dict, restart=True
    )
    seed: int = option("seed of the simulated noise", 1, "1", 0, 2**31, restart=True)
    sensor_period_s: float = option(
        "period of the simulated slow sensors", 0.1, "s", 1e-3, 60.0, restart=True
    )
    recording: str = option(
        "the recording that back end `replay` plays, relative to this file", "", restart=True
    )
    run_dir: str = option(
        "where the virtual rig keeps its control socket and reference recording, relative to this file",
        "../run/wire",
        restart=True,
    )
    devices: tuple[Node, ...] = option("bindings of profile, port and channel roles", (), restart=True)
    faults: tuple[Node, ...] = option("faults to inject, for tests", (), restart=True)


@dataclass(frozen=True)
class SocketSettings:
    """The command socket."""

    path: str = option(
        "the Unix socket; lock, log and kept estimates stand beside it", "../run/thermoctl.sock", restart=True
    )
    group: str = option("group that may command; empty: the daemon's own", "", restart=True)


@dataclass(frozen=True)
class Settings:
    """A whole configuration; `path` is the file it came from."""

    path: str
    rig: RigSettings
    loop: LoopSettings
    control: ControlSettings
    compensation: CompensationSettings
    protection: ProtectionSettings
    recording: RecordingSettings
    hal: HalSettings
    socket: SocketSettings


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


def options() -> Iterator[tuple[str, dataclasses.Field, Option]]:
    """Every option as (section.key, dataclass field, Option), in order."""
    for section, cls in SECTIONS.items():
        for f in dataclasses.fields(cls):
            yield f"{section}.{f.name}", f, f.metadata["option"]


def changed(old: Settings, new: Settings) -> list[tuple[str, bool]]:
    """The options that differ, each with whether the change needs a restart."""
    found = []
    for key, f, row in options():
        section = key.split(".")[0]
        before, after = (_plain(getattr(getattr(s, section), f.name)) for s in (old, new))
        if before != after:
            found.append((key, row.restart))
    return found


def effective(settings: Settings) -> str:
    """Every option with the value in force, as YAML that `load_settings` takes back (paths absolute)."""
    values: dict[str, dict[str, Any]] = {}
    for key, f, _ in options():
        section, name = key.split(".")
        value = _plain(getattr(getattr(settings, section), f.name))
        if value is not None:
            values.setdefault(section, {})[name] = dict(value) if isinstance(value, Mapping) else value
    return yaml.safe_dump(values, sort_keys=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Node):
        return value.plain()
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def load_settings(path: str | Path) -> Settings:
    """Read and validate a configuration. Raises InputError with file:line:column for the first thing that is wrong."""
    root = load(path)
    if not isinstance(root.value, dict):
        raise root.error(f"a mapping with the sections {', '.join(SECTIONS)} was expected")
    for name, node in root.value.items():
        if name not in SECTIONS:
            raise node.error(
                f"unknown section '{name}'{suggest(name, SECTIONS)}; expected one of {', '.join(SECTIONS)}"
            )
    sections = {name: _section(name, cls, root.value.get(name), root) for name, cls in SECTIONS.items()}
    settings = Settings(path=str(path), **sections)
    _together(settings, root)
    folder = Path(path).absolute().parent
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


def _below(folder: Path, path: str) -> str:
    return str((folder / path).resolve()) if path else ""


def _section(name: str, cls: type, node: Node | None, root: Node) -> Any:
    fields = {f.name: f for f in dataclasses.fields(cls)}
    types_ = typing.get_type_hints(cls)
    if node is None or node.value is None:
        place, given = root, {}
    elif isinstance(node.value, dict):
        place, given = node, node.value
    else:
        raise node.error(f"section '{name}': a mapping was expected")
    values = {}
    for key, item in given.items():
        if key not in fields:
            raise item.error(
                f"unknown option '{name}.{key}'{suggest(key, fields)}; expected one of {', '.join(fields)}"
            )
        values[key] = _value(f"{name}.{key}", types_[key], fields[key].metadata["option"], item)
    for key, f in fields.items():
        if (
            key not in values
            and f.default is dataclasses.MISSING
            and f.default_factory is dataclasses.MISSING
        ):
            raise place.error(f"'{name}.{key}' is missing: {f.metadata['option'].meaning}")
    return cls(**values)


def _value(key: str, kind: Any, row: Option, node: Node) -> Any:
    """One option's value, checked and converted."""
    origin = typing.get_origin(kind)
    if kind is bool:
        if not isinstance(node.value, bool):
            raise node.error(f"{key}: true or false was expected, not {_shown(node)}")
        return node.value
    if kind in (int, float):
        return _number(key, kind, row, node)
    if kind is str:
        if not isinstance(node.value, str):
            raise node.error(f"{key}: a text was expected, not {_shown(node)}")
        if row.choices and node.value not in row.choices:
            raise node.error(
                f"{key}: '{node.value}'{suggest(node.value, row.choices)}; expected one of "
                f"{', '.join(row.choices)}"
            )
        return node.value
    if origin is dict:
        return _mapping(key, typing.get_args(kind)[1], row, node)
    if origin is tuple:
        if not isinstance(node.value, list):
            raise node.error(f"{key}: a list was expected, not {_shown(node)}")
        if typing.get_args(kind)[0] is Node:
            return tuple(node.value)
        for item in node.value:
            _channel(key, item.value, item)
        return tuple(item.value for item in node.value)
    if origin in (types.UnionType, typing.Union):  # Node | None: the reader of that part checks it
        return node
    raise TypeError(f"{key}: no rule for {kind}")


def _number(key: str, kind: Any, row: Option, node: Node) -> Any:
    value: Any = node.value
    if isinstance(value, str):
        value = _with_unit(key, value, row, node)
    if isinstance(value, bool) or not isinstance(value, int | float):
        unit = f" in {row.unit}" if row.unit not in ("", "1") else ""
        raise node.error(f"{key}: a number{unit} was expected, not {_shown(node)}")
    if kind is int and value != int(value if math.isfinite(value) else 0):
        raise node.error(f"{key}: a whole number was expected, not {value}")
    if not row.low <= value <= row.high:
        raise node.error(
            f"{key}: {value:g} is out of range; expected {row.low:g} to {row.high:g} {row.unit}".rstrip()
        )
    return kind(value)


def _with_unit(key: str, text: str, row: Option, node: Node) -> float:
    """'5 ms' in the option's own unit."""
    import pint  # slow to import, and rarely needed

    registry: Any = pint.UnitRegistry()
    number, _, unit = text.strip().partition(" ")
    try:
        return float(registry.Quantity(float(number), unit).to(row.unit if row.unit != "1" else "").magnitude)
    except ValueError:
        raise node.error(f"{key}: a number in {row.unit or 'no unit'} was expected, not '{text}'") from None
    except Exception as e:  # pint's errors have no common base but Exception
        raise node.error(
            f"{key}: '{text}': the unit does not fit ({str(e).splitlines()[0]}); expected {row.unit}"
        ) from None


def _mapping(key: str, kind: Any, row: Option, node: Node) -> dict[str, Any]:
    if not isinstance(node.value, dict):
        raise node.error(f"{key}: a mapping of names was expected, not {_shown(node)}")
    if kind is str:
        return {name: _value(f"{key}.{name}", str, row, item) for name, item in node.value.items()}
    numbers = {}
    for name, item in sorted(
        node.value.items(), key=lambda pair: pair[0] != TEMPERATURES
    ):  # single channels after all
        for channel in channels.TEMPERATURES if name == TEMPERATURES else (name,):
            _channel(key, channel, item)
            numbers[channel] = _number(f"{key}.{name}", float, row, item)
    return numbers


def _channel(key: str, name: Any, node: Node) -> None:
    if name not in CHANNELS:
        raise node.error(
            f"{key}: no channel '{name}'{suggest(str(name), CHANNELS)}; expected one of {', '.join(CHANNELS)}"
        )


def _shown(node: Node) -> str:
    if isinstance(node.value, dict | list):
        return "a mapping" if isinstance(node.value, dict) else "a list"
    return f"'{str(node.value)[:40]}'"


def _together(settings: Settings, root: Node) -> None:
    """What options must be towards each other."""

    def place(section: str, key: str) -> Node:
        node = root.value.get(section)
        return node.value.get(key, node) if node is not None and isinstance(node.value, dict) else root

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
    for name in channels.CODES:
        if name in protection.frozen_s:
            raise place("protection", "frozen_s").error(
                f"protection.frozen_s.{name}: it stands still when all is well; supply_v, an analogue reading of the same "
                "frame, shows that the amplifier repeats an old one"
            )
    needed = {"simulated": "plant", "devices": "devices", "replay": "recording"}[hal.backend]
    if not getattr(hal, needed):
        raise place("hal", "backend").error(f"hal.{needed} is missing: the back end '{hal.backend}' needs it")
    backend = {"device": "devices", "tick": "simulated"}.get(settings.loop.pace, hal.backend)
    if hal.backend != backend:
        raise place("loop", "pace").error(
            f"loop.pace: {settings.loop.pace} needs hal.backend: {backend}, found '{hal.backend}'; set pace: clock"
        )


__all__ = ["CHANNELS", "InputError", "Option", "Settings", "changed", "load_settings", "options"]
