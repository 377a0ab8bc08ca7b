# cython: annotation_typing=False
"""CiA 402, the profile of drives (IEC 61800-7-201), as every bus carries it: states, steps, objects.

    status word & mask = value -> state          control word for the next step towards 'operation enabled'
      0x4F  0x00  not ready to switch on         -                        (the drive goes on by itself)
      0x4F  0x40  switch on disabled             0x06 shutdown
      0x6F  0x21  ready to switch on             0x07 switch on
      0x6F  0x23  switched on                    0x0F enable operation
      0x6F  0x27  operation enabled              0x0F
      0x6F  0x07  quick stop active              0x00 disable voltage
      0x4F  0x0F  fault reaction active          -
      0x4F  0x08  fault                          0x80 fault reset (rising edge), only while `enable` is False

Only a new `enable` takes the steps towards 'operation enabled'. A drive that leaves it without our command
(quick stop from an input, supply, its own fault) is disabled. It stays disabled until `enable` was withdrawn
and is given again. Until then its state reads as the state it left to, so that a stop between two ticks is
seen, too. The buses (can/drive.py, ethercat/device.py) carry words, commands and objects.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Sequence

from thermoctl.files.yamlfile import InputError, Node, Section, integer_of, kind_of
from thermoctl_hal.base.backend import AMP_DISABLED, AMP_ENABLED, AMP_FAULT, AMP_OFFLINE, AMP_QUICK_STOP
from thermoctl_hal.base.key import Key, take, whole, whole_range
from thermoctl_hal.base.profile import FIELD_TYPES, Amplifier, Object
from thermoctl_hal.base.wire import nearest

_MAX_STEP_S = 0.01  # longest time for which a position target moves in one write
_RESET_S = 1.0  # time between attempts to reset a drive's fault while `enable` is False
CONTROL_WORD, MODE = Object(0x6040), Object(0x6060)
MAX_SUB_INDEX = 255
OBJECT_TYPES = {t: c for t, c in FIELD_TYPES.items() if t[-2:] != "64" and not t.startswith("float")}
_OFFLINE, _DISABLED, _ENABLED = AMP_OFFLINE, AMP_DISABLED, AMP_ENABLED  # numbers of C, by cia402.pxd
_FAULT, _QUICK_STOP = AMP_FAULT, AMP_QUICK_STOP
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
_TYPES = {
    0x1000: "uint32", 0x1016: "uint32", 0x1017: "uint16", 0x603F: "uint16", 0x6040: "uint16", 0x6041: "uint16",
    0x6060: "int8", 0x6061: "int8", 0x6064: "int32", 0x606C: "int32", 0x6071: "int16", 0x6072: "uint16",
    0x6073: "uint16", 0x6075: "uint32", 0x6076: "uint32", 0x6077: "int16", 0x6078: "int16", 0x6079: "uint32",
    0x607A: "int32", 0x607F: "uint32", 0x6080: "uint32", 0x6081: "uint32", 0x6083: "uint32", 0x6084: "uint32",
    0x6085: "uint32", 0x6087: "uint32", 0x60B1: "int32", 0x60B2: "int16", 0x60F4: "int32", 0x60FF: "int32",
    0x60FD: "uint32", 0x6502: "uint32",
}  # fmt: skip
STANDARD_TYPES = {Object(index): t for index, t in _TYPES.items()}
"""Types of objects that CiA 301 and CiA 402-2 define: for drives without an EDS file."""
START_UP: tuple[Key, ...] = (
    whole("index", "index of the object", 0x1000, 0xFFFF, example="0x6075"),
    whole("sub", "sub-index", 0, 255, default=0),
    whole("value", "the number written", -(2**31), 2**32, example="2500"),
)
"""Keys of an object that is written at set-up."""


class Enabling:
    """The rule by which an amplifier is enabled: only by a new `enable`, never again by itself."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start as before the first connection."""
        self.wanted = self.driving = self.left = False
        self.left_to = _OFFLINE

    def wants(self, enable: bool) -> bool:
        """Take the wanted state; return whether the amplifier may be enabled, or stay so."""
        if not enable:
            self.driving = self.left = False
        self.wanted = enable and not self.left
        return self.wanted

    def shown(self, state: float) -> float:
        """Take the reported AMP_* state; return it, or the state to which it left 'enabled' by itself."""
        if self.driving and not self.left and state != _ENABLED:
            self.left, self.left_to = True, state
        if self.wanted and state == _ENABLED and not self.left:
            self.driving = True
        return self.left_to if self.left and state != _FAULT else state


class DriveSteps(Enabling):
    """The outputs of a drive in each cycle: its control word and its command in counts.

    amplifier: None where nothing commands the drive. letter: of the command object in `struct`; tracks: the
    command is a position. Raises InputError where `limits` exceed the command object."""

    def __init__(self, amplifier: Amplifier | None, letter: str, tracks: bool, place: str) -> None:
        super().__init__()
        self.word, self.left_word, self._tracks = 0, -1, tracks
        self._position, self._target, self._target_s, self._reset_s = 0.0, math.nan, 0.0, -math.inf
        self._largest, self._scale = whole_range(8 * struct.calcsize("<" + letter), True)[1], 1.0
        if amplifier is None:
            return
        (self._low, self._high), self._scale = amplifier.limits, amplifier.scale
        self._slew = amplifier.slew_per_s / amplifier.scale
        low, high = amplifier.counts
        if max(-low, high) > self._largest:
            raise InputError(
                f"{place}: drive: 'limits' / 'scale' is {low:g} .. {high:g} counts, the command object holds "
                f"{-self._largest} .. {self._largest}: check both"
            )

    def reconnect(self) -> None:
        """Take a new connection: a drive that was lost while it drove is not enabled again by itself."""
        self.take(0, self._position)
        self._target, self._reset_s = math.nan, -math.inf

    def take(self, word: int, position: float) -> float:
        """Take status word and position in counts; return the AMP_* state to show."""
        was_left, self.word, self._position = self.left, word, position
        state = self.shown(drive_state(word))
        if self.left != was_left:
            self.left_word = word
        elif self.driving and not self.left:
            self.left_word = -1
        return state

    def control_word(self, enable: bool, now_s: float) -> int:
        """Return the control word of this cycle."""
        word = next_control_word(self.word, self.wants(enable))
        if not enable and self.word & 0x4F == 0x08 and now_s - self._reset_s >= _RESET_S:
            word, self._reset_s = 0x80, now_s
        return word

    def counts(self, drive: float, now_s: float) -> int:
        """Return the command of this cycle, after its control word: 0 until the drive is enabled.

        A position target is the present one until then. It moves by at most `slew_per_s`, so that enabling or
        a step of the command is no jump."""
        wanted = min(max(drive, self._low), self._high) / self._scale
        is_enabled = self.wanted and drive_state(self.word) == _ENABLED
        if not self._tracks:
            return min(max(nearest(wanted), -self._largest), self._largest) if is_enabled else 0
        step = self._slew * min(max(now_s - self._target_s, 0.0), _MAX_STEP_S)
        self._target_s = now_s
        if not is_enabled or self._target != self._target:
            self._target = self._position
        else:
            self._target += min(max(wanted - self._target, -step), step)
        return min(max(nearest(self._target), -self._largest), self._largest)


def state_without_role(place: str) -> InputError:
    """Return the error for a drive whose status word has no role."""
    return InputError(
        f"{place}: a drive needs its status word (object 0x6041) in the role amplifier_state: without it nobody sees "
        "that the drive stopped by itself"
    )


def write_mapping(
    put: Callable[[Object, str, int], None], pdo: int, entries: Sequence[tuple[Object, str]]
) -> None:
    """Map a PDO to these objects with their letters of `struct`; `put` writes a number to an object."""
    put(Object(pdo), "B", 0)
    for k, ((index, sub), letter) in enumerate(entries, 1):
        put(Object(pdo, k), "I", index << 16 | sub << 8 | 8 * struct.calcsize("<" + letter))
    put(Object(pdo), "B", len(entries))


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


def read_objects(s: Section | None) -> dict[Object, str]:
    """Return the types that `objects` of a profile gives to objects. Raises InputError."""
    types: dict[Object, str] = {}
    if s is None:
        return types
    for name, node in s.node.value.items():
        item = read_object_name(Node(name, node.file, node.line, node.column), "objects")
        types[item] = s.text(name, choices=OBJECT_TYPES)
    return types


def read_start_up(node: Node) -> tuple[Object, int]:
    """Return an object that is written at set-up, and its value. Raises InputError."""
    s = Section(node, "start_up")
    found = take(s, START_UP)
    s.end()
    return Object(found["index"], found["sub"]), found["value"]
