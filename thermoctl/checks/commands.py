"""The command `plant check`, and the checks that `diagnose`, `refit` and `simulate` make first."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TextIO

from thermoctl.checks import Finding, checks
from thermoctl.checks.file import file_findings, other_degrees
from thermoctl.checks.hung import without_hung
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import Plant, commands, load
from thermoctl.plant.lacking import outputs_lacking
from thermoctl.plant.recordings import read_recordings
from thermoctl.recording.foreign.logger import options, print_notes
from thermoctl.recording.table import Table


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
            findings = [*other_degrees(p), *checked(p, args.data, args)[1]]
            report(findings, sys.stdout)
            if not findings:
                print("the recordings fit the plant's labels, units and clock")
            return int(any(f.severe for f in findings))
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


def refit(args: argparse.Namespace) -> int:
    """`thermoctl refit`: after the checks. A severe finding stops it: a parameter would absorb the mistake.

    Raises InputError."""

    def read(plant: Plant, paths: Sequence[str], args: argparse.Namespace) -> list[Table]:
        """Read recordings; refuse those with a severe finding."""
        tables, findings = checked(plant, paths, args)
        report(findings, sys.stderr)
        if any(f.severe for f in findings) and not args.anyway:
            raise InputError(
                f"{plant.file}: not refitted: the checks above would make any number doubtful; correct the data or the "
                "plant, or refit with --anyway"
            )
        return without_hung(plant, tables)[0]

    return commands.refit(args, read)


def simulate(args: argparse.Namespace) -> int:
    """`thermoctl simulate`: after the checks, which do not stop it."""

    def read(plant: Plant, paths: Sequence[str], args: argparse.Namespace) -> list[Table]:
        """Read recordings; check those that have a column of an output, say which have none."""
        tables = read_recordings(plant, paths, **options(args))
        print_notes(tables)
        lack = [outputs_lacking(plant, t) for t in tables]
        for text in filter(None, lack):
            print(f"note: {text}; the simulation is compared with nothing", file=sys.stderr)
        report(checks(plant, [t for t, text in zip(tables, lack, strict=True) if not text]), sys.stderr)
        return tables

    return commands.simulate(args, read)


def report(found: Sequence[Finding], out: TextIO) -> None:
    """Print each finding on a line of its own; one that several recordings share is printed once."""
    where: dict[Finding, list[Finding]] = {}
    for f in found:
        # A missing `between_samples` concerns the plant file; its numbers differ in each recording.
        where.setdefault(replace(f, where="", what=f.what if f.kind != "between" else ""), []).append(f)
    for f, *more in where.values():
        places = [x.where for x in (f, *more) if x.what == f.what]
        shared = ", ".join(dict.fromkeys(places))
        count = f" (in {len(more) + 1} recordings)" if len(places) <= len(more) else ""
        print(replace(f, where=shared, what=f.what + count), file=out)
