"""Read the recording of any logger: CSV of every dialect, Excel, and the formats of `read_table`.

Our own files take the way of `read_table`: same speed, same errors. Other text is read in the dialect that
its first lines show. Every guess is a note of the table; nothing is repaired silently.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from thermoctl.recording import clock, files, formats
from thermoctl.recording.clock import ClockError, Seconds
from thermoctl.recording.dialect import (
    MISSING,
    Dialect,
    cells_of,
    decoded,
    find_dialect,
    is_number,
    lines,
    split_unit,
)
from thermoctl.recording.table import Table
from thermoctl.yamlfile import InputError, suggest

TEXT = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
EXCEL = (".xlsx", ".xlsm")
HEAD = 65536  # bytes that decide whether a file is one of ours


def read_recording(
    path: str | Path, time: str | None = None, columns: Mapping[str, str] | None = None
) -> Table:
    """Read a recording of any logger. Raises InputError with file and line.

    `time`: the column of times (default: by its name, else the first that increases). `columns` renames:
    wanted name: name in the file. Units of the header are in `units`, guesses in `notes`."""
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        if path.is_dir() or suffix not in (*TEXT, *EXCEL):
            table = _with_units(_of_columns(path, time) if time else files.read_table(path))
        elif suffix in EXCEL:
            table = _read_text(path, formats.read_excel(path), time, ())
        elif time is None and _is_ours(path):
            table = files.read_table(path)
        else:
            if (size := path.stat().st_size) > files.MAX_CSV_BYTES:
                raise InputError(
                    f"{path}: {size} bytes; a text file of at most {files.MAX_CSV_BYTES} was expected "
                    "(cut it in parts)"
                )
            text, notes = decoded(path, path.read_bytes())
            table = _read_text(path, text, time, notes)
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror or e}") from None
    return _renamed(table, columns or {})


def _is_ours(path: Path) -> bool:
    """Whether `read_table` reads the file: commas, points, a column t or t_s, no units in the header."""
    with open(path, "rb") as f:
        head = f.read(HEAD)
    try:
        text = head.removeprefix(b"\xef\xbb\xbf").decode(
            "utf-8", errors="strict" if len(head) < HEAD else "ignore"
        )
    except UnicodeDecodeError:
        return False
    shown = [line for _, line in zip(range(2), (x for _, x in lines(text)), strict=False)]
    if not shown:
        return True  # empty: read_table refuses it
    try:
        names, *rows = [cells_of(line, ",") for line in shown]
    except csv.Error:
        return False
    if not {"t", "t_s"} & set(names) or any(split_unit(n)[1] for n in names):
        return False
    filled = [c for c in (rows[0] if rows else ()) if c not in MISSING]
    at = names.index("t" if "t" in names else "t_s")
    seconds = not rows or at >= len(rows[0]) or not clock.is_time(rows[0][at])
    return seconds and (not filled or any(is_number(c, ".") for c in filled))


def _read_text(path: Path, text: bytes, time: str | None, notes: tuple[str, ...]) -> Table:
    if b"\0" in text:
        raise InputError(f"{path}: holds zero bytes; text was expected (was the file cut off?)")
    lead = text[: 4 * HEAD].decode("utf-8", errors="ignore")
    dialect = find_dialect(path, lead)
    raw = _columns(path, text, dialect)
    names = [n for n in dialect.names if n in raw]
    chosen = _time_columns(path, names, raw, time)
    try:
        seconds, guess = _seconds(chosen, raw, dialect.units), _guess(chosen, time, names)
    except ClockError as e:
        line = _line(text, dialect, e.row)
        raise InputError(f"{path}:{line}: column '{chosen[0]}': {e.reason}") from None
    left = [n for n in names if n not in chosen and not isinstance(raw[n], np.ndarray)]
    values = {n: v for n, v in raw.items() if isinstance(v, np.ndarray) and n not in (*chosen, "t")}
    notes = (*notes, *dialect.notes, *filter(None, (guess, seconds.note)))
    if left:
        notes += (f"columns of text left out: {', '.join(left)}",)
    meta = {"start": seconds.start} if seconds.start else {}
    place = files.Raw({"t": seconds.t, **values}, meta, lambda row: f"{path}:{_line(text, dialect, row)}")
    table = files.checked(path, place)
    return replace(table, units={n: u for n, u in dialect.units.items() if n in values}, notes=notes)


Column: TypeAlias = np.ndarray | pa.ChunkedArray


def _columns(path: Path, text: bytes, dialect: Dialect) -> dict[str, Column]:
    """Numbers (float64) and texts by column; a column of numbers with a text in it is an error."""
    body = _body(text, dialect)
    names = [n or f"\0{i}" for i, n in enumerate(dialect.names)]
    strings = dialect.texts | dialect.times
    kinds = {n: pa.string() if n in strings else pa.float64() for n in names}
    try:
        arrow = pa.csv.read_csv(
            pa.BufferReader(body),
            pa.csv.ReadOptions(column_names=names),
            pa.csv.ParseOptions(delimiter=dialect.separator, ignore_empty_lines=True),
            pa.csv.ConvertOptions(
                column_types=kinds, null_values=list(MISSING), decimal_point=dialect.decimal
            ),
        )
    except pa.ArrowInvalid as e:
        if not body.strip():
            raise InputError(f"{path}: no rows; at least one sample was expected") from None
        _refuse(path, text, dialect)
        raise InputError(f"{path}: cannot be read as a table: {str(e).splitlines()[0]}") from None
    if len(arrow) * len(names) > files.MAX_CELLS:
        raise InputError(
            f"{path}: {len(arrow)} rows; at most {files.MAX_CELLS} cells are read at once: cut it"
        )
    return {
        n: arrow[n].cast(pa.string()) if n in strings else files.to_numpy(arrow[n])
        for n in names
        if not (
            n.startswith("\0") and arrow[n].null_count == len(arrow)
        )  # a separator at the end of each line
    }


def _body(text: bytes, dialect: Dialect) -> bytes:
    at = 0
    for _ in range(dialect.first - 1):
        at = text.find(b"\n", at) + 1
        if at == 0:
            return b""
    body = text[at:]
    return files.COMMENT.sub(b"", body) if b"#" in body else body


def _refuse(path: Path, text: bytes, dialect: Dialect) -> None:
    """Raise InputError for the first cell or row that is no part of the table."""
    for line, content in lines(text.decode("utf-8")):
        if line < dialect.first:
            continue
        cells = cells_of(content, dialect.separator)
        if len(cells) != len(dialect.names):
            raise InputError(
                f"{path}:{line}: {len(cells)} cells; {len(dialect.names)} as in the header were expected"
            )
        for name, cell in zip(dialect.names, cells, strict=True):
            known = (
                cell in MISSING or is_number(cell, dialect.decimal) or name in dialect.texts | dialect.times
            )
            if not known:
                sign = "comma" if dialect.decimal == "," else "point"
                raise InputError(
                    f"{path}:{line}: column '{name}': '{cell[:40]}' stands where a number with a decimal {sign} "
                    "belongs (leave the cell empty where a sample is missing)"
                )


def _line(text: bytes, dialect: Dialect, row: int) -> int:
    """Return the line of data row `row`."""
    numbers = (n for n, _ in lines(text.decode("utf-8")) if n >= dialect.first)
    return next((n for i, n in enumerate(numbers) if i == row), dialect.first + row)


def _time_columns(
    path: Path, names: list[str], raw: Mapping[str, Column], time: str | None
) -> tuple[str, ...]:
    """Return the column of times, or a column of dates and one of times of day."""
    if time is not None:
        plain = split_unit(time)[0]
        found = next((n for n in (time, plain) if n in names), None)
        if found is None:
            raise InputError(
                f"{path}: no column '{time}'{suggest(time, names)}; the columns are {', '.join(names)}"
            )
        return (found,)
    lower = {n if len(n) == 1 else n.lower(): n for n in reversed(names)}  # t is a time, T a temperature
    date, of_day = (
        next((lower[k] for k in keys if k in lower), None) for keys in (clock.DATES, clock.CLOCKS)
    )
    if date and of_day and ":" not in _first(raw[date]) and ":" in _first(raw[of_day]):
        return date, of_day
    for known in clock.NAMES:
        if known in lower:
            return (lower[known],)
    first = names[0]
    values = raw[first]
    if not isinstance(values, np.ndarray):
        if clock.is_time(str(values[0].as_py())):
            return (first,)
    elif len(values) > 1 and bool(np.all(np.diff(values) > 0)):
        return (first,)
    raise InputError(
        f"{path}: no column 't' (time in seconds) and no other name of a time; the columns are {', '.join(names)}; "
        "name it with --time COLUMN"
    )


def _first(column: Column) -> str:
    return "" if isinstance(column, np.ndarray) or not len(column) else str(column[0].as_py())


def _guess(chosen: tuple[str, ...], time: str | None, names: list[str]) -> str:
    if time is not None or chosen[0] in ("t", "t_s"):
        return ""
    return f"time taken from column {' and '.join(repr(n) for n in chosen)} (another: --time COLUMN)"


def _seconds(chosen: tuple[str, ...], raw: Mapping[str, Column], units: Mapping[str, str]) -> Seconds:
    parts = [raw[n] for n in chosen]
    first = parts[0]
    if isinstance(first, np.ndarray):
        return clock.from_numbers(first, units.get(chosen[0]) or _suffix(chosen[0]))
    if len(parts) == 1:
        return clock.from_texts(first)
    return clock.from_texts(pc.binary_join_element_wise(*parts, " "))


def _suffix(name: str) -> str | None:
    """Return the unit that a name such as time_ms ends with."""
    tail = name.rpartition("_")[2]
    return tail if tail != name and tail in clock.SECONDS else None


def _with_units(table: Table) -> Table:
    """Return a Parquet file's table with the units that its fields state."""
    path = Path(table.path)
    if path.suffix.lower() != ".parquet":
        return table
    fields = pa.parquet.read_schema(path)
    stated = {f.name: (f.metadata or {}).get(b"unit", b"").decode(errors="replace") for f in fields}
    return replace(table, units={n: u for n, u in stated.items() if u and n in table.columns})


def _of_columns(path: Path, time: str) -> Table:
    """Read a file of columns by name (Parquet, Arrow, MDF4, TDMS) with another column as the time."""
    reader = files.READERS.get(path.suffix.lower())
    if reader is None or path.is_dir():
        return files.read_table(path)  # which says what was expected
    if path.suffix.lower() != ".parquet":
        table = files.read_table(path)
        if time not in table.columns:
            raise InputError(
                f"{path}: no column '{time}'{suggest(time, table.columns)}; the columns are {', '.join(table.columns)}"
            )
        rest = {n: v for n, v in table.columns.items() if n != time}
        seconds = clock.from_numbers(table.columns[time], _suffix(time))
    else:
        try:
            arrow = pa.parquet.read_table(path)
        except pa.ArrowException as e:
            raise InputError(f"{path}: not a whole parquet file: {str(e).splitlines()[0]}") from None
        if time not in arrow.column_names:
            names = arrow.column_names
            raise InputError(
                f"{path}: no column '{time}'{suggest(time, names)}; the columns are {', '.join(names)}"
            )
        column = arrow[time]
        if pa.types.is_timestamp(column.type):
            ns = column.cast(pa.timestamp("ns", column.type.tz)).cast(pa.int64()).to_numpy()
            start = str(np.datetime64(int(ns[0]) // 1_000_000, "ms"))
            seconds = Seconds((ns - ns[0]) / 1e9, start, f"time from {start}")
        else:
            seconds = clock.from_numbers(files.to_numpy(column.cast(pa.float64())), _suffix(time))
        numbers = [
            f.name for f in arrow.schema if pa.types.is_integer(f.type) or pa.types.is_floating(f.type)
        ]
        rest = {n: files.to_numpy(arrow[n].cast(pa.float64())) for n in numbers if n != time}
    raw = files.Raw(
        {"t": seconds.t, **{n: v for n, v in rest.items() if n != "t"}},
        {},
        lambda row: f"{path}: row {row + 1}",
    )
    return replace(files.checked(path, raw), notes=(seconds.note,) if seconds.note else ())


def _renamed(table: Table, columns: Mapping[str, str]) -> Table:
    if not columns:
        return table
    for wanted, name in columns.items():
        if name not in table.columns:
            known = ", ".join(table.columns)
            raise InputError(
                f"{table.path}: no column '{name}', which '{wanted}' shall be read from"
                f"{suggest(name, table.columns)}; the columns are {known}"
            )
    taken = {name: wanted for wanted, name in columns.items()}
    # Drop a column that already has a wanted name, unless it is renamed too.
    kept = {n: v for n, v in table.columns.items() if n in taken or n not in columns}
    units = {taken.get(n, n): table.units[n] for n in kept if n in table.units}
    return replace(table, columns={taken.get(n, n): v for n, v in kept.items()}, units=units)


def joined(parts: Sequence[Table]) -> Table:
    """Return several files as one recording, in the order of their times. Raises InputError.

    Files with dates are placed by them, others follow by their times."""
    first = parts[0]
    starts = [p.meta.get("start") for p in parts]
    if len(parts) > 1 and all(starts):
        since = [np.datetime64(str(s).removesuffix("Z")) for s in starts]
        offsets = [float((s - min(since)) / np.timedelta64(1, "us")) / 1e6 for s in since]
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
    found: dict[str, str] = {}
    for part in next(csv.reader(io.StringIO(text or "")), []):
        wanted, sign, name = (x.strip() for x in part.partition("="))
        if not (wanted and sign and name):
            raise InputError(f"--columns {part}: NAME=COLUMN was expected, such as heat=P_heater")
        if wanted in found:
            raise InputError(f"--columns: '{wanted}' stands twice; give it once")
        found[wanted] = name
    return found
