"""Recordings of a test.

Rows as the loop records them, a table of them, and the signals of a calibration at 1 s. The rows of a test
that runs are on the disk, too: kill -9 or a power cut costs at most the last KEEP_S of them."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoctl.control import faults
from thermoctl.files.safe_file import WriteError, reason
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.table import Table
from thermoctl.recording.writer import StreamFile, schema
from thermoctl.rig.signals import AT, Row, fault_word

EVERY_RIG = ("power_w", "air_c", "output_reference_um", "position_raw_um", "setpoint_um")
"""Signals of a calibration, besides the points' temperatures."""
KEEP_S = 1.0
"""Wall time between two writes of the rows of a running test.

A block of rows, 100 s of a simulated rig, is written at once."""
LARGEST = 1e9  # a larger reading is no um, degC or W: a fit would take it for everything
SETTLED = 5  # first samples, whose mean error is the origin of the thermal growth


@dataclass(frozen=True)
class Recorded:
    """One test at 1 s: t (N,) s, power_w, air_c, setpoint_um.

    Temperatures (N, points) degC as read (NaN: no reading).

    error_um is the difference of the two encoders."""

    t: np.ndarray
    power_w: np.ndarray
    air_c: np.ndarray
    temperatures: np.ndarray
    error_um: np.ndarray
    setpoint_um: np.ndarray


def of_columns(t: np.ndarray, columns: Mapping[str, np.ndarray], points: Sequence[str]) -> Recorded:
    """Take the signals at 1 s as one test of a rig with these points.

    The position error is relative to its start."""
    temperatures = np.column_stack([columns[f"{p}_c"] for p in points])
    error = columns["output_reference_um"] - columns["position_raw_um"]
    error = error - np.nanmean(error[:SETTLED])
    return Recorded(t, columns["power_w"], columns["air_c"], temperatures, error, columns["setpoint_um"])


def read(path: str | Path, points: Sequence[str]) -> Recorded:
    """Read a recording of a rig with these points at 1 s; gaps in power and air are held.

    Raises InputError when a signal is missing, has no reading, or one that none of its kind can be."""
    table = read_table(path)
    names = (*EVERY_RIG, *(f"{p}_c" for p in points))
    for n in names:
        if n not in table.columns:
            raise InputError(
                f"{path}: column '{n}' is missing{suggest(n, table.columns)}; a calibration needs it"
            )
        largest = np.nanmax(np.abs(table.columns[n]), initial=-1.0)
        least = -1.0 if n == "output_reference_um" else 0.0  # the output may be measured in some tests only
        if not least <= largest < LARGEST:
            found = "no reading" if largest < 0.0 else f"{largest:g}"
            raise InputError(
                f"{path}: column '{n}': {found}; readings below {LARGEST:g} were expected: correct the channel's profile, or "
                "leave the cell empty"
            )
    since = table.t - table.t[0]
    t = np.arange(np.floor(since[-1]) + 1)
    k = np.clip(np.searchsorted(since, t + 1e-9, side="right") - 1, 0, None)
    columns = {n: table.columns[n][k] for n in names}
    for n in ("power_w", "air_c"):
        columns[n] = filled(columns[n][:, None])[:, 0]
    return of_columns(t, columns, points)


def filled(y: np.ndarray) -> np.ndarray:
    """Hold missing readings (N, m), for methods that need every sample."""
    out = y.copy()
    t = np.arange(len(y))
    for j in range(y.shape[1]):
        ok = np.isfinite(y[:, j])
        out[:, j] = y[np.maximum.accumulate(np.where(ok, t, t[ok][0])), j]
    return out


def rows_of(table: Table, layout: Row) -> np.ndarray:
    """Arrange a table as record rows (N, signals); NaN where a signal is missing."""
    missing = np.full(len(table), np.nan)
    return np.column_stack([table.t if n == "t_s" else table.columns.get(n, missing) for n in layout.names])


def as_table(rows: np.ndarray, path: str | Path, layout: Row) -> Table:
    """Arrange record rows as a table named after the file `path`."""
    columns = {n: rows[:, i] for n, i in layout.index.items() if n != "t_s"}
    return Table(Path(path).stem, str(path), rows[:, AT["t_s"]], columns)


def causes(row: np.ndarray) -> str:
    """Name the faults of a record row that trip, with their remedies.

    Without any fault, a user disarmed the rig."""
    tripping = [f for f in faults.decode(fault_word(row)) if f.severity != "warning"]
    return "; ".join(f"{f.name}: {f.meaning} -> {f.remedy}" for f in tripping) or "somebody disarmed it"


def stream_of(path: Path) -> Path:
    """Return the stream that holds the rows of a test until its file `path` is written."""
    return path.with_name(path.name + ".running.arrows")


def kept(
    blocks: Iterable[np.ndarray], path: Path, layout: Row, note: Callable[[], None]
) -> Iterator[np.ndarray]:
    """Yield the blocks of a test, and write them to its stream. note: saves the time that the test reached.

    A disk that refuses does not end the test; the rows are then in memory only, and a line reports it."""
    waiting: list[np.ndarray] = []
    stream: StreamFile | None = None
    written_s = time.monotonic()
    try:
        for block in blocks:
            waiting.append(block)
            if time.monotonic() - written_s >= KEEP_S:
                try:
                    note()
                    stream = stream or StreamFile(stream_of(path), schema(layout.signals, {}))
                    stream.write(np.vstack(waiting))
                    written_s, waiting = time.monotonic(), []
                except (OSError, WriteError) as e:
                    written_s = math.inf
                    why = e.why if isinstance(e, WriteError) else f"{stream_of(path)}: {reason(e)}"
                    print(f"thermoctl: {why}; the test goes on, its rows are in memory only", file=sys.stderr)
            yield block
    finally:
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()


def recover(path: Path) -> None:
    """Write the rows of a test that was killed to its file `path`. Raises InputError."""
    stream = stream_of(path)
    if stream.exists():
        try:
            rows: Table | None = read_table(stream)
        except InputError:  # killed before the first row
            rows = None
        if rows is not None:
            write_table(path, rows)
        stream.unlink()
