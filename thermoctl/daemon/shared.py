"""The shared memory of one daemon: the loop's output and its commands.

One segment, named after the rig's socket, with version and layout in its header. The supervisor creates and
removes it; a segment left behind by a killed daemon is replaced. It is a mapped file in SHARED_MEMORY.
multiprocessing's own class is not used: it starts one more process, which removes the segment of a killed
daemon at any later time.

    ring        the record of every tick (rows in the order of signals.SIGNALS)
    mailbox     commands to the loop;  parameters: the block that a RELOAD command applies
    remarks     age and verdict of every reading, onset of every active fault, messages of the devices
    state       the law's state at intervals, with tick and generation: where a recording's replay starts
    lateness, busy, reference   histograms, microseconds
    device_counters   frames, errors, reconnections of each device
    counters    start time, ticks of the reference loop, process ids
"""

from __future__ import annotations

import json
import mmap
import os
import time
import zlib
from pathlib import Path

import numpy as np

from thermoctl.channels import CHANNELS
from thermoctl.control import faults
from thermoctl.control.model import NAMES
from thermoctl.daemon.ring import Box, Histogram, Mailbox, Remarks, Ring
from thermoctl.signals import SIGNALS
from thermoctl.yamlfile import InputError

VERSION = 1
MAGIC = 0x7468726D6F63746C  # 'thrmoctl'
ROWS = 8192  # ticks a reader may lag behind
BINS = 4096  # us
STATE_NUMBERS = 1024
TEXT_WORDS = 40  # of 8 bytes each, for a device's message
COUNTER_WORDS = 512  # of 8 bytes each, for the counters of all devices as text
SHARED_MEMORY = Path("/dev/shm")

_AREAS = (
    ("header", "u8", (4,)),
    ("ring_head", "u8", (1,)),
    ("rows", "f8", (ROWS, len(SIGNALS))),
    ("mail_counters", "u8", (2,)),
    ("mail", "f8", (64, 2)),
    ("parameters_sequence", "u8", (1,)),
    ("parameters", "f8", (len(NAMES) + 1,)),
    ("state_sequence", "u8", (1,)),
    ("state", "f8", (STATE_NUMBERS,)),
    ("lateness", "u8", (BINS + 1,)),
    ("busy", "u8", (BINS + 1,)),
    ("reference", "u8", (BINS + 1,)),
    ("largest", "f8", (3,)),
    ("counters", "f8", (16,)),
    ("ages", "f8", (len(CHANNELS),)),
    ("verdicts", "f8", (len(CHANNELS),)),
    ("remark_numbers", "f8", (3,)),
    ("onsets", "f8", (64, 3)),
    ("text_sequences", "u8", (len(CHANNELS),)),
    ("text_times", "f8", (len(CHANNELS),)),
    ("texts", "u8", (len(CHANNELS), TEXT_WORDS)),
    ("device_counters_sequence", "u8", (1,)),
    ("device_counters", "f8", (COUNTER_WORDS,)),
)
START_S, LOOP_PID, RECORDER_LOST, RECORDER_ROWS, WARNINGS, TUNING, RESUMED, RUN_S = range(8)
"""Indices in `counters`. TUNING: 1 + percent, 0 without tuning. RUN_S: start of this run, seconds since 1970.

RESUMED: 1 when the law started with the estimates of an earlier run.
"""
BEATS = 8
"""First index in `counters` of the helpers' round counts; the supervisor detects one that hangs."""
_LAYOUT = zlib.crc32(json.dumps([_AREAS, [s.name for s in SIGNALS], NAMES, faults.NAMES]).encode())


class Shared:
    """The segment with its areas; the supervisor calls `create`, others `attach`."""

    def __init__(self, memory: mmap.mmap, path: Path):
        self._memory, self._path = memory, path
        at = 0
        self.areas: dict[str, np.ndarray] = {}
        for name, kind, shape in _AREAS:
            array: np.ndarray = np.ndarray(shape, kind, memory, at)
            self.areas[name] = array
            at += array.nbytes
        a = self.areas
        self.ring = Ring(a["ring_head"], a["rows"])
        self.mailbox = Mailbox(a["mail_counters"], a["mail"])
        self.parameters = Box(a["parameters_sequence"], a["parameters"])
        self.state = Box(a["state_sequence"], a["state"])
        self.lateness = Histogram(a["lateness"], a["largest"][0:1])
        self.busy = Histogram(a["busy"], a["largest"][1:2])
        self.reference = Histogram(a["reference"], a["largest"][2:3])
        self.device_counters = Box(a["device_counters_sequence"], a["device_counters"])
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
    def create(cls, name: str) -> Shared:
        """Create the segment; one that a killed daemon left behind is removed first."""
        size = sum(int(np.prod(shape)) * 8 for _, _, shape in _AREAS)
        path = SHARED_MEMORY / name
        try:
            path.unlink(missing_ok=True)
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        except PermissionError:
            raise InputError(
                f"shared memory '{name}': left by another user; remove {path}, or take another socket.path"
            ) from None
        try:
            os.ftruncate(file, size)
            shared = cls(mmap.mmap(file, size), path)
        finally:
            os.close(file)
        shared.areas["header"][:] = MAGIC, VERSION, _LAYOUT, size
        shared.counters[RUN_S] = time.time()
        return shared

    @classmethod
    def attach(cls, name: str) -> Shared:
        """Attach to the segment of a running daemon.

        Raises InputError when there is none, it belongs to another user, or it has another layout.
        """
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
            header = tuple(int(h) for h in np.ndarray((4,), "u8", memory))
        except (ValueError, TypeError):  # empty, or shorter than a header
            header = ()
        finally:
            os.close(file)
        if header[:3] != (MAGIC, VERSION, _LAYOUT) or len(memory) < header[3]:
            raise InputError(f"shared memory '{name}': of another version; restart the daemon")
        return cls(memory, path)

    def beats(self, place: int) -> float:
        """Return the rounds that the helper at this place has done."""
        return float(self.counters[BEATS + place])

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
