"""Whitened rows of a refitted hypothesis, and the part of them that its own unknowns absorb.

Unknowns with a Gaussian prior of covariance P and sensitivities J add J P J' to the rows' covariance. Let
J sqrt(P) be U s W'. Multiplying by the inverse root of that covariance removes the share
1 - 1 / sqrt(1 + s^2) of each direction of U. That is nearly all where the data determine the unknowns, and
little where the prior does. Below, this is called the projection."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermoctl.diagnosis.evidence.where import signals
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.simulation.simulate import Excitation, Model, Simulation


@dataclass(frozen=True)
class Pushed:
    """First-order changes that columns cause in one recording.

    - `forces`: (state, column) of each change of a slope dx/dt, with values q (N, forces) (`Model.respond`)
    - `read`: (output, column) of each direct change of an output, with values (N,)"""

    forces: list[tuple[int, int]]
    q: np.ndarray
    read: dict[tuple[int, int], np.ndarray]


class Metric:
    """Whitened rows of a refitted hypothesis, as the screening needs them; a subclass fills them.

    - `weight` (rows,): the factor that whitens each row
    - `residual` (rows,): after projection, with initial states at the means of their priors
    - `own`: by recording, the directions that its own unknowns absorb (its initial states)
    - `shared`: the further directions that the unknowns common to all recordings absorb"""

    fit: Fit
    model: Model
    drives: list[Excitation]
    runs: list[Simulation]
    weight: np.ndarray
    residual: np.ndarray
    own: list[Absorbed]
    shared: Absorbed

    @cached_property
    def signals(self) -> list[dict[str, np.ndarray | float]]:
        """Return by recording every name of the plant with its value or its values (N,) along the run."""
        runs = zip(self.drives, self.fit.values, self.runs, strict=True)
        return [signals(self.model, d, values, run.x) for d, values, run in runs]

    def unweighted(self, r: int, e: np.ndarray) -> np.ndarray:
        """Transform samples (N, outputs, ...) of recording r to rows (rows, ...) that are not whitened."""
        raise NotImplementedError

    def responses(self, pushed: Callable[[int], Pushed], count: int) -> np.ndarray:
        """Return the rows (rows, count), not whitened, of the responses in all recordings.

        `pushed`: returns the first-order changes in recording r. `count`: number of columns."""
        raise NotImplementedError

    def spread(self, r: int, w: np.ndarray) -> np.ndarray:
        """Apply the transpose of `unweighted` to rows w (rows, k): return (N, outputs, k) of recording r."""
        raise NotImplementedError

    def project(self, d: np.ndarray) -> np.ndarray:
        """Return directions (rows, ...) without the part that the plant's own unknowns absorb."""
        return self.shared.without(without(self.own, d))

    def pulled(self, w: np.ndarray) -> np.ndarray:
        """Return the transpose of `project`, applied to rows w (rows, ...): w' project(d) = pulled(w)' d."""
        return without(self.own, self.shared.without(w))


@dataclass(frozen=True)
class Absorbed:
    """Orthonormal directions (rows, k), and the share (k,) of each that unknowns absorb."""

    directions: np.ndarray
    share: np.ndarray

    @classmethod
    def by(cls, columns: np.ndarray) -> Absorbed:
        """Return the directions that unknowns absorb.

        `columns` (rows, k): changes by independent prior deviations."""
        u, s, _ = np.linalg.svd(columns, full_matrices=False)
        return cls(u, 1 - 1 / np.sqrt(1 + s**2))

    def without(self, x: np.ndarray) -> np.ndarray:
        """Return rows (rows, ...) less the absorbed share of each direction."""
        return x - (self.directions * self.share) @ (self.directions.T @ x)


def without(own: Sequence[Absorbed], d: np.ndarray) -> np.ndarray:
    """Return rows (rows, ...) of all recordings without the part that each one's own unknowns absorb."""
    parts = np.split(d, np.cumsum([len(q.directions) for q in own])[:-1])
    return np.concatenate([q.without(x) for q, x in zip(own, parts, strict=True)])
