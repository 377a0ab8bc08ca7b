"""A plant for Python: the content of a plant file, and methods to save, export and show it."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from thermoctl.api.data import Data, tables_of
from thermoctl.export.commands import SUFFIX, write
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.plant import language, load, save
from thermoctl.plant.show import drawing
from thermoctl.report.page import figure


@dataclass(frozen=True)
class Plant:
    """A checked plant; `description` holds its inputs, parameters, nodes, flows and outputs."""

    description: language.Plant

    @property
    def parameters(self) -> dict[str, float]:
        """Return the values of the parameters, by name."""
        return {p.name: p.value for p in self.description.parameters.values()}

    def with_values(self, values: Mapping[str, float]) -> Plant:
        """Return the plant with other parameter values. Raises InputError for an unknown name."""
        parameters = dict(self.description.parameters)
        for name, value in values.items():
            if name not in parameters:
                raise InputError(f"'{name}' is not a parameter of the plant{suggest(name, parameters)}")
            parameters[name] = dataclasses.replace(parameters[name], value=float(value))
        return Plant(dataclasses.replace(self.description, parameters=parameters))

    def save(self, path: str | Path) -> None:
        """Write the plant file."""
        save(self.description, path)

    def export(self, path: str | Path, data: Data | None = None) -> None:
        """Write the plant for another program: the suffix says which (.fmu, .mo, .py, .c).

        `data`: a recording, where a jump or an initial value needs one. Raises InputError."""
        kinds = {suffix: to for to, suffix in SUFFIX.items()}
        if Path(path).suffix not in kinds:
            raise InputError(f"{path}: one of the endings {', '.join(kinds)} was expected")
        table = tables_of(self.description, data)[0] if data is not None else None
        write(self.description, kinds[Path(path).suffix], Path(path), table)

    def __repr__(self) -> str:
        p = self.description
        return f"<Plant '{p.title}': {len(p.inputs)} inputs, {len(p.parameters)} parameters, {len(p.nodes)} nodes, {len(p.outputs)} outputs>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{p.name}</td><td>{p.value:.6g}</td><td>{html.escape(p.unit or '')}</td>"
            f"<td>{'' if p.range is None else f'{p.range[0]:g} .. {p.range[1]:g}'}</td></tr>"
            for p in self.description.parameters.values()
        )
        head = "<tr><th>parameter</th><th>value</th><th>unit</th><th>range</th></tr>"
        return (
            f"<h4>{html.escape(self.description.title)}</h4>{figure(drawing(self.description, widest=11.0))}"
            f"<table>{head}{rows}</table>"
        )


def plant_of(plant: Plant | str | Path) -> Plant:
    """Return a plant, read from a file where a path is given. Raises InputError."""
    return plant if isinstance(plant, Plant) else Plant(load(plant))
