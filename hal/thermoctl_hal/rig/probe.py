"""Read a device without a rig file: the channels of its profile, or the raw traffic of its port.

Nothing is driven.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from thermoctl_hal.base.backend import ERROR, OK, ROLE, ROLES, HardwareError, Sample
from thermoctl_hal.base.binding import Binding, Bound, limits_of
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.line import open_port
from thermoctl_hal.base.profile import ERROR_CODE, Assumed, Cia402, LineSettings, Object, Profile, typed
from thermoctl_hal.base.wire import EXTENDED, read_available
from thermoctl_hal.can.bus import open_can
from thermoctl_hal.can.set_up import Objects, Sdo
from thermoctl_hal.modbus.link import FUNCTIONS, Link, NoAnswer
from thermoctl_hal.rig.make import driver

SHOWN_BYTES, FIRST_REGISTERS, PAUSE_S = 256, 10, 0.002


@dataclass(frozen=True)
class Reading:
    """A channel: raw number and reading (NaN without one), unit, and the problem ('' when it is good)."""

    channel: str
    raw: float
    value: float
    unit: str
    problem: str


class Probe:
    """The channels of a profile, read from a port. An amplifier is only listened to.

    Channels take the roles of a sample in turn; the meanings of the roles do not matter here."""

    def __init__(self, profile: Profile, port: str, address: int | None) -> None:
        self.profile = replace(profile, amplifier=None)
        channels = [c for c in profile.channels.values() if not isinstance(c.source, Assumed)]
        bounds = [
            Bound(role, c, c.scale, c.offset, *limits_of(c))
            for role, c in zip(ROLES, channels[: len(ROLES)], strict=False)
        ]
        spec = profile.bus_spec
        self._binding = Binding(
            profile.model,
            self.profile,
            port,
            spec.address if address is None else address,
            tuple(bounds),
            profile.file,
        )
        self.sample = Sample()
        self.device: Device | None = None if isinstance(spec, Cia402) else driver(self._binding)

    def open(self) -> None:
        """Open the port. Raises HardwareError, InputError."""
        if self.device is not None:
            self.device.connect()

    def close(self) -> None:
        """Close the port."""
        if self.device is not None:
            self.device.disconnect()

    def step(self) -> None:
        """Read once. Raises HardwareError, OSError."""
        if self.device is None:
            self._read_objects()
        elif self.device.slow:
            self.device.poll(self.sample)
        else:
            self.device.read(self.sample, time.monotonic())

    def _read_objects(self) -> None:
        """Read the objects of a drive by SDO; nothing is configured."""
        spec = typed(self.profile.bus_spec, Cia402)
        node = self._binding.address
        objects = Objects(spec, self.profile.file, node)
        port = open_can(self._binding.port, (0x580 + node, *range(0x701, 0x780)))
        try:
            sdo = Sdo(port, node, spec.sdo_timeout_s)
            for i, b in enumerate(self._binding.bounds):
                item = typed(b.channel.source, Object)
                letter = "H" if item == ERROR_CODE else objects.format(item, "transmit")
                bits = 8 * {"B": 1, "H": 2, "I": 4}[letter.upper()]
                raw = sdo.read(item) & (1 << bits) - 1
                if letter.islower() and raw >> (bits - 1):
                    raw -= 1 << bits
                self.sample.value[i] = raw * b.scale + b.offset
                self.sample.status[i] = OK if b.low <= self.sample.value[i] <= b.high else ERROR
        finally:
            port.close()

    def complete(self) -> bool:
        """Return whether every channel has a reading or a fault."""
        return all(self.sample.status[ROLE[b.role]] in (OK, ERROR) for b in self._binding.bounds)

    def readings(self) -> list[Reading]:
        """Return every channel, in the order of the profile."""
        readings = []
        for b in self._binding.bounds:
            role = ROLE[b.role]
            value, problem = float(self.sample.value[role]), ""
            if self.sample.status[role] != OK:
                outside = "outside its range" if self.sample.status[role] == ERROR else "not read"
                device = self.device
                problem = outside if device is None else device.problems.get(role) or device.silence()
            raw = (value - b.offset) / b.scale if not math.isnan(value) else math.nan
            readings.append(Reading(b.channel.name, raw, value, b.channel.unit, problem))
        return readings


def read_for(probe: Probe, seconds: float) -> list[Reading]:
    """Read until every channel is known, at most for `seconds`; return the channels.

    Raises HardwareError, OSError."""
    probe.open()
    try:
        end, problem = time.monotonic() + seconds, None
        while not probe.complete() and time.monotonic() < end:
            try:
                probe.step()
            except HardwareError as e:
                problem = e
            time.sleep(PAUSE_S)
        readings = probe.readings()
        if problem is not None and all(math.isnan(r.value) for r in readings):
            raise problem
        return readings
    finally:
        probe.close()


def raw_traffic(port: str, seconds: float, baud: int, unit: int) -> list[str]:
    """Return lines about a port without any profile. Raises HardwareError, OSError.

    Modbus: the first registers and bits of a unit. CAN: the identifiers that arrive. Serial: the bytes."""
    if port.startswith(("rtu:", "tcp:")):
        return _registers(port, baud, unit)
    if ":" in port and not port.startswith(("/", "socket:")):
        return _frames(port, seconds)
    line: Any = open_port(port, LineSettings(baud=baud))
    data = bytearray()
    try:
        _listen(seconds, lambda: data.extend(read_available(line.fileno())))
    finally:
        line.close()
    if not data:
        return [
            f"nothing arrived in {seconds:g} s at {baud} baud: many devices answer only when they are asked"
        ]
    return [
        f"{len(data)} bytes at {baud} baud",
        bytes(data[:SHOWN_BYTES]).hex(" "),
        repr(bytes(data[:SHOWN_BYTES])),
    ]


def _registers(port: str, baud: int, unit: int) -> list[str]:
    link = Link(port, LineSettings(baud=baud), 1.0)
    lines = []
    try:
        for kind in FUNCTIONS:
            try:
                values = link.read(kind, 0, FIRST_REGISTERS, unit, 1.0)
            except NoAnswer as e:
                lines.append(f"{kind}: {e}")
                continue
            shown = f"exception {values}" if isinstance(values, int) else " ".join(map(str, values))
            lines.append(f"{kind} 0..{FIRST_REGISTERS - 1}: {shown}")
    finally:
        link.close()
    return lines


def _frames(port: str, seconds: float) -> list[str]:
    bus = open_can(port, ())
    seen: dict[int, tuple[int, bytes]] = {}

    def take() -> None:
        """Count the received frames by identifier and keep the last data of each."""
        for can_id, data in [*bus.receive(), *bus.long_frames()]:
            seen[can_id] = (seen.get(can_id, (0, b""))[0] + 1, data)

    try:
        _listen(seconds, take)
    finally:
        bus.close()
    return [
        f"0x{i & ~EXTENDED:X} ({29 if i & EXTENDED else 11} bits): {n} frames, last {data.hex(' ')}"
        for i, (n, data) in sorted(seen.items())
    ] or [f"no frame in {seconds:g} s: check the bitrate, and who sends"]


def _listen(seconds: float, take: Callable[[], object]) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        take()
        time.sleep(PAUSE_S)
