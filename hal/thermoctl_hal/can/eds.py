"""Read the types of objects from an EDS file (CiA 306); only those that a profile names must be sound.

Of each section `[6041]` or `[1A00sub3]` name, types, AccessType, PDOMapping and the limits count. Other
lines, and faults in them, are passed over with one warning.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from thermoctl_hal.base.profile import Object, object_name
from thermoctl_hal.base.text_file import read_text, while_same

_SECTION = re.compile(r"\s*\[\s*([^\];]*?)\s*(?:\]|$|;)")  # the second bracket may be missing
_OBJECT = re.compile(r"(?:0x)?([0-9A-F]{4})h?(?:\s*sub\s*(?:0x)?([0-9A-F]{1,2})h?)?", re.IGNORECASE)
_NUMBER = re.compile(r"([+-]?)\s*(?:0x([0-9A-F]+)h?|([0-9A-F]+)h|(\d+))", re.IGNORECASE)
_COMMENT = (";", "#", "//")
_NAMES = ("boolean", "integer8", "integer16", "integer32", "unsigned8", "unsigned16", "unsigned32", "real32")
"""Data types of CiA 301 from number 1 on, by name."""
_VARIABLE = 0x7  # ObjectType; a missing one is a variable
LAST_SUB = 254


@dataclass
class Entry:
    """A section of the file: its line, and the keys that count, by lower-case name."""

    line: int
    again: Entry | None = None  # another section of the same object, with another type
    keys: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return the object's name."""
        return self.keys.get("parametername", "")

    @property
    def data_type(self) -> int | None:
        """Return the number of the data type; None where there is none."""
        text = _plain(self.keys.get("datatype", "")).lower()
        return _NAMES.index(text) + 1 if text in _NAMES else _number(text)

    @property
    def access(self) -> str:
        """Return ro, wo, rw, rwr, rww or const; '' where the file does not state it."""
        return _plain(self.keys.get("accesstype", "")).lower()

    @property
    def in_pdo(self) -> bool:
        """Return whether a PDO may hold the object: the file does not state PDOMapping=0."""
        return _number(self.keys.get("pdomapping", "1")) != 0

    @property
    def limits(self) -> tuple[float, float]:
        """Return LowLimit and HighLimit; without bounds where they are not stated or leave no range.

        Raises ValueError for a limit that is no number: it must not be passed over."""
        low, high = (self._limit(key) for key in ("LowLimit", "HighLimit"))
        bounds = -math.inf if low is None else low, math.inf if high is None else high
        return bounds if bounds[0] < bounds[1] else (-math.inf, math.inf)

    def _limit(self, key: str) -> int | None:
        """Return a limit; a hexadecimal one of a signed type is a two's complement, also of 32 bits."""
        text = _plain(self.keys.get(key.lower(), ""))
        if not text or "$NODEID" in text.upper():
            return None
        value, bits = _number(text), {2: 8, 3: 16, 4: 32}.get(self.data_type or 0, 0)
        octal = re.fullmatch(r"[+-]?0+([1-7][0-7]+)", text)
        if value is None or octal:
            either = f" (it could be octal, {int(octal[1], 8)})" if octal else ""
            raise ValueError(
                f"{key}={text}, which is no decimal number and no 0x..{either}: correct the file"
            )
        for width in (bits, 32) if bits else ():
            if -(1 << (bits - 1)) <= value - (1 << width) < 0:
                return value - (1 << width)
        return value


@dataclass(frozen=True)
class Eds:
    """The objects of an EDS file. `warning`: file, line and object of the first oddity; '' without any."""

    entries: dict[Object, Entry]
    warning: str

    def subs(self, index: int) -> list[int]:
        """Return the sub-indices above 0 of an object."""
        return sorted(o.sub for o in self.entries if o.number == index and o.sub)

    def has(self, index: int) -> bool:
        """Return whether the file has an object of this index."""
        return any(o.number == index for o in self.entries)


def _plain(text: str) -> str:
    """Return a value without its comment, blanks and quotes."""
    return re.split("[;#]|//", text)[0].strip().strip("'\"")


def _number(text: str) -> int | None:
    """Return a number as EDS files write it: 7, -7, 0x0007, 0007h; None for other text."""
    match = _NUMBER.fullmatch(_plain(text))
    if match is None:
        return None
    value = int(match[2] or match[3] or match[4], 10 if match[4] else 16)
    return -value if match[1] == "-" else value


@while_same
def read_eds(path: Path) -> Eds:
    """Read an EDS file. Raises OSError; ValueError where it has no object."""
    entries, remarks = _sections(read_text(path).split("\n"))
    if not entries:
        raise ValueError(
            "it has no section of an object, as [6041]; of an XDD or ESI file (XML) the maker's tool saves an EDS "
            "file, or give the types of the objects as 'objects'"
        )
    # The sub-indices that CompactSubObj counts have the type of their object.
    for item, entry in list(entries.items()):
        count = _number(entry.keys.get("compactsubobj", ""))
        for sub in range(1, min(count or 0, LAST_SUB) + 1):
            entries.setdefault(Object(item.number, sub), Entry(entry.line, keys=entry.keys))
    remarks += _odd(entries)
    remarks.sort()
    more = f"; and {len(remarks) - 1} more" if len(remarks) > 1 else ""
    return Eds(entries, f"{path}:{remarks[0][0]}: {remarks[0][1]}{more}" if remarks else "")


def _sections(lines: list[str]) -> tuple[dict[Object, Entry], list[tuple[int, str]]]:
    """Return the objects' sections, and what was passed over: (line, description)."""
    entries: dict[Object, Entry] = {}
    remarks: list[tuple[int, str]] = []
    counts: dict[int, int] = {}  # index -> line of its sub-index 0
    entry: Entry | None = None
    for number, line in enumerate(lines, 1):
        text = line.strip().strip("\ufeff\0\x1a")
        if not text or text.startswith(_COMMENT):
            if text.startswith("//"):
                remarks.append((number, f"'{text[:40]}' is no comment of the format, passed over"))
            continue
        if section := _SECTION.match(text):
            match = _OBJECT.fullmatch(section[1])
            entry = Entry(number) if match else None
            if match and entry:
                item = Object(int(match[1], 16), int(match[2] or "0", 16))
                if match[2] and not item.sub:
                    counts.setdefault(item.number, number)  # [2022sub0] counts the sub-indices of [2022]
                elif entries.setdefault(item, entry) is not entry:
                    entries[item].again = entry
                    remarks.append((number, f"object {object_name(item)} stands twice, the first one counts"))
            continue
        key, *value = re.split("[=:]", text, maxsplit=1)
        if not value:
            remarks.append((number, f"'{text[:40]}' is no line of the format, passed over"))
        elif entry is not None and value[0].strip():
            entry.keys.setdefault(key.strip().lower(), value[0].strip())
    lost = ((n, i) for i, n in counts.items() if Object(i) not in entries)
    return entries, remarks + [(n, f"[{i:04X}sub0] has no object [{i:04X}]") for n, i in lost]


def _odd(entries: dict[Object, Entry]) -> Iterator[tuple[int, str]]:
    """Name the objects that cannot be used: without a type, or sub-indices without an object."""
    with_subs = {o.number for o in entries if o.sub}
    for item, entry in entries.items():
        kind = _number(entry.keys.get("objecttype", "")) or _VARIABLE
        if item.sub and Object(item.number) not in entries:
            yield entry.line, f"[{item.number:04X}sub{item.sub:X}] has no object [{item.number:04X}]"
        elif item.number not in with_subs and "objecttype" not in entry.keys and "datatype" not in entry.keys:
            yield entry.line, f"object {object_name(item)} has neither ObjectType nor DataType"
        elif (item.sub or item.number not in with_subs) and kind == _VARIABLE and entry.data_type is None:
            yield entry.line, f"object {object_name(item)} has no DataType"
