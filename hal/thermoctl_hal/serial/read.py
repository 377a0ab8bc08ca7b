"""Read the parts of a profile about serial devices: binary frames and lines of text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from thermoctl.files.yamlfile import Node, Section, integer_of, suggest
from thermoctl_hal.base.checksum import ALIASES, SUMS, algorithm, names
from thermoctl_hal.base.key import check_bits, named, take
from thermoctl_hal.base.profile import (
    FRAME_TYPES,
    BinaryFrame,
    Bits,
    BusSpec,
    Condition,
    LineSettings,
    TextField,
    TextLine,
    typed,
)
from thermoctl_hal.serial.keys import SERIAL
from thermoctl_hal.serial.text_number import BASES, takes_letters

# limits of wire.Framer: sync and tail bytes, fields, payload bytes (a uint8 length)
MAX_SYNC, MAX_FIELDS, MAX_PAYLOAD = 8, 64, 255
_ORDER = {"little": "<", "big": ">"}
_TYPES = "int8 .. int64, uint8 .. uint64, float32, float64, bcd8 .. bcd64, hex1 .. hex16, digits1 .. digits16, skip1 .. skip64"


def read_line(top: Section) -> LineSettings:
    """Read the settings of the serial line."""
    s = top.section("line", False)
    if s is None:
        return LineSettings()
    k = take(s, SERIAL["line"])
    s.end()
    return LineSettings(**k)


def read_frame(top: Section, folder: Path) -> BinaryFrame:
    """Read `frame` of a serial-binary device."""
    s = top.section("frame")
    if s.get("crc", False) is None:
        raise s.node.error(
            f"frame: 'crc' is missing: one of {', '.join((*ALIASES, *SUMS, 'none'))} ('none': frames have no "
            "checksum), or a name of the CRC catalogue as CRC-32/ISO-HDLC"
        )
    k = take(s, SERIAL["frame"])
    request, hz = _request(s, k)
    sync = _bytes(s, "sync", k["sync"])
    if not sync and not request:
        raise s.get("sync").error(
            f"sync: 1 to {MAX_SYNC} bytes were expected; none is for a device that answers a 'request'"
        )
    fields, more = _fields(s, k["fields"])
    known = [n for n, _ in fields] + [b.name for b in more["bits"]]
    if len(set(known)) != len(known) or not 1 <= len(known) <= MAX_FIELDS:
        raise s.get("fields").error(f"fields: 1 to {MAX_FIELDS} fields of different names were expected")
    for n in more["signs"].values():
        if n.field not in known:
            raise s.get("fields").error(f"sign: '{n.field}' is no field{suggest(n.field, known)}")
    frame = BinaryFrame(
        sync,
        fields,
        _ORDER[k["endian"]],
        k["length"],
        checksum_name(s),
        _ORDER[k["crc_endian"]],
        k["crc_over"],
        _bytes(s, "tail", k["tail"] or []),
        named(s, "sequence", known) if k["sequence"] else "",
        _invalid(k["invalid"], known),
        request=request,
        request_hz=hz,
        answer_s=k["answer_s"],
        **more,
    )
    if frame.payload_size > MAX_PAYLOAD:
        raise s.get("fields").error(
            f"fields: {frame.payload_size} bytes; at most {MAX_PAYLOAD} fit the length byte"
        )
    s.end()
    return frame


def _bytes(s: Section, key: str, nodes: list[Node]) -> bytes:
    content = bytes(integer_of(n, key, 0, 255) for n in nodes)
    if len(content) > MAX_SYNC:
        raise s.get(key).error(f"{key}: at most {MAX_SYNC} bytes were expected, found {len(content)}")
    return content


def checksum_name(s: Section) -> str:
    """Return the checksum's name in `crc`. Raises InputError with the nearest names."""
    name = s.text("crc")
    if algorithm(name) is None:
        raise s.get("crc").error(
            f"crc: '{name}' is not one of {', '.join((*ALIASES, *SUMS, 'none'))} and is not in the CRC catalogue"
            f"{suggest(name.upper(), names())}"
        )
    return name


def _fields(s: Section, nodes: list[Node]) -> tuple[tuple[tuple[str, str], ...], dict[str, Any]]:
    """Return the fields (name, type), and the other arguments of a BinaryFrame about fields."""
    fields: list[tuple[str, str]] = []
    bits: list[Bits] = []
    signs: dict[str, Condition] = {}
    constants: dict[str, int] = {}
    other: set[str] = set()
    for node in nodes:
        f = Section(node, "field")
        k = take(f, SERIAL["field"])
        f.end()
        name = k["name"] or (f"skip at {len(fields)}" if k["type"].startswith("skip") else "")
        if not name:
            raise node.error("field: 'name' is missing")
        if k["of"]:
            bits.append(_bits(f, k, name, fields))
        elif k["bits"] or k["low_bit"] or k["signed"]:
            raise node.error(
                f"field '{name}': 'bits', 'low_bit' and 'signed' belong to a field with 'of': add one for the bits, "
                "of this field; a sign is part of the type, as int16"
            )
        elif k["type"] not in FRAME_TYPES:
            raise node.error(
                f"type: '{k['type']}' is not one of {_TYPES}{suggest(k['type'], FRAME_TYPES)}"
                if k["type"]
                else f"field '{name}': 'type' is missing, or 'of' for some bits of another field"
            )
        else:
            fields.append((name, k["type"]))
        if k["endian"] and k["endian"] != s.text("endian", "little"):
            other.add(name)
        if k["equals"] is not None:
            constants[name] = k["equals"]
        if k["sign"] is not None:
            sign = take(k["sign"], SERIAL["sign of a field"])
            k["sign"].end()
            signs[name] = Condition(sign["field"], sign["mask"], sign["minus"])
    return tuple(fields), {
        "bits": tuple(bits),
        "signs": signs,
        "constants": constants,
        "other_endian": frozenset(other),
    }


def _bits(f: Section, k: dict[str, Any], name: str, fields: list[tuple[str, str]]) -> Bits:
    kinds = dict(fields)
    of = named(f, "of", kinds)
    kind, size = FRAME_TYPES[kinds[of]]
    widths = {"int": 8 * size, "uint": 8 * size, "hex": 4 * size}
    check_bits(f, k, widths.get(kind, 0), f"'{of}', a {kinds[of]}")
    if not k["bits"] or k["type"]:
        raise f.node.error(f"field '{name}': it is some bits of '{of}': give 'bits', and no 'type'")
    return Bits(name, of, k["low_bit"], k["bits"], k["signed"])


def _invalid(s: Section | None, known: list[str]) -> Condition | None:
    if s is None:
        return None
    k = take(s, SERIAL["invalid of serial-binary"])
    condition = Condition(named(s, "field", known), k["mask"], k["good"])
    s.end()
    return condition


def _request(s: Section, k: dict[str, Any]) -> tuple[bytes, float]:
    request = bytes_of(k["request"], "request") if k["request"] is not None else b""
    if bool(request) != (k["request_hz"] > 0):
        raise s.node.error(f"{s.what}: 'request' and 'request_hz' belong together")
    return request, k["request_hz"]


def bytes_of(node: Node, key: str) -> bytes:
    """Return the bytes of a list of numbers, or of text with escapes as \\r. Raises InputError."""
    if isinstance(node.value, list):
        return bytes(integer_of(n, key, 0, 255) for n in node.value)
    if not isinstance(node.value, str):
        raise node.error(f"{key}: text or a list of bytes was expected")
    try:
        return node.value.encode("ascii").decode("unicode_escape").encode("latin-1")
    except ValueError as e:
        raise node.error(f"{key}: text with escapes as \\r, \\n, \\x02 was expected: {e}") from None


def read_field(s: Section, spec: BusSpec) -> str:
    """Read the place of a channel of a serial-binary device: the name of a field."""
    take(s, SERIAL["channel of serial-binary"])
    return named(s, "field", [n for n in typed(spec, BinaryFrame).names if not n.startswith("skip at ")])


def read_text(top: Section, folder: Path) -> TextLine:
    """Read `text` of a serial-lines device."""
    s = top.section("text")
    k = take(s, SERIAL["text"])
    pattern = _pattern(s, "pattern", k["pattern"])
    if not pattern.groupindex:
        raise s.get("pattern").error(
            "pattern: named groups (?P<name>...) were expected, one for each reading"
        )
    request, hz = _request(s, k)
    end = bytes_of(s.get("end"), "end") if k["end"] else b""
    spec = TextLine(pattern, request, hz, k["decimal"], k["answer_s"], end, _checksum(k["checksum"]))
    s.end()
    return spec


def _pattern(s: Section, key: str, text: str) -> re.Pattern[str]:
    try:
        return re.compile(text, re.ASCII)
    except re.error as e:
        raise s.get(key).error(f"{key}: not a regular expression: {e}") from None


def _checksum(s: Section | None) -> tuple[str, re.Pattern[str]] | None:
    if s is None:
        return None
    k = take(s, SERIAL["checksum of text"])
    pattern = _pattern(s, "pattern", k["pattern"])
    if not {"data", "sum"} <= set(pattern.groupindex):
        raise s.node.error("checksum: the groups (?P<data>...) and (?P<sum>...) were expected in its pattern")
    s.end()
    return checksum_name(s), pattern


def read_text_field(s: Section, spec: BusSpec) -> TextField:
    """Read the place of a channel of a serial-lines device: groups of the pattern."""
    pattern = typed(spec, TextLine).pattern
    k = take(s, SERIAL["channel of serial-lines"])
    group = named(s, "field", pattern.groupindex)
    if k["base"] not in BASES:
        raise s.get("base").error(f"base: {k['base']} is not one of {', '.join(map(str, BASES))}")
    if s.get("base", False) is None and takes_letters(pattern, group):
        raise s.node.error(
            f"{s.what}: group '{group}' of the pattern also takes the letters A to F: "
            "say base: 16, or base: 10"
        )
    for key in ("sign", "unit_field"):
        if k[key]:
            named(s, key, pattern.groupindex)
    factors: dict[str, float] = {}
    if k["unit_factors"] is not None:
        units = k["unit_factors"]
        factors = {name: units.number(name) for name in units.node.value}
    if bool(factors) != bool(k["unit_field"]):
        raise s.node.error(f"{s.what}: 'unit_field' and 'unit_factors' belong together")
    return TextField(group, k["base"], k["sign"], k["unit_field"], factors)
