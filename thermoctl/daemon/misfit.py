"""Detect that the daemon's model no longer fits its rig, by a CUSUM (Page 1954) of the coil's innovations.

    z_k = mean of the innovation over BLOCK_S / (S / sqrt(n)),  n independent samples in the block
    S^2 = R_v / (1 - C K), the variance that the filter expects (35)
    g   = max(0, g +- z - DRIFT);  alarm when g > LIMIT; both signs

While the model fits, z is about standard normal and the sums fall back to zero. When it does not, the sum
gives the alarm, and its last zero the onset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoctl.control.model import CompensatorModel

BLOCK_S = 20.0  # duration of the innovations averaged to one z
DRIFT = 1.0  # half of the shift to detect, which is two standard errors of a block
LIMIT = 15.0
CLIP = 4.0  # limit of |z|, so that no single block raises an alarm
CORRELATED = 4.0  # neighbouring samples that count as one independent one: quantisation correlates them


@dataclass(frozen=True)
class Alarm:
    """The model did not fit from `begin_s` to `end_s`; `mean_c`: the mean innovation then, K."""

    begin_s: float
    end_s: float
    mean_c: float


class Misfit:
    """Detects a lasting bias of the innovations by a CUSUM on both sides.

    Pass rows in order: `add(t_s, innovation_c, kalman_gain)` returns an alarm when one is new. The
    division into calls has no influence. A model without a coil temperature has no innovations and never
    raises an alarm."""

    def __init__(self, model: CompensatorModel):
        self._gain, self._noise = float(model.C[0] @ model.gain[:, 0]), math.sqrt(model.R_v)
        self._watches = bool(model.C[0].any())
        self.restart()

    def restart(self) -> None:
        """Reset the sums: after a change of the model, or when the clock starts again."""
        self._rows = np.empty((3, 0))  # t, innovation and gain of the rows of the incomplete block
        self._last_t, self._last_c = -math.inf, math.nan
        self.sums = [0.0, 0.0]
        # since each sum was zero: start time, total, number of blocks
        self._since, self._total, self._blocks = [0.0, 0.0], [0.0, 0.0], [0, 0]
        self.alarmed = False

    def add(self, t_s: np.ndarray, innovation_c: np.ndarray, kalman_gain: np.ndarray) -> Alarm | None:
        """Add rows (n,) of each signal; return the newest alarm that they raise.

        NaN innovations (no sample yet) are left out."""
        rows = np.array([t_s, innovation_c, kalman_gain])[:, np.isfinite(t_s) & np.isfinite(innovation_c)]
        alarm = None
        if not self._watches or not rows.shape[1]:
            return alarm
        begins = np.flatnonzero(np.diff(rows[0], prepend=self._last_t) < 0.0)  # the clock restarted
        for k, part in enumerate(np.split(rows, begins, axis=1)):
            if k > 0:
                self.restart()
            alarm = self._add(part) or alarm
        return alarm

    def _add(self, rows: np.ndarray) -> Alarm | None:
        alarm = None
        if not rows.shape[1]:
            return alarm
        # The signal holds between samples of the sensor.
        changed = np.diff(rows[1], prepend=self._last_c) != 0.0
        self._last_t, self._last_c = rows[0, -1], rows[1, -1]
        if not changed.any():
            return alarm
        rows = np.hstack((self._rows, rows[:, changed]))
        while rows.shape[1] and rows[0, -1] >= rows[0, 0] + BLOCK_S:
            size = int(np.searchsorted(rows[0], rows[0, 0] + BLOCK_S)) + 1
            alarm = self._block(rows[:, :size]) or alarm
            rows = rows[:, size:]
        self._rows = rows
        return alarm

    def _block(self, rows: np.ndarray) -> Alarm | None:
        share = self._gain * rows[2, -1]
        sigma = self._noise / math.sqrt(1.0 - share) if 0.0 <= share < 1.0 else self._noise
        mean, n = float(rows[1].mean()), max(1.0, rows.shape[1] / CORRELATED)
        z = max(-CLIP, min(CLIP, mean / (sigma / math.sqrt(n))))
        alarm = None
        for side, sign in enumerate((1.0, -1.0)):
            if self.sums[side] == 0.0:
                self._since[side], self._total[side], self._blocks[side] = float(rows[0, 0]), 0.0, 0
            self.sums[side] = max(0.0, self.sums[side] + sign * z - DRIFT)
            self._total[side] += mean
            self._blocks[side] += 1
            if self.sums[side] > LIMIT:
                alarm = Alarm(self._since[side], float(rows[0, -1]), self._total[side] / self._blocks[side])
                # the sum stops at the limit, so that it soon falls below it when the model fits again
                self.sums[side] = LIMIT
        new = alarm is not None and not self.alarmed
        if alarm is not None:
            self.alarmed = True
        elif max(self.sums) == 0.0:
            self.alarmed = False
        return alarm if new else None
