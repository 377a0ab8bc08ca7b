"""Read the recording of any logger: text of every dialect, Excel, MATLAB, MDF, TDMS, Parquet, JSON.

Files of this program are read by `read_table`, with its speed and its errors. Every other file becomes sheets
of cells. The whole column decides on the kind of its cells, and evidence decides which column is the time.
Every guess is a note of the table; nothing is repaired silently.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import io
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording import files
from thermoctl.recording.foreign import axis, cells, clock, formats, layouts
from thermoctl.recording.foreign.axis import Clock
from thermoctl.recording.foreign.cells import CellError
from thermoctl.recording.foreign.clock import ClockError
from thermoctl.recording.foreign.dialect import (
    FACT,
    Dialect,
    cells_of,
    decoded,
    find_dialect,
    is_comment,
    lines,
    stated_step,
)
from thermoctl.recording.foreign.sheet import Cells, Sheet
from thermoctl.recording.foreign.units import split_unit, split_words
from thermoctl.recording.table import Table

HEAD = 65536  # number of first bytes that show whether this program wrote the file
HOUR_S = 3600.0
EQUAL_TIMES = ("spread", "mean", "first", "last")
MAGIC = (
    (b"MDF     ", "mdf"),
    (b"UnFinMF ", "mdf"),
    (b"TDSm", "tdms"),
    (b"PK\x03\x04", "excel"),
    (b"PAR1", "parquet"),
    (b"ARROW1", "arrow"),
    (b"\x89HDF", "mat"),
    (b"MATLAB ", "mat"),
    (b"\xd0\xcf\x11\xe0", "xls"),
    (b"\x1f\x8b", "gzip"),
)
_SUFFIXES = {
    ".mf4": "mdf",
    ".mdf": "mdf",
    ".tdms": "tdms",
    ".xlsx": "excel",
    ".xlsm": "excel",
    ".parquet": "parquet",
}
_SUFFIXES |= {".arrow": "arrow", ".arrows": "arrow", ".feather": "arrow", ".mat": "mat"}


@dataclass(frozen=True)
class How:
    """Choices of a person about the reading of a file; the reader finds the others.

    - `time`: column of times
    - `sheet`: sheet of Excel, group of TDMS, variable of MATLAB
    - `missing`: further words and numbers for "no value"
    - `decimal`: the decimal sign
    - `run`: the one to read of several in a file, from 1
    - `equal_times`: see EQUAL_TIMES
    - `trace`: receives how the file was read, for people"""

    time: str | None = None
    sheet: str | None = None
    missing: tuple[str, ...] = ()
    decimal: str | None = None
    run: int | None = None
    equal_times: str | None = None
    trace: list[str] = field(default_factory=list, compare=False)


def read_recording(
    path: str | Path, time: str | None = None, columns: Mapping[str, str] | None = None, **how: Any
) -> Table:
    """Read a recording of any logger. Raises InputError with file and line.

    `time`: the column of times (default: by the evidence of all columns). `columns`: wanted name: name in
    the file. `how`: the other fields of `How`. Units are in `units`, guesses in `notes`."""
    path, said = Path(path), How(time, **how)
    try:
        if _is_ours(path, said):
            try:
                table = files.read_table(path)
                said.trace.extend(
                    ("format: " + _kind(path), "time: 't': a table of numbers with a time in seconds")
                )
                return _renamed(table, columns or {})
            except InputError:
                if path.is_dir() or path.suffix.lower() not in _TEXT:
                    raise
        notes: list[str] = []
        sheets = _sheets(path, said, notes)
        table = _table(path, sheets, said, notes)
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror or e}") from None
    except pa.ArrowException as e:
        raise InputError(f"{path}: not a whole {path.suffix[1:]} file: {str(e).splitlines()[0]}") from None
    return _renamed(table, columns or {})


_SINCE = re.compile(r", from \d{4}-\d\d-\d\d [\d:.]+( UTC)?")
_TEXT = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc", "")


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
    kind = _kind(path)
    if kind == "text":
        return path.suffix.lower() == ".csv" and _plain(path)
    if kind == "arrow":
        return True
    if kind != "parquet":
        return False
    fields = pa.parquet.read_schema(path)
    numbers = all(pa.types.is_floating(f.type) or pa.types.is_integer(f.type) for f in fields)
    return numbers and bool({"t", "t_s"} & set(fields.names)) and not any(f.metadata for f in fields)


def _kind(path: Path) -> str:
    """Return the format by the first bytes, of an empty or damaged file by its suffix."""
    with open(path, "rb") as f:
        head = f.read(8)
    suffix = path.suffix.lower()
    if suffix in _SUFFIXES and (not head or suffix in (".arrow", ".arrows", ".feather")):
        return _SUFFIXES[suffix]
    found = next((kind for magic, kind in MAGIC if head.startswith(magic)), None)
    return found or _SUFFIXES.get(suffix, "text")


def _plain(path: Path) -> bool:
    """Return whether a text has commas, points, t or t_s as its only time, and no units in the header."""
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
    others = [
        n
        for n in names
        if n not in ("t", "t_s", "wall_s") and {"time", "zeit", "date", "timestamp"} & set(axis.tokens(n))
    ]
    filled = [c for c in (rows[0] if rows else ()) if c and c.lower() != "nan"]
    return not others and all(re.fullmatch(r"-?\d*\.?\d+(?:[eE][-+]?\d+)?|-?\d+\.", c) for c in filled)


def _sheets(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    """Read a file's sheets by its format."""
    kind = _kind(path)
    how.trace.append(f"format: {kind}")
    if kind in _READERS:
        return [_of_names(s) for s in _READERS[kind](path, how, notes)]
    if kind == "xls":
        raise InputError(f"{path}: an Excel file of before 2007; save it as .xlsx or .csv")
    if (size := path.stat().st_size) > files.MAX_CSV_BYTES:
        raise InputError(
            f"{path}: {size} bytes; a text file of at most {files.MAX_CSV_BYTES} was expected (cut it in parts)"
        )
    data = path.read_bytes()
    if kind == "gzip":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError) as e:
            raise InputError(f"{path}: not a whole gzip file: {e}") from None
    text, said = decoded(path, data)
    notes += said
    return _text(path, text, how, notes)


def _of_names(sheet: Sheet) -> Sheet:
    """Return a sheet with the units that its columns' names state, such as 'P (mW)', as those of a text."""
    split = {n: split_words(n) for n in sheet.columns}
    plain = [name for name, _ in split.values()]
    names = {
        n: name if unit and n not in sheet.units and plain.count(name) == 1 else n
        for n, (name, unit) in split.items()
    }
    units = sheet.units | {names[n]: unit for n, (_, unit) in split.items() if unit and names[n] != n}
    return replace(sheet, columns={names[n]: c for n, c in sheet.columns.items()}, units=units)


def _arrow(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    table = files.read_table(path)
    return [Sheet({"t": table.t, **table.columns}, lambda row: f"{path}: row {row + 1}", meta=table.meta)]


def _excel(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    """Return the named sheet of an Excel file, else the first that holds a table."""
    pages = formats.read_excel(path, how.sheet)
    first: InputError | None = None
    for title, text in pages:
        try:
            here: list[str] = []
            read_sheets = _text(path, text, how, here)
            _table(path, read_sheets, how, list(here))
        except InputError as e:
            first = first or e
            continue
        if len(pages) > 1:
            notes.append(f"sheet '{title}' read, of {', '.join(t for t, _ in pages)} (another: --sheet NAME)")
        notes += here
        return read_sheets
    raise first or InputError(f"{path}: no rows; at least one sample was expected")


_READERS: dict[str, Callable[[Path, How, list[str]], list[Sheet]]] = {
    "mdf": lambda path, how, notes: formats.read_mdf(path, notes),
    "tdms": lambda path, how, notes: formats.read_tdms(path, notes, how.sheet),
    "mat": lambda path, how, notes: formats.read_mat(path, notes, how.sheet),
    "parquet": lambda path, how, notes: [formats.read_arrow(path, pa.parquet.read_table(path))],
    "arrow": _arrow,
    "excel": _excel,
}


def _text(path: Path, text: bytes, how: How, notes: list[str]) -> list[Sheet]:
    """Read a text as sheets: a table of rows, or a layout of its own."""
    if b"\0" in text:
        raise InputError(f"{path}: holds zero bytes; text was expected (was the file cut off?)")
    if (special := layouts.special(path, text)) is not None:
        return [p for s in special for p in layouts.pivoted(s) or [s]]
    dialect = find_dialect(path, text[: 4 * HEAD].decode("utf-8", errors="ignore"))
    how.trace.append(f"read as: {_described(dialect)}")
    notes += dialect.notes

    def closely() -> list[Sheet]:
        """Read the rows cell by cell."""
        return _stated(_slow(path, text, dialect), dialect)

    sheet = _fast(path, text, dialect, how)
    if sheet is None:
        return closely()
    stated = _stated(sheet, dialect)
    stated[0].again = closely  # reading cell by cell gives an error with the line
    return stated


def _described(dialect: Dialect) -> str:
    shown = {"\t": "tab", " ": "blanks", "  ": "blanks"}.get(dialect.separator, f"'{dialect.separator}'")
    return f"text, separator {shown}, data from line {dialect.first}"


def _stated(sheet: Sheet, dialect: Dialect) -> list[Sheet]:
    """Return a sheet with the units and the interval of its dialect; of a long table one a signal."""
    sheet.units = dict(dialect.units)
    sheet.columns = {n: c for n, c in sheet.columns.items() if not FACT.match(n)}
    sheet.decimal = dialect.decimal or ("," if dialect.separator == ";" else None)
    if (stated := stated_step(dialect.facts)) is not None:
        sheet.step_s, sheet.offset_s = stated
    return layouts.pivoted(sheet) or [sheet]


def _fast(path: Path, text: bytes, dialect: Dialect, how: How) -> Sheet | None:
    """Read by Arrow: plain numbers as floats, other columns as texts; None where that cannot be right."""
    decimal = how.decimal or dialect.decimal
    if decimal is None or dialect.separator in (" ", "  ") or "" in dialect.names:
        return None
    body = _body(text, dialect)
    if b"\n#" in body or b"\n%" in body or body[:1] in b"#%":
        body = b"\n".join(x for x in body.splitlines() if not is_comment(x.decode("utf-8")))
    names = list(dialect.names)
    try:
        arrow = pa.csv.read_csv(
            pa.BufferReader(body),
            pa.csv.ReadOptions(column_names=names),
            pa.csv.ParseOptions(delimiter=dialect.separator, ignore_empty_lines=True),
            pa.csv.ConvertOptions(
                column_types={n: pa.float64() if n in dialect.numeric else pa.string() for n in names},
                null_values=["", "NaN", "nan", "NAN", "NA", "null"],
                strings_can_be_null=False,
                decimal_point=decimal,
            ),
        )
    except pa.ArrowInvalid:
        return None
    if len(arrow) * len(names) > files.MAX_CELLS:
        raise InputError(
            f"{path}: {len(arrow)} rows; at most {files.MAX_CELLS} cells are read at once: cut it"
        )
    columns = {n: _plain_column(arrow[n]) for n in names}
    return Sheet(columns, lambda row: f"{path}:{_line(text, dialect, row)}")


def _plain_column(column: pa.ChunkedArray) -> Cells:
    if pa.types.is_floating(column.type):
        return files.to_numpy(column)
    return column.combine_chunks()


def _body(text: bytes, dialect: Dialect) -> bytes:
    position = 0
    for _ in range(dialect.first - 1):
        position = text.find(b"\n", position) + 1
        if position == 0:
            return b""
    body = text[position:]
    return body if position < len(text) else b""


def _line(text: bytes, dialect: Dialect, row: int) -> int:
    """Return the line of data row `row`."""
    numbers = (n for n, _ in lines(text.decode("utf-8")) if n >= dialect.first)
    return next((n for i, n in enumerate(numbers) if i == row), dialect.first + row)


def _slow(path: Path, text: bytes, dialect: Dialect) -> Sheet:
    """Read row by row: repeated headers and a cut last line are left out with a note. Raises InputError."""
    width = len(dialect.names)
    headers = (list(dialect.header), [c for c in dialect.header if c])
    rows: list[tuple[int, list[str]]] = []
    odd: list[tuple[int, list[str]]] = []
    again: list[int] = []
    notes: list[str] = []
    for line, content in lines(text.decode("utf-8")):
        cells = cells_of(content, dialect.separator) if line >= dialect.first else []
        cells = cells[:-1] if len(cells) == width + 1 and not cells[-1] else cells
        if cells and (cells in headers or (again and again[-1] == line - 1 and not _any_value(cells))):
            again.append(line)
        elif any(cells):
            (rows if len(cells) == width else odd).append((line, cells))
    while len(rows) > 1 and _is_footer(rows[-1][1], rows[0][1]):
        odd.append(rows.pop())
    if not rows:
        raise InputError(f"{path}: no rows; at least one sample was expected")
    if odd and min(odd)[0] < rows[-1][0]:
        line, cells = min(odd)
        raise InputError(f"{path}:{line}: {len(cells)} cells; {width} as in the header were expected")
    if odd:
        notes.append(
            f"line{'s' if len(odd) > 1 else ''} {', '.join(str(n) for n, _ in odd[:3])} at the end left out: "
            f"{len(odd[0][1])} cells of {width}, or words only (was the file cut off?)"
        )
    if again:
        notes.append(f"the header stands again in line {', '.join(map(str, again[:5]))}; left out")
    numbers = [n for n, _ in rows]
    columns = {n: pa.array([r[i] for _, r in rows], pa.string()) for i, n in enumerate(dialect.names)}
    return Sheet(dict(columns), lambda row: f"{path}:{numbers[min(row, len(numbers) - 1)]}", notes=notes)


def _is_footer(row: Sequence[str], first: Sequence[str]) -> bool:
    """Return whether a row holds words only, or begins with one where the first row has a number or time."""
    if _any_value(first) and not _any_value(row):
        return any(not cells.is_missing(c) for c in row)
    return _any_value(first[:1]) and not _any_value(row[:1]) and not cells.is_missing(row[0])


def _any_value(row: Sequence[str]) -> bool:
    """Return whether a cell is a number or a time."""
    return any(cells.is_number(c) or clock.is_time(c) for c in row)


# ------------------------------------------------------------------------------------------- cells, clock,
# table
def _table(path: Path, sheets: Sequence[Sheet], how: How, notes: Sequence[str]) -> Table:
    """Return the table of a file's sheets, each timed by its own clock."""
    try:
        return _merged(path, sheets, how, notes)
    except InputError:
        if not sheets or sheets[0].again is None:
            raise
        return _merged(path, sheets[0].again(), how, notes)


def _merged(path: Path, sheets: Sequence[Sheet], how: How, notes: Sequence[str]) -> Table:
    parts: list[Table] = []
    later: list[str] = []
    for sheet in sheets:
        try:
            values = _valued(path, sheet, how)
        except CellError as e:
            raise InputError(f"{sheet.place(e.row)}: {e.reason}") from None
        parts += _timed(path, values, how)
        later += values.notes
    if not parts:
        raise InputError(f"{path}: no channels with a time; at least one was expected")
    table = parts[0] if len(parts) == 1 else _united(path, parts)
    if not table.columns:
        text = ", ".join(n for s in sheets for n in s.columns if not isinstance(s.columns[n], np.ndarray))
        raise InputError(f"{path}: no column of numbers beside the time; columns of text: {text or 'none'}")
    if not len(table):
        raise InputError(f"{path}: no rows; at least one sample was expected")
    earliest: dict[str, str] = {}  # the earliest of notes that differ only in a clock's start
    for note in (n for p in parts for n in p.notes):
        earliest[_SINCE.sub("", note)] = min(note, earliest.get(_SINCE.sub("", note), note))
    every = tuple(dict.fromkeys([*notes, *later, *earliest.values()]))
    how.trace.extend(f"note: {n}" for n in every)
    return replace(table, notes=every)


def _valued(path: Path, sheet: Sheet, how: How) -> Sheet:
    """Return a sheet whose columns are numbers, times, or texts that are neither. Raises CellError."""
    texts = {n: c for n, c in sheet.columns.items() if not isinstance(c, np.ndarray)}
    decimal = how.decimal or _decimal(texts.values(), sheet)
    valued = replace(sheet, columns={}, units=dict(sheet.units), notes=list(sheet.notes))
    left = []
    for name, column in sheet.columns.items():
        if isinstance(column, np.ndarray):
            valued.columns[name] = _without(column, how.missing)
            continue
        try:
            values = _of_texts(name.partition("\0")[0], column, decimal, how.missing, valued.notes)
        except CellError as e:
            raise CellError(e.row, f"column '{name.partition(chr(0))[0]}': {e.reason}") from None
        if isinstance(values, cells.Numbers):
            valued.columns[name] = _without(values.values, how.missing)
            valued.notes += values.notes
            stated = valued.units.get(name)
            if values.unit and stated and stated != values.unit:
                raise CellError(
                    0,
                    f"column '{name}': its header says {stated}, its cells {values.unit}; one unit was expected",
                )
            if values.unit:
                valued.units[name] = values.unit
        elif values is not None:
            valued.columns[name] = values
        else:
            valued.left[name] = next((w for w in column.to_pylist() if w and w.strip()), "")
            left.append(name.partition("\0")[0].strip() or f"column {list(sheet.columns).index(name) + 1}")
    if left:
        valued.notes.append(f"columns of text left out: {', '.join(left)}")
    return valued


def _without(values: np.ndarray, missing: Sequence[str]) -> np.ndarray:
    """Return numbers without those that stand for "no value"."""
    for word in missing:
        try:
            number = float(word.replace(",", "."))
        except ValueError:
            continue
        if values.dtype.kind == "f":
            values = np.where(values == number, np.nan, values)
    return values


def _of_texts(
    name: str, column: pa.Array, decimal: str | None, missing: Sequence[str], notes: list[str]
) -> cells.Numbers | pa.Array | None:
    tidy, empty, _ = cells.words(column, missing)
    filled = tidy.filter(pc.invert(empty))
    if not len(filled):
        return cells.numbers(name, column, decimal, missing)
    if pc.all(pc.match_substring_regex(filled, r"^\d{15,20}$")).as_py():
        return pc.if_else(empty, "", tidy)
    right = clock.times(filled)
    share = float(np.mean(right))
    if share == 1.0:
        return pc.if_else(empty, "", tidy)
    if share >= 0.5 and not all(cells.is_number(t) for t in filled.filter(pa.array(~right)).to_pylist()[:1]):  # noqa: PLR2004
        row = int(np.flatnonzero(~empty.to_numpy(zero_copy_only=False))[int(np.argmin(right))])
        raise CellError(
            row,
            f"'{column[row].as_py()[:40]}' is no date or time; one such as 2026-03-14T09:26:53.5 was expected",
        )
    return cells.numbers(name, column, decimal, missing)


def _decimal(texts: Iterable[Any], sheet: Sheet) -> str | None:
    """Return the decimal sign that all cells show; else that of the file's first lines."""
    shown: set[str] = set()
    for column in texts:
        filled = column.filter(pc.invert(cells.words(column)[1]))
        if len(filled) and cells.differs(filled) and len(signs := cells.decimal_signs(filled)) == 1:
            shown |= signs
    if len(shown) > 1:
        return None
    if shown == {"."} and sheet.decimal == ",":
        return "."
    return next(iter(shown), sheet.decimal)


def _timed(path: Path, sheet: Sheet, how: How) -> list[Table]:
    """Return the tables of a sheet: one for each of its clocks, with the columns that hold numbers."""
    if not any(len(c) for c in sheet.columns.values()):
        raise InputError(f"{path}: no rows; at least one sample was expected")
    tables: list[Table] = []
    several = _clocks(path, sheet, how)
    for timer, names in several:
        _refuse_lost(sheet, timer)
        t = np.full(len(sheet), np.nan)
        t[: len(timer.seconds.t)] = timer.seconds.t
        values: dict[str, np.ndarray] = {}
        notes = [_clock_note(timer, how)]
        for name in names:
            column = sheet.columns[name]
            plain = name.partition("\0")[0].strip()
            if not isinstance(column, np.ndarray) or column.dtype.kind != "f":
                notes.append(f"another time left out: {plain}")
                continue
            if name.strip() != plain or not plain:
                _refuse_name(path, sheet, name, plain, column)
                if not plain:
                    continue
            values[plain] = column
        t, values, place = _rows(path, sheet, t, values, len(several) > 1, how, notes)
        for name, column in values.items():
            if np.isinf(column).any():
                raise InputError(
                    f"{place(int(np.isinf(column).argmax()))}: column '{name}': an infinite value; a finite number was "
                    "expected (leave the cell empty where a sample is missing)"
                )
        units = {n: u for n, u in sheet.units.items() if n in values}
        start = timer.seconds.start or sheet.start
        if timer.seconds.start and len(t) and t[0] != 0:
            start, t = _moved(timer.seconds.start, float(t[0])), t - t[0]
        meta = sheet.meta | ({"start": start} if start else {})
        tables.append(
            Table(path.stem, str(path), t, values, meta, units, tuple(filter(None, notes)), recorded=True)
        )
        _trace(how, timer, tables[-1])
    return tables


def _refuse_lost(sheet: Sheet, counter: Clock) -> None:
    """Refuse a counter, or a number of no unit, as the clock beside times that cannot be read."""
    sure = not counter.counter and (counter.seconds.kind != "bare" or any(map(_plain_time, counter.columns)))
    for name, word in () if sure or not counter.why else sheet.left.items():
        if axis.named(name) > 0 and any(c.isdigit() for c in word):
            what = "counter" if counter.counter else "column"
            raise InputError(
                f"{sheet.place(0)}: column '{name}': '{word.strip()}' is no time in a form that is known, and the only other "
                f"clock is the {what} {counter.where}; name that with --time, or write the times in seconds"
            )


def _plain_time(name: str) -> bool:
    """Return whether a name is a time and nothing else, such as `t`, `Time` or `Zeit`."""
    return axis.named(name) > 0 and len(axis.tokens(name)) == 1


def _moved(start: str, seconds: float) -> str:
    """Return a date some seconds later."""
    later = np.datetime64(start.rstrip("Z"), "ms") + np.timedelta64(round(seconds * 1e3), "ms")
    return f"{later}Z" if start.endswith("Z") else str(later)


def _refuse_name(path: Path, sheet: Sheet, name: str, plain: str, column: np.ndarray) -> None:
    if not np.isfinite(column).any() or name == " ":
        return
    if not plain:
        position = list(sheet.columns).index(name)
        raise InputError(f"{path}: column {position + 1} of {len(sheet.columns)} has no name in the header")
    raise InputError(f"{sheet.place(0)}: the column '{plain}' stands twice in the header; rename one")


def _clock_note(timer: Clock, how: How) -> str:
    plain = timer.columns == ("t",) or timer.columns == ("t_s",)
    if how.time is not None or not timer.why or (plain and timer.seconds.kind in ("unit", "bare")):
        return "" if timer.seconds.kind in ("unit", "bare") and not how.time else timer.seconds.note
    return timer.note + " (another: --time COLUMN)"


def _trace(how: How, timer: Clock, table: Table) -> None:
    said = "; ".join(filter(None, (timer.why, timer.seconds.note)))
    how.trace.append(f"time: {timer.where}: {said}")
    how.trace.extend(f"column: {n} [{table.units.get(n, 'no unit stated')}]" for n in table.columns)


def _clocks(path: Path, sheet: Sheet, how: How) -> list[tuple[Clock, list[str]]]:
    """Return the clocks of a sheet with the columns of each. Raises InputError with file and line."""
    names = list(sheet.columns)
    if how.time is None and sheet.clock is not None:
        return [(Clock(("time of the channel",), sheet.clock, 0, ""), names)]
    if how.time is not None:
        plain = split_unit(how.time)[0]
        chosen = next((n for n in (how.time, plain) if n in names), None)
        if chosen is None:
            named = [n for n in names if n.strip() and "\0" not in n]
            raise InputError(
                f"{path}: no column '{how.time}'{suggest(how.time, named)}; the columns are {', '.join(named)}"
            )
        try:
            seconds = axis.read(chosen, sheet.columns[chosen], sheet.units.get(chosen))
        except ClockError as e:
            raise InputError(f"{sheet.place(e.row)}: column '{chosen}': {e.reason}") from None
        return [(Clock((chosen,), seconds, 0, ""), [n for n in names if n != chosen])]
    try:
        return axis.clocks(sheet)
    except ClockError as e:
        raise InputError(f"{sheet.place(e.row)}: {e.reason}") from None
    except LookupError as e:
        shown = ", ".join(n for n in names if n.strip() and "\0" not in n)
        raise InputError(
            f"{path}: no column 't' (time in seconds) and no other that is a time for sure ({e}); the columns are {shown}; "
            "name it with --time COLUMN"
        ) from None


def _rows(
    path: Path,
    sheet: Sheet,
    t: np.ndarray,
    values: dict[str, np.ndarray],
    several: bool,
    how: How,
    notes: list[str],
) -> tuple[np.ndarray, dict[str, np.ndarray], Any]:
    """Return times and values in the order of time. Raises InputError for missing, equal or earlier times."""
    rows = np.arange(len(t))
    missing = ~np.isfinite(t)
    if missing.any():
        filled = np.any([np.isfinite(v) for v in values.values()], axis=0) if values else missing
        if (missing & filled).any():
            row = int((missing & filled).argmax())
            raise InputError(
                f"{sheet.place(row)}: the time is missing; a finite number or a date was expected"
            )
        rows = rows[~missing]
    if len(rows) > 1 and (np.diff(t[rows]) < 0).all():
        rows = rows[::-1]
        notes.append("the rows run backwards in time; turned round")
    rows = _one_run(sheet, t, rows, how, notes)
    t, values = t[rows], {n: v[rows] for n, v in values.items()}
    if (np.diff(t) == 0).any():
        t, values = _distinct(sheet, t, values, rows, how, notes)
    if several is False and len(t) and sheet.clock is None and how.run not in (None, 1):
        t = t - t[0]
    return t, values, lambda row: sheet.place(int(rows[min(row, len(rows) - 1)]))


def _one_run(sheet: Sheet, t: np.ndarray, rows: np.ndarray, how: How, notes: list[str]) -> np.ndarray:
    back = np.flatnonzero(np.diff(t[rows]) < 0)
    if not len(back) and how.run in (None, 1):
        return rows
    parts = np.split(rows, back + 1)
    if how.run is not None:
        if not 1 <= how.run <= len(parts):
            raise InputError(f"{sheet.place(0)}: --run {how.run}: the file holds {len(parts)} run(s)")
        if len(parts) > 1:
            notes.append(f"run {how.run} of {len(parts)} read")
        return np.asarray(parts[how.run - 1])
    row, before = int(rows[back[0] + 1]), int(rows[back[0]])
    jump = float(t[before] - t[row])
    usual = float(np.median(np.abs(np.diff(t[rows]))))
    hour = " by an hour (daylight saving?)" if abs(jump + usual - HOUR_S) <= max(1.5 * usual, 1.0) else ""
    raise InputError(
        f"{sheet.place(row)}: the time {t[row]:.17g} runs backwards from {t[before]:.17g}{hour}: {len(parts)} runs in one "
        f"file? --run 1 reads the first, up to --run {len(parts)}"
    )


def _distinct(
    sheet: Sheet, t: np.ndarray, values: dict[str, np.ndarray], rows: np.ndarray, how: How, notes: list[str]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Spread rows with equal times over the interval, or merge them, as the option `equal_times` says."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(t) != 0) + 1])
    counts = np.diff(np.concatenate([starts, [len(t)]]))
    if how.equal_times is None:
        row = int(np.flatnonzero(np.diff(t) == 0)[0]) + 1
        raise InputError(
            f"{sheet.place(int(rows[row]))}: the time {t[row]:.17g} stands twice; strictly increasing seconds were expected "
            "(--equal-times spread: rows of one time at even steps to the next; mean, first or last: one row of them)"
        )
    notes.append(f"{int((counts - 1).sum())} rows of equal times: {how.equal_times}")
    if how.equal_times == "spread":
        distinct = t[starts]
        steps = np.diff(distinct)
        usual = float(np.median(steps)) if len(steps) else 1.0
        gap = np.minimum(np.append(steps, usual), 2 * usual)
        # A last second that was cut goes on at the pace of the others.
        pace = np.append(counts[:-1], max(counts[-1], int(np.median(counts))))
        within = np.arange(len(t)) - np.repeat(starts, counts)
        return np.repeat(distinct, counts) + within * np.repeat(gap / pace, counts), values
    if how.equal_times == "mean":
        found = {}
        for n, v in values.items():
            seen = np.add.reduceat(np.isfinite(v).astype(float), starts)
            with np.errstate(invalid="ignore", divide="ignore"):
                found[n] = np.add.reduceat(np.nan_to_num(v), starts) / seen
        return t[starts], found
    pick = starts if how.equal_times == "first" else starts + counts - 1
    return t[pick], {n: v[pick] for n, v in values.items()}


def _united(path: Path, parts: Sequence[Table]) -> Table:
    """Merge tables of different clocks: rows at the union of all times, empty where a column has none."""
    starts = [p.meta.get("start") for p in parts]
    offsets = np.zeros(len(parts))
    first = min((s for s in starts if s), default=None)
    if all(starts):
        since = [np.datetime64(str(s).removesuffix("Z"), "us") for s in starts]
        offsets = np.array([float((s - min(since)) / np.timedelta64(1, "us")) / 1e6 for s in since])
    times = [p.t + o for p, o in zip(parts, offsets, strict=True)]
    every = np.sort(np.concatenate(times))
    steps = [float(np.median(np.diff(t))) for t in times if len(t) > 1]
    near = 1e-6 * min(steps, default=1.0)
    grid = every[np.concatenate([[True], np.diff(every) > near])]
    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    for part, t in zip(parts, times, strict=True):
        rows = np.searchsorted(grid, t - near)
        for name, values in part.columns.items():
            if name in columns:
                raise InputError(f"{path}: the column '{name}' stands twice; rename one")
            columns[name] = np.full(len(grid), np.nan)
            columns[name][rows] = values
        units |= part.units
    meta = {"start": first} if first and all(starts) else {}
    return Table(path.stem, str(path), grid, columns, meta, units, recorded=True)


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
    names: dict[str, str] = {}
    for part in next(csv.reader(io.StringIO(text or "")), []):
        wanted, sign, name = (x.strip() for x in part.partition("="))
        if not (wanted and sign and name):
            raise InputError(f"--columns {part}: NAME=COLUMN was expected, such as heat=P_heater")
        if wanted in names:
            raise InputError(f"--columns: '{wanted}' stands twice; give it once")
        names[wanted] = name
    return names
