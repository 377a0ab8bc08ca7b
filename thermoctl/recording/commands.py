"""`thermoctl recordings list | info | export | recover`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import write_table
from thermoctl.recording.foreign.logger import joined, options, print_notes, read_recording
from thermoctl.recording.reader import export, info, recover
from thermoctl.recording.writer import FULL, TIER, recording_files

UNKNOWN_RIG = "unknown rig"
"""Label of old recordings, which do not name their rig."""


def list_recordings(args: argparse.Namespace) -> int:
    """Print one line a recording, by rig and run: begin, length, size, and whether it was closed."""
    folder = Path(args.directory)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no such folder; name the one that recording.directory of the configuration says"
        )
    entries: list[dict[str, Any]] = []
    places = [folder, *(p for p in folder.iterdir() if p.is_dir())]  # an axis' recordings: its own folder
    for path in sorted(p for place in places for kind in (FULL, TIER) for p in recording_files(place, kind)):
        try:
            i = info(path)
        except InputError as e:
            entries.append({"path": str(path), "error": str(e)})
            continue
        entries.append(
            {
                "path": str(path),
                "rig": i.meta.get("rig") or UNKNOWN_RIG,
                "run": i.meta.get("run", ""),
                "rows": i.rows,
                "seconds": i.ends_s - i.begins_s,
                "bytes": i.bytes,
                "whole": i.whole,
                "begins": _wall(i.begins_wall_s),
            }
        )
    if args.json:
        print(json.dumps([{k: None if v != v else v for k, v in f.items()} for f in entries], indent=1))
        return 0
    entries.sort(key=lambda f: (f.get("rig", ""), f.get("run", ""), f["path"]))
    heading = None
    for f in entries:
        if "rig" in f and (f["rig"], f["run"]) != heading:
            heading = f["rig"], f["run"]
            print(f"{f['rig']}{', run ' + f['run'] if f['run'] else ''}:")
        print(
            f["error"]
            if "error" in f
            else f"  {f['path']}  {f['begins']}  {f['rows']} rows  {f['seconds']:.3f} s  "
            f"{f['bytes'] / 1e6:.2f} MB{'' if f['whole'] else '  not closed (killed, or still recording)'}"
        )
    if not entries:
        print(f"{folder}: no recordings")
    return 0


def show_info(args: argparse.Namespace) -> int:
    """Print the contents of one recording."""
    i = info(args.file)
    if args.json:
        print(json.dumps({k: None if v != v else v for k, v in dataclasses.asdict(i).items()}, indent=1))
        return 0
    print(
        f"{i.path}: {i.rows} rows, t {i.begins_s:g} to {i.ends_s:g} s, begun {_wall(i.begins_wall_s)}, ended {_wall(i.ends_wall_s)}, "
        f"{i.bytes / 1e6:.2f} MB"
        + (
            ""
            if i.whole
            else f"; not closed: {i.bytes - i.readable_bytes} bytes at its end are no whole batch "
            "(`thermoctl recordings recover` writes a closed copy)"
        )
    )
    for name, unit, meaning in i.columns:
        print(f"  {name:<28} {unit:<6} {meaning}")
    for key, text in i.meta.items():
        print(f"{key}:\n" + "\n".join("  " + line[:200] for line in text.splitlines()))
    return 0


def export_recording(args: argparse.Namespace) -> int:
    """Write a recording in another format."""
    rows = export(
        args.file, args.out, args.columns.split(",") if args.columns else None, args.begin, args.end
    )
    print(f"{args.out}: {rows} rows")
    return 0


def import_recordings(args: argparse.Namespace) -> int:
    """Write the recording of any logger as Parquet, with units; several files are parts of one recording.

    With --explain say how each file is read, and why. Raises InputError without --out and --explain."""
    if not (args.out or args.explain):
        raise InputError("recordings import: --out OUT.parquet was expected, or --explain")
    how = options(args)
    parts = []
    for path in args.files:
        trace: list[str] = []
        parts.append(read_recording(path, **how, trace=trace))
        for line in trace if args.explain else ():
            print(f"{path}: {line}")
    if not args.explain:
        print_notes(parts)
    if args.out:
        table = joined(parts)
        write_table(args.out, table)
        units = ", ".join(f"{n} [{table.units[n]}]" if n in table.units else n for n in table.columns)
        print(f"{args.out}: {len(table)} rows, {table.t[-1] - table.t[0]:.6g} s; {units}")
    return 0


def recover_recording(args: argparse.Namespace) -> int:
    """Write a closed copy of a truncated recording."""
    path = Path(args.file)
    i = recover(path, args.out or path.with_name(path.stem + ".recovered.arrows"))
    print(
        f"{i.path}: {i.rows} rows, t {i.begins_s:g} to {i.ends_s:g} s; {path.stat().st_size - i.bytes + 8} bytes of "
        "the original's end are left out"
    )
    return 0


def _wall(seconds: float) -> str:
    return "-" if math.isnan(seconds) else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%SZ")
