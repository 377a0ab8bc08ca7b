"""Readings and faults as every view shows them: value, state, age, the device's own words; causes first.

`status`, `--json`, monitor, dashboard, metrics and MQTT take them from here. A number whose reading is not valid is null;
the last one stands in `readings` as `last`, beside its state and age.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hal.drive_errors import describe
from thermoctl.channels import CHANNELS, SIGNAL, STATUS_NAMES
from thermoctl.control import causes, faults
from thermoctl.daemon.ring import CODE, CODE_S, TRIPS
from thermoctl.daemon.shared import Shared
from thermoctl.signals import INDEX, fault_word

SOURCES: dict[str, tuple[str, ...]] = {
    **{signal: (role,) for role, signal in SIGNAL.items()},
    "position_um": ("position_um",),
    "compensated_um": ("position_um",),
    "power_w": ("voltage_v", "current_a"),
    "innovation_c": ("coil_c",),
    "kalman_gain": ("coil_c",),
    "air_rate_k_s": ("air_c",),
}
"""Signals that are worth as much as these channels. ABSENT does not count against a computed one: the law does without."""
LATE_REMEDY = "docs/how-to/real-time.md: stop what burns the processor beside the loop; `thermoctl latency` shows how late"


def verdict(status_bits: int, kind: float, channel: int) -> str:
    """State of a channel: OK, ABSENT, or what is wrong by the device or by the law (ERROR STALE RANGE RATE FROZEN)."""
    state = STATUS_NAMES[status_bits >> (2 * channel) & 3]
    if state == "OK" and kind > 0.0:
        return faults.KINDS[int(kind) - 1].upper()
    return state


def readings(shared: Shared, row: np.ndarray) -> dict[str, dict[str, Any]]:
    """Every channel of the newest row: value (null unless OK), last, state, age_s, and the device's newest message with
    its time (seconds since 1970), which stays when the channel is well again."""
    bits, found = int(row[INDEX["status_bits"]]), {}
    begin_s = row[INDEX["wall_s"]] - row[INDEX["t_s"]]
    for c, role in enumerate(CHANNELS):
        state = verdict(bits, shared.areas["verdicts"][c], c)
        last = _or_none(row[INDEX[SIGNAL[role]]])
        said = shared.remarks.get(c) or (0, math.nan, "")
        found[role] = {
            "value": last if state == "OK" else None,
            "last": last,
            "state": state,
            "age_s": None if state == "ABSENT" else round(float(shared.areas["ages"][c]), 3),
            "message": said[2],
            "message_wall_s": _or_none(begin_s + said[1]),
        }
    return found


def valid(name: str, found: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether a signal's number may be shown as one: every channel it comes from is well."""
    allowed = ("OK",) if name in SIGNAL.values() else ("OK", "ABSENT")
    return all(found[role]["state"] in allowed for role in SOURCES.get(name, ()))


def hide_invalid(rows: np.ndarray, name: str) -> np.ndarray:
    """The column of a signal in rows (n, signals), NaN where the device of one of its channels was not well."""
    values = rows[:, INDEX[name]]
    return np.where(invalid(rows[:, INDEX["status_bits"]], name), np.nan, values)


def invalid(status_bits: np.ndarray, name: str) -> np.ndarray:
    """Which of these rows' words of status say that a channel of this signal is stale or in error."""
    bits, bad = np.nan_to_num(status_bits).astype(np.int64), np.zeros(len(status_bits), bool)
    for role in SOURCES.get(name, ()):
        state = bits >> (2 * CHANNELS.index(role)) & 3
        bad |= (state == 1) | (state == 2)
    return bad


def drive_code(shared: Shared, row: np.ndarray) -> dict[str, Any] | None:
    """The drive's newest error code, kept after its reset: code, its text and time; None where there was none."""
    code, at_s = (float(shared.areas["remark_numbers"][k]) for k in (CODE, CODE_S))
    if not code:
        return None
    now = row[INDEX["amplifier_fault"]] == code
    wall_s = row[INDEX["wall_s"]] - row[INDEX["t_s"]] + at_s
    return {"code": int(code), "text": describe(code), "wall_s": float(wall_s), "stands": bool(now)}


def standing_faults(
    shared: Shared, row: np.ndarray, found: Mapping[str, Any], also: int = 0
) -> list[dict[str, Any]]:
    """Active and latched faults, the cause first and its consequences behind it (control/causes.py); [] while OFF.

    also: bits of further faults to list, which are gone again in this row.
    """
    if row[INDEX["state"]] == 0.0:
        return []
    trips, onsets = int(shared.areas["remark_numbers"][TRIPS]), shared.areas["onsets"]
    begin_s = row[INDEX["wall_s"]] - row[INDEX["t_s"]]
    standing = [
        causes.Standing(f.name, float(onsets[f.bit, 0]), int(onsets[f.bit, 1]), float(onsets[f.bit, 2]))
        for f in faults.decode(fault_word(row) | also)
    ]
    code = drive_code(shared, row)
    return [
        {
            "name": f.name,
            "severity": causes.severity_of(f.name, trips),
            "meaning": faults.BY_NAME[f.name].meaning,
            "remedy": faults.BY_NAME[f.name].remedy,
            "t_s": f.t_s,
            "wall_s": begin_s + f.t_s,
            "tick": f.tick,
            "follows": cause,
            "late_s": f.late_s if f.late_first and not cause else 0.0,
            "messages": _messages(f, found, begin_s, code),
        }
        for f, cause in causes.in_order(standing, trips)
    ]


def _messages(
    fault: causes.Standing, found: Mapping[str, Any], begin_s: float, code: Mapping[str, Any] | None
) -> list[str]:
    """The devices' own words for this fault: those of its channels that are not well, or were so since it began."""
    roles: dict[str, list[str]] = {}  # by what is said: a lost device says the same for each channel
    texts: dict[str, str] = {}
    for role in causes.channels_of(fault.name):
        r = found[role]
        since = r["message_wall_s"] is not None and r["message_wall_s"] >= begin_s + fault.t_s - 0.5
        if r["message"] and (since or r["state"] not in ("OK", "ABSENT")):
            words = r["message"].removeprefix(f"{role}: ")
            tail = words.split(": ", 1)[-1]
            roles.setdefault(tail, []).append(role)
            texts.setdefault(tail, words)
    said = [f"{', '.join(roles[tail])}: {text}" for tail, text in texts.items()]
    if fault.name in ("amplifier_fault", "amplifier_error", "amplifier_not_following") and code is not None:
        said.insert(0, f"the drive reports {code['text']}")
    return said


def shown(reading: Mapping[str, Any] | None, digits: int = 2) -> str:
    """A reading in a terminal: '27.03', or '- (error, 20 s old)'; '-' where no device is bound to it."""
    if reading is None or reading["state"] == "ABSENT":
        return "-"
    if reading["value"] is not None:
        return number(reading["value"], digits)
    age = "never read" if reading["last"] is None else f"{span(reading['age_s'])} old"
    return f"- ({reading['state'].lower()}, {age})"


def number(value: float | None, digits: int) -> str:
    """A number, '-' for none, and no -0.00."""
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def span(seconds: float | None) -> str:
    """A time as people say it."""
    if seconds is None:
        return "-"
    if seconds < 60.0:
        return f"{seconds:.1f} s" if seconds < 10.0 else f"{seconds:.0f} s"
    hours, minutes = int(seconds // 3600), int(seconds % 3600 // 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def fault_lines(standing: Iterable[Mapping[str, Any]]) -> list[str]:
    """The faults as lines of a terminal: each cause with its time, its devices' words and its remedy, then what follows."""
    lines: list[str] = []
    listed = list(standing)
    for f in listed:
        if f.get("follows"):
            continue
        at = f"at {clock(f['wall_s'])}, tick {f['tick']}" if "wall_s" in f else ""
        if f.get("late_s"):
            lines += [
                f"{f['severity']}: the machine was late by {f['late_s'] * 1e3:.0f} ms: {f['name']} {at} may be its consequence",
                f"    -> {LATE_REMEDY}",
            ]
        said = "; ".join(f.get("messages", ())) or f["meaning"]
        lines += [f"{f['severity']} {f['name']} {at}: {said}".replace(" :", ":"), f"    -> {f['remedy']}"]
        after = [g["name"] for g in listed if g.get("follows") == f["name"]]
        if after:
            lines.append(f"    it brought: {', '.join(after)}")
    return lines


def value_lines(status: Mapping[str, Any]) -> list[str]:
    """The values of a status as lines of a terminal; what is not valid is '-' with its state and age."""
    found = status["readings"]
    shown_or = {
        name: number(status[name], 3)
        if status[name] is not None
        else next(
            (shown(found[r], 3) for r in SOURCES[name] if found[r]["state"] not in ("OK", "ABSENT")), "-"
        )
        for name in ("position_um", "output_reference_um", "power_w")
    }
    lines = [
        f"setpoint {number(status['setpoint_um'], 3)} um   position {shown_or['position_um']} um   compensation "
        f"{number(status['compensation_um'], 3)} um   output {shown_or['output_reference_um']} um",
        f"drive {number(status['drive'], 3)}   power {shown_or['power_w']} W   air {shown(found['air_c'])} C",
        f"{'temperature, C':20}{'measured':>9}{'estimated':>11}{'age':>9}",
    ]
    for point, estimate in status["estimates_c"].items():
        r = found[f"{point}_c"]
        bad = "" if r["state"] == "OK" else f"  {r['state'].lower()}"
        lines.append(
            f"{point.replace('_', ' '):20}{number(r['value'], 2):>9}{number(estimate, 2):>11}{span(r['age_s']):>9}{bad}"
        )
    if status["estimates_state"] != "OK":
        lines.append(f"estimates: not corrected by the coil's sensor for {span(found['coil_c']['age_s'])}")
    return lines + message_lines(status)


def message_lines(status: Mapping[str, Any]) -> list[str]:
    """A line for each reading that is not valid, in its device's words; in FAULT for those, too, that are well again; and
    the drive's newest error code."""
    lines = []
    for role, r in status["readings"].items():
        said = f": {r['message']} (since {clock(r['message_wall_s'])})" if r["message"] else ""
        if r["state"] not in ("OK", "ABSENT"):
            lines.append(f"{role} {r['state'].lower()}, {span(r['age_s'])} old{said}")
        elif said and status["state"] == "FAULT":
            lines.append(f"{role} is well again; before{said}")
    if code := status["drive_code"]:
        reset = "" if code["stands"] else ", reset since"
        lines.append(f"the drive's error code {code['text']} at {clock(code['wall_s'])}{reset}")
    return lines


def clock(wall_s: float) -> str:
    """The time of day."""
    return time.strftime("%H:%M:%S", time.localtime(wall_s))


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
