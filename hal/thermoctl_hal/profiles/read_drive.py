"""Read `drive` of a profile: the command that an amplifier takes, and the messages that carry it."""

from __future__ import annotations

import re
from typing import Any

from thermoctl.files.yamlfile import Node, Section, integer_of, number_of
from thermoctl_hal.base.key import named, take
from thermoctl_hal.base.message import misfit
from thermoctl_hal.base.profile import (
    ACTUAL_POSITION,
    FRAME_TYPES,
    POSITION_MODES,
    Amplifier,
    BinaryFrame,
    BusSpec,
    CanMessage,
    Channel,
    Cia402,
    Dbc,
    FrameMessage,
    Message,
    Modbus,
    Register,
    RegisterMessage,
    StateOf,
    TextLine,
    TextMessage,
    object_name,
    typed,
)
from thermoctl_hal.can.read import check_unit, message_of
from thermoctl_hal.ethercat.read import Ethercat
from thermoctl_hal.profiles.keys import TABLES
from thermoctl_hal.serial.read import bytes_of, checksum_name

COMMAND, ADDRESS = "command", "address"
REFUSED_MODES = (1, 2, 6, 7)
_COMMAND = re.compile(rb"\{command(:[^{}]*)?\}")
_ORDER = {"little": "<", "big": ">"}
_SINGLE, _COIL, _SEVERAL = 6, 5, 16  # Modbus functions that write


def read_amplifier(top: Section, spec: BusSpec, channels: dict[str, Channel]) -> Amplifier | None:
    """Read `drive`, None where the device takes no command. Raises InputError."""
    s = top.section("drive", False)
    if s is None:
        return None
    if s.get("limits", False) is None:
        raise s.node.error("drive: 'limits' is missing: [low, high], the largest commands ever sent")
    k = take(s, TABLES["drive"])
    if isinstance(spec, Cia402 | Ethercat):
        _check_mode(s, spec, k)
        more: dict[str, Any] = {"watchdog_s": spec.watchdog_s}
    else:
        more = _by_messages(s, spec, channels, [limit / k["scale"] for limit in k["limits"]])
    if isinstance(spec, Dbc):
        command = typed(more["command"], CanMessage)
        for name in (n for n, value in command.values.items() if value is None):
            check_unit(s, spec, command.name, name, k["unit"], k["scale"])
    low, high = k["limits"]
    is_position = isinstance(spec, Cia402 | Ethercat) and spec.mode in POSITION_MODES
    if not low <= 0.0 <= high and not is_position:
        raise s.node.error(f"limits: [{low:g}, {high:g}] must contain 0, the safe command")
    s.end()
    return Amplifier(k["unit"], k["scale"], k["limits"], k["slew_per_s"], **more)


def _check_mode(s: Section, spec: Cia402 | Ethercat, k: dict[str, Any]) -> None:
    if isinstance(spec, Ethercat) and spec.command is None:
        raise s.node.error("command: is missing in 'ethercat': the object that takes the command, as 0x6071")
    if spec.mode in REFUSED_MODES:
        raise s.node.error(
            f"mode: {spec.mode} is not supported, because it needs a handshake or moves by itself: use 8 (cyclic "
            "position), 9 or 3 (velocity), 10 or 4 (torque), or the maker's"
        )
    if spec.mode not in POSITION_MODES:
        return
    if ACTUAL_POSITION not in spec.transmit:
        raise s.node.error(
            f"transmit: a position mode needs {object_name(ACTUAL_POSITION)}: the command starts from the present "
            "position, so that enabling does not move the axis"
        )
    if not k["slew_per_s"]:
        raise s.node.error(
            "drive: 'slew_per_s' is missing: the largest rate of the command in a position mode"
        )


def _by_messages(
    s: Section, spec: BusSpec, channels: dict[str, Channel], counts: list[float]
) -> dict[str, Any]:
    if s.get("watchdog_s", False) is None:
        raise s.node.error(
            "drive: 'watchdog_s' is missing: the time after which the device stops by itself when our messages "
            "stop, as it is set in the device; none when it cannot"
        )
    k = take(s, TABLES["drive by messages"])
    command = _fitting(k["command"], spec, "command", *counts)
    if not carries_command(command):
        raise k["command"].error(
            "command: this message does not carry the command: put 'command' where it belongs"
        )
    messages: dict[str, Any] = {
        key: tuple(_fitting(n, spec, key) for n in k[key] or ())
        for key in ("set_up", "enable", "disable", "reset")
    }
    state = None
    if not (isinstance(k["state"].value, str) and k["state"].value == "assumed"):
        x = Section(k["state"], "state")
        v = take(x, TABLES["state of a drive"])
        numbers = [
            tuple(number_of(n, key) for n in v[key] or ()) for key in ("enabled", "disabled", "quick_stop")
        ]
        state = StateOf(named(x, "channel", channels), *numbers)
        x.end()
    fault = named(s, "fault", channels) if k["fault"] else ""
    watchdog = k["watchdog_s"]
    if isinstance(watchdog.value, str) and watchdog.value == "none":
        watchdog_s = None
    else:
        watchdog_s = number_of(watchdog, "watchdog_s", 1e-3, 60)
        if watchdog_s < 2.0 / k["command_hz"]:
            raise watchdog.error(
                f"watchdog_s: {watchdog_s:g} s is below two periods of command_hz: the device would stop by itself"
            )
    return messages | {
        "command": command,
        "command_hz": k["command_hz"],
        "state": state,
        "fault": fault,
        "watchdog_s": watchdog_s,
    }


def _fitting(node: Node, spec: BusSpec, key: str, *counts: float) -> Message:
    """Return the message of a node; it must carry its numbers, and commands of 0 and of `counts`."""
    message = read_message(node, spec, key)
    for command in (0.0, *counts):
        if why := misfit(message, spec, command):
            limits = f" ('limits' / 'scale' is {counts[0]:g} .. {counts[1]:g} counts)" if command else ""
            raise node.error(f"{key}: {why}{limits}")
    return message


def carries_command(message: Message) -> bool:
    """Return whether a message has a place for the command."""
    if isinstance(message, CanMessage):
        return None in message.values.values()
    if isinstance(message, RegisterMessage):
        return message.value is None
    return (
        _COMMAND.search(message.template) is not None
        if isinstance(message, TextMessage)
        else None in message.values
    )


def read_message(node: Node, spec: BusSpec, key: str) -> Message:
    """Read a message that we send to a device of this bus. Raises InputError."""
    if isinstance(spec, TextLine):
        message = TextMessage(bytes_of(node, key))
        for form in _COMMAND.finditer(message.template):
            _check_format(node, form[0].decode())
        return message
    if isinstance(spec, BinaryFrame):
        return _frame(node, key)
    s = Section(node, key)
    if isinstance(spec, Dbc):
        k = take(s, TABLES["message of can-dbc"])
        message_name = message_of(s, spec)
        signals = [x.name for x in spec.database.get_message_by_name(message_name).signals]
        values = {}
        if k["values"] is not None:
            for name, value in k["values"].node.value.items():
                if name not in signals:
                    raise value.error(
                        f"values: '{name}' is no signal of {message_name}; it has {', '.join(signals)}"
                    )
                values[name] = _number(value, name)
        s.end()
        return CanMessage(message_name, values)
    if not isinstance(spec, Modbus):
        raise TypeError(f"{type(spec).__name__} has no messages")
    return _register(s)


def _register(s: Section) -> RegisterMessage:
    k = take(s, TABLES["message of modbus"])
    s.end()
    if k["kind"] == "coil":
        register, default = Register("coil", k["register"], "bit"), _COIL
    else:
        types = ("int16", "uint16", "int32", "uint32", "float32")
        register = Register("holding", k["register"], s.text("type", "int16", types), k["word_order"])
        default = _SINGLE if register.words == 1 else _SEVERAL
    function = k["function"] or default
    if function not in ((_COIL,) if k["kind"] == "coil" else (default, _SEVERAL)):
        raise s.node.error(f"function: {function} cannot write this {k['kind']}; {default} can")
    value = _number(k["value"], "value")
    return RegisterMessage(register, value, function)


def _frame(node: Node, key: str) -> FrameMessage:
    s = Section(node, key)
    k = take(s, TABLES["message of serial-binary"])
    fields, values, other = [], [], set()
    for number, item in enumerate(k["fields"]):
        f = Section(item, "field")
        v = take(f, TABLES["field of a message"])
        if v["type"] not in FRAME_TYPES:
            raise item.error(f"type: '{v['type']}' is not one of the types of a frame's field")
        fields.append((f"{number}", v["type"]))
        if v["endian"] and v["endian"] != k["endian"]:
            other.add(f"{number}")
        values.append(ADDRESS if v["value"].value == ADDRESS else _number(v["value"], "value"))
        f.end()
    frame = BinaryFrame(
        bytes(integer_of(n, "sync", 0, 255) for n in k["sync"] or ()),
        tuple(fields),
        _ORDER[k["endian"]],
        False,
        checksum_name(s) if s.get("crc", False) is not None else "none",
        _ORDER[k["crc_endian"]],
        k["crc_over"],
        bytes(integer_of(n, "tail", 0, 255) for n in k["tail"] or ()),
        other_endian=frozenset(other),
    )
    s.end()
    return FrameMessage(frame, tuple(values))


def _number(node: Node, key: str) -> float | None:
    """Return a number, None for 'command'."""
    if node.value == COMMAND:
        return None
    if isinstance(node.value, str):
        return float(integer_of(node, key))
    return number_of(node, key)


def _check_format(node: Node, form: str) -> None:
    try:
        form.format(command=1 if form[:-1].endswith(("d", "x", "X")) else 1.5)
    except (ValueError, KeyError, IndexError) as e:
        raise node.error(f"{form}: no format of a number, as {{command:+.3f}}: {e}") from None
