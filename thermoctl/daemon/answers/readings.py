"""Readings and faults as every view shows them: value, state, age, the device's message; causes first.

`status`, `--json`, monitor, dashboard, metrics and MQTT use them. An invalid reading has the value null;
`readings` keeps its last value as `last`, with state and age.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from thermoctl.control import causes, faults
from thermoctl.daemon.answers.sources import sources
from thermoctl.daemon.tick.ring import CODE, CODE_S, TRIPS
from thermoctl.daemon.tick.shared import Shared
from thermoctl.rig.channels import ERROR, STALE, STATUS_NAMES, Channels
from thermoctl.rig.signals import AT, Row, fault_word, of_recording, recorded_states
from thermoctl_hal.can.drive_errors import describe


def verdict(status: int, kind: float) -> str:
    """Return a channel's state: OK, ABSENT, or the error found by the device (status) or the law (kind).

    Errors are ERROR, STALE, RANGE, RATE and FROZEN.
    """
    state = STATUS_NAMES[status]
    if state == "OK" and kind > 0.0:
        return faults.KINDS[int(kind) - 1].upper()
    return state


def readings(shared: Shared, row: np.ndarray) -> dict[str, dict[str, Any]]:
    """Return every channel of the newest row: value (null unless OK), last, state, age_s, message.

    The message is the device's newest one, with its time (seconds since 1970); it stays when the channel
    is valid again.
    """
    statuses, found = shared.row.states(row)[0], {}
    values = row[shared.row.readings]
    begin_s = row[AT["wall_s"]] - row[AT["t_s"]]
    for c, role in enumerate(shared.channels.names):
        state = verdict(int(statuses[c]), shared.areas["verdicts"][c])
        last = _or_none(values[c])
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


def valid_signals(channels: Channels, found: Mapping[str, Mapping[str, Any]]) -> dict[str, bool]:
    """Return for each signal that comes from channels whether it is valid: every such channel is."""
    measured = set(channels.signal.values())
    return {
        name: all(
            found[role]["state"] in (("OK",) if name in measured else ("OK", "ABSENT")) for role in roles
        )
        for name, roles in sources(channels).items()
    }


def hide_invalid(rows: np.ndarray, name: str, layout: Row) -> np.ndarray:
    """Return a signal's column of rows (n, signals), NaN where one of its channels was stale or in error."""
    channels = [layout.channels.index[role] for role in sources(layout.channels).get(name, ())]
    states = layout.states(rows)[:, channels]
    return np.where(((states == STALE) | (states == ERROR)).any(axis=1), np.nan, rows[:, layout.index[name]])


def invalid(columns: Mapping[str, np.ndarray], meta: Mapping[str, str], name: str) -> np.ndarray:
    """Return for each row of a recording whether a channel of this signal is stale or in error.

    columns: the recording's words of status bits; meta: its metadata.
    """
    states = recorded_states(columns, meta)
    bad = np.zeros(len(next(iter(columns.values()))), bool)
    for role in sources(of_recording(meta).channels).get(name, ()):
        bad |= (states[role] == STALE) | (states[role] == ERROR)
    return bad


def drive_code(shared: Shared, row: np.ndarray) -> dict[str, Any] | None:
    """Return the drive's newest error code with text and time; None where there was none.

    It is kept after the drive's reset.
    """
    code, at_s = (float(shared.areas["remark_numbers"][k]) for k in (CODE, CODE_S))
    if not code:
        return None
    now = row[AT["amplifier_fault"]] == code
    wall_s = row[AT["wall_s"]] - row[AT["t_s"]] + at_s
    return {"code": int(code), "text": describe(code), "wall_s": float(wall_s), "stands": bool(now)}


def standing_faults(
    shared: Shared, row: np.ndarray, found: Mapping[str, Any], also: int = 0
) -> list[dict[str, Any]]:
    """List active and latched faults, each cause before its consequences (control/causes.py).

    `also`: bits of further faults to list, which are gone again in this row. Empty while the daemon starts.
    """
    if row[AT["state"]] == 0.0:
        return []
    trips, onsets = int(shared.areas["remark_numbers"][TRIPS]), shared.areas["onsets"]
    begin_s = row[AT["wall_s"]] - row[AT["t_s"]]
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
            "messages": _messages(f, found, begin_s, code, shared.channels),
        }
        for f, cause in causes.in_order(standing, trips)
    ]


def _messages(
    fault: causes.Standing,
    found: Mapping[str, Any],
    begin_s: float,
    code: Mapping[str, Any] | None,
    channels: Channels,
) -> list[str]:
    """Return the devices' messages for this fault.

    They come from its channels that are invalid now, or were invalid since the fault began.
    """
    roles: dict[str, list[str]] = {}  # by message: a lost device gives each channel the same one
    texts: dict[str, str] = {}
    for role in causes.channels_of(fault.name, channels):
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


def _or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
