"""The command `prove`."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from thermoctl.proof import tables
from thermoctl.proof.prove import prove as prove_cases
from thermoctl.proof.recordings import real, recordings_folder, totals
from thermoctl.proof.run import Reporter
from thermoctl.yamlfile import InputError


def prove(args: argparse.Namespace) -> int:
    """Run `thermoctl prove`: 0 when every goal that could be measured is reached, else 1."""
    console = Console()
    if args.real:
        folder = recordings_folder(args.cases)
        entries = real(folder, args.out, args.scheduler, args.workers, args.number, Reporter())
        console.print(tables.real_table(entries))
        console.print(totals(entries))
        return int(any(e.error for e in entries))
    if not args.cases:
        raise InputError("prove: a folder of cases was expected, or --real")
    content = prove_cases(
        args.cases, args.out, args.answers, args.scheduler, args.workers, args.number, Reporter()
    )
    console.print(tables.table(content))
    console.print(f"written: {Path(args.out) / 'proof.json'}, {Path(args.out) / 'proof.html'}")
    goals = [*content["goals"].values(), *content["open_world"].get("goals", {}).values()]
    return int(any(g["reached"] is False for g in goals))
