"""The dialect of a text file that a logger wrote: encoding, separator, decimal sign, header, units.

It is found from the file's first lines. A line is data if at least half of its cells are numbers or times.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from thermoctl.recording.clock import is_time
from thermoctl.yamlfile import InputError

MISSING = ("", "NaN", "nan", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None", "-", "--", "---", "#N/A")
SAMPLE = 400  # lines that decide
FEW = 20  # lines; of more, a head takes at most half
SEPARATORS = (",", ";", "\t", "|")
_POINT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
_COMMA = re.compile(r"[-+]?(\d+,?\d*|,\d+)([eE][-+]?\d+)?$")
# Symbols that make `(...)` behind a name a unit; square brackets always hold one.
_SYMBOL = (
    r"(?:°[CF]|℃|℉|deg ?[CF]?|Celsius|Fahrenheit|Kelvin|%|°|rad|min|h|hr|ppm|bar|psi|rpm|"
    r"(?:da|[fpnuµμmcdkMGT])?(?:m|g|s|A|K|V|W|J|N|Pa|Hz|Ω|Ohm|ohm|F|H|C|T|Wh|l|L|mol|bar))"
)
_POWER = r"(?:(?:\^|\*\*)?-?\d|[²³⁻¹]+)?"
_UNIT = re.compile(rf"1|(?:1/)?{_SYMBOL}{_POWER}(?:[*/·. ]\(?{_SYMBOL}{_POWER}\)?)*$")
_NAMED = re.compile(r"(.*?\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*(?:\([^()]*\))?[^()]*)\)|\s/\s*(\S+))$")
_SPELLED = {
    "Celsius": "degC",
    "Fahrenheit": "degF",
    "Kelvin": "K",
    "°": "deg",
    "hr": "h",
    "Ohm": "ohm",
    "Ω": "ohm",
}


@dataclass(frozen=True)
class Dialect:
    """How a text file is to be read.

    `names` and `units` by column; `first`: its first line of data, from 1; `texts`: columns without numbers;
    `notes`: the guesses."""

    separator: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    first: int
    texts: frozenset[str]
    times: frozenset[str]
    notes: tuple[str, ...]


def decoded(path: Path, data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return a file's text as UTF-8 and a note where its encoding is another. Raises InputError."""
    head = data[:4096]
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif head.count(0) > len(head) / 5:  # of Latin text every other byte is zero
        encoding = "utf-16-be" if head[:1] == b"\0" else "utf-16-le"
    else:
        try:
            data.decode("utf-8")
            data = data.removeprefix(b"\xef\xbb\xbf")
            return data if b"\n" in data else data.replace(b"\r", b"\n"), ()
        except UnicodeDecodeError:
            encoding = "cp1252"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as e:
        raise InputError(
            f"{path}: not text in UTF-8, UTF-16 or Windows-1252 (byte {e.start}); save it as UTF-8"
        ) from None
    name = {"cp1252": "Windows-1252 (Latin-1)"}.get(encoding, "UTF-16")
    return text.encode("utf-8"), (f"read as {name}",)


def split_unit(header: str) -> tuple[str, str | None]:
    """Return name and unit of `T_block [degC]`, `T_block (degC)`, `T_block / °C`; None for no unit."""
    text = header.strip()
    match = _NAMED.match(text)
    if not match:
        return text, None
    name, square, bracket, slash = match.groups()
    unit = (square if square is not None else bracket if bracket is not None else slash).strip()
    if square is None and not _UNIT.match(unit):
        return text, None
    return name.strip(), spelled(unit)


def spelled(unit: str) -> str | None:
    """Return a unit as pint writes it: °C is degC; None where nothing is stated."""
    unit = unit.strip().replace("μ", "µ").replace("℃", "degC").replace("℉", "degF")
    unit = unit.replace("°C", "degC").replace("°F", "degF").replace("deg C", "degC").replace("deg F", "degF")
    return _SPELLED.get(unit, unit) if unit not in ("", "-", "–") else None


def lines(text: str) -> Iterator[tuple[int, str]]:
    """(line counted from 1, text) without comments and empty lines."""
    for number, line in enumerate(io.StringIO(text), 1):
        if line.strip() and not line.lstrip(" \t").startswith("#"):
            yield number, line.rstrip("\r\n")


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of one line, unquoted and stripped."""
    return [c.strip() for c in next(csv.reader([line], delimiter=separator), [])]


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number with this decimal sign."""
    return bool((_POINT if decimal == "." else _COMMA).match(cell))


def _sample(path: Path, text: str) -> tuple[list[tuple[int, str]], str | None]:
    """Return the lines that decide, and the separator that a line `sep=;` states."""
    sample: list[tuple[int, str]] = []
    stated = None
    for number, line in lines(text):
        if not sample and (match := re.match(r"sep=(.)\s*$", line)):
            stated = match[1]
            continue
        sample.append((number, line))
        if len(sample) == SAMPLE:
            break
    if not sample:
        raise InputError(f"{path}: the file is empty; a header line with the column names was expected")
    if len(sample) == 1:
        raise InputError(
            f"{path}:{sample[0][0]}: no rows; a header line and at least one sample below it were expected"
        )
    return sample, stated


def find_dialect(path: Path, text: str) -> Dialect:
    """Find the dialect from the first lines of a file. Raises InputError (file:line) where there is none."""
    notes: list[str] = []
    sample, stated = _sample(path, text)
    separator, decimal, rows = _separator(path, sample, (stated,) if stated else SEPARATORS)
    width = Counter(len(c) for _, c in _tail(rows)).most_common(1)[0][0]
    table = [(n, c) for n, c in rows if len(c) == width]
    data = [_is_data(c, decimal) for _, c in table]
    twice = [a and b for a, b in zip(data, [*data[1:], True], strict=True)]
    begin = twice.index(True) if True in twice else len(table)
    if begin == 0:
        raise InputError(
            f"{path}:{table[0][0]}: a header line with the column names was expected, found numbers; add one"
        )
    head = table[max(begin - 2, 0) : begin]
    if len(head) == 2 and not _is_units(head[1][1]):  # another line of the same width above the header
        head = head[1:]
    names, units = _names(path, head[0], width)
    if len(head) == 2:
        stated_units = (spelled(c.strip("[]()")) for c in head[1][1])
        units |= {n: u for n, u in zip(names, stated_units, strict=True) if u}
        notes.append(f"line {head[1][0]} read as units")
    if skipped := sum(1 for n, _ in rows if n < head[0][0]):
        notes.append(f"{skipped} lines before the header left out")
    if separator != ",":
        shown = {"\t": "tab"}.get(separator, f"'{separator}'")
        notes.append(f"separator {shown}" + (", decimal comma" if decimal == "," else ""))
    texts, times = _kinds(names, [c for _, c in table[begin:]], decimal)
    first = table[begin][0] if begin < len(table) else rows[-1][0] + 1
    return Dialect(separator, decimal, names, units, first, texts, times, tuple(notes))


def _separator(
    path: Path, sample: list[tuple[int, str]], candidates: tuple[str, ...]
) -> tuple[str, str, list[tuple[int, list[str]]]]:
    """Return the separator and decimal sign that give lines of one width and most numbers."""
    best: tuple[float, str, str, list[tuple[int, list[str]]]] | None = None
    for separator in candidates:
        try:
            rows = [(n, cells_of(line, separator)) for n, line in sample]
        except csv.Error:
            continue
        tail = [c for _, c in _tail(rows)]
        width, lines_of = Counter(len(c) for c in tail).most_common(1)[0]
        if width < 2:
            continue
        cells = [x for c in tail if len(c) == width for x in c]
        for decimal in ".," if separator != "," else ".":
            good = sum(is_number(x, decimal) or x in MISSING or is_time(x) for x in cells)
            score = lines_of / len(tail) * good / len(cells)
            if best is None or score > best[0] + 1e-9:
                best = score, separator, decimal, rows
    if best is None or best[0] < 0.3:
        shown = sample[0][1][:60]
        raise InputError(
            f"{path}:{sample[0][0]}: '{shown}': no columns; a header line and rows separated by comma, "
            "semicolon, tab or | were expected"
        )
    return best[1:]


def _tail(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return the rows that are data most likely: the later half of many, all but the first of a few."""
    return rows[max(1, len(rows) // 2) if len(rows) > FEW else 1 :]


def _is_data(cells: list[str], decimal: str) -> bool:
    filled = [c for c in cells if c not in MISSING]
    return 2 * sum(is_number(c, decimal) or is_time(c) for c in filled) >= len(filled) > 0


def _is_units(cells: list[str]) -> bool:
    """Return whether a line below the header states units: all cells short, at least one a known unit."""
    bare = [c.strip("[]()") for c in cells]
    return all(len(c) <= 12 for c in bare) and any(_UNIT.match(c) for c in bare if c)


def _names(path: Path, head: tuple[int, list[str]], width: int) -> tuple[tuple[str, ...], dict[str, str]]:
    line, cells = head
    split = [split_unit(c) for c in cells]
    names = [n for n, _ in split]
    # Two columns that differ by their units only keep them in their names.
    names = [c if names.count(n) > 1 else n for c, n in zip(cells, names, strict=True)]
    for i, name in enumerate(names):
        if not name and i < width - 1:
            raise InputError(f"{path}:{line}: column {i + 1} of {width} has no name in the header")
        if name in names[:i]:
            raise InputError(f"{path}:{line}: the column '{name}' stands twice in the header; rename one")
    units = {n: u for n, (_, u) in zip(names, split, strict=True) if u and n}
    return tuple(names), units


def _kinds(
    names: tuple[str, ...], rows: list[list[str]], decimal: str
) -> tuple[frozenset[str], frozenset[str]]:
    """Columns of text and columns of times: by the sample's cells, none of which is a number."""
    texts: set[str] = set()
    times: set[str] = set()
    for i, name in enumerate(names):
        filled = [r[i] for r in rows if r[i] not in MISSING]
        if filled and not any(is_number(c, decimal) for c in filled):
            (times if all(is_time(c) for c in filled) else texts).add(name)
    return frozenset(texts), frozenset(times)
