"""Read the recording of any logger: text of every dialect, Excel, MATLAB, MDF, TDMS, Parquet, JSON.

Files of this program are read by `read_table`, with its speed and its errors. Every other file becomes sheets
of cells. The whole column decides on the kind of its cells, and evidence decides which column is the time.
Every guess is a note of the table; nothing is repaired silently.
"""

from __future__ import annotations

import argparse
import csv
import io
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording import files
from thermoctl.recording.foreign import clock
from thermoctl.recording.foreign.cells import has_no_readings, suspected_codes
from thermoctl.recording.foreign.dialect import cells_of, lines
from thermoctl.recording.foreign.opening import HEAD, kind_of, sheets_of
from thermoctl.recording.foreign.sheet import How
from thermoctl.recording.foreign.timing import MIXED, table_of
from thermoctl.recording.foreign.units import column_of, split_unit, tokens
from thermoctl.recording.table import Table


def read_recording(
    path: str | Path, time: str | None = None, columns: Mapping[str, str] | None = None, **how: Any
) -> Table:
    """Read a recording of any logger. Raises InputError with file and line.

    `time`: see `How` (default: by the evidence of all columns). `columns`: wanted name: name in
    the file. `how`: the other fields of `How`. Units are in `units`, guesses in `notes`."""
    path, said = Path(path), How(time, **how)
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError(f"{path}: a pipe or a device; a file was expected (save its text in one first)")
        if _is_ours(path, said):
            try:
                table = files.read_table(path)
                with_units = any(split_unit(n)[1] for n in table.columns)
                if not with_units and not has_no_readings(table.columns) and np.abs(table.t).max() < EPOCH_S:
                    said.trace.extend(
                        ("format: " + kind_of(path), "time: 't': a table of numbers with a time in seconds")
                    )
                    return _renamed(table, columns or {})
            except InputError:
                if path.is_dir() or path.suffix.lower() not in _FOREIGN:
                    raise
        notes: list[str] = []
        sheets = sheets_of(path, said, notes)
        table = table_of(path, sheets, said, notes)
    except (OSError, pa.ArrowException) as e:
        raise files.unreadable(path, e) from None
    return _renamed(table, columns or {})


EPOCH_S = 1e8  # three years: larger times are milliseconds of an epoch, or seconds of one with its date
_FOREIGN = (".csv", ".arrow", ".feather")  # files that may be another program's though they look like ours


def options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options of a command about reading its recordings, as arguments of `read_recording`."""
    missing = next(csv.reader(io.StringIO(getattr(args, "missing", None) or "")), [])
    return {
        "time": args.time,
        "columns": parsed_columns(args.columns),
        "sheet": getattr(args, "sheet", None),
        "missing": tuple(m.strip() for m in missing),
        "decimal": getattr(args, "decimal", None),
        "run": getattr(args, "run", None),
        "equal_times": getattr(args, "equal_times", None),
    }


def print_notes(tables: Iterable[Table]) -> None:
    """Print the reader's notes; one that several files share is printed once, with the first file's name."""
    where: dict[str, list[str]] = {}
    for table in tables:
        for note in table.notes:
            where.setdefault(note, []).append(table.path)
    for note, paths in where.items():
        also = f" (and {len(paths) - 1} more)" if len(paths) > 1 else ""
        print(f"note: {paths[0]}{also}: {note}", file=sys.stderr)


def _is_ours(path: Path, how: How) -> bool:
    """Return whether `read_table` reads the file: columns of numbers with a time t or t_s, and no choices."""
    if path.is_dir():
        return True  # read_table raises the error
    if how != How():
        return False
    kind = kind_of(path)
    if kind == "text":
        return path.suffix.lower() == ".csv" and _plain(path)
    if kind == "arrow":
        return True
    if kind != "parquet":
        return False
    fields = pa.parquet.read_schema(path)
    if len(set(fields.names)) < len(fields.names):
        return False
    numbers = all(pa.types.is_floating(f.type) or pa.types.is_integer(f.type) for f in fields)
    return numbers and bool({"t", "t_s"} & set(fields.names)) and not any(f.metadata for f in fields)


def _plain(path: Path) -> bool:
    """Return whether a text has commas, points, t or t_s as its only time, and no units in the header."""
    with open(path, "rb") as f:
        head = f.read(HEAD)
        ends = f.seek(max(f.seek(0, 2) - 1, 0)) == 0 or f.read(1) in b"\r\n"
    try:
        text = head.removeprefix(b"\xef\xbb\xbf").decode(
            "utf-8", errors="strict" if len(head) < HEAD else "ignore"
        )
    except UnicodeDecodeError:
        return False
    if not ends:
        return False  # the last line may be cut off
    shown = [line for _, line in zip(range(2), (x for _, x in lines(text)), strict=False)]
    if not shown:
        return True  # empty: read_table refuses it
    try:
        names, *rows = [cells_of(line, ",") for line in shown]
    except csv.Error:
        return False
    if not {"t", "t_s"} & set(names) or any(split_unit(n)[1] for n in names):
        return False
    others = [
        n
        for n in names
        if n not in ("t", "t_s", "wall_s") and {"time", "zeit", "date", "timestamp"} & set(tokens(n))
    ]
    filled = [c for c in (rows[0] if rows else ()) if c and c.lower() != "nan"]
    return not others and all(re.fullmatch(r"-?\d*\.?\d+(?:[eE][-+]?\d+)?|-?\d+\.", c) for c in filled)


def _renamed(table: Table, columns: Mapping[str, str]) -> Table:
    table = replace(table, notes=(*table.notes, *suspected_codes(table.columns)))
    if not columns:
        return table
    chosen: dict[str, str] = {}
    for wanted, name in columns.items():
        if (column := column_of(name, table.columns, table.units)) is None:
            known = ", ".join(table.columns)
            raise InputError(
                f"{table.path}: no column '{name}', which '{wanted}' shall be read from"
                f"{suggest(name, table.columns)}; the columns are {known}"
            )
        chosen[wanted] = column
    # A column that already has a wanted name is dropped, unless it is renamed too.
    sources = {n: n for n in table.columns if n not in chosen.values()} | chosen
    units = {n: table.units[c] for n, c in sources.items() if c in table.units}
    return replace(table, columns={n: table.columns[c] for n, c in sources.items()}, units=units)


def _refuse_unsure_order(parts: Sequence[Table]) -> None:
    """Raise InputError where the dates of a file may be two days each, and no other file says which."""
    read = [
        (p.path, m)
        for p in parts
        for n in p.notes
        if (m := re.search(r"dates read as ([\w./-]+)( \(or)?", n))
    ]
    sure = {m[1] for _, m in read if not m[2]}
    for path, m in read:
        if m[2] and sure != {m[1]}:
            raise InputError(
                f"{path}: day and month cannot be told apart, and the dates place this file among the others; write "
                "them as 2026-03-14, or put the rows into one file"
            )


def joined(parts: Sequence[Table]) -> Table:
    """Return several files as one recording, in the order of their times. Raises InputError.

    Files with dates are placed by them, others follow by their times."""
    first = parts[0]
    starts = [p.meta.get("start") for p in parts]
    if len({str(s).endswith("Z") for s in starts if s}) > 1:
        raise InputError(f"{parts[1].path}: {MIXED}")
    if any(starts) and not all(starts):
        without = parts[list(map(bool, starts)).index(False)].path
        raise InputError(
            f"{without}: times without a date beside files with dates: nothing says where it begins"
        )
    if len({str(s)[:10] for s in starts}) > 1:
        _refuse_unsure_order(parts)
    if len(parts) > 1 and all(starts):
        offsets = clock.offsets(list(map(str, starts)))
        parts = [replace(p, t=p.t + o) for p, o in zip(parts, offsets, strict=True)]
        first = parts[int(np.argmin(offsets))]
    parts = sorted(parts, key=lambda p: p.t[0])
    for a, b in pairwise(parts):
        if set(a.columns) != set(b.columns):
            differing = ", ".join(sorted(set(a.columns) ^ set(b.columns)))
            raise InputError(
                f"{b.path}: other columns than {a.path} ({differing}); parts of one recording were expected"
            )
        if any(a.units.get(n) != b.units.get(n) for n in a.columns):
            raise InputError(f"{b.path}: other units than {a.path}; import them one by one")
        if not b.t[0] > a.t[-1]:
            raise InputError(
                f"{b.path}: begins at t = {b.t[0]:.6g} s, before the end of {a.path} at {a.t[-1]:.6g} s; parts of one "
                "recording were expected"
            )
    t = np.concatenate([p.t for p in parts])
    columns = {n: np.concatenate([p.columns[n] for p in parts]) for n in first.columns}
    return replace(first, t=t, columns=columns, notes=())


def parsed_columns(text: str | None) -> dict[str, str]:
    """Return the option `--columns A=B,C=D` as a mapping. Raises InputError."""
    names: dict[str, str] = {}
    for part in next(csv.reader(io.StringIO(text or "")), []):
        wanted, sign, name = (x.strip() for x in part.partition("="))
        if not (wanted and sign and name):
            raise InputError(f"--columns {part}: NAME=COLUMN was expected, such as heat=P_heater")
        if wanted in names:
            raise InputError(f"--columns: '{wanted}' stands twice; give it once")
        names[wanted] = name
    return names
