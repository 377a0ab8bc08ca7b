"""Read the parts of a profile about an EtherCAT slave: its section, and the places of its channels."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermoctl.files.yamlfile import Node, Section, number_of
from thermoctl_hal.base.cia402 import OBJECT_TYPES, STANDARD_TYPES, START_UP, read_object_name
from thermoctl_hal.base.key import check_bits, sentinel_of, take
from thermoctl_hal.base.profile import (
    FIELD_TYPES,
    STATUS_WORD,
    BusSpec,
    Condition,
    Object,
    object_name,
    typed,
)
from thermoctl_hal.ethercat.keys import ETHERCAT

LONGEST_WATCHDOG_S = 6.5535
"""65535 steps of 100 us, the step that a slave controller has at power-on."""


@dataclass(frozen=True)
class Ethercat(BusSpec):
    """An EtherCAT slave; `transmit`, `command` and `start_up` are written to it at set-up.

    transmit: objects of the inputs with their letters of struct, in order; empty where the slave keeps its
    mapping. command: object and letter of a CiA-402 drive's command, None for other slaves."""

    vendor_id: int
    product_code: int
    position: int
    input_bytes: int
    transmit: Mapping[Object, str]
    command: tuple[Object, str] | None
    mode: int
    start_up: tuple[tuple[Object, str, int], ...]
    watchdog_s: float | None  # None: the slave has no watchdog
    timeout_s: float

    @property
    def address(self) -> int:
        """Return the position."""
        return self.position


@dataclass(frozen=True)
class Place:
    """A value in the inputs of a slave.

    bits: (lowest, count) of the bits that hold the value, count 0 for all; `signed`: they are a two's
    complement. `sentinels`: raw numbers for 'no reading'. `invalid`: place and test that a good reading
    passes."""

    offset: int
    letter: str
    bits: tuple[int, int] = (0, 0)
    signed: bool = False
    sentinels: tuple[float, ...] = ()
    invalid: tuple[Place, Condition] | None = None

    @property
    def end(self) -> int:
        """Return the first byte after the value."""
        return self.offset + struct.calcsize("<" + self.letter)

    def value(self, inputs: bytes) -> float:
        """Return the raw number in the inputs of the slave."""
        raw: float = struct.unpack_from("<" + self.letter, inputs, self.offset)[0]
        low, count = self.bits
        if not count:
            return raw
        value = int(raw) >> low & (1 << count) - 1
        return value - (1 << count) if self.signed and value >> (count - 1) else value


def read_ethercat(top: Section, _folder: Path) -> Ethercat:
    """Read `ethercat`, the description of a slave. Raises InputError."""
    s = top.section("ethercat")
    k = take(s, ETHERCAT["ethercat"])
    types: dict[Object, str] = {Object(index): t for index, t in STANDARD_TYPES.items()}
    if k["objects"] is not None:
        for name, node in k["objects"].node.value.items():
            item = read_object_name(Node(name, node.file, node.line, node.column), "objects")
            types[item] = k["objects"].text(name, choices=OBJECT_TYPES)
    transmit = {}
    for node in k["transmit"] or ():
        item = read_object_name(node, "transmit")
        transmit[item] = _letter(types, item, node, "transmit")
    command = None
    if k["command"] is not None:
        item = read_object_name(k["command"], "command")
        command = item, _letter(types, item, k["command"], "command")
        if not command[1].islower():
            raise k["command"].error(f"command: object {object_name(item)} has no sign")
        if next(iter(transmit), None) != STATUS_WORD:
            raise s.node.error("transmit: a drive sends its status word 0x6041 first")
    spec = Ethercat(
        k["vendor_id"],
        k["product_code"],
        k["position"],
        k["input_bytes"],
        transmit,
        command,
        k["mode"],
        tuple(_start_up(node, types) for node in k["start_up"] or ()),
        _watchdog(s, k),
        k["timeout_s"],
    )
    s.end()
    return spec


def _watchdog(s: Section, k: dict[str, Any]) -> float | None:
    node = k["watchdog_s"]
    if node is None and k["command"] is not None:
        raise s.node.error(
            "watchdog_s: is missing: the time after which the drive stops by itself when our frames stop, which is "
            "written to its process data watchdog; none where it has no watchdog"
        )
    if node is None or node.value == "none":
        return None
    return number_of(node, "watchdog_s", 1e-3, LONGEST_WATCHDOG_S)


def _letter(types: Mapping[Object, str], item: Object, node: Node, key: str) -> str:
    if item not in types:
        raise node.error(
            f"{key}: the type of object {object_name(item)} is not known: say objects: "
            f"{{'{object_name(item)}': int32}}"
        )
    return FIELD_TYPES[types[item]]


def _start_up(node: Node, types: Mapping[Object, str]) -> tuple[Object, str, int]:
    w = Section(node, "start_up")
    v = take(w, START_UP)
    w.end()
    item = Object(v["index"], v["sub"])
    letter = _letter(types, item, node, "start_up")
    try:
        struct.pack("<" + letter, v["value"])
    except struct.error:
        raise node.error(f"start_up: {v['value']} does not fit object {object_name(item)}") from None
    return item, letter, v["value"]


def read_place(s: Section, spec: BusSpec) -> Place:
    """Read the place of a channel: an object of `transmit`, or an offset and a type. Raises InputError."""
    k = take(s, ETHERCAT["channel of ethercat"])
    slave = typed(spec, Ethercat)
    invalid = None
    if k["invalid"] is not None:
        i = take(k["invalid"], ETHERCAT["invalid of ethercat"])
        invalid = _place(k["invalid"], i, slave), Condition("", i["mask"], i["good"])
        k["invalid"].end()
    place = _place(s, k, slave)
    width = 0 if place.letter in "fd" else 8 * (place.end - place.offset)
    check_bits(s, k, width, f"the {width} bits of it")
    if k["object"] is not None and k["type"]:
        raise s.get("type").error(
            f"type: object {k['object'].value} has its own: leave it out, or give its 'byte'"
        )
    return Place(
        place.offset,
        place.letter,
        (k["low_bit"], k["bits"]),
        k["signed"],
        tuple(_sentinel(n, place, k) for n in k["sentinels"] or ()),
        invalid,
    )


def _sentinel(node: Node, found: Place, k: dict[str, Any]) -> float:
    if k["bits"]:
        return sentinel_of(node, k["bits"], k["signed"])
    width = 8 * (found.end - found.offset)
    return sentinel_of(node, width, found.letter.islower(), found.letter if found.letter in "fd" else "")


def _place(s: Section, k: dict[str, Any], spec: Ethercat) -> Place:
    if (k["object"] is None) == (k["byte"] is None):
        raise s.node.error("object, byte: give one of them: where the value is in the slave's inputs")
    if k["object"] is None:
        kind = s.text("type", k["type"] or None, FIELD_TYPES)
        place = Place(k["byte"], FIELD_TYPES[kind])
        if 0 < spec.input_bytes < place.end:
            raise s.node.error(
                f"byte: {place.end - 1} of the inputs is outside the {spec.input_bytes} input_bytes"
            )
        return place
    item, offset = read_object_name(k["object"], "object"), 0
    for sent, letter in spec.transmit.items():
        if sent == item:
            return Place(offset, letter)
        offset += struct.calcsize("<" + letter)
    raise k["object"].error(
        f"object: {object_name(item)} is not sent by the slave; add it to 'transmit', or give its 'byte'"
    )
