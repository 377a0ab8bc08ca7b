"""Cells of text as numbers: every spelling of numbers, of on and off, and of "no value".

The whole column decides. A cell that could be two different numbers is an error, never a guess.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from thermoctl.recording.foreign.units import WORDS, known, scale_between, spelled

MISSING = frozenset({"", *(w.strip() for w in WORDS["missing"].split("|"))})
"""Cells that mean "no value", in lower case."""
_MARKS = r"^(?:[-+*?.=_~–—∞]+|#{2,}|[-+]?\d\.#\w+)$"
"""Cells of marks only, as loggers write them out of range, and NaN as Windows prints it, such as -1.#J."""
_AROUND = r"^[-+*\[(<{]+([^\W\d].*?)[-+*\])>}]*$"
"""A word between marks: `[N/A]`, `-----OL-----`."""
_NO_READING = 9.9e37  # devices with SCPI send this and larger numbers for "overload" and "no value"
_CODES = re.compile(
    r"-99|-?9{3,}|-?99+\.9+|-?[67]999|85|-127|32767|-32768|65535|327\.67|-327\.68|3276\.7|-3276\.8|655\.35|6553\.5"
)
"""Numbers that sensors and loggers write without a reading: 85 and -127 are those of a DS18B20."""
_FAR = 2.0  # a code is further from the other readings than this many times their range
_HUGE = 1e9  # larger numbers are codes, such as 1e37, if the others are small
PAIRS = tuple(tuple(pair.split("/")) for pair in WORDS["pairs"].split())
"""Words of two-valued columns: the first of a pair is 1, the second 0."""
_GROUP = " '’_\u00a0\u2009\u202f"
_SIGNS = "−–—‒﹣－"
_NUMBER = (
    rf"^(?P<open>\()?(?P<sign>[+-])?\s*(?P<body>\d+(?:[.,{_GROUP}]\d+)*[.,]?|[.,]\d+)"
    rf"(?P<exp>[eEdDqQ][+-]?\d+)?(?P<back>-)?(?P<close>\))?(?P<unit>\s*[^\d\s.,+\-:()][^:,()]{{0,11}}|\s+1/\w+)?$"
)
_TIGHT = re.compile(_NUMBER)
_PLAIN = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_READINGS = {
    ".": rf"^(\d+|[1-9]\d{{0,2}}(,\d{{3}})+|[1-9]\d?(,\d\d)+,\d{{3}}|[1-9]\d{{0,2}}([{_GROUP}]\d{{3}})+)?(\.\d*)?$",
    ",": rf"^(\d+|[1-9]\d{{0,2}}(\.\d{{3}})+|[1-9]\d{{0,2}}([{_GROUP}]\d{{3}})+)?(,\d*)?$",
}
_UNGROUPED = str.maketrans("", "", ".,")
FEW_WORDS = 3  # up to so many different words among numbers are a status; more are remarks


@dataclass(frozen=True)
class Numbers:
    """A column of numbers (N,) float64, NaN where missing; its unit, if cells state one; notes for people."""

    values: np.ndarray
    unit: str | None = None
    notes: tuple[str, ...] = ()


class CellError(Exception):
    """A cell that cannot be read: the row, from 0, and the reason."""

    def __init__(self, row: int, reason: str):
        super().__init__(reason)
        self.row, self.reason = row, reason


def is_missing(cell: str) -> bool:
    """Return whether a cell means "no value"."""
    word = cell.strip().lower()
    return word in MISSING or re.sub(_AROUND, r"\1", word) in MISSING or re.match(_MARKS, word) is not None


def is_number(cell: str) -> bool:
    """Return whether a cell can be a number, in any spelling, also with a unit."""
    match = _TIGHT.match(_tidy_one(cell))
    return match is not None and (not match["unit"] or known(match["unit"].strip()))


def has_no_readings(columns: Mapping[str, np.ndarray]) -> bool:
    """Return whether columns hold numbers by which SCPI says that there is no reading."""
    numbers = (v for v in columns.values() if v.dtype.kind == "f" and len(v))
    return any(np.fmax.reduce(np.abs(v)) >= _NO_READING for v in numbers)


def readings(name: str, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return numbers (N,) without those by which SCPI says that there is no reading; note them."""
    if not has_no_readings({name: values}):
        return values
    none = np.abs(values) >= _NO_READING
    notes.append(f"'{name}': {int(none.sum())} numbers of 9.9e37 and more read as no value")
    return np.where(none, np.nan, values)


def _is_code(value: float) -> bool:
    return abs(value) >= _HUGE or _CODES.fullmatch(f"{value:.10g}") is not None


def suspected_codes(columns: Mapping[str, np.ndarray]) -> list[str]:
    """Return a note for each number that may mean "no value".

    Such a number is far from the other readings of its column. It stays in the column."""
    notes = []
    for name, values in columns.items():
        rest, found = values[np.isfinite(values)], list[float]()
        while len(rest) and (code := next(filter(_is_code, (rest.min(), rest.max())), None)) is not None:
            found.append(float(code))
            rest = rest[rest != code]
        low, high = (rest.min(), rest.max()) if len(rest) else (0.0, 0.0)
        for code in found:
            if 0.0 < _FAR * (high - low) < max(low - code, code - high):
                said = f"{code:.10g}" if float(f"{code:.10g}") == code else repr(code)
                notes.append(
                    f"'{name}': {said} stands {int((values == code).sum())} times, the other readings are {low:g} to "
                    f"{high:g}: if it means 'no reading', give --missing={said}"
                )
    return notes


def _tidy_one(cell: str) -> str:
    return re.sub(f"[{_SIGNS}]", "-", re.sub(r'^="?([^"]*)"?$', r"\1", cell.strip().strip("\"'")))


def _tidied(texts: pa.Array) -> pa.Array:
    """Return cells without blanks and quotes at their ends, with one kind of minus sign."""
    texts = pc.utf8_trim(texts, characters=" \t\"'\u00a0\u2009\u202f\ufeff")
    texts = pc.replace_substring_regex(texts, f"[{_SIGNS}]", "-")
    return pc.replace_substring_regex(texts, r'^="?([^"]*)"?$', r"\1")


def decimal_signs(texts: pa.Array) -> set[str]:
    """Return the decimal signs with which all numbers of a column can be read.

    An empty set says that no sign fits all of them."""
    parts = pc.extract_regex(_tidied(texts), _NUMBER)
    body = pc.drop_null(parts.field("body").filter(parts.is_valid()))
    return {s for s, pattern in _READINGS.items() if pc.all(pc.match_substring_regex(body, pattern)).as_py()}


def differs(texts: pa.Array) -> bool:
    """Return whether the decimal sign makes a difference in a column."""
    parts = pc.extract_regex(_tidied(texts), _NUMBER)
    body = pc.drop_null(parts.field("body").filter(parts.is_valid()))
    return bool(pc.any(pc.match_substring_regex(body, "[.,]")).as_py())


def words(texts: pa.Array, also_missing: Collection[str] = ()) -> tuple[pa.Array, pa.Array, list[str]]:
    """Return tidy cells, a mask of the missing ones, and the words that stand for "no value" there."""
    tidy = _tidied(texts)
    lower = pc.utf8_lower(tidy)
    spellings = sorted(MISSING | {m.strip().lower() for m in also_missing})
    bare = pc.replace_substring_regex(lower, _AROUND, r"\1")
    known_words = (pc.is_in(w, pa.array(spellings)) for w in (lower, bare))
    missing = pc.fill_null(pc.or_(*known_words), True)
    missing = pc.or_(missing, pc.fill_null(pc.equal(tidy, ""), True))
    missing = pc.or_(missing, pc.fill_null(pc.match_substring_regex(tidy, _MARKS), False))
    shown = pc.unique(pc.drop_null(tidy.filter(missing))).to_pylist()
    return tidy, missing, [w for w in shown if len(w) > len("null") or w in also_missing]


def numbers(
    name: str, texts: pa.Array, decimal: str | None, also_missing: Collection[str] = ()
) -> Numbers | None:
    """Return a column of texts as numbers; None for a column of words. Raises CellError.

    `decimal`: the sign that other columns of the file show, for a column that fits both. Words among numbers
    are an error that names --missing; a column of which most cells are remarks is one of words."""
    tidy, missing, shown = words(texts, also_missing)
    filled = tidy.filter(pc.invert(missing))
    note = (f"'{name}': {', '.join(repr(w) for w in shown)} read as no value",) if shown else ()
    if not len(filled):
        only = pc.unique(pc.utf8_lower(pc.drop_null(tidy))).to_pylist()
        if "open" in only and set(only) <= {"open", "", "unavailable", "unknown"}:
            return _switched(name, tidy, ("open", "closed"))
        return Numbers(np.full(len(texts), np.nan), None, note)
    if (paired := _pair(name, tidy, filled)) is not None:
        return paired
    empty = missing.to_numpy(zero_copy_only=False)
    plain = pc.fill_null(pc.match_substring_regex(tidy, _PLAIN), False).to_numpy(zero_copy_only=False)
    if (plain | empty).all() and decimal != ",":
        return Numbers(_floats(tidy, missing), None, note)
    parts = pc.extract_regex(tidy, _NUMBER)
    unit = pc.utf8_trim_whitespace(parts.field("unit"))
    right = parts.is_valid().to_numpy(zero_copy_only=False)
    for text in pc.unique(pc.drop_null(unit)).to_pylist():
        if text and not known(text):
            right &= ~pc.fill_null(pc.equal(unit, text), False).to_numpy(zero_copy_only=False)
    wrong = ~(right | empty)
    if wrong.any():
        _refuse(name, tidy, wrong, int((right & ~empty).sum()))
        return None
    body = parts.field("body")
    if not any(pc.any(pc.match_substring_regex(body, p)).as_py() for p in _READINGS.values()):
        return None  # identities such as 345_9356_33_6
    values, grouped = _valued(parts, empty, decimal)
    if grouped:
        note = (
            *note,
            f"'{name}': {grouped} read as {grouped.translate(_UNGROUPED)}, with a separator of thousands",
        )
    return with_units(name, values, unit, empty, note)


def _pair(name: str, tidy: pa.Array, filled: pa.Array) -> Numbers | None:
    lower = set(pc.unique(pc.utf8_lower(filled)).to_pylist())
    fits = [(yes, no) for yes, no in PAIRS if lower <= {yes, no}]
    if not fits and lower == {"closed"}:
        fits = [("open", "closed")]
    return _switched(name, tidy, fits[0]) if fits else None


def _switched(name: str, tidy: pa.Array, pair: tuple[str, str]) -> Numbers:
    low = pc.utf8_lower(tidy)
    yes, no = (pc.fill_null(pc.equal(low, w), False).to_numpy(zero_copy_only=False) for w in pair)
    values = np.where(yes, 1.0, np.where(no, 0.0, np.nan))
    return Numbers(values, None, (f"'{name}': {pair[0]} read as 1, {pair[1]} as 0",))


def _floats(texts: pa.Array, missing: pa.Array) -> np.ndarray:
    bare = pc.replace_substring_regex(texts, r"^\+", "")
    bare = pc.if_else(missing, pa.scalar(None, pa.string()), bare)
    return np.array(bare.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)


def _refuse(name: str, tidy: pa.Array, wrong: np.ndarray, count: int) -> None:
    """Raise CellError for words among numbers; return for a column of remarks."""
    remarks = pc.unique(tidy.filter(pa.array(wrong))).to_pylist()
    if count == 0 or (len(remarks) > FEW_WORDS and count <= wrong.sum()):
        return
    row = int(wrong.argmax())
    text = tidy[row].as_py()[:40]
    raise CellError(
        row,
        f"'{text}' stands where a number belongs (empty the cell where a sample is missing"
        + (f", or --missing '{text}'" if text else "")
        + (f"; {int(wrong.sum())} cells are no number)" if wrong.sum() > 1 else ")"),
    )


def _valued(parts: pa.Array, empty: np.ndarray, decimal: str | None) -> tuple[np.ndarray, str]:
    """Return the numbers, and one that only the file's decimal sign shows to have thousands; '' for none."""
    body = pc.if_else(pa.array(empty), pa.scalar(None, pa.string()), parts.field("body"))
    fits = {s: pc.fill_null(pc.match_substring_regex(body, p), True) for s, p in _READINGS.items()}
    whole = [s for s, m in fits.items() if pc.all(m).as_py()]
    if not whole:
        sign = decimal or max(fits, key=lambda s: pc.sum(fits[s].cast(pa.int64())).as_py() or 0)
        row = int(np.argmin(fits[sign].to_numpy(zero_copy_only=False)))
        shown = {".": "point", ",": "comma"}[sign]
        raise CellError(
            row, f"'{body[row].as_py()[:40]}' stands where a number with a decimal {shown} belongs"
        )
    chosen = whole[0] if len(whole) == 1 else decimal
    if chosen is None:
        if pc.any(pc.match_substring_regex(body, "[.,]")).as_py():
            row = pc.index(pc.fill_null(pc.match_substring_regex(body, "[.,]"), False), True).as_py()
            raise CellError(
                row,
                f"'{body[row].as_py()}' has a decimal sign or a separator of thousands, and no number of the file says "
                "which; say it with --decimal , or --decimal .",
            )
        chosen = "."
    sign = chosen
    apart = pc.drop_null(body.filter(pc.match_substring(body, "," if sign == "." else ".")))
    grouped = apart[0].as_py() if len(whole) > 1 and len(apart) else ""
    body = pc.replace_substring_regex(body, f"[{_GROUP}{'.' if sign == ',' else ','}]", "")
    body = pc.replace_substring(body, sign, ".")
    # Without the exponent's letter a Fortran double is a float; an empty group gives an empty text.
    exponent = pc.replace_substring_regex(parts.field("exp"), "[dDqQ]", "e")
    texts = pc.binary_join_element_wise(body, exponent, "")
    values = _floats(pc.if_else(pc.equal(texts, ""), pa.scalar(None, pa.string()), texts), pa.array(empty))
    signs = np.ones(len(values))
    opened, closed = (pc.not_equal(parts.field(k), "") for k in ("open", "close"))
    if pc.any(pc.not_equal(opened, closed)).as_py():
        raise CellError(pc.index(pc.not_equal(opened, closed), True).as_py(), "a bracket is not closed")
    for minus in (
        pc.equal(parts.field("sign"), "-"),
        pc.equal(parts.field("back"), "-"),
        pc.fill_null(pc.not_equal(parts.field("open"), ""), False),
    ):
        signs[pc.fill_null(minus, False).to_numpy(zero_copy_only=False)] *= -1
    return values * signs, grouped


def with_units(
    name: str, values: np.ndarray, unit: pa.Array, empty: np.ndarray, note: tuple[str, ...]
) -> Numbers:
    """Bring a column to the unit that its first cell states; cells of other prefixes are converted."""
    filled = np.flatnonzero(~empty)
    units = [u or "" for u in pc.unique(pc.drop_null(unit.filter(pa.array(~empty)))).to_pylist()]
    if units == [""] or not units:
        return Numbers(values, None, note)
    first = spelled(unit[int(filled[0])].as_py() or "")
    for text in units:
        here = pc.fill_null(pc.equal(unit, text), False).to_numpy(zero_copy_only=False) & ~empty
        scale = scale_between(spelled(text), first)
        if scale is None and np.any(values[here] != 0):
            raise CellError(
                int(np.flatnonzero(here)[0]),
                f"a value in '{text}' among values in '{first or 'no unit'}'; one unit was expected",
            )
        values = np.where(here, values * (scale if scale is not None else 1.0), values)
    said = f"'{name}': unit {first} from its cells" if first else ""
    mixed = f"; {', '.join(u for u in units if spelled(u) != first)} converted" if len(units) > 1 else ""
    return Numbers(values, first, (*note, said + mixed) if said else note)
