"""Reload: the whole file is validated again; what may change while running is applied between two ticks."""
from __future__ import annotations

from typing import Any

from thermoctl.control.model import Parameters
from thermoctl.daemon.assemble import law_parameters
from thermoctl.settings import changed, load_settings


def reload_settings(current: Any) -> tuple[Any, Parameters, list[str], list[str]]:
    """(settings, parameters, changed keys, those of them that count only after a restart).

    The settings that come back are the new ones. Raises InputError for a file that is not valid: nothing is applied then.
    """
    settings = load_settings(current.path)
    found = changed(current, settings)
    return settings, law_parameters(settings), [key for key, _ in found], [key for key, restart in found if restart]
