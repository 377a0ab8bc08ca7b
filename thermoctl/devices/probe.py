"""`thermoctl devices probe`: read a device without a rig file; drives nothing."""

from __future__ import annotations

import math

from thermoctl.devices.library import find
from thermoctl_hal.profiles.read import load_profile
from thermoctl_hal.rig.probe import Probe, raw_traffic, read_for

EXIT_OK, EXIT_PROBLEM = 0, 1


def probe(port: str, profile: str, address: int | None, seconds: float, baud: int) -> int:
    """Print every channel of the profile with raw number, reading and problem.

    Without a profile, print the raw traffic. Exit status 1 when a channel has a problem.
    Raises HardwareError, InputError."""
    if not profile:
        print("\n".join(raw_traffic(port, seconds, baud, 1 if address is None else address)))
        return EXIT_OK
    readings = read_for(Probe(load_profile(find(profile)), port, address), seconds)
    for r in readings:
        raw = "-" if math.isnan(r.raw) else f"{r.raw:.10g}"
        value = "-" if math.isnan(r.value) else f"{r.value:.6g}"
        print(f"{r.channel:20} raw {raw:>14}  {value:>12} {r.unit:6} {r.problem or 'OK'}")
    return EXIT_PROBLEM if any(r.problem for r in readings) else EXIT_OK
