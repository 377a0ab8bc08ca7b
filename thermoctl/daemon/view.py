"""`demo`: a daemon of its own, armed and moving, with the monitor's view in front of it."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from thermoctl.daemon.monitor import errors, ramp_of, remember, screen
from thermoctl.daemon.socket import ask
from thermoctl.yamlfile import InputError

START_S = 60.0
STROKE_UM, HALF_CYCLE_S = 40.0, 8.0  # quick enough to watch; the limiter gives the trapezoids


def demo(settings: Any, seconds: float | None = None) -> int:
    """Start the daemon, arm, move in trapezoids and show it until Ctrl-C or for `seconds`. Without a terminal: a line a
    second. Returns 1 when a fault stands at the end, or the daemon's own exit status."""
    console = Console()
    log_path = Path(settings.socket.path).with_suffix(".log")
    log_path.parent.mkdir(parents=True, exist_ok=True)
    with log_path.open("wb") as log:
        daemon = subprocess.Popen(
            [sys.executable, "-m", "thermoctl.cli", "run", "--config", settings.path],
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
    faulty = False
    try:
        if not _wait_for_ready(settings, daemon):
            sys.stderr.write(log_path.read_text(errors="replace"))
            return daemon.poll() or 3
        answer = ask(settings.socket.path, {"command": "arm"})
        if not answer["ok"]:
            raise InputError(answer["error"])
        faulty = _show(settings, console, daemon, seconds)
    except KeyboardInterrupt:
        pass
    finally:
        with contextlib.suppress(InputError):
            ask(settings.socket.path, {"command": "disarm"})
        daemon.terminate()
        code = daemon.wait(15)
    console.print(f"stopped; the amplifier is disabled. Log: {log_path}")
    return 1 if faulty else code


def _wait_for_ready(settings: Any, daemon: subprocess.Popen) -> bool:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and daemon.poll() is None:
        with contextlib.suppress(InputError):
            if ask(settings.socket.path, {"command": "status"})["state"] == "READY":
                return True
        time.sleep(0.1)
    return False


def _show(settings: Any, console: Console, daemon: subprocess.Popen, seconds: float | None) -> bool:
    """The view until it is time; whether a fault stood at the end."""
    begin, turn = time.monotonic(), 0
    trails: dict[str, deque[float]] = {}
    interval_s = 0.25 if console.is_terminal else 1.0
    faulty = False
    with contextlib.ExitStack() as stack:
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if console.is_terminal else None
        while daemon.poll() is None and (seconds is None or time.monotonic() - begin < seconds):
            status = ask(settings.socket.path, {"command": "status"})
            faulty = any(f["severity"] != "warning" for f in status["faults"])
            if status["state"] == "ARMED" and time.monotonic() - begin >= turn * HALF_CYCLE_S:
                ask(
                    settings.socket.path,
                    {"command": "setpoint", "value": STROKE_UM if turn % 2 == 0 else -STROKE_UM},
                )
                turn += 1
            remember(trails, status)
            if live is not None:
                latency = ask(settings.socket.path, {"command": "latency"})
                live.update(screen(status, latency, trails, console.width, ramp_of(console)), refresh=True)
            else:
                with_, without = errors(status)
                error = "-" if with_ is None else f"{with_:+.3f} um (without compensation {without:+.3f} um)"
                print(
                    f"{status['state']} tick {status['ticks']} setpoint {status['setpoint_um']:.1f} um, error {error}"
                    f", coil {status['temperatures_c']['coil']:.2f} C, {status['slips']} slips",
                    flush=True,
                )
            time.sleep(interval_s)
    return faulty
