"""The numbers by which a diagnosis decides, from config/diagnosis.yaml."""

from __future__ import annotations

from dataclasses import dataclass, fields

from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import Section, load


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
    unasked: float


def limits() -> Thresholds:
    """Read the shipped numbers. Raises InputError where one is missing or not known."""
    top = Section(load(shipped("config") / "diagnosis.yaml"), "the numbers of a diagnosis")
    sections = {f.name: top.section(f.name) for f in fields(Thresholds)}
    top.end()
    return Thresholds(**{name: s.get("value").value for name, s in sections.items()})
