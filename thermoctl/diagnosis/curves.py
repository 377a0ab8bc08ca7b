"""Measured and simulated outputs of a diagnosis, and how well each simulation fits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Excitation


@dataclass(frozen=True)
class Curve:
    """One output in one recording: `t` s and `y` (N,), NaN where not measured.

    `errors`: measured minus simulated (N,) of the plants `before` (as given), `refit_only` and `after` (with
    the findings). `held_out`: the simulations were not fitted to these readings."""

    recording: str
    output: str
    unit: str | None
    held_out: bool
    t: np.ndarray
    y: np.ndarray
    errors: Mapping[str, np.ndarray]

    def rms(self, key: str) -> float | None:
        """Return the root-mean-square error of a simulation; None where there is none."""
        e = self.errors.get(key, np.full(1, np.nan))
        return float(np.sqrt(np.nanmean(e**2))) if np.isfinite(e).any() else None

    def fit_percent(self, key: str) -> float | None:
        """Return 100 (1 - |error| / |y - its mean|), as MATLAB's `compare` has it; None for a constant."""
        if self.rms(key) is None:
            return None
        e = self.errors[key]
        y = self.y[np.isfinite(e)]
        spread = float(np.linalg.norm(y - y.mean()))
        return 100 * (1 - float(np.sqrt(np.nansum(e**2))) / spread) if spread > 0 else None

    def entry(self) -> dict[str, Any]:
        """Return the fits as `recordings` of a result lists them."""
        return {
            "recording": self.recording,
            "output": self.output,
            "held_out": self.held_out,
            "rms": {k: self.rms(k) for k in self.errors},
            "fit_percent": {k: self.fit_percent(k) for k in self.errors},
        }


def curves_of(
    plant: Plant, drives: Sequence[Excitation], errors: Mapping[str, Sequence[np.ndarray]], held_out: bool
) -> Iterator[Curve]:
    """Yield a curve for each measured output of each recording, with the errors that are known."""
    given = {k: e for k, e in errors.items() if len(e)}
    for r, d in enumerate(drives):
        for j, o in enumerate(plant.outputs.values()):
            seen = np.isfinite(d.y[:, j])  # an outlier has an error, too
            measured = {k: np.where(seen, e[r][:, j], np.nan) for k, e in given.items()}
            own = {k: e for k, e in measured.items() if np.isfinite(e).any()}
            if own:
                yield Curve(d.name, o.name, o.unit, held_out, d.t, d.y[:, j], own)
