"""Return a signal's history for a plot: minimum, mean and maximum in each pixel's span.

Only recordings of one rig are drawn, by the name in their metadata; those without a name belong to no rig. A
reading that was stale or in error is not a sample. Long spans come from the 10 Hz tier, short ones
(FULL_SPAN_S and less) from the full rate. Closed files are reduced to one second once and kept in memory, so
a day is drawn again in milliseconds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.stream import open_stream, texts
from thermoctl.recording.writer import FULL, NAME, TIER, recording_files
from thermoctl.rig.signals import NAMES

Invalid = Callable[[Mapping[str, np.ndarray], Mapping[str, str], str], np.ndarray] | None
FULL_SPAN_S = 60.0  # at and below this the full rate is shown
COARSE_SPAN_S = 7200.0  # above this, one second is fine enough
MAX_POINTS = 4000
_CLOCK, _STATUS = "wall_s", "status_bits"  # further words are status_bits_2 ...


@dataclass(frozen=True)
class History:
    """`t` (n,) seconds since 1970, the middle of each bucket that holds a sample.

    low, mean, high (n,) in the signal's unit; `source` 'full' or 'tier'; `files` that were read."""

    t: np.ndarray
    low: np.ndarray
    mean: np.ndarray
    high: np.ndarray
    source: str
    files: int


def history(
    directory: str | Path,
    rig: str,
    signal: str,
    begin_s: float,
    end_s: float,
    points: int = 800,
    invalid: Invalid = None,
    names: Collection[str] = NAMES,
) -> History:
    """Return the rig's signal from begin_s to end_s (seconds since 1970) in at most `points` buckets.

    names: the rig's signals. invalid(columns of status bits, metadata, signal) marks the samples to omit
    (readings.invalid); None keeps all. Empty when nothing is recorded.
    Raises InputError for an unknown signal, an empty span, or points outside 2..MAX_POINTS."""
    if signal not in names:
        raise InputError(f"history: no signal '{signal[:60]}'{suggest(signal, names)}")
    if not (np.isfinite([begin_s, end_s]).all() and 0.0 <= begin_s < end_s <= 1e11):
        raise InputError("history: a span of seconds since 1970 with its begin before its end was expected")
    if not 2 <= points <= MAX_POINTS:
        raise InputError(f"history: 2 to {MAX_POINTS} points were expected, not {points}")
    span_s = end_s - begin_s
    kind = FULL if span_s <= FULL_SPAN_S else TIER
    step_s = 1.0 if span_s > COARSE_SPAN_S else 0.0
    paths = [p for p in _within(Path(directory), kind, begin_s, end_s) if rig_of(p) == rig]
    parts = [_samples(path, signal, kind, step_s, invalid) for path in paths]
    empty = np.empty(0)
    wall, low, mean, high = (np.concatenate([p[k] for p in parts]) if parts else empty for k in range(4))
    inside = (wall >= begin_s) & (wall <= end_s) & np.isfinite(mean)
    bucket = np.minimum((wall[inside] - begin_s) / span_s * points, points - 1).astype(np.int64)
    which, low, mean, high = reduce(bucket, low[inside], mean[inside], high[inside])
    return History(
        begin_s + (which + 0.5) / points * span_s,
        low,
        mean,
        high,
        "full" if kind == FULL else "tier",
        len(paths),
    )


def reduce(bucket: np.ndarray, low: np.ndarray, mean: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
    """Reduce samples of the same bucket to (bucket numbers, minimum, mean, maximum).

    The buckets need not be in order, because the clock may step."""
    if not len(bucket):
        return bucket, low, mean, high
    if (np.diff(bucket) < 0).any():
        order = np.argsort(bucket, kind="stable")
        bucket, low, mean, high = bucket[order], low[order], mean[order], high[order]
    starts = np.concatenate(([0], np.flatnonzero(np.diff(bucket)) + 1))
    count = np.diff(np.concatenate((starts, [len(bucket)])))
    return (
        bucket[starts],
        np.fmin.reduceat(low, starts),
        np.add.reduceat(mean, starts) / count,
        np.fmax.reduceat(high, starts),
    )


def _match(path: Path) -> re.Match[str]:
    match = NAME.match(path.name)
    assert match is not None  # recording_files gives only such names
    return match


def _start_s(path: Path) -> float:
    return datetime.strptime(_match(path)["start"], "%Y%m%dT%H%M%S.%fZ").replace(tzinfo=UTC).timestamp()


def _within(directory: Path, kind: str, begin_s: float, end_s: float) -> list[Path]:
    """Return the files that may overlap the span: from the start in a file's name to its last write."""
    try:
        paths = recording_files(directory, kind)
    except OSError:
        return []  # nothing was recorded yet
    chosen = []
    for path in paths:
        try:
            if _start_s(path) <= end_s and path.stat().st_mtime + 1.0 >= begin_s:
                chosen.append(path)
        except FileNotFoundError:  # the disk budget deleted it meanwhile
            continue
    return chosen


def recorded_span(directory: str | Path, rig: str) -> tuple[float, float] | None:
    """Return (start of the oldest recording, last write of the newest), seconds since 1970.

    None where the rig has none."""
    paths = [p for p in _within(Path(directory), TIER, 0.0, 1e11) if rig_of(p) == rig]
    try:
        return (min(map(_start_s, paths)), max(p.stat().st_mtime for p in paths)) if paths else None
    except FileNotFoundError:  # the disk budget deleted one meanwhile
        return None


def rig_of(path: Path) -> str:
    """Return the rig that a recording's metadata names; '' where it names none or cannot be read."""
    try:
        return _rig_of(path, path.stat().st_ino)
    except (InputError, OSError):
        return ""


@lru_cache(maxsize=4096)
def _rig_of(path: Path, inode: int) -> str:
    return texts(open_stream(path).schema.metadata).get("rig", "")


def _samples(path: Path, signal: str, kind: str, step_s: float, invalid: Invalid) -> tuple[np.ndarray, ...]:
    """Return (wall, low, mean, high) of one file, reduced to `step_s` (0: as recorded); [] if broken."""
    try:
        size = path.stat().st_size
        return (
            _reduced(path, size, signal, kind, step_s, invalid)
            if step_s
            else _read(path, signal, kind, invalid)
        )
    except (InputError, OSError):
        return (np.empty(0),) * 4


@lru_cache(maxsize=512)
def _reduced(
    path: Path, size: int, signal: str, kind: str, step_s: float, invalid: Invalid
) -> tuple[np.ndarray, ...]:
    wall, low, mean, high = _read(path, signal, kind, invalid)
    there = np.isfinite(mean) & np.isfinite(wall)
    which, low, mean, high = reduce(
        np.floor(wall[there] / step_s).astype(np.int64), low[there], mean[there], high[there]
    )
    return (which + 0.5) * step_s, low, mean, high


def _read(path: Path, signal: str, kind: str, invalid: Invalid) -> tuple[np.ndarray, ...]:
    schema = open_stream(path).schema
    ranged = kind == TIER and f"{signal}_min" in schema.names
    names = [f"{signal}_min", signal, f"{signal}_max"] if ranged else [signal] * 3
    status = {n for n in schema.names if n.startswith(_STATUS)}
    wanted = {_CLOCK, *status, *names}
    batches = [
        {n: batch.column(n).to_numpy(zero_copy_only=False) for n in wanted}
        for batch in open_stream(path, wanted)
    ]
    if not batches:
        return (np.empty(0),) * 4
    columns = {n: np.concatenate([b[n] for b in batches]) for n in wanted}
    bad = np.zeros(len(columns[_CLOCK]), bool)
    if invalid is not None:
        bad = invalid({n: columns[n] for n in status}, texts(schema.metadata), signal)
    return columns[_CLOCK], *(np.where(bad, np.nan, columns[n]) for n in names)
