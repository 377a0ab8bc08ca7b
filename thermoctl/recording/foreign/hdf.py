"""Read an HDF5 file: vectors and matrices of a group, tables of PyTables, data frames of pandas."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.foreign import clock
from thermoctl.recording.foreign.sheet import Cells, Sheet, as_cells, place_in
from thermoctl.recording.foreign.units import spelled, time_unit
from thermoctl.units import SECONDS

_NONE = b"N."  # None as PyTables pickles it


def read_hdf(path: Path, notes: list[str], group: str | None = None) -> list[Sheet]:
    """Return the named group of an HDF5 file, else that with most cells, as a table. Raises InputError."""
    h5py = load("h5py", path)
    sheets: dict[tuple[str, int], Sheet] = {}

    def add(place: str, item: Any) -> None:
        """Put a dataset into the table of its group; those of another length are another table."""
        above, _, name = place.rpartition("/")
        if not isinstance(item, h5py.Dataset) or item.ndim not in (1, 2) or len(item) < 2:
            return
        if re.fullmatch(r"axis0|block\d+_items", name) or "_i_" in place:  # names of a data frame; an index
            return
        columns = {n: _converted(c, item.attrs) for n, c in _columns(name, item).items()}
        own = above if item.dtype.names is None else place
        sheet = sheets.setdefault((own or "/", len(item)), Sheet({}, place_in(path), name=own or "/"))
        sheet.columns |= columns
        if len(columns) == 1 and (
            unit := spelled(_text(item.attrs.get("units", item.attrs.get("unit", ""))), name)
        ):
            sheet.units[name] = unit

    try:
        with h5py.File(path) as file:
            file.visititems(add)
    except (OSError, RuntimeError, ValueError, TypeError, KeyError) as e:
        raise InputError(f"{path}: not a whole HDF5 file: {str(e).splitlines()[0]}") from None
    names = list(dict.fromkeys(s.name for s in sheets.values()))
    if group is not None and group not in names:
        raise InputError(f"{path}: no group '{group}'{suggest(group, names)}; it has {', '.join(names)}")
    chosen = [s for s in sheets.values() if group in (None, s.name)]
    chosen.sort(key=lambda s: len(s) * len(s.columns), reverse=True)
    if len(chosen) > 1:
        notes.append(
            f"'{chosen[0].name}' read, {len(chosen[0])} rows, of {', '.join(names)} (another: --sheet GROUP)"
        )
    return chosen[:1]


def _converted(cells: Cells, said: Any) -> Cells:
    """Return what packed numbers of netCDF stand for, and the dates of times such as `hours since` one."""
    if not isinstance(cells, np.ndarray) or cells.dtype.kind != "f":
        return cells
    for none in (said[key] for key in ("_FillValue", "missing_value") if key in said):
        cells = np.where(cells == np.ravel(none)[0], np.nan, cells)
    if {"scale_factor", "add_offset"} & set(said):
        scale, offset = (np.ravel(said.get(k, d))[0] for k, d in (("scale_factor", 1.0), ("add_offset", 0.0)))
        cells = cells * float(scale) + float(offset)
    unit, since, date = _text(said.get("units", "")).partition(" since ")
    step = time_unit(unit)
    if not since or step is None or not np.isfinite(cells).all() or not clock.is_time(date):
        return cells
    begin = np.datetime64(str(clock.from_texts(pa.array([date])).start).rstrip("Z"))
    return np.asarray(begin + np.round(cells * SECONDS[step] * 1e6).astype("timedelta64[us]"))


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _columns(name: str, item: Any) -> dict[str, Cells]:
    """Return the columns of a dataset: of a matrix and of a table's field with several values one each."""
    values, said = item[()], item.attrs
    if values.dtype.names is not None:
        fields = {n: np.asarray(values[n]) for n in values.dtype.names}
        if (kind := _text(said.get("index_kind", ""))) and "index" in fields:  # to_hdf(format="table")
            info = _text(item.parent.attrs.get("info", ""))
            own = (re.findall(r"\nVindex_name\np\d+\nV([^\n]*)", info) or ["index"])[0]
            rest = {n: v for n, v in fields.items() if n != "index"}
            fields = {own: _dated(fields["index"], kind, "\nVtz\n" in info), **rest}
        titles = {n: _pickled(said.get(f"{n}_kind", "")) for n in fields}
        return {k: c for n, v in fields.items() if v.ndim < 3 for k, c in _split(n, v, titles[n]).items()}
    if name in ("axis1", "index") and "kind" in said:
        values = _dated(values, _text(said["kind"]), "tz" in said)
        name = _text(said["name"]) if "name" in said and said["name"] != _NONE else "index"
    elif name == "values":  # a series
        name = _text(item.parent.attrs.get("name", name))
    items = item.parent.get(name.replace("_values", "_items")) if name.startswith("block") else None
    return _split(name, values, [_text(t) for t in items[()]] if items is not None else [])


def _dated(values: np.ndarray, kind: str, zoned: bool) -> np.ndarray:
    """Return the index of a data frame as the dates that its kind states; UTC stays a number of an epoch."""
    unit = re.match(r"(datetime64|timedelta64)(?:\[(\w+))?", kind)
    return values.astype(f"{unit[1]}[{unit[2] or 'ns'}]") if unit and not zoned else values


def _pickled(value: Any) -> list[str]:
    """Return the texts of a list that PyTables pickled, without unpickling it: that could run code."""
    return re.findall(r"\na?[VI]([^\n]*)", _text(value))


def _split(name: str, values: np.ndarray, titles: list[str]) -> dict[str, Cells]:
    if values.ndim == 1:
        return {name: as_cells(values)}
    width = values.shape[1]
    own = titles if len(titles) == width else [f"{name}_{k + 1}" for k in range(width)]
    return {n: as_cells(c) for n, c in zip(own, values.T, strict=True)}
