"""Read our own recordings: rows for a replay, a summary, a recovered copy, an export."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from thermoctl.files.safe_file import whole_file
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import READERS, picked, read_table, to_arrow, write_arrow
from thermoctl.recording.foreign import formats
from thermoctl.recording.foreign.logger import read_recording
from thermoctl.recording.stream import END, open_stream, texts
from thermoctl.recording.table import Table
from thermoctl.rig.signals import of_recording


@dataclass(frozen=True)
class Info:
    """Summary of a recording. `whole`: it was closed; else its writer was killed or is still writing."""

    path: str
    rows: int
    begins_s: float  # t of the first and last row; NaN without rows
    ends_s: float
    begins_wall_s: float  # NaN where the wall clock is not recorded
    ends_wall_s: float
    bytes: int
    readable_bytes: int
    whole: bool
    columns: tuple[tuple[str, str, str], ...]  # name, unit, meaning
    meta: dict[str, str]


def info(path: str | Path) -> Info:
    """Summarise a recording, decoding its times only. Raises InputError."""
    path = Path(path)
    fields = open_stream(path).schema
    clock = next((n for n in ("t", "t_s") if n in fields.names), None)
    if clock is None:
        raise InputError(f"{path}: no column 't' or 't_s'; it is no recording")
    stream = open_stream(path, [clock, "wall_s"])
    rows, begins, ends, wall, wall_end = 0, np.nan, np.nan, np.nan, np.nan
    for batch in stream:
        if batch.num_rows:
            t = batch.column(clock)
            if not rows:
                begins = t[0].as_py()
                wall = batch.column("wall_s")[0].as_py() if "wall_s" in batch.schema.names else np.nan
            if "wall_s" in batch.schema.names:
                wall_end = batch.column("wall_s")[-1].as_py()
            rows, ends = rows + batch.num_rows, t[-1].as_py()
    said = {f.name: texts(f.metadata) for f in fields}
    columns = tuple((n, m.get("unit", ""), m.get("meaning", "")) for n, m in said.items())
    size, good, meta = path.stat().st_size, stream.good_bytes, texts(fields.metadata)
    return Info(str(path), rows, begins, ends, wall, wall_end, size, good, stream.whole, columns, meta)


def read_rows(path: str | Path) -> tuple[np.ndarray, str]:
    """Return (ticks (n, signals) in the order of its rig's signals, text `law` of the metadata) for a replay.

    Raises InputError when a signal is missing (a tier, or a recording of another version)."""
    table = read_table(path)
    if "10 Hz" in table.meta.get("tier", ""):
        raise InputError(f"{path}: no full-rate recording but its 10 Hz tier; a replay needs every tick")
    row = of_recording(table.meta)
    missing = [n for n in row.names if n not in table.columns]
    if missing:
        raise InputError(
            f"{path}: no full-rate recording of this version: {', '.join(missing[:3])} "
            f"{'is' if len(missing) == 1 else 'are'} missing; replay it with the version that recorded it"
        )
    return np.column_stack([table.columns[n] for n in row.names]), table.meta.get("law", "")


def recover(path: str | Path, out: str | Path) -> Info:
    """Copy the complete batches of a truncated recording to `out` and close it properly.

    Any Arrow reader opens the copy; its summary is returned. Raises InputError when nothing can be read or
    `out` exists."""
    path, out = Path(path), Path(out)
    stream = open_stream(path)
    for _ in stream:
        pass
    if out.exists():
        raise InputError(f"{out}: exists already; name another file")
    with whole_file(out) as temporary:
        with open(path, "rb") as source, open(temporary, "wb") as target:
            left = stream.good_bytes
            while left:
                piece = source.read(min(left, 1 << 22))
                target.write(piece)
                left -= len(piece)
            target.write(END)
        shutil.copystat(path, temporary)
    return info(out)


def export(
    path: str | Path,
    out: str | Path,
    columns: Iterable[str] | None = None,
    begin_s: float = -np.inf,
    end_s: float = np.inf,
) -> int:
    """Write a recording as .parquet, .csv, .mf4 or .mcap; returns the rows written.

    columns: only these (beside the time); begin_s, end_s: the part begin_s <= t < end_s. A recording of ours
    goes to Parquet and CSV batch by batch, however long. Raises InputError."""
    path, out = Path(path), Path(out)
    kind = out.suffix.lower()
    if kind not in (".parquet", ".csv", ".mf4", ".mcap"):
        raise InputError(f"{out}: an export is .parquet, .csv, .mf4 or .mcap, not '{out.suffix}'")
    if begin_s >= end_s:
        raise InputError(f"{out}: --from {begin_s:g} s is not before --to {end_s:g} s")
    want = None if columns is None else list(columns)
    with whole_file(out) as temporary:
        if kind in (".mf4", ".mcap") or path.suffix != ".arrows":
            return _export_table(path, temporary, kind, want, begin_s, end_s)
        return _export_stream(path, temporary, kind, want, begin_s, end_s)


def _export_table(
    path: Path, out: str, kind: str, want: list[str] | None, begin_s: float, end_s: float
) -> int:
    table = _table(path, want)
    a, b = np.searchsorted(table.t, [begin_s, end_s])
    if a == b:
        raise InputError(
            f"{path}: no rows from {begin_s:g} to {end_s:g} s; it holds {table.t[0]:g} to {table.t[-1]:g} s"
        )
    table = dataclasses.replace(table, t=table.t[a:b], columns={n: v[a:b] for n, v in table.columns.items()})
    if kind == ".mcap":
        formats.write_mcap(out, table)
    elif kind == ".mf4":
        with TemporaryDirectory() as folder:  # asammdf requires its own suffix
            formats.write_mdf(f"{folder}/export.mf4", table)
            shutil.copyfile(f"{folder}/export.mf4", out)
    else:
        write_arrow(out, kind, to_arrow(table))
    return len(table)


def _table(path: Path, want: list[str] | None) -> Table:
    if path.suffix.lower() in READERS:
        return read_table(path, want)
    table = read_recording(path)
    names = picked(path, list(table.columns), want)
    return dataclasses.replace(table, columns={n: table.columns[n] for n in names})


def _export_stream(
    path: Path, out: str, kind: str, want: list[str] | None, begin_s: float, end_s: float
) -> int:
    if want is not None:  # an unknown name raises an error that lists the columns
        want = picked(path, open_stream(path).schema.names, want)
    stream = open_stream(path, want)
    clock = "t" if "t" in stream.schema.names else "t_s"
    rows = 0
    with ExitStack() as stack:
        f = stack.enter_context(open(out, "wb"))
        writer = stack.enter_context(
            pa.csv.CSVWriter(f, stream.schema)
            if kind == ".csv"
            else pa.parquet.ParquetWriter(f, stream.schema, compression="zstd", write_page_checksum=True)
        )
        for piece in _pieces(stream, clock, begin_s, end_s):
            writer.write_table(piece)
            rows += piece.num_rows
    if not rows:
        raise InputError(f"{path}: no rows from {begin_s:g} to {end_s:g} s")
    return rows


def _pieces(
    batches: Iterable[pa.RecordBatch], clock: str, begin_s: float, end_s: float
) -> Iterator[pa.Table]:
    """Yield tables of many batches (a row group each), cut to the given times, NaN as null."""
    held: list[pa.RecordBatch] = []
    rows = 0
    for batch in batches:
        t = batch.column(clock).to_numpy()
        a, b = np.searchsorted(t, [begin_s, end_s])
        if a < b:
            held.append(
                pa.RecordBatch.from_arrays(
                    [pa.array(c.to_numpy()[a:b], from_pandas=True) for c in batch.columns],
                    schema=batch.schema,
                )
            )
            rows += b - a
        if rows >= 100_000:
            yield pa.Table.from_batches(held)
            held, rows = [], 0
    if held:
        yield pa.Table.from_batches(held)
