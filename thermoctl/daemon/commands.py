"""Commands to a running daemon: status, latency, arm, disarm, setpoint, reload.

They load neither numpy nor drivers, so they answer at once.
"""

from __future__ import annotations

import json
import sys

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.answers.display import between, counter_lines, fault_lines, value_lines
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.lock import holder
from thermoctl.files.yamlfile import InputError


def request(settings: Settings, command: str, as_json: bool, value: float | None = None) -> int:
    """Send arm, disarm, setpoint or reload; return 0, or 1 when the daemon refuses."""
    answer = ask(settings.socket.path, {"command": command, "value": value})
    if as_json:
        print(json.dumps(answer))
    elif not answer["ok"]:
        print(f"thermoctl: {answer['error']}", file=sys.stderr)
    elif command == "reload":
        print("applied: " + (", ".join(answer["applied"]) or "nothing changed"))
        if answer["needs_restart"]:
            print("needs a restart: " + ", ".join(answer["needs_restart"]))
    else:
        setpoint = answer.get("setpoint_um")
        held = command != "disarm" and setpoint is not None
        print(answer["state"] + (f", setpoint {setpoint:.3f} um" if held else ""))
    return 0 if answer["ok"] else 1


def status(settings: Settings, as_json: bool = False) -> int:
    """Print the daemon's state; return 0, or 1 when it does not run or a fault is active."""
    try:
        answer = ask(settings.socket.path, {"command": "status"})
    except InputError as e:
        if (pid := holder(settings)) is not None:
            e = InputError(
                f"{e.args[0]}; pid {pid} holds the rig: it is starting, stopping, or drives it without the command socket"
            )
        if as_json:
            print(json.dumps({"ok": False, "state": "OFF", "error": str(e)}))
        else:
            print(f"thermoctl: {e}", file=sys.stderr)
        return 1
    faulty = any(f["severity"] != "warning" for f in answer["faults"])
    if as_json:
        print(json.dumps(answer))
        return 1 if faulty else 0
    if not answer["ticks"]:
        print("OFF, starting")
        return 1
    print(
        f"{answer['state']}   {answer['ticks']} ticks in {answer['uptime_s']:.1f} s, {answer['slips']} slips, "
        f"busy {answer['busy_us']:.0f} us"
    )
    print("\n".join([*fault_lines(answer["faults"]), *value_lines(answer)]))
    for line in (*answer.get("slow", ()), *counter_lines(answer)):
        print(line)
    if answer.get("tuning_percent") is not None:
        print(f"tuning of the expansion model: {answer['tuning_percent']:.0f} % of the excitation seen")
    if answer["recorder"]["lost"]:
        print(f"recorder: {answer['recorder']['lost']} ticks lost")
    return 1 if faulty else 0


def latency(settings: Settings, as_json: bool = False) -> int:
    """Print histograms of lateness and busy time, skipped ticks, and the idle loop's lateness."""
    answer = ask(settings.socket.path, {"command": "latency"})
    if as_json:
        print(json.dumps(answer))
        return 0
    period = answer["period_us"]
    print(
        f"{answer['ticks']} ticks of {period:g} us, {answer['slips']} slips "
        f"({1000.0 * answer['slips'] / max(answer['ticks'], 1):.2f} in 1000)"
    )
    print(f"{'':24}{'p50':>9}{'p99':>9}{'p99.9':>9}{'largest':>10}   us")
    for name, label in (
        ("lateness", "wake-up lateness"),
        ("busy", "busy time"),
        ("reference", "idle loop's lateness"),
    ):
        h = answer[name]
        if h["count"]:
            print(f"{label:24}{h['p50_us']:9.0f}{h['p99_us']:9.0f}{h['p999_us']:9.0f}{h['largest_us']:10.0f}")
        else:
            print(
                f"{label:24}  none (loop.reference is off)"
                if name == "reference"
                else f"{label:24}  none yet"
            )
    busy = answer["busy"]
    if busy["count"]:
        print(
            f"{'busy share of the tick':24}"
            + "".join(f"{100.0 * busy[k] / period:8.1f}%" for k in ("p50_us", "p99_us", "p999_us"))
        )
    for name in ("lateness", "busy"):
        print(f"\n{name}, us")
        print(_bars(answer[name]["bins_us"]))
    return 0


def _bars(bins: list[list[int]]) -> str:
    """Draw a histogram of whole microseconds in bins of about doubling width."""
    edges = [0, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 1 << 30]
    counts = between(bins, edges)
    top = max(counts, default=0) or 1
    return "\n".join(
        f"{low:6d} .. {high if high < 1 << 30 else '':<5} {count:9.0f} {'#' * round(50 * count / top)}"
        for low, high, count in zip(edges, edges[1:], counts, strict=False)
        if count
    )
