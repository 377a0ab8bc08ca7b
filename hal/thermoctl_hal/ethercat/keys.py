"""The keys of an EtherCAT slave's profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.key import REQUIRED, Key, bits_of

_PLACE = (
    Key("object", "node", "an object of `transmit`; give this or `byte`", None, example="0x6041"),
    Key(
        "byte",
        "integer",
        "first byte of the value in the slave's inputs, from 0",
        None,
        "byte",
        0,
        1485,
        example="2",
    ),
)

ETHERCAT: dict[str, tuple[Key, ...]] = {
    "ethercat": (
        Key(
            "vendor_id",
            "integer",
            "the maker's number, compared at connection",
            REQUIRED,
            "",
            1,
            2**32 - 1,
            example="0x2",
        ),
        Key(
            "product_code",
            "integer",
            "the product's number, compared at connection",
            REQUIRED,
            "",
            0,
            2**32 - 1,
            example="0x0CF23052",
        ),
        Key(
            "position",
            "integer",
            "place of the slave on the cable, 1 for the first (binding: `address`)",
            1,
            "",
            1,
            199,
        ),
        Key(
            "input_bytes",
            "integer",
            "size of the slave's inputs, compared at connection; 0: not compared",
            0,
            "byte",
            0,
            1486,
            example="16",
        ),
        Key(
            "transmit",
            "list",
            "objects that the inputs consist of, written to 0x1A00; none: the slave keeps its own mapping",
            None,
            example="[0x6041, 0x6077]",
        ),
        Key("objects", "section", "types of the maker's own objects", None, example="{'0x30D1:2': int32}"),
        Key(
            "command",
            "node",
            "of a drive: object that takes the command; 0x1600 becomes control word 0x6040 and this object",
            None,
            example="0x6071",
        ),
        Key("mode", "integer", "of a drive: object 0x6060, as of `cia402`", 0, "", -128, 127, example="10"),
        Key("start_up", "list", "further objects written at set-up", None),
        Key(
            "watchdog_s",
            "node",
            "of a drive: the slave leaves operation when our frames stop for this long; written to its process data "
            "watchdog. `none`: it has no watchdog, and `check` says so",
            None,
            "s",
            example="0.1",
        ),
        Key("timeout_s", "number", "longest wait for a frame to return", 0.002, "s", 1e-4, 0.1),
    ),
    "channel of ethercat": (
        *_PLACE,
        Key("type", "text", "int8 .. int64, uint8 .. uint64, float32, float64; an object has its own", ""),
        *bits_of("it"),
        Key("signed", "flag", "the bits are a two's complement", False),
        Key("sentinels", "list", "raw numbers that mean 'no reading'", None, example="[32767]"),
        Key("invalid", "section", "bits of the inputs that say that the reading is wrong", None),
    ),
    "invalid of ethercat": (
        *_PLACE,
        Key("type", "text", "as of a channel", "uint16"),
        Key("mask", "integer", "its bits that are looked at", REQUIRED, "", 1, 2**32, example="0x4040"),
        Key("good", "integer", "their value when the reading is good", 0, "", 0, 2**32),
    ),
}
