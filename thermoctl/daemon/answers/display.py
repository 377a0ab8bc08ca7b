"""Text for terminals and logs, made from a status answer: readings, faults, times.

It loads neither numpy nor the loop.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from thermoctl.daemon.answers.sources import FIXED_SOURCES

LATE_REMEDY = "docs/how-to/real-time.md: stop other programs on the loop's processor; `thermoctl latency` shows the lateness"
MEASURED, EXPECTED, UNKNOWN = "measured", "expected, not measured", "unknown: no model, no second encoder"
"""Origin of the output and its error: `output_is` of a status."""
NO_ESTIMATE, FREE = "NONE", "NOT CORRECTED"
"""`estimates_state` of a rig without a model, and while the coil's reading is invalid."""
_NORMAL = ("frames", "rows")  # counters of devices that count what is well


def shown(reading: Mapping[str, Any] | None, digits: int = 2) -> str:
    """Format a reading: '27.03', or '- (error, 20 s old)'; '-' where no device is bound."""
    if reading is None or reading["state"] == "ABSENT":
        return "-"
    if reading["value"] is not None:
        return number(reading["value"], digits)
    age = "never read" if reading["last"] is None else f"{span(reading['age_s'])} old"
    return f"- ({reading['state'].lower()}, {age})"


def number(value: float | None, digits: int) -> str:
    """Format a number; '-' for none, and never -0.00."""
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def span(seconds: float | None) -> str:
    """Format a time span in the largest fitting units."""
    if seconds is None:
        return "-"
    if seconds < 60.0:
        return f"{seconds:.1f} s" if seconds < 10.0 else f"{seconds:.0f} s"
    hours, minutes = int(seconds // 3600), int(seconds % 3600 // 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def fault_lines(standing: Iterable[Mapping[str, Any]]) -> list[str]:
    """List the faults as lines of a terminal.

    Each cause has its time, its devices' messages and its remedy; its consequences follow."""
    lines: list[str] = []
    listed = list(standing)
    for f in listed:
        if f.get("follows"):
            continue
        at = f"at {clock(f['wall_s'])}, tick {f['tick']}" if "wall_s" in f else ""
        late = f"{f.get('late_s', 0.0) * 1e3:.0f} ms"
        if f.get("late_first"):
            lines += [
                f"{f['severity']}: the machine was late by {late}: {f['name']} {at} may be its consequence",
                f"    -> {LATE_REMEDY}",
            ]
        said = "; ".join(f.get("messages", ())) or f["meaning"]
        lines += [f"{f['severity']} {f['name']} {at}: {said}".replace(" :", ":"), f"    -> {f['remedy']}"]
        if f.get("late_s") and not f.get("late_first"):
            lines.append(f"    also: one tick was {late} late in the second before")
        after = [g["name"] for g in listed if g.get("follows") == f["name"]]
        if after:
            lines.append(f"    followed by: {', '.join(after)}")
    return lines


def value_lines(status: Mapping[str, Any]) -> list[str]:
    """List a status' values as lines of a terminal.

    An invalid value is '-' with its state and age."""
    by_role = status["readings"]
    shown_or = {
        name: number(status[name], 3)
        if status[name] is not None
        else next(
            (
                shown(by_role[r], 3)
                for r in FIXED_SOURCES[name]
                if by_role[r]["state"] not in ("OK", "ABSENT")
            ),
            "-",
        )
        for name in ("position_um", "output_reference_um", "power_w")
    }
    mark = "?" if status["estimates_state"] == FREE else ""
    output = f"{shown_or['output_reference_um']} um"
    if status["output_is"] != MEASURED:
        expected = status["compensated_um"] if status["estimates_state"] != NO_ESTIMATE else None
        output = f"{number(expected, 3)} um ({status['output_is']})"
    lines = [
        f"setpoint {number(status['setpoint_um'], 3)} um   position {shown_or['position_um']} um   compensation "
        f"{number(status['compensation_um'], 3)}{mark} um   output {output}",
        f"drive {number(status['drive'], 3)}   power {shown_or['power_w']} W   air {shown(by_role['air_c'])} C",
        f"{'temperature, C':20}{'measured':>9}{'estimated':>11}{'age':>9}",
    ]
    for point, estimate in status["estimates_c"].items():
        r = by_role[f"{point}_c"]
        bad = "" if r["state"] == "OK" else f"  {r['state'].lower()}"
        lines.append(
            f"{status['labels'][point]:20}{number(r['value'], 2):>9}{number(estimate, 2):>11}{span(r['age_s']):>9}{bad}"
        )
    if mark:
        lines.append(
            f"estimates and compensation (?): not corrected by the coil's sensor for {span(by_role[status['coil']]['age_s'])}"
        )
    return lines + message_lines(status)


def message_lines(status: Mapping[str, Any]) -> list[str]:
    """List a line for each invalid reading, with its device's message.

    In FAULT also readings that are valid again are listed. Then comes what cannot be saved, and the drive's
    newest error code."""
    lines = []
    for role, r in status["readings"].items():
        said = f": {r['message']} (since {clock(r['message_wall_s'])})" if r["message"] else ""
        if r["state"] not in ("OK", "ABSENT"):
            lines.append(f"{role} {r['state'].lower()}, {span(r['age_s'])} old{said}")
        elif said and status["state"] == "FAULT":
            lines.append(f"{role} is well again; before{said}")
    lines += unsaved_lines(status)
    if code := status["drive_code"]:
        reset = "" if code["stands"] else ", reset since"
        lines.append(f"the drive's error code {code['text']} at {clock(code['wall_s'])}{reset}")
    return lines


def unsaved_lines(status: Mapping[str, Any]) -> list[str]:
    """List a line for each kind of data that cannot be saved at present, with the reason."""
    return [
        f"not saved: {u['what']}, since {clock(u['since_s'])}: {u['why']}; tried again by itself"
        for u in status.get("unsaved", ())
    ]


def counter_lines(status: Mapping[str, Any]) -> list[str]:
    """List a line for each device that counted errors, lost frames or reconnections."""
    return [
        f"{device}: " + ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        for device, counts in status.get("device_counters", {}).items()
        if any(count for name, count in counts.items() if name not in _NORMAL)
    ]


def between(bins: Iterable[Sequence[float]], edges: Sequence[float]) -> list[float]:
    """Return the counts of a histogram, (us, count) each, between neighbouring edges."""
    bins = list(bins)
    return [sum(count for us, count in bins if low <= us < high) for low, high in pairwise(edges)]


def clock(wall_s: float) -> str:
    """Format seconds since 1970 as the local time of day."""
    return time.strftime("%H:%M:%S", time.localtime(wall_s))
