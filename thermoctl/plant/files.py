"""Plant files: parse, then check the units. The only module that does both."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from thermoctl.files import yamlfile
from thermoctl.files.safe_file import write_text
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.foreign import plant_node
from thermoctl.plant.language import Plant
from thermoctl.plant.parse import parse
from thermoctl.plant.units import check_units


def load(path: str | Path, mapped: str | Path | None = None) -> Plant:
    """Read and check a plant file, or an FMU with the file that maps its variables. Raises InputError."""
    if Path(path).suffix.lower() == ".fmu":
        return _checked(plant_node(path, yamlfile.load(mapped) if mapped else None))
    if mapped:
        raise InputError(f"{path}: a map ({mapped}) goes with an FMU; a file that ends in .fmu was expected")
    return _checked(yamlfile.load(path))


def loads(text: str, file: str = "<text>") -> Plant:
    """Read and check a plant from a string; `file` names it in errors. Raises InputError."""
    return _checked(yamlfile.loads(text, file))


def from_plain(data: Mapping[str, Any], file: str = "<plant>") -> Plant:
    """Build and check a plant from plain dicts, which have no line numbers. Raises InputError."""

    def node(value: Any) -> yamlfile.Node:
        """Return plain data as a Node at line 0, column 0; keys become text."""
        if isinstance(value, Mapping):
            value = {str(k): node(v) for k, v in value.items()}
        elif isinstance(value, (list, tuple)):
            value = [node(v) for v in value]
        return yamlfile.Node(value, file, 0, 0)

    return _checked(node(data))


def extended(plant: Plant, change: Callable[[dict[str, Any]], None], file: str | None = None) -> Plant:
    """Return the plant after `change` edited a copy of its plain dicts. Raises InputError."""
    data = copy.deepcopy(plant.plain())
    change(data)
    return from_plain(data, file or plant.file)


def save(plant: Plant, path: str | Path, note: str = "") -> None:
    """Write the plant file, whole or not at all; `note` becomes a comment at its head."""
    text = "".join(f"# {line}\n" for line in note.splitlines())
    text += yamlfile.dumps(plant.plain())
    write_text(path, text)


def _checked(root: yamlfile.Node) -> Plant:
    plant = parse(root)
    check_units(plant)
    return plant
