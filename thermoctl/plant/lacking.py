"""Text about columns that a plant reads and a recording lacks, and how to name them."""

from __future__ import annotations

from collections.abc import Iterable

from thermoctl.files.yamlfile import near
from thermoctl.plant.language import Input, Output, Plant
from thermoctl.recording.table import Table

SHOWN = 40  # at most so many columns are listed


def lacking(plant: Plant, table: Table, kind: str, items: Iterable[Input | Output]) -> str:
    """Return the text that a recording has no column of some inputs or outputs (`kind`) of a plant.

    It lists the columns that the plant does not read, and the option that names one for it."""
    read = {r.column for r in plant.readings()}
    rest = [c for c in table.columns if c not in read]
    wanted = list(dict.fromkeys(i.column for i in items))
    pair = next(((w, c) for w in wanted if (c := near(w, rest))), (wanted[0], "COLUMN"))
    return (
        f"{table.path}: no column {', '.join(map(repr, wanted[:SHOWN]))}, "
        f"{f'which an {kind} of' if len(wanted) == 1 else f'which {kind}s of'} {plant.file} "
        f"read{'s' if len(wanted) == 1 else ''}; columns that it does not read: "
        f"{', '.join(rest[:SHOWN]) or 'none'}{'; name one: --columns {}={}'.format(*pair) if rest else ''}"
    )


def outputs_lacking(plant: Plant, table: Table) -> str:
    """Return `lacking` of all outputs where a recording has no column of any, else ""."""
    outputs = plant.outputs.values()
    if any(o.column in table.columns for o in outputs):
        return ""
    return lacking(plant, table, "output", outputs)
