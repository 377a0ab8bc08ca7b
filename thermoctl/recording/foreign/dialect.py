"""The dialect of a text file that a logger wrote: encoding, separator, decimal sign, header, units.

It is found from the file's first lines. A line is data if most of its cells are of the kind (number, time)
that the column holds in the later lines.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, takewhile
from pathlib import Path

from thermoctl.files.yamlfile import InputError
from thermoctl.recording.foreign.cells import is_missing, is_number
from thermoctl.recording.foreign.clock import is_time
from thermoctl.recording.foreign.facts import aligned, facts_of, take_below
from thermoctl.recording.foreign.units import (
    WIDE,
    WORDS,
    has_factor,
    known,
    named,
    spelled,
    split_slash,
    split_unit,
    split_words,
    time_unit,
)
from thermoctl.units import SECONDS

SAMPLE = 400  # number of first lines from which the dialect is found
FEW = 5  # in a file with more lines, the head takes at most half of them
SEPARATORS = (",", ";", "\t", "|", "  ", " ")
HEAD_LINES = 6  # number of lines above the data from which names, units and kinds of values are taken
UNIT_LENGTH = 16  # largest number of characters of a cell in a line of units
_COMMENT = re.compile(r"[ \t]*(%|#(?!\s*[,;\t|]|N/A|NA\b|NV\b|(VALUE|WERT|DIV/0|NUM|REF|BEZUG|NULL)!))")
# The line below the header of a table in Markdown or SQL.
_RULER = re.compile(r"\s*([|+][\s|+:=-]*)?-{3}[\s|+:=-]*$")
FACT = re.compile(r"(t0|tInc)\s*=\s*(.+)$")  # a statement in place of a name (Rigol)
# LabVIEW and Bio-Logic state where the header ends; its last line has the names.
_HEADER_END = re.compile(r"\*{3}End_of_Header\*{3}|Nb header lines\W+(\d+)")
_TWO = re.compile(r"[-+]?[\d.]+(?: [-+]?[\d.]+)+$")  # numbers between single blanks
_COMMA = re.compile(r"[-+]?(\d+,\d+|,\d+)([eE][-+]?\d+)?$")
_STATED = re.compile(r"[A-Za-z][^,;\t|:=]{0,60}?\s[:=]\s+\S")  # `Channel : RPM` above a table
_UNSEEN = re.compile(
    "[\u200b\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)  # marks of direction, as Windows copies dates
_DECIMALS = re.compile(r"[-+]?\d*[.,]\d+$")
_AMBIGUOUS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}$")
_THOUSANDS = re.compile(rb"\.(?<!:\d\d\.)\d{3}(?=[;\t\r\n])")  # the end of 1.050 in a cell
ENCODINGS = dict(pair.split("=") for pair in WORDS["encodings"].split())  # name for people: Python's name
_FOREIGN_WORDS = {
    w for key in ("times", "counters", "units", "quantities") for w in WORDS[key].split() if not w.isascii()
}
_KINDS = {"", *WORDS["kinds"].split()}


@dataclass(frozen=True)
class Dialect:
    """How a text file is to be read.

    - `names`, `units`: by column
    - `first`: its first line of data, from 1
    - `numeric`: columns of plain numbers, as far as the sample shows
    - `facts`: statements of the lines above the header, by their keys
    - `longer`: a line of data with cells beyond those of the others
    - `notes`: the guesses"""

    separator: str
    decimal: str | None
    names: tuple[str, ...]
    units: dict[str, str]
    first: int
    numeric: frozenset[str]
    notes: tuple[str, ...]
    facts: dict[str, list[str]] = field(default_factory=dict)
    header: tuple[str, ...] = ()
    longer: int = 0


def decoded(path: Path, data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return a file's text as UTF-8 and a note where its encoding is another. Raises InputError."""
    head = data[:4096]
    even, odd = head[::2].count(0), head[1::2].count(0)
    if head.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        encodings = ["utf-32"]
    elif head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ["utf-16"]
    elif max(even, odd) > max(len(head) / 5, 4 * min(even, odd)):  # every other byte of Latin text is zero
        encodings = ["utf-16-be" if even > odd else "utf-16-le"]
    else:
        encodings = ["utf-8"]
    text = _read_as(data, encodings[0])
    if text is None and encodings == ["utf-8"]:
        encodings = _by_words(data)
    read = ((e, text) for e in encodings if (text := _read_as(data, e)) is not None)
    encoding, text = next(read, ("", None))
    if text is None:
        raise InputError(
            f"{path}: not text in UTF-8, UTF-16 or a code page that its words show; save it as UTF-8"
        )
    whole, notes = _whole_lines(_UNSEEN.sub("", text).encode("utf-8"))
    if encoding == "utf-8":
        return whole, notes
    name = next((name for name, e in ENCODINGS.items() if e == encoding), encoding[:6].upper())
    return whole, (f"read as {name}", *notes)


def _read_as(data: bytes, encoding: str) -> str | None:
    """Return the text, without a character that is cut off at the end; None for another encoding."""
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as e:
        cut = e.reason in ("unexpected end of data", "truncated data", "incomplete multibyte sequence")
        return data[: e.start].decode(encoding) if cut else None


def _by_words(data: bytes) -> list[str]:
    """Return the encodings of ENCODINGS in which a text holds most known words; the first of equal ones.

    Of the bytes alone most of them make some text."""
    shown = b"\n".join(islice((m[0] for m in re.finditer(rb"[^\n]*[\x80-\xff][^\n]*", data)), SAMPLE))

    def points(encoding: str) -> int:
        text = shown.decode(encoding, errors="replace").lower()
        return sum(len(word) ** 2 for word in _FOREIGN_WORDS if word in text)

    return sorted(ENCODINGS.values(), key=points, reverse=True)


def _whole_lines(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return a text without marks of byte order, its lines with zero bytes empty, and a note on these.

    A loss of power leaves zero bytes where a line was not yet on the disk."""
    data = data.replace(b"\xef\xbb\xbf", b"")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    rows = data.split(b"\n") if b"\0" in data else []
    holed = [k for k, row in enumerate(rows) if b"\0" in row]
    if not 0 < 2 * len(holed) < len(rows):
        return data, ()  # whole, or no text at all
    for k in holed:
        rows[k] = b""
    which = ", ".join(str(k + 1) for k in holed[:5])
    return b"\n".join(rows), (f"zero bytes in line {which}: left out (did the logger lose power?)",)


def lines(text: str) -> Iterator[tuple[int, str]]:
    """(line counted from 1, text) without comments and empty lines."""
    for number, line in enumerate(io.StringIO(text), 1):
        if line.strip() and not is_comment(line):
            yield number, line.rstrip("\r\n")


def shown(separator: str) -> str:
    """Return a separator for people."""
    return {"\t": "tab", " ": "blanks", "  ": "blanks"}.get(separator, f"'{separator}'")


def is_comment(line: str) -> bool:
    """Return whether a line is a comment: # first, but no column's name `#` (HOBO), no `#N/A` of Excel."""
    return bool(_COMMENT.match(line))


def cells_of(line: str, separator: str) -> list[str]:
    """Return the cells of one line, unquoted and stripped."""
    if separator in ("  ", " "):
        if '"' in line:
            line = re.sub(r'^\s*\((".*")\)\s*$', r"\1", line.strip())  # the header of Fluent
            return [c.strip() for c in next(csv.reader([line], delimiter=" ", skipinitialspace=True), [])]
        return re.split(r"\s{2,}|\t" if separator == "  " else r"\s+", line.strip())
    cells = [c.strip() for c in next(csv.reader([line], delimiter=separator), [])]
    return [c[1:-1] if len(c) > 1 and c[0] == c[-1] == '"' else c for c in cells]


def _sample(path: Path, text: str) -> tuple[list[tuple[int, str]], list[tuple[int, str]], str | None]:
    """Return the lines that decide, the comments above them, and the separator that a line `sep=;` states."""
    sample: list[tuple[int, str]] = []
    comments: list[tuple[int, str]] = []
    stated = None
    for number, line in enumerate(io.StringIO(text), 1):
        if not line.strip():
            continue
        if is_comment(line) or (not sample and _STATED.match(line)):
            comments.append((number, line.strip().lstrip("#% \t")))
            continue
        if _RULER.match(line):
            continue
        if not sample and (match := re.match(r"\"?sep=(.)\"?\s*$", line)):
            stated = match[1]
            continue
        sample.append((number, line.rstrip("\r\n")))
        if len(sample) == SAMPLE:
            break
    if not sample:
        raise InputError(f"{path}: the file is empty; a header line with the column names was expected")
    if len(sample) == 1 and not comments:
        raise InputError(
            f"{path}:{sample[0][0]}: no rows; a header line and at least one sample below it were expected"
        )
    return sample, [c for c in comments if c[0] < sample[-1][0]], stated


def _kind(cell: str) -> str:
    if is_missing(cell):
        return "-"
    return "n" if is_number(cell) else "t" if is_time(cell) else "w"


def find_dialect(path: Path, text: str, whole: bytes = b"") -> Dialect:
    """Find the dialect from the first lines of a file. Raises InputError (file:line) where there is none.

    `whole`: the file, whose later lines tell whether a point parts thousands if the first ones do not."""
    sample, comments, stated = _sample(path, text)
    separator, rows = _separator(path, sample, (stated,) if stated else SEPARATORS)
    width = Counter(len(c) for _, c in _tail(rows)).most_common(1)[0][0]
    longer = rows[1][0] if _longer_once(rows, width) else 0
    rows = [(n, c[:width] if n <= longer else c) for n, c in rows]
    begin = _begin(rows, width)
    head = [(n, c) for n, c in rows[:begin]]
    above = [(n, line) for n, line in sample if begin >= len(rows) or n < rows[begin][0]]
    facts = facts_of([*comments, *above], separator)
    data = [c for _, c in rows[begin:] if len(c) == width]
    first = rows[begin][0] if begin < len(rows) else rows[-1][0] + 1
    notes = [f"line {longer}: its cells beyond column {width} left out"] if longer else []
    names, units, header, used = _header(path, head, comments, separator, width, data, facts, notes)
    if skipped := [c for n, c in head if n not in used]:
        of_numbers = sum(bool(c[1:]) and all(is_number(x) or is_time(x) for x in c) for c in skipped)
        lost = f", {of_numbers} of them rows of another table" if of_numbers > 1 else ""
        notes.append(f"{len(skipped)} line{'s' if skipped[1:] else ''} before the header left out{lost}")
    facts |= {m[1].strip().lower(): [m[2]] for c in header if (m := FACT.match(c))}
    shown_by = data
    if separator in ";\t" and not any(re.search("[.,]", c) and not is_time(c) for row in data for c in row):
        found = (m.span() for m in islice(_THOUSANDS.finditer(whole), SAMPLE))
        later = [whole[whole.rfind(b"\n", 0, a) + 1 : whole.find(b"\n", b)].decode() for a, b in found]
        shown_by = data + [c for line in later if len(c := cells_of(line, separator)) == width]
    decimal = _decimal(shown_by, separator)
    if decimal == "." and separator in ";\t" and (parted := _perhaps_thousands(shown_by)):
        notes.append(f"{parted} read with a decimal point (if it parts thousands: --decimal ,)")
    if separator != "," and width > 1:
        notes.append(f"separator {shown(separator)}" + (", decimal comma" if decimal == "," else ""))
    return Dialect(
        separator, decimal, names, units, first, _numeric(names, data), tuple(notes), facts, header, longer
    )


def _separator(
    path: Path, sample: list[tuple[int, str]], candidates: tuple[str, ...]
) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the separator that gives lines of one width and most numbers."""
    best: tuple[float, str, list[tuple[int, list[str]]]] | None = None
    for separator in candidates:
        if not separator.strip(" ") and best is not None and best[0] >= 0.3:
            break  # blanks inside the cells: another separator was found already
        try:
            rows = [(n, cells_of(line, separator)) for n, line in sample]
        except csv.Error:
            continue
        tail = [c for _, c in _tail(rows)]
        width, lines_of = Counter(len(c) for c in tail).most_common(1)[0]
        if width < 2 or (separator == "," and len(rows[0][1]) == 1 and _all_commas(sample)):
            continue
        if separator == "  " and any(_TWO.match(x) for c in tail for x in c):
            continue
        cells = [x for c in tail if len(c) == width for x in c]
        good = sum(_kind(x) != "w" for x in cells)
        score = lines_of / len(tail) * good / len(cells) - (0.01 if separator in ("  ", " ") else 0)
        if separator == ";" and re.search(r"\d,\d", sample[-1][1]):
            score += 0.005  # a decimal comma rather than two columns
        if best is None or score > best[0] + 1e-9:
            best = score, separator, rows
    alone = [(n, [line.strip()]) for n, line in sample]
    if best is None and all(_kind(c[0]) in "n-" for _, c in _tail(alone)):
        return "\t", alone
    if best is None or best[0] < 0.3:
        shown = sample[0][1][:60]
        raise InputError(
            f"{path}:{sample[0][0]}: '{shown}': no columns; a header line and rows separated by comma, "
            "semicolon, tab, | or blanks were expected (columns of a fixed width: write them with commas)"
        )
    return best[1:]


def _all_commas(sample: list[tuple[int, str]]) -> bool:
    """Return whether each line that decides is numbers with decimal commas, one or as many as names."""
    rows = [c[0].split() for _, c in _tail([(n, [line]) for n, line in sample])]
    numbers = all(all(_kind(c) in "nt" for c in row) and any(map(_COMMA.match, row)) for row in rows)
    return numbers and {1, len(sample[0][1].split())} >= {len(row) for row in rows}


def _tail(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return the rows that are data most likely: the later half, of a few all but the first.

    Where the file states the end of its header, all below it. Of these, the last ones of one width."""
    for n, cells in rows:
        if match := _HEADER_END.match(" ".join(cells)):
            names = int(match[1] or n + 1)
            rows = [r for r in rows if r[0] > names] or rows
    tail = rows[len(rows) // 2 if len(rows) > FEW else 1 :] or rows
    widths = Counter(len(c) for _, c in reversed(tail))  # the last of equal ones
    width = len(tail[-1][1])
    block = list(takewhile(lambda r: len(r[1]) == width, reversed(tail)))[::-1]
    return block if len(block) > 1 and width == widths.most_common(1)[0][0] else tail


def _begin(rows: list[tuple[int, list[str]]], width: int) -> int:
    """Return the index of the first row of data: it and the next have the kinds of the later rows."""
    tail = [c for _, c in _tail(rows) if len(c) == width]
    kinds = []
    for i in range(width):
        seen = Counter(k for c in reversed(tail) if (k := _kind(c[i])) != "-")  # the last of equal ones
        kinds.append(seen.most_common(1)[0][0] if seen else "-")
    expected = [i for i, k in enumerate(kinds) if k in "nt"]

    def is_data(cells: list[str]) -> bool:
        """Return whether half of the cells that should be numbers or times are."""
        if len(cells) < width or (kinds[0] == "-" and _kind(cells[0]) == "w"):
            return False
        if not expected:
            return all(_kind(c) == "-" for c in cells[1:]) and any(c for c in cells)
        there = [i for i in expected if not is_missing(cells[i])]
        right = sum(_kind(cells[i]) in "nt" for i in there)
        if expected[0] == 0 and there and there[0] == 0 and _kind(cells[0]) not in "nt":
            return False  # a word where rows begin with their time: `Delta_X 0.1 0.1`
        return 2 * right >= len(there) > 0 and 2 * right >= max(1, len(there))

    data = [is_data(c) for _, c in rows]
    after = [*(d and len(c) == width for d, (_, c) in zip(data, rows, strict=True)), True][1:]
    # A wider row is of another table above, unless a row of this one follows.
    data = [d and (a or len(c) <= width) for d, a, (_, c) in zip(data, after, rows, strict=True)]
    # Without a word in the first column a row of a header can look like data; then the next row has to, too.
    enough = 1 if expected[:1] == [0] else 2
    for i, good in enumerate(data):
        following = [d for (_, c), d in zip(rows[i + 1 :], data[i + 1 :], strict=True) if len(c) == width][
            :FEW
        ]
        if good and (
            not following or (2 * sum(following) >= len(following) and (enough == 1 or following[0]))
        ):
            return i
    return len(rows)


def _longer_once(rows: list[tuple[int, list[str]]], width: int) -> bool:
    """Return whether only the header and the first row have further cells: a serial number (Lascar)."""
    lengths = [len(c) for _, c in rows]
    if not lengths[:1] == lengths[1:2] != [width] or not lengths[0] > width == max(lengths[2:], default=0):
        return False
    return list(map(_kind, rows[1][1][:width])) == list(map(_kind, rows[2][1]))


def _bare(cell: str) -> str:
    """Return the unit of a cell such as `[degC]`, `(degC)` or `in degC`."""
    text = cell.strip().translate(WIDE)
    while text[:1] + text[-1:] in ("[]", "()"):
        text = text[1:-1].strip()
    return text.removeprefix("in ").strip()


def _is_units(cells: list[str], above: list[str]) -> bool:
    """Return whether most cells of a line are units, and the line above it can be the header."""
    bare = [_bare(c) for c in cells]
    if any(named(c) > 0 >= named(a) and time_unit(c) is None for c, a in zip(bare, above, strict=False)):
        return False  # the names, below those of groups
    words = [c for c in bare if c and not is_number(c) and c.lower() not in ("ts", "rn") and named(c) == 0]
    right = sum(known(c) and not re.fullmatch("[A-Z][0-9]", c) for c in bare)  # T1 and V2 are names
    names = sum(bool(c) and (not is_number(c) or re.fullmatch(r"\d{1,3}", c) is not None) for c in above)
    return (
        all(len(c) <= UNIT_LENGTH for c in bare[1:])
        and right > 0
        and 2 * right > len(words)
        and 2 * names >= len(above) > 1
    )


def _unit_lines(lines_of: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Take the lines with units and kinds of values from those of the header, and return them."""
    if len(lines_of) > 2 and _is_units(lines_of[-2][1], lines_of[-3][1]) and _is_remarks(lines_of[-1][1]):
        lines_of.pop()  # the line below the units (Origin)
    if len(lines_of) > 1 and _are_above(lines_of[-2][1], lines_of[-1][1]):
        return [lines_of.pop(-2)]
    found: list[tuple[int, list[str]]] = []
    while len(lines_of) > 1 and (
        _is_kinds(lines_of[-1][1])
        or (all(_is_kinds(c) for _, c in found) and _is_units(lines_of[-1][1], lines_of[-2][1]))
    ):
        found.append(lines_of.pop())
    return found


def _are_above(cells: list[str], names: list[str]) -> bool:
    """Return whether a line is units of the names below, which have none; the first is a time's or empty."""
    units, others = ([known(_bare(c)) for c in line if c] for line in (cells, names))
    stated = any(split_words(c)[1] for c in names)
    is_time = not cells[0] or time_unit(_bare(cells[0])) is not None
    return (
        is_time
        and bool(names[0])
        and all(units)
        and not all(others)
        and not stated
        and _is_units(cells, names)
    )


def _header(
    path: Path,
    head: list[tuple[int, list[str]]],
    comments: list[tuple[int, str]],
    separator: str,
    width: int,
    data: list[list[str]],
    facts: dict[str, list[str]],
    notes: list[str],
) -> tuple[tuple[str, ...], dict[str, str], tuple[str, ...], set[int]]:
    """Return names, units, the header's cells, and the lines that they were taken from."""
    if paired := _paired(head, width, data):
        return paired
    lines_of = _header_lines(head, comments, separator, width, data)
    if not lines_of:
        _refuse_commas(path, head, separator, width, data)
        notes.append("no header: the columns are called column_1, column_2 ...")
        empty = {i for i in range(width) if data and not any(row[i] for row in data)}
        names = [f"\0{i}" if i in empty else f"column_{i + 1}" for i in range(width)]
        return tuple(names), aligned(facts, names, {}), (), set()
    below = _unit_lines(lines_of)
    while len(lines_of) > 1 and below and sum(bool(c) for c in lines_of[-1][1]) < width / 2:
        lines_of.pop()
    line, cells = lines_of[-1]
    if len(cells) < width and any(map(is_number, cells)) and all(map(_is_word, lines_of[0][1])):
        raise InputError(f"{path}:{line}: {len(cells)} cells; {width} as in the rows below were expected")
    cells = _widened(cells, width, data)
    if cells[1:] == lines_of[-1][1]:
        _index(path, line, width, data, notes)
    split = list(map(split_slash if _slashed(cells) else split_words, cells))
    names = [n for n, _ in split]
    # If the names of two columns differ only by their units, the units stay part of the names.
    named_so = {n: {c for c, (m, _) in zip(cells, split, strict=True) if m == n} for n in names}
    names = [c if len(named_so[n]) > 1 else n for c, n in zip(cells, names, strict=True)]
    names = distinct(names)
    units = {n: u for n, (_, u) in zip(names, split, strict=True) if u and n.strip()}
    for number, row in below:
        if not _is_kinds(row):
            units |= _units_of(_widened(row, width, data), names)
            notes.append(f"line {number} read as units")
            take_below(lines_of[-1][1], row, facts)
    units |= aligned(facts, names, units)
    return tuple(names), units, tuple(cells), {line, *(n for n, _ in below)}


def _units_of(cells: list[str], names: list[str]) -> dict[str, str]:
    """Return the units of a line below the header. An unknown one stays, so that a plant refuses it.

    Above the first column, of times or a counter, it is a word such as `Sequence`."""
    stated = [(n, c, spelled(_bare(c), n)) for n, c in zip(names, cells, strict=True)]
    unknown = {n for n, c, _ in stated if not is_number(c) and (n != names[0] or c != _bare(c))}
    return {n: u for n, _, u in stated if u and (known(u) or has_factor(u) or n in unknown)}


_COMMAS = "; if the numbers have decimal commas, separate the cells by semicolons"


def _refuse_commas(
    path: Path, head: list[tuple[int, list[str]]], separator: str, width: int, data: list[list[str]]
) -> None:
    """Raise InputError where decimal commas seem to part the numbers: `Time,T` above `0,5,20,5`.

    Also where there are more names than columns."""
    line, names = head[-1] if head else (0, [])
    whole = all(re.fullmatch(r"[-+]?\d*", c) for row in data for c in row)
    words = all(map(_is_word, names))
    if separator == "," and whole and 1 < len(names) < width <= 2 * len(names) and words:
        raise InputError(f"{path}:{line}: {len(names)} names, {width} cells in the rows below{_COMMAS}")
    if words and len(names) > width and any(named(n) > 0 for n in names):
        raise InputError(
            f"{path}:{line}: {len(names)} names, {width} cells in the rows below; delete the names without a column"
        )


def _is_word(cell: str) -> bool:
    return _kind(cell) == "w"


def _header_lines(
    head: list[tuple[int, list[str]]],
    comments: list[tuple[int, str]],
    separator: str,
    width: int,
    data: list[list[str]],
) -> list[tuple[int, list[str]]]:
    """Return the lines that can be the header, with those of units below it; none without a header."""
    fitting = [(n, c) for n, c in head if _fits(c, width, data)]
    # `Max;150;10` are no names; those of `Time;101;102` are.
    fitting = [
        (n, c) for n, c in fitting if not c[0] or c[0].lower() not in _KINDS or any(map(_is_word, c[1:]))
    ]
    if traced := [f for f in fitting if f[1][0] == "TraceName"]:
        return traced  # Yokogawa: above its units and rates
    lines_of = ([f for f in fitting if len(f[1]) > 1] or fitting)[-HEAD_LINES:]  # a lone word is a title
    parted = bool(lines_of) and lines_of[-1][0] != head[-1][0] and len(head[-1][1]) > 1
    stated = [c for _, c in fitting if len(list(filter(None, c))) == 2 and is_number(c[1])]
    if parted and len(stated) > 1:
        lines_of = []  # statements such as `Sampling Period,4e-7`, and a title above the rows (GW Instek)
    if not lines_of or parted:
        listed = _listed(comments, width) if not lines_of else None
        lines_of = _commented(comments, separator, width) or ([listed] if listed else lines_of)
    return lines_of


def _slashed(cells: list[str]) -> bool:
    """Return whether a header writes units as `I/mA`: its time does, or half of its cells.

    Elsewhere a slash parts the levels of a name: `kitchen/V`."""
    split = [split_slash(c) for c in cells if split_slash(c) != split_words(c)]
    return any(u in SECONDS and named(n) > 0 for n, u in split) or 2 * len(split) > sum(map(bool, cells))


def _paired(
    head: list[tuple[int, list[str]]], width: int, data: list[list[str]]
) -> tuple[tuple[str, ...], dict[str, str], tuple[str, ...], set[int]] | None:
    """Return the header of pairs of a time and a value (Beckhoff Scope): `Name CH1 Name CH2`."""
    pairs = {
        c[0].lower(): (n, c) for n, c in head if len(c) == width and width % 2 == 0 and len(set(c[::2])) == 1
    }
    if "name" not in pairs or len(data) < 2:
        return None
    names, units = [], {}
    for i, name in enumerate(pairs["name"][1][1::2]):
        names += [f"Time\0{2 * i}" if i else "Time", name]
        if "unit" in pairs and (unit := spelled(pairs["unit"][1][2 * i + 1], name)):
            units[name] = unit
        unit = next((split_unit(k)[1] for k in pairs if k.startswith("sampletime")), None)
        units[names[-2]] = unit or "ms"
    if len(set(names)) < len(names):
        return None
    return tuple(names), units, tuple(pairs["name"][1]), {n for n, _ in pairs.values()}


def _fits(cells: list[str], width: int, data: list[list[str]]) -> bool:
    """Return whether a line above the data can be its header: as wide, but for an index or an empty end."""
    filled = len(cells)
    while filled and not cells[filled - 1]:
        filled -= 1
    if filled < 2 and width > 2:
        return False
    if 2 * sum(bool(_DECIMALS.match(c)) or is_time(c) for c in cells) > filled:
        return False  # a row of values or dates above the table (EnergyPlus, Yokogawa)
    more = {c.lower() for c in cells[width:]}
    known_more = len(cells) > width and (
        more <= {"start", "increment", "comment", ""} or all(is_number(c) or not c for c in more)
    )
    return len(cells) in (width, width - 1) or filled == width or known_more


def _widened(cells: list[str], width: int, data: list[list[str]]) -> list[str]:
    """Return as many names as columns: an index, or a date and a time under one name, leave one out."""
    cells = cells[:width]
    if len(cells) == width - 1:
        kinds = [_kind(c) for c in data[0]] if data else []
        empty = bool(data) and all(not row[-1] for row in data)
        if not empty and kinds[:2] == ["t", "t"]:
            return [cells[0], f"{cells[0]} of day", *cells[1:]]
        return [*cells, ""] if empty else ["", *cells]
    return cells + [""] * (width - len(cells))


def _index(path: Path, line: int, width: int, data: list[list[str]], notes: list[str]) -> None:
    """Note a first column without a name. Raises InputError where it may be another that lacks its name.

    Dates, words, and row numbers from 1 (R writes those) are an index."""
    first = [row[0] for row in data]
    counted = first == [str(i) for i in range(1, len(first) + 1)] and any(
        "." in c for row in data for c in row
    )
    if all(map(is_number, first)) and not counted:
        raise InputError(
            f"{path}:{line}: {width - 1} names, {width} cells in the rows below; add the name that lacks to the header"
            f"{_COMMAS}"
        )
    notes.append("the header has one name less than the rows have cells: it lacks the first column's name")


def distinct(names: list[str]) -> list[str]:
    """Return names that differ: a repeated or missing one gets \\0 and its place, the first a blank."""
    if not names[0]:
        names = [" ", *names[1:]]
    return [name if name and name not in names[:i] else f"{name}\0{i}" for i, name in enumerate(names)]


def _is_remarks(cells: list[str]) -> bool:
    """Return whether a line holds neither names of times, nor units, nor kinds of values."""
    return not _is_kinds(cells) and not any(known(_bare(c)) or split_words(c)[1] or named(c) for c in cells)


def _is_kinds(cells: list[str]) -> bool:
    return all(c.lower() in _KINDS for c in cells) and len({c.lower() for c in cells}) <= len(_KINDS)


def _commented(comments: list[tuple[int, str]], separator: str, width: int) -> list[tuple[int, list[str]]]:
    """Return the last comment as wide as the data, of units with that above: numpy, gnuplot, others."""
    found: list[tuple[int, list[str]]] = []
    for number, text in (c for c in reversed(comments) if c[1].strip()):
        for sep in (separator, ",", ";", "\t", "  ", " "):
            cells = cells_of(text, sep)
            stated = _STATED.match(text) or (cells[0].endswith(":") and not cells[-1].endswith(":"))
            if len(cells) == width and not any(_kind(c) in "t" for c in cells) and not stated:
                if found:
                    return [(number, cells), *found] if _is_units(found[0][1], cells) else found
                found = [(number, cells)]
                break
    return found


def _listed(comments: list[tuple[int, str]], width: int) -> tuple[int, list[str]] | None:
    """Return names that stand above the table one a line: `Channel : RPM`, `name 0 = timeS: Time`.

    Their key stands once for each column; a time in the first one may have none."""
    by_key: dict[str, list[str]] = {}
    for _, text in comments:
        if match := re.match(r"([A-Za-z][A-Za-z _]*?)\s*\d*\s*[:=]\s*(.+)$", text):
            by_key.setdefault(match[1].lower(), []).append(match[2])
    for names in by_key.values():
        timed = ["Time"] * (width - len(names)) + names
        if len(names) > 1 and len(set(timed)) == width <= len(names) + 1 and not any(map(is_number, names)):
            return comments[-1][0], timed
    return None


def _decimal(data: list[list[str]], separator: str) -> str | None:
    """Return the decimal sign that the sample shows; None where a comma may part thousands."""
    cells = [x for c in data for x in c if re.search(r"\d", x)]
    commas = [x for x in cells if _COMMA.match(x)]
    if not commas:
        if separator in ";\t" and any(map(_parts_thousands, zip(*data, strict=True))):
            return ","
        return None if any("," in x and not is_time(x) for x in cells) else "."
    if any(re.match(r"[-+]?\d*\.\d", x) for x in cells):
        return None
    return "," if separator == ";" or any(not _AMBIGUOUS.match(x) for x in commas) else None


def _parts_thousands(column: tuple[str, ...]) -> bool:
    """Return whether the points of a column part thousands: `950` before `1.050`, no other digits."""
    parted = [c for c in column if re.fullmatch(r"[-+]?[1-9]\d{0,2}(\.\d{3})+", c)]
    whole = [c for c in column if re.fullmatch(r"[-+]?\d{1,3}", c)]
    others = [c for c in column if not is_missing(c) and c not in parted and c not in whole]
    return bool(parted and whole) and not others and any(c.endswith("0") for c in parted)


def _perhaps_thousands(data: list[list[str]]) -> str:
    """Return a number such as 1.200 where every point in the sample may part thousands; '' else."""
    pointed = [c for row in data for c in row if _DECIMALS.match(c)]
    return pointed[0] if all(re.match(r"[-+]?[1-9]\d{0,2}\.\d{3}$", c) for c in pointed) and pointed else ""


def _numeric(names: tuple[str, ...], data: list[list[str]]) -> frozenset[str]:
    """Return the columns of plain numbers in the sample; 15 digits and more are texts."""
    plain = re.compile(r"(?!\d{15,}$)-?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?$")
    filled = {n: [r[i] for r in data if not is_missing(r[i])] for i, n in enumerate(names)}
    return frozenset(n for n, seen in filled.items() if seen and all(plain.match(c) for c in seen))
