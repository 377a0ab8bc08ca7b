"""Compare the rate of arriving readings with `rate_hz` of the devices' profiles; counters of the devices.

A sensor that sends at a tenth of its rate passes every age limit that suits a slow machine. But its readings
are older than the control loop and the limits on jumps assume. So `doctor` and `status` compare both rates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.tick.shared import COUNTER_WORDS, Shared
from thermoctl.rig.signals import AT

SLOW_SHARE = (
    # A rate below this share of rate_hz is reported; a busy machine reaches 0.8, a wrong setting 0.1 to 0.3.
    0.5
)
LOOK_ROWS = 4000  # newest ticks in which `status` counts readings
ATTEMPTS = 3  # number of attempts to read the counters, which the loop writes once a second
FEWEST = 10  # no rate is reported where fewer readings are expected in the ticks counted


def expected_hz(settings: Settings) -> dict[str, float]:
    """Return the profile's rate of each role, Hz; empty for back ends without devices.

    Raises InputError."""
    if settings.hal.backend != "devices":
        return {}
    from thermoctl_hal.rig.make import make_devices

    return {b.role: b.channel.rate_hz for d in make_devices(settings) for b in d.binding.bounds}


def slow(role: str, found_hz: float, expected: Mapping[str, float], reads_hz: float) -> str:
    """Return a sentence when `role` arrives too slowly, else ''.

    reads_hz: how often the reading was checked; a higher rate cannot be seen."""
    due_hz = min(expected.get(role, 0.0), reads_hz)
    if found_hz >= SLOW_SHARE * due_hz:
        return ""
    return (
        f"slow, {found_hz:.3g} of {expected[role]:.4g} Hz arrive: set the device faster, "
        "or rate_hz in its profile to what it can do"
    )


def put_counters(shared: Shared, counters: Mapping[str, int]) -> None:
    """Publish a back end's counters by `<device>.<counter>`; those that do not fit are left as they were."""
    by_device: dict[str, dict[str, int]] = {}
    for name, count in counters.items():
        device, _, counter = name.rpartition(".")
        by_device.setdefault(device, {})[counter] = int(count)
    text = json.dumps(by_device).encode()
    if by_device and len(text) <= 8 * (COUNTER_WORDS - 1):
        shared.device_counters.put(np.frombuffer(text.ljust(-(-len(text) // 8) * 8), "f8").copy())


def device_counters(shared: Shared) -> dict[str, dict[str, int]]:
    """Return the newest counters by device: frames, errors, lost, reconnections and the driver's own."""
    for _ in range(ATTEMPTS):
        if (words := shared.device_counters.get()) is not None:
            by_device: dict[str, dict[str, int]] = json.loads(np.asarray(words).tobytes())
            return by_device
    return {}


def slow_readings(shared: Shared, expected: Mapping[str, float]) -> list[str]:
    """List a line for each reading that arrived too slowly in the last LOOK_ROWS ticks.

    Only ticks in which the reading was good count: one that is lost is a fault and not listed."""
    rows, _, _ = shared.ring.read(max(0, shared.ring.head - LOOK_ROWS))
    if len(rows) < 2:
        return []
    tick_s = (rows[-1, AT["t_s"]] - rows[0, AT["t_s"]]) / (len(rows) - 1)
    arrived, good = shared.row.arrived(rows), shared.row.states(rows) == 0
    lines = []
    for c, role in enumerate(shared.channels.names):
        seconds = good[:, c].sum() * tick_s
        if role in expected and expected[role] * seconds >= FEWEST:
            found_hz = arrived[good[:, c], c].sum() / seconds
            if said := slow(role, found_hz, expected, 1 / tick_s):
                lines.append(f"{role}: {said}")
    return lines
