"""Every key of a device profile, in tables: the reader and the reference page both use them.

A table lists the keys of one mapping of the file; `take` reads such a mapping. A key that stands in no table
is refused.
"""

from __future__ import annotations

import math
from typing import Any

from thermoctl.yamlfile import Section
from thermoctl_hal.buses import BUSES
from thermoctl_hal.checksum import ALIASES, SUMS
from thermoctl_hal.key import REQUIRED, Key, bits_of
from thermoctl_hal.keys_ethercat import ETHERCAT

MAX_ADDRESS, MAX_MODBUS_BITS = 65535, 64

_ENDIAN = ("little", "big")
_NMEA = (
    r"\$(?P<data>.*)\*(?P<sum>[0-9A-Fa-f]{2})"  # a sentence of NMEA 0183: the XOR of what is between $ and *
)
_REQUEST = (
    Key(
        "request",
        "node",
        "sent to ask for a reading: a list of bytes, or text with \\r, \\n, \\x.. ; `{address}` is the binding's",
        None,
        example="'?\\r'",
    ),
    Key("request_hz", "number", "requests per second", 0.0, "Hz", 0, 1000, example="20"),
    Key(
        "answer_s",
        "number",
        "longest time for an answer, after which the next device of a shared line is asked",
        0.1,
        "s",
        1e-3,
        10,
    ),
)

TABLES: dict[str, tuple[Key, ...]] = {
    "profile": (
        Key("format", "text", "`thermoctl-device/1`"),
        Key("vendor", "text", "who makes the device"),
        Key("model", "text", "its product name"),
        Key("manual", "text", "title of the document that states the registers or frames", ""),
        Key("edition", "text", "edition of that document: version, date, document number or commit", ""),
        Key("place", "text", "page, section or table of it that states them", ""),
        Key("about", "text", "what else a user should know", ""),
        Key("bus", "text", ", ".join(BUSES)),
        Key("line", "section", "settings of a serial line", None),
        Key("channels", "section", "the readings, by name"),
        Key("drive", "section", "the command that an amplifier takes", None),
    ),
    "line": (
        Key("baud", "integer", "baud rate", 115200, "1/s", 50, 20_000_000),
        Key("data_bits", "integer", "data bits of a character", 8, "", 7, 8),
        Key("parity", "text", "none, even or odd", "N", choices=("N", "E", "O")),
        Key("stop_bits", "integer", "stop bits", 1, "", 1, 2),
        Key(
            "latency_timer_ms",
            "integer",
            "longest time that an FTDI adapter holds bytes back; 0 leaves it as it is",
            1,
            "ms",
            0,
            255,
        ),
    ),
    "channel": (
        Key(
            "unit",
            "text",
            "unit of the reading: um, nm, mm, m, in, deg, arcsec, rad, V, mV, A, mA, degC, degF, K, 1",
        ),
        Key("scale", "number", "reading = raw x scale + offset", 1.0),
        Key("offset", "number", "the same", 0.0),
        Key("range", "interval", "[low, high]: readings outside are errors", (-math.inf, math.inf), "unit"),
        Key("rate_hz", "number", "rate of the readings", REQUIRED, "Hz", 1e-3, 1e5, example="10"),
        Key(
            "stale_after_s",
            "number",
            "largest age of a valid reading",
            REQUIRED,
            "s",
            1e-4,
            3600,
            example="1",
        ),
    ),
    "channel of serial-binary": (Key("field", "text", "name of a field of the frame"),),
    "channel of serial-lines": (
        Key("field", "text", "named group of the pattern"),
        Key("base", "integer", "10 or 16; required where the group also takes letters", 10, example="16"),
        Key(
            "sign",
            "text",
            "group with the sign, where it stands apart from the digits: '-' is minus",
            "",
            example="s",
        ),
        Key("unit_field", "text", "group with the unit, where the line gives it", "", example="u"),
        Key(
            "unit_factors",
            "section",
            "unit as the line spells it: factor to the channel's unit; another unit is an error",
            None,
            example="{mm: 1000, in: 25400}",
        ),
    ),
    "channel of can-dbc": (
        Key("message", "text", "message of the DBC file"),
        Key("signal", "text", "signal of that message; a multiplexed one counts only when it is sent"),
        Key("invalid", "section", "a signal of the same message that says that the reading is wrong", None),
        Key("sentinels", "list", "values of the signal that mean 'no reading'", None, example="[3276.7]"),
    ),
    "invalid of can-dbc": (
        Key("signal", "text", "the signal"),
        Key("mask", "integer", "bits of its raw number that are looked at; 0: all", 0, example="0x04"),
        Key("good", "integer", "raw number of these bits when the reading is good", 0, "", 0, 2**32),
    ),
    "channel of can-cia402": (Key("object", "node", "an object of `transmit`, or 0x603F (error code)"),),
    "channel of modbus": (
        Key(
            "kind",
            "text",
            "input (function 4), holding (3), discrete (2) or coil (1)",
            "input",
            choices=("input", "holding", "discrete", "coil"),
        ),
        Key(
            "register",
            "integer",
            "address from 0: a manual's 40001 is kind: holding, register: 0",
            REQUIRED,
            "",
            0,
            MAX_ADDRESS,
            example="0",
        ),
        Key("type", "text", "int16 .. int64, uint16 .. uint64, float32, float64, bcd16, bcd32", "int16"),
        Key("word_order", "text", "order of the words of a value", "big", choices=("big", "little")),
        Key("byte_order", "text", "order of the two bytes of a word", "big", choices=("big", "little")),
        *bits_of("the register"),
        Key("signed", "flag", "the bits are a two's complement", False),
        Key("sentinels", "list", "raw numbers that mean 'no sensor'", None, example="[32767]"),
        Key("invalid", "section", "a register or bit that says that the reading is wrong (open wire)", None),
    ),
    "invalid of modbus": (
        Key("kind", "text", "as of a channel", "input", choices=("input", "holding", "discrete", "coil")),
        Key("register", "integer", "address from 0", REQUIRED, "", 0, MAX_ADDRESS, example="120"),
        Key(
            "mask",
            "integer",
            "bits of the register that are looked at",
            0xFFFF,
            "",
            1,
            0xFFFF,
            example="0x0300",
        ),
        Key("good", "integer", "their value when the reading is good", 0, "", 0, 0xFFFF),
    ),
    "frame": (
        Key(
            "sync",
            "list",
            "0 to 8 bytes that begin a frame; none only with `request`",
            example="[0xAA, 0x55]",
        ),
        Key(
            "length",
            "flag",
            "the payload's length follows as one byte. Write another constant length byte into `sync`",
            True,
        ),
        Key("fields", "list", "what the payload holds, in order"),
        Key("endian", "text", "byte order of the fields", "little", choices=_ENDIAN),
        Key(
            "crc",
            "text",
            f"checksum after the payload: none, {', '.join((*SUMS, *ALIASES))} or a name of the CRC catalogue "
            "with 8, 16, 24, 32, 40 or 64 bits, as CRC-16/KERMIT, CRC-8/SMBUS, CRC-32/ISO-HDLC",
        ),
        Key("crc_endian", "text", "byte order of the checksum", "little", choices=_ENDIAN),
        Key(
            "crc_over",
            "text",
            "bytes that the checksum covers: after-sync, frame (with the sync) or payload (without the length byte)",
            "after-sync",
            choices=("after-sync", "frame", "payload"),
        ),
        Key("tail", "list", "bytes that end a frame, after the checksum", None, example="[0x0D]"),
        Key("sequence", "text", "field that counts frames; its gaps are counted as lost frames", ""),
        Key("invalid", "section", "bits that make every reading of the frame an error", None),
        *_REQUEST,
    ),
    "field": (
        Key("name", "text", "name of the field; none for skip", ""),
        Key(
            "type",
            "text",
            "int8 .. int64 and uint8 .. uint64 in steps of 8 bits, float32, float64, bcd8 .. bcd64 (two digits a "
            "byte), hex1 .. hex16 and digits1 .. digits16 (ASCII characters), skip1 .. skip64 (bytes without meaning)",
            "",
        ),
        Key("endian", "text", "byte order, where it differs from the frame's", "", choices=("", *_ENDIAN)),
        Key(
            "equals",
            "integer",
            "a frame with another number here is another device's and is ignored",
            None,
            example="3",
        ),
        Key("of", "text", "instead of `type`: this field is some bits of that field", ""),
        *bits_of("that field"),
        Key("signed", "flag", "the bits are a two's complement", False),
        Key("sign", "section", "bits of another field that say that the number is negative", None),
    ),
    "sign of a field": (
        Key("field", "text", "the field with the sign"),
        Key("mask", "integer", "its bits that are looked at", 0xFF, "", 1, 2**32),
        Key(
            "minus",
            "integer",
            "their value for minus; the sign character '-' is 0x2D",
            REQUIRED,
            "",
            0,
            2**32,
            example="0x2D",
        ),
    ),
    "invalid of serial-binary": (
        Key("field", "text", "the field"),
        Key("mask", "integer", "its bits that are looked at", REQUIRED, "", 1, 2**32, example="0x03"),
        Key("good", "integer", "their value when the reading is good", 0, "", 0, 2**32),
    ),
    "text": (
        Key(
            "pattern",
            "text",
            "regular expression from the line's first character, a named group for each reading",
        ),
        *_REQUEST,
        Key("decimal", "text", "decimal sign", ".", choices=(".", ",")),
        Key("end", "text", "characters that end a line; none: CR, LF or both", "", example="'\\x03'"),
        Key("checksum", "section", "checksum of a line, verified before the line is taken", None),
    ),
    "checksum of text": (
        Key("crc", "text", "as of a binary frame: xor8 for NMEA"),
        Key(
            "pattern",
            "text",
            "regular expression of a line with the groups `data` and `sum` (hexadecimal)",
            r"\$(?P<data>.*)\*(?P<sum>[0-9A-Fa-f]{2})",
        ),
    ),
    "can-dbc": (
        Key("dbc", "text", "the DBC file, beside the profile"),
        Key(
            "node_shift",
            "integer",
            "the binding's `address`, shifted by so many bits, is added to every identifier of the DBC file",
            None,
            "",
            0,
            28,
            example="5",
        ),
    ),
    "cia402": (
        Key(
            "eds", "text", "the drive's EDS file; none: types of standard objects, and those of `objects`", ""
        ),
        Key(
            "objects",
            "section",
            "types of the maker's own objects where there is no EDS file",
            None,
            example="{'0x30D1:1': int32}",
        ),
        Key("node_id", "integer", "node id (binding: `address`)", 1, "", 1, 126),
        Key(
            "mode",
            "integer",
            "object 0x6060: 10 cyclic torque, 9 cyclic velocity, 8 cyclic position, 4 profile torque, 3 profile velocity, < 0 the maker's",
            REQUIRED,
            "",
            -128,
            127,
        ),
        Key("command", "node", "object of RPDO 1 that takes the command: 0x6071, with a sub-index 0x30D1:1"),
        Key(
            "transmit",
            "list",
            "objects of TPDO 1, at most 8 bytes, the status word 0x6041 first",
            example="[0x6041, 0x6078]",
        ),
        Key("start_up", "list", "further objects written at set-up", None),
        Key("heartbeat_s", "number", "period of our heartbeat and of the drive's", 0.02, "s", 1e-3, 1),
        Key(
            "watchdog_s",
            "number",
            "the drive stops when our heartbeat is missing for this long",
            0.1,
            "s",
            2e-3,
            10,
        ),
        Key("master_id", "integer", "our own node id (missing: 127 - node id)", 0, "", 1, 127),
        Key("sdo_timeout_s", "number", "longest time for an answer at set-up", 0.3, "s", 0.01, 10),
    ),
    "start_up": (
        Key("index", "integer", "index of the object", REQUIRED, "", 0x1000, 0xFFFF, example="0x6075"),
        Key("sub", "integer", "sub-index", 0, "", 0, 255),
        Key("value", "integer", "the number written", REQUIRED, "", -(2**31), 2**32, example="2500"),
    ),
    "modbus": (
        Key("unit_id", "integer", "unit (binding: `address`)", 1, "", 0, 247),
        Key("timeout_s", "number", "longest time for an answer", 0.3, "s", 0.01, 10),
        Key("max_gap", "integer", "registers are read together over gaps of up to this many", 8, "", 0, 100),
        Key("max_block", "integer", "registers read by one request, at most", 100, "", 1, 125),
    ),
    "drive": (
        Key("unit", "text", "unit of the command"),
        Key("scale", "number", "one count of the command", REQUIRED, "unit", 1e-12, example="0.001"),
        Key(
            "limits",
            "interval",
            "[low, high]: the largest commands ever sent",
            REQUIRED,
            "unit",
            example="[-2.5, 2.5]",
        ),
        Key(
            "slew_per_s",
            "number",
            "largest rate of the command; required in a position mode, where it starts from the present position",
            0.0,
            "unit/s",
            0,
            example="500",
        ),
    ),
    "drive by messages": (
        Key("command", "node", "the message that carries the command (see Messages)"),
        Key("command_hz", "number", "commands per second, at most one a tick", 100.0, "Hz", 0.1, 10000),
        Key("set_up", "list", "messages that are sent before each `enable`: mode, limits", None),
        Key("enable", "list", "messages that enable it", None),
        Key("disable", "list", "messages that disable it, after a command of 0"),
        Key("reset", "list", "messages that reset a fault, sent only while disabled", None),
        Key("state", "node", "`assumed`, or the channel and its numbers: every other number is a fault"),
        Key("fault", "text", "channel that is 0 without a fault", "", example="error"),
        Key(
            "watchdog_s",
            "node",
            "the device stops by itself when our messages stop for this long, as set in the device; `none`: it "
            "does not, and `check` says so",
            example="0.1",
        ),
    ),
    "state of a drive": (
        Key("channel", "text", "the channel, bound to the role amplifier_state"),
        Key("enabled", "list", "its raw numbers for: follows the command", example="[8]"),
        Key("disabled", "list", "for: without power", example="[0, 1]"),
        Key("quick_stop", "list", "for: stopped by itself", None),
    ),
    "message of can-dbc": (
        Key("message", "text", "message of the DBC file"),
        Key(
            "values",
            "section",
            "signal: number, or `command`; the other signals are 0",
            None,
            example="{Torque: command}",
        ),
    ),
    "message of modbus": (
        Key("kind", "text", "holding or coil", "holding", choices=("holding", "coil")),
        Key("register", "integer", "address from 0", REQUIRED, "", 0, MAX_ADDRESS),
        Key("type", "text", "as of a channel", "int16"),
        Key("word_order", "text", "order of the words", "big", choices=("big", "little")),
        Key("value", "node", "the number written, or `command`"),
        Key(
            "function",
            "integer",
            "6 or 16 for registers, 5 for coils; 0: by the number of registers",
            0,
            "",
            0,
            16,
        ),
    ),
    "message of serial-binary": (
        Key("sync", "list", "bytes before the fields (missing: none)", None),
        Key("fields", "list", "name, type and `value`: a number, `command` or `address`"),
        Key("endian", "text", "byte order", "little", choices=_ENDIAN),
        Key("crc", "text", "checksum, as of a frame", "none"),
        Key("crc_endian", "text", "its byte order", "little", choices=_ENDIAN),
        Key("crc_over", "text", "as of a frame", "after-sync", choices=("after-sync", "frame", "payload")),
        Key("tail", "list", "bytes at the end", None),
    ),
    "field of a message": (
        Key("type", "text", "as of a frame's field"),
        Key("value", "node", "a number, `command` or `address`"),
        Key("endian", "text", "byte order, where it differs", "", choices=("", *_ENDIAN)),
    ),
} | ETHERCAT


def take(s: Section, table: str) -> dict[str, Any]:
    """Read the keys of a table from `s`; values are checked, sections and nodes are left to the caller.

    A missing optional key has its default. Raises InputError. The caller calls `s.end()`."""
    return {key.name: _value(s, key) for key in TABLES[table]}


def _value(s: Section, key: Key) -> Any:
    given = s.get(key.name, key.default is REQUIRED)
    if given is None:
        return key.default
    if key.kind == "text":
        return s.text(key.name, choices=key.choices)
    if key.kind == "number":
        return s.number(key.name, low=key.low, high=key.high)
    if key.kind == "integer":
        low, high = (int(v) if math.isfinite(v) else d for v, d in ((key.low, 0), (key.high, 2**32)))
        return s.integer(key.name, low=low, high=high)
    if key.kind == "flag":
        return s.flag(key.name, False)
    if key.kind == "interval":
        return s.interval(key.name)
    if key.kind == "list":
        return s.list(key.name)
    return s.section(key.name) if key.kind == "section" else given
