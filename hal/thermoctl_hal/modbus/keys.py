"""The keys of a Modbus device in a profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.key import Key, bits_of, flag, listed, node, number, section, text, whole

MAX_ADDRESS = 65535
_KINDS, _ORDERS = ("input", "holding", "discrete", "coil"), ("big", "little")

MODBUS: dict[str, tuple[Key, ...]] = {
    "modbus": (
        whole("unit_id", "unit (binding: `address`); above 247 only on TCP", 0, 255, default=1),
        number(
            "timeout_s",
            "longest time for an answer; a drive without valid ones is disabled after three",
            0.01,
            10,
            "s",
            default=0.3,
        ),
        whole("max_gap", "registers are read together over gaps of up to this many", 0, 100, default=8),
        whole("max_block", "registers read by one request, at most", 1, 125, default=100),
    ),
    "channel of modbus": (
        text("kind", "input (function 4), holding (3), discrete (2) or coil (1)", "input", choices=_KINDS),
        whole(
            "register",
            "address from 0: a manual's 40001 is kind: holding, register: 0",
            0,
            MAX_ADDRESS,
            example="0",
        ),
        text("type", "int16 .. int64, uint16 .. uint64, float32, float64, bcd16, bcd32", "int16"),
        text(
            "word_order",
            "order of the words of a value: big is a manual's ABCD, little CDAB; with byte_order little BADC, DCBA",
            "big",
            choices=_ORDERS,
        ),
        text("byte_order", "order of the two bytes of a word", "big", choices=_ORDERS),
        *bits_of("the register"),
        flag("signed", "the bits are a two's complement", False),
        listed(
            "sentinels",
            "raw numbers that mean 'no sensor'; 0x.. are the bits of the register",
            None,
            example="[32767, 0x8000]",
        ),
        whole(
            "scale_register",
            "register of a whole number n with sign: the value counts 10^n (SunSpec's scale factors)",
            0,
            MAX_ADDRESS,
            default=None,
            example="40077",
        ),
        section("invalid", "a register or bit that says that the reading is wrong (open wire)", None),
    ),
    "invalid of modbus": (
        text("kind", "as of a channel", "input", choices=_KINDS),
        whole("register", "address from 0", 0, MAX_ADDRESS, example="120"),
        whole("mask", "bits of the register that are looked at", 1, 0xFFFF, default=0xFFFF, example="0x0300"),
        whole("good", "their value when the reading is good", 0, 0xFFFF, default=0),
    ),
    "message of modbus": (
        text("kind", "holding or coil", "holding", choices=("holding", "coil")),
        whole("register", "address from 0", 0, MAX_ADDRESS),
        text("type", "as of a channel", "int16"),
        text("word_order", "order of the words", "big", choices=_ORDERS),
        node("value", "the number written, or `command`"),
        whole(
            "function", "6 or 16 for registers, 5 for coils; 0: by the number of registers", 0, 16, default=0
        ),
    ),
}
