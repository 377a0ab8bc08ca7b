"""The command `prove`."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from thermoctl.proof import tables
from thermoctl.proof.prove import prove as prove_cases
from thermoctl.proof.recordings import real
from thermoctl.proof.run import Reporter


def prove(args: argparse.Namespace) -> int:
    """Run `thermoctl prove`: 0 when every goal that could be measured is reached, else 1."""
    console = Console()
    if args.real:
        apart = args.apart.split(",") if args.apart else ()
        entries = real(args.cases, args.out, apart, args.scheduler, args.workers, Reporter())
        console.print(tables.real_table(entries))
        return 0
    content = prove_cases(
        args.cases, args.out, args.answers, args.scheduler, args.workers, args.number, Reporter()
    )
    console.print(tables.table(content))
    console.print(f"written: {Path(args.out) / 'proof.json'}, {Path(args.out) / 'proof.html'}")
    return 0 if all(g["reached"] is not False for g in content["goals"].values()) else 1
