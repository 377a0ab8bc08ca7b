"""Checks of a plant and its recordings before any refit: wrong labels, units, clocks and signs, damaged data.

`checks` takes seconds. Each finding has a suggestion. A severe finding means that a diagnosis of these data
would name the mistake as physics.
"""

from __future__ import annotations

from collections.abc import Sequence

from thermoctl.checks.data import data_findings
from thermoctl.checks.file import unconverted
from thermoctl.checks.finding import Finding
from thermoctl.checks.hung import hung_findings, without_hung
from thermoctl.checks.labels import label_findings
from thermoctl.checks.model import plant_findings, start_findings
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant
from thermoctl.plant.lacking import outputs_lacking
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.plant.units import in_plant_units
from thermoctl.recording.table import Table

__all__ = ["Finding", "checks"]


def checks(plant: Plant, recordings: Sequence[Table]) -> list[Finding]:
    """Return what is wrong with a plant and its recordings, severe findings first.

    Raises InputError where a recording lacks an input of the plant, or all its outputs."""
    model = compile_plant(plant)
    given = [in_plant_units(plant, t) for t in recordings]
    tables, _ = without_hung(plant, given)
    excitations = [model.excitation(t) for t in tables]
    if text := next(filter(None, (outputs_lacking(plant, t) for t in tables)), ""):
        raise InputError(text)
    findings = [*plant_findings(model, excitations), *(f for f, _ in unconverted(plant))]
    findings += [f for t in given for f in hung_findings(plant, t)]
    for table, excitation in zip(tables, excitations, strict=True):
        findings += data_findings(model, table, excitation)
    if not any(f.severe for f in findings):
        labels, cleared = label_findings(model, tables)
        findings += labels
        for table in cleared:
            findings += start_findings(model, model.excitation(table))
    order = sorted(findings, key=lambda f: not f.severe)
    return list({f.what: f for f in reversed(order)}.values())[::-1]  # each once, the severe one
