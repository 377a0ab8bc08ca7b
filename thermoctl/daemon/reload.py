"""Reload: validate the whole file again; apply the options that need no restart between two ticks."""

from __future__ import annotations

from typing import Any

from thermoctl.configuration.settings import Settings, changed, load_settings, options, with_live
from thermoctl.control.model import Parameters
from thermoctl.daemon.tick.assemble import law_parameters
from thermoctl.rig.option import LIVE_STEP

ROUNDING = 1e-9  # a change by exactly the factor is no jump


def reload_settings(current: Settings, started: Settings) -> tuple[Any, Parameters, list[str], list[str]]:
    """Read the file again; return (settings, parameters, applied keys, keys that need a restart).

    current: the settings in force; started: those at the daemon's start. Raises InputError for an invalid
    file; then nothing is applied.
    """
    given = load_settings(current.path, current.axis)
    applied = [key for key, restart in changed(current, given) if not restart]
    waiting = [key for key, restart in changed(started, given) if restart]
    settings = with_live(current, given)
    return settings, law_parameters(settings), applied, waiting


def jumps(old: Parameters, new: Parameters, factor: float = LIVE_STEP) -> list[str]:
    """List the changes by more than `factor` of options that an armed rig takes in steps."""
    found = []
    for key, _, row in options():
        if row.in_steps:
            before, after = (getattr(p, key.split(".")[1]) for p in (old, new))
            low, high = sorted((before, after))
            if high > factor * low * (1.0 + ROUNDING):
                found.append(f"{key} {before:g} -> {after:g}")
    return found
