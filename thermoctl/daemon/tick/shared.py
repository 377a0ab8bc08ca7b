"""The shared memory of one daemon: the loop's output and its commands.

One segment, named after the rig's socket, with version and layout in its header. The supervisor creates and
removes it; a segment left behind by a killed daemon is replaced. It is a mapped file in SHARED_MEMORY.
multiprocessing's own class is not used: it starts one more process, which removes the segment of a killed
daemon at any later time.

    declaration the rig's points: the sizes of all areas follow from it (signals.Row)
    ring        the record of every tick
    mailbox     commands to the loop;  parameters: the block that a RELOAD command applies
    remarks     age and verdict of every reading, onset of every active fault, messages of the devices
    state       the law's state at intervals, with tick and generation: where a recording's replay starts
    lateness, busy, reference   histograms, microseconds
    device_counters   frames, errors, reconnections of each device
    unsaved     data that cannot be saved now, and why (daemon/unsaved.py)
    counters    start time, ticks of the reference loop, process ids
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import mmap
import os
import time
import zlib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from thermoctl.control import faults
from thermoctl.control.model import packed_names
from thermoctl.daemon.tick.ring import Box, Histogram, Mailbox, Remarks, Ring
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.channels import DEFAULT, Channels, of_text
from thermoctl.rig.signals import Row, of_channels

VERSION = 2
MAGIC = 0x7468726D6F63746C  # 'thrmoctl'
ROWS = 8192  # ticks a reader may lag behind
BINS = 4096  # us
STATE_NUMBERS = 4096
TEXT_WORDS = 40  # words of 8 bytes for a device's message
COUNTER_WORDS = 512  # words of 8 bytes for the counters of all devices as text
UNSAVED = ("recording", "estimates")
"""The writers of the daemon: the places of `Shared.unsaved`."""
UNSAVED_WORDS = 128  # words of 8 bytes for the reason
SHARED_MEMORY = Path("/dev/shm")

DECLARATION_BYTES = 16384
_HEADER = 4  # numbers: MAGIC, VERSION, layout, bytes of the segment


def _areas(row: Row) -> tuple[tuple[str, str, tuple[int, ...]], ...]:
    """Return the areas' names, types and shapes for a rig with this row."""
    channels = len(row.channels.names)
    return (
        ("header", "u8", (_HEADER,)),
        ("declaration", "u8", (DECLARATION_BYTES // 8,)),
        ("ring_head", "u8", (1,)),
        ("rows", "f8", (ROWS, len(row))),
        ("mail_counters", "u8", (2,)),
        ("mail", "f8", (64, 2)),
        ("parameters_sequence", "u8", (1,)),
        ("parameters", "f8", (len(packed_names(row.channels.names)) + 1,)),
        ("state_sequence", "u8", (1,)),
        ("state", "f8", (STATE_NUMBERS,)),
        ("lateness", "u8", (BINS + 1,)),
        ("busy", "u8", (BINS + 1,)),
        ("reference", "u8", (BINS + 1,)),
        ("largest", "f8", (3,)),
        ("counters", "f8", (16,)),
        ("ages", "f8", (channels,)),
        ("verdicts", "f8", (channels,)),
        ("remark_numbers", "f8", (3,)),
        ("onsets", "f8", (64, 3)),
        ("text_sequences", "u8", (channels,)),
        ("text_times", "f8", (channels,)),
        ("texts", "u8", (channels, TEXT_WORDS)),
        ("device_counters_sequence", "u8", (1,)),
        ("device_counters", "f8", (COUNTER_WORDS,)),
        ("unsaved_sequences", "u8", (len(UNSAVED), 1)),
        ("unsaved", "f8", (len(UNSAVED), UNSAVED_WORDS)),
    )


START_S, LOOP_PID, RECORDER_LOST, RECORDER_ROWS, NO_MODEL, TUNING, RESUMED, RUN_S = range(8)
"""Indices in `counters`. TUNING: 1 + percent, 0 without tuning. RUN_S: start of this run, seconds since 1970.

NO_MODEL: 1 on a rig without a compensator's model, of which nothing is estimated.
RESUMED: 1 when the law started with the estimates of an earlier run.
"""
BEATS = 8
"""First index in `counters` of the helpers' round counts; the supervisor detects one that hangs."""
TRIAL = 15
"""Index in `counters`: 1 while the loop has gains that a command tries."""


def _layout(row: Row) -> int:
    """Return a number that differs for another layout of the segment."""
    names = [row.names, packed_names(row.channels.names), faults.NAMES]
    return zlib.crc32(json.dumps([_areas(row), names]).encode())


class Shared:
    """The segment with its areas; the supervisor calls `create`, others `attach`.

    `row`: the signals of its rows; `channels`: the rig's channels."""

    def __init__(self, memory: mmap.mmap, path: Path, channels: Channels):
        self._memory, self._path = memory, path
        self.channels, self.row = channels, of_channels(channels)
        offset = 0
        self.areas: dict[str, np.ndarray] = {}
        for name, kind, shape in _areas(self.row):
            array: np.ndarray = np.ndarray(shape, kind, memory, offset)
            self.areas[name] = array
            offset += array.nbytes
        a = self.areas
        self.ring = Ring(a["ring_head"], a["rows"])
        self.mailbox = Mailbox(a["mail_counters"], a["mail"])
        self.parameters = Box(a["parameters_sequence"], a["parameters"])
        self.state = Box(a["state_sequence"], a["state"])
        self.lateness = Histogram(a["lateness"], a["largest"][0:1])
        self.busy = Histogram(a["busy"], a["largest"][1:2])
        self.reference = Histogram(a["reference"], a["largest"][2:3])
        self.device_counters = Box(a["device_counters_sequence"], a["device_counters"])
        self.unsaved = {
            name: Box(a["unsaved_sequences"][k], a["unsaved"][k]) for k, name in enumerate(UNSAVED)
        }
        self.counters = a["counters"]
        self.remarks = self.make_remarks()

    def make_remarks(self, period_s: float = 0.001) -> Remarks:
        """Return the areas of the remarks; period_s matters to the writer only."""
        a = self.areas
        return Remarks(
            a["ages"],
            a["verdicts"],
            a["remark_numbers"],
            a["onsets"],
            a["text_sequences"],
            a["text_times"],
            a["texts"].view("u1"),
            period_s,
        )

    @classmethod
    def create(cls, name: str, channels: Channels = DEFAULT) -> Shared:
        """Create the segment and lock it; one that a killed daemon left behind is removed first.

        Raises InputError where a daemon holds it: its lock beside the socket may have been deleted."""
        row, text = of_channels(channels), channels.text().encode()
        if len(text) > DECLARATION_BYTES:
            raise InputError(
                f"points: names and labels of {len(text)} bytes; at most {DECLARATION_BYTES} fit"
            )
        size = sum(int(np.prod(shape)) * 8 for _, _, shape in _areas(row))
        path = SHARED_MEMORY / name
        try:
            with contextlib.suppress(FileNotFoundError), open(path, "rb") as left:
                fcntl.flock(left, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            fcntl.flock(file, fcntl.LOCK_EX)
        except BlockingIOError:
            raise InputError(
                f"shared memory '{name}': another daemon holds this rig, and may drive it, though its lock file was "
                "deleted; end it with `thermoctl stop`"
            ) from None
        except PermissionError:
            raise InputError(
                f"shared memory '{name}': left by another user; remove {path}, or take another socket.path"
            ) from None
        try:
            os.posix_fallocate(file, 0, size)  # where memory is lacking: an error now, no SIGBUS in the loop
            shared = cls(mmap.mmap(file, size), path, channels)
        except OSError as e:
            path.unlink(missing_ok=True)
            raise InputError(
                f"shared memory '{name}': {size} bytes are not to be had on {SHARED_MEMORY}: {e.strerror}; free some there"
            ) from None
        finally:
            os.close(file)  # the mapping holds a copy, and so the lock, in this process and its children
        shared.areas["declaration"].view("u1")[: len(text)] = np.frombuffer(text, "u1")
        shared.areas["header"][:] = MAGIC, VERSION, _layout(row), size
        shared.counters[RUN_S] = time.time()
        return shared

    @classmethod
    def attach(cls, name: str) -> Shared:
        """Attach to the segment of a running daemon.

        Raises InputError when there is none, it belongs to another user, or it has another layout."""
        path = SHARED_MEMORY / name
        try:
            file = os.open(path, os.O_RDWR)
        except FileNotFoundError:
            raise InputError(f"shared memory '{name}': not there: no daemon runs (thermoctl start)") from None
        except PermissionError:
            raise InputError(
                f"shared memory '{name}': belongs to another user: run this as the daemon's user"
            ) from None
        try:
            memory = mmap.mmap(file, 0)
            header = tuple(int(h) for h in np.ndarray((_HEADER,), "u8", memory))
            if header[:2] != (MAGIC, VERSION) or len(memory) < header[3]:
                raise ValueError("another version")
            channels = of_text(memory[8 * _HEADER : 8 * _HEADER + DECLARATION_BYTES].rstrip(b"\0").decode())
            if header[2] != _layout(of_channels(channels)):
                raise ValueError("another version")
        except (ValueError, TypeError):  # also where it is empty, or shorter than a header
            raise InputError(f"shared memory '{name}': of another version; restart the daemon") from None
        finally:
            os.close(file)
        return cls(memory, path, channels)

    def beats(self, place: int) -> float:
        """Return the rounds that the helper at this place has done."""
        return float(self.counters[BEATS + place])

    @property
    def run(self) -> str:
        """The run's name: the daemon's start in UTC, as recordings and log lines have it."""
        start = datetime.fromtimestamp(float(self.counters[RUN_S]), UTC)
        return start.strftime("%Y%m%dT%H%M%SZ")

    def remove(self) -> None:
        """Remove the segment's name (by its creator); the memory is freed with its last user."""
        self._path.unlink(missing_ok=True)


def percentiles(counts: np.ndarray, fractions: tuple[float, ...] = (0.5, 0.99, 0.999)) -> list[float]:
    """Percentiles of a histogram of whole microseconds, us (upper edge of the bin); NaN when it is empty."""
    total = counts.sum()
    if total == 0:
        return [float("nan")] * len(fractions)
    cumulative = np.cumsum(counts)
    return [float(np.searchsorted(cumulative, f * total)) + 1.0 for f in fractions]
