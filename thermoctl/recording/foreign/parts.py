"""Times that stand in several columns: a date and a time of day, parts of a date, fractions of seconds."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.recording.foreign import clock
from thermoctl.recording.foreign.clock import ClockError, Seconds
from thermoctl.recording.foreign.sheet import Cells, Sheet
from thermoctl.recording.foreign.units import NO_NAME, named, unit_of_time

_FRACTIONS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_FRACTION_NAMES = {  # unit of a column, and words of its name
    "milliseconds": ("ms", re.compile(r"(?i)\bm(illi)?s(ec)?|milli")),
    "microseconds": ("us", re.compile(r"(?i)(\b|_)(micro|[uµ])s(ec(ond)?s?)?$")),
    "nanoseconds": ("ns", re.compile(r"(?i)(\b|_)n(ano)?s(ec(ond)?s?)?$")),
}
# A column without a name is the fraction of whole seconds if it makes the steps' spread EVENER times as
# large, in ENOUGH rows. Real fractions: 0.37. Of 4000 random signals in 20 rows at most 0.1 % do it by
# chance.
EVENER, ENOUGH = 0.5, 20
# Names of numbers that count from a start, as do those with a unit, and of digits such as hhmm.
_COUNTS, _OF_DAY = re.compile(r"(?i)elapsed|run|lauf|uptime|since|seit"), re.compile(r"(?i)hour|hh|uhr")
_ZONES = ("utc", "gmt", "lst", "mst", "mdt", "pst", "pdt", "cst", "cdt", "est", "edt")  # MIDC
_FIELDS = {  # names of the parts of a date that have a column each
    "year": ("year", "yyyy", "yy", "yr", "jahr", "annee", "año", "anno"),
    "month": ("month", "mm", "mo", "mon", "monat", "mois", "mes", "mese"),
    "day": ("day", "dd", "dy", "tag", "jour", "dia", "día", "giorno"),
    "doy": ("doy", "julian", "jday", "julday", "day_of_year", "dayofyear", "jd"),
    "hour": ("hour", "hh", "hr", "stunde", "heure", "hora", "ora"),
    "hhmm": ("hhmm", "time", "hourmin", "hour_minute", *_ZONES),
    "minute": ("minute", "min", "mi", "mn", "minuto", "minuti"),
    "second": ("second", "ss", "sec", "sekunde", "seconde", "segundo", "secondo"),
}
# Orders and ranges of these parts in the first columns of a table without names, as weather files have them.
_ORDERS = """year doy month day hour minute | year month day hour minute | year month day hour minute second
    | year doy hhmm | doy hhmm | year month day hour"""
_RANGES = {"year": (1900, 2100), "month": (1, 12), "day": (1, 31), "doy": (1, 366), "hour": (0, 24)}
_RANGES |= {"hhmm": (0, 2400), "minute": (0, 60), "second": (0, 60)}


def joined(sheet: Sheet, read: dict[str, Seconds]) -> Iterator[tuple[tuple[str, ...], Seconds, int]]:
    """Yield columns, their times, and how many kinds of evidence join them.

    They are dates and times of day, either of them and milliseconds, or parts of a date. `read`: columns
    that are times alone."""
    names = list(sheet.columns)
    dates = [n for n, s in read.items() if s.kind == "date"]
    full = [n for n, s in read.items() if s.kind in ("date and time", "time of day", "epoch")]
    pairs: list[tuple[tuple[str, ...], Seconds]] = [((n,), read[n]) for n in full]
    for date in dates:
        for of_day in names:
            if (both := _date_and_time(sheet, date, of_day, read)) is not None:
                pairs.append(((date, of_day), both))
                yield (date, of_day), both, 1
    for columns, seconds in pairs:
        after = names.index(columns[-1]) + 1
        if after < len(names) and (fraction := _fraction(sheet, names[after], seconds.t)) is not None:
            part, unit = fraction
            t = seconds.t + part - part[0]
            start = clock.later(seconds.start, float(part[0])) if seconds.start else None
            whole = replace(seconds, t=t, start=start, note=seconds.note + f" and {unit}")
            yield (*columns, names[after]), whole, 2
    at = _named_parts(sheet)
    if (parts := _of_parts(sheet, at) or _of_first_columns(sheet)) is not None:
        yield *parts, 2
    elif (hms := _of_day(sheet, at)) is not None:
        used, since = hms
        t = since + clock.DAY_S * np.concatenate([[0], np.cumsum(np.diff(since) < -clock.DAY_S / 2)])
        note = "hour, minute and second put together"
        yield used, Seconds(t - t[0], None, note, "time of day"), 2
        for date in dates:
            t = read[date].t + since
            start = clock.later(str(read[date].start), float(t[0]))
            yield (date, *used), Seconds(t - t[0], start, f"{read[date].note}; {note}", "date and time"), 2


def _named_parts(sheet: Sheet) -> dict[str, str]:
    """Return the columns that are parts of a date or time, by part; `mm` behind an hour is its minute."""
    at: dict[str, str] = {}
    for n in sheet.columns:
        word = n.strip().lower()
        keys = [key for key, names in _FIELDS.items() if word in names]
        at |= dict.fromkeys(["minute"] if word == "mm" and "hour" in at else keys, n)
    return at


def _of_day(sheet: Sheet, at: dict[str, str]) -> tuple[tuple[str, ...], np.ndarray] | None:
    """Return columns hour, minute and perhaps second, and their seconds of the day (N,)."""
    used = [key for key in ("hour", "minute", "second") if key in at]
    whole = all(_within(sheet.columns[at[k]], *_RANGES[k]) for k in used)
    if used[:2] != ["hour", "minute"] or not whole or {"month", "day", "doy"} & at.keys():
        return None
    since = np.zeros(len(sheet))
    for key, seconds in zip(used, (clock.HOUR_S, 60.0, 1.0), strict=False):
        if key != "second" and np.any(sheet.columns[at[key]] % 1):
            return None
        since += sheet.columns[at[key]] * seconds
    return tuple(at[key] for key in used), since


def _of_first_columns(sheet: Sheet) -> tuple[tuple[str, ...], Seconds] | None:
    """Return a clock of first columns without names, if they are parts of a date that runs evenly."""
    names = list(filter(NO_NAME.match, sheet.columns))
    names = [n for k, n in enumerate(names) if n == f"column_{k + int(names[0][7:])}"]  # none behind a word
    for order in map(str.split, _ORDERS.split("|")):
        at = dict(zip(order, names, strict=False))
        if len(at) == len(order) and all(_within(sheet.columns[n], *_RANGES[key]) for key, n in at.items()):
            parts = _of_parts(sheet, at)
            if parts and len(parts[0]) == len(at) and clock.is_even(clock.of_one_year(parts[1]).t):
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
    if "year" in whole and whole["year"].max() < 100:
        whole["year"] += 2000
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
        counts = _COUNTS.search(of_day) or unit_of_time(of_day, sheet.units.get(of_day)) not in (None, "h")
        counts = counts and not _OF_DAY.search(of_day)
        hourly = of_day.strip().lower() in _FIELDS["hour"]
        unnamed = NO_NAME.match(of_day) and NO_NAME.match(date) and np.any(np.diff(read[date].t) == 0)
        if counts or not plain or digits.max() > 235_959 or not (named(of_day) > 0 or hourly or unnamed):
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
    days = pc.replace_substring_regex(days, r"[T ]0?0:00.*$", "")  # the midnight of Excel and of databases
    try:
        joined = clock.from_texts(pc.binary_join_element_wise(days, hours, " "))
        if NO_NAME.match(of_day) and not clock.is_even(joined.t):
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
    if not np.isfinite(values).all() or values.min() < 0 or np.any(t % 1):
        return None
    if "fraction" in name.lower() and values.max() < 1:  # `Fractional Seconds` of Keithley
        return values, "fractions of seconds"
    if np.any(values % 1):
        return None
    stated = unit_of_time(name, sheet.units.get(name))
    is_named = [u for u, (short, words) in _FRACTION_NAMES.items() if stated == short or words.search(name)]
    unit = next((u for u in is_named or _FRACTIONS if values.max() < _FRACTIONS[u]), None)
    if unit is None:
        return None
    part = values / _FRACTIONS[unit]
    # A signal that has nothing to do with the time adds its own spread to that of the steps.
    steps, finer = np.diff(t), np.diff(t + part)
    is_even = len(t) >= ENOUGH and finer.min() > 0 and _spread(finer) < EVENER * _spread(steps)
    return (part, unit) if is_even or is_named else None


def _spread(steps: np.ndarray) -> float:
    """Return the mean distance of steps (N,) from their median; a few gaps count little."""
    return float(np.mean(np.abs(steps - np.median(steps))))
