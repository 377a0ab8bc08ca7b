"""Write a recording: every tick, and a 10 Hz tier of min, mean and max that is kept longer.

Each is an Arrow IPC stream with zstd. Every half second a batch is written and synced. A power cut loses the
ticks after the last batch; the file before it can be read (stream.py). Files are named after the rig and
their start, `rig-20261121T043000.123Z.arrows` and `.10hz.arrows`. The oldest are deleted when the disk budget
is used up, and only after the beginning of the new file is on the disk.

A failing or full disk raises nothing here and deletes nothing. Lost rows are counted, the reason is reported
once, and the next file is tried some seconds later. The daemon continues.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa

from thermoctl.files.safe_file import part_file, reason, remedy_of, sync_folder
from thermoctl.recording.stream import CRC, END, checksums
from thermoctl.rig.signals import SIGNALS, Signal

BATCH_S = 0.5  # duration of one batch at the full rate: a power loss costs at most these ticks
BATCH_ROWS = 4096  # most rows in one batch, for simulated time that runs faster
TIER_HZ = 10.0
TIER_BATCH_ROWS = 50  # 5 s, less than the ring holds, for a test that goes on; the full rate has them, too
RETRY_S = 5.0
CHANGED = "a new file begins; let other programs change only older ones"
FULL, TIER = ".arrows", ".10hz.arrows"
NAME = re.compile(r"^(?P<rig>.+)-(?P<start>\d{8}T\d{6}\.\d{3}Z)(?P<again>-\d+)?(?P<kind>\.10hz)?\.arrows$")
_COMPRESSED = pa.ipc.IpcWriteOptions(compression="zstd")


def schema(signals: Sequence[Signal], metadata: Mapping[str, str]) -> pa.Schema:
    """Return the schema: float64 columns with unit and meaning of the signals; `metadata` is stored."""
    return pa.schema(
        [pa.field(s.name, pa.float64(), metadata={"unit": s.unit, "meaning": s.meaning}) for s in signals],
        metadata=dict(metadata),
    )


class StreamFile:
    """One Arrow stream on disk; a batch is written and synced whole, or absent. Raises OSError."""

    def __init__(self, path: Path, columns: pa.Schema):
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        self.path, self.schema = path, columns
        self.bytes = self.rows = 0
        self._buffer = io.BytesIO()
        self._fd, part = part_file(path)
        try:
            self._stream = pa.ipc.new_stream(self._buffer, columns, options=_COMPRESSED)
            self._append(np.empty((0, len(columns))))  # pyarrow writes the schema with the first batch
            os.replace(part, path)
            sync_folder(path.parent)
        except OSError:
            os.close(self._fd)
            for name in (part, path):
                with contextlib.suppress(OSError):
                    os.unlink(name)
            raise

    def write(self, rows: np.ndarray) -> None:
        """Append rows (k, columns) as one batch."""
        self._append(rows)
        self.rows += len(rows)

    def _append(self, rows: np.ndarray) -> None:
        batch = pa.RecordBatch.from_arrays(
            [pa.array(column) for column in np.ascontiguousarray(rows.T)], schema=self.schema
        )
        self._stream.write_batch(batch, custom_metadata={CRC: checksums(batch)})
        self._put()

    def _put(self) -> None:
        data = self._buffer.getvalue()
        self._buffer.seek(0)
        self._buffer.truncate()
        try:
            _write_all(self._fd, data)
            os.fdatasync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self.bytes)  # remove the incomplete batch
            os.lseek(self._fd, self.bytes, os.SEEK_SET)
            raise
        self.bytes += len(data)

    def is_intact(self) -> bool:
        """Return whether the file is still at its path, with what was written. Raises OSError."""
        try:
            there, own = os.stat(self.path), os.fstat(self._fd)
        except FileNotFoundError:
            return False
        return os.path.samestat(there, own) and own.st_size == self.bytes

    def close(self) -> None:
        """Write the end mark and release the file; one without rows is removed."""
        try:
            if self.rows:
                _write_all(self._fd, END)
            else:
                os.unlink(self.path)
        finally:
            os.close(self._fd)


def _write_all(fd: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


class Tier:
    """Reduce rows to min, mean and max over each tenth of a second; words of bits are or-ed.

    NaN is a missing sample."""

    def __init__(self, signals: Sequence[Signal]):
        names = [s.name for s in signals]
        self.clock = names.index("t_s")
        self.bits = [i for i, s in enumerate(signals) if s.bits]
        self.ranged = [i for i in range(len(names)) if i != self.clock and i not in self.bits]
        mean = [signals[i] for i in self.ranged]
        ends = [
            Signal(f"{s.name}_{end}", s.unit, f"{end} of {s.meaning}") for end in ("min", "max") for s in mean
        ]
        self.signals = (signals[self.clock], *(signals[i] for i in self.bits), *mean, *ends)
        self._open = np.empty((0, len(names)))

    def add(self, rows: np.ndarray, last: bool = False) -> np.ndarray:
        """Return the rows (m, len(self.signals)) that `rows` (k, signals) complete.

        `last` completes the row in progress."""
        rows = np.concatenate((self._open, rows))
        bins = np.floor(rows[:, self.clock] * TIER_HZ + 1e-6)
        ends = np.flatnonzero(np.diff(bins)) + 1
        whole = len(rows) if last else int(ends[-1]) if len(ends) else 0
        self._open = rows[whole:].copy()
        if not whole:
            return np.empty((0, len(self.signals)))
        rows, starts = rows[:whole], np.concatenate(([0], ends[ends < whole]))
        data = rows[:, self.ranged]
        there = ~np.isnan(data)
        count = np.add.reduceat(there, starts, axis=0, dtype=np.float64)
        total = np.add.reduceat(np.where(there, data, 0.0), starts, axis=0)
        with np.errstate(invalid="ignore"):
            mean = total / np.where(count > 0, count, np.nan)
        words = np.nan_to_num(rows[:, self.bits]).astype(np.int64)
        t, bits = rows[starts][:, [self.clock]], np.bitwise_or.reduceat(words, starts, axis=0)
        low, high = (f.reduceat(data, starts, axis=0) for f in (np.fmin, np.fmax))
        return np.hstack((t, bits, mean, low, high))


class WriterSettings(Protocol):
    """The settings that a writer reads: settings.RecordingSettings, or the same fields in a test."""

    @property
    def directory(self) -> str | Path:
        """The folder of the recordings."""

    @property
    def file_mb(self) -> float:
        """Size of a file after which the next begins, MB."""

    @property
    def file_s(self) -> float:
        """Age of a file after which the next begins, s."""

    @property
    def budget_gb(self) -> float:
        """Disk budget of the full rate, GB."""

    @property
    def tier_budget_gb(self) -> float:
        """Disk budget of the 10 Hz tier, GB."""


class RecordingWriter:
    """One recording: a full-rate file and its tier.

    When it is `full`, close it and open the next.

    - settings: folder, sizes and budgets
    - metadata: configuration, model and law, written into the files, beside `begins`: the wall clock
    - log(text): called with the reason when the disk fails, and with '' once rows are on the disk
    - `error`: the reason why nothing is recorded, '' when it is"""

    def __init__(
        self,
        settings: WriterSettings,
        metadata: Mapping[str, str],
        rig: str = "rig",
        log: Callable[[str], None] = print,
        signals: Sequence[Signal] = SIGNALS,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ):
        self.directory, self.log, self.clock = Path(settings.directory), log, clock
        self.budget, self.tier_budget = settings.budget_gb * 1e9, settings.tier_budget_gb * 1e9
        self.file_bytes, self.file_s = min(settings.file_mb * 1e6, self.budget / 4), settings.file_s
        self.error, self.lost, self._told = "", 0, 0
        self._waiting: list[np.ndarray] = []
        self._waiting_rows = 0
        self._tier = Tier(signals)
        self._tier_rows: list[np.ndarray] = []
        self._time = [s.name for s in signals].index("t_s")
        self._begun = self._failed = clock()
        self._pruned_at, self._working = 0, False
        self._full_file: StreamFile | None = None
        self._tier_file: StreamFile | None = None
        self._files_of = (
            re.sub(r"[^\w.-]+", "_", rig) or "rig",
            schema(signals, {**metadata, "tier": "full"}),
            schema(self._tier.signals, {**metadata, "tier": "10 Hz min, mean, max"}),
            wall,
        )
        self._open()

    @property
    def path(self) -> Path | None:
        """Path of the full-rate file; None while the disk cannot be written."""
        return self._full_file.path if self._full_file else None

    @property
    def full(self) -> bool:
        """True when the next recording is due: by size, by age, or some seconds after the disk refused."""
        if self._full_file is None:
            return self.clock() - self._failed >= RETRY_S
        return self._full_file.bytes >= self.file_bytes or self.clock() - self._begun >= self.file_s

    def write(self, rows: np.ndarray) -> int:
        """Append ticks (k, signals) in order of time; returns how many rows were lost since the last call."""
        if len(rows):
            self._waiting.append(np.array(rows, dtype=np.float64))
            self._waiting_rows += len(rows)
            span = rows[-1, self._time] - self._waiting[0][0, self._time]
            if span >= BATCH_S or span < 0 or self._waiting_rows >= BATCH_ROWS:
                self.flush()
        new, self._told = self.lost - self._told, self.lost
        return new

    append = write

    def flush(self) -> None:
        """Write the waiting rows to the disk now."""
        if not self._waiting:
            return
        rows = np.concatenate(self._waiting)
        self._waiting, self._waiting_rows = [], 0
        if self._full_file is None:
            self.lost += len(rows)
            return
        try:
            if intact := self._full_file.is_intact():
                self._full_file.write(rows)
                intact = self._full_file.is_intact()
        except OSError as e:
            self.lost += len(rows)
            self._fail(e)
            return
        if not intact:
            self.lost += len(rows)
            self._fail(OSError(f"{self._full_file.path.name} was deleted, moved or changed"), CHANGED)
            self._failed -= RETRY_S  # nothing is wrong with the disk
            return
        try:
            self._tier_rows.append(self._tier.add(rows))
            self._flush_tier(TIER_BATCH_ROWS)
            if not self._working or self._full_file.bytes - self._pruned_at > self.budget / 64:
                self._prune()
        except OSError as e:
            self._fail(e)
            return
        if not self._working:
            self._working = True
            self.log("")

    def close(self) -> int:
        """Flush, write the end marks, release the files; returns the rows lost since the last `write`."""
        self.flush()
        try:
            self._end_tier()
        except OSError as e:
            self._fail(e)
        self._release()
        new, self._told = self.lost - self._told, self.lost
        return new

    def _end_tier(self) -> None:
        """Write the rows of the tier that wait."""
        if self._full_file:
            self._tier_rows.append(self._tier.add(np.empty((0, len(self._full_file.schema))), last=True))
            self._flush_tier(1)

    def _flush_tier(self, least: int) -> None:
        if self._tier_file and sum(map(len, self._tier_rows)) >= least:
            self._tier_file.write(np.concatenate(self._tier_rows))
            self._tier_rows = []

    def _open(self) -> None:
        rig, full, tier, wall = self._files_of
        now = datetime.fromtimestamp(wall(), UTC)
        self._stamp = stamp = now.strftime("%Y%m%dT%H%M%S.%f")[:-3] + "Z"
        begins = {"begins": now.isoformat(timespec="milliseconds")}
        full, tier = (s.with_metadata({**s.metadata, **begins}) for s in (full, tier))
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            for again in ("", *(f"-{i}" for i in range(1, 1000))):
                stem = self.directory / f"{rig}-{stamp}{again}"
                try:
                    file = StreamFile(stem.with_name(stem.name + FULL), full)
                    break
                except FileExistsError:
                    continue
            else:
                raise FileExistsError(f"{self.directory}: a thousand files begin with {rig}-{stamp}")
            self._full_file = file
            self._tier_file = StreamFile(stem.with_name(stem.name + TIER), tier)
            self._prune(opening=True)
        except OSError as e:
            self._fail(e)

    def _prune(self, opening: bool = False) -> None:
        """Delete the oldest files; a margin is for the rows until the next check."""
        self._pruned_at = self._full_file.bytes if self._full_file else 0
        for file, kind, budget in (
            (self._full_file, FULL, self.budget),
            (self._tier_file, TIER, self.tier_budget),
        ):
            limit = budget + file.bytes if opening and file else budget * (1 - 1 / 32)
            prune(self.directory, kind, limit, file.path if file else None, self._stamp)

    def _fail(self, e: OSError, remedy: str = "") -> None:
        self.error = f"{self.directory}: {reason(e)}; {remedy or remedy_of(e)}"
        self._failed = self.clock()
        self.log(self.error)
        with contextlib.suppress(OSError):  # often the few bytes of the tier still fit
            self._end_tier()
        self._release()

    def _release(self) -> None:
        for f in (self._full_file, self._tier_file):
            if f is not None:
                with contextlib.suppress(OSError):  # the file is readable without its end mark
                    f.close()
        self._full_file = self._tier_file = None


def disk_warning(settings: WriterSettings) -> str:
    """Return a sentence where the budgets are larger than the disk has room for; '' else."""
    folder = Path(settings.directory).absolute()
    place = next(p for p in (folder, *folder.parents) if p.exists())
    try:
        room = shutil.disk_usage(place).free
        if folder.is_dir():
            for kind in (FULL, TIER):
                room += sum(p.stat().st_size for p in recording_files(folder, kind))
    except OSError:  # the recorder reports it
        return ""
    wanted = (settings.budget_gb + settings.tier_budget_gb) * 1e9
    if wanted <= room:
        return ""
    return (
        f"recording.budget_gb and tier_budget_gb are {wanted / 1e9:.3g} GB together, but the disk of {folder} has room for "
        f"{room / 1e9:.3g} GB: it fills before an old recording is deleted, and then nothing is recorded; lower them"
    )


def recording_files(directory: Path, kind: str) -> list[Path]:
    """Return our files of one kind (FULL or TIER) in a folder, oldest first."""
    files = [
        p for p in directory.iterdir() if (m := NAME.match(p.name)) and bool(m["kind"]) == (kind == TIER)
    ]
    return sorted(files, key=lambda p: (NAME.match(p.name)["start"], len(p.name), p.name))  # type: ignore[index]


def prune(directory: Path, kind: str, budget: float, keep: Path | None, now: str) -> int:
    """Delete the oldest files of a kind, but not `keep`, until they fit `budget` bytes; return how many.

    Files dated after `now`, in the form of their names, are older than it: the clock was wrong before."""
    sizes = {}
    for p in sorted(recording_files(directory, kind), key=lambda p: NAME.match(p.name)["start"] <= now):  # type: ignore[index]
        try:
            sizes[p] = p.stat().st_size
        except FileNotFoundError:
            continue
    total, gone = sum(sizes.values()), 0
    for p, size in sizes.items():
        if total <= budget:
            break
        if p != keep:
            p.unlink(missing_ok=True)
            total, gone = total - size, gone + 1
    return gone
