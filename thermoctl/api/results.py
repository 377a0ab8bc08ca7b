"""Results of a simulation and of a diagnosis."""

from __future__ import annotations

import dataclasses
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoctl.api.plants import Plant
from thermoctl.api.plots import over_time
from thermoctl.diagnosis.report.figures import chance
from thermoctl.diagnosis.report.words import words
from thermoctl.diagnosis.result import Diagnosis as Found
from thermoctl.diagnosis.result import contract
from thermoctl.plant import save
from thermoctl.plant.simulate import Excitation, compile_plant
from thermoctl.plant.simulate import Simulation as Run
from thermoctl.report.page import figure
from thermoctl.safe_file import whole_files, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Simulation:
    """A free run. `t` (N,) s; `outputs`, `states` and `errors` (measured - simulated) by name, (N,) each."""

    plant: Plant
    excitation: Excitation
    run: Run

    @property
    def t(self) -> np.ndarray:
        """Seconds from the recording's first sample."""
        return self.excitation.t

    @property
    def outputs(self) -> dict[str, np.ndarray]:
        """Readings of perfect sensors."""
        return dict(zip(self.plant.description.outputs, self.run.y.T, strict=True))

    @property
    def states(self) -> dict[str, np.ndarray]:
        """The nodes."""
        return dict(zip(self.plant.description.nodes, self.run.x.T, strict=True))

    @property
    def last(self) -> dict[str, float]:
        """The nodes at the end: `x0` of a run that goes on from here."""
        return {n: float(x[-1]) for n, x in self.states.items()}

    @property
    def errors(self) -> dict[str, np.ndarray]:
        """Measured minus simulated; NaN where not measured."""
        return dict(zip(self.plant.description.outputs, (self.excitation.y - self.run.y).T, strict=True))

    @property
    def rms(self) -> dict[str, float]:
        """Root-mean-square error of each output, NaN where not measured."""
        return {
            o: float(np.sqrt(np.nanmean(e**2))) if np.isfinite(e).any() else float("nan")
            for o, e in self.errors.items()
        }

    def plot(self) -> Figure:
        """Return measured and simulated outputs over time."""
        return over_time(self.plant.description, self.excitation, {"simulated": self.run.y})


def joined(
    plant: Plant, drives: Sequence[Excitation], runs: Sequence[Run], begins: Sequence[float]
) -> Simulation:
    """Return the runs of a recording's parts, which begin at `begins`, s, as one."""
    t = np.concatenate([d.t + b for d, b in zip(drives, begins, strict=True)])
    whole = dataclasses.replace(
        drives[0], t=t, u=np.concatenate([d.u for d in drives]), y=np.concatenate([d.y for d in drives])
    )
    return Simulation(
        plant, whole, Run(t, np.concatenate([r.x for r in runs]), np.concatenate([r.y for r in runs]))
    )


@dataclass(frozen=True)
class FoundEffect:
    """One effect that the plant lacks.

    `confirmed`: probability that it predicts what it was not fitted to. `parameters`: value, sd and unit by
    name; `when`: intervals."""

    effect: str
    where: str
    probability: float
    confirmed: float
    equation: str
    parameters: Mapping[str, Mapping[str, Any]]
    summary: str
    when: Sequence[Sequence[float]] | None = None


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis; `found` holds all that the engine knows."""

    before: Plant
    found: Found

    @cached_property
    def json(self) -> dict[str, Any]:
        """The result as of docs/reference/diagnosis.md."""
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
        return Plant(self.found.extended)

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
