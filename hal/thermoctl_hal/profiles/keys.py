"""Every key of a device profile, in tables: the reader and the reference page both use them.

A table lists the keys of one mapping of the file. A key that stands in no table is refused.
"""

from __future__ import annotations

import math

from thermoctl_hal.base.key import REQUIRED, Key, listed, node, number, section, text
from thermoctl_hal.can.keys import CAN
from thermoctl_hal.ethercat.keys import ETHERCAT
from thermoctl_hal.modbus.keys import MODBUS
from thermoctl_hal.profiles.buses import BUSES
from thermoctl_hal.serial.keys import SERIAL

PROFILE: dict[str, tuple[Key, ...]] = {
    "profile": (
        text("format", "`thermoctl-device/1`"),
        text("vendor", "who makes the device"),
        text("model", "its product name"),
        text("manual", "title of the document that states the registers or frames", ""),
        text("edition", "edition of that document: version, date, document number or commit", ""),
        text("place", "page, section or table of it that states them", ""),
        text("about", "what else a user should know", ""),
        text("bus", ", ".join(BUSES)),
        section("line", "settings of a serial line", None),
        section("channels", "the readings, by name"),
        section("drive", "the command that an amplifier takes", None),
    ),
    "channel": (
        text(
            "unit", "unit of the reading: um, nm, mm, m, in, deg, arcsec, rad, V, mV, A, mA, degC, degF, K, 1"
        ),
        number("scale", "reading = raw x scale + offset", default=1.0),
        number("offset", "the same", default=0.0),
        Key("range", "interval", "[low, high]: readings outside are errors", (-math.inf, math.inf), "unit"),
        number("rate_hz", "rate of the readings", 1e-3, 1e5, "Hz", example="10"),
        number("stale_after_s", "largest age of a valid reading", 1e-4, 3600, "s", example="1"),
    ),
    "drive": (
        text("unit", "unit of the command"),
        number("scale", "one count of the command", 1e-12, unit="unit", example="0.001"),
        Key(
            "limits",
            "interval",
            "[low, high]: the largest commands ever sent",
            REQUIRED,
            "unit",
            example="[-2.5, 2.5]",
        ),
        number(
            "slew_per_s",
            "largest rate of the command; required in a position mode, where it starts from the present position",
            0,
            unit="unit/s",
            default=0.0,
            example="500",
        ),
    ),
    "drive by messages": (
        node("command", "the message that carries the command (see Messages)"),
        number("command_hz", "commands per second, at most one a tick", 0.1, 10000, "Hz", default=100.0),
        listed("set_up", "messages that are sent before each `enable`: mode, limits", None),
        listed("enable", "messages that enable it", None),
        listed("disable", "messages that disable it, after a command of 0"),
        listed("reset", "messages that reset a fault, sent only while disabled", None),
        node("state", "`assumed`, or the channel and its numbers: every other number is a fault"),
        text("fault", "channel that is 0 without a fault", "", example="error"),
        node(
            "watchdog_s",
            "the device stops by itself when our messages stop for this long, as set in the device; `none`: it "
            "does not, and `check` says so",
            example="0.1",
        ),
    ),
    "state of a drive": (
        text("channel", "the channel, bound to the role amplifier_state"),
        listed("enabled", "its raw numbers for: follows the command", example="[8]"),
        listed("disabled", "for: without power", example="[0, 1]"),
        listed("quick_stop", "for: stopped by itself", None),
    ),
}

TABLES = PROFILE | SERIAL | CAN | MODBUS | ETHERCAT
