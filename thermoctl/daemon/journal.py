"""The watcher that logs for the loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from thermoctl.control import arming, faults
from thermoctl.daemon.answers import readings
from thermoctl.daemon.answers.display import LATE_REMEDY
from thermoctl.daemon.tick.shared import Shared
from thermoctl.rig.signals import AT, fault_words

TELL_AGAIN_S = 10.0  # an intermittent fault is logged at most once in this time
Log = Callable[..., None]


class Watcher:
    """Logs changes of state, faults and the devices' messages: the loop itself logs nothing.

    Faults are logged with their cause first. While the law warms up (OFF) nothing is a fault."""

    def __init__(self, shared: Shared, log: Log):
        self.shared, self.log = shared, log
        self.position, self.before = 0, (arming.OFF, 0)
        self.told: dict[str, float] = {}
        self.changes = [0] * len(shared.channels.names)
        self.code: Any = None

    def look(self) -> None:
        """Log what is new in the ring."""
        rows, self.position, _ = self.shared.ring.read(self.position)
        if not len(rows):
            return
        self._devices(rows[-1])
        states = rows[:, AT["state"]].astype(np.uint64)
        pairs = np.column_stack((states, np.where(states == arming.OFF, np.uint64(0), fault_words(rows))))
        known = np.vstack((np.array([self.before], np.uint64), pairs))
        changed = np.flatnonzero((known[1:] != known[:-1]).any(axis=1))
        new = 0
        for k in changed[:20]:
            state, bits = pairs[k]
            before_state, before_bits = self.before if k == 0 else pairs[k - 1]
            if state != before_state:
                self.log(
                    "state",
                    tick=int(rows[k, AT["tick"]]),
                    t_s=round(float(rows[k, AT["t_s"]]), 3),
                    was=arming.STATES[int(before_state)],
                    now=arming.STATES[int(state)],
                )
                self.told.clear()
            new |= int(bits) & ~int(before_bits)
        self.before = (int(pairs[-1, 0]), int(pairs[-1, 1]))
        if new:
            self._faults(rows[-1], new)

    def _faults(self, row: np.ndarray, new: int) -> None:
        """Log the faults of `new`, causes first, including those that have cleared by now."""
        for f in readings.standing_faults(self.shared, row, readings.readings(self.shared, row), new):
            name = f["name"]
            if not new >> faults.BIT[name] & 1 or f["t_s"] - self.told.get(name, -np.inf) < TELL_AGAIN_S:
                continue
            self.told[name] = f["t_s"]
            if f["late_first"]:
                self.log("late", ms=round(f["late_s"] * 1e3), before=name, remedy=LATE_REMEDY)
            self.log(
                f["severity"],
                tick=f["tick"],
                t_s=round(f["t_s"], 3),
                name=name,
                follows=f["follows"] or None,
                device="; ".join(f["messages"]) or None,
                meaning=f["meaning"],
                remedy=None if f["follows"] else f["remedy"],
            )

    def _devices(self, row: np.ndarray) -> None:
        """Log new messages of the devices, and the drive's error code.

        A channel is logged again only after TELL_AGAIN_S."""
        if row[AT["state"]] == arming.OFF:
            return
        for c, role in enumerate(self.shared.channels.names):
            said = self.shared.remarks.get(c)
            if said is None or said[0] == self.changes[c]:
                continue
            self.changes[c] = said[0]
            if said[1] - self.told.get(role, -np.inf) >= TELL_AGAIN_S:
                self.told[role] = said[1]
                self.log("device", role=role, t_s=round(said[1], 3), message=said[2])
        code = readings.drive_code(self.shared, row)
        numbers = self.shared.areas["remark_numbers"][1:].tolist()
        if code is not None and numbers != self.code:
            self.code = numbers
            self.log("device", role="amplifier_fault", message=f"the drive reports {code['text']}")
