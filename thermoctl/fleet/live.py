"""`thermoctl diagnose --live`: find where the daemon's model stopped fitting, in the daemon's own recordings.

The last hours of the newest session's 10 Hz tier are read. The innovations go through the same sum as in the
daemon (daemon/misfit.py). The stretch from BEFORE_S before the onset until now is averaged to seconds. It is
written as a CSV with the columns of the thermal plant.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.misfit import Alarm, Misfit
from thermoctl.daemon.tick.assemble import compensator
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.language import Plant
from thermoctl.recording.files import read_table, write_table
from thermoctl.recording.table import Table
from thermoctl.recording.writer import TIER, recording_files

BEFORE_S = 1800.0  # length of the part before the alarm, when the model still fitted
STRIDE = 10  # rows of the 10 Hz tier in a second
_STEP_S = 1.0


def newest(directory: str | Path, rig: str, hours: float) -> Table:
    """Read the newest session of a rig, at most so many hours back.

    Raises InputError where there is none."""
    folder = Path(directory)
    files = (
        [p for p in recording_files(folder, TIER) if p.name.startswith(rig + "-")] if folder.is_dir() else []
    )
    parts: list[Table] = []
    for path in reversed(files):
        part = read_table(path)
        if parts and (part.t[-1] > parts[-1].t[0] or parts[0].t[-1] - part.t[0] > hours * 3600):
            break  # an earlier session with another clock, or too far back
        parts.append(part)
    if not parts:
        raise InputError(
            f"{directory}: no recording of the rig '{rig}'; the daemon writes them while `recording: enable` is on"
        )
    parts.reverse()
    names = set.intersection(*(set(p.columns) for p in parts))
    return Table(
        rig,
        str(files[-1]),
        np.concatenate([p.t for p in parts]),
        {n: np.concatenate([p.columns[n] for p in parts]) for n in names},
    )


def wall_clock(table: Table, t_s: float) -> str:
    """Return the time of day in UTC at t_s of a recording, for a message; '' where it was not recorded."""
    if "wall_s" not in table.columns:
        return ""
    at_s = float(np.interp(t_s, table.t, table.columns["wall_s"]))
    return datetime.fromtimestamp(at_s, UTC).strftime(", %Y-%m-%d %H:%M:%SZ") if np.isfinite(at_s) else ""


def alarms(settings: Settings, table: Table) -> list[Alarm]:
    """Find every time that the model stopped fitting in a table of `newest`."""
    watch = Misfit(compensator(settings))
    out = []
    for k in range(0, len(table.t), STRIDE):
        rows = slice(k, k + STRIDE)  # in pieces as in the daemon, so that a temporary alarm is not lost
        alarm = watch.add(
            table.t[rows], table.columns["innovation_c"][rows], table.columns["kalman_gain"][rows]
        )
        if alarm is not None:
            out.append(alarm)
    return out


def seconds(table: Table) -> Table:
    """Average over each second; NaN where nothing was measured in it."""
    bins = np.floor((table.t - table.t[0]) / _STEP_S).astype(int)
    there = np.bincount(bins) > 0
    columns = {}
    for name, values in table.columns.items():
        good = np.isfinite(values)
        total, n = (np.bincount(bins[good], w, len(there)) for w in (values[good], None))
        columns[name] = np.where(n > 0, total / np.maximum(n, 1), np.nan)[there]
    return Table(table.name, table.path, table.t[0] + np.flatnonzero(there) * _STEP_S, columns)


def extract(plant: Plant, table: Table, alarm: Alarm | None, out: str | Path) -> None:
    """Write the columns that the plant reads, averaged to seconds, from BEFORE_S before the alarm.

    Raises InputError where an input of the plant is missing."""
    table = seconds(table)
    known = dict(table.columns)
    if {"output_reference_um", "position_raw_um"} <= set(known):
        known.setdefault("position_error_um", known["output_reference_um"] - known["position_raw_um"])
    wanted = [i.column for i in plant.inputs.values()] + [o.column for o in plant.outputs.values()]
    missing = [i.column for i in plant.inputs.values() if i.column not in known]
    if missing:
        raise InputError(
            f"{table.path}: the daemon records no column '{missing[0]}', which the plant reads as an input"
        )
    keep = table.t >= (alarm.begin_s - BEFORE_S if alarm is not None else -np.inf)
    columns = {c: known[c][keep] for c in wanted if c in known and np.isfinite(known[c][keep]).any()}
    whole = np.all([np.isfinite(columns[i.column]) for i in plant.inputs.values()], axis=0)
    if not whole.any():
        raise InputError(f"{table.path}: an input of the plant is missing throughout")
    first = int(np.argmax(whole))
    write_table(
        out,
        Table(
            Path(out).stem,
            str(out),
            table.t[keep][first:] - table.t[keep][first],
            {k: v[first:] for k, v in columns.items()},
        ),
    )
