"""The catalogue of effects, read from files: config/effects/*.yaml, and a user's own folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from thermoctl.diagnosis.hypothesis.effect import Effect, read
from thermoctl.files import yamlfile
from thermoctl.files.shipped import shipped

CATALOGUE = shipped("config/effects")


def catalogue(folders: Sequence[Path] = (CATALOGUE,)) -> dict[str, Effect]:
    """Return all entries of these folders by name. A later entry of the same name wins. Raises InputError."""
    entries = {}
    for folder in folders:
        files = sorted(Path(folder).glob("*.yaml"))
        if not files:
            raise yamlfile.InputError(f"{folder}: no effect files (*.yaml) here")
        for file in files:
            effect = read(yamlfile.load(file))
            entries[effect.name] = effect
    return entries


def contained(entries: Mapping[str, Effect]) -> dict[str, str]:
    """Return, by entry, the simpler effect that it contains, for the entries that contain one."""
    return {e.name: e.contains for e in entries.values() if e.contains}
