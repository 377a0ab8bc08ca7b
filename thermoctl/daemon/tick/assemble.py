"""Make the law's inputs from the configuration: parameters, the model, names of shared memory."""

from __future__ import annotations

import grp
import zlib
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermoctl.configuration.settings import RigSettings, Settings
from thermoctl.control.model import BY_CHANNEL, CompensatorModel, Parameters, zero_model
from thermoctl.files.yamlfile import InputError, load
from thermoctl.rig.channels import Channels
from thermoctl_hal.rig.make import bindings

UNNAMED = RigSettings().name
PLANT_FILES = (".yaml", ".yml", ".fmu")
"""Endings of a model's sources that are plant files, not recordings."""


def law_parameters(settings: Settings) -> Parameters:
    """Return the law's parameters from `settings`. Raises InputError for an unknown channel."""
    given: dict[str, Any] = vars(settings.control) | vars(settings.compensation) | vars(settings.protection)
    given |= {
        "compensate": settings.compensation.enable,
        "position_mode": settings.control.mode == "position",
        "required": dict.fromkeys(settings.protection.required, 1.0),
    }
    taken: dict[str, Any] = {
        f.name: _by_channel(settings.channels, given[f.name], BY_CHANNEL[f.name], f"protection.{f.name}")
        if f.name in BY_CHANNEL
        else float(given[f.name])
        for f in fields(Parameters)
    }
    return Parameters(**taken)


def in_force(settings: Settings, numbers: np.ndarray | None) -> Settings:
    """Return the settings with the options of the packed parameters of a reload or a trial.

    None: the settings as they are."""
    if numbers is None:
        return settings
    taken = vars(Parameters.unpack(numbers))
    taken |= {"enable": taken["compensate"]}
    sections = {}
    for name in ("control", "compensation", "protection"):
        old = vars(getattr(settings, name))
        new = {n: taken[n] for n in old if n in taken}
        for n in new.keys() & BY_CHANNEL.keys():
            pairs = zip(settings.channels.names, new[n].tolist(), strict=True)
            by_name = {c: x for c, x in pairs if x != BY_CHANNEL[n] or (n != "required" and c in old[n])}
            same = n == "required" and by_name.keys() == set(old[n])
            new[n] = old[n] if same else tuple(by_name) if n == "required" else by_name
        new |= {n: type(old[n])(x) for n, x in new.items() if isinstance(old[n], bool | int)}
        sections[name] = replace(getattr(settings, name), **new)
    return replace(settings, **sections)


def _by_channel(channels: Channels, given: Any, default: float, where: str) -> np.ndarray:
    array = np.full(len(channels.names), default)
    for name, number in given.items():
        if name not in channels.index:
            raise InputError(f"{where}: no channel '{name}'; expected one of {', '.join(channels.names)}")
        array[channels.index[name]] = number
    return array


def priority_warning(settings: Settings) -> str:
    """Return a warning when the loop of a real rig asks for no real-time priority, else ''."""
    if settings.hal.backend != "devices" or settings.loop.priority > 0:
        return ""
    return (
        f"{settings.path}: loop.priority is 0: any other program may delay or skip ticks of the loop, which acts on the rig "
        "as more dead time; set loop.priority: 80 (docs/how-to/real-time.md)"
    )


def power_warning(settings: Settings) -> str:
    """Return a warning with file:line when the coil's power cannot be computed, else ''."""
    protection = settings.protection
    if settings.hal.backend != "devices":
        return ""
    roles = given_roles(settings)
    lacks = [] if "current_a" in roles else ["current_a"]
    if "voltage_v" not in roles and protection.resistance_ohm == 0.0:
        lacks.append("voltage_v (or protection.resistance_ohm, for R I^2)")
    if not lacks:
        return ""
    root = load(settings.path)
    section = root.value.get("protection", root)
    place = (section.value or {}).get("power_limit_w", section) if section is not root else root
    return str(
        place.error(
            f"the coil's power is unknown without {' and '.join(lacks)}: protection.power_limit_w "
            f"({protection.power_limit_w:g} W) can never trip, and the model is driven with 0 W: its estimates and the "
            "compensation follow the coil's reading alone"
        )
    )


def given_roles(settings: Settings) -> set[str]:
    """Return the roles that devices have. Raises InputError."""
    return {b.role for device in bindings(settings) for b in device.bounds}


def lacks(settings: Settings) -> list[str]:
    """Return a line for each sensor that this rig has not, with the consequence.

    Empty for back ends without devices. Raises InputError for a model on a rig without any temperature of
    the air or the coil: there is nothing to start its estimates from."""
    if settings.hal.backend != "devices":
        return []
    coil, roles = settings.channels.coil, given_roles(settings)
    electric = {"voltage_v", "current_a"} <= roles and settings.protection.resistance_ohm > 0.0
    by_resistance = electric and coil not in roles and coil not in settings.protection.required
    lines = []
    if "output_reference_um" not in roles:
        lines.append(
            "no output_reference_um (second encoder): nothing proves the output's error, compensation.tune learns "
            "nothing, `thermoctl calibrate` refuses; a model from `thermoctl plant linearise` compensates "
            "(docs/how-to/without-a-second-encoder.md)"
        )
    if "air_c" not in roles:
        lines.append(
            f"no air_c: the air counts as constant, at the first reading of {coil}; the air's drift is not compensated"
        )
    if coil not in roles and by_resistance:
        lines.append(
            f"no {coil}: the coil's temperature is taken from its resistance (voltage_v, current_a, "
            f"protection.resistance_ohm) while the current is above protection.resistance_current_a "
            f"({settings.protection.resistance_current_a:g} A); in between the model alone estimates it"
        )
    elif coil not in roles:
        lines.append(
            f"no {coil}: the model alone estimates the temperatures, from rest at the air's; no reading corrects them. "
            "voltage_v, current_a and protection.resistance_ohm would make the coil's resistance its thermometer"
        )
    if settings.compensation.model and coil not in roles and "air_c" not in roles and not by_resistance:
        raise InputError(
            f"{settings.path}: compensation.model needs air_c or {coil} (or voltage_v, current_a and "
            "protection.resistance_ohm): without a temperature its estimates have no start"
        )
    return lines


def check_mode(settings: Settings) -> None:
    """Check that the drive takes a target position, um, only with control.mode: position.

    Raises InputError."""
    wanted = settings.control.mode == "position"
    for b in bindings(settings) if settings.hal.backend == "devices" else ():
        profile = b.profile
        if profile.amplifier is None or (profile.amplifier.unit == "um") == wanted:
            continue
        expected = "torque (or velocity)" if wanted else "position"
        raise InputError(
            f"{b.place}: the drive of {profile.model} takes its command in {profile.amplifier.unit}, and control.mode is "
            f"{settings.control.mode}: set control.mode: {expected}, or take a profile whose drive has "
            f"unit {'um' if wanted else 'of a current, voltage or speed'}"
        )


def compensator(settings: Settings) -> CompensatorModel:
    """Load the model that `compensation.model` names, else a model without rises and expansion.

    Raises InputError for a model of another rig, or of other points."""
    if not settings.compensation.model:
        return zero_model(settings.loop.period_s, settings.channels.point_names)
    from thermoctl.identify.modelfile import load_model

    return load_model(settings.compensation.model, settings.rig.name, settings.channels.point_names)


def origin(settings: Settings) -> str:
    """Return a line for a model computed from a plant file; '' for one fitted to recordings.

    Raises InputError for an unreadable model."""
    if not settings.compensation.model:
        return ""
    from thermoctl.identify.modelfile import load_calibration

    calibration = load_calibration(settings.compensation.model)
    sources = calibration.fingerprints
    if calibration.figures or any(Path(name).suffix not in PLANT_FILES for name in sources):
        return ""
    return (
        f"no calibration stands behind the model (computed from {', '.join(sources) or 'no file'}): what it compensates is "
        "expected, not measured; docs/how-to/without-a-second-encoder.md says how to judge it"
    )


def unknown_group(settings: Settings) -> str:
    """Return a line where socket.group is no group of this system; else ''."""
    try:
        grp.getgrnam(settings.socket.group or "root")
    except KeyError:
        return (
            f"socket.group: no group '{settings.socket.group}' on this system: the daemon would not start here; "
            "`thermoctl service install` makes the group thermoctl; leave it out for that of the daemon's user"
        )
    return ""


def shared_name(settings: Settings) -> str:
    """Return the name of the daemon's shared memory: one daemon a socket path."""
    return f"thermoctl-{zlib.crc32(str(Path(settings.socket.path).absolute()).encode()):08x}"


def rig_identity(settings: Settings) -> str:
    """Return the rig's name in recordings.

    It is rig.name, or, without one, the configuration's name and a hash of its path."""
    if settings.rig.name != UNNAMED:
        return settings.rig.name
    path = Path(settings.path).absolute()
    return f"{path.stem}-{zlib.crc32(str(path).encode()):08x}"
