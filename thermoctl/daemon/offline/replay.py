"""Replay: run the recorded inputs through the law again and compare the outputs bit for bit."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from thermoctl.control.law import Law
from thermoctl.daemon.recorder import read_law_metadata
from thermoctl.daemon.tick.ring import unpack_readings
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.reader import info, read_rows
from thermoctl.rig.channels import of_names
from thermoctl.rig.signals import AT, OUTPUTS, of_channels

_DT, _COMMAND, _VALUE, _EXTERNAL = (AT[n] for n in ("dt_s", "command", "command_value", "external_bits"))


@dataclass
class Replay:
    """Result of a replay.

    `ticks` compared, `skipped` before the stored state; `differences` {signal: (ticks that differ, first
    of them, largest difference)}; `outputs` (ticks, outputs) of this replay."""

    ticks: int
    skipped: int
    differences: dict[str, tuple[int, int, float]]
    outputs: np.ndarray


def replay(rows: np.ndarray, law_metadata: str, name: str = "recording") -> Replay:
    """Run `rows` (ticks, signals) through a law made from the recording's own metadata.

    A recording of this law's version has its fault bits: a bit is never given to another fault
    (control/faults.py).

    Raises InputError when the metadata is missing or damaged, or ticks are missing."""
    try:
        metadata = read_law_metadata(law_metadata)
        law = Law(metadata["model"], metadata["parameters"], float(metadata["period_s"]))
        tick = int(metadata["tick"])
        if metadata["state"] is not None:
            law.restore(metadata["state"])
        layout = of_channels(of_names(metadata["model"].points))
        if rows.shape[1] != len(layout):
            raise ValueError(f"rows of {rows.shape[1]} signals, expected {len(layout)}")
    except (ValueError, KeyError, TypeError, OverflowError) as e:
        raise InputError(
            f"{name}: holds no usable law to replay ({e}): replay it with the version that recorded it"
        ) from None
    ticks = rows[:, AT["tick"]]
    skipped = int(np.searchsorted(ticks, tick, side="right"))
    rows = np.ascontiguousarray(rows[skipped:])
    if len(rows) and rows[0, AT["tick"]] != tick + 1:
        raise InputError(
            f"{name}: the stored state is of tick {tick}, the next row is tick "
            f"{rows[0, AT['tick']]:.0f}; ticks are missing, so a replay cannot start"
        )
    missing = np.flatnonzero(np.diff(rows[:, AT["tick"]]) != 1)
    if len(missing):
        raise InputError(
            f"{name}: ticks are missing after tick {rows[missing[0], AT['tick']]:.0f} (the recorder "
            "fell behind); a replay would not start from the same state"
        )
    bits = range(layout.fresh.start, layout.delay.stop)
    whole = rows[:, [_COMMAND, _EXTERNAL, *bits]]
    wrong = np.flatnonzero(
        ~((whole == np.floor(whole)) & (np.abs(whole) <= [100, *[2.0**53] * (1 + len(bits))])).all(axis=1)
    )
    if len(wrong):
        raise InputError(
            f"{name}: tick {rows[wrong[0], AT['tick']]:.0f} has a command, or bits, that are no whole number: "
            "damaged"
        )
    n = layout.readings.stop - layout.readings.start
    value, (fresh, status, delay) = np.zeros(n), np.zeros((3, n), dtype=np.uint8)
    law.bind(value, fresh, status, delay)
    outputs = [*(AT[name] for name in OUTPUTS), *range(layout.estimates.start, layout.estimates.stop)]
    given = np.empty((len(rows), len(outputs)))
    for k, row in enumerate(rows):
        value[:] = row[layout.readings]
        unpack_readings(row[bits.start : bits.stop], fresh, status, delay)
        law.step(row[_DT], int(row[_COMMAND]), row[_VALUE], int(row[_EXTERNAL]))
        given[k] = law.outputs
    recorded = np.ascontiguousarray(rows[:, outputs])
    differences = {}
    same = given.view(np.uint64) == recorded.view(np.uint64)
    for j, output in enumerate(layout.names[k] for k in outputs):
        wrong = np.flatnonzero(~same[:, j])
        if len(wrong):
            largest = float(np.nanmax(np.abs(given[wrong, j] - recorded[wrong, j]), initial=0.0))
            differences[output] = (len(wrong), int(rows[wrong[0], AT["tick"]]), largest)
    return Replay(len(rows), skipped, differences, given)


def command(recording: str) -> int:
    """Run a recording's inputs through the law; return 1 when an output differs in one bit."""
    rows, metadata = read_rows(recording)
    begin = time.perf_counter()
    result = replay(rows, metadata, recording)
    seconds = time.perf_counter() - begin
    meta = info(recording).meta
    print(
        f"{recording}: {result.ticks} ticks replayed in {seconds:.2f} s"
        + (f", {result.skipped} before the stored state skipped" if result.skipped else "")
        + f"; rig {meta.get('rig', 'unknown')}, run {meta.get('run', 'unknown')}"
    )
    for name, (count, first, largest) in result.differences.items():
        row = rows[np.searchsorted(rows[:, AT["tick"]], first)]
        wall_time = datetime.fromtimestamp(row[AT["wall_s"]], UTC).isoformat(timespec="milliseconds")
        print(
            f"  {name}: differs in {count} ticks, first in tick {first} (t_s {row[AT['t_s']]:.3f}, {wall_time}), by at most {largest:g}"
        )
    if result.differences:
        return 1
    print(f"  all {np.size(result.outputs)} outputs are the recorded ones, bit for bit")
    return 0
