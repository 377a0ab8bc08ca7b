"""Does the model of the daemon still fit its rig? The coil's innovations, watched without end.

    z_k = mean of the innovation over BLOCK_S / (S / sqrt(n)),   S^2 = R_v / (1 - C K) the variance that the filter expects (35),
    n independent samples in the block;                          CUSUM (Page 1954): g = max(0, g + |z| side - DRIFT) > LIMIT

Where the model holds, z is about standard normal and the sum falls back to zero; where it does not, both the alarm and the
onset (the sum's last zero) come out. The sum runs on both sides.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoctl.control.model import CompensatorModel

BLOCK_S = 20.0          # of innovations in one value
DRIFT = 1.0             # a lasting shift of two standard errors of a block is what the sum is tuned to
LIMIT = 15.0
CLIP = 4.0              # no single block decides
CORRELATED = 4.0        # quantisation correlates neighbours: so many samples count as one


@dataclass(frozen=True)
class Alarm:
    """The model does not fit from `begin_s` to `end_s`; `mean_c`: the mean innovation there, K."""
    begin_s: float
    end_s: float
    mean_c: float


class Misfit:
    """Feed it rows in order: `add(t_s, innovation_c, kalman_gain)` returns an alarm when one is new."""

    def __init__(self, model: CompensatorModel):
        self._gain, self._noise = float(model.C[0] @ model.gain[:, 0]), math.sqrt(model.R_v)
        self.restart()

    def restart(self) -> None:
        """Forget what was seen: another model, or a clock that began again."""
        self._t: list[float] = []
        self._values: list[float] = []
        self.sums = [0.0, 0.0]
        self._since = [0.0, 0.0]
        self._seen: list[list[float]] = [[], []]
        self.alarmed = False

    def add(self, t_s: np.ndarray, innovation_c: np.ndarray, kalman_gain: np.ndarray) -> Alarm | None:
        """Rows (n,) of each; NaN innovations (no sample yet) are left out."""
        found = None
        for t, e, k in zip(t_s.tolist(), innovation_c.tolist(), kalman_gain.tolist(), strict=True):
            if self._t and t < self._t[-1]:
                self.restart()
            if not math.isfinite(e) or (self._values and e == self._values[-1]):
                continue            # the signal holds between samples of the sensor
            self._t.append(t)
            self._values.append(e)
            if t - self._t[0] >= BLOCK_S:
                share = self._gain * k
                found = self._block(self._noise / math.sqrt(1.0 - share) if 0.0 <= share < 1.0 else self._noise) or found
        return found

    def _block(self, sigma: float) -> Alarm | None:
        mean, n = float(np.mean(self._values)), max(1.0, len(self._values) / CORRELATED)
        begin, end = self._t[0], self._t[-1]
        self._t, self._values = [], []
        z = max(-CLIP, min(CLIP, mean / (sigma / math.sqrt(n))))
        found = None
        for side, sign in enumerate((1.0, -1.0)):
            if self.sums[side] == 0.0:
                self._since[side], self._seen[side] = begin, []
            self.sums[side] = max(0.0, self.sums[side] + sign * z - DRIFT)
            self._seen[side].append(mean)
            if self.sums[side] > LIMIT:
                found = Alarm(self._since[side], end, float(np.mean(self._seen[side])))
                self.sums[side] = LIMIT         # so that it falls back soon after the model fits again
        new = found is not None and not self.alarmed
        if found is not None:
            self.alarmed = True
        elif max(self.sums) == 0.0:
            self.alarmed = False
        return found if new else None
