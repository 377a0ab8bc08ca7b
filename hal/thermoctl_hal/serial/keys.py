"""The keys of a serial device in a profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.checksum import ALIASES, SUMS
from thermoctl_hal.base.key import Key, bits_of, flag, listed, node, number, section, text, whole

_ENDIAN = ("little", "big")
_NMEA = (
    r"\$(?P<data>.*)\*(?P<sum>[0-9A-Fa-f]{2})"  # a sentence of NMEA 0183: the XOR of what is between $ and *
)
_REQUEST = (
    node(
        "request",
        "sent to ask for a reading: a list of bytes, or text with \\r, \\n, \\x.. ; `{address}` is the binding's",
        None,
        example="'?\\r'",
    ),
    number("request_hz", "requests per second", 0, 1000, "Hz", default=0.0, example="20"),
    number(
        "answer_s",
        "longest time for an answer, after which the next device of a shared line is asked",
        1e-3,
        10,
        "s",
        default=0.1,
    ),
)

SERIAL: dict[str, tuple[Key, ...]] = {
    "line": (
        whole("baud", "baud rate", 50, 20_000_000, "1/s", default=115200),
        whole("data_bits", "data bits of a character", 7, 8, default=8),
        text("parity", "none, even or odd", "N", choices=("N", "E", "O")),
        whole("stop_bits", "stop bits", 1, 2, default=1),
        whole(
            "latency_timer_ms",
            "longest time that an FTDI adapter holds bytes back; 0 leaves it as it is",
            0,
            255,
            "ms",
            default=1,
        ),
    ),
    "frame": (
        listed("sync", "0 to 8 bytes that begin a frame; none only with `request`", example="[0xAA, 0x55]"),
        flag(
            "length",
            "the payload's length follows as one byte; put another constant length into `sync`",
            True,
        ),
        listed("fields", "what the payload holds, in order"),
        text("endian", "byte order of the fields", "little", choices=_ENDIAN),
        text(
            "crc",
            f"checksum after the payload: none, {', '.join((*SUMS, *ALIASES))} or a name of the CRC catalogue "
            "with 8, 16, 24, 32, 40 or 64 bits, as CRC-16/KERMIT, CRC-8/SMBUS, CRC-32/ISO-HDLC",
        ),
        text("crc_endian", "byte order of the checksum", "little", choices=_ENDIAN),
        text(
            "crc_over",
            "bytes that the checksum covers: after-sync, frame (with the sync) or payload (without the length byte)",
            "after-sync",
            choices=("after-sync", "frame", "payload"),
        ),
        listed("tail", "bytes that end a frame, after the checksum", None, example="[0x0D]"),
        text("sequence", "field that counts frames; its gaps are counted as lost frames", ""),
        section("invalid", "bits that make every reading of the frame an error", None),
        *_REQUEST,
    ),
    "field": (
        text("name", "name of the field; none for skip", ""),
        text(
            "type",
            "int8 .. int64 and uint8 .. uint64 in steps of 8 bits, float32, float64, bcd8 .. bcd64 (two digits a "
            "byte), hex1 .. hex16 and digits1 .. digits16 (ASCII characters), skip1 .. skip64 (bytes without meaning)",
            "",
        ),
        text("endian", "byte order, where it differs from the frame's", "", choices=("", *_ENDIAN)),
        whole(
            "equals",
            "a frame with another number here is another device's and is ignored",
            default=None,
            example="3",
        ),
        text("of", "instead of `type`: this field is some bits of that field", ""),
        *bits_of("that field"),
        flag("signed", "the bits are a two's complement", False),
        section("sign", "bits of another field that say that the number is negative", None),
    ),
    "sign of a field": (
        text("field", "the field with the sign"),
        whole("mask", "its bits that are looked at", 1, 2**32, default=0xFF),
        whole("minus", "their value for minus; the sign character '-' is 0x2D", 0, 2**32, example="0x2D"),
    ),
    "invalid of serial-binary": (
        text("field", "the field"),
        whole("mask", "its bits that are looked at", 1, 2**32, example="0x03"),
        whole("good", "their value when the reading is good", 0, 2**32, default=0),
    ),
    "channel of serial-binary": (text("field", "name of a field of the frame"),),
    "text": (
        text("pattern", "regular expression from the line's first character, a named group for each reading"),
        *_REQUEST,
        text("decimal", "decimal sign", ".", choices=(".", ",")),
        text("end", "characters that end a line; none: CR, LF or both", "", example="'\\x03'"),
        section("checksum", "checksum of a line, verified before the line is taken", None),
    ),
    "checksum of text": (
        text("crc", "as of a binary frame: xor8 for NMEA"),
        text("pattern", "regular expression of a line with the groups `data` and `sum` (hexadecimal)", _NMEA),
    ),
    "channel of serial-lines": (
        text("field", "named group of the pattern"),
        whole("base", "10 or 16; required where the group also takes letters", default=10, example="16"),
        text(
            "sign",
            "group with the sign, where it stands apart from the digits: '-' is minus",
            "",
            example="s",
        ),
        text("unit_field", "group with the unit, where the line gives it", "", example="u"),
        section(
            "unit_factors",
            "unit as the line spells it: factor to the channel's unit; another unit is an error",
            None,
            example="{mm: 1000, in: 25400}",
        ),
    ),
    "message of serial-binary": (
        listed("sync", "bytes before the fields (missing: none)", None),
        listed("fields", "name, type and `value`: a number, `command` or `address`"),
        text("endian", "byte order", "little", choices=_ENDIAN),
        text("crc", "checksum, as of a frame", "none"),
        text("crc_endian", "its byte order", "little", choices=_ENDIAN),
        text("crc_over", "as of a frame", "after-sync", choices=("after-sync", "frame", "payload")),
        listed("tail", "bytes at the end", None),
    ),
    "field of a message": (
        text("type", "as of a frame's field"),
        node("value", "a number, `command` or `address`"),
        text("endian", "byte order, where it differs", "", choices=("", *_ENDIAN)),
    ),
}
