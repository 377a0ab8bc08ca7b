"""The keys of a CAN device in a profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.cia402 import START_UP
from thermoctl_hal.base.key import REQUIRED, Key

CAN: dict[str, tuple[Key, ...]] = {
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
    "channel of can-dbc": (
        Key("message", "text", "message of the DBC file"),
        Key("signal", "text", "signal of that message; a multiplexed one counts only when it is sent"),
        Key("invalid", "section", "a signal of the same message that says that the reading is wrong", None),
        Key(
            "sentinels",
            "list",
            "values of the signal (or its raw numbers) that mean 'no reading'; compared as raw numbers; 0x.. are its bits",
            None,
            example="[3276.7]",
        ),
    ),
    "invalid of can-dbc": (
        Key("signal", "text", "the signal"),
        Key("mask", "integer", "bits of its raw number that are looked at; 0: all", 0, example="0x04"),
        Key("good", "integer", "raw number of these bits when the reading is good", 0, "", 0, 2**32),
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
    "start_up": START_UP,
    "channel of can-cia402": (Key("object", "node", "an object of `transmit`, or 0x603F (error code)"),),
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
}
