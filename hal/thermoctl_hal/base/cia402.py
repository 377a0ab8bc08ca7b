# cython: annotation_typing=False
"""CiA 402, the profile of drives (IEC 61800-7-201), as every bus carries it: states, control words, objects.

    status word & mask = value -> state          control word for the next step towards 'operation enabled'
      0x4F  0x00  not ready to switch on         -                        (the drive goes on by itself)
      0x4F  0x40  switch on disabled             0x06 shutdown
      0x6F  0x21  ready to switch on             0x07 switch on
      0x6F  0x23  switched on                    0x0F enable operation
      0x6F  0x27  operation enabled              0x0F
      0x6F  0x07  quick stop active              0x00 disable voltage
      0x4F  0x0F  fault reaction active          -
      0x4F  0x08  fault                          0x80 fault reset (rising edge), only while `enable` is False

Which of these steps a drive takes, and when, is decided by its driver: can/drive.py, ethercat/device.py.
"""

from __future__ import annotations

import re
import struct

from thermoctl.files.yamlfile import InputError, Node, integer_of, kind_of
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, AMP_FAULT, AMP_OFFLINE, AMP_QUICK_STOP
from thermoctl_hal.base.key import Key, whole, whole_range
from thermoctl_hal.base.profile import FIELD_TYPES, Amplifier, Object

MAX_STEP_S = 0.01  # longest time for which a position target moves in one write
FAULT_RESET_S = 1.0  # time between attempts to reset a drive's fault while `enable` is False
CONTROL_WORD = Object(0x6040)
MAX_SUB_INDEX = 255
OBJECT_TYPES = {t: c for t, c in FIELD_TYPES.items() if t[-2:] != "64" and not t.startswith("float")}
_OFFLINE, _DISABLED, _ENABLED, _FAULT, _QUICK_STOP = (
    AMP_OFFLINE,
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_QUICK_STOP,
)  # numbers of C, by cia402.pxd
_STATES = (
    (0x4F, 0x00, "not ready to switch on"),
    (0x4F, 0x40, "switched off (switch on disabled)"),
    (0x6F, 0x21, "switched off (ready to switch on)"),
    (0x6F, 0x23, "switched on, operation disabled"),
    (0x6F, 0x27, "operation enabled"),
    (0x6F, 0x07, "quick stop active"),
    (0x4F, 0x0F, "fault reaction active"),
    (0x4F, 0x08, "fault"),
    (0, 0, "a state that CiA 402 does not know"),
)
STANDARD_TYPES = {
    0x1000: "uint32", 0x1016: "uint32", 0x1017: "uint16", 0x603F: "uint16", 0x6040: "uint16", 0x6041: "uint16",
    0x6060: "int8", 0x6061: "int8", 0x6064: "int32", 0x606C: "int32", 0x6071: "int16", 0x6072: "uint16",
    0x6073: "uint16", 0x6075: "uint32", 0x6076: "uint32", 0x6077: "int16", 0x6078: "int16", 0x6079: "uint32",
    0x607A: "int32", 0x607F: "uint32", 0x6080: "uint32", 0x6081: "uint32", 0x6083: "uint32", 0x6084: "uint32",
    0x6085: "uint32", 0x6087: "uint32", 0x60B1: "int32", 0x60B2: "int16", 0x60F4: "int32", 0x60FF: "int32",
    0x60FD: "uint32", 0x6502: "uint32",
}  # fmt: skip
"""Types of objects that CiA 301 and CiA 402-2 define: for drives without an EDS file."""
START_UP: tuple[Key, ...] = (
    whole("index", "index of the object", 0x1000, 0xFFFF, example="0x6075"),
    whole("sub", "sub-index", 0, 255, default=0),
    whole("value", "the number written", -(2**31), 2**32, example="2500"),
)
"""Keys of an object that is written at set-up."""


def largest_command(letter: str, amplifier: Amplifier, place: str) -> int:
    """Return the largest count of a command with this letter of `struct`.

    Raises InputError where `limits` are larger."""
    largest = whole_range(8 * struct.calcsize("<" + letter), True)[1]
    low, high = amplifier.counts
    if max(-low, high) > largest:
        raise InputError(
            f"{place}: drive: 'limits' / 'scale' is {low:g} .. {high:g} counts, the command object holds "
            f"{-largest} .. {largest}: check both"
        )
    return largest


def drive_state(status_word: int) -> float:
    """Return the amplifier_state (AMP_*, thermoctl_hal.base.backend) of a CiA-402 status word."""
    if status_word & 0x4F in (0x0F, 0x08):
        return _FAULT
    if status_word & 0x6F == 0x27:
        return _ENABLED
    if status_word & 0x6F == 0x07:
        return _QUICK_STOP
    return _OFFLINE if status_word & 0x4F == 0x00 else _DISABLED


def state_name(status_word: int) -> str:
    """Return the CiA-402 state of a status word in the standard's words."""
    return next(name for mask, value, name in _STATES if status_word & mask == value)


def next_control_word(status_word: int, enable: bool) -> int:
    """Return the control word for one step towards the wanted state (table in the module's text)."""
    state = status_word & 0x6F
    if not enable:
        return 0x06 if state in (0x23, 0x27) else 0x00
    if status_word & 0x4F == 0x40:
        return 0x06
    if state == 0x21:
        return 0x07
    return 0x0F if state in (0x23, 0x27) else 0x00


def read_object_name(node: Node, key: str) -> Object:
    """Return an object: 0x6041, or 0x30D1:1 with the sub-index (decimal, or 0x.. in hexadecimal)."""
    if isinstance(node.value, int) and not isinstance(node.value, bool):
        return Object(integer_of(node, key, 0x1000, 0xFFFF))
    found = re.fullmatch(r"(0x[1-9A-Fa-f][0-9A-Fa-f]{3})(?::(0x[0-9A-Fa-f]{1,2}|\d{1,3}))?", str(node.value))
    sub = found[2] or "0" if found else "0"
    item = Object(int(found[1] if found else "0", 16), int(sub, 16 if "x" in sub else 10))
    if found is None or item.sub > MAX_SUB_INDEX:
        raise node.error(
            f"{key}: an object as 0x6041, or 0x30D1:1 with its sub-index, was expected, found {kind_of(node)}"
        )
    return item
