"""Reports when a writer of the daemon cannot save its data: once in the log, and by `status` until it can.

Each writer (shared.UNSAVED) has a text in shared memory.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from thermoctl.daemon.tick.shared import UNSAVED, Shared

ATTEMPTS = 3  # number of attempts to read a text that may be written meanwhile
_EVENTS = {
    "recording": ("nothing is recorded", "recording again"),
    "estimates": ("the estimates are not kept: the next start is cold", "the estimates are kept again"),
}
# Largest number of characters of a reason; of a longer one the end is kept, which names the error.
LONGEST = 400
REMEDY = "it is tried again by itself"


class Unsaved:
    """Reports for one writer (a name of shared.UNSAVED): call it with the reason, '' when it works."""

    def __init__(self, shared: Shared, name: str, log: Callable[..., None]):
        self._box, self._name, self._log = shared.unsaved[name], name, log
        self._now = _read(self._box)  # a restarted process goes on

    def __call__(self, why: str) -> None:
        """Log a change, and publish it."""
        why = why.encode("ascii", "backslashreplace").decode()[-LONGEST:]
        if why == self._now.get("why", ""):
            return
        since_s = self._now.get("since_s") or time.time()
        self._now = {"why": why, "since_s": since_s} if why else {}
        text = json.dumps(self._now).encode()
        self._box.put(np.frombuffer(text.ljust(-(-len(text) // 8) * 8), "f8").copy())
        begins, ends = _EVENTS[self._name]
        if why:
            self._log(begins, why=why, remedy=REMEDY)
        else:
            self._log(ends, after_s=round(time.time() - since_s, 1))


def unsaved(shared: Shared) -> list[dict[str, Any]]:
    """List the data that cannot be saved now: what, why, since_s (seconds since 1970)."""
    reasons = {name: _read(shared.unsaved[name]) for name in UNSAVED}
    return [{"what": name, **now} for name, now in reasons.items() if now]


def _read(box: Any) -> dict[str, Any]:
    for _ in range(ATTEMPTS):
        if (words := box.get()) is not None:
            try:
                return dict(json.loads(np.asarray(words).tobytes()))
            except ValueError:  # cut off
                return {}
    return {}
