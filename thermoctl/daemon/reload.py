"""Reload: validate the whole file again; apply the options that need no restart between two ticks."""

from __future__ import annotations

from typing import Any

from thermoctl.configuration.settings import Settings, changed, load_settings
from thermoctl.control.model import Parameters
from thermoctl.daemon.tick.assemble import law_parameters


def reload_settings(current: Settings, started: Settings) -> tuple[Any, Parameters, list[str], list[str]]:
    """Read the file again; return (settings, parameters, applied keys, keys that need a restart).

    current: the settings in force; started: those at the daemon's start. Raises InputError for an invalid
    file; then nothing is applied.
    """
    settings = load_settings(current.path, current.axis)
    applied = [key for key, restart in changed(current, settings) if not restart]
    waiting = [key for key, restart in changed(started, settings) if restart]
    return settings, law_parameters(settings), applied, waiting
