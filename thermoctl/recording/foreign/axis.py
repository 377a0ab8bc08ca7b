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
from thermoctl.recording.foreign.parts import joined
from thermoctl.recording.foreign.sheet import Cells, Sheet
from thermoctl.recording.foreign.units import (
    COUNTED,
    NAMED,
    has_factor,
    is_generic,
    known,
    named,
    unit_of_time,
)

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
    even = clock.is_even(t)
    return STRICT + (EVEN if even else 0), "increases evenly" if even else "increases"


_BRACKETED = re.compile(r"\(([^\W\d_]{1,4}|(?:tick|sample|frame|count|cycle|step|point)s?)\.?\)$")
_MODIFIED = re.compile(r"(?i)(?<![a-z])mjd(?![a-z])|modified.?julian")
_MINUTES = re.compile(r"(?i)(?<![:\w])m+(?:in\w*)?:s")  # a header such as "Time (min:sec)"


def read(name: str, cells: Cells, unit: str | None, is_time: bool = False) -> Seconds:
    """Return a column as seconds. Raises ClockError for one that cannot be a time.

    `is_time`: see `unit_of_time`. A unit with a factor is refused, and one that is none where no person
    named the column."""
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
        # A short word in round brackets is a unit, as in `Time (HH)`. A longer one, as `(elapsed)`, is none.
        written = unit or next(iter(_BRACKETED.findall(name)), None)
        stated, header = unit_of_time(name, unit, is_time), f"{name} [{unit}]" if unit else name
        if modified := _MODIFIED.search(f"{name} {unit or ''}") is not None:
            stated = None
        seconds = clock.from_numbers(cells, stated, named(name) > 0 or modified, modified)
        if seconds.kind != "epoch" and has_factor(header) and (stated or named(name) > 0):
            raise ClockError(
                0, f"'{header}' counts in steps; write it in s, or say --time 0.1s for even rows"
            )
        if seconds.kind == "bare" and written and not is_time and named(name) > 0 and not known(written):
            raise ClockError(
                0, f"'{written}' is no unit of time that is known; if it is s, say --time '{name}'"
            )
        return seconds
    if pc.all(pc.match_substring_regex(cells, r"^\s*\d{15,20}\s*$")).as_py():
        return _exact(cells)
    minutes = clock.from_minutes(cells) if _MINUTES.search(f"{name} {unit or ''}") else None
    return minutes or clock.from_texts(cells)


def chosen(name: str, cells: Cells, unit: str | None) -> Seconds:
    """Return the column that a person named as seconds; `name` may end in (mm:ss) or (hh:mm).

    Raises ClockError."""
    if not isinstance(cells, np.ndarray):
        clock.refuse_minutes(name, cells)
    return read(name, cells, unit, True)


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
    names = list(sheet.columns)
    for columns, seconds, evidence in joined(sheet, by_column):
        yield _judged(sheet, columns, seconds, names.index(columns[0])).plus(evidence * JOINED)
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
    first = next(iter(sheet.columns))  # X_Value stands again before each channel of a clock of its own
    generic = is_generic(first) and name.partition("\0")[0] == first and len(sheet.columns) > 1
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
    if len(best.columns) == 1 and not isinstance(texts := sheet.columns[best.columns[0]], np.ndarray):
        name = best.columns[0]
        clock.refuse_minutes(
            f"{name.partition(chr(0))[0]} {sheet.units.get(name, '')}".strip(), _complete(texts)
        )
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
