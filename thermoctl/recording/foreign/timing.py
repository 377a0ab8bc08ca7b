"""From sheets of cells to one table: numbers, the clock of each sheet, one run, times that differ."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.foreign import axis, cells, clock
from thermoctl.recording.foreign.axis import Clock
from thermoctl.recording.foreign.cells import CellError
from thermoctl.recording.foreign.clock import ClockError, Seconds
from thermoctl.recording.foreign.sheet import How, Sheet
from thermoctl.recording.foreign.units import column_of, interval, known, named, states_unit_of, tokens
from thermoctl.recording.table import Table, exact

_ADVICE = "name it with --time COLUMN, or say the time from row to row, such as --time 0.1s"
MIXED = "times in UTC beside times of a zone that is not stated; write all of them in UTC"
_SINCE = re.compile(r", from \d{4}-\d\d-\d\d [\d:.]+( UTC)?")


def table_of(path: Path, sheets: Sequence[Sheet], how: How, notes: Sequence[str]) -> Table:
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
    words: dict[str, str] = {}
    for sheet in sheets:
        try:
            values = _valued(path, sheet, how)
        except CellError as e:
            raise InputError(f"{sheet.place(e.row)}: {e.reason}") from None
        parts += _timed(path, values, how)
        words |= values.left
        later += values.notes
    if not parts:
        lost = f" ({'; '.join(notes)})" if notes else ""
        raise InputError(f"{path}: no channels with a time; at least one was expected{lost}")
    table = parts[0] if len(parts) == 1 else _united(path, parts)
    if not table.columns:
        text = ", ".join(f"{n} ('{word[:40]}')" for n, word in words.items())
        raise InputError(f"{path}: no column of numbers beside the time; columns of text: {text or 'none'}")
    if not len(table):
        raise InputError(f"{path}: no rows; at least one sample was expected")
    if empty := [n for n, v in table.columns.items() if not np.isfinite(v).any()]:
        formulas = " (formulas without results? save the file in Excel)" if path.suffix[:4] == ".xls" else ""
        later.append(f"no value at all: {', '.join(empty)}{formulas}")
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
    for name, column in sheet.columns.items():
        if isinstance(column, np.ndarray):
            _put(valued, name, cells.Numbers(_without(column, how.missing)))
            continue
        try:
            values = _of_texts(name.partition("\0")[0], column, decimal, how.missing, valued.notes)
        except CellError as e:
            raise CellError(e.row, f"column '{name.partition(chr(0))[0]}': {e.reason}") from None
        if isinstance(values, cells.Numbers):
            _put(valued, name, replace(values, values=_without(values.values, how.missing)))
        elif values is not None:
            valued.columns[name] = values
        else:
            valued.left[name] = next((w for w in column.to_pylist() if w and w.strip()), "")
    _take_units(sheet, valued)
    left = [_plain(n) or f"column {list(sheet.columns).index(n) + 1}" for n in valued.left]
    if left:
        valued.notes.append(f"columns of text left out: {', '.join(left)}")
    return valued


def _put(valued: Sheet, name: str, found: cells.Numbers) -> None:
    """Put a column of numbers into the sheet. Raises CellError for a unit unlike its header's."""
    stated = valued.units.get(name)
    if found.unit and stated and stated != found.unit:
        raise CellError(
            0, f"column '{name}': its header says {stated}, its cells {found.unit}; one unit was expected"
        )
    valued.notes += found.notes
    valued.columns[name] = cells.readings(_plain(name), found.values, valued.notes)
    if found.unit:
        valued.units[name] = found.unit


def _take_units(sheet: Sheet, valued: Sheet) -> None:
    """Bring each column that a column of units follows to the unit of its first row. Raises CellError.

    A multimeter that changes its range writes `999.8, mV` and `1.0002, V`. Behind a time alone, the units
    are those of the column that follows them: `10:00:00, C, 20.5`."""
    names = list(sheet.columns)
    for k, name in enumerate(names):
        near = [
            n for n in (*names[:k][-1:], *names[k + 1 : k + 2]) if states_unit_of(_plain(name), _plain(n))
        ] or ([] if _plain(name) else names[:k][-1:])
        before = next((n for n in near if _is_numbers(valued.columns.get(n))), None)
        if name not in valued.left or before is None or {*names[:k][-1:]} & valued.left.keys():
            continue
        values = valued.columns[before]
        texts = pc.utf8_trim_whitespace(pc.fill_null(sheet.columns[name], ""))
        texts = pc.replace_substring_regex(texts, r"\s*(?:AC|DC)\s*", "")
        words = [w for w in pc.unique(texts).to_pylist() if w]
        if all(map(known, words)) and (_plain(name) or len(words) == 1):
            del valued.left[name]
            _put(valued, before, cells.with_units(_plain(before), values, texts, ~np.isfinite(values), ()))
        elif len(words) > 1 and _plain(name):
            row = pc.index(texts, words[1]).as_py()
            raise CellError(
                row,
                f"column '{_plain(name)}': '{words[1]}' after '{words[0]}': one unit was expected, or units that are known "
                f"(convert '{_plain(before)}' to one)",
            )


def _is_numbers(cells: Any) -> bool:
    return isinstance(cells, np.ndarray) and cells.dtype.kind == "f"


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
    if share >= 0.5 and not all(cells.is_number(t) for t in filled.filter(pa.array(~right)).to_pylist()[:1]):
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
    final, said = _final_names(path, sheet, [n for _, names in several for n in names])
    for timer, names in several:
        _refuse_lost(sheet, timer)
        timer = replace(timer, seconds=clock.summer_time(timer.seconds))
        t = np.full(len(sheet), np.nan)
        t[: len(timer.seconds.t)] = timer.seconds.t
        values: dict[str, np.ndarray] = {}
        notes = [
            _clock_note(timer, how),
            clock.set_in_between(timer.seconds),
            clock.rounding(timer.seconds.t),
            *said,
        ]
        for name in names:
            column = sheet.columns[name]
            if not isinstance(column, np.ndarray) or column.dtype.kind != "f":
                if name not in timer.others:
                    notes.append(f"another time left out: {_plain(name)}")
            elif name in final:
                values[final[name]] = column
        t, values = _rows(path, sheet, t, values, len(several) > 1, how, notes)
        units = {final[n]: u for n, u in sheet.units.items() if final.get(n) in values}
        start = timer.seconds.start or sheet.start
        if timer.seconds.start and len(t) and t[0] != 0:
            start, t = clock.later(timer.seconds.start, float(t[0])), t - t[0]
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
        if named(name) > 0 and any(c.isdigit() for c in word):
            what = "counter" if counter.counter else "column"
            raise InputError(
                f"{sheet.place(0)}: column '{name}': '{word.strip()}' is no time in a form that is known, and the only other "
                f"clock is the {what} {counter.where}; name that with --time, or write the times in seconds"
            )


def _plain_time(name: str) -> bool:
    """Return whether a name is a time and nothing else, such as `t`, `Time` or `Zeit`."""
    return named(name) > 0 and len(tokens(name)) == 1


def _plain(name: str) -> str:
    """Return the name of a column as the header has it; several columns can have it."""
    return name.partition("\0")[0].strip()


def _final_names(path: Path, sheet: Sheet, used: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return the names in the table of the used columns, and notes.

    A doubled name gets a number, a missing one its place.

    Left out are an index without a name, and empty columns whose name is missing or doubled.
    Raises InputError for a second time of one name."""
    every = list(sheet.columns)
    alike: dict[str, list[str]] = {}
    for name in used:
        column = sheet.columns[name]
        empty = isinstance(column, np.ndarray) and column.dtype.kind == "f" and not np.isfinite(column).any()
        if name != " " and not ("\0" in name and empty):
            alike.setdefault(_plain(name), []).append(name)
    final: dict[str, str] = {}
    notes = []
    for plain, names in alike.items():
        another_time = "\0" in names[-1] and named(plain) > 0  # nobody knows which columns it times
        if len(names) == 1 and plain and not another_time:
            final[names[0]] = plain
            continue
        new = {
            n: f"{plain}_{k + 1}" if plain else f"column_{every.index(n) + 1}" for k, n in enumerate(names)
        }
        if another_time or set(new.values()) & alike.keys():
            raise InputError(f"{sheet.place(0)}: the column '{plain}' stands twice in the header; rename one")
        final |= new
        what = f"'{plain}' stands {len(names)} times in the header" if plain else "columns without a name"
        notes.append(f"{what}: called {', '.join(new.values())}")
    return final, notes


def _clock_note(timer: Clock, how: How) -> str:
    plain = timer.columns == ("t",) or timer.columns == ("t_s",)
    if how.time is not None or not timer.why or (plain and timer.seconds.kind in ("unit", "bare")):
        return "" if timer.seconds.kind in ("unit", "bare") and not how.time else timer.seconds.note
    return timer.note


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
        base = re.sub(r"(?i)\s*[\[(](?:mm:ss|hh:mm)[\])]$", "", how.time)
        chosen = column_of(how.time, sheet.columns, sheet.units) or column_of(
            base, sheet.columns, sheet.units
        )
        if chosen is None and (step := interval(how.time)):
            t = step * np.arange(len(sheet))
            note = f"{step:g} s from row to row, as --time says"
            return [(Clock((), Seconds(t, sheet.start, note, "unit"), 0, ""), names)]
        if chosen is None:
            given = [n for n in names if n.strip() and "\0" not in n]
            raise InputError(
                f"{path}: no column '{how.time}'{suggest(how.time, given)}; the columns are {', '.join(given)}; {_ADVICE}"
            )
        try:
            seconds = axis.chosen(how.time, sheet.columns[chosen], sheet.units.get(chosen))
        except ClockError as e:
            raise InputError(f"{sheet.place(e.row)}: column '{chosen}': {e.reason}") from None
        return [(Clock((chosen,), seconds, 0, ""), [n for n in names if n != chosen])]
    try:
        return axis.clocks(sheet)
    except ClockError as e:
        raise InputError(f"{sheet.place(e.row)}: {e.reason}") from None
    except LookupError as e:
        shown = ", ".join(n for n in names if n.strip() and "\0" not in n)
        texts = [
            f"'{_plain(n)}': '{w.strip()[:40]}'"
            for n, w in sheet.left.items()
            if sum(map(str.isdigit, w)) > 3 or named(n) > 0
        ]
        unread = f"; no time in a form that is known: {', '.join(texts)}" if texts else ""
        raise InputError(
            f"{path}: no column 't' (time in seconds) and no other that is a time for sure ({e}{unread}); the columns are {shown}; "
            f"{_ADVICE}"
        ) from None


def _rows(
    path: Path,
    sheet: Sheet,
    t: np.ndarray,
    values: dict[str, np.ndarray],
    several: bool,
    how: How,
    notes: list[str],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
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
    return t, values


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
    hour = (
        " by an hour (daylight saving?)" if abs(jump + usual - clock.HOUR_S) <= max(1.5 * usual, 1.0) else ""
    )
    raise InputError(
        f"{sheet.place(row)}: the time {exact(t[row])} runs backwards from {exact(t[before])}{hour}: {len(parts)} runs in one "
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
            f"{sheet.place(int(rows[row]))}: the time {exact(t[row])} stands twice; strictly increasing seconds were expected "
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
    if len({s.endswith("Z") for s in starts if s}) > 1:
        raise InputError(f"{path}: {MIXED}")
    if all(starts):
        offsets = clock.offsets(list(map(str, starts)))
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
