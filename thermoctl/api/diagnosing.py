"""A diagnosis and its result; the only module of the interface that loads the search."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermoctl.api.data import Data, tables_of
from thermoctl.api.plants import Plant, plant_of
from thermoctl.api.plots import over_time
from thermoctl.checks import checks
from thermoctl.diagnosis.contract import contract
from thermoctl.diagnosis.diagnose import diagnose as _diagnose
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.diagnosis.relabelled import relabelled
from thermoctl.diagnosis.report.figures import chance
from thermoctl.diagnosis.report.words import words
from thermoctl.diagnosis.result import Diagnosis as Found
from thermoctl.files.safe_file import whole_files, write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import save
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.report.page import figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FoundEffect:
    """One effect that the plant lacks.

    `confirmed`: probability that it predicts data that it was not fitted to. `parameters`: value, sd and
    unit by name; `when`: intervals. `recording`: the one in which an event happens, None where it is at the
    same time of each; `lasts`: in later recordings, too? `members`: of a family whose effects the data do not
    tell apart, each with effect, where and probability. Equation and parameters are then of the one in the
    plant."""

    effect: str
    where: str
    probability: float
    confirmed: float
    equation: str
    parameters: Mapping[str, Mapping[str, Any]]
    summary: str
    when: Sequence[Sequence[float]] | None = None
    recording: str | None = None
    lasts: bool | None = None
    members: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis. `found`: the whole outcome (thermoctl.diagnosis.result.Diagnosis)."""

    before: Plant
    found: Found

    @cached_property
    def json(self) -> dict[str, Any]:
        """Return the result as a dict; docs/reference/diagnosis.md describes its keys."""
        return contract(self.found)

    @property
    def verdict(self) -> str:
        """consistent, explained, ambiguous, partly_explained or unexplained."""
        return str(self.json["verdict"])

    @property
    def findings(self) -> list[FoundEffect]:
        """The effects that the plant lacks, each with its own probability."""
        return [FoundEffect(**f) for f in self.json["findings"]]

    @property
    def summary(self) -> str:
        """The result in a few sentences."""
        return words(self.json)

    @property
    def plant(self) -> Plant:
        """The plant with the findings and refitted parameters."""
        return Plant(self.found.plant)

    def save(self, folder: str | Path) -> None:
        """Write diagnosis.json and plant.yaml."""
        with whole_files(folder) as part:
            save(self.plant.description, part / "plant.yaml")
            write_text(part / "diagnosis.json", json.dumps(self.json, indent=1, allow_nan=False) + "\n")

    def plot(self, recording: int = 0) -> Figure:
        """Return one recording with the plant as it came, refitted, and with the findings."""
        table = self.found.case.tables[recording]
        stages = {"as it came": self.before.description, "refitted": self.found.null.plant}
        if self.found.shown:
            stages["with the findings"] = self.plant.description
        lines = {}
        for label, plant in stages.items():
            model = compile_plant(plant, ())
            excitation = model.excitation(table)
            lines[label] = model.run(excitation).y
        return over_time(self.before.description, excitation, lines)

    def __repr__(self) -> str:
        return f"<Diagnosis: {self.verdict}; {', '.join(f'{f.effect} at {f.where}' for f in self.findings) or 'no finding'}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{f.effect}</td><td>{f.where}</td><td>{chance(f.probability)}</td>"
            f"<td><code>{html.escape(f.equation)}</code></td></tr>"
            for f in self.findings
        )
        head = "<tr><th>effect</th><th>where</th><th>probability</th><th>equation</th></tr>"
        table = f"<table>{head}{rows}</table>" if rows else ""
        return f"<h4>{self.verdict}</h4><p>{html.escape(self.summary)}</p>{table}{figure(self.plot())}"


def diagnose(
    plant: Plant | str | Path,
    data: Data | Sequence[Data],
    held_out: Data | Sequence[Data] = (),
    effects: Sequence[str | Path] = (),
    anyway: bool = False,
) -> Diagnosis:
    """Find the physics that a plant lacks. Raises InputError, also for a severe finding of `check`.

    `held_out`: recordings for validation only; `effects`: folders of further effect files; `anyway`: diagnose
    in spite of a severe finding."""
    own = plant_of(plant)
    tables = tables_of(own.description, data)
    severe = [] if anyway else [f for f in checks(own.description, tables) if f.severe]
    if severe:
        raise InputError(f"{severe[0]} (anyway=True diagnoses in spite of it)")
    entries = catalogue((CATALOGUE, *map(Path, effects)))
    reserve = tables_of(own.description, held_out)
    outcome = _diagnose(own.description, tables, entries, limits(), reserve)
    if not anyway and (wrong := relabelled(outcome)):
        raise InputError(f"{wrong[0]} (anyway=True diagnoses in spite of it)")
    return Diagnosis(own, outcome)
