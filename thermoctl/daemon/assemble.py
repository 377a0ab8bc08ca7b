"""Make the law's inputs from the configuration: parameters, the model, names of shared memory."""

from __future__ import annotations

import zlib
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from hal.binding import bind
from thermoctl.channels import CHANNELS
from thermoctl.control.model import BY_CHANNEL, CompensatorModel, Parameters, zero_model
from thermoctl.settings import RigSettings, Settings
from thermoctl.yamlfile import InputError, load

UNNAMED = RigSettings().name


def law_parameters(settings: Settings) -> Parameters:
    """Return the law's parameters from `settings`. Raises InputError for an unknown channel."""
    given: dict[str, Any] = vars(settings.control) | vars(settings.compensation) | vars(settings.protection)
    given |= {
        "compensate": settings.compensation.enable,
        "required": dict.fromkeys(settings.protection.required, 1.0),
    }
    taken: dict[str, Any] = {
        f.name: _by_channel(given[f.name], BY_CHANNEL[f.name], f"protection.{f.name}")
        if f.name in BY_CHANNEL
        else float(given[f.name])
        for f in fields(Parameters)
    }
    return Parameters(**taken)


def _by_channel(given: Any, default: float, where: str) -> np.ndarray:
    array = np.full(len(CHANNELS), default)
    for name, number in given.items():
        if name not in CHANNELS:
            raise InputError(f"{where}: no channel '{name}'; expected one of {', '.join(CHANNELS)}")
        array[CHANNELS.index(name)] = number
    return array


def power_warning(settings: Settings) -> str:
    """Return a warning with file:line when the coil's power cannot be computed, else ''."""
    protection = settings.protection
    if settings.hal.backend != "devices":
        return ""
    folder = Path(settings.path).parent
    roles = {b.role for node in settings.hal.devices for b in bind(node, folder).bounds}
    lacks = [] if "current_a" in roles else ["current_a"]
    if "voltage_v" not in roles and protection.resistance_ohm == 0.0:
        lacks.append("voltage_v (or protection.resistance_ohm, for R I^2)")
    if not lacks:
        return ""
    root = load(settings.path)
    section = root.value.get("protection", root)
    place = section.value.get("power_limit_w", section) if section is not root else root
    return str(
        place.error(
            f"the coil's power is unknown without {' and '.join(lacks)}: protection.power_limit_w "
            f"({protection.power_limit_w:g} W) can never trip, and the model is driven with 0 W: its estimates and the "
            "compensation follow the coil's reading alone"
        )
    )


def compensator(settings: Settings) -> CompensatorModel:
    """Load the model that `compensation.model` names, else a model without rises and expansion.

    Raises InputError for a model of another rig.
    """
    if not settings.compensation.model:
        return zero_model(settings.loop.period_s)
    from thermoctl.identify.modelfile import load_model

    return load_model(settings.compensation.model, settings.rig.name)


def shared_name(settings: Settings) -> str:
    """Return the name of the daemon's shared memory: one daemon a socket path."""
    return f"thermoctl-{zlib.crc32(str(Path(settings.socket.path).absolute()).encode()):08x}"


def rig_identity(settings: Settings) -> str:
    """Return the rig's name in recordings.

    It is rig.name, or, without one, the configuration's name and a hash of its path.
    """
    if settings.rig.name != UNNAMED:
        return settings.rig.name
    path = Path(settings.path).absolute()
    return f"{path.stem}-{zlib.crc32(str(path).encode()):08x}"
