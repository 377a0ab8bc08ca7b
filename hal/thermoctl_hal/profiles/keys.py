"""Every key of a device profile, in tables: the reader and the reference page both use them.

A table lists the keys of one mapping of the file. A key that stands in no table is refused.
"""

from __future__ import annotations

import math

from thermoctl_hal.base.key import REQUIRED, Key
from thermoctl_hal.can.keys import CAN
from thermoctl_hal.ethercat.keys import ETHERCAT
from thermoctl_hal.modbus.keys import MODBUS
from thermoctl_hal.profiles.buses import BUSES
from thermoctl_hal.serial.keys import SERIAL

PROFILE: dict[str, tuple[Key, ...]] = {
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
}

TABLES = PROFILE | SERIAL | CAN | MODBUS | ETHERCAT
