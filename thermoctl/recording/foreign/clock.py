"""Times as loggers write them, in seconds: dates, times of day, durations, counts from an epoch."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.units import SECONDS

DAY_NS = 86_400_000_000_000
DAY_S = 86_400.0
HOUR_S = 3600.0
YEAR_S = 365.2425 * DAY_S
_MONTHS = dict(jan=1, feb=2, mar=3, apr=4, may=5, jun=6, jul=7, aug=8, sep=9, oct=10, nov=11, dec=12)
_MONTHS |= dict(
    mär=3, mrz=3, mai=5, okt=10, dez=12, fév=2, fev=2, avr=4, jui=6, aoû=8, déc=12, ene=1, abr=4, ago=8
)
_MONTHS |= dict(dic=12, gen=1, mag=5, giu=6, lug=7, set=9, ott=10, maj=5, mrt=3, mei=5, juin=6, juil=7, aug=8)
_ZONES = dict(z=0, utc=0, gmt=0, wet=0, west=1, bst=1, cet=1, cest=2, mez=1, mesz=2, eet=2, eest=3, msk=3)
_ZONES |= dict(est=-5, edt=-4, cdt=-5, mst=-7, mdt=-6, pst=-8, pdt=-7, jst=9, kst=9, aest=10, aedt=11)
# A letter of any alphabet; Arrow needs milliseconds to compile \pL.
_LETTER = r"[^\x00-\x40\x5B-\x60\x7B-\x7F]"
_DATE = r"(?P<a>\d{1,4})[-/.](?P<b>\d{1,2}|{L}{3,4})[-/.](?P<c>\d{1,4})".replace("{L}", _LETTER)
_CLOCK = (
    r"(?P<h>\d{1,4}):(?P<m>\d{2})(?::(?P<s>\d{2})(?:[.,:;](?P<f>\d{1,9})\d*)?)?\s*(?P<p>[AaPp][Mm])?"
    r"\s*(?P<z>[+-]\d{2}:?\d{2}|[A-Za-z]{1,4})?"
)
_PATTERN = rf"^(?:{_DATE}(?:[T ,;]\s*|$))?(?:{_CLOCK})?$"
# Replacements of other spellings, before the pattern is tried: (expression, replacement).
_SPELLINGS = tuple(
    (pattern.replace("{L}", _LETTER), by)
    for pattern, by in (
        ("[\u00a0\u2009\u202f]", " "),
        (r"(\d{4})\s\([A-Z][\w ]+\)$", r"\1"),  # GMT+0100 (Central European Time) of JavaScript
        (r"\s?\[?[A-Z][a-z]+/[A-Z]\w+(?:/\w+)?\]?$", ""),  # a region's name, with Java behind the offset
        (r"^(\d{4})\. ?(\d{1,2})\. ?(\d{1,2})\. ", r"\1-\2-\3 "),  # Hungary, Korea
        (r"^(\d\S*\d),? (?:klo )?(\d{1,2})\.(\d{2})\.(\d{2})", r"\1 \2:\3:\4"),  # Italy, Denmark, Finland
        (r"^(\d\S*\d),? (?:klo )?(\d{1,2})\.(\d{2})$", r"\1 \2:\3"),
        (r"^(?:(?i:mon|tue|wed|thu|fri|sat|sun|mo|di|mi|do|fr|sa|so){L}*\.?,?\s+)(\d|{L})", r"\1"),
        (r"^(\d\S*[T ]\d{1,2}:\d{2}(?::[\d.]+)?Z?)(?:/| - )\d.*$", r"\1"),  # from one time to another
        (r"([ap])\.\s?m\.", r"\1m"),
        (r"(?:上午|午前|오전)\s*(\d[\d:.]*)", r"\1 AM"),
        (r"(^|\s)([AaPp][Mm])\s*(\d[\d:.]*)$", r"\1\3 \2"),
        (r"(?:下午|午後|오후)\s*(\d[\d:.]*)", r"\1 PM"),
        (r"^(\d{1,2}:\d{2}\S*(?: [AaPp][Mm])?),? (\d{1,4}[-/.](?:\d{1,2}|{L}{3,})[-/.]\d{2,4})$", r"\2 \1"),
        (r"^({L}{3}){L}*\.?\s+(\d{1,2})\s+(\d{1,2}:\d{2}:\d{2}\S*)\s+(\d{4})$", r"\2-\1-\4 \3"),
        (r"^({L}{3}){L}*\.?\s+(\d{1,2}),?\s+(\d{4})", r"\2-\1-\3"),
        (r"^(\d{1,2})\.?[ -]({L}{3}){L}*\.?,?[ -](\d{2,4})([ ,T]|$)", r"\1-\2-\3\4"),
        (r"^(\d{4})年(\d{1,2})月(\d{1,2})日", r"\1-\2-\3"),
        (r"^((?:19|20)\d{2})(\d{2})(\d{2})$", r"\1-\2-\3"),
        (r"^((?:19|20)\d{2})(\d{2})(\d{2})[T _:-]?(\d{2})$", r"\1-\2-\3 \4:00"),
        (r"^((?:19|20)\d{2})(\d{2})(\d{2})[T _:-]?(\d{2})(\d{2})$", r"\1-\2-\3 \4:\5"),
        (
            r"^((?:19|20)\d{2})(\d{2})(\d{2})[T _-]?(\d{2})(\d{2})(\d{2})[.,]?(\d*)(Z?)$",
            r"\1-\2-\3 \4:\5:\6.\7\8",
        ),
        (r"^(\d{4}-\d{2}-\d{2})[_T -](\d{2})[-.](\d{2})[-.](\d{2})(?:[-.](\d+))?$", r"\1 \2:\3:\4.\5"),
        (r"^(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[-_:](\d{1,2}:\d{2})", r"\1 \2"),
        (r"^(\d{4}:\d{2}:\d{2}) (\d)", r"\1T\2"),
        (r"\.(Z?)$", r"\1"),
        (r"^(\d{1,2})/(\d{1,2})\s+(\d{1,2}:\d{2}:\d{2})$", r"1900-\1-\2 \3"),  # EnergyPlus states no year
        (r"^(\d{1,2})\.(\d{1,2})\.\s+(\d{1,2}:\d{2}(?::\d{2})?)$", r"1900-\2-\1 \3"),
        (r"^(\d{1,4})[. ](\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?)$", r"\1d \2"),  # .NET, Hioki
        (r"(^|[^\d:])(\d{1,4}):(\d):(\d)", r"\1\2:0\3:\4"),  # 9:5:3 of an Arduino
        (r"(^|[^\d:])(\d{1,4}:\d{2}):(\d)($|\D)", r"\1\2:0\3\4"),
        (r"^(\d{1,3}):(\d{2})([.,]\d+)$", r"0:\1:\2\3"),
        (r"\s*\(?(?:GMT|UTC)([+-])(\d)(?::?(\d{2}))?\)?$", r"\g<1>0\2:\3"),
        (r"\s*\(?(?:GMT|UTC)([+-])(\d{2}):?(\d{2})?\)?$", r"\1\2:\3"),
        (r"([+-]\d{2}):?$", r"\1"),
        (r"(:\d{2}(?:[.,]\d+)?\s?)([+-]\d{2})$", r"\g<1>\2:00"),
    )
)
# Names that tell hours from minutes.
_TOLD = re.compile(r"(?i)m+(?:in\w*)?:s|h+(?:ours?|rs?)?:m|uhr|of.?day|local|utc|gmt")
_DURATION = r"^(?P<sign>-)?(?P<d>\d+) ?d(?:ays?)?,? *(?P<rest>\d{1,2}:\d{2}.*)$"
# PT1M30S of ISO 8601, `1h 2m`, 2m30s: two parts, as 5m may be a length.
_PARTS = (
    r"^P?(?:(?P<d>\d+)\s?[Dd][a-z]*)?[T,\s]*(?:(?P<h>\d+)\s?[Hh][a-z]*)?[,\s]*(?:(?P<m>\d+)\s?(?:M|m|[Mm]in[a-z]*))?"
    r"[,\s]*(?:(?P<s>\d+(?:\.\d+)?)\s?[Ss][a-z]*)?$"
)
_PARTED = r"^P[T\d].*[A-Z]$|^\d+\s?[DdHhMm][a-z]*[,\s]*\d"
_MAYBE = re.compile(r"\d\D+\d|\d\D*[^\W\d_]{3}|[^\W\d_]{3}\W*\d")
_ONE_SPELLINGS = tuple((re.compile(p), by) for p, by in _SPELLINGS)
_ONE_TIME, _ONE_DURATION = re.compile(_PATTERN), re.compile(_DURATION)
_ONE_PARTS, _ONE_PARTED = re.compile(_PARTS), re.compile(_PARTED)
# A number's epoch: name, seconds of a count, its zero in seconds since 1970, least and largest count.
_1904, _1601, _1899 = -2_082_844_800.0, -11_644_473_600.0, -2_209_161_600.0
EPOCHS = (
    ("unix s", 1.0, 0.0, 9e8, 3.2e9),
    ("unix ms", 1e-3, 0.0, 9e11, 3.2e12),
    ("unix us", 1e-6, 0.0, 9e14, 3.2e15),
    ("unix 100 ns", 1e-7, 0.0, 9e15, 3.2e16),
    ("unix ns", 1e-9, 0.0, 9e17, 3.2e18),
    ("s since 1904", 1.0, _1904, 3.2e9, 4.2e9),
    ("ms since 1904", 1e-3, _1904, 3.2e12, 4.2e12),
    ("100 ns since 1601", 1e-7, _1601, 1.2e17, 1.7e17),
    ("100 ns since the year 1", 1e-7, -62_135_596_800.0, 6.2e17, 6.8e17),
    ("days since 1900 (Excel)", DAY_S, _1899, 36_526.0, 73_050.0),
    ("days since the year 0 (MATLAB)", DAY_S, -719_529.0 * DAY_S, 730_486.0, 767_011.0),
    ("millionths of a day since 1900 (WinCC)", DAY_S / 1e6, _1899, 3.6e10, 7.3e10),
    ("modified Julian days", DAY_S, -40_587.0 * DAY_S, 15_020.0, 88_070.0),
    ("Julian days", DAY_S, -2_440_587.5 * DAY_S, 2_451_544.0, 2_488_070.0),
)
YEARS = 20, 39  # range of two digits that are a year rather than a day
LATE = 0.05  # a clock that nobody has set yet counts from 1970; three years of it are this share of 1998
LONG = 1e8  # least count since an epoch: hardly any signal has so large numbers


class ClockError(Exception):
    """A time that cannot be read: the row, from 0, and the reason."""

    def __init__(self, row: int, reason: str):
        super().__init__(reason)
        self.row, self.reason = row, reason


@dataclass(frozen=True)
class Seconds:
    """`t` (N,) in seconds; `start`: the date of t = 0 where it is known; `note`: how the times were read.

    `kind`: date and time, date, time of day, duration, epoch, unit, or bare (a number without a unit)."""

    t: np.ndarray
    start: str | None = None
    note: str = ""
    kind: str = "bare"


def summer_time(seconds: Seconds) -> Seconds:
    """Return local times going on evenly over a change to or from daylight saving, with a note.

    Such a change is an hour on a Sunday of spring or autumn before 4 o'clock."""
    if seconds.kind != "date and time" or seconds.start is None or seconds.start.endswith("Z"):
        return seconds
    steps = np.diff(seconds.t)
    usual = float(np.median(np.abs(steps))) if len(steps) else 0.0
    t, notes = seconds.t.copy(), [seconds.note]
    near = max(0.1 * min(usual, HOUR_S), 1.0)
    for k in np.flatnonzero(np.abs(np.abs(steps - usual) - HOUR_S) <= near):
        before = later(seconds.start, float(seconds.t[k]))
        day = np.datetime64(before[:10])
        sunday = int(day.astype(int) - 3) % 7 == 0  # 1970-01-04 was one
        if sunday and int(before[5:7]) in (3, 4, 9, 10, 11) and int(before[11:13]) < 4:
            hour = HOUR_S if steps[k] < usual else -HOUR_S
            t[k + 1 :] += hour
            notes.append(f"daylight saving after {before[:19].replace('T', ' ')}: later times {hour:+g} s")
    return replace(seconds, t=t, note="; ".join(notes))


def set_in_between(seconds: Seconds) -> str:
    """Return a note where dates leap by years: a clock without a battery begins in 1970 or 2000."""
    steps = np.diff(seconds.t)
    if seconds.start is None or not len(steps) or not steps.max() > max(YEAR_S, 1e4 * np.median(steps)):
        return ""
    k = int(np.argmax(steps))
    before, after = (later(seconds.start, float(seconds.t[i])).replace("T", " ")[:19] for i in (k, k + 1))
    return f"the dates leap from {before} to {after}: was the clock set then? The earlier ones are doubtful"


def later(start: str, seconds: float) -> str:
    """Return a date some seconds later."""
    date = np.datetime64(start.rstrip("Z"), "ms") + np.timedelta64(round(seconds * 1e3), "ms")
    return f"{date}Z" if start.endswith("Z") else str(date)


def offsets(starts: Sequence[str]) -> np.ndarray:
    """Return the seconds of dates (N,) after the first of them."""
    dates = np.array([s.removesuffix("Z") for s in starts], "datetime64[us]")
    return np.asarray((dates - dates.min()) / np.timedelta64(1, "s"))


def of_one_year(seconds: Seconds) -> Seconds:
    """Return the times of a typical year, whose months are from several years, as those of one year.

    All steps are equal, but a few that are longer or shorter by whole years."""
    steps = np.diff(seconds.t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    years = np.round((steps - usual) / YEAR_S)
    jumps = (years != 0) & (np.abs(steps - usual - years * YEAR_S) < 2 * DAY_S)  # a 29th of February
    even = usual > 0 and np.all(np.abs(steps[~jumps] - usual) <= 1e-6 * usual)
    if not even or not 0 < np.sum(jumps) < 12 or (steps > 0).all():
        return seconds
    t = np.concatenate([seconds.t[:1], seconds.t[0] + np.cumsum(np.where(jumps, usual, steps))])
    return replace(seconds, t=t, note=f"{seconds.note}; months of several years put together as one year")


def is_even(t: np.ndarray) -> bool:
    """Return whether times (N,) increase in every row, most steps within 2 % of the median."""
    steps = np.diff(t[np.isfinite(t)])
    usual = np.median(steps) if len(steps) else 0.0
    return bool(np.all(steps > 0) and np.median(np.abs(steps - usual)) <= 0.02 * usual) if usual else False


def grain(t: np.ndarray) -> float:
    """Return the largest of 60, 1, 0.1, 0.01 ... s that divides all times (N,), counted from the first."""
    t = t[np.isfinite(t)]
    since = t - t[:1]
    sizes = (60.0, *(10.0**-k for k in range(7)))
    return next((g for g in sizes if np.all(np.abs(since / g - np.round(since / g)) < 1e-3)), 0.0)


def rounding(t: np.ndarray) -> str:
    """Return a note where the steps of the times (N,) differ as rounding makes even ones differ."""
    steps = np.diff(t[np.isfinite(t)])
    if len(steps) < 2 or not 0 < np.ptp(steps) <= 1.001 * np.median(steps):
        return ""
    size = grain(t)
    if abs(np.ptp(steps) - size) > 0.001 * size:
        return ""
    return f"the times are whole multiples of {size:g} s and {steps.min():g} or {steps.max():g} s apart: rounded?"


def tidied(texts: pa.Array) -> pa.Array:
    """Return times in the one spelling that `from_texts` reads."""
    texts = pc.utf8_trim(texts, characters=" \t\"'\u00a0")
    for pattern, by in _SPELLINGS:
        texts = pc.replace_substring_regex(texts, pattern, by.replace(r"\g<1>", r"\1"))
    return texts


@functools.lru_cache(65536)
def is_time(cell: str) -> bool:
    """Return whether a cell is a date, a time of day, both, or a duration of days and a time."""
    text = cell.strip(" \t\"'\u00a0")
    if len(text) > 99:
        return False
    if _ONE_PARTED.match(text) and _ONE_PARTS.match(text):
        return True
    if not _MAYBE.search(text):
        return False
    for pattern, by in _ONE_SPELLINGS:
        text = pattern.sub(by, text)
    return bool(text and (_ONE_TIME.match(text) or _ONE_DURATION.match(text)))


def are_times(texts: pa.Array) -> bool:
    """Return whether all cells of a column are dates or times of day. A bare number is none."""
    return bool(times(texts).all())


def times(texts: pa.Array) -> np.ndarray:
    """Return which cells (N,) are dates, times of day or durations; a bare number is none."""
    tidy = tidied(texts)
    right = pc.or_(
        pc.and_(pc.match_substring_regex(tidy, _PATTERN), pc.match_substring_regex(texts, r"\D")),
        pc.or_(pc.match_substring_regex(tidy, _DURATION), _are_parted(texts)),
    )
    return np.array(pc.and_(right, pc.not_equal(tidy, "")).to_numpy(zero_copy_only=False), dtype=bool)


def _are_parted(texts: pa.Array) -> pa.Array:
    """Return which cells are durations such as `1h 2m` and PT30S."""
    texts = pc.utf8_trim_whitespace(texts)
    return pc.and_(pc.match_substring_regex(texts, _PARTED), pc.match_substring_regex(texts, _PARTS))


def from_numbers(values: np.ndarray, unit: str | None, dated: bool = True, modified: bool = False) -> Seconds:
    """Return numbers as seconds: by their epoch, else in the unit that the header states.

    `dated`: the name is one of a date or a time, so that small counts (days of Excel) may be dates.
    `modified`: its name says that it counts modified Julian days, which are as large as those of Excel."""
    finite = values[np.isfinite(values)]
    for name, scale, zero, low, high in EPOCHS if len(finite) else ():
        if modified != name.startswith("modified"):
            continue
        stated = unit is None or abs(SECONDS.get(unit, np.nan) - scale) < 1e-9 * scale
        stated = stated or ("WinCC" in name and unit == "ms" and bool(np.any(finite % 1)))  # its Time_ms
        unset = int(np.argmax(finite >= low)) if name.startswith("unix") and finite[0] >= 0 else 0
        right = (
            low <= finite[unset:].min()
            and finite.max() <= high
            and finite[:unset].max(initial=0) < LATE * low
        )
        if stated and right and (dated or low > LONG):
            if scale == DAY_S:
                values = _of_days(values)
                finite = values[np.isfinite(values)]
            start = _date(finite[0] * scale + zero)
            where = " UTC" if name.startswith("unix") else ""
            t = (values - finite[0]).astype(float) * scale
            if scale >= DAY_S / 1e6:  # floats of days: to the microsecond that they can hold
                t = np.round(t, 5)
            note = f"time read as {name}, from {start.replace('T', ' ')}{where}"
            return Seconds(t, start + ("Z" if where else ""), note, "epoch")
    if unit in SECONDS:
        scale = SECONDS[unit]
        return Seconds(values * scale, None, "" if scale == 1 else f"time converted from {unit} to s", "unit")
    return Seconds(
        np.asarray(values, float), None, "" if unit is None else f"unit '{unit}' is no time; read as s"
    )


def _of_days(days: np.ndarray) -> np.ndarray:
    """Return days (N,) without their rounding: of 44512.66008, to 0.864 s, the whole second."""
    for size, whole_s in ((1e-4, 10.0), (1e-5, 1.0), (1e-6, 0.1)):
        if np.nanmax(np.abs(days / size - np.round(days / size))) < 1e-3:
            return np.round(days * DAY_S / whole_s) * whole_s / DAY_S
    return days


def _date(seconds: float) -> str:
    return str(np.datetime64(round(seconds * 1e3), "ms"))


def from_stamps(stamps: np.ndarray) -> Seconds:
    """Return datetime64 or timedelta64 values as seconds from the first."""
    ns = stamps.astype("datetime64[ns]" if stamps.dtype.kind == "M" else "timedelta64[ns]")
    whole = ns.astype(np.int64)
    there = ~np.isnat(ns)
    first = whole[there][0] if there.any() else 0
    if stamps.dtype.kind == "m":
        return Seconds(np.where(there, whole / 1e9, np.nan), None, "", "duration")
    start = _date(first / 1e9)
    t = np.where(there, (whole - first) / 1e9, np.nan)
    return Seconds(t, start, f"dates from {start.replace('T', ' ')}", "date and time")


def from_minutes(texts: pa.Array) -> Seconds | None:
    """Return texts such as 75:30.5, minutes and seconds, as seconds; None where one is no such text."""
    parts = pc.extract_regex(pc.utf8_trim_whitespace(texts), r"^(?P<m>\d+):(?P<s>\d{1,2}(?:\.\d+)?)$")
    if parts.null_count:
        return None
    t = 60.0 * parts.field("m").cast(pa.float64()).to_numpy() + parts.field("s").cast(pa.float64()).to_numpy()
    return Seconds(t, None, "minutes and seconds, as its name says", "duration")


def refuse_minutes(name: str, texts: pa.Array) -> None:
    """Raise ClockError for times from 00:00 that may be hours and minutes, or minutes and seconds.

    The name, a day's end, or a start later than 00:59 tells."""
    parts = pc.extract_regex(pc.utf8_trim_whitespace(texts), r"^(?P<h>\d+):(?P<m>\d{2})$")
    if parts.null_count or len(parts) < 2 or _TOLD.search(name):
        return
    hours = _whole(parts.field("h"))
    t = 60 * hours + _whole(parts.field("m"))
    steps = np.diff(t)
    if (hours[0] > 0 and hours.max() <= 24) or steps.min() < -12 * 60 or t[-1] + steps[-1] == 24 * 60:
        return
    raise ClockError(
        0,
        f"'{texts[0].as_py()}' may be minutes and seconds, or hours and minutes; say --time '{name} (mm:ss)' or "
        f"--time '{name} (hh:mm)'",
    )


def from_texts(texts: pa.Array) -> Seconds:
    """Return dates, times of day or durations as seconds from the first. Raises ClockError.

    A time of day that runs backwards by more than half a day is past midnight."""
    empty = pc.fill_null(pc.equal(pc.utf8_trim_whitespace(texts), ""), True)
    if pc.any(empty).as_py():
        raise ClockError(pc.index(empty, True).as_py(), "the time is missing; a date or time was expected")
    if (quick := _iso(texts) or _of_parts(texts)) is not None:
        return quick
    tidy = tidied(texts)
    if _with_points(tidy):
        tidy = pc.replace_substring(tidy, ".", ":")
    if pc.any(pc.match_substring_regex(tidy, _DURATION)).as_py():
        tidy = pc.replace_substring_regex(tidy, r"^(\d{1,2}:\d{2}:)", r"0d \1")  # .NET leaves out 0 days
    if pc.all(pc.match_substring_regex(tidy, _DURATION)).as_py():
        parts = pc.extract_regex(tidy, _DURATION)
        t = _whole(parts.field("d")) * DAY_S + _clock_ns(_fields(parts.field("rest"))) / 1e9
        return Seconds(t, None, "durations of days and a time", "duration")
    field = _fields(tidy)
    clock = _clock_ns(field)
    dated = pc.not_equal(field["a"], "").to_numpy(zero_copy_only=False)
    if not dated.any():
        if _whole(field["h"]).max() > 24:
            return Seconds(clock / 1e9, None, "durations read as hours, minutes and seconds", "duration")
        days = np.concatenate([[0], np.cumsum(np.diff(clock) < -DAY_NS // 2)])
        ns = clock + days * DAY_NS
        note = "time of day read as seconds from the first" + (
            f"; past midnight {days[-1]} times" if days[-1] else ""
        )
        return Seconds((ns - ns[0]) / 1e9, None, note, "time of day")
    if not dated.all():
        raise ClockError(int(np.argmin(dated)), "a time without a date among dates")
    points = pc.match_substring_regex(tidy, r"^\d+\.\d+\.")[0].as_py()
    ns, order = _dated(field, clock, points)
    zone = field["z"][0].as_py()
    seconds = _since(
        ns, order, bool(zone) and (zone[0] in "+-" or zone.lower() in ("z", "utc", "gmt")), bool(clock.any())
    )
    if zone and zone.lower() not in ("z", "utc", "gmt") and zone[0] not in "+-":
        seconds = replace(seconds, note=f"{seconds.note} (zone {zone})")
    return seconds


def _with_points(tidy: pa.Array) -> bool:
    """Return whether all texts are times of day such as 10.00.59: no month is 00."""
    times = pc.all(pc.match_substring_regex(tidy, r"^([01]?\d|2[0-4])\.[0-5]\d\.[0-5]\d$")).as_py()
    return bool(times and pc.any(pc.match_substring_regex(tidy, r"^\d+\.00\.")).as_py())


def _fields(tidy: pa.Array) -> dict[str, pa.Array]:
    parts = pc.extract_regex(tidy, _PATTERN)
    empty = pc.or_(parts.is_null(), pc.equal(tidy, ""))
    if pc.any(empty).as_py():
        row = pc.index(empty, True).as_py()
        given = tidy[row].as_py()
        raise ClockError(
            row, f"'{given[:40]}' is no date or time; one such as 2026-03-14T09:26:53.5 was expected"
        )
    return {name: parts.field(name) for name in "abchmsfpz"}


def _iso(texts: pa.Array) -> Seconds | None:
    """Parse ISO dates with Arrow, five times as fast as the regular expression; None if Arrow cannot."""
    for zone in (None, "UTC"):
        try:
            ns = texts.cast(pa.timestamp("ns", zone)).cast(pa.int64())
        except pa.ArrowInvalid:
            continue
        if ns.null_count:
            return None
        ns = ns.to_numpy(zero_copy_only=False)
        return _since(ns, "year-month-day", zone is not None, bool(np.any(ns % DAY_NS)))
    return None


def _of_parts(texts: pa.Array) -> Seconds | None:
    """Return durations such as `1h 2m` and PT30S as seconds; None where one is no such text."""
    if not pc.all(_are_parted(texts)).as_py():
        return None
    parts = pc.extract_regex(pc.utf8_trim_whitespace(texts), _PARTS)
    day, hour, minute, second = (
        pc.if_else(pc.equal(parts.field(k), ""), "0", parts.field(k)).cast(pa.float64()).to_numpy()
        for k in "dhms"
    )
    t = day * DAY_S + hour * HOUR_S + minute * 60.0 + second
    return Seconds(t, None, "durations of days, hours, minutes, seconds", "duration")


def _since(ns: np.ndarray, order: str, zoned: bool, timed: bool = True) -> Seconds:
    start = str(np.datetime64(int(ns[0]) // 1_000_000, "ms"))
    note = f"dates read as {order}, from {start.replace('T', ' ')}{' UTC' if zoned else ''}"
    return Seconds(
        (ns - ns[0]) / 1e9, start + ("Z" if zoned else ""), note, "date and time" if timed else "date"
    )


def _whole(column: pa.Array) -> np.ndarray:
    return pc.if_else(pc.equal(column, ""), "0", column).cast(pa.int64()).to_numpy(zero_copy_only=False)


def _clock_ns(field: dict[str, pa.Array]) -> np.ndarray:
    hour, minute, second = (_whole(field[k]) for k in "hms")
    half = pc.utf8_lower(field["p"]).to_numpy(zero_copy_only=False)
    dated = pc.not_equal(field["a"], "").to_numpy(zero_copy_only=False)
    wrong = ((hour > 24) & (dated | (half != ""))) | (minute > 59) | (second > 60)
    if wrong.any():
        raise ClockError(int(wrong.argmax()), "a time of day beyond 24:59:60")
    if (half != "").any():
        hour = np.where(half == "", hour, hour % 12 + np.where(half == "pm", 12, 0))
    fraction = _whole(pc.utf8_rpad(field["f"], 9, "0"))
    zone = np.zeros(len(hour), np.int64)
    names = pc.unique(field["z"]).to_pylist()
    for text in names:
        here = pc.equal(field["z"], text).to_numpy(zero_copy_only=False)
        if text and text[0] in "+-":
            zone[here] = (int(text[1:3]) * 60 + int(text[-2:])) * (1 if text[0] == "+" else -1)
        elif text and text.lower() in _ZONES:
            zone[here] = 60 * _ZONES[text.lower()] if len(names) > 1 else 0
        elif len(names) > 1:
            what = (
                f"the zone '{text}' among others is not known"
                if text
                else "a time without a zone among others"
            )
            raise ClockError(int(np.argmax(here)), f"{what}; write the times in UTC")
    return ((hour * 60 + minute - zone) * 60 + second) * 1_000_000_000 + fraction


def _dated(field: dict[str, pa.Array], clock: np.ndarray, points: bool) -> tuple[np.ndarray, str]:
    """Return nanoseconds since 1970, and the order of year, month and day.

    `points` between them: the month is not first."""
    middle = pc.utf8_lower(field["b"])
    named = [t for t in pc.unique(middle).to_pylist() if t.isalpha()]
    for text in named:
        month = _MONTHS.get(text, _MONTHS.get(text[:3]))
        if month is None:
            raise ClockError(
                pc.index(middle, text).as_py(), f"'{text}' is no month; jan to dec were expected"
            )
        middle = pc.if_else(pc.equal(middle, text), str(month), middle)
    a, b, c = _whole(field["a"]), _whole(middle), _whole(field["c"])
    buddhist = 2400 < max(a.max(), c.max()) < 2700
    a, c = (np.where(part > 2400, part - 543, part) if buddhist else part for part in (a, c))
    if a.max() > 31 or len(field["a"][0].as_py()) == 4:
        orders = {"year-month-day": (a, b, c)}
    else:
        year = np.where(c < 100, c + 2000, c)
        orders = {"day.month.year": (year, b, a), "month/day/year": (year, a, b)}
        if len(field["c"][0].as_py()) == 2:
            orders["year/month/day"] = (a + 2000, b, c)
        if named:
            orders = {"day.month.year": (year, b, a)}
    by_order = {order: days(*parts) * DAY_NS + clock for order, parts in orders.items() if _valid(*parts)}
    if points and "day.month.year" in by_order:
        by_order.pop("month/day/year", None)
    if not by_order:
        raise ClockError(
            0, "no date: a month of 1 to 12, a day of 1 to 31, a year of 1678 to 2261 were expected"
        )
    if "year/month/day" in by_order and YEARS[0] <= a[0] <= YEARS[1] and not YEARS[0] <= c[0] <= YEARS[1]:
        prefer = ["year/month/day", *orders]
    else:
        halves = pc.any(pc.not_equal(field["p"], "")).as_py()
        prefer = ["month/day/year", *orders] if halves else list(orders)
    ns, order = _one_order(by_order, prefer)
    return ns, f"{order} of Buddhist years" if buddhist else order


def _one_order(possible: dict[str, np.ndarray], prefer: list[str]) -> tuple[np.ndarray, str]:
    """Return the order of day and month that runs forward, evenly; any if all give the same seconds."""
    if len(possible) > 1:
        forward = {k: ns for k, ns in possible.items() if (np.diff(ns) >= 0).all()}
        possible = forward or possible
    if len({(ns - ns[0]).tobytes() for ns in possible.values()}) == 1 < len(possible):
        order = next(o for o in prefer if o in possible)
        return possible[order], order + " (or another order: the seconds are the same)"
    if len(possible) > 1:  # steps of a second in one order are months in the other
        even, uneven = {}, 0
        for order, ns in possible.items():
            steps = np.diff(ns)
            within = steps[np.diff(ns // DAY_NS) == 0]  # as long in any order
            usual = within.max(initial=0) or (np.sort(steps)[(len(steps) - 1) // 2] if len(steps) > 1 else 0)
            if 0 < steps.max() <= 3 * usual:
                even[order] = ns
            uneven += steps.max() > 20 * max(usual, 1)
        if len(even) != 1 or uneven != len(possible) - 1:
            raise ClockError(0, "day and month cannot be told apart; write the dates as 2026-03-14")
        possible = even
    ((order, ns),) = possible.items()
    return ns, order


def _valid(year: np.ndarray, month: np.ndarray, day: np.ndarray) -> bool:
    if not (month.min() >= 1 and month.max() <= 12 and day.min() >= 1 and day.max() <= 31):
        return False
    if year.min() < 1678 or year.max() > 2261:  # those of nanoseconds in 64 bits
        return False
    months = ((year - 1970) * 12 + month - 1).astype("datetime64[M]")
    length = ((months + 1).astype("datetime64[D]") - months.astype("datetime64[D]")).astype(int)
    return bool(np.all(day <= length))


def days(year: np.ndarray, month: np.ndarray | int, day: np.ndarray) -> np.ndarray:
    """Return days since 1970; with month 1, `day` may be the day of the year."""
    months = ((year - 1970) * 12 + month - 1).astype("datetime64[M]")
    return months.astype("datetime64[D]").astype(np.int64) + day - 1
