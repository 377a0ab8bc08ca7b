"""Make the back end and the drivers that the configuration names."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from thermoctl.configuration.settings import Settings
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.channels import AxesChannels
from thermoctl_hal.base.backend import Backend, HardwareError
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.device import Device
from thermoctl_hal.profiles.bind import bind, check_rig, file_warnings, rig_notes
from thermoctl_hal.profiles.buses import BUSES, part
from thermoctl_hal.rig.axes import AxisBackend
from thermoctl_hal.rig.board import Board
from thermoctl_hal.rig.devices import DevicesBackend
from thermoctl_hal.rig.poller import ports
from thermoctl_hal.simulated.faulty import FaultInjector, schedule

SIMULATED = "thermoctl_hal.simulated.rig:simulated_backend"
"""Imported where it is asked for, because it loads the plant's packages."""


def make_backend(settings: Settings, board: Board | None = None) -> Backend:
    """Make the back end of `settings.hal`, not yet open.

    It is wrapped in a fault injector when `hal.faults` lists any. board: filled by poller processes, or None
    to poll slow devices from threads of this process. Raises InputError: a mistake in the configuration, a
    profile or the plant."""
    backend = _plain_backend(settings, board)
    return _with_faults(backend, settings)


def make_backends(settings: Settings, board: Board | None = None) -> list[Backend]:
    """Make the back end of each axis, not yet open; of a rig without axes the only one. See make_backend.

    Devices are opened once, with the first of them, and read once a tick, by the first of them."""
    if not isinstance(settings.channels, AxesChannels):
        return [make_backend(settings, board)]
    if settings.hal.backend != "devices":
        return [make_backend(s) for s in settings.parts]
    devices = _devices_backend(settings, board)
    return [_with_faults(AxisBackend(devices, settings.channels, s.axis), s) for s in settings.parts]


def _devices_backend(settings: Settings, board: Board | None) -> DevicesBackend:
    needed = list(settings.protection.required)
    if isinstance(settings.channels, AxesChannels):
        required = [(s.axis, r) for s in settings.parts for r in s.protection.required]
        needed = [f"{axis}.{r}" for axis, r in required] + [
            r for _, r in required if r in settings.channels.shared
        ]
    return DevicesBackend(fast_devices(settings), slow_devices(settings), board, needed, settings.channels)


def _plain_backend(settings: Settings, board: Board | None) -> Backend:
    kind = settings.hal.backend
    if kind == "devices":
        return _devices_backend(settings, board)
    if kind == "simulated":
        simulated: Backend = part(SIMULATED)(settings)
        return simulated
    raise ValueError(f"hal.backend is {kind!r}; settings.py allows simulated or devices")


def _with_faults(backend: Backend, settings: Settings) -> Backend:
    if settings.hal.faults:
        backend = FaultInjector(
            backend,
            schedule(settings.hal.faults, settings.channels),
            seed=settings.hal.seed,
            channels=settings.channels,
        )
    return backend


def fast_devices(settings: Settings) -> list[Device]:
    """Make the drivers of `hal.devices` that are read and written inside the tick, not yet open."""
    return [d for d in make_devices(settings) if not d.slow]


def slow_devices(settings: Settings) -> list[Device]:
    """Make the drivers of `hal.devices` with a blocking poll(), not yet open."""
    return [d for d in make_devices(settings) if d.slow]


def disable_amplifier(settings: Settings) -> None:
    """Disable the amplifier of `hal.devices` over a link of its own, if the loop no longer can.

    No other device is opened, and a mistake in another device's profile does not count. Raises HardwareError,
    OSError, InputError."""
    if settings.hal.backend != "devices":
        return
    groups = ports(driving_devices(settings))
    with ThreadPoolExecutor(len(groups) or 1) as pool:  # a dead port delays no other one
        failed = [line for lines in pool.map(_switch_off, groups) for line in lines]
    if failed:
        raise HardwareError("; ".join(failed))


def _switch_off(devices: list[Device]) -> list[str]:
    """Disable the amplifiers of a port in turn; return a line for each that failed."""
    failed = []
    for device in devices:
        try:
            device.switch_off()
        except (HardwareError, OSError) as e:  # the other axes' amplifiers are switched off all the same
            failed.append(f"{device.name}: {e}")
    return failed


def make_devices(settings: Settings) -> list[Device]:
    """Make the drivers of `hal.devices`, not connected. Raises InputError.

    Paths of profiles are relative to the configuration file."""
    return [driver(b) for b in check_rig(bindings(settings))]


def bindings(settings: Settings) -> list[Binding]:
    """Return each item of `hal.devices`, bound to its profile. Raises InputError."""
    return [bind(node, Path(settings.path).parent, settings.channels) for node in settings.hal.devices]


def device_notes(settings: Settings) -> list[str]:
    """Return a line for each probable mistake in `hal.devices`. Raises InputError."""
    bound = bindings(settings)
    limit = settings.control.output_limit
    return rig_notes(bound) + [
        f"{b.place}: control.output_limit is {limit:g}, but {b.name} takes commands of {low:g} .. {high:g} "
        "(drive.limits): the rest is cut off, and drive_saturated does not see it; lower output_limit"
        for b in bound
        if b.profile.amplifier
        for low, high in (b.profile.amplifier.limits,)
        if limit > max(-low, high)
    ]


def device_warnings(settings: Settings) -> list[str]:
    """Return a line for each file of a device that was read in spite of a fault. Raises InputError."""
    return file_warnings(bindings(settings)) if settings.hal.backend == "devices" else []


def whole_frames(settings: Settings) -> dict[str, str]:
    """Return role -> device, for devices that send all their channels in each frame or line."""
    return {
        x.role: b.name
        for b in bindings(settings)
        if b.profile.bus in ("serial-binary", "serial-lines", "can-cia402")
        or len({getattr(x.channel.source, "message", x.role) for x in b.bounds}) == 1
        and b.profile.bus == "can-dbc"
        for x in b.bounds
    }


def driving_devices(settings: Settings) -> list[Device]:
    """Make the drivers of the devices that take the command, not connected.

    A mistake in another device's binding or profile does not count. Raises InputError where no device drives
    because of a mistake."""
    devices, mistakes = [], []
    for node in settings.hal.devices:
        try:
            binding = bind(node, Path(settings.path).parent, settings.channels)
            if binding.profile.amplifier is not None:
                devices.append(driver(binding))
        except InputError as e:
            mistakes.append(e)
    if mistakes and not devices:
        raise mistakes[0]
    return devices


def can_drive(settings: Settings) -> bool:
    """Return whether a device takes the drive command, so that the rig may be armed. Raises InputError."""
    return settings.hal.backend != "devices" or bool(driving_devices(settings))


def driver(binding: Binding) -> Device:
    """Make the driver of a bound device, not connected. Raises InputError."""
    amplifier, bus = binding.profile.amplifier, BUSES[binding.profile.bus]
    made: Device = part(bus.drive if amplifier is not None and bus.drive else bus.driver)(binding)
    return made
