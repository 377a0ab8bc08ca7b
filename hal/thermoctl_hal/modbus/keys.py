"""The keys of a Modbus device in a profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.key import REQUIRED, Key, bits_of

MAX_ADDRESS, MAX_MODBUS_BITS = 65535, 64

MODBUS: dict[str, tuple[Key, ...]] = {
    "modbus": (
        Key("unit_id", "integer", "unit (binding: `address`); above 247 only on TCP", 1, "", 0, 255),
        Key("timeout_s", "number", "longest time for an answer", 0.3, "s", 0.01, 10),
        Key("max_gap", "integer", "registers are read together over gaps of up to this many", 8, "", 0, 100),
        Key("max_block", "integer", "registers read by one request, at most", 100, "", 1, 125),
    ),
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
        Key(
            "word_order",
            "text",
            "order of the words of a value: big is a manual's ABCD, little CDAB; with byte_order little BADC, DCBA",
            "big",
            choices=("big", "little"),
        ),
        Key("byte_order", "text", "order of the two bytes of a word", "big", choices=("big", "little")),
        *bits_of("the register"),
        Key("signed", "flag", "the bits are a two's complement", False),
        Key(
            "sentinels",
            "list",
            "raw numbers that mean 'no sensor'; 0x.. are the bits of the register",
            None,
            example="[32767, 0x8000]",
        ),
        Key(
            "scale_register",
            "integer",
            "register of a whole number n with sign: the value counts 10^n (SunSpec's scale factors)",
            None,
            "",
            0,
            MAX_ADDRESS,
            example="40077",
        ),
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
}
