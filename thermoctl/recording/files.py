"""Read and write a `Table`; the suffix of the file selects the format.

A table has a time column `t` in seconds, strictly increasing, and any number of other columns. Every cell is
a number or missing (NaN). Any other file is refused with the row; nothing is repaired silently.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from thermoctl.files.safe_file import whole_file
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.stream import CRC, checksums, open_stream, texts
from thermoctl.recording.table import Table, exact

MAX_CELLS = 250_000_000  # 2 GB of float64; a longer recording is read a few columns or hours at a time
MAX_CSV_BYTES = 4_000_000_000
_MISSING = ["", "NaN", "nan", "NAN"]
COMMENT = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)


@dataclass(frozen=True)
class Raw:
    """The result of a reader: columns by name, with t, and a function that names data row k (from 0)."""

    columns: dict[str, np.ndarray]
    meta: dict[str, str]
    place: Callable[[int], str]


def read_table(path: str | Path | Table, columns: Iterable[str] | None = None) -> Table:
    """Read a recording; the suffix selects the format (`FORMATS`), `columns` the columns beside the time.

    A table is returned as it is, so that a caller may have read it himself (`logger.read_recording`).
    The time column is `t`, in our own recordings `t_s`. Raises InputError with file and row (CSV: line) for:
    - text in a number column, or an infinite value
    - a time that is missing, equal to the one before, or earlier
    - a ragged row, a repeated column, no time column, no rows
    - a file that is too large, truncated, or not of its format"""
    if isinstance(path, Table):
        return path
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if path.is_dir():
        raise InputError(f"{path}: a folder; one recording file ({FORMATS}) was expected")
    if reader is None:
        raise InputError(f"{path}: the format '{path.suffix}' is not known; {FORMATS} are")
    want = None if columns is None else list(dict.fromkeys(columns))
    try:
        return checked(path, reader(path, want))
    except (OSError, pa.ArrowException, OverflowError) as e:  # a date of another era overflows
        raise unreadable(path, e) from None
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: not a whole {path.suffix[1:]} file: a name of a column is not text"
        ) from None


def unreadable(path: Path, e: Exception) -> InputError:
    """Return the error for a file that cannot be read. Arrow's own OSErrors have no number."""
    if isinstance(e, OSError) and e.errno is not None:
        return InputError(f"{path}: cannot be read: {e.strerror}")
    return InputError(f"{path}: not a whole {path.suffix[1:]} file: {str(e).splitlines()[0]}")


def write_table(path: str | Path, table: Table) -> None:
    """Write a table as .csv, .parquet or .arrow (IPC file); a missing sample becomes an empty cell.

    The file appears whole or not at all. Raises InputError for another suffix or when the place cannot be
    written."""
    kind = table_kind(Path(path))
    with whole_file(path) as temporary:
        write_arrow(temporary, kind, to_arrow(table))


def table_kind(path: Path) -> str:
    """Return the suffix of a table in small letters. Raises InputError for one that no table has."""
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet", ".arrow"):
        raise InputError(f"{path}: a table is written as .csv, .parquet or .arrow, not '{path.suffix}'")
    return kind


def write_arrow(path: str, kind: str, arrow: pa.Table) -> None:
    """Write a table of Arrow; `kind`: .csv, .parquet or .arrow."""
    with open(path, "wb") as f:
        if kind == ".csv":
            pa.csv.write_csv(arrow, f, pa.csv.WriteOptions(quoting_style="needed"))
        elif kind == ".parquet":
            pa.parquet.write_table(arrow, f, compression="zstd", write_page_checksum=True)
        else:
            options = pa.ipc.IpcWriteOptions(compression="zstd")
            with pa.ipc.new_file(f, arrow.schema, options=options) as writer:
                for batch in arrow.to_batches():
                    writer.write_batch(batch, custom_metadata={CRC: checksums(batch)})


def to_arrow(table: Table) -> pa.Table:
    """Return the table as Arrow: `t` first, float64, null for a missing sample; `meta`, units.

    A signal that its logger calls t becomes t_signal."""
    arrays = {"t": table.t} | {"t_signal" if n == "t" else n: v for n, v in table.columns.items()}
    arrow = pa.table(
        {k: pa.array(np.asarray(v, dtype=np.float64), from_pandas=True) for k, v in arrays.items()}
    )
    fields = [
        f.with_metadata({"unit": table.units[f.name]}) if f.name in table.units else f for f in arrow.schema
    ]
    return arrow.cast(pa.schema(fields, table.meta or None))


def checked(path: Path, raw: Raw) -> Table:
    """Return the table of a reader's result: finite, times increasing. Raises InputError with the place."""
    columns = dict(raw.columns)
    clock = _clock(columns)
    if clock is None:
        raise InputError(
            f"{path}: no column 't' (time in seconds); the columns are {', '.join(columns) or 'none'}"
        )
    t = columns[clock] if clock == "t_s" else columns.pop("t")
    if len(t) == 0:
        raise InputError(f"{path}: no rows; at least one sample was expected")
    for name, values in (("t", t), *columns.items()):
        bad = np.isinf(values) if name != "t" else ~np.isfinite(values)
        if bad.any():
            row = int(bad.argmax())
            what = "the time is missing" if np.isnan(values[row]) else "an infinite value"
            raise InputError(
                f"{raw.place(row)}: column '{name}': {what}; a finite number was expected"
                + ("" if name == "t" else " (leave the cell empty where a sample is missing)")
            )
    still = np.diff(t) <= 0
    if still.any():
        row = int(still.argmax()) + 1
        what = "stands twice" if t[row] == t[row - 1] else f"runs backwards from {exact(t[row - 1])}"
        raise InputError(
            f"{raw.place(row)}: the time {exact(t[row])} {what}; strictly increasing seconds were expected"
        )
    return Table(path.stem, str(path), t, columns, raw.meta, recorded=True)


def _clock(names: Iterable[str]) -> str | None:
    names = set(names)
    return "t" if "t" in names else "t_s" if "t_s" in names else None


def _limit(path: Path, rows: int, columns: int) -> None:
    if rows * columns > MAX_CELLS:
        raise InputError(
            f"{path}: {rows} rows x {columns} columns; at most {MAX_CELLS} cells are read at once: "
            "name fewer columns or cut the recording (thermoctl recordings export --from --to)"
        )


def picked(path: Path, names: list[str], want: list[str] | None) -> list[str]:
    """Return the time column and the requested columns."""
    if want is None:
        return names
    for name in want:
        if name not in names:
            raise InputError(
                f"{path}: no column '{name}'{suggest(name, names)}; the columns are {', '.join(names)}"
            )
    return [n for n in names if n in want or n == _clock(names)]


# ------------------------------------------------------------------------------------------------------- CSV
def _read_csv(path: Path, want: list[str] | None) -> Raw:
    if path.stat().st_size > MAX_CSV_BYTES:
        raise InputError(
            f"{path}: {path.stat().st_size} bytes; a CSV file of at most {MAX_CSV_BYTES} was expected "
            "(convert it to Parquet)"
        )
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    bare = COMMENT.sub(b"", data) if b"#" in data else data
    bare = bare.lstrip(b"\r\n")
    head, _, body = bare.partition(b"\n")
    names = _header(path, head)
    columns = None
    if body.strip():
        chosen = picked(path, names, want)
        _limit(path, body.count(b"\n"), len(chosen))
        try:
            arrow = pa.csv.read_csv(
                pa.BufferReader(body),
                pa.csv.ReadOptions(column_names=names),
                convert_options=pa.csv.ConvertOptions(
                    column_types=dict.fromkeys(names, pa.float64()), null_values=_MISSING, check_utf8=False
                ),
            )
            columns = {n: to_numpy(arrow[n]) for n in chosen}
        except pa.ArrowInvalid:
            # go on below: for the exact place of an error, and for text that only Python parses
            columns = None
    if columns is None:
        columns = _slow_csv(path, data, names)
        columns = {n: columns[n] for n in picked(path, names, want)}
    return Raw(columns, {}, lambda row: f"{path}:{_csv_line(data, row)}")


def _header(path: Path, head: bytes) -> list[str]:
    if not head.strip():
        raise InputError(f"{path}: the file is empty; a header line with the column names was expected")
    try:
        names = [n.strip() for n in next(csv.reader([head.decode("utf-8")], strict=True))]
    except (UnicodeDecodeError, csv.Error):
        raise InputError(
            f"{path}: the header line is not text; a CSV file with the column names first was expected"
        ) from None
    for i, name in enumerate(names):
        if not name:
            raise InputError(f"{path}: column {i + 1} of {len(names)} has no name in the header")
        if name in names[:i]:
            raise InputError(f"{path}: the column '{name}' stands twice in the header")
    if len(names) == 1 and _clock(names) is None and re.search(r"[;\t|]", names[0]):
        raise InputError(
            f"{path}: the header has no comma ('{names[0][:60]}'); comma-separated columns were expected"
        )
    return names


def _csv_rows(data: bytes) -> Iterable[tuple[int, list[str]]]:
    """Yield (line counted from 1, cells) of the header and each row, without comments and empty lines."""
    lines = io.StringIO(data.decode("utf-8", errors="replace"), newline="")
    number = 0

    def counted() -> Iterable[str]:
        """Yield the lines of header and rows; `number` then holds the number of the line, from 1."""
        nonlocal number
        for line in lines:
            number += 1
            if line.strip("\r\n") and not line.lstrip(" \t").startswith("#"):
                yield line

    for cells in csv.reader(counted()):
        yield number, cells


def _csv_line(data: bytes, row: int) -> int:
    for i, (line, _) in enumerate(_csv_rows(data)):
        if i == row + 1:
            return line
    return row + 2


def _slow_csv(path: Path, data: bytes, names: list[str]) -> dict[str, np.ndarray]:
    """Read cell by cell, for the exact place of an error."""
    values: list[list[float]] = []
    for i, (line, cells) in enumerate(_csv_rows(data)):
        if i == 0:
            continue
        if len(cells) != len(names):
            raise InputError(
                f"{path}:{line}: {len(cells)} cells; {len(names)} as in the header were expected"
            )
        numbers = []
        for name, cell in zip(names, cells, strict=True):
            try:
                if "_" in cell:
                    raise ValueError
                numbers.append(float(cell) if cell.strip() else np.nan)
            except ValueError:
                raise InputError(
                    f"{path}:{line}: column '{name}': '{cell[:40]}' stands where a number belongs "
                    "(leave the cell empty where a sample is missing)"
                ) from None
        values.append(numbers)
    return dict(zip(names, np.array(values, dtype=np.float64).reshape(-1, len(names)).T.copy(), strict=True))


# -------------------------------------------------------------------------------------------- Parquet, Arrow
def to_numpy(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as float64, NaN for null.

    Pyarrow's own conversion loads pandas where that is installed, for a quarter of a second."""
    return np.concatenate([np.zeros(0), *map(_floats, column.cast(pa.float64()).chunks)])


def _floats(chunk: pa.DoubleArray) -> np.ndarray:
    if chunk.null_count == len(chunk):
        return np.full(len(chunk), np.nan)
    values = np.frombuffer(chunk.buffers()[1], np.float64, len(chunk), 8 * chunk.offset).copy()
    if chunk.null_count:
        values[np.from_dlpack(chunk.is_null().cast(pa.uint8())) == 1] = np.nan
    return values


def _from_arrow(path: Path, arrow: pa.Table, want: list[str] | None) -> Raw:
    names = arrow.column_names
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"{path}: the column '{name}' stands twice")
    columns = {}
    for name in picked(path, names, want):
        column, kind = arrow[name], arrow.schema.field(name).type
        if not (
            pa.types.is_integer(kind)
            or pa.types.is_floating(kind)
            or pa.types.is_boolean(kind)
            or pa.types.is_decimal(kind)
            or pa.types.is_null(kind)
        ):
            row, value = next(((i, v.as_py()) for i, v in enumerate(column) if v.is_valid), (0, None))
            raise InputError(
                f"{path}: row {row + 1}: column '{name}': {str(value)[:40]!r} ({kind}) stands where a "
                "number belongs" + (" (seconds)" if name == "t" else "")
            )
        columns[name] = to_numpy(column.cast(pa.float64(), safe=False))
    return Raw(columns, own_meta(arrow.schema), lambda row: f"{path}: row {row + 1}")


def own_meta(schema: pa.Schema) -> dict[str, str]:
    """Return a schema's metadata without those that pandas and Arrow add."""
    return {k: v for k, v in texts(schema.metadata).items() if k not in ("pandas", "ARROW:schema")}


def _read_parquet(path: Path, want: list[str] | None) -> Raw:
    with pa.parquet.ParquetFile(path, page_checksum_verification=True) as f:
        names = f.schema_arrow.names
        chosen = picked(path, names, want)
        _limit(path, f.metadata.num_rows, len(chosen))
        return _from_arrow(path, f.read(columns=chosen) if len(set(names)) == len(names) else f.read(), want)


def _read_arrow(path: Path, want: list[str] | None) -> Raw:
    return _from_arrow(path, arrow_of(path, want), want)


def arrow_of(path: Path, want: list[str] | None = None) -> pa.Table:
    """Return an IPC file, or an IPC stream up to where it was cut (a recorder that lost power leaves one)."""
    with pa.memory_map(str(path)) as source:
        if source.size() >= 6 and source.read(6) == b"ARROW1":
            with pa.ipc.open_file(source) as f:
                rows = sum(f.get_batch(i).num_rows for i in range(f.num_record_batches))
                _limit(path, rows, len(picked(path, f.schema.names, want)))
                return pa.Table.from_batches(_batches(path, f), f.schema)
    stream = open_stream(path, want and [*want, "t", "t_s"])
    batches, rows = [], 0
    for batch in stream:
        rows += batch.num_rows
        _limit(path, rows, batch.num_columns)
        batches.append(batch)
    return pa.Table.from_batches(batches, stream.schema)


def _batches(path: Path, f: pa.RecordBatchFileReader) -> Iterator[pa.RecordBatch]:
    """Yield a file's batches. Raises InputError for one whose own checksums do not fit; most have none."""
    for i in range(f.num_record_batches):
        batch, said = f.get_batch_with_custom_metadata(i)
        if said and CRC in said and said[CRC] != checksums(batch):
            raise InputError(f"{path}: not a whole file: its batch {i + 1} was changed (checksum)")
        yield batch


READERS: dict[str, Callable[[Path, list[str] | None], Raw]] = {
    ".csv": _read_csv,
    ".parquet": _read_parquet,
    ".arrow": _read_arrow,
    ".arrows": _read_arrow,
    ".feather": _read_arrow,
}
FORMATS = ", ".join(READERS)
