"""The time axis of a table, by evidence: each column that can be a clock collects points, the most win.

Points come from the kind of its cells (dates, times of day, numbers of an epoch), and from name and unit in
any language. Further points are for a column that increases, and evenly. A counter is the last resort.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.recording.foreign import clock
from thermoctl.recording.foreign.clock import ClockError, Seconds
from thermoctl.recording.foreign.names import COUNTED, NAMED, NO_NAME, is_generic, named, unit_of_time
from thermoctl.recording.foreign.sheet import Cells, Sheet
from thermoctl.recording.foreign.units import known

KINDS = {
    "date and time": 60,
    "date": 30,
    "time of day": 45,
    "duration": 45,
    "epoch": 35,
    "unit": 35,
    "bare": 0,
}
STEP = 50  # points for a column that has the interval stated in the file
FOREIGN = -60  # points for a unit that is not one of time
STRICT, TIES, EVEN, FIRST, JOINED = 25, 5, 8, 4, 6
NEEDED = 30  # least points of a clock
# Least points of a clock that is used though another column holds wrong dates, or is named as another.
SURE = 60
UNLIKE = 0.05  # least relative difference of a stated interval and the recorded times to be a note
COUNTER_NOTE = "a counter, for want of times"
COUNTER = 1.0  # step of a column that counts rows
_FRACTIONS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
# A column without a name is the fraction of whole seconds if it makes the steps' spread EVENER times as
# large, in ENOUGH rows. Real fractions: 0.37. Of 4000 random signals in 20 rows at most 0.1 % do it by
# chance.
EVENER, ENOUGH = 0.5, 20
_ZONES = ("utc", "gmt", "lst", "mst", "mdt", "pst", "pdt", "cst", "cdt", "est", "edt")  # MIDC
_FIELDS = {  # names of the parts of a date that have a column each
    "year": ("year", "yyyy", "yr", "jahr", "annee", "año", "anno"),
    "month": ("month", "mm", "mo", "mon", "monat", "mois", "mes", "mese"),
    "day": ("day", "dd", "dy", "tag", "jour", "dia", "día", "giorno"),
    "doy": ("doy", "julian", "jday", "julday", "day_of_year", "dayofyear", "jd"),
    "hour": ("hour", "hh", "hr", "stunde", "heure", "hora", "ora"),
    "hhmm": ("hhmm", "time", "hourmin", "hour_minute", *_ZONES),
    "minute": ("minute", "min", "mi", "minuto", "minuti"),
    "second": ("second", "ss", "sec", "sekunde", "seconde", "segundo", "secondo"),
}
# Orders and ranges of these parts in the first columns of a table without names, as weather files have them.
_ORDERS = """year doy month day hour minute | year month day hour minute | year month day hour minute second
    | year doy hhmm | doy hhmm | year month day hour"""
_RANGES = {"year": (1900, 2100), "month": (1, 12), "day": (1, 31), "doy": (1, 366), "hour": (0, 24)}
_RANGES |= {"hhmm": (0, 2400), "minute": (0, 60), "second": (0, 60)}


@dataclass(frozen=True)
class Clock:
    """A clock and its columns; `why`: the evidence, for people; `counter`: it counts rows.

    `others`: further columns of times."""

    columns: tuple[str, ...]
    seconds: Seconds
    points: float
    why: str
    counter: bool = False
    others: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """Return how the time was read, for people."""
        read = f"time from {self.where}" + (f": {self.seconds.note}" if self.seconds.note else "")
        others = ", ".join(repr(c.partition("\0")[0]) for c in self.others)
        return (
            f"{read}; other times: {others} (choose with --time COLUMN)"
            if others
            else f"{read} (another: --time COLUMN)"
        )

    @property
    def where(self) -> str:
        """Return the columns' names for people."""
        return " and ".join(map(_shown, self.columns)) or "the rows"

    def plus(self, points: float) -> Clock:
        """Return the clock with further points."""
        return replace(self, points=self.points + points)


def _shown(column: str) -> str:
    name, _, place = column.strip(" ").partition("\0")
    if name:
        return repr(name)
    return f"column {int(place) + 1}" if place else "the first column"


def _run(t: np.ndarray) -> tuple[int, str]:
    """Return points for how evenly a clock increases, and the reason as text."""
    t = t[np.isfinite(t)]
    steps = np.diff(t)
    if not len(steps):
        return 0, "one row"
    if (steps < 0).all():
        return TIES, "decreases"
    back = np.mean(steps < 0)
    if back > 0.02 and np.sum(steps < 0) > 1 or not (steps > 0).any():
        return FOREIGN, "does not increase"
    if not (steps > 0).all():
        return TIES, "increases, with equal or earlier times"
    even = np.median(np.abs(steps - np.median(steps))) <= 0.02 * np.median(steps)
    return STRICT + (EVEN if even else 0), "increases evenly" if even else "increases"


_MINUTES = re.compile(r"(?i)(?<![:\w])m+(?:in\w*)?:s")  # a header such as "Time (min:sec)"


def read(name: str, cells: Cells, unit: str | None, is_time: bool = False) -> Seconds:
    """Return a column as seconds. Raises ClockError for one that cannot be a time.

    `is_time`: see `unit_of_time`."""
    if isinstance(cells, np.ndarray):
        if cells.dtype.kind in "mM":
            return clock.from_stamps(cells)
        there = np.isfinite(cells)
        if not there.any():
            raise ClockError(0, "the time is missing; a finite number or a date was expected")
        if unit is None and (digits := _digits(cells[there])) is not None:
            seconds = clock.from_texts(pa.array(digits))
            t = np.full(len(cells), np.nan)
            t[there] = seconds.t
            return replace(seconds, t=t)
        return clock.from_numbers(cells, unit_of_time(name, unit, is_time), named(name) > 0)
    if pc.all(pc.match_substring_regex(cells, r"^\s*\d{15,20}\s*$")).as_py():
        return _exact(cells)
    minutes = clock.from_minutes(cells) if _MINUTES.search(f"{name} {unit or ''}") else None
    return minutes or clock.from_texts(cells)


def _exact(cells: pa.Array) -> Seconds:
    """Return long whole numbers, which floats would round, as seconds."""
    compact = clock.tidied(cells)
    if pc.all(pc.match_substring(compact, ":")).as_py():
        return clock.from_texts(cells)
    whole = pc.utf8_trim_whitespace(cells).cast(pa.int64()).to_numpy(zero_copy_only=False)
    about = clock.from_numbers(whole.astype(float), None)
    scale = next((e[1] for e in clock.EPOCHS if e[3] <= whole.min() and whole.max() <= e[4]), None)
    return about if scale is None else replace(about, t=(whole - whole[0]) * scale)


def _digits(values: np.ndarray) -> list[str] | None:
    """Return numbers such as 20260301105957 as texts, if all of them are compact dates."""
    if values.min() < 19_000_101 or np.any(values != np.round(values)):
        return None
    low, high = values.min(), values.max()
    for size in (1, 100, 10_000, 1_000_000):
        if 19_000_101 * size <= low and high < 21_000_101 * size:
            texts = [str(int(v)) for v in values.tolist()]
            return (
                texts
                if clock.are_times(pc.binary_join_element_wise(pa.array(texts), "", " ")) or _valid(texts)
                else None
            )
    return None


def _valid(texts: list[str]) -> bool:
    try:
        clock.from_texts(pa.array(texts))
    except ClockError:
        return False
    return True


def candidates(sheet: Sheet, refused: list[ClockError]) -> Iterator[Clock]:
    """Yield every column, and every pair of a date and a time of day, that can be a clock.

    `refused` collects what is wrong with columns of dates that are none."""
    by_column: dict[str, Seconds] = {}
    for name, cells in sheet.columns.items():
        try:
            filled = cells if isinstance(cells, np.ndarray) else pc.fill_null(cells, "")
            by_column[name] = read(name, _complete(filled), sheet.units.get(name))
        except ClockError as e:
            if not isinstance(cells, np.ndarray) or named(name) > 0:
                refused.append(ClockError(e.row, f"column '{name.strip()}': {e.reason}"))
    for position, (name, seconds) in enumerate(by_column.items()):
        yield _judged(sheet, (name,), seconds, position)
    yield from _joined(sheet, by_column)
    if sheet.step_s is not None:
        t = sheet.offset_s + sheet.step_s * np.arange(len(sheet))
        yield Clock(
            (),
            Seconds(t, sheet.start, f"{sheet.step_s:g} s a row, as the file states"),
            STEP,
            "stated interval",
        )


def _complete(cells: Cells) -> Cells:
    """Leave out empty cells at the end: a shorter clock beside a longer one."""
    if isinstance(cells, np.ndarray):
        return cells
    there = pc.not_equal(pc.utf8_trim_whitespace(cells), "").to_numpy(zero_copy_only=False)
    return cells[: int(np.flatnonzero(there)[-1]) + 1 if there.any() else 0]


def _judged(sheet: Sheet, columns: tuple[str, ...], seconds: Seconds, position: int) -> Clock:
    name, unit, kind = columns[0], sheet.units.get(columns[0]), seconds.kind
    seconds = clock.of_one_year(seconds)
    by_name = max(named(c) for c in columns) if len(columns) > 1 else named(name)
    running, runs = _run(seconds.t)
    generic = position == 0 and is_generic(name) and len(sheet.columns) > 1
    steps = np.diff(seconds.t[np.isfinite(seconds.t)])
    counter = kind == "bare" and len(steps) > 0 and bool(np.all(steps == COUNTER))
    with_x = name.strip().lower().startswith("x") and sheet.step_s is None
    counter = counter and (by_name == COUNTED or (generic and not with_x))
    if generic and not counter and not by_name and sheet.step_s is not None:
        by_name = NAMED  # X_Value of LabVIEW, beside a nominal interval
    points = KINDS[kind] + by_name + running + (FIRST if position == 0 else 0)
    why = [kind]
    if by_name:
        why.append(
            f"name '{name.strip()}'" if by_name > 0 else f"'{name.strip()}' names a counter or another time"
        )
    if kind == "bare" and unit is not None and known(unit):
        points += FOREIGN
        why.append(f"unit {unit}")
    if kind == "bare" and by_name <= 0 and not generic:
        points += COUNTED  # the column only increases, as any signal may
    if kind == "bare":
        note = "its unit is assumed: s"
        note = f"{COUNTER_NOTE}; {note} a step" if counter else note
        seconds = replace(seconds, note="; ".join(filter(None, (seconds.note, note))))
    if counter and points > FOREIGN:
        points = NEEDED
    return Clock(columns, seconds, points, f"{', '.join(why)}, {runs}", counter)


def _joined(sheet: Sheet, read: dict[str, Seconds]) -> Iterator[Clock]:
    """Yield clocks of two columns: dates and times of day, or either of them and milliseconds."""
    names = list(sheet.columns)
    dates = [n for n, s in read.items() if s.kind == "date"]
    full = [n for n, s in read.items() if s.kind in ("date and time", "time of day", "epoch")]
    pairs: list[tuple[tuple[str, ...], Seconds]] = [((n,), read[n]) for n in full]
    for date in dates:
        for of_day in names:
            if (joined := _date_and_time(sheet, date, of_day, read)) is not None:
                pairs.append(((date, of_day), joined))
                yield _judged(sheet, (date, of_day), joined, names.index(date)).plus(JOINED)
    for columns, seconds in pairs:
        after = names.index(columns[-1]) + 1
        if after < len(names) and (fraction := _fraction(sheet, names[after], seconds.t)) is not None:
            part, unit = fraction
            t = seconds.t + part - part[0]
            start = clock.later(seconds.start, float(part[0])) if seconds.start else None
            whole = replace(seconds, t=t, start=start, note=seconds.note + f" and {unit}")
            yield _judged(sheet, (*columns, names[after]), whole, names.index(columns[0])).plus(2 * JOINED)
    at = {key: n for n in sheet.columns for key, names in _FIELDS.items() if n.strip().lower() in names}
    if (parts := _of_parts(sheet, at) or _of_first_columns(sheet)) is not None:
        yield _judged(sheet, *parts, 0).plus(2 * JOINED)


def _of_first_columns(sheet: Sheet) -> tuple[tuple[str, ...], Seconds] | None:
    """Return a clock of first columns without names, if they are parts of a date that runs evenly."""
    names = list(filter(NO_NAME.match, sheet.columns))
    for order in map(str.split, _ORDERS.split("|")):
        at = dict(zip(order, names, strict=False))
        if len(at) == len(order) and all(_within(sheet.columns[n], *_RANGES[key]) for key, n in at.items()):
            parts = _of_parts(sheet, at)
            if parts and len(parts[0]) == len(at) and "evenly" in _run(clock.of_one_year(parts[1]).t)[1]:
                return parts
    return None


def _within(cells: Cells, low: float, high: float) -> bool:
    return isinstance(cells, np.ndarray) and bool(np.all((low <= cells) & (cells <= high)))


def _of_parts(sheet: Sheet, at: dict[str, str]) -> tuple[tuple[str, ...], Seconds] | None:
    """Return a clock of columns year, month, day, hour ..., or year, day of the year, hhmm (Campbell)."""
    dated = "doy" in at or {"month", "day"} <= at.keys()
    if not dated or not ("hour" in at or {"year", "hhmm"} <= at.keys() or {"doy", "hhmm"} <= at.keys()):
        return None
    yearless = "year" not in at
    columns = {key: sheet.columns[n] for key, n in at.items()}
    for key, c in columns.items():
        if not isinstance(c, np.ndarray) or not np.isfinite(c).all() or (key != "second" and np.any(c % 1)):
            return None
    whole = {key: c.astype(np.int64) for key, c in columns.items() if key != "second"}
    if yearless:  # a typical year
        whole["year"] = np.full(len(sheet), 2001)
    days = clock.days(whole["year"], whole.get("month", 1), whole["day" if "month" in at else "doy"])
    if "month" in at and "doy" in at and np.any(clock.days(whole["year"], 1, whole["doy"]) != days):
        at = {key: n for key, n in at.items() if key != "doy"}  # a Julian day
    hour, minute = (
        (whole["hhmm"] // 100, whole["hhmm"] % 100)
        if "hhmm" in at
        else (whole["hour"], whole.get("minute", 0))
    )
    if np.all(minute == 60):  # hours that are named by their end (EnergyPlus)
        minute = 0
    t = days * 86_400.0 + hour * 3600.0 + minute * 60.0 + columns.get("second", 0.0)
    start = str(np.datetime64(round(float(t[0]) * 1e3), "ms"))
    used = [key for key in _FIELDS if key in at]
    from_date = "of a year that is not stated" if yearless else f"from {start.replace('T', ' ')}"
    note = f"{', '.join(used)} put together, {from_date}"
    return tuple(at[key] for key in used), Seconds(
        t - t[0], None if yearless else start, note, "date and time"
    )


def _date_and_time(sheet: Sheet, date: str, of_day: str, read: dict[str, Seconds]) -> Seconds | None:
    if of_day == date:
        return None
    days, hours, said = sheet.columns[date], sheet.columns[of_day], ""
    if isinstance(hours, np.ndarray):
        digits = hours[np.isfinite(hours)] if hours.dtype.kind == "f" else np.zeros(0)
        plain = len(digits) == len(hours) > 0 and np.all(digits == np.round(digits)) and digits.min() >= 0
        hourly = of_day.strip().lower() in _FIELDS["hour"]
        unnamed = NO_NAME.match(of_day) and NO_NAME.match(date) and np.any(np.diff(read[date].t) == 0)
        if not plain or digits.max() > 235_959 or not (named(of_day) > 0 or hourly or unnamed):
            return None
        long = digits.max() > 2359 or "hhmmss" in of_day.lower()
        if digits.max() <= 24 and "hhmm" not in of_day.lower():
            digits, long, said = digits * 10_000, True, " and hours of the day"
        hours = pa.array([f"{v:06.0f}" if long else f"{v:04.0f}00" for v in digits.tolist()])
        hours = pc.replace_substring_regex(hours, r"^(\d\d)(\d\d)(\d\d)$", r"\1:\2:\3")
    elif of_day not in read or read[of_day].kind != "time of day":
        return None
    if isinstance(days, np.ndarray):
        if days.dtype.kind == "M":
            days = pa.array(np.datetime_as_string(days, unit="D").tolist())
        else:
            days = pa.array([f"{v:.0f}" for v in days.tolist()])
            days = pc.replace_substring_regex(days, r"^(\d{4})(\d\d)(\d\d)$", r"\1-\2-\3")
    try:
        joined = clock.from_texts(pc.binary_join_element_wise(days, hours, " "))
        if NO_NAME.match(of_day) and "evenly" not in _run(joined.t)[1]:
            return None
        return replace(joined, note=joined.note + said)
    except (ClockError, pa.ArrowInvalid):
        return None


def _fraction(sheet: Sheet, name: str, t: np.ndarray) -> tuple[np.ndarray, str] | None:
    """Return what a column adds to whole seconds t (N,), in seconds (N,), and its unit; None for nothing.

    Its name says milliseconds; or it makes uneven times more even, as milli-, micro- or nanoseconds."""
    values = sheet.columns[name]
    if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or len(values) != len(t) or not len(t):
        return None
    if not np.isfinite(values).all() or values.min() < 0 or np.any(values % 1) or np.any(t % 1):
        return None
    unit = next((u for u, size in _FRACTIONS.items() if values.max() < size), None)
    if unit is None:
        return None
    part = values / _FRACTIONS[unit]
    is_named = unit_of_time(name, sheet.units.get(name)) == "ms" or re.search(
        r"(?i)\bm(illi)?s(ec)?|milli", name
    )
    # A signal that has nothing to do with the time adds its own spread to that of the steps.
    steps, finer = np.diff(t), np.diff(t + part)
    is_even = len(t) >= ENOUGH and finer.min() > 0 and _spread(finer) < EVENER * _spread(steps)
    return (part, unit) if is_even or (is_named and unit == "milliseconds") else None


def _spread(steps: np.ndarray) -> float:
    """Return the mean distance of steps (N,) from their median; a few gaps count little."""
    return float(np.mean(np.abs(steps - np.median(steps))))


def _finest(best: Clock, good: list[Clock]) -> Clock:
    """Return the finest of the clocks that show the same times; it keeps the date of the best one."""
    if best.counter or not best.columns or len(good) < 2:
        return best
    t, size = best.seconds.t - best.seconds.t[0], clock.grain(best.seconds.t)
    same = [
        c
        for c in good
        if not c.counter
        and len(c.seconds.t) == len(t)
        and np.all(np.abs(c.seconds.t - c.seconds.t[0] - t) <= size)
    ]
    finest = min(same, key=lambda c: clock.grain(c.seconds.t), default=best)
    if clock.grain(finest.seconds.t) >= size:
        return best
    if finest.seconds.start or not best.seconds.start:
        return finest
    dated = replace(finest.seconds, t=finest.seconds.t - finest.seconds.t[0], start=best.seconds.start)
    return replace(finest, seconds=dated)


def clocks(sheet: Sheet) -> list[tuple[Clock, list[str]]]:
    """Return the clock of a table with the columns that it times; several where they do not agree.

    Two clocks are two tables in one file: `Time1, CH1, Time2, CH2`. Raises LookupError with the reason if
    there is none. Raises ClockError for a wrong date that only a counter could replace."""
    refused: list[ClockError] = []
    ranked = sorted(candidates(sheet, refused), key=lambda c: -c.points)
    good = [c for c in ranked if c.points >= NEEDED]
    if refused and (not good or good[0].counter or good[0].points < SURE):
        raise refused[0]
    if not good:
        raise LookupError("; ".join(f"'{'+'.join(c.columns)}' {c.why}" for c in ranked[:4]))
    best = next((c for c in good[1:] if not good[0].columns and _says_it(c, good[0])), good[0])
    sheet.notes += _disagreement(best, good)
    others = _rivals(sheet, best, good[1:])
    best = best if others else _finest(best, good)
    names = list(sheet.columns)
    twins = {
        c.columns[0]
        for c in ranked
        if len(c.columns) == 1
        and "\0" in c.columns[0]
        and np.array_equal(c.seconds.t, best.seconds.t, equal_nan=True)
    }
    names = [n for n in names if n not in twins]
    used = {n for c in (best, *others) for n in c.columns} | twins
    further = {c.columns[0] for c in good if len(c.columns) == 1 and c.points >= SURE} - used
    best = replace(best, others=tuple(n for n in names if n in further))
    if not others:
        return [(best, [n for n in names if n not in best.columns])]
    every = sorted((best, *others), key=lambda c: names.index(c.columns[0]))
    begins = [names.index(c.columns[0]) for c in every] + [len(names)]
    chosen = []
    for k, c in enumerate(every):
        mine = names[begins[k] : begins[k + 1]] + (names[: begins[0]] if k == 0 else [])
        chosen.append((c, [n for n in mine if n not in c.columns]))
    return chosen


def _surely_timed(clock: Clock) -> bool:
    """Return whether a column holds times by its name or its cells, and they never run backwards."""
    named_so = clock.seconds.kind != "bare" or any(named(c) > 0 for c in clock.columns)
    steps = np.diff(clock.seconds.t)
    return bool(clock.columns) and named_so and len(steps) > 0 and not (steps < 0).any()


def _disagreement(best: Clock, good: list[Clock]) -> list[str]:
    """Return a note where the interval that a file states is not that of its recorded times.

    Raises ClockError where it would be used though the times drift away from it."""
    stated = next((c for c in good if not c.columns), best)
    timed = [c for c in (best, *good) if _surely_timed(c)]
    if stated.columns or not timed:
        return []
    t, even = timed[0].seconds.t, stated.seconds.t[: len(timed[0].seconds.t)]
    steps, step = np.diff(t), even[1] - even[0]
    away = float(np.nanmax(np.abs((t - t[0]) - (even - even[0]))))
    says = f"the file states {step:g} s a row; its times in {timed[0].where} differ by up to {away:.3g} s"
    if best.columns:
        return [says + "; they are used"] if abs(np.nanmedian(steps) - step) > UNLIKE * step else []
    if away > 2 * max(step, float(np.nanmax(steps))):  # more than rounded times do
        option = timed[0].columns[0].partition("\0")[0]
        raise ClockError(0, f"{says}; say --time {option!r}, or --time {step:g}s for even rows")
    return [says]


def _says_it(clock: Clock, stated: Clock) -> bool:
    """Return whether a column of times has the interval that the file states."""
    t, other = clock.seconds.t, stated.seconds.t
    same = len(t) == len(other) and np.allclose(t - t[0], other - other[0], rtol=1e-6, atol=0.0)
    return bool(same) and not clock.counter


def _stem(name: str) -> str:
    return re.sub(r"[\d_\s.\0]+", "", name).lower()


def _rivals(sheet: Sheet, best: Clock, others: list[Clock]) -> list[Clock]:
    """Return other clocks whose names differ only by a number, and whose times and columns differ."""
    names = list(sheet.columns)
    taken = set(best.columns)
    times = {n for c in (best, *others) for n in c.columns}
    followed = {n for n, after in pairwise(names) if after not in times}
    rivals: list[Clock] = []
    if not taken & followed:
        return rivals
    for other in others:
        (name, *more) = other.columns or ("",)
        if more or not name or taken & {name} or other.counter:
            continue
        same_name = _stem(name) == _stem(best.columns[0]) if best.columns else False
        n = min(len(other.seconds.t), len(best.seconds.t))
        same = np.array_equal(other.seconds.t[:n], best.seconds.t[:n], equal_nan=True)
        same = same and other.seconds.start == best.seconds.start
        if same_name and other.seconds.kind == best.seconds.kind and name in followed and not same:
            rivals.append(other)
            taken.add(name)
    return rivals
