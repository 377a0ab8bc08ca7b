"""Polling of slow devices, in a process or a thread of its own; the readings go to a board."""

from __future__ import annotations

import os
import signal
import threading
import time

from hal.backend import STALE, HardwareError, Sample
from hal.board import Board
from hal.device import Device

RECONNECT_S = 0.25  # between attempts to open a device that is gone


def poll_until(device: Device, board: Board, stop: threading.Event) -> None:
    """Poll a slow device at its fastest channel's rate and post to the board, until `stop` is set.

    A device that is gone is connected again; its last values are kept until they are stale."""
    period_s = 1.0 / max(b.channel.rate_hz for b in device.binding.bounds)
    sample = Sample()
    sample.status[device.roles] = STALE
    due = time.monotonic()
    while not stop.is_set():
        try:
            if not device.up:
                device.connect()
                device.up = True
            device.poll(sample)
        except (HardwareError, OSError) as e:
            if device.up:
                device.counts["reconnections"] += 1
            device.up = False
            device.disconnect()
            device.miss_all(f"{e}; reconnecting")
        board.post(sample, device)
        due += period_s if device.up else RECONNECT_S
        now = time.monotonic()
        if due < now:  # a slow answer: drop the polls that were missed
            due = now
        stop.wait(due - now)
    device.up = False
    device.disconnect()


def run_poller(device: Device, board_name: str) -> None:
    """Run a poller process: poll `device` until SIGTERM or until the parent is gone."""
    board = Board.attach(board_name)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the group; the supervisor stops us
    parent = os.getppid()

    def watch_parent() -> None:
        while not stop.wait(0.5):
            if os.getppid() != parent:
                stop.set()

    threading.Thread(target=watch_parent, daemon=True).start()
    poll_until(device, board, stop)
