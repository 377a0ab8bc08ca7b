"""The commands `effects` and `diagnose --explain`. They only read files, so no simulation code is loaded."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.report.explain import NOTHING, explain, why
from thermoctl.files.kept import reading
from thermoctl.files.yamlfile import InputError, suggest


def explained(folder: str, effect: str | None = None, own: Sequence[str] = ()) -> int:
    """Print the reasons of a diagnosis, or those of one effect. `own`: further folders of effect files.

    Raises InputError where there is none, and for a name that is no effect."""
    result = read(Path(folder))
    with reading(Path(folder) / "diagnosis.json", "the result of a diagnosis", "diagnose again"):
        answer = why(result, effect) if effect else explain(result)
    if effect and answer.endswith(NOTHING):
        known = catalogue((CATALOGUE, CATALOGUE.parent / "mistakes", *map(Path, own)))
        asked = effect.partition(" at ")[0].replace(" ", "_")
        if asked not in known:
            raise InputError(
                f"'{asked}' is no effect of the catalogue{suggest(asked, known)}, and the diagnosis in {folder} "
                "fitted none of this name; `thermoctl effects` lists them"
            )
    print(answer)
    return 0


def effects(args: argparse.Namespace) -> int:
    """`thermoctl effects [show NAME]`: list the catalogue, or show an entry. Raises InputError."""
    entries = catalogue((CATALOGUE, *map(Path, args.effects or ())))
    console = Console(soft_wrap=True)
    if args.action == "show":
        if args.name not in entries:
            raise InputError(
                f"'{args.name}' is not an effect of the catalogue{suggest(str(args.name), entries)}; "
                "`thermoctl effects` lists them"
            )
        e = entries[args.name]
        console.print(
            f"[bold]{e.name}[/]: {e.title}\nplace       {e.where}\nexcited by  {e.excited_by}\n"
            f"mimics      {', '.join(e.mimics) or '-'}\nsource      {e.source}"
        )
        for number, changes in enumerate(e.changes):
            head = f"variant {number}" if number else "change"
            for kind, value in (pair for change in changes for pair in change.items()):
                if isinstance(value, dict):
                    value = ", ".join(f"{k}: {v}" for k, v in value.items())
                console.print(f"{head:11} {kind}: {value}", markup=False)
        for p in e.parameters:
            console.print(
                f"parameter   {p.name} [{p.unit or '1'}] {p.low:g} .. {p.high:g}, absent at {p.null:g}",
                markup=False,
            )
        return 0
    if args.action:
        raise InputError(
            f"effects: 'show NAME', 'check FILE', 'save DIR NAME' or nothing was expected, not '{args.action}'"
        )
    table = Table("effect", "place", "what it is", box=None, header_style="bold")
    for e in entries.values():
        table.add_row(e.name, e.where, e.title)
    console.print(table)
    return 0


def read(folder: Path) -> dict[str, Any]:
    """Read the result of an earlier diagnosis. Raises InputError."""
    path = folder / "diagnosis.json"
    with reading(path, "the folder of a diagnosis (--out)", "diagnose again"):
        result = json.loads(path.read_bytes())
    if (
        not isinstance(result, dict)
        or not {"decision", "hypotheses", "lost", "refused", "promised"} <= result.keys()
    ):
        raise InputError(f"{path}: written by an older version, without its reasons; diagnose again")
    return result
