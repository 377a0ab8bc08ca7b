"""Tuning the expansion model while a reference encoder is present.

Nothing is learnt before the rig has moved through what it shall be good for: samples are counted in buckets of coil temperature and of its
trend (warming, cooling); progress is the part of the buckets that are full. The bank of output-error estimators gives a proposal; its
static gains are clipped round the calibrated ones, and it is taken only where it explains a held-out hour better. Every change is a
calibration of its own (`modelfile.install`), so it can be rolled back.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermoctl.control.model import CompensatorModel
from thermoctl.identify.expansion import Bank, Expansion


class Tuner:
    """Feed `update` with estimated rises and the reference; ask `progress` and `proposal`.

    buckets: coil temperature rises K between which samples are sought; `full` samples fill one; `clip` bounds the change of each gain as a
    part of the largest calibrated gain."""

    def __init__(self, model: CompensatorModel, buckets_k: tuple[float, ...] = (0.5, 2.0, 4.0, 6.0, 9.0), full: int = 300, clip: float = 0.3):
        self.model, self.full, self.clip = model, full, clip
        self.edges = np.array(buckets_k)
        self.counts = np.zeros((2, len(buckets_k) - 1))
        self.bank = Bank(len(model.b1), model.expansion_period_s)
        self.recent: list[tuple[np.ndarray, float]] = []
        self.last_coil: float | None = None
        self.slow = 0.0

    def update(self, rises_k: np.ndarray, error_um: float) -> None:
        """One sample at the expansion model's period: estimated rises (12,) and the measured position error (NaN: no reference)."""
        coil = float(rises_k[0])
        if self.last_coil is not None:
            self.slow += 0.02 * ((coil - self.last_coil) - self.slow)
        self.last_coil = coil
        k = int(np.searchsorted(self.edges, coil)) - 1
        if np.isfinite(error_um) and 0 <= k < self.counts.shape[1]:
            self.counts[int(self.slow < 0), k] += 1
        self.bank.update(rises_k[None], np.array([error_um]))
        self.recent = [*self.recent[-3599:], (rises_k.copy(), error_um)]

    @property
    def progress(self) -> float:
        """Percent of the excitation that is asked for."""
        return float(100 * np.minimum(self.counts / self.full, 1).mean())

    def proposal(self) -> tuple[CompensatorModel | None, str]:
        """(model, why): None with the reason while it is too early or no better. b_air keeps the sum of the gains it had."""
        if self.progress < 100:
            return None, f"excitation {self.progress:.0f} %: warm up and cool down through {self.edges[0]:g} to {self.edges[-1]:g} K"
        new = clipped(self.bank.model(), self.model, self.clip)
        now = Expansion(self.model.f1, self.model.b1, self.model.b2, self.model.expansion_period_s, 0.0, self.model.offset_um)
        before, after = self._error(now), self._error(new)
        if after > 0.95 * before:
            return None, f"no better: {after:.3g} um against {before:.3g} um with the calibrated model"
        scale = float((new.b1 + new.b2).sum() / max(abs((self.model.b1 + self.model.b2).sum()), 1e-12))
        sign = np.sign((self.model.b1 + self.model.b2).sum())
        return replace(self.model, f1=new.f1, b1=new.b1, b2=new.b2, b_air=self.model.b_air * scale * sign, offset_um=new.offset_um,
                       meta={**self.model.meta, "tuned_online": True}), f"{after:.3g} um against {before:.3g} um"

    def _error(self, e: Expansion) -> float:
        rises = np.array([r for r, _ in self.recent])
        y = np.array([v for _, v in self.recent])
        left = (y - e.predict(rises))[len(y) // 4:]                  # its own start forgotten
        return float(np.nanstd(left))


def clipped(new: Expansion, old: CompensatorModel, clip: float) -> Expansion:
    """`new` with each static gain within +-clip of the largest calibrated gain round the calibrated one. The two lags' gains are not
    told apart by slow temperatures (only their sum is), so the sum is clipped and given to T(n)."""
    old_gain = (old.b1 + old.b2) / (1 - old.f1)
    width = clip * max(np.abs(old_gain).max(), 1e-12)
    gain = np.clip((new.b1 + new.b2) / (1 - new.f1), old_gain - width, old_gain + width)
    return replace(new, b1=np.zeros_like(gain), b2=(1 - new.f1) * gain)
