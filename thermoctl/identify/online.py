"""Tuning the expansion model while a reference encoder is present.

Nothing is proposed before the rig has covered its range. Samples are counted in buckets of coil temperature
and of its trend (warming, cooling); progress is the share of full buckets. A bank of output-error estimators
learns from all but the newest samples (`hold_s`). Its proposal is accepted only if it predicts those better.

Static gains stay within bounds of the calibrated ones, also after many tunings, because a tuned model carries
the gains of its first calibration. Every change is a calibration (`modelfile.install`), so it can be rolled
back.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from thermoctl.control.model import CompensatorModel
from thermoctl.identify.expansion import Bank, Expansion


class Tuner:
    """Feed `update` with estimated rises and the reference; ask `progress` and `proposal`.

    - buckets: edges of the buckets, coil temperature rises in K; `full` samples fill one
    - `clip`: largest change of each gain, as a share of the largest calibrated gain
    - `hold_s`: seconds of newest samples that are the test"""

    def __init__(
        self,
        model: CompensatorModel,
        buckets_k: tuple[float, ...] = (0.5, 2.0, 4.0, 6.0, 9.0),
        full: int = 300,
        clip: float = 0.3,
        hold_s: float = 3600.0,
    ):
        self.model, self.full, self.clip = model, full, clip
        self.edges = np.array(buckets_k)
        self.counts = np.zeros((2, len(buckets_k) - 1))
        period_s = model.expansion_period_s
        self.bank = Bank(len(model.b1), period_s, tau_range_s=(2 * period_s, 2000 * period_s))
        self.recent: deque[tuple[np.ndarray, float]] = deque()
        self.hold = max(60, round(hold_s / model.expansion_period_s))
        self.last_coil: float | None = None
        self.slow = 0.0

    def update(self, rises_k: np.ndarray, error_um: float, air_k: float = 0.0) -> None:
        """One sample at the expansion model's period.

        Arguments: estimated rises (points,), the measured position error (NaN: no reference), and the
        rise of the air since the start. Bodies expand with their absolute temperature, hence the air."""
        coil = float(rises_k[0])
        if self.last_coil is not None:
            self.slow += 0.02 * ((coil - self.last_coil) - self.slow)
        self.last_coil = coil
        k = int(np.searchsorted(self.edges, coil)) - 1
        if np.isfinite(error_um) and 0 <= k < self.counts.shape[1]:
            self.counts[int(self.slow < 0), k] += 1
        self.recent.append((rises_k + air_k, error_um))
        if len(self.recent) > self.hold:
            old, error = self.recent.popleft()
            self.bank.update(old, error)

    @property
    def progress(self) -> float:
        """Return the percentage of the required excitation."""
        return float(100 * np.minimum(self.counts / self.full, 1).mean())

    def proposal(self) -> tuple[CompensatorModel | None, str]:
        """Return (tuned model, reason); no model if samples are missing or it is not 5 % better."""
        if self.progress < 100:
            return (
                None,
                f"excitation {self.progress:.0f} %: warm up and cool down through {self.edges[0]:g} to {self.edges[-1]:g} K",
            )
        if self.bank.samples < self.hold:
            return (
                None,
                f"{self.bank.samples} samples before those kept back to judge by; {self.hold} are needed",
            )
        gains = calibrated_gains(self.model)
        width = self.clip * max(np.abs(gains).max(), 1e-12)
        new = self.bank.bounded(gains - width, gains + width)
        before, after = self.error_um(self.model), self._error(new)
        if not after <= 0.95 * before:
            return None, f"no better: {after:.3g} um against {before:.3g} um with the calibrated model"
        return replace(
            self.model,
            f1=new.f1,
            b1=new.b1,
            b2=new.b2,
            b_air=float((new.b1 + new.b2).sum()) if self.model.b_air else 0.0,
            meta={
                **self.model.meta,
                "tuned_online": True,
                "calibrated_gains_um_k": calibrated_gains(self.model).tolist(),
            },
        ), f"{after:.3g} um against {before:.3g} um"

    def error_um(self, model: CompensatorModel) -> float:
        """Return the standard error of a model over the newest samples, um."""
        return self._error(Expansion(model.f1, model.b1, model.b2, model.expansion_period_s))

    def _error(self, e: Expansion) -> float:
        """Return the standard error over the held-out samples, um; initial state and offset are fitted."""
        drive = np.array([r for r, _ in self.recent])
        y = np.array([v for _, v in self.recent])
        n = np.arange(len(y))
        here = np.isfinite(y)
        if here.sum() < 60:
            return float("nan")
        free = np.column_stack([np.ones(len(y)), e.f1**n])
        left = (y - e.predict(drive))[here]
        return float(np.std(left - free[here] @ np.linalg.lstsq(free[here], left, rcond=None)[0]))


def calibrated_gains(model: CompensatorModel) -> np.ndarray:
    """Return the static gains (points,) um/K of the calibration that a model came from, before any tuning."""
    stored = model.meta.get("calibrated_gains_um_k")
    return np.array(stored, dtype=float) if stored is not None else (model.b1 + model.b2) / (1 - model.f1)
