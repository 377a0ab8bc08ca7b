"""Read JSON of pandas, InfluxDB, Grafana, Home Assistant and others: records, columns, rows."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign import clock
from thermoctl.recording.foreign.cells import is_number
from thermoctl.recording.foreign.sheet import INDEX, Sheet, of_lists, of_records
from thermoctl.recording.foreign.units import WORDS, known, named, spelled

IDS = WORDS["identities"].split()
# Keys of Home Assistant's websocket. Its "lc", the last change, is stated only where it is not "lu".
_SHORT = {"s": "state", "a": "attributes", "lu": "time"}
_ABOUT = re.compile(r"(?<=\{ )about: '([^'\n]*)'")  # as rrdtool xport --json writes it
_GRAFANA = dict(pair.split("=") for pair in WORDS["grafana"].split())


def read_json(path: Path, text: str) -> list[Sheet] | None:
    """Return the tables of a JSON text, or of lines of JSON; None for another text. Raises InputError."""
    notes: list[str] = []
    try:
        content = json.loads(_ABOUT.sub(r'"about": "\1"', text, count=1))
    except ValueError as e:
        content = _json_lines(path, text, notes)
        if not content:
            if path.suffix.lower() == ".json":
                raise InputError(
                    f"{path}: no JSON: {e}; a whole file was expected (was it cut off?)"
                ) from None
            return None
    if sheets := _tables(path, content) or _one_series(path, content):
        sheets[0].notes += notes
        return _apart(sheets)
    raise InputError(
        f'{path}: no table in this JSON; records [{{"t": 0, "T": 20}}, ...], columns {{"t": [0, 1], "T": [20, 21]}} '
        'or rows [["t", "T"], [0, 20], ...] were expected'
    )


def _json_lines(path: Path, text: str, notes: list[str]) -> list[Any]:
    """Return the values of lines of JSON; none where the first line is none. A cut last line is a note."""
    rows = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    found: list[Any] = []
    for number, line in rows:
        try:
            found.append(json.loads(line))
        except ValueError as e:
            if not found:
                break
            if number != rows[-1][0]:
                raise InputError(f"{path}:{number}: no JSON: {e}; a line of JSON was expected") from None
            notes.append(f"line {number} at the end left out: no whole JSON (was the file cut off?)")
    return found


def _tables(path: Path, content: Any) -> list[Sheet] | None:
    """Return the tables of a JSON value: records, columns, or lists of either."""
    if isinstance(content, list):
        return _of_list(path, content)
    if not isinstance(content, dict):
        return None
    for reader in (_rrdtool, _thingspeak, _fields, _series, _temperature_store, _websocket, _indexed):
        if sheets := reader(path, content):
            return sheets
    if sheet := _lists(path, content):
        return [sheet]
    sheets = _inner(path, content.items())
    for sheet in sheets or ():
        stated = content.get(f"{sheet.name}_units")  # Open-Meteo's hourly, hourly_units
        units = stated.items() if isinstance(stated, dict) else ()
        sheet.units |= {n: spelled(u, n) or "" for n, u in units if n in sheet.columns and known(str(u))}
    return sheets or _inner(path, ((k, x) for k, v in content.items() if isinstance(v, list) for x in v))


def _inner(path: Path, items: Iterable[tuple[str, Any]]) -> list[Sheet] | None:
    """Return the tables of named values; a table without a name gets that of its value."""
    found = []
    for name, value in items:
        for sheet in (_tables(path, value) or []) if isinstance(value, dict | list) else []:
            sheet.name = sheet.name or name
            found.append(sheet)
    return found or None


def _apart(sheets: list[Sheet]) -> list[Sheet]:
    """Return the tables, a column that several have called by its table: `block` for `value`."""
    names = [sheet.name for sheet in sheets]
    count = Counter(n for sheet in sheets for n in sheet.columns if named(n) <= 0)
    for sheet in sheets if len(set(names)) == len(names) else ():
        twice = [n for n in sheet.columns if count[n] > 1 and n != INDEX]
        values = [n for n in twice if n in WORDS["values"].split()] or twice
        new = {n: sheet.name if values == [n] else f"{sheet.name}_{n}" for n in twice}
        sheet.columns = {new.get(n, n): c for n, c in sheet.columns.items()}
        sheet.units = {new.get(n, n): u for n, u in sheet.units.items()}
    return sheets


def _lists(path: Path, content: Mapping[str, Any]) -> Sheet | None:
    """Return the lists of one length in an object as columns; the longest, if they are two or more."""
    lists = {
        k: v for k, v in content.items() if isinstance(v, list) and v and not isinstance(v[0], dict | list)
    }
    lengths = [len(v) for v in lists.values()]
    rows = max((n for n in lengths if lengths.count(n) > 1), default=0)
    if not rows:
        return None
    sheet = of_lists(path, {k: v for k, v in lists.items() if len(v) == rows})
    sheet.notes += [
        f"list '{k}' left out: {len(v)} items; the others have {rows}"
        for k, v in lists.items()
        if len(v) != rows
    ]
    return sheet


def _of_list(path: Path, content: list[Any]) -> list[Sheet] | None:
    if content and all(isinstance(x, dict) for x in content):
        return _of_objects(path, content)
    if content and all(map(_are_records, content)):  # Home Assistant: a list for each entity
        return [of_records(path, [_common(x[0]) | y for x in content for y in x])]
    if len(content) > 1 and all(isinstance(x, list) for x in content):
        rows = content[1:] if all(isinstance(n, str) for n in content[0]) else content
        names = content[0] if rows is not content else [f"column_{i + 1}" for i in range(len(rows[0]))]
        plain = not any(isinstance(y, dict | list) for x in rows for y in x)
        if plain and {len(x) for x in rows} == {len(set(names))} != {1}:
            return [of_lists(path, dict(zip(names, zip(*rows, strict=True), strict=True)))]
    return None


def _of_objects(path: Path, content: list[dict[str, Any]]) -> list[Sheet]:
    if series := [s for x in content for s in _series(path, x) or _fields(path, x) or ()]:
        return series
    lists = ((k, v) for x in content for k, v in x.items() if isinstance(v, list))
    if not any(named(k) > 0 for x in content for k in x) and (inner := _inner(path, lists)):
        return inner  # InfluxDB: results, each with its series
    tables = [s for x in content if (s := _lists(path, x))]
    if len(tables) == 1 == len(content):
        return tables
    if len(tables) == len(content) and not any(
        named(k) > 0 for x in content for k, v in x.items() if not isinstance(v, list)
    ):
        raise InputError(f"{path}: {len(tables)} objects of lists; one was expected: write a file of each")
    return [of_records(path, content)]


def _rrdtool(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    """Read what rrdtool xport writes: the names and the first time beside rows, with or without times."""
    meta, rows = content.get("meta"), content.get("data")
    if not isinstance(meta, dict) or not {"start", "step", "legend"} <= meta.keys():
        return None
    names = ["time", *meta["legend"]]
    if not isinstance(rows, list) or not all(isinstance(r, list) for r in rows):
        return None
    timed = [
        r if len(r) == len(names) else [meta["start"] + k * meta["step"], *r] for k, r in enumerate(rows)
    ]
    return [of_records(path, [dict(zip(names, r, strict=False)) for r in timed])]


def _thingspeak(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    feeds, titles = content.get("feeds"), content.get("channel", {})
    if not isinstance(feeds, list) or not feeds or not isinstance(titles, dict):
        return None
    names = {k: str(titles.get(k, k)) if k.startswith("field") else k for f in feeds for k in f}
    return [of_records(path, [{names[k]: v for k, v in f.items()} for f in feeds])]


def _fields(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    """Read fields with their values: a schema with records (pandas), or with columns (Grafana)."""
    schema, data = content.get("schema", content), content.get("data")
    fields = schema.get("fields") if isinstance(schema, dict) else None
    if not isinstance(fields, list) or not all(isinstance(f, dict) and "name" in f for f in fields):
        return None
    if isinstance(data, list) and data and all(isinstance(r, dict) for r in data):
        index = {"index": INDEX} if schema.get("primaryKey") == ["index"] else {}
        return [of_records(path, [{index.get(k, k): v for k, v in r.items()} for r in data])]
    columns = data.get("values") if isinstance(data, dict) else [f.get("values") for f in fields]
    if not isinstance(columns, list) or not all(isinstance(c, list) for c in columns):
        return None
    names, units = [], {}
    for field in fields:
        config = field.get("config") or {}
        labels = "_".join(map(str, (field.get("labels") or {}).values()))
        names.append(str(config.get("displayName") or config.get("displayNameFromDS") or field["name"]))
        if names[-1].lower() in WORDS["values"].split() and labels:
            names[-1] = labels
        unit = str(config.get("unit") or "")
        if known(unit := _GRAFANA.get(unit, unit)):
            units[names[-1]] = spelled(unit, names[-1]) or ""
    sheet = of_lists(
        path,
        dict(zip(names, columns, strict=False)),
        name=str(schema.get("name") or schema.get("refId") or ""),
    )
    sheet.units = units
    return [sheet]


def _series(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    """Read names beside rows (InfluxDB 1, pandas), and series of pairs (Prometheus, Grafana)."""
    if isinstance(content.get("target"), str) and isinstance(pairs := content.get("datapoints"), list):
        return [of_records(path, [{"time": v[1], content["target"]: v[0]} for v in pairs])]
    rows = [v for v in content.values() if isinstance(v, list) and v and all(isinstance(r, list) for r in v)]
    values = content.get("values", content.get("data", rows[0] if len(rows) == 1 else None))
    if not isinstance(values, list) or not values or not all(isinstance(v, list) for v in values):
        return None
    if isinstance(labels := content.get("metric"), dict):
        name = "_".join(str(v) for k, v in labels.items() if k not in ("job",)) or "value"
        return [of_records(path, [{"time": v[0], name: v[1]} for v in values])]
    lists = (v for v in content.values() if isinstance(v, list) and len(v) == len(values[0]))
    titles = content.get("columns") or next((v for v in lists if all(isinstance(n, str) for n in v)), None)
    if not isinstance(titles, list):
        return None
    names = ["_".join(map(str, n)) if isinstance(n, list) else str(n) for n in titles]
    index = content.get("index")
    if isinstance(index, list) and len(index) == len(values):
        own = (content.get("index_names") or [None])[0]
        names, values = [own or INDEX, *names], [[i, *v] for i, v in zip(index, values, strict=True)]
    tags = "_".join(map(str, (content.get("tags") or {}).values()))
    return [
        of_records(
            path, [dict(zip(names, v, strict=False)) for v in values], tags or str(content.get("name") or "")
        )
    ]


def _indexed(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    """Read objects of one set of keys: `{"T": {"0.5": 20}}` and `{"0.5": {"T": 20}}` of pandas."""
    inner = list(content.values())
    if not inner or not all(isinstance(v, dict) and v.keys() == inner[0].keys() for v in inner):
        return None
    if any(isinstance(x, dict | list) for v in inner for x in v.values()):
        return None
    if _are_rows(inner[0]) and not (_are_rows(content) and len(content) > len(inner[0])):
        return [of_lists(path, {INDEX: list(inner[0]), **{n: list(v.values()) for n, v in content.items()}})]
    if _are_rows(content):
        return [of_records(path, [{INDEX: k, **v} for k, v in content.items()])]
    return None


def _one_series(path: Path, content: Any) -> list[Sheet] | None:
    """Read `{"0.5": 20, "1.0": 21}`, a series of pandas."""
    if not isinstance(content, dict) or not _are_rows(content):
        return None
    if any(isinstance(v, dict | list) for v in content.values()):
        return None
    return [of_lists(path, {INDEX: list(content), "value": list(content.values())})]


def _are_rows(keys: Iterable[str]) -> bool:
    """Return whether keys count or time rows, as no names of columns do."""
    keys = list(keys)
    return len(keys) > 1 and (all(map(is_number, keys)) or all(map(clock.is_time, keys)))


def _common(first: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the first record of an entity states for all of its records."""
    return {k: v for k, v in first.items() if k in IDS or (k == "attributes" and v)}


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(x, dict) for x in value)


def _websocket(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    """Read a history of Home Assistant's websocket: short keys; the first record has the unit."""
    if not content or not all(_are_records(v) and {"s", "lu"} <= v[0].keys() for v in content.values()):
        return None
    every = [
        {"entity_id": name} | {_SHORT[k]: v for k, v in (records[0] | x).items() if k in _SHORT}
        for name, records in content.items()
        for x in ({k: v for k, v in x.items() if v != {}} for x in records)
    ]
    return [of_records(path, every)]


def _temperature_store(path: Path, content: Mapping[str, Any]) -> list[Sheet] | None:
    """Read Moonraker's temperature store: a list a second for each heater and sensor, the newest last."""
    columns: dict[str, list[Any]] = {}
    for name, held in content.items():
        if isinstance(held, dict) and isinstance(held.get("temperatures"), list):
            for key, unit in (("temperatures", "temperature"), ("targets", "target"), ("powers", "power")):
                if isinstance(held.get(key), list):
                    columns[f"{name}_{unit}"] = held[key]
    if not columns:
        return None
    rows = min(len(c) for c in columns.values())
    sheet = of_lists(path, {n: c[len(c) - rows :] for n, c in columns.items()})
    sheet.units = {n: "degC" for n in columns if not n.endswith("_power")}
    sheet.step_s = 1.0
    return [sheet]
