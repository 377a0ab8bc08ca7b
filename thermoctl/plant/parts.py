"""Parts of a recording: a new one after each gap in which an input may have changed, or the clock jumped.

Nothing is known of the state after such a gap, so each part has a start of its own, from its first readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import log

import numpy as np

from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.recording.table import Table

ALARM = 1e-6  # probability of a false alarm in a recording with random intervals
MISSED = 4.5  # in a regular recording, an interval of so many usual ones lacks samples
REGULAR = 0.1  # a recording is regular if its intervals differ by at most this share of their median
FEW = 8  # with fewer samples no gap is sought
MANY = 50  # gaps that are more frequent than one in so many samples belong to the logger's sampling
HOUR_S = 3600.0
RESTARTED = "restarted"
"""Key of a part's `meta`: its start comes from its readings."""


def gaps(t: np.ndarray) -> np.ndarray:
    """Return the rows (k,) after which samples are missing.

    That is beyond 4.5 steps of a regular recording. Of n random (exponential) intervals with median m, one is
    longer than m log2(n / ALARM) with probability ALARM. Many such intervals are the logger's sampling, and
    so are several in a row, where it goes on at another rate."""
    steps = np.diff(t)
    if len(steps) < FEW:
        return np.zeros(0, int)
    median = float(np.median(steps))
    regular = np.mean(np.abs(steps - median) <= REGULAR * median) > 1 - 1 / MANY
    limit = MISSED * median if regular else median * log(len(steps) / ALARM) / log(2)
    around = ((k, np.median(steps[max(k - FEW, 0) : k + FEW + 1])) for k in np.flatnonzero(steps > limit))
    rows = np.array([k for k, usual in around if steps[k] > MISSED * usual], int)
    return rows if len(rows) <= max(3, len(steps) // MANY) else np.zeros(0, int)


def in_parts(plant: Plant, table: Table) -> list[Table]:
    """Return a recording as the parts between its gaps, or as it is. Each cut is a note.

    Inputs alone are a schedule: they hold between its rows, however far apart."""
    measured = [table.columns[o.column] for o in plant.outputs.values() if o.column in table.columns]
    if not any(np.isfinite(y).any() for y in measured):
        return [table]
    rows = gaps(table.t)
    moving = [i.column for i in plant.inputs.values() if _moves(table, i.column)]
    jumps = [k for k in rows.tolist() if moving or _goes_on(plant, table, k)]
    if not jumps:
        return [table]
    notes = [_cut(plant, table, k) for k in jumps]
    if unknown := unread_starts(plant):
        names = ", ".join(map(repr, unknown))
        left = f"; nothing states where {names} starts after it (initial_sigma would): the rest is left out"
        return [replace(part(table, 0, jumps[0] + 1, 1), notes=(*table.notes, notes[0] + left))]
    ends = [0, *(k + 1 for k in jumps), len(table)]
    parts = []
    for number, (begin, end) in enumerate(zip(ends[:-1], ends[1:], strict=True), 1):
        if end - begin >= FEW:
            parts.append(part(table, begin, end, number))
        else:
            notes.append(f"part {number} left out: {end - begin} samples")
    if not parts:
        return [table]
    return [replace(parts[0], notes=(*table.notes, *notes)), *(replace(p, notes=()) for p in parts[1:])]


def part(table: Table, begin: int, end: int, number: int) -> Table:
    """Return rows `begin` to `end` of a recording as its part `number`, which starts at its first row."""
    columns = {n: v[begin:end] for n, v in table.columns.items()}
    meta = table.meta | ({RESTARTED: str(number)} if begin else {})
    if begin and (start := meta.get("start")):
        later = np.datetime64(start.rstrip("Z"), "ms") + np.timedelta64(
            round((table.t[begin] - table.t[0]) * 1e3), "ms"
        )
        meta["start"] = f"{later}Z" if start.endswith("Z") else str(later)
    name = table.name if number == 1 else f"{table.name}_part{number}"
    return replace(
        table,
        name=name,
        path=f"{table.path} (part {number})",
        t=table.t[begin:end],
        columns=columns,
        meta=meta,
    )


def _moves(table: Table, column: str) -> bool:
    values = table.columns.get(column, np.zeros(0))
    values = values[np.isfinite(values)]
    return len(values) > 0 and bool(np.ptp(values) > 0)


def direct_outputs(plant: Plant) -> dict[str, str]:
    """Return by node the output that reads it as it is."""
    return {
        str(o.value.value): o.name
        for o in plant.outputs.values()
        if o.value.op == "name" and o.value.value in plant.nodes
    }


def unread_starts(plant: Plant) -> list[str]:
    """Return the nodes of which neither a reading nor an initial_sigma gives the state after a gap."""
    read = direct_outputs(plant)
    return [
        n.name
        for n in plant.nodes.values()
        if n.name not in read
        and n.initial_sigma is None
        and not any(e.op == "first" for e in ex.walk(n.initial))
    ]


def _goes_on(plant: Plant, table: Table, k: int) -> bool:
    """Return whether moving readings continue after a gap as if no time had passed."""
    usual = float(np.median(np.diff(table.t)))
    steady = []
    for o in plant.outputs.values():
        y = table.columns.get(o.column, np.zeros(0))
        near = y[max(k - 2 * FEW, 0) : k + 1 + 2 * FEW]
        before = y[max(k - 2 * FEW, 0) : k + 1]
        if len(before) < FEW or len(near) < 2 * FEW or not np.isfinite(near).all():
            continue
        steps = np.abs(np.diff(before))
        slope = float(np.polyfit(np.arange(len(before)), before, 1)[0])
        noise = max(
            float(np.std(np.diff(before, 2))) / 6**0.5, float(steps[steps > 0].min(initial=np.inf)) / 4
        )
        expected = abs(slope) * (table.t[k + 1] - table.t[k]) / usual
        if expected > 12 * noise:
            steady.append(abs(y[k + 1] - y[k] - slope) <= 6 * noise)
    return bool(steady) and all(steady)


def _cut(plant: Plant, table: Table, k: int) -> str:
    """Return the note of a cut after row k."""
    usual = float(np.median(np.diff(table.t)))
    gap = float(table.t[k + 1] - table.t[k])
    where = f"no samples from t = {table.t[k]:.6g} to {table.t[k + 1]:.6g} s, {usual:.3g} s apart elsewhere"
    hour = abs(gap - HOUR_S) <= max(2.5 * usual, 1.0)
    if _goes_on(plant, table, k) or (hour and usual < HOUR_S / 10):
        what = "daylight saving?" if hour else "the readings go on as if no time had passed"
        return f"{where}: a jump of the clock ({what}); read as two recordings"
    return f"{where}: inputs may have changed meanwhile; read as two recordings, each with a start of its own"


def all_parts(plant: Plant, tables: Sequence[Table]) -> list[Table]:
    """Return recordings with those that have gaps in parts."""
    return [part for table in tables for part in in_parts(plant, table)]
