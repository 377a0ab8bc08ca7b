"""The live one-screen view, and `demo`: a daemon of its own, armed and moving, with the view in front of it."""
from __future__ import annotations

import contextlib
import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from thermoctl.daemon.socket import ask
from thermoctl.yamlfile import InputError

START_S = 60.0
STROKE_UM, HALF_CYCLE_S = 40.0, 8.0          # quick enough to watch; the limiter gives the trapezoids
_BARS = " .:-=+*#%@"


def screen(status: dict[str, Any], latency: dict[str, Any], history: list[tuple[float, float]]) -> Group:
    """The view of one moment. history: (error with, error without compensation), um, oldest first."""
    def number(value: float | None, digits: int = 3) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    style = {"ARMED": "bold green", "FAULT": "bold red", "READY": "bold yellow"}.get(status["state"], "bold")
    head = Text.assemble(("thermoctl  ", "bold"), (status["state"], style),
                         f"   {status['ticks']} ticks   {status['slips']} slips   Ctrl-C stops safely")
    position = Table(show_header=False, box=None, pad_edge=False)
    with_, without = errors(status)
    for label, value, unit in (
            ("setpoint", number(status["setpoint_um"]), "um"), ("reference", number(status["reference_um"]), "um"),
            ("position (encoder)", number(status["position_um"]), "um"),
            ("output (proof encoder)", number(status["output_reference_um"]), "um"),
            ("compensation", number(status["compensation_um"]), "um"),
            ("error with compensation", number(with_), "um"),
            ("error without it", number(without), "um"),
            ("drive", number(status["drive"], 4), ""), ("coil power", number(status["power_w"]), "W")):
        position.add_row(label, Text(value, justify="right"), unit)
    heat = Table(show_header=True, box=None, pad_edge=False)
    for title in ("temperature", "measured", "estimated"):
        heat.add_column(title, justify="left" if title == "temperature" else "right")
    for name, measured in status["temperatures_c"].items():
        heat.add_row(name.replace("_", " "), number(measured, 2), number(status["estimates_c"][name], 2))
    heat.add_row("air", number(status["air_c"], 2), "")
    both = Table.grid(padding=(0, 6))
    both.add_row(position, heat)
    late = latency["lateness"]
    timing = Text(f"lateness p50 {number(late['p50_us'], 0)} us, p99 {number(late['p99_us'], 0)} us, largest "
                  f"{number(late['largest_us'], 0)} us   busy p50 {number(latency['busy']['p50_us'], 0)} us of "
                  f"{latency['period_us']:.0f}")
    faults = [Text(f"{f['severity']} {f['name']}: {f['meaning']} -> {f['remedy']}",
                   style="red" if f["severity"] != "warning" else "yellow") for f in status["faults"]]
    return Group(head, "", both, "", Text("error, last minute: with    " + trace([h[0] for h in history])),
                 Text("                    without " + trace([h[1] for h in history])), "", timing, *faults)


def errors(status: dict[str, Any]) -> tuple[float | None, float | None]:
    """(what the output errs by with compensation, what it would err by without), um: from the proof encoder where there
    is one, else what the law believes."""
    reference, compensation = status["reference_um"], status["compensation_um"]
    if status["state"] != "ARMED" or reference is None:
        return None, None
    output = status["output_reference_um"]
    with_ = (output if output is not None else status["compensated_um"]) - reference
    return with_, with_ + compensation


def trace(values: list[float], full_um: float = 2.0) -> str:
    """A line of characters, one a value: blank at 0, @ at `full_um` and above."""
    top = len(_BARS) - 1
    return "".join(_BARS[min(top, round(abs(v) / full_um * top))] if math.isfinite(v) else "?" for v in values)


def demo(settings: Any, seconds: float | None = None) -> int:
    """Start the daemon, arm, move in trapezoids and show it until Ctrl-C or for `seconds`. Without a terminal: a line a
    second. Returns 1 when a fault stands at the end, or the daemon's own exit status."""
    console = Console()
    log_path = Path(settings.socket.path).with_suffix(".log")
    log_path.parent.mkdir(parents=True, exist_ok=True)
    with log_path.open("wb") as log:
        daemon = subprocess.Popen([sys.executable, "-m", "thermoctl.cli", "run", "--config", settings.path],
                                  stdout=log, stderr=log, start_new_session=True)
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
    history: list[tuple[float, float]] = []
    interval_s = 0.25 if console.is_terminal else 1.0
    faulty = False
    with contextlib.ExitStack() as stack:
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if console.is_terminal else None
        while daemon.poll() is None and (seconds is None or time.monotonic() - begin < seconds):
            status = ask(settings.socket.path, {"command": "status"})
            faulty = any(f["severity"] != "warning" for f in status["faults"])
            if status["state"] == "ARMED" and time.monotonic() - begin >= turn * HALF_CYCLE_S:
                ask(settings.socket.path, {"command": "setpoint", "value": STROKE_UM if turn % 2 == 0 else -STROKE_UM})
                turn += 1
            with_, without = errors(status)
            if with_ is not None and without is not None:
                history = [*history, (with_, without)][-60:]
            if live is not None:
                latency = ask(settings.socket.path, {"command": "latency"})
                live.update(screen(status, latency, history), refresh=True)
            else:
                error = "-" if with_ is None else f"{with_:+.3f} um (without compensation {without:+.3f} um)"
                print(f"{status['state']} tick {status['ticks']} setpoint {status['setpoint_um']:.1f} um, error {error}"
                      f", coil {status['temperatures_c']['coil']:.2f} C, {status['slips']} slips", flush=True)
            time.sleep(interval_s)
    return faulty
