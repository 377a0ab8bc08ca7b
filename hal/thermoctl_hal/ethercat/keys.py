"""The keys of an EtherCAT slave's profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.key import Key, bits_of, flag, listed, node, number, section, text, whole

_PLACE = (
    node("object", "an object of `transmit`; give this or `byte`", None, example="0x6041"),
    whole(
        "byte",
        "first byte of the value in the slave's inputs, from 0",
        0,
        1485,
        "byte",
        default=None,
        example="2",
    ),
)

ETHERCAT: dict[str, tuple[Key, ...]] = {
    "ethercat": (
        whole("vendor_id", "the maker's number, compared at connection", 1, 2**32 - 1, example="0x2"),
        whole(
            "product_code", "the product's number, compared at connection", 0, 2**32 - 1, example="0x0CF23052"
        ),
        whole("position", "place on the cable, 1 for the first (binding: `address`)", 1, 199, default=1),
        whole(
            "input_bytes",
            "size of the slave's inputs, compared at connection; 0: not compared",
            0,
            1486,
            "byte",
            default=0,
            example="16",
        ),
        listed(
            "transmit",
            "objects that the inputs consist of, written to 0x1A00; none: the slave keeps its own mapping",
            None,
            example="[0x6041, 0x6077]",
        ),
        section("objects", "types of the maker's own objects", None, example="{'0x30D1:2': int32}"),
        node(
            "command",
            "of a drive: object that takes the command; 0x1600 becomes control word 0x6040 and this object",
            None,
            example="0x6071",
        ),
        whole("mode", "of a drive: object 0x6060, as of `cia402`", -128, 127, default=0, example="10"),
        listed("start_up", "further objects written at set-up", None),
        node(
            "watchdog_s",
            "of a drive: the slave leaves operation when our frames stop for this long; written to its process data "
            "watchdog. `none`: it has no watchdog, and `check` says so",
            None,
            unit="s",
            example="0.1",
        ),
        number("timeout_s", "longest wait for a frame to return", 1e-4, 0.1, "s", default=0.002),
    ),
    "channel of ethercat": (
        *_PLACE,
        text("type", "int8 .. int64, uint8 .. uint64, float32, float64; an object has its own", ""),
        *bits_of("it"),
        flag("signed", "the bits are a two's complement", False),
        listed("sentinels", "raw numbers that mean 'no reading'", None, example="[32767]"),
        section("invalid", "bits of the inputs that say that the reading is wrong", None),
    ),
    "invalid of ethercat": (
        *_PLACE,
        text("type", "as of a channel", "uint16"),
        whole("mask", "its bits that are looked at", 1, 2**32, example="0x4040"),
        whole("good", "their value when the reading is good", 0, 2**32, default=0),
    ),
}
