"""Whitened rows of a refitted hypothesis, and the directions that its own parameters absorb."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.plant.refit import Fit
from thermoctl.plant.simulate import Excitation, Model, Simulation

ABSENT = 1e-6  # share of a sensitivity, below which others imitate it


@dataclass(frozen=True)
class Pushed:
    """First-order changes by columns in one recording: forces (`Model.respond`), and changes of outputs.

    `forces`: (state, column), with values q (N, forces); `read`: (output, column), with values (N,)."""

    forces: list[tuple[int, int]]
    q: np.ndarray
    read: dict[tuple[int, int], np.ndarray]


class Metric:
    """Whitened rows of a refitted hypothesis, as the screening needs them; a subclass fills them.

    - `weight` (rows,): factor of each row that whitens it
    - `residual` (rows,): the residual, without what the plant's own parameters absorb
    - `own`: of each recording, orthonormal (rows, k): the directions that its own unknowns absorb
    - `basis` (rows, k): orthonormal; the directions that the other parameters absorb besides"""

    fit: Fit
    model: Model
    drives: list[Excitation]
    runs: list[Simulation]
    weight: np.ndarray
    residual: np.ndarray
    own: list[np.ndarray]
    basis: np.ndarray

    def unweighted(self, r: int, e: np.ndarray) -> np.ndarray:
        """Transform samples (N, outputs, ...) of recording r to rows (rows, ...) that are not whitened."""
        raise NotImplementedError

    def responses(self, pushed: Callable[[int], Pushed], count: int) -> np.ndarray:
        """Return the rows (rows, count), not whitened, of the responses in all recordings.

        `pushed`: of a recording."""
        raise NotImplementedError

    def spread(self, r: int, w: np.ndarray) -> np.ndarray:
        """Return (N, outputs, k): the transpose of `unweighted`, of all rows (rows, k), for recording r."""
        raise NotImplementedError

    def project(self, d: np.ndarray) -> np.ndarray:
        """Return directions (rows, k) without the part that the plant's own parameters absorb."""
        d = without(self.own, d)
        return d - self.basis @ (self.basis.T @ d)


def without(own: Sequence[np.ndarray], d: np.ndarray) -> np.ndarray:
    """Return rows (rows, ...) of all recordings without what each one's orthonormal basis spans."""
    parts = np.split(d, np.cumsum([len(q) for q in own])[:-1])
    return np.concatenate([x - q @ (q.T @ x) for q, x in zip(own, parts, strict=True)])


def span(columns: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (rows, k) of columns; parts below ABSENT of their `size` are left out."""
    there = size > 0
    u, s, _ = np.linalg.svd(columns[:, there] / size[there], full_matrices=False)
    return u[:, s > ABSENT]
