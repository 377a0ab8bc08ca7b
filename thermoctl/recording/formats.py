"""Recordings of other programs: MDF4, TDMS and Excel read, MDF4 and MCAP written.

The libraries (asammdf, npTDMS, openpyxl, mcap) are an extra, `pip install 'thermoctl[formats]'`. Channels
with different rates are merged by time, so most cells of a slow channel are empty.
"""

from __future__ import annotations

import csv
import io
import json
from datetime import UTC, date, datetime, time
from pathlib import Path

import numpy as np

from thermoctl.extras import load
from thermoctl.recording.table import Table
from thermoctl.rig.signals import units
from thermoctl.yamlfile import InputError


def _damaged(path: Path, kind: str, e: Exception) -> InputError:
    return InputError(
        f"{path}: not a whole {kind} file: {str(e).splitlines()[0] if str(e) else type(e).__name__}"
    )


def _united(path: Path, channels: list[tuple[str, np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    """Merge channels (name, times (n,), values (n,)) into columns over the union of all times."""
    if not channels:
        raise InputError(f"{path}: no channels with a time; at least one was expected")
    for name, t, values in channels:
        if values.dtype.kind not in "fiub" or values.ndim != 1:
            raise InputError(
                f"{path}: row 1: channel '{name}': {str(values[:1].tolist())[:40]} stands where a "
                "number belongs"
            )
        wrong = ~(np.diff(t) > 0)
        if wrong.any() or not np.isfinite(t).all():
            raise InputError(
                f"{path}: row {int(wrong.argmax()) + 2}: channel '{name}': the time does not increase; "
                "strictly increasing seconds were expected"
            )
    grid = channels[0][1]
    if any(not np.array_equal(t, grid) for _, t, _ in channels):
        grid = np.unique(np.concatenate([t for _, t, _ in channels]))
    columns = {"t": grid.astype(np.float64)}
    for name, t, values in channels:
        if name in columns:
            raise InputError(
                f"{path}: two channels are called '{name}'; export them under names of their own"
            )
        column = np.full(len(grid), np.nan)
        column[np.searchsorted(grid, t)] = values
        columns[name] = column
    return columns


def read_mdf(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of an ASAM MDF file by channel name, with `t`. Raises InputError."""
    asammdf = load("asammdf", path)
    path.stat()
    try:
        with asammdf.MDF(str(path)) as mdf:
            found = [(s.name, np.asarray(s.timestamps), np.asarray(s.samples)) for s in mdf.iter_channels()]
    except Exception as e:  # asammdf raises any error on damaged bytes
        raise _damaged(path, "MDF", e) from None
    return _united(path, [c for c in found if c[0] not in ("t", "time")])


def read_tdms(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a TDMS file by channel name, with `t`.

    Raises InputError.

    `t` comes from the waveform properties or from a channel `t` of the same group. A name that several groups
    use becomes group_channel."""
    nptdms = load("nptdms", path)
    path.stat()
    try:
        groups = [
            (g.name, {c.name: (np.asarray(c[:]), dict(c.properties)) for c in g.channels()})
            for g in nptdms.TdmsFile.read(str(path)).groups()
        ]
    except Exception as e:  # npTDMS likewise
        raise _damaged(path, "TDMS", e) from None
    names = [n for _, channels in groups for n in channels]
    found = []
    for group, channels in groups:
        clock = channels.get("t", channels.get("t_s"))
        for name, (values, properties) in channels.items():
            if name in ("t", "t_s"):
                continue
            step = properties.get("wf_increment")
            if clock is not None:
                t = clock[0]
            elif isinstance(step, int | float) and step > 0:
                t = float(properties.get("wf_start_offset", 0.0)) + step * np.arange(len(values))
            else:
                raise InputError(
                    f"{path}: channel '{group}/{name}' has no time: no waveform step (wf_increment) and "
                    "no channel 't' in its group"
                )
            if len(t) != len(values):
                raise InputError(
                    f"{path}: channel '{group}/{name}' has {len(values)} values and {len(t)} times"
                )
            found.append((name if names.count(name) == 1 else f"{group}_{name}", t, values))
    return _united(path, found)


def read_excel(path: Path) -> bytes:
    """Return the first sheet of an Excel file as comma-separated text, row for row. Raises InputError."""
    openpyxl = load("openpyxl", path)
    path.stat()
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        for row in book.worksheets[0].iter_rows(values_only=True):
            cells = [c.isoformat() if isinstance(c, date | time) else "" if c is None else c for c in row]
            writer.writerow(cells)
        book.close()
    except Exception as e:  # openpyxl likewise
        raise _damaged(path, "Excel", e) from None
    return out.getvalue().encode()


def write_mdf(path: str, table: Table) -> None:
    """Write MDF 4.10, one channel group, zipped; units of our signals."""
    asammdf, unit = load("asammdf", Path(path)), units(table.columns)
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append(
            [
                asammdf.Signal(samples=v, timestamps=table.t, name=n, unit=unit.get(n, ""))
                for n, v in table.columns.items()
            ],
            comment=f"thermoctl recording {table.name}",
        )
        if "wall_s" in table.columns:  # other programs then show the time of day
            mdf.start_time = datetime.fromtimestamp(table.columns["wall_s"][0] - table.t[0], UTC)
        mdf.save(path, overwrite=True, compression=2)


def write_mcap(path: str, table: Table) -> None:
    """Write MCAP with one JSON message a row on /thermoctl (Foxglove and PlotJuggler plot its fields).

    A missing sample is left out of its message. Log time is `wall_s` if it is recorded, else `t`.
    """
    writer_module = load("mcap.writer", Path(path))
    clock = table.columns.get("wall_s", table.t - min(table.t[0], 0.0))
    unit = {"t": "s"} | units(table.columns)
    names, values = ["t", *table.columns], np.column_stack([table.t, *table.columns.values()])
    with open(path, "wb") as f:
        writer = writer_module.Writer(f)
        writer.start(profile="", library="thermoctl")
        schema = writer.register_schema(
            "thermoctl",
            "jsonschema",
            json.dumps(
                {
                    "type": "object",
                    "properties": {n: {"type": "number", "description": unit.get(n, "")} for n in names},
                }
            ).encode(),
        )
        channel = writer.register_channel("/thermoctl", "json", schema)
        writer.add_metadata("thermoctl", table.meta)
        for time_s, row in zip(clock, values, strict=True):
            data = json.dumps({n: v for n, v in zip(names, row.tolist(), strict=True) if v == v}).encode()
            writer.add_message(
                channel, log_time=round(time_s * 1e9), publish_time=round(time_s * 1e9), data=data
            )
        writer.finish()
