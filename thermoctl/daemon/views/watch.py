"""Frames for the dashboard: a thread that follows the ring and makes a frame a few times a second.

It only reads shared memory; the loop does not notice. It detects the end of a daemon (the segment is gone)
and a new start.

A capture holds the rows of every tick around a new fault. It begins with the rows that the ring still holds,
so a fault soon after the dashboard's start has its history, too. A newly opened page shows the last minute at
once, from reduced rows.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control import arming, faults
from thermoctl.daemon.answers.display import EXPECTED, MEASURED, UNKNOWN, between
from thermoctl.daemon.answers.readings import finite, hide_invalid, invalid
from thermoctl.daemon.answers.snapshot import latency, status
from thermoctl.daemon.tick.assemble import compensator, rig_identity, shared_name
from thermoctl.daemon.tick.shared import Shared
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.history import history, recorded_span
from thermoctl.rig.signals import AT, fault_words

BEFORE_S, AFTER_S = 2.0, 2.0  # span of a capture before and after the fault
CAPTURES = 16
SILENT_S = 2.0  # rows are shown as old after this time without a tick
PAST_S, PAST_STEP_S = 60.0, 0.1  # length and step of the history sent to a newly opened page
_PAST = """
wall_s reference_um compensated_um position_raw_um output_reference_um compensation_um expansion_um
innovation_c power_w
"""
PAST = tuple(_PAST.split())
_RANGED = "position_raw_um compensated_um output_reference_um lateness_us drive power_w innovation_c"
RANGED = tuple(_RANGED.split())
"""Signals whose minimum and maximum since the previous frame are in each frame."""
LATENESS_EDGES_US = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)

_T, _WALL = AT["t_s"], AT["wall_s"]
_TRIPS = np.uint64(faults.mask("fault", "critical"))


@dataclass
class Capture:
    """The rows of every tick from BEFORE_S before a fault to AFTER_S after it: rows (n, signals)."""

    number: int
    t_s: float
    wall_s: float
    faults: list[str]
    rows: np.ndarray
    whole: bool = False
    lost: int = 0  # ticks that were overwritten before they could be read

    def summary(self) -> dict[str, Any]:
        """Return the entry of a list of captures."""
        return {
            "number": self.number,
            "wall_s": self.wall_s,
            "t_s": self.t_s,
            "faults": self.faults,
            "rows": len(self.rows),
            "whole": self.whole,
            "lost": self.lost,
        }


class Watch:
    """Follows the ring of a daemon: `look()` once, or `run()` at `rate_hz` until `stop()`.

    frame: the newest one, a dict ready for JSON; `wait(seen)` returns (number, frame) as soon as its
    number is not `seen`. captures: newest last. past: the last minute, {state, PAST signals} every tenth
    of a second, oldest first."""

    def __init__(self, settings: Settings, rate_hz: float = 20.0):
        self.settings, self.rate_hz = settings, rate_hz
        self.name = shared_name(settings)
        self.shared: Shared | None = None
        self.captures: deque[Capture] = deque(maxlen=CAPTURES)
        self.past: deque[dict[str, Any]] = deque(maxlen=round(PAST_S / PAST_STEP_S))
        self.number, self.frame = 0, _down()
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._recent: deque[np.ndarray] = deque()
        self._position = self._captured = self._inode = 0
        self._bits: int | None = None  # fault bits of the row before; None before the first
        self._moved_s = time.monotonic()
        self._is_new = True  # no daemon has been seen yet, so that `past` comes from the recording
        model = compensator(settings)
        self._noise_c2 = model.R_v if settings.compensation.model else math.nan
        self._gain = float(model.C[0] @ model.gain[:, 0])

    def run(self) -> None:
        """Call `look` `rate_hz` times a second until `stop()`."""
        while not self._stopping.wait(1.0 / self.rate_hz):
            self.look()

    def stop(self) -> None:
        """End `run`, and everyone who waits for a frame."""
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()

    @property
    def stopping(self) -> bool:
        """Return whether `stop` was called."""
        return self._stopping.is_set()

    def wait(self, seen: int, timeout_s: float) -> tuple[int, dict[str, Any]]:
        """Return the newest frame once there is one newer than `seen`, at the latest after timeout_s."""
        with self._changed:
            self._changed.wait_for(lambda: self.number != seen or self.stopping, timeout_s)
            return self.number, self.frame

    def look(self) -> None:
        """Read the rows since the last look; make a frame."""
        shared = self._attached()
        if self._is_new and shared is None:
            self.past.extend(recorded_past(self.settings))
        self._is_new = False
        frame = _down() if shared is None else self._follow(shared)
        with self._changed:
            self.number, self.frame = self.number + 1, frame
            self._changed.notify_all()

    def capture(self, number: int) -> Capture | None:
        """Return the capture of this number, None when it is no longer kept."""
        return next((c for c in list(self.captures) if c.number == number), None)

    def latency(self) -> dict[str, Any] | None:
        """Return snapshot.latency with each histogram in LATENESS_EDGES_US; None without a daemon."""
        shared = self.shared
        if shared is None:
            return None
        answer = latency(shared, self.settings.loop.period_s)
        for name in ("lateness", "busy", "reference"):
            bins = answer[name].pop("bins_us")
            answer[name]["counts"] = between(bins, (*LATENESS_EDGES_US, math.inf))
        return {**answer, "edges_us": list(LATENESS_EDGES_US)}

    def _attached(self) -> Shared | None:
        """Return the segment of the daemon that runs now; None when there is none."""
        try:
            inode = os.stat(f"/dev/shm/{self.name}").st_ino
        except OSError:
            inode = 0
        if inode != self._inode and self.shared is not None:
            memory = self.shared._memory
            vars(self.shared).clear()
            self.shared = None
            with contextlib.suppress(BufferError):  # a request still reads it and frees it afterwards
                memory.close()
        if self.shared is None and inode:
            try:
                shared = Shared.attach(self.name)
            except InputError:
                return None
            self.shared, self._inode = shared, inode
            # Position 0: start with the oldest row that the ring still holds.
            self._position, self._bits = 0, None
            self._recent.clear()
            self.past.clear()
        return self.shared

    def _follow(self, shared: Shared) -> dict[str, Any]:
        first = self._bits is None
        rows, self._position, lost = shared.ring.read(self._position)
        now = time.monotonic()
        if len(rows):
            self._moved_s = now
            self._keep(rows, 0 if first else lost)
        frame = {**status(shared), "ok": True, "silent_s": round(now - self._moved_s, 1)}
        if len(rows):
            self._remember(rows, frame.get("output_is", ""))
        frame["stale"] = frame["silent_s"] > SILENT_S
        newest = rows[-1] if len(rows) else shared.ring.newest()
        if newest is not None:
            frame.update(
                wall_s=float(newest[_WALL]),
                position_raw_um=frame["readings"]["position_um"]["value"],
                innovation_sigma_c=self._sigma(newest),
            )
        if len(rows):
            with np.errstate(all="ignore"):
                frame["range"] = {
                    n: [finite(np.fmin.reduce(column)), finite(np.fmax.reduce(column))]
                    for n, column in ((n, hide_invalid(rows, n, self.settings.row)) for n in RANGED)
                }
        return frame

    def _sigma(self, row: np.ndarray) -> float | None:
        """Return the innovation's expected standard deviation, K: S = R_v / (1 - C K), from (35)."""
        share = self._gain * row[AT["kalman_gain"]]
        return finite(math.sqrt(self._noise_c2 / (1.0 - share))) if 0.0 <= share < 1.0 else None

    def _remember(self, rows: np.ndarray, output_is: str) -> None:
        """Append the last row of each PAST_STEP_S to `past`, and drop rows older than a minute."""
        rows = rows[rows[:, _WALL] > rows[-1, _WALL] - PAST_S]
        step = np.floor(rows[:, _WALL] / PAST_STEP_S)
        rows = rows[np.append(np.diff(step) != 0, True)]
        columns = {n: hide_invalid(rows, n, self.settings.row) for n in PAST}
        for k, row in enumerate(rows):
            point = {
                "ok": True,
                "state": arming.STATES[int(row[AT["state"]])],
                "output_is": output_is,
                **{n: finite(column[k]) for n, column in columns.items()},
            }
            if self.past and row[_WALL] < self.past[-1]["wall_s"]:
                self.past.clear()  # the clock was set back
            if self.past and row[_WALL] // PAST_STEP_S == self.past[-1]["wall_s"] // PAST_STEP_S:
                self.past[-1] = point
            else:
                self.past.append(point)

    def _keep(self, rows: np.ndarray, lost: int) -> None:
        """Add rows to open captures; begin one for each new fault that trips.

        lost: ticks missing before `rows`, because this process fell behind by more than the ring's length."""
        if lost:
            self._recent.clear()
        for capture in self.captures:
            if not capture.whole:
                capture.lost += min(
                    lost, round((capture.t_s + AFTER_S - capture.rows[-1, _T]) / self.settings.loop.period_s)
                )
                after = rows[rows[:, _T] <= capture.t_s + AFTER_S]
                capture.rows = np.concatenate((capture.rows, after))
                capture.whole = len(after) < len(rows)
        bits = np.where(rows[:, AT["state"]] == arming.OFF, np.uint64(0), fault_words(rows) & _TRIPS)
        before = np.concatenate((bits[:1] if self._bits is None else [np.uint64(self._bits)], bits[:-1]))
        for k in np.flatnonzero(bits & ~before):
            names = [f.name for f in faults.decode(int(bits[k] & ~before[k]))]
            self._begin_capture(rows, int(k), names)
        self._bits = int(bits[-1])
        self._recent.append(rows)
        while self._recent[0][-1, _T] < rows[-1, _T] - BEFORE_S:
            self._recent.popleft()

    def _begin_capture(self, rows: np.ndarray, k: int, names: list[str]) -> None:
        newest = self.captures[-1] if self.captures else None
        t_s = float(rows[k, _T])
        if newest is not None and newest.t_s <= t_s <= newest.t_s + AFTER_S:
            newest.faults = [*newest.faults, *(n for n in names if n not in newest.faults)]  # a consequence
            return
        captured = np.concatenate((*self._recent, rows))
        captured = captured[(captured[:, _T] >= t_s - BEFORE_S) & (captured[:, _T] <= t_s + AFTER_S)]
        self._captured += 1
        whole = bool(rows[-1, _T] > t_s + AFTER_S)
        self.captures.append(Capture(self._captured, t_s, float(rows[k, _WALL]), names, captured, whole))


def recorded_past(settings: Settings) -> list[dict[str, Any]]:
    """Return the last minute that was recorded, as `Watch.past`; [] where nothing was."""
    folder, rig = settings.recording.directory, rig_identity(settings)
    span = recorded_span(folder, rig)
    if span is None:
        return []
    begin_s, step_s = span[1] - PAST_S, PAST_STEP_S
    columns: dict[str, dict[int, float]] = {}
    for name in ("state", *PAST):
        drawn = history(folder, rig, name, begin_s, span[1] + 1.0, 610, invalid, settings.row.names)
        columns[name] = dict(zip((drawn.t // step_s).astype(int).tolist(), drawn.mean.tolist(), strict=True))
    measured = any(math.isfinite(v) for v in columns["output_reference_um"].values())
    output_is = MEASURED if measured else EXPECTED if settings.compensation.model else UNKNOWN
    return [
        {
            "ok": True,
            "state": arming.STATES[round(columns["state"][k])],
            "output_is": output_is,
            **{n: finite(columns[n].get(k, math.nan)) for n in PAST},
        }
        for k in sorted(columns["state"])
    ]


def _down() -> dict[str, Any]:
    return {
        "ok": False,
        "state": "OFF",
        "faults": [],
        "error": "the daemon is not running: `thermoctl start`",
    }
