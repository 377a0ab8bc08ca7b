"""The numbers by which a diagnosis decides, from config/diagnosis.yaml."""

from __future__ import annotations

from dataclasses import dataclass, fields

from thermoctl.files import yamlfile
from thermoctl.files.shipped import shipped


@dataclass(frozen=True)
class Thresholds:
    """The numbers by their names. config/diagnosis.yaml states the meaning and origin of each."""

    beam: int
    shortlist: int
    effects: int
    fits: int
    missing: float
    rare: float
    name: float
    set: float
    clean: float
    alike: float


def limits() -> Thresholds:
    """Read the shipped numbers. Raises InputError where one is missing or not known."""
    root = yamlfile.load(shipped("config") / "diagnosis.yaml")
    names = {f.name for f in fields(Thresholds)}
    for key, node in root.value.items():
        if key not in names:
            raise node.error(
                f"unknown number '{key}'; known are {', '.join(sorted(names))}{yamlfile.suggest(key, names)}"
            )
    values = {key: node.plain()["value"] for key, node in root.value.items()}
    for key in names - values.keys():
        raise root.error(f"the number '{key}' is missing")
    return Thresholds(**values)
