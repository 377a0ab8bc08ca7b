"""Reload: the whole file is validated again; what may change while running is applied between two ticks."""

from __future__ import annotations

from typing import Any

from thermoctl.control.model import Parameters
from thermoctl.daemon.assemble import law_parameters
from thermoctl.settings import Settings, changed, load_settings


def reload_settings(current: Settings, started: Settings) -> tuple[Any, Parameters, list[str], list[str]]:
    """(settings, parameters, applied keys, keys that count only after a restart).

    current: the settings in force; started: those that the daemon was started with. Raises InputError for a file that
    is not valid: nothing is applied then.
    """
    settings = load_settings(current.path)
    applied = [key for key, restart in changed(current, settings) if not restart]
    waiting = [key for key, restart in changed(started, settings) if restart]
    return settings, law_parameters(settings), applied, waiting
