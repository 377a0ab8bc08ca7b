"""The command `plant check`, and the checks that `diagnose` makes first."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TextIO

from thermoctl.checks import Finding, checks
from thermoctl.checks.file import file_findings
from thermoctl.plant import Plant, load
from thermoctl.plant.recordings import read_recordings
from thermoctl.recording.logger import options, print_notes
from thermoctl.recording.table import Table
from thermoctl.yamlfile import InputError


def check(args: argparse.Namespace) -> int:
    """Load each plant file with all its checks; with --data compare one with recordings.

    Returns 1 for a severe finding; without --data also for a negative storage."""
    if args.data and len(args.plants) != 1:
        raise InputError("plant check --data: one plant file was expected")
    severe = False
    for path in args.plants:
        p = load(path, args.map)
        free = sum(1 for q in p.parameters.values() if q.range)
        print(
            f"{path}: good; {len(p.inputs)} inputs, {len(p.parameters)} parameters ({free} free), {len(p.nodes)} nodes, "
            f"{len(p.flows)} flows, {len(p.outputs)} outputs"
        )
        if args.data:
            _, found = checked(p, args.data, args)
            report(found, sys.stdout)
            if not found:
                print("the recordings fit the plant's labels, units and clock")
            return int(any(f.severe for f in found))
        alone = file_findings(p)
        report(alone, sys.stdout)
        severe |= any(f.severe for f in alone)
    return int(severe)


def checked(
    plant: Plant, paths: Sequence[str], args: argparse.Namespace
) -> tuple[list[Table], list[Finding]]:
    """Read recordings for a plant, print the reader's notes, and return the tables and the findings."""
    tables = read_recordings(plant, paths, **options(args))
    print_notes(tables)
    return tables, checks(plant, tables)


def report(found: Sequence[Finding], out: TextIO) -> None:
    """Print each finding on a line of its own."""
    for finding in found:
        print(finding, file=out)
