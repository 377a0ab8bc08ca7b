"""Polling of slow devices, in a process or a thread of its own; the readings go to a board."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial

from thermoctl_hal.base.backend import STALE, HardwareError, Sample
from thermoctl_hal.base.binding import port_key
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.profile import Assumed
from thermoctl_hal.rig.board import Board

RECONNECT_S = 0.25  # time between attempts to open a device that is gone
END_S = 1.0  # after this time a process that drives nothing waits for no device any more
COMMAND_AGE_S = 0.25  # an amplifier is disabled when the loop's last command is older


def ports(devices: Iterable[Device]) -> list[list[Device]]:
    """Group slow devices by their port: those of a group are polled in turn."""
    groups: dict[str, list[Device]] = {}
    for device in devices:
        groups.setdefault(port_key(device.binding.port), []).append(device)
    return list(groups.values())


def poll_until(devices: list[Device], board: Board, stop: threading.Event) -> None:
    """Poll the slow devices of a port and post to the board, until `stop` is set.

    Each is polled at its fastest channel's rate; the longest overdue comes next. After each other device a
    drive that is due has one turn. A drive whose `enable` was withdrawn comes at once. A device that is gone
    is connected again, and its last values are kept until they are stale."""
    period_s = {d: 1.0 / _rate_hz(d) for d in devices}
    enabled = {d: False for d in devices if d.drives}
    had_turn: set[Device] = set()  # drives, since the last turn of another device

    def is_withdrawn(device: Device) -> bool:
        """Return whether a drive still has to be disabled."""
        return enabled.get(device, False) and not _command(device, board)[1]

    def is_first(device: Device) -> bool:
        """Return whether a drive goes before the others."""
        is_due = device.drives and device not in had_turn and due_s[device] <= time.monotonic()
        return is_due or is_withdrawn(device)

    samples = {d: Sample(len(d.binding.channels.names)) for d in devices}
    due_s = dict.fromkeys(devices, time.monotonic())
    for device in devices:
        samples[device].status[device.roles] = STALE
        others = [d for d in enabled if d is not device]
        device.is_urgent = partial(_is_urgent, stop, is_withdrawn, others)
    while not stop.is_set():
        device = min(devices, key=lambda d: (not is_first(d), due_s[d]))
        if not is_first(device) and stop.wait(max(0.0, due_s[device] - time.monotonic())):
            break
        is_enabled = _poll(device, samples[device], board)
        if device.drives:
            enabled[device] = is_enabled
            had_turn.add(device)
        else:
            had_turn.clear()
        board.post(samples[device], device)
        due_s[device] += period_s[device] if device.up else RECONNECT_S
        due_s[device] = max(due_s[device], time.monotonic())  # a slow answer: drop the polls that were missed
    for device in devices:
        device.is_urgent = lambda: False  # the state of an amplifier is read below
        if device.drives and not device.up:
            with contextlib.suppress(HardwareError, OSError):
                device.switch_off()
        device.up = False
        device.disconnect()  # disables an amplifier that is up


def _rate_hz(device: Device) -> float:
    amplifier = device.binding.profile.amplifier
    rates = [b.channel.rate_hz for b in device.binding.bounds if not isinstance(b.channel.source, Assumed)]
    return max(rates + ([amplifier.command_hz] if amplifier is not None else []))


def _is_urgent(stop: threading.Event, is_withdrawn: Callable[[Device], bool], others: list[Device]) -> bool:
    return stop.is_set() or any(map(is_withdrawn, others))


def _command(device: Device, board: Board) -> tuple[float, bool]:
    """Return the loop's command of a drive; disabled where the last one is old."""
    drive, enable, sent_s = board.command(device)
    is_fresh = time.monotonic() - sent_s <= COMMAND_AGE_S
    return (drive, enable) if is_fresh else (0.0, False)


def _poll(device: Device, sample: Sample, board: Board) -> bool:
    """Read a device and write a drive's command; return whether the drive was left enabled."""
    try:
        if not device.up:
            device.connect()
            device.up = True
        device.poll(sample)
        if device.drives:
            drive, enable = _command(device, board)
            device.write(drive, enable, time.monotonic())
            return enable
    except (HardwareError, OSError) as e:
        if device.up:
            device.counts["reconnections"] += 1
        device.up = False
        device.disconnect()
        if device.drives:
            device.fail_all(sample, f"{e}; reconnecting")
        device.miss_all(f"{e}; reconnecting")
    return False


def run_poller(devices: list[Device], board_name: str) -> None:
    """Run a poller process for the devices of a port, until SIGTERM or until the parent is gone."""
    board = Board.attach(board_name)
    stop = threading.Event()
    # A thread takes SIGTERM: a handler could interrupt `stop` itself, and wait for good for its lock.
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the group; the supervisor stops us
    parent = os.getppid()

    def watch() -> None:
        """Set `stop` at SIGTERM, or within 0.5 s after the parent has ended; then see that this one ends."""
        while signal.sigtimedwait([signal.SIGTERM], 0.5) is None and os.getppid() == parent:
            pass
        stop.set()
        if not any(d.drives for d in devices):
            time.sleep(END_S)
            os._exit(0)  # still waiting for a host: to connect, or for its name

    threading.Thread(target=watch, daemon=True).start()
    poll_until(devices, board, stop)
