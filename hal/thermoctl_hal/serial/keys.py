"""The keys of a serial device in a profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.checksum import ALIASES, SUMS
from thermoctl_hal.base.key import REQUIRED, Key, bits_of

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

SERIAL: dict[str, tuple[Key, ...]] = {
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
    "channel of serial-binary": (Key("field", "text", "name of a field of the frame"),),
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
            _NMEA,
        ),
    ),
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
}
