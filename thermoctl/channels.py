"""Define every channel once; a channel is one reading from a device.

All arrays over channels have the order of TABLE. Back ends, protection limits, fault bits, the law's indices,
the recording's signals and `status` derive from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

OK, STALE, ERROR, ABSENT = range(4)
STATUS_NAMES = ("OK", "STALE", "ERROR", "ABSENT")
"""Status of a reading. ERROR: its device reports it as invalid, or is lost. ABSENT: no device has this role.
"""

AMP_OFFLINE, AMP_DISABLED, AMP_ENABLED, AMP_FAULT, AMP_QUICK_STOP = (float(k) for k in range(5))
AMPLIFIER_STATES = ("offline", "disabled", "enabled", "fault", "quick stop")
"""Values of `amplifier_state`. Offline: starting up, or lost. Disabled: powered and not driving."""

GROUPS = {
    "position": "position encoder",
    "monitored": "output reference or one of the other temperatures",
    "voltage": "coil voltage",
    "current": "coil current",
    "air": "chamber air temperature",
    "coil": "coil temperature",
    "amplifier": "the amplifier's report of itself",
}
"""Groups of channels that share their fault bits, with the group's name in messages.

The law only watches the `monitored` channels when the coil's sensor alone corrects the estimate.
"""


@dataclass(frozen=True)
class Channel:
    """One channel: `role` in the configuration, `unit` as pint reads it ('1' for a number), fault `group`.

    `low` and `high` bound a plausible reading. `signal` is its column in a recording (default: the role).
    `point` is the place of a temperature on the actuator. A `thermal` sensor follows its body slowly, and its
    delay is recorded. A `code` is a state or an error number: it is constant in normal operation, so it is
    never checked for `frozen`.
    """

    role: str
    unit: str
    group: str
    meaning: str
    low: float = -inf
    high: float = inf
    signal: str = ""
    point: str = ""
    thermal: bool = False
    code: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "signal", self.signal or self.role)


def _point(name: str, group: str = "monitored") -> Channel:
    """Return the temperature of one point of the actuator."""
    meaning = f"{name.replace('_', ' ')}: measured"
    return Channel(f"{name}_c", "degC", group, meaning, -40.0, 200.0, point=name, thermal=True)


TABLE = (
    Channel("position_um", "um", "position", "position encoder", signal="position_raw_um"),
    Channel(
        "output_reference_um",
        "um",
        "monitored",
        "second encoder at the output, for proof only; the controller does not use it",
    ),
    Channel("voltage_v", "V", "voltage", "coil voltage"),
    Channel("current_a", "A", "current", "coil current"),
    Channel("air_c", "degC", "air", "chamber air", -40.0, 80.0, thermal=True),
    _point("coil", "coil"),
    _point("bobbin"),
    _point("inner_magnet"),
    _point("outer_magnet"),
    _point("inner_stator"),
    _point("outer_stator"),
    _point("stator_connector"),
    _point("bobbin_connector"),
    _point("shaft_1"),
    _point("shaft_2"),
    _point("bracket_1"),
    _point("bracket_2"),
    Channel("supply_v", "V", "amplifier", "the amplifier's supply", 0.0),
    Channel(
        "amplifier_state",
        "1",
        "amplifier",
        ", ".join(f"{k} {state}" for k, state in enumerate(AMPLIFIER_STATES)),
        0.0,
        len(AMPLIFIER_STATES) - 1.0,
        code=True,
    ),
    Channel("amplifier_fault", "1", "amplifier", "the amplifier's own error code; 0 none", 0.0, code=True),
)
"""The channels. Append a new one at the end: `fresh_bits` and `status_bits` of recordings hold one bit a
channel.

Thermal channels must be neighbours, air first, then the points; `delay_bits` holds 13 of them.
"""

CHANNELS = tuple(c.role for c in TABLE)
INDEX = {role: i for i, role in enumerate(CHANNELS)}
SIGNAL = {c.role: c.signal for c in TABLE}
"""Each channel's column in a recording."""
POINTS = tuple(c.point for c in TABLE if c.point)
"""The twelve temperature points, in the paper's order."""
TEMPERATURES = tuple(c.role for c in TABLE if c.point)
"""Their channels."""
THERMAL = tuple(c.role for c in TABLE if c.thermal)
CODES = tuple(c.role for c in TABLE if c.code)
