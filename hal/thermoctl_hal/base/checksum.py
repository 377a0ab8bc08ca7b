"""Checksums by name: sums, XOR, and the CRCs of the public catalogue (reveng), from the library crccheck."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

SUMS = ("sum8", "sum8-inverted", "sum8-negated", "sum16", "xor8")
"""Sums of the bytes modulo 2^8 or 2^16; inverted: its complement; negated: the sum of all bytes is then 0."""
ALIASES = {"ccitt-false": "CRC-16/IBM-3740", "xmodem": "CRC-16/XMODEM", "modbus": "CRC-16/MODBUS"}
_WIDTHS = (8, 16, 24, 32, 40, 64)


@dataclass(frozen=True)
class Algorithm:
    """kind: none, sum, xor or crc; `width` in bits. The other parameters are those of the catalogue."""

    kind: str
    width: int = 0
    poly: int = 0
    init: int = 0
    reflected: bool = False
    xor_out: int = 0
    negated: bool = False


@cache
def algorithm(name: str) -> Algorithm | None:
    """Return the checksum of this name (case does not matter), None where there is none."""
    if name == "none":
        return Algorithm("none")
    if name == "xor8":
        return Algorithm("xor", 8)
    if name in SUMS:
        return Algorithm(
            "sum",
            16 if name == "sum16" else 8,
            xor_out=0xFF if name == "sum8-inverted" else 0,
            negated=name == "sum8-negated",
        )
    entry = _catalogue().get(ALIASES.get(name, name).upper())
    if entry is None or entry._width not in _WIDTHS:
        return None
    return Algorithm(
        "crc", entry._width, entry._poly, entry._initvalue, entry._reflect_input, entry._xor_output
    )


def names() -> list[str]:
    """Return every name that `algorithm` knows."""
    wide = [n for n, c in _catalogue().items() if c._width in _WIDTHS]
    return ["none", *SUMS, *ALIASES, *sorted(wide)]


@cache
def _catalogue():  # type: ignore[no-untyped-def]
    import crccheck.crc  # only profiles that name a checksum need it

    return {
        name.upper(): c for c in crccheck.crc.ALLCRCCLASSES for name in c._names if name.startswith("CRC-")
    }
