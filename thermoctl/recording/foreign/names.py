"""Meaning of a column's name: a time in any language, a counter, a unit of time."""

from __future__ import annotations

import re

from thermoctl.recording.foreign.units import WORDS, spelled, time_unit
from thermoctl.units import SECONDS

NAMED, COUNTED = 30, -30  # points for a name of times, for a name of a counter
_TIMES = WORDS["times"].split()
_COUNTERS = WORDS["counters"].split()
_OTHERS = WORDS["other_times"].split()
MOST_WORDS = 3  # largest number of words in a counter's name
_STEPS = ("step", "index", "number", "no", "nr", "count", "id", "idx")
NO_NAME = re.compile(r"column_\d+$")  # column of a table without a header
_PARTS = re.compile(r"[^\W\d_]+|#|n[°º]", re.UNICODE)


def tokens(name: str) -> list[str]:
    """Return the words of a name in lower case: time, ms of `Time_ms` and of `timeMs`."""
    split = re.sub(r"([a-zäöü])([A-Z])", r"\1 \2", name)
    return [p.lower() for p in _PARTS.findall(split)]


def named(name: str) -> int:
    """Return points for a name: of times in any language, of a counter, of another time than the clock."""
    words = tokens(name)
    if name.strip() == "T":  # t is a time, T a temperature
        return 0
    if any(w in _OTHERS for w in words):
        return -NAMED
    if 1 < len(words) <= MOST_WORDS and words[-1] in _STEPS:  # `Time Step` counts
        return COUNTED
    if re.fullmatch(r"t|ts|t[_ ]?(s|ms|us|ns|min|h|d|sec|msec)", name.strip()):
        return NAMED
    words = [
        w for k, w in enumerate(words) if w != "data" or k == 0
    ]  # Italian for a date, English for values
    if any(w in _TIMES for w in words) or re.match(r"(?i)(date|time|zeit|datum|timestamp)", "".join(words)):
        return NAMED
    if "#" in name or any(w in _COUNTERS for w in words[:1]):
        return COUNTED
    return 0


def is_generic(name: str) -> bool:
    """Return whether a first column's name says that it is what the others are drawn over."""
    return bool(
        re.fullmatch(r"(?i)|column_1|unnamed: 0|x([ _-]?(value|axis|data|wert|achse))?", name.strip())
    )


def unit_of_time(name: str, unit: str | None, is_time: bool = False) -> str | None:
    """Return the unit of time that a header states, in brackets or as a word of the name.

    `is_time`: the column is a time whatever its name, so that S is the second and not the siemens."""
    if unit is not None:
        if is_time or named(name) > 0:
            return time_unit(unit)
        return short if (short := spelled(unit)) in SECONDS else None
    before = re.match(r"(.+?)(?:/| per )", name)
    if before and named(before[1]) <= 0:  # m/s and W per hour are rates
        return None
    words = tokens(name)
    for word in reversed(words):
        short = spelled(word)
        if (
            short in SECONDS
            and (len(word) > 1 or (len(words) > 1 and word == words[-1]))
            and word not in ("tag", "day")
        ):
            return short
    return None
