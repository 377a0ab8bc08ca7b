"""Statements of a text file above its table: the time from row to row, and units by column."""

from __future__ import annotations

import re

from thermoctl.recording.foreign.cells import is_number
from thermoctl.recording.foreign.units import known, named, spelled, split_unit, time_unit
from thermoctl.units import SECONDS

_STEP = re.compile(
    r"(?i)^(?:.*(?:sampl\w*|scan|log\w*|record\w*|acqui\w*|mess|abtast)\w*[\s_-]*(?:interval|period|time|rate|freq\w*|clock|step|intervall|zeit|rate)?"
    r"|interval|period|x?increment|xincr\w*|delta[_ ]?[xt]|tinc|dt|h(?:orizontal)?resolution|timebase|samplerate|frequency|fs)\b.*$"
)
_INTERVAL = re.compile(
    r"(?i)interval|period|time|rate|freq|clock|step|zeit|incr|xinc|tinc|delta|^dt|resolution|hz|^fs"
)
_DURATION = re.compile(r"(?i)(?:record|log|acqui|mess)\w*[\s_-]*(?:time|zeit)")  # whole recording
_RATE = re.compile(r"(?i)rate|freq|hz|^fs")
_VALUE = re.compile(r"^\s*([+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)\s*([^\d\s]*)\s*$")


def facts_of(above: list[tuple[int, str]], separator: str) -> dict[str, list[str]]:
    """Return the statements of the lines above the header: `Delta_X <tab> 0.1`, `Interval: 0.5 s`."""
    facts: dict[str, list[str]] = {}
    sep = separator if separator.strip() or separator == "\t" else "\t"
    for _, line in above:
        line = line.rstrip(f" {sep}")
        cells = [c.strip().strip('"') for c in line.split(sep)]
        if len(cells) < 2 and (match := re.match(r"([^:=]{2,40})[:=]\s*(.+)$", line)):
            cells = [match[1].strip(), match[2].strip()]
        elif len(cells) > 1 and cells[0].endswith((":", "=")):
            cells[0] = cells[0][:-1].strip()
        if len(cells) > 1 and cells[0]:
            facts.setdefault(cells[0].lower(), cells[1:])
    return facts


def take_below(cells: list[str], row: list[str], facts: dict[str, list[str]]) -> None:
    """Take Start and Increment of an oscilloscope from the line below the header (Rigol)."""
    for name, value in zip(cells, row, strict=False):
        if name.lower() in ("start", "increment"):
            facts[name.lower()] = [value]


def aligned(facts: dict[str, list[str]], names: list[str], units: dict[str, str]) -> dict[str, str]:
    """Return units of lines above the header that name them by column: LVM, oscilloscopes."""
    own = {n: facts[n.lower()] for n in names if n.lower() in facts}  # `Humidity = %rh` (Rotronic)
    found = {
        n: str(spelled(unit, n))
        for n, (unit, *more) in own.items()
        if not more and known(unit) and not {n} & units.keys() and split_unit(unit)[0] not in names
    }
    for key, values in facts.items():
        if re.search(r"(?i)^(y_?|vert\w*[ _]?|v)?(unit|einheit)", key) and any(
            known(_own(v)) for v in values
        ):
            while len(values) > len(names) - 1 and not values[-1]:
                values = values[:-1]
            columns = names if len(values) == len(names) else names[1:]
            found |= {
                n: str(spelled(_own(v), n))
                for n, v in zip(columns, values, strict=False)
                if known(_own(v)) and n not in units
            }
        elif (
            re.search(r"(?i)^(x_?|hor\w*[ _]?|h)(unit|einheit)", key)
            and time_unit(values[0])
            and names[0] not in units
            and named(names[0]) > 0
        ):
            found[names[0]] = values[0]
    return found


def _own(unit: str) -> str:
    """Return the unit of `CH1:V` (Siglent) and of `V`."""
    return unit.rpartition(":")[2]


def stated_step(facts: dict[str, list[str]]) -> tuple[float, float] | None:
    """Return the interval between rows that a file states above its header, and the first time, s."""
    start = 0.0
    for key in ("start", "x0", "t0", "xoffset", "hoffset", "trigger offset"):
        if key in facts and (match := _VALUE.match(facts[key][0])):
            start = float(match[1].replace(",", "."))
    for key, values in facts.items():
        if not _STEP.match(key) or _DURATION.match(key):
            continue
        filled = [v for v in values if v]
        match = _VALUE.match(filled[0]) if filled else None
        if match is None:
            continue
        size = float(match[1].replace(",", "."))
        if not _INTERVAL.search(key) and not time_unit(match[2]):
            continue  # `Samples 600` states the number of samples, `Sampling 1s` their interval
        stated = (
            match[2] or next((v for v in filled[1:2] if not is_number(v)), "") or (split_unit(key)[1] or "")
        )
        unit = (
            time_unit(stated) or spelled(stated.replace("hz", "Hz")) or ("Hz" if _RATE.search(key) else "s")
        )
        if unit in SECONDS and size > 0 and "rate" not in key:
            return size * SECONDS[unit], start
        if unit in ("Hz", "kHz", "MHz", "Sa/s", "S/s", "1/s") and size > 0:
            return 1 / (size * {"kHz": 1e3, "MHz": 1e6}.get(unit, 1.0)), start
    return None
