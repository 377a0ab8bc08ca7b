"""Read the parts of a profile about Modbus devices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from thermoctl.files.yamlfile import Node, Section, number_of
from thermoctl_hal.base.key import check_bits, sentinel_of, take
from thermoctl_hal.base.profile import (
    BIT_KINDS,
    REGISTER_TYPES,
    WORD_BYTES,
    BusSpec,
    Condition,
    Modbus,
    Register,
    typed,
)
from thermoctl_hal.modbus.keys import MODBUS

REGISTERS = 65536  # addresses of a Modbus unit
_WORD_BITS = 8 * WORD_BYTES
_MANUAL_BASES = (
    (30001, 9999, "input"),
    (40001, 9999, "holding"),
    (300001, 65536, "input"),
    (400001, 65536, "holding"),
)
"""Manuals often number input registers 30001..39999 and holding registers 40001..49999, from address 0: first
number, how many, kind; with six digits all of them."""


def read_modbus(top: Section, folder: Path) -> Modbus:
    """Read `modbus`."""
    s = top.section("modbus")
    k = take(s, MODBUS["modbus"])
    s.end()
    return Modbus(**k)


def read_register(s: Section, spec: BusSpec) -> Register:
    """Read the place of a channel of a Modbus device: registers, a coil or a discrete input."""
    given = s.get("register")
    if isinstance(given.value, int) and given.value >= REGISTERS and (hint := register_hint(given.value)):
        raise given.error(f"register: {hint}")
    k = take(s, MODBUS["channel of modbus"])
    invalid = _invalid(k["invalid"])
    exponent = None if k["scale_register"] is None else Register(k["kind"], k["scale_register"])
    if k["kind"] in BIT_KINDS:
        for key in ("type", "word_order", "byte_order", "low_bit", "bits", "scale_register"):
            if (node := s.get(key, False)) is not None:
                raise node.error(f"{key}: a {k['kind']} is one bit and has none")
        bits = tuple(sentinel_of(n, 1, False) for n in k["sentinels"] or ())
        return Register(k["kind"], k["register"], "bit", sentinels=bits, invalid=invalid)
    types = [t for t in REGISTER_TYPES if t != "bit"]
    source = Register(
        k["kind"],
        k["register"],
        s.text("type", "int16", types),
        k["word_order"],
        (),
        k["byte_order"],
        (k["low_bit"], k["bits"]),
        k["signed"],
        invalid,
        exponent,
    )
    if source.address + source.words > REGISTERS or source.words > typed(spec, Modbus).max_block:
        raise s.node.error(f"register: {source.words} registers from {source.address} do not fit")
    width = _WORD_BITS * source.words if "int" in source.type else 0
    check_bits(s, k, width, f"a {source.type}")
    return replace(source, sentinels=tuple(_sentinel(n, source) for n in k["sentinels"] or ()))


def _sentinel(node: Node, source: Register) -> float:
    """Return a sentinel as the raw number that `decode` gives. Raises InputError."""
    width = _WORD_BITS * source.words
    if source.bits[1]:
        return sentinel_of(node, source.bits[1], source.signed)
    if source.type.startswith("bcd"):
        value = number_of(node, "sentinels")
        if not 0 <= value < 10 ** (width // 4):
            raise node.error(f"sentinels: {value:g} has more than the {width // 4} digits of {source.type}")
        return float(value)
    letter = {"float32": "f", "float64": "d"}.get(source.type, "")
    return sentinel_of(node, width, not source.type.startswith("u"), letter)


def _invalid(s: Section | None) -> tuple[Register, Condition] | None:
    if s is None:
        return None
    k = take(s, MODBUS["invalid of modbus"])
    s.end()
    if k["kind"] in BIT_KINDS:
        register, mask = Register(k["kind"], k["register"], "bit"), 1
    else:
        register, mask = Register(k["kind"], k["register"], "uint16"), k["mask"]
    if k["good"] & ~mask:
        raise s.get("good").error(f"good: {k['good']} has bits outside mask {mask:#x}")
    return register, Condition("", mask, k["good"])


def register_hint(address: int) -> str:
    """Return the kind and address meant by a manual that counts registers from 30001 or 40001, else ''."""
    for base, count, kind in _MANUAL_BASES:
        if base <= address < base + count:
            return (
                f"addresses count from 0; where the manual calls it {address}, it is kind: {kind}, "
                f"register: {address - base}"
            )
    return ""
