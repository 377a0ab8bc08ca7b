"""Read texts that are not a plain table: long tables, JSON, InfluxDB, Klipper's log, Tektronix.

Each reader returns sheets of texts, or None where the text is of another kind.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign import clock
from thermoctl.recording.foreign.cells import PAIRS, is_number
from thermoctl.recording.foreign.dialect import cells_of
from thermoctl.recording.foreign.jsonfile import IDS, read_json
from thermoctl.recording.foreign.sheet import Sheet, of_lists, of_records
from thermoctl.recording.foreign.units import NO_NAME, WORDS, known, named, spelled, states_unit_of

VALUES = WORDS["values"].split()
_BOOKKEEPING = {"result", "table", "_start", "_stop", "_measurement"}
_POINT = re.compile(
    r"^(?P<head>(?:\\.|[^\s\\])+) (?P<fields>(?:\\.|\"(?:\\.|[^\"\\])*\"|[^\s\\\"])+)(?: (?P<time>-?\d+))?$"
)
_STATS = re.compile(r"^(?:[^\n]*?[ \t])?Stats (\d+\.\d+): (.*)$", re.MULTILINE)
_LABEL = r"([A-Za-z_]\w*)[:=]\s?([-+]?[\d.]+(?:[eE][-+]?\d+)?)"
_LABEL_ALONE = r"^.*\w[:=]$|^[^\s/]+/\S+$"  # `2:`, `T=`, and a topic of MQTT
_LABELS = re.compile(
    r"(?:(?P<stamp>\d\d:\d\d:\d\d\.\d+) -> )?(?P<labels>(?:[A-Za-z_]\w*[:=]\s?[-+]?[\d.]+(?:[eE][-+]?\d+)?(?:[,\t ]+|$)){2,})",
    re.MULTILINE,
)
_STAMP = re.compile(
    r"^\[?(?:(?:ts|time|timestamp)=\"?)?(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?(?:Z|[+-]\d\d:?\d\d)?)(?=[\]\s,\"])"
)
# T=20.1 degC of a log's line; the unit is no name of the next pair.
_PAIR = re.compile(
    r"([^\W\d]\w*)=([-+]?[\d.]+(?:[eE][-+]?\d+)?)(?![\w.:/-])(?: ?([^\s,;=\d][^\s,;=]*)(?![^\s,;]*=))?"
)
FEW = 20  # number of first rows that show whether a column is a clock
ENOUGH = 0.75  # least share of the times at which each signal of a long table has a row
LEAD = 65536  # number of first bytes from which the layout is found
_GLOBAL = {"print_time", "buffer_time", "print_stall", "sysload", "cputime", "memavail", "gcodein"}


def special(path: Path, text: bytes) -> list[Sheet] | None:
    """Return the sheets of a text that is no table of rows; None for a table. Raises InputError."""
    lead = text[:LEAD].decode("utf-8", errors="ignore")
    for looks, reader in _LAYOUTS:
        if looks.search(lead) and (sheets := reader(path, text.decode("utf-8"))) is not None:
            return sheets
    return None


def _annotated(path: Path, text: str) -> list[Sheet] | None:
    """Read InfluxDB's annotated CSV: tables of records, each with a header of its own."""
    records, places, header = [], [], []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        cells = cells_of(line, ",")
        if "result" in cells and "table" in cells:
            header = cells
        elif len(cells) != len(header):
            raise InputError(
                f"{path}:{number}: {len(cells)} cells; {len(header)} as in the header were expected"
            )
        else:
            places.append(number)
            records.append({h: c for h, c in zip(header, cells, strict=True) if h and h not in _BOOKKEEPING})
    if not records:
        raise InputError(f"{path}: no rows; at least one record was expected")
    sheet = of_records(path, records)
    sheet.place = lambda row: f"{path}:{places[min(row, len(places) - 1)]}"
    return [sheet]


def _points(path: Path, text: str) -> list[Sheet] | None:
    """Read InfluxDB's line protocol: `measurement,tag=a field=1.0,other=2i 1772359200000000000`."""
    rows = [(n, x) for n, x in enumerate(text.splitlines(), 1) if x.strip() and not x.startswith("#")]
    if not rows or not (match := _POINT.match(rows[0][1])) or "=" not in match["fields"] or not match["time"]:
        return None
    by_measurement: dict[str, dict[str, list[Any]]] = {}
    places: dict[str, list[int]] = {}
    series: set[str] = set()
    parsed = []
    for number, line in rows:
        match = _POINT.match(line.strip())
        fields = re.findall(r'((?:\\.|[^,=\\])+)=("(?:\\.|[^"\\])*"|[^,]*)', match["fields"]) if match else []
        if not match or not fields or match["time"] is None:
            raise InputError(f"{path}:{number}: '{line[:40]}': a point `name field=value time` was expected")
        parsed.append((number, match["head"], fields, match["time"]))
        series.add(match["head"])
    for number, head, fields, time in parsed:
        table = by_measurement.setdefault(head, {"time": []})
        places.setdefault(head, []).append(number)
        count = len(table["time"])
        table["time"].append(time)
        for key, value in fields:
            value = value[:-1] if re.fullmatch(r"-?\d+[iu]", value) else value.strip('"')
            table.setdefault(key.replace("\\", ""), [None] * count).append(value)
        for column in table.values():
            column.extend([None] * (count + 1 - len(column)))
    sheets = []
    for head, table in by_measurement.items():
        tags = "_".join(part.partition("=")[2] for part in head.split(",")[1:]) or head
        named = {k if k == "time" or len(series) == 1 else f"{tags}_{k}": v for k, v in table.items()}
        numbers = places[head]
        sheets.append(of_lists(path, named, lambda row, numbers=numbers: f"{path}:{numbers[row]}"))  # type: ignore[misc]
    return sheets


def _klipper(path: Path, text: str) -> list[Sheet] | None:
    """Read the lines `Stats 123.4: heater_bed: target=60 temp=59.9 pwm=0.4 ...` of Klipper's log."""
    lines = list(_STATS.finditer(text))
    if len(lines) < 2:
        return None
    records = []
    for match in lines:
        record: dict[str, Any] = {"time [s]": match[1]}
        section = ""
        for word in match[2].split():
            key, sign, value = word.partition("=")
            if not sign and word.endswith(":"):
                section = word[:-1]
            elif sign and re.fullmatch(r"-?[\d.]+(?:e[+-]?\d+)?", value):
                record[key if key in _GLOBAL or not section else f"{section}_{key}"] = value
        records.append(record)
    sheet = of_records(path, records)
    sheet.units = {n: "degC" for n in sheet.columns if n.endswith(("_temp", "_target"))} | {"time [s]": "s"}
    sheet.place = lambda row: f"{path}:{text.count(chr(10), 0, lines[row].start()) + 1}"
    return [sheet]


def _labelled(path: Path, text: str) -> list[Sheet] | None:
    """Read the lines `T:20.1,P:3` of Arduino's plotter, with or without its monitor's time before them."""
    records = []
    for line in filter(str.strip, text.splitlines()):
        match = _LABELS.fullmatch(line.strip())
        if match is None:
            return None
        stamp = {"time": match["stamp"]} if match["stamp"] else {}
        records.append(stamp | dict(re.findall(_LABEL, match["labels"])))
    return [of_records(path, records)]


def _logged(path: Path, text: str) -> list[Sheet] | None:
    """Read a program's log: the lines with a date and `T=20.1 degC`. Others are left out with a note."""
    records, places = [], []
    units: dict[str, str | None] = {}
    every = [(n, x) for n, x in enumerate(text.splitlines(), 1) if x.strip()]
    for number, line in every:
        stamp, found = _STAMP.match(line), _PAIR.findall(line)
        if stamp and found:
            records.append({"time": stamp[1]} | {name: value for name, value, _ in found})
            places.append(number)
            units |= {name: spelled(unit, name) for name, _, unit in found if known(unit)}
    if 2 * len(records) < len(every):
        return None
    sheet = of_records(path, records)
    sheet.units = {k: v for k, v in units.items() if v}
    sheet.place = lambda row: f"{path}:{places[row]}"
    if len(records) < len(every):
        sheet.notes.append(f"{len(every) - len(records)} lines without a date and NAME=NUMBER left out")
    return [sheet]


def _probes(path: Path, text: str) -> list[Sheet] | None:
    """Read the probes of OpenFOAM: a column a probe, several of one with vectors."""
    probes = re.findall(r"(?m)^#\s*Probe\s+(\d+)\s+\(", text)
    rows = [(n, re.sub(r"[()]", " ", x).split()) for n, x in enumerate(text.splitlines(), 1) if x[:1] != "#"]
    rows = [(n, cells) for n, cells in rows if cells]
    size = (len(rows[0][1]) - 1) // len(probes) if rows else 0
    names = [f"probe_{p}" + (f"_{k + 1}" if size > 1 else "") for p in probes for k in range(size)]
    for number, cells in rows:
        if len(cells) != len(names) + 1:
            raise InputError(
                f"{path}:{number}: {len(cells)} numbers; {len(names) + 1} were expected (was it cut?)"
            )
    columns = zip(*(cells for _, cells in rows), strict=True)
    sheet = of_lists(
        path, dict(zip(["Time", *names], columns, strict=True)), lambda row: f"{path}:{rows[row][0]}"
    )
    sheet.units = {"Time": "s"}
    return [sheet]


def _tektronix(path: Path, text: str) -> list[Sheet] | None:
    """Read the table of a Tektronix TDS: key, value, empty, time, value in each line."""
    rows = [cells_of(x, ",") for x in text.splitlines() if x.strip()]
    if any(len(r) < 5 for r in rows):
        return None
    facts = {r[0].lower(): r[1] for r in rows if r[0]}
    name = facts.get("source", "CH1") or "CH1"
    sheet = of_lists(
        path, {"TIME": [r[3] for r in rows], name: [r[4] for r in rows]}, lambda row: f"{path}:{row + 1}"
    )
    units = {"TIME": spelled(facts.get("horizontal units", "s")), name: spelled(facts.get("vertical units"))}
    sheet.units = {k: v for k, v in units.items() if v}
    return [sheet]


_LAYOUTS: tuple[tuple[re.Pattern[str], Callable[[Path, str], list[Sheet] | None]], ...] = (
    (re.compile(r"\A\s*[{\[]"), read_json),
    (re.compile(r"\A(?:#(?:datatype|group|default)\b|,result,table\b)"), _annotated),
    (re.compile(r"\A(?:#.*\n|\s*\n)*[^\s,]\S* \S+=\S.* -?\d+\s*$", re.MULTILINE), _points),
    (re.compile(r"^(?:.*\s)?Stats \d+\.\d+: ", re.MULTILINE), _klipper),
    (re.compile(r"\A\W?\w?Record Length\"?,"), _tektronix),
    (re.compile(r"\A#\s*Probe 0 \("), _probes),
    (
        re.compile(
            rf"{_STAMP.pattern}(?:.*(?:INFO|DEBUG|WARN|ERROR|level=)[^=\n]*|\"? [^\W\d]\w*)=[-+\d]",
            re.MULTILINE,
        ),
        _logged,
    ),
    (re.compile(rf"\A{_LABELS.pattern}\s*$", re.MULTILINE), _labelled),
)


def pivoted(sheet: Sheet) -> list[Sheet] | None:
    """Return a sheet for each signal of a long table (signal, time, value or values); None for a wide one."""
    identity, value = _identity_and_value(sheet)
    ids = None if identity is None else _signals(identity, sheet.columns[identity])
    if identity is None or ids is None:
        return None
    rest = {n: c for n, c in sheet.columns.items() if n not in (identity, value)}
    times = {n: c for n, c in rest.items() if _is_clock(c) or (named(n) > 0 and _are_numbers(c))}
    tags = [
        n
        for n, c in rest.items()
        if n not in times and not isinstance(c, np.ndarray) and len(pc.unique(c)) > 1
    ]
    if not times:
        return None
    if len(times) == 1:
        times = {n: _of_one_day(sheet, c) for n, c in times.items()}
    units = {n: c for n, c in rest.items() if states_unit_of(n, "") and not isinstance(c, np.ndarray)}
    if tags and identity.startswith("_"):
        ids = pc.binary_join_element_wise(ids, *[pc.fill_null(sheet.columns[t], "") for t in tags], "_")
    values = [value] if value is not None else [n for n in rest if n not in times and n not in units]
    sheets = []
    for name in pc.unique(ids).to_pylist():
        if not name or name.startswith("$"):  # WinCC marks the start and the end of its run by $RT_OFF$
            continue
        rows = np.flatnonzero(pc.equal(ids, name).to_numpy(zero_copy_only=False))
        place = _places(sheet.place, rows)
        alone = {n for n in values if n == value or n.strip().lower() in VALUES or NO_NAME.match(n)}
        own = {name if len(values) == len(alone) == 1 else f"{name}_{n}": n for n in values}
        taken = {**times, **{k: sheet.columns[n] for k, n in own.items()}, **units}
        columns = {n: _taken(c, rows) for n, c in taken.items()}
        columns = {n: c for n, c in columns.items() if n not in units or pc.any(pc.not_equal(c, "")).as_py()}
        stated = {k: sheet.units[n] for k, n in {**{n: n for n in times}, **own}.items() if n in sheet.units}
        sheets.append(Sheet(columns, place, stated, name=name, decimal=sheet.decimal))
    if sheets:
        sheets[0].notes += sheet.notes
    return sheets or None


def _identity_and_value(sheet: Sheet) -> tuple[str | None, str | None]:
    """Return the columns that name the signal of a row, and that hold its value; None where none does."""
    lower = {n.strip().lower(): n for n in reversed(sheet.columns)}
    identity = next((lower[k] for k in IDS if k in lower and _any(sheet.columns[lower[k]])), None)
    value = next((lower[k] for k in VALUES if k in lower), None)
    if identity is None and value is None:
        identity, value = _labelled_columns(sheet)
    if identity is None or value is None or identity == value:
        return _told_apart(sheet), None
    if identity[:1] != "_" and _is_one(sheet.columns[identity]):
        return _told_apart(sheet) or identity, value  # series of one measurement differ in a tag
    return identity, value


def _told_apart(sheet: Sheet) -> str | None:
    """Return the column whose words, or whose numbers by its name, tell whose reading a row is.

    Each word stands at most times, once; or the name says it, and the words change from row to row.
    Words of a state do not tell. None where no column does."""
    times = [c for n, c in sheet.columns.items() if named(n) > 0 or _is_clock(c[:FEW])]
    found = {}
    for name, cells in sheet.columns.items():
        by_name = name.strip().lower() in IDS
        if named(name) > 0 or (isinstance(cells, np.ndarray) and not by_name):
            continue
        if (ids := _signals(name, cells)) is None:
            continue
        words = pc.unique(ids).to_pylist()
        is_state = any({w.lower() for w in words} <= {*pair, ""} for pair in PAIRS)
        counted = bool(len(_numbers(cells))) or all(map(is_number, words))
        if 1 < len(words) <= len(ids) / 2 and not is_state and (by_name or not counted):
            found[name] = ids, len(words)
    if not times or not found:
        return None
    texts = (
        pa.array(map(str, c.tolist())) if isinstance(c, np.ndarray) else pc.fill_null(c, "") for c in times
    )
    key = pc.binary_join_element_wise(*texts, " ")
    often = len(key) / len(pc.unique(key)) if len(key) else 0.0
    for name, (ids, count) in found.items():
        at_once = often > ENOUGH * count and len(
            pc.unique(pc.binary_join_element_wise(key, ids, "|"))
        ) == len(key)
        in_turn = pc.sum(pc.not_equal(ids[1:], ids[:-1])).as_py() > len(ids) / 4  # not one after the other
        if at_once or (in_turn and name.strip().lower() in IDS):
            sheet.notes.append(f"a long table: '{name.strip()}' tells whose reading a row is")
            return name
    return None


def _is_one(cells: Any) -> bool:
    return not isinstance(cells, np.ndarray) and len(pc.unique(cells)) == 1


def _any(cells: Any) -> bool:
    return isinstance(cells, np.ndarray) or bool(pc.any(pc.not_equal(pc.fill_null(cells, ""), "")).as_py())


def _of_one_day(sheet: Sheet, cells: Any) -> Any:
    """Return times of day, which have no date, as durations from the first of all signals.

    Raises InputError."""
    if isinstance(cells, np.ndarray) or not clock.are_times(cells):
        return cells
    try:
        seconds = clock.from_texts(cells)
    except clock.ClockError as e:
        raise InputError(f"{sheet.place(e.row)}: {e.reason}") from None
    if seconds.kind != "time of day":
        return cells
    sheet.notes.append(seconds.note)
    return np.round(seconds.t * 1e9).astype("timedelta64[ns]")


def _labelled_columns(sheet: Sheet) -> tuple[str | None, str | None]:
    """Return the columns of labels and values of rows `00:42:14 2: 91.1`; note numbers that may be labels."""
    if len(names := list(sheet.columns)) != 3 or not all(map(NO_NAME.match, names)):
        return None, None
    cells = sheet.columns[names[1]]
    texts = cells if not isinstance(cells, np.ndarray) else pa.array([], pa.string())
    seen = len(pc.unique(texts))
    if 1 < seen <= len(texts) / 2 and pc.all(pc.match_substring_regex(texts, _LABEL_ALONE)).as_py():
        return names[1], names[2]
    numbers = _numbers(cells)
    high = numbers.max(initial=0)
    in_turn = 1 < high <= len(numbers) / 2 and np.array_equal(numbers, np.arange(len(numbers)) % high + 1)
    if in_turn and _is_clock(sheet.columns[names[0]]):
        sheet.notes.append(
            f"{names[1]} runs from 1 to {high:g} again and again: channels in turn? A header line "
            "`time channel value` makes a column of each"
        )
    return None, None


def _numbers(cells: Any) -> np.ndarray:
    """Return a column as numbers; none where a cell is no plain number."""
    if isinstance(cells, np.ndarray):
        return cells if cells.dtype.kind == "f" and np.isfinite(cells).all() else np.zeros(0)
    if not len(cells) or not pc.all(pc.match_substring_regex(cells, r"^\d{1,9}$")).as_py():
        return np.zeros(0)
    return np.asarray(cells.cast(pa.float64()).to_numpy(zero_copy_only=False))


def _are_numbers(cells: Any) -> bool:
    return isinstance(cells, np.ndarray) or pc.all(pc.match_substring_regex(cells, r"^\d+\.?\d*$")).as_py()


def _signals(name: str, cells: Any) -> pa.Array | None:
    """Return names of signals; of numbered ones `channel_2`. None where numbers count rows."""
    texts = cells
    if len(numbers := _numbers(cells)):
        texts = pa.array([f"{v:.0f}" for v in numbers.tolist()])
        if np.any(numbers % 1) or not 1 < len(pc.unique(texts)) <= len(numbers) / 2:
            return None
    elif isinstance(cells, np.ndarray):
        return None
    texts = pc.replace_substring_regex(pc.fill_null(texts, ""), r"\s*[:=]$", "")
    prefix = "channel" if NO_NAME.match(name) else name.strip()
    return pc.replace_substring_regex(texts, r"^(\d+)$", prefix.replace("\\", r"\\") + r"_\1")


def _places(place: Callable[[int], str], rows: np.ndarray) -> Callable[[int], str]:
    return lambda row: place(int(rows[row]))


def _taken(cells: Any, rows: np.ndarray) -> Any:
    return cells[rows] if isinstance(cells, np.ndarray) else cells.take(pa.array(rows))


def _is_clock(cells: Any) -> bool:
    if isinstance(cells, np.ndarray):
        there = cells[np.isfinite(cells)] if cells.dtype.kind == "f" else cells
        return cells.dtype.kind in "mM" or (
            len(there) > 0 and clock.from_numbers(there, None).kind == "epoch"
        )
    return len(cells) > 0 and clock.are_times(cells)
