"""Readings and faults as every view shows them: value, state, age, the device's message; causes first.

`status`, `--json`, monitor, dashboard, metrics and MQTT use them. An invalid reading has the value null;
`readings` keeps its last value as `last`, with state and age.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from thermoctl.control import causes, faults, losses
from thermoctl.daemon.answers.display import clock
from thermoctl.daemon.answers.sources import sources
from thermoctl.daemon.tick.ring import CODE, CODE_S, TRIPS
from thermoctl.daemon.tick.shared import Shared
from thermoctl.rig.channels import ERROR, STALE, STATUS_NAMES, Channels
from thermoctl.rig.signals import AT, Row, fault_word, of_recording, recorded_states
from thermoctl_hal.can.drive_errors import describe

UNBOUND_MESSAGE = "no device of hal.devices has this role"
"""As the back end of devices reports a role that nothing gives."""


def verdict(status: int, kind: float) -> str:
    """Return a channel's state: OK, ABSENT, or the error found by the device (status) or the law (kind).

    Errors are ERROR, STALE, RANGE, RATE and FROZEN."""
    state = STATUS_NAMES[status]
    if state == "OK" and kind > 0.0:
        return faults.KINDS[int(kind) - 1].upper()
    return state


def readings(shared: Shared, row: np.ndarray) -> dict[str, dict[str, Any]]:
    """Return every channel of the newest row: value (null unless OK), last, state, age_s, message.

    The message is the device's newest one, with its time (seconds since 1970); it stays when the channel
    is valid again."""
    statuses, by_role = shared.row.states(row)[0], {}
    values = row[shared.row.readings]
    begin_s = row[AT["wall_s"]] - row[AT["t_s"]]
    for c, role in enumerate(shared.channels.names):
        state = verdict(int(statuses[c]), shared.areas["verdicts"][c])
        last = finite(values[c])
        said = shared.remarks.get(c) or (0, math.nan, "")
        by_role[role] = {
            "value": last if state == "OK" else None,
            "last": last,
            "state": state,
            "age_s": None if state == "ABSENT" else round(float(shared.areas["ages"][c]), 3),
            "message": said[2],
            "message_wall_s": finite(begin_s + said[1]),
        }
    return by_role


def valid_signals(channels: Channels, found: Mapping[str, Mapping[str, Any]]) -> dict[str, bool]:
    """Return for each signal that is computed from channels whether all these channels are valid."""
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

    columns: the recording's words of status bits; meta: its metadata."""
    states = recorded_states(columns, meta)
    bad = np.zeros(len(next(iter(columns.values()))), bool)
    for role in sources(of_recording(meta).channels).get(name, ()):
        bad |= (states[role] == STALE) | (states[role] == ERROR)
    return bad


def drive_code(shared: Shared, row: np.ndarray) -> dict[str, Any] | None:
    """Return the drive's newest error code with text and time; None where there was none.

    It is kept after the drive's reset."""
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
        _described(f, cause, trips, float(row[AT["t_s"]]), begin_s, found, code, shared.channels)
        for f, cause in causes.in_order(standing, trips)
    ]


def _described(
    fault: causes.Standing,
    cause: str,
    trips: int,
    now_s: float,
    begin_s: float,
    found: Mapping[str, Any],
    code: Mapping[str, Any] | None,
    channels: Channels,
) -> dict[str, Any]:
    """Return a fault as `status` shows it. begin_s: seconds since 1970 at t_s = 0.

    `late_s` is the machine's delay before it. `late_first`: that is the likely cause, because the reading's
    device states none of its own."""
    row = faults.BY_NAME[fault.name]
    hit = _hit(fault, found, begin_s, channels)
    loss, reading = _loss(fault, hit, found, now_s)
    is_old = (reading.get("age_s") or 0.0) > losses.LATE_WINDOW_S
    is_stated = loss is not None and (loss.is_certain or (loss is not losses.SLOW and is_old))
    late_s = fault.late_s if fault.may_be_late and not cause else 0.0
    return {
        "name": fault.name,
        "severity": causes.severity_of(fault.name, trips),
        "meaning": row.meaning,
        "remedy": row.remedy if loss is None else _remedy(loss, reading, begin_s + now_s),
        "loss": None if loss is None else loss.name,
        "t_s": fault.t_s,
        "wall_s": begin_s + fault.t_s,
        "tick": fault.tick,
        "follows": cause,
        "late_s": late_s,
        "late_first": bool(late_s) and fault.is_timed and not is_stated,
        "messages": _messages(fault, hit, code),
    }


def _hit(
    fault: causes.Standing, found: Mapping[str, Any], begin_s: float, channels: Channels
) -> list[tuple[str, str]]:
    """Return (role, message) of the fault's channels that are invalid now, or were since the fault began."""
    hit = []
    for role in causes.channels_of(fault.name, channels):
        r = found[role]
        since = r["message_wall_s"] is not None and r["message_wall_s"] >= begin_s + fault.t_s - 0.5
        if r["state"] == "ABSENT" and fault.name.endswith("_error") and not r["message"]:
            hit.append((role, UNBOUND_MESSAGE))
        elif r["message"] and (since or r["state"] not in ("OK", "ABSENT")):
            hit.append((role, r["message"].removeprefix(f"{role}: ")))
    return hit


def _loss(
    fault: causes.Standing, hit: list[tuple[str, str]], found: Mapping[str, Any], now_s: float
) -> tuple[losses.Loss | None, Mapping[str, Any]]:
    """Return how the fault's reading was lost, and that reading; None: its device reports its own state."""
    kind = faults.BY_NAME[fault.name].kind
    for role, message in hit if kind in ("error", "stale") else ():
        if message == UNBOUND_MESSAGE:
            return losses.UNBOUND, found[role]
        loss, age_s = losses.loss_of(message), found[role]["age_s"]
        has_arrived = kind == "stale" and age_s is not None and now_s - age_s > fault.t_s
        if has_arrived and (loss is None or not loss.is_certain):
            return losses.SLOW, found[role]
        if loss is not None:
            return loss, found[role]
    return None, {}


def _remedy(loss: losses.Loss, reading: Mapping[str, Any], now_wall_s: float) -> str:
    if loss not in (losses.UNBOUND, losses.SLOW) and reading["state"] == "OK":
        return losses.BACK
    since = ""
    if reading["last"] is not None and reading["age_s"] is not None:
        since = f"nothing was received since {clock(now_wall_s - reading['age_s'])}; "
    return loss.remedy.format(since=since)


def _messages(
    fault: causes.Standing, hit: list[tuple[str, str]], code: Mapping[str, Any] | None
) -> list[str]:
    """Return the devices' messages, each once with its channels; the drive's error code first."""
    roles: dict[str, list[str]] = {}  # by message: a lost device gives each channel the same one
    texts: dict[str, str] = {}
    for role, words in hit:
        tail = words.split(": ", 1)[-1]
        roles.setdefault(tail, []).append(role)
        texts.setdefault(tail, words)
    said = [f"{', '.join(roles[tail])}: {text}" for tail, text in texts.items()]
    if fault.name in ("amplifier_fault", "amplifier_error", "amplifier_not_following") and code is not None:
        said.insert(0, f"the drive reports {code['text']}")
    return said


def finite(value: float) -> float | None:
    """Return a number for JSON; None where it is not finite."""
    return float(value) if math.isfinite(value) else None
