"""The command `effects check`: mistakes in effect files, each with its place in the file.

An effect that the catalogue's reader takes is put at every place of some plants, where its units are checked.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from thermoctl.diagnosis.hypothesis.candidates import Candidate, candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE
from thermoctl.diagnosis.hypothesis.effect import read
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.files import yamlfile
from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError, Node
from thermoctl.plant import Plant, expression, load
from thermoctl.plant.simulation.simulate import Excitation
from thermoctl.plant.units import check_units


def check_file(path: Path, plants: Sequence[Plant]) -> tuple[str, list[str]]:
    """Check one effect file; return the effect's name and the places of `plants` where it sits.

    Raises InputError with file, line and column at the first mistake."""
    root = yamlfile.load(path)
    effect = read(root)
    places = []
    for plant in plants:
        for c in candidates(made_rig(plant), {effect.name: effect}):
            label = f"{effect.where} '{c.place.where}' of {plant.file}"
            _try(root, c, label)
            if (place := f"{Path(plant.file).name}: {c.place.where}") not in places:
                places.append(place)
    return effect.name, places


def made_rig(plant: Plant) -> Rig:
    """Return a plant with two made recordings in which every input moves, so that every place is found."""
    t = 0.5 * np.arange(80)  # not 1 s: a division by it would vanish, and the units with it
    u = np.array([20.0 + np.where(t > 3 * k + 3, 1.0, 0.0) for k in range(len(plant.inputs))])
    first = {i: 20.0 for i in (*plant.inputs, *plant.outputs)}
    y = np.full((len(t), len(plant.outputs)), np.nan)
    linear = np.array([i.linear for i in plant.inputs.values()], np.intc)
    excitation = Excitation("made", t, u.T.reshape(len(t), len(plant.inputs)), y, first, linear)
    columns = {i.column: q for i, q in zip(plant.inputs.values(), u, strict=True)}
    return Rig(plant, [excitation, dataclasses.replace(excitation, name="made again")], [columns, columns])


def own_plants() -> list[Plant]:
    """Return the templates and the actuator: between them they have most kinds of places."""
    folder = shipped("config/plants")
    return [load(p) for p in (*sorted((folder / "templates").glob("*.yaml")), folder / "actuator.yaml")]


def _try(root: Node, c: Candidate, label: str) -> None:
    """Extend the plant by the effect and check the units. Raises InputError at the effect's change."""
    change = root.value["variants"].value[c.variant - 1] if c.variant else root.value["change"]
    values = {
        p.name: p.typical if p.typical is not None else max(p.low, min(p.high, p.null))
        for p in c.effect.parameters
    }
    try:
        check_units(dataclasses.replace(c.extend(values), file=label))
    except (InputError, expression.ExpressionError, KeyError) as e:
        message = re.sub(r"^.*?:\d+:\d+: ", "", str(e))
        raise change.error(f"at {label}: {message}") from None


def files_of(paths: Sequence[str]) -> Iterator[Path]:
    """Yield the effect files of files and folders. Raises InputError for a folder without one."""
    for path in map(Path, paths or [str(CATALOGUE)]):
        files = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
        if not files:
            raise InputError(f"{path}: no effect files (*.yaml) here")
        yield from files
