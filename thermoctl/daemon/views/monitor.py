"""`thermoctl monitor`: the rig on one screen of a terminal, for instance over ssh.

It asks the command socket and gives no commands.
"""

from __future__ import annotations

import contextlib
import math
import textwrap
import time
from collections import deque
from collections.abc import Iterable
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.answers.display import (
    EXPECTED,
    FREE,
    MEASURED,
    between,
    fault_lines,
    message_lines,
    number,
    span,
)
from thermoctl.daemon.control_socket import ask
from thermoctl.files.yamlfile import InputError

BLOCKS, ASCII = "▁▂▃▄▅▆▇█", "_.-=+*#@"
FEWEST = 4  # lines of faults that are shown on any terminal: the cause, its remedy and what follows
KEPT = 240  # samples of a sparkline
STYLE = {"ARMED": "bold green", "FAULT": "bold white on red", "READY": "bold yellow"}
_READINGS = {
    "position, mean": "position_um",
    "compensated": "position_um",
    "output (proof)": "output_reference_um",
    "air": "air_c",
}
"""Rows of the numbers, and the channel that must be valid for each."""
TRAILS = (
    ("compensated", "compensated_um", "um", 3),
    ("error with", "with", "um", 3),
    ("error without", "without", "um", 3),
    ("coil", "coil_c", "C", 2),
    ("innovation", "innovation_c", "K", 3),
    ("power", "power_w", "W", 2),
)
"""Sparklines: label, key of the trail, unit, digits."""


def errors(status: dict[str, Any]) -> tuple[float | None, float | None]:
    """Return the output's error with compensation and without it, um; None unless armed.

    The reference encoder measures the output; without one the law's estimate is used, which is expected and
    not measured. Both are None while that encoder is invalid, and with neither encoder nor model."""
    reference, output = status.get("reference_um"), status.get("output_reference_um")
    if status.get("output_is") == EXPECTED:
        output = status.get("compensated_um")
    if status["state"] != "ARMED" or reference is None or output is None:
        return None, None
    return output - reference, output - reference + status["compensation_um"]


def remember(trails: dict[str, deque[float]], status: dict[str, Any]) -> None:
    """Add this status' values to the trails (NaN where there is none)."""
    with_, without = errors(status)
    coil = (status.get("temperatures_c") or {}).get(status.get("coil", "").removesuffix("_c"))
    values = {**status, "with": with_, "without": without, "coil_c": coil}
    for _, key, _, _ in TRAILS:
        value = values.get(key)
        trails.setdefault(key, deque(maxlen=KEPT)).append(math.nan if value is None else value)


def sparkline(values: Iterable[float], width: int, ramp: str = BLOCKS) -> str:
    """Draw the newest `width` values with the ramp's characters; blank where there is no value."""
    newest = list(values)[-width:] if width > 0 else []
    finite = [v for v in newest if math.isfinite(v)]
    if not finite:
        return " " * len(newest)
    low, span = min(finite), max(finite) - min(finite)
    return "".join(
        " "
        if not math.isfinite(v)
        else ramp[len(ramp) // 2 if span == 0 else min(len(ramp) - 1, int((v - low) / span * len(ramp)))]
        for v in newest
    )


def screen(
    status: dict[str, Any],
    latency: dict[str, Any] | None,
    trails: dict[str, deque[float]],
    width: int = 80,
    ramp: str = BLOCKS,
    height: int = 0,
) -> Group:
    """Draw one moment from the answers of the command socket, `width` characters wide.

    height: lines of the terminal, 0 for any number. The values come before the sparklines, and faults take
    at most the lines that the values leave, but always FEWEST."""
    faults = _faults(status["faults"])
    head = Text.assemble(("thermoctl ", "bold"), (f" {status['state']} ", STYLE.get(status["state"], "bold")))
    if "channels" not in status:
        return Group(head, *faults)
    head.append(
        f"   {status['ticks']} ticks   {status['slips']} slips   up {span(status['uptime_s'])}"
        f"   recorder lost {status['recorder']['lost']}"
    )
    both = Table.grid(padding=(0, 3))
    numbers, temperatures = _numbers(status), _temperatures(status)
    both.add_row(numbers, temperatures)
    is_measured = status["output_is"] == MEASURED
    origin = (
        [] if is_measured else [Text(f"error with and without compensation: {status['output_is']}", "yellow")]
    )
    rows = max(numbers.row_count, temperatures.row_count + 1) + len(origin)
    left = height - 1 - rows if height else None
    faults = _fitting(faults, width, left, FEWEST)
    parts: list[RenderableType] = [head, *faults, *([] if faults and height else [Text()]), both, *origin]
    left = None if left is None else left - max(1, len(faults))
    below: list[RenderableType] = [Text(), _trails(trails, width, ramp)]
    if latency is not None:
        below.append(_timing(latency, ramp))
    if left is None or left >= len(TRAILS) + len(below) - 1:
        parts += below
        left = None if left is None else left - len(TRAILS) - len(below) + 1
    parts += _fitting([Text(line, style="yellow") for line in message_lines(status)], width, left, 0)
    return Group(*parts, *([] if faults else [Text("no faults", style="green")]))


def _fitting(texts: list[Text], width: int, room: int | None, fewest: int) -> list[Text]:
    """Return the texts in lines of `width`, cut to `room` lines (None: all), at least `fewest`."""
    if room is None:
        return texts
    lines = [
        Text(line, style=text.style)
        for text in texts
        for line in textwrap.wrap(text.plain, width, subsequent_indent="  ") or [""]
    ]
    room = max(room, fewest)
    if len(lines) <= room or not room:
        return lines[:room]
    return [*lines[: room - 1], Text(f"... {len(lines) - room + 1} more lines: `thermoctl status`", "dim")]


def _faults(standing: list[dict[str, Any]]) -> list[Text]:
    """Return the fault lines of `status` in colour, the cause first."""
    lines = []
    for line in fault_lines(standing):
        style = "dim" if line.startswith(" ") else "bold yellow" if line.startswith("warning") else "bold red"
        lines.append(Text(line, style=style))
    return lines


def _numbers(status: dict[str, Any]) -> Table:
    with_, without = errors(status)
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="dim")
    table.add_column(justify="right")
    for label, value, unit in (
        ("setpoint", status["setpoint_um"], "um"),
        ("reference", status["reference_um"], "um"),
        ("position, mean", status["position_um"], "um"),
        ("compensated", status["compensated_um"], "um"),
        ("output (proof)", status["output_reference_um"], "um"),
        ("expansion", status["expansion_um"], "um"),
        ("compensation", status["compensation_um"], "um"),
        ("error with it", with_, "um"),
        ("error without it", without, "um"),
        ("drive", status["drive"], ""),
        ("power", status["power_w"], "W"),
        ("innovation", status["innovation_c"], "K"),
        ("air", status["air_c"], "C"),
    ):
        uncorrected = label in ("expansion", "compensation") and status["estimates_state"] == FREE
        table.add_row(f"{label} (?)" if uncorrected else label, _value(status, label, value), unit)
    return table


def _value(status: dict[str, Any], label: str, value: float | None) -> Text:
    """Return the number, or the state of the reading that makes it invalid."""
    role = status["coil"] if label == "innovation" else _READINGS.get(label)
    reading = status["readings"][role] if role and value is None else None
    if reading is None or reading["state"] in ("OK", "ABSENT"):
        return Text(number(value, 3))
    return Text(f"- {reading['state'].lower()}", style="yellow")


def _temperatures(status: dict[str, Any]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("temp., C", no_wrap=True)
    estimated = status["estimates_state"] != FREE
    for title in ("meas.", "est." if estimated else "est.?", "diff."):
        table.add_column(title, justify="right")
    table.add_column(no_wrap=True)  # age of an invalid reading
    for name, measured in status["temperatures_c"].items():
        estimate, reading = status["estimates_c"][name], status["readings"][f"{name}_c"]
        difference = None if measured is None or estimate is None else measured - estimate
        dead = reading["state"] not in ("OK", "ABSENT")
        table.add_row(
            Text(status["labels"][name], style="yellow" if dead else ""),
            Text("-" if dead else number(measured, 2), style="yellow" if dead else ""),
            Text(number(estimate, 2), style="" if estimated else "dim"),
            Text(reading["state"].lower(), style="yellow") if dead else number(difference, 2),
            span(reading["age_s"]) if dead else "",
        )
    return table


def _trails(trails: dict[str, deque[float]], width: int, ramp: str) -> Table:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="dim", width=14)
    long = max(10, min(KEPT, width - 14 - 28 - 4))
    table.add_column(width=long, no_wrap=True)
    table.add_column(no_wrap=True)
    for label, key, unit, digits in TRAILS:
        newest = [v for v in list(trails.get(key, ()))[-long:] if math.isfinite(v)]
        bounds = f"{min(newest):.{digits}f} .. {max(newest):.{digits}f} {unit}" if newest else "-"
        table.add_row(label, Text(sparkline(trails.get(key, ()), long, ramp), style="cyan"), bounds)
    return table


def _timing(latency: dict[str, Any], ramp: str) -> Text:
    late, busy = latency["lateness"], latency["busy"]
    counts = between(late["bins_us"], (0, 2, 5, 10, 20, 50, 100, 200, 500, 1000, math.inf))
    shape = sparkline([math.log1p(c) if c else math.nan for c in counts], len(counts), ramp)
    return Text.assemble(
        ("lateness      ", "dim"),
        (f"[{shape}]", "cyan"),
        f" p50 {number(late['p50_us'], 0)}, p99 {number(late['p99_us'], 0)}, max "
        f"{number(late['largest_us'], 0)}; busy p99 {number(busy['p99_us'], 0)}"
        f" of {latency['period_us']:.0f} us",
    )


def ramp_of(console: Console) -> str:
    """Return the sparkline characters that this terminal can show."""
    return BLOCKS if console.encoding.lower().startswith("utf") else ASCII


def look(path: str, with_latency: bool = True) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Ask the daemon for status and latency; without a daemon return an empty status with the reason."""
    try:
        return ask(path, {"command": "status"}), ask(path, {"command": "latency"}) if with_latency else None
    except InputError as e:
        return {
            "ok": False,
            "state": "OFF",
            "ticks": 0,
            "faults": [{"name": "no daemon", "severity": "warning", "meaning": str(e), "remedy": "retrying"}],
        }, None


def show(settings: Settings, interval_s: float = 0.5, once: bool = False) -> int:
    """Show the rig until Ctrl-C.

    `once`, or no terminal: print one screen and return 1 when no daemon runs or a fault is active."""
    if not 0.05 <= interval_s <= 60.0:
        raise InputError(f"--interval {interval_s:g}: 0.05 to 60 seconds were expected")
    console = Console()
    ramp = ramp_of(console)
    trails: dict[str, deque[float]] = {}
    if once or not console.is_terminal:
        status, latency = look(settings.socket.path)
        remember(trails, status)
        console.print(screen(status, latency, trails, console.width, ramp))
        return int(not status["ok"] or any(f["severity"] != "warning" for f in status["faults"]))
    with (
        contextlib.suppress(KeyboardInterrupt),
        Live(console=console, auto_refresh=False, screen=True) as live,
    ):
        while True:
            status, latency = look(settings.socket.path)
            remember(trails, status)
            view = screen(status, latency, trails, console.width, ramp, console.height)
            live.update(view, refresh=True)
            time.sleep(interval_s)
    return 0
