"""Recordings of other programs: MDF, TDMS, Excel and MATLAB read, MDF4 and MCAP written.

The libraries (asammdf, npTDMS, openpyxl, mat-io, mcap) are an extra, `pip install 'thermoctl[formats]'`. A
reader returns sheets: columns that share a clock.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.files import own_meta
from thermoctl.recording.foreign.clock import Seconds
from thermoctl.recording.foreign.dialect import distinct
from thermoctl.recording.foreign.facts import stated_step
from thermoctl.recording.foreign.sheet import Cells, Sheet, as_cells, place_in
from thermoctl.recording.foreign.units import spelled
from thermoctl.recording.stream import texts
from thermoctl.recording.table import Table
from thermoctl.rig.signals import units

_MODELICA_UNIT = re.compile(r"\[([^\]|]+)[^\]]*\]\s*$")  # `Angle [rad|deg]`


def _damaged(path: Path, kind: str, e: Exception) -> InputError:
    return InputError(
        f"{path}: not a whole {kind} file: {str(e).splitlines()[0] if str(e) else type(e).__name__}"
    )


def _timed(
    path: Path, channels: list[tuple[str, str, np.ndarray, np.ndarray, str | None]], notes: list[str]
) -> list[Sheet]:
    """Return sheets of the channels (name, unit, times (n,), values (n,), start), one a clock.

    A channel of arrays or objects, or one whose length is not that of its times, is left out with a note."""
    sheets: dict[tuple[int, bytes, str | None], Sheet] = {}
    names = [c[0] for c in channels]
    for name, unit, t, values, start in channels:
        if values.ndim != 1 or values.dtype.kind not in "fiubmMSUO":
            notes.append(
                f"channel '{name}' left out: each sample is {values.dtype} {values.shape[1:]}, no number"
            )
            continue
        if len(values) != len(t):
            notes.append(f"channel '{name}' left out: {len(values)} values and {len(t)} times")
            continue
        wrong = np.flatnonzero(~(np.diff(t) > 0))
        if not np.isfinite(t).all() or len(wrong):
            row = int(wrong[0]) + 2 if len(wrong) else 1
            raise InputError(
                f"{path}: row {row}: channel '{name}': the time does not increase; strictly increasing seconds were expected"
            )
        key = (len(t), np.ascontiguousarray(t).tobytes(), start)
        seconds = Seconds(np.asarray(t, float), start, "", "unit")
        sheet = sheets.setdefault(key, Sheet({}, place_in(path), clock=seconds, start=start))
        if names.count(name) > 1 and name in [n for s in sheets.values() for n in s.columns]:
            raise InputError(
                f"{path}: two channels are called '{name}'; export them under names of their own"
            )
        sheet.columns[name] = as_cells(values)
        if stated := spelled(unit, name):
            sheet.units[name] = stated
    return list(sheets.values())


def frames(path: Path) -> InputError:
    """Return the error of a log of CAN frames."""
    return InputError(
        f"{path}: frames of a CAN bus, not the signals in them; decode them by the bus's DBC file first, with "
        "asammdf or `python -m cantools decode`"
    )


def read_mdf(path: Path, notes: list[str]) -> list[Sheet]:
    """Read the channels of an ASAM MDF file (3 or 4), a sheet for each clock. Raises InputError."""
    asammdf = load("asammdf", path)
    path.stat()
    channels = []
    try:
        with asammdf.MDF(str(path)) as mdf:
            begins = mdf.header.start_time
            start = begins.replace(tzinfo=None).isoformat(timespec="milliseconds") if begins else None
            for signal in mdf.iter_channels():
                samples = np.asarray(signal.samples)
                invalid = getattr(signal, "invalidation_bits", None)
                if invalid is not None and samples.dtype.kind in "fiub":
                    samples = np.where(np.asarray(invalid, bool), np.nan, samples)
                if samples.dtype.names and signal.name == "CAN_DataFrame":
                    raise frames(path)
                if signal.name not in ("t", "time"):
                    channels.append(
                        (signal.name, signal.unit or "", np.asarray(signal.timestamps), samples, start)
                    )
    except InputError:
        raise
    except Exception as e:  # asammdf raises any error on damaged bytes
        raise _damaged(path, "MDF", e) from None
    return _timed(path, _own_names(channels), notes)


def _own_names(channels: list[Any]) -> list[Any]:
    """Return channels with a number behind each name that several groups use."""
    names = [c[0] for c in channels]
    seen: dict[str, int] = {}
    renamed = []
    for name, *rest in channels:
        seen[name] = seen.get(name, 0) + 1
        renamed.append((f"{name}_{seen[name]}" if names.count(name) > 1 else name, *rest))
    return renamed


def read_tdms(path: Path, notes: list[str], group: str | None = None) -> list[Sheet]:
    """Read a TDMS file: channels with a waveform by their clocks, the others of a group as a table.

    A name that several groups use becomes group_channel. Raises InputError."""
    nptdms = load("nptdms", path)
    logging.getLogger("nptdms").setLevel(logging.ERROR)  # a note says that the file was cut
    path.stat()
    try:
        file = nptdms.TdmsFile.read(str(path))
        groups = {
            g.name: {c.name: (np.asarray(c[:]), dict(c.properties)) for c in g.channels()}
            for g in file.groups()
        }
        if file.file_status.incomplete_final_segment:
            notes.append("the last segment is shorter than stated: was the file cut off?")
    except Exception as e:  # npTDMS likewise
        raise _damaged(path, "TDMS", e) from None
    if group is not None:
        groups = {group: groups[_chosen(path, group, list(groups), "group")]}
    names = [n for channels in groups.values() for n in channels]
    waves: list[Any] = []
    tables = []
    for title, channels in groups.items():
        clocked = any(n in ("t", "t_s") for n in channels)
        rest = {}
        for name, (values, properties) in channels.items():
            step = properties.get("wf_increment")
            unit = str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")
            own = name if names.count(name) == 1 or (clocked and name in ("t", "t_s")) else f"{title}_{name}"
            if isinstance(step, int | float) and step > 0 and len(values) and not clocked:
                begins = properties.get("wf_start_time")
                start = str(np.datetime64(begins, "us")) if begins is not None else None
                t = float(properties.get("wf_start_offset", 0.0)) + step * np.arange(len(values))
                waves.append((own, unit, t, values, start))
            else:
                rest[own] = values, unit
        tables.append(_group(path, title, rest, notes))
    sheets = _timed(path, waves, notes)
    for table in tables:
        if sheets and not any(isinstance(c, np.ndarray) for c in table.columns.values()):
            notes += (
                [f"channels of text without times left out: {', '.join(table.columns)}"]
                if table.columns
                else []
            )
        elif table.columns:
            sheets.append(table)
    return sheets


def _group(path: Path, title: str, channels: dict[str, tuple[np.ndarray, str]], notes: list[str]) -> Sheet:
    """Return the channels (values, unit) of a group as a table; another length is left out with a note."""
    lengths = [len(v) for v, _ in channels.values() if len(v)]
    rows = max(set(lengths), key=lengths.count) if lengths else 0
    table = Sheet({}, place_in(path), name=title)
    for name, (values, unit) in channels.items():
        if len(values) != rows or not rows:
            notes.append(f"channel '{title}/{name}' left out: {len(values)} values; the others have {rows}")
            continue
        table.columns[name] = as_cells(values)
        if stated := spelled(unit, name):
            table.units[name] = stated
    return table


def _chosen(path: Path, name: str, names: list[str], what: str) -> str:
    if name not in names:
        raise InputError(f"{path}: no {what} '{name}'{suggest(name, names)}; it has {', '.join(names)}")
    return name


def read_excel(path: Path, sheet: str | None = None) -> list[tuple[str, bytes]]:
    """Return the sheets of an Excel file, hidden ones last, or the named one, as comma-separated text.

    Raises InputError."""
    openpyxl = load("openpyxl", path)
    sheets = []
    with open(path, "rb") as f:  # openpyxl refuses the path of an Excel file with another suffix
        data = io.BytesIO(f.read())
    try:
        with zipfile.ZipFile(data) as archive:
            if "[Content_Types].xml" not in archive.namelist():
                raise ValueError("unpack the archive, or save its table as .xlsx or .csv")
        book = openpyxl.load_workbook(data, read_only=True, data_only=True)
        titles = [w.title for w in book.worksheets]
        for page in sorted(book.worksheets, key=lambda w: w.sheet_state != "visible"):
            out = io.StringIO()
            writer = csv.writer(out, lineterminator="\n")
            for row in page.iter_rows(values_only=True) if sheet in (None, page.title) else ():
                writer.writerow([_cell(c) for c in row])
            sheets.append((page.title, out.getvalue().encode()))
        book.close()
    except Exception as e:  # openpyxl likewise
        raise _damaged(path, "Excel", e) from None
    return sheets if sheet is None else [f for f in sheets if f[0] == _chosen(path, sheet, titles, "sheet")]


def _cell(value: object) -> str:
    if isinstance(value, timedelta):
        return f"{value.days} days {timedelta(seconds=value.seconds)}.{value.microseconds:06d}"
    if isinstance(value, date | time):
        return value.isoformat()
    return "" if value is None else str(value).replace("\n", " ")


def _loaded(path: Path) -> dict[str, Any]:
    """Return the variables of a MATLAB file, by name. Raises InputError."""
    matio = load("matio", path)
    path.stat()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = matio.load_from_mat(str(path))
    except Exception as e:  # any error on damaged bytes
        raise _damaged(path, "MATLAB", e) from None
    return {k: v for k, v in content.items() if not k.startswith("__")}


def read_mat(path: Path, notes: list[str], variable: str | None = None) -> list[Sheet]:
    """Read a MATLAB file, 4 to 7.3: tables, timetables, structs, vectors. Raises InputError."""
    content = _loaded(path)
    if (result := _trajectories(content, notes)) is not None:
        return [Sheet(result[0], place_in(path), result[1])]
    step_s = _stated(content)
    if variable is not None:
        content = {variable: content[_chosen(path, variable, list(content), "variable")]}
    sheets: list[Sheet] = []
    loose: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if hasattr(value, "columns"):  # a data frame
            columns: dict[str, Cells] = {str(c): as_cells(np.asarray(value[c])) for c in value.columns}
            if value.index.dtype.kind in "mM":
                columns = {str(value.index.name or "Time"): np.asarray(value.index), **columns}
            sheets.append(Sheet(columns, place_in(path), name=name))
        elif vectors := _vectors(value):
            step, found = _stated(_fields(value)), _of_arrays(path, vectors, notes)
            sheets += [replace(s, name=f"{name}: {s.name}", step_s=step) for s in found]
        elif _is_array(value):
            loose[name] = np.squeeze(value)
    sheets += _of_arrays(path, loose, notes)
    for sheet in sheets:
        sheet.step_s = sheet.step_s or step_s
    if len(sheets) > 1:
        sheets.sort(key=len, reverse=True)
        notes.append(
            f"'{sheets[0].name}' read, of {'; '.join(s.name for s in sheets)} (another: --sheet VARIABLE)"
        )
    return sheets[:1]


def _of_arrays(path: Path, loose: Mapping[str, np.ndarray], notes: list[str]) -> list[Sheet]:
    """Return vectors and matrices of one length as tables; a matrix has its longer side as rows.

    Those that are in no table are a note."""
    sheets, lost = [], set(loose)
    for size in {max(v.shape) for v in loose.values()}:
        own = {n: v for n, v in loose.items() if max(v.shape) == size and v.ndim <= 2 and v.dtype.kind != "c"}
        columns: dict[str, Cells] = {}
        for name, v in own.items():
            if v.ndim == 1:
                columns[name] = v.astype(float)
                continue
            tall = (v.T if v.shape[0] < size else v).astype(float)
            of = name if len(own) > 1 else "column"
            columns |= {f"{of}_{i + 1}": c for i, c in enumerate(tall.T)}
        if len(columns) > 1:
            sheets.append(Sheet(columns, place_in(path), name=", ".join(own)))
            lost = lost - own.keys()
    notes += [
        f"'{n}' left out: {loose[n].dtype}, size {' x '.join(map(str, loose[n].shape))}" for n in sorted(lost)
    ]
    return sheets


def _stated(fields: Mapping[str, Any]) -> float | None:
    """Return the sampling interval, s, by a number called Ts, dt, Fs or sample time; None without one."""
    names = {"ts": "interval", "fs": "samplerate"}
    numbers = {
        n.lower(): v for n, v in fields.items() if np.size(v) == 1 and np.asarray(v).dtype.kind in "fiu"
    }
    facts = {
        names.get(n, n): [f"{np.asarray(v).item():g}"]
        for n, v in numbers.items()
        if re.fullmatch("[tf]s|dt|.*sampl.*", n)
    }
    step = stated_step(facts)
    return step[0] if step else None


def _fields(value: Any) -> dict[str, Any]:
    """Return the fields of a single struct, by name."""
    if not isinstance(value, np.ndarray) or value.dtype.names is None or value.size != 1:
        return {}
    record = value.reshape(-1)[0]
    return {n: record[n] for n in value.dtype.names}


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiubc" and value.size > 1


def _vectors(value: Any) -> dict[str, np.ndarray]:
    """Return the vectors and matrices of a struct, by name.

    Also those of dSPACE's X.Data and Y(k).Name, Y(k).Data, and of Simulink's signals(k).values."""
    fields = _fields(value)
    inner = {
        k: fields[k].dtype.names or () for k in ("X", "Y", "signals") if isinstance(fields.get(k), np.ndarray)
    }
    vectors = {n: np.squeeze(v) for n, v in fields.items() if _is_array(v)}
    if "Data" in inner.get("X", ()) and "Data" in inner.get("Y", ()):
        vectors = {"time": np.ravel(fields["X"].reshape(-1)[0]["Data"])}
        for y in fields["Y"].reshape(-1):
            name = str(np.ravel(y["Name"])[0]).strip('"').rpartition("/")[2]
            vectors[name] = np.ravel(y["Data"])
    signals = fields["signals"].reshape(-1) if {"values", "label"} <= set(inner.get("signals", ())) else ()
    for k, signal in enumerate(signals, 1):
        vectors["".join(np.ravel(signal["label"])) or f"signal_{k}"] = np.squeeze(signal["values"])
    return vectors


def _trajectories(
    content: Mapping[str, Any], notes: list[str]
) -> tuple[dict[str, Cells], dict[str, str]] | None:
    """Return the varying columns of a result of Dymola or OpenModelica, and their units; else None.

    Of the rows of an event, which have one time, the last is kept."""
    kind = [str(line).strip("\0 ") for line in np.ravel(content.get("Aclass", []))]
    if not kind or kind[0] != "Atrajectory":
        return None
    by_column = "binTrans" in kind
    if "data_2" in content:
        matrices = (content[k].T if by_column else content[k] for k in ("dataInfo", "data_2"))
        places, data = (np.asarray(m) for m in matrices)
        names, meanings = (_lines(content.get(k, []), by_column) for k in ("name", "description"))
    else:
        data, names = np.asarray(content["data"]), _lines(content.get("names", []), by_column)
        places, meanings = np.array([(2, k + 1) for k in range(len(names))]), [""] * len(names)
    last = np.append(np.diff(data[:, 0]) != 0, True)
    if not last.all():
        notes.append(f"{np.sum(~last)} rows before an event, or twice, left out")
    columns: dict[str, Cells] = {}
    units = {}
    for name, meaning, (table, column, *_) in zip(names, meanings, places.astype(int), strict=False):
        if table != 1:  # the table of parameters, which are constant
            columns[name] = np.sign(column) * data[last, abs(column) - 1].astype(float)
            if match := _MODELICA_UNIT.search(meaning):
                units[name] = spelled(match[1], name) or ""
    return columns, {n: u for n, u in units.items() if u}


def _lines(text: Any, by_column: bool) -> list[str]:
    """Return the lines of a matrix of letters; `by_column`: it is stored transposed."""
    lines = [str(line) for line in np.ravel(text)]
    return ["".join(letters).rstrip("\0 ") for letters in (zip(*lines, strict=True) if by_column else lines)]


def read_arrow(path: Path, arrow: pa.Table) -> Sheet:
    """Return the columns of a Parquet or Arrow file; lists are left out with a note."""
    sheet = Sheet({}, place_in(path), meta=own_meta(arrow.schema))
    while any(pa.types.is_struct(f.type) for f in arrow.schema):
        arrow = arrow.flatten()
    for name, column, kind in zip(distinct(arrow.column_names), arrow.columns, arrow.schema, strict=True):
        column = column.combine_chunks()
        column = column.dictionary_decode() if pa.types.is_dictionary(column.type) else column
        if pa.types.is_date(column.type):
            column = column.cast(pa.timestamp("s"))
        if pa.types.is_timestamp(column.type):
            values: Cells = column.cast(pa.timestamp("ns", column.type.tz)).to_numpy(zero_copy_only=False)
        elif pa.types.is_duration(column.type):
            values = column.cast(pa.duration("ns")).to_numpy(zero_copy_only=False)
        elif (
            pa.types.is_string(column.type)
            or pa.types.is_large_string(column.type)
            or pa.types.is_string_view(column.type)
            or pa.types.is_time(column.type)
        ):
            values = pc.fill_null(column.cast(pa.string()), "")
        else:
            try:
                values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False).astype(float)
            except (pa.ArrowException, ValueError):
                sheet.notes.append(f"column '{name}' left out: {column.type} is no number")
                continue
        sheet.columns[name] = values
        if unit := texts(kind.metadata).get("unit"):
            sheet.units[name] = unit
    return sheet


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
        if "wall_s" in table.columns:  # with an absolute time, other programs show the time of day
            mdf.start_time = datetime.fromtimestamp(table.columns["wall_s"][0] - table.t[0], UTC)
        mdf.save(path, overwrite=True, compression=2)


def write_mcap(path: str, table: Table) -> None:
    """Write MCAP with one JSON message a row on /thermoctl (Foxglove and PlotJuggler plot its fields).

    A missing sample is left out of its message. Log time is `wall_s` if it is recorded, else `t`."""
    writer_module = load("mcap.writer", Path(path))
    clock = table.columns.get("wall_s", table.t - min(table.t[0], 0.0))
    unit = {"t": "s"} | units(table.columns)
    names, values = ["t", *table.columns], np.column_stack([table.t, *table.columns.values()])
    with open(path, "wb") as f:
        writer = writer_module.Writer(f)
        writer.start(profile="", library="thermoctl")
        numbers = {n: {"type": "number", "description": unit.get(n, "")} for n in names}
        described = json.dumps({"type": "object", "properties": numbers})
        schema = writer.register_schema("thermoctl", "jsonschema", described.encode())
        channel = writer.register_channel("/thermoctl", "json", schema)
        writer.add_metadata("thermoctl", table.meta)
        for time_s, row in zip(clock, values, strict=True):
            data = json.dumps({n: v for n, v in zip(names, row.tolist(), strict=True) if v == v}).encode()
            ns = round(time_s * 1e9)
            writer.add_message(channel, log_time=ns, publish_time=ns, data=data)
        writer.finish()
