"""Reload: validate the whole file again; apply the options that need no restart between two ticks."""

from __future__ import annotations

from typing import Any

from thermoctl.configuration.settings import Settings, changed, load_settings, with_live
from thermoctl.control.model import Parameters
from thermoctl.daemon.tick.assemble import law_parameters
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.option import LIVE_STEP

# Options of which a larger change would make the output of an armed rig jump.
IN_STEPS = (
    *(f"control.{n}" for n in ("kp", "ti_s", "td_s", "output_limit", "setpoint_rate_um_s", "moving_average")),
    "compensation.slew_um_s",
)
ROUNDING = 1e-9  # a change by exactly the factor is no jump


def reload_settings(current: Settings, started: Settings) -> tuple[Any, Parameters, list[str], list[str]]:
    """Read the file again; return (settings, parameters, applied keys, keys that need a restart).

    current: the settings in force; started: those at the daemon's start. Raises InputError for an invalid
    file, or one that lacks options in force; then nothing is applied."""
    given = load_settings(current.path, current.axis)
    if lost := vanished(current, given):
        raise InputError(
            f"{current.path}: nothing was changed: {', '.join(lost)}: in force, and no longer in the file. Was it cut? "
            "Write the value that is wanted, also where it is the default; a limit goes away by a restart only"
        )
    applied = [key for key, restart in changed(current, given) if not restart]
    waiting = [key for key, restart in changed(started, given) if restart]
    settings = with_live(current, given)
    return settings, law_parameters(settings), applied, waiting


def vanished(current: Settings, given: Settings) -> list[str]:
    """List the options in force that a file has no longer, and whose default or absence would count."""
    found = []
    for key in (key for key, restart in changed(current, given) if not restart):
        before, after = current.value(key), given.value(key)
        if key not in given.given:
            found.append(key)
        elif isinstance(before, dict):
            found += [f"{key}.{name}" for name in before if name not in after]
    return found


def jumps(old: Parameters, new: Parameters, factor: float = LIVE_STEP) -> list[str]:
    """List the changes of options IN_STEPS by more than `factor`."""
    found = []
    for key in IN_STEPS:
        before, after = (getattr(p, key.split(".")[1]) for p in (old, new))
        if max(before, after) > factor * min(before, after) * (1.0 + ROUNDING):
            found.append(f"{key} {before:g} -> {after:g}")
    return found
