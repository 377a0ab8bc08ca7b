"""Ways in which a reading is lost, read from the device's own message, each with its remedy. Pure.

A reading that is gone, one that is silent and one that is slow give the same fault (`..._stale`, `..._error`)
and need three remedies. A remedy names only commands that can run beside the daemon.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

LATE_WINDOW_S = 1.0
"""Late ticks are looked for in this time before a fault; a longer silence is the device's own."""
BACK = "the reading is back: look at the device's plug and supply, then `thermoctl disarm` acknowledges the fault"
"""Remedy for a reading that was lost and is valid again."""


@dataclass(frozen=True)
class Loss:
    """One way to lose a reading.

    words: pattern of the driver's message. remedy: {since} stands for the time of the last reading."""

    name: str
    meaning: str
    words: str
    remedy: str

    @property
    def is_certain(self) -> bool:
        """True where the message states the cause, so that late ticks do not come before it."""
        return self.name not in ("silent", "slow")


UNBOUND = Loss(
    "unbound",
    "no device of the configuration has this role",
    "",
    "bind a device to this role in hal.devices, or take it out of protection.required; `thermoctl check` shows both places",
)
SLOW = Loss(
    "slow",
    "readings arrive, but later than the limit",
    "",
    "`thermoctl status` names a slow reading with its rate: set the device faster or poll fewer registers; else raise "
    "protection.stale_s to its real rate, then `thermoctl reload`",
)
LOSSES = (
    Loss(
        "bus-off",
        "the CAN adapter left the bus after too many transmission errors",
        "bus-off",
        "correct the bitrate, put a terminator at both ends, look for a short between CAN_H and CAN_L",
    ),
    Loss(
        "refused",
        "the system does not let the daemon open the port",
        r"permission denied|in use by another program|cannot do \d+ baud",
        "do what the message says; the daemon tries the port again every second",
    ),
    Loss(
        "gone",
        "the port was closed, or the link to the device is lost",
        r"lost on |no such device|cannot be opened|connection is gone|nobody answers|gone while|was lost|not connected",
        "plug the device in, or power it; {since}the daemon connects again by itself",
    ),
    Loss(
        "garbled",
        "something arrives that is no reading",
        r"wrong CRC|bytes came|no valid answer|gave no reading|no line end|field that says 'equals'",
        "compare baud rate, parity and frame of the profile with the device's manual; look for a second sender on the line",
    ),
    Loss(
        "silent",
        "the port is open and nothing arrives",
        r"nothing arrives|no answer within|does not answer|posted nothing",
        "power the device, check its cable, baud rate and address; {since}the daemon goes on asking",
    ),
)
"""The losses that a message reports, the first whose words it contains."""


def loss_of(message: str) -> Loss | None:
    """Return the loss that a driver's message reports; None where the device reports its own state."""
    return next((loss for loss in LOSSES if re.search(loss.words, message)), None)
