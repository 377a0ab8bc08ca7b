"""The keys of a CAN device in a profile, for the tables of profiles/keys.py."""

from __future__ import annotations

from thermoctl_hal.base.cia402 import START_UP
from thermoctl_hal.base.key import Key, listed, node, number, section, text, whole

CAN: dict[str, tuple[Key, ...]] = {
    "can-dbc": (
        text("dbc", "the DBC file, beside the profile"),
        whole(
            "node_shift",
            "the binding's `address`, shifted by so many bits, is added to every identifier of the DBC file",
            0,
            28,
            default=None,
            example="5",
        ),
    ),
    "channel of can-dbc": (
        text("message", "message of the DBC file"),
        text("signal", "signal of that message; a multiplexed one counts only when it is sent"),
        section("invalid", "a signal of the same message that says that the reading is wrong", None),
        listed(
            "sentinels",
            "values of the signal (or its raw numbers) that mean 'no reading'; compared as raw numbers; 0x.. are its bits",
            None,
            example="[3276.7]",
        ),
    ),
    "invalid of can-dbc": (
        text("signal", "the signal"),
        whole("mask", "bits of its raw number that are looked at; 0: all", default=0, example="0x04"),
        whole("good", "raw number of these bits when the reading is good", 0, 2**32, default=0),
    ),
    "cia402": (
        text("eds", "the drive's EDS file; none: types of standard objects, and those of `objects`", ""),
        section(
            "objects",
            "types of the maker's own objects where there is no EDS file",
            None,
            example="{'0x30D1:1': int32}",
        ),
        whole("node_id", "node id (binding: `address`)", 1, 126, default=1),
        whole(
            "mode",
            "object 0x6060: 10 cyclic torque, 9 cyclic velocity, 8 cyclic position, 4 profile torque, 3 profile velocity, < 0 the maker's",
            -128,
            127,
        ),
        node("command", "object of RPDO 1 that takes the command: 0x6071, with a sub-index 0x30D1:1"),
        listed(
            "transmit",
            "objects of TPDO 1, at most 8 bytes, the status word 0x6041 first",
            example="[0x6041, 0x6078]",
        ),
        listed("start_up", "further objects written at set-up", None),
        number("heartbeat_s", "period of our heartbeat and of the drive's", 1e-3, 1, "s", default=0.02),
        number(
            "watchdog_s",
            "the drive stops when our heartbeat is missing for this long",
            2e-3,
            10,
            "s",
            default=0.1,
        ),
        whole("master_id", "our own node id (missing: 127 - node id)", 1, 127, default=0),
        number("sdo_timeout_s", "longest time for an answer at set-up", 0.01, 10, "s", default=0.3),
    ),
    "start_up": START_UP,
    "channel of can-cia402": (node("object", "an object of `transmit`, or 0x603F (error code)"),),
    "message of can-dbc": (
        text("message", "message of the DBC file"),
        section(
            "values", "signal: number, or `command`; the others are 0", None, example="{Torque: command}"
        ),
    ),
}
