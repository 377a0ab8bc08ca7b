"""The directions that a later screening simulates, chosen by the responses of the first one.

Beside a hypothesis whose residual is only noise, a plant moves nearly as it did without effects. So each
direction changes the outputs nearly as before. Its gain follows from the rows of the first screening and
from the present residual and metric. Only the directions with the largest gains are simulated again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from thermoctl.diagnosis.search.gains import Column, Direction, scores
from thermoctl.diagnosis.search.metric import Metric
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import Group, chunks, projected
from thermoctl.diagnosis.search.sketch import foremost_groups

# None of these numbers chooses a hypothesis: directions that are kept are screened exactly.
KEPT = 288  # columns that are simulated again, at most
LIKE = 0.1  # largest change of an output, over its swing, for which the plant moves as before
CHUNK = 480  # columns whose rows are whitened together


@dataclass
class Known:
    """The rows of the first screening, and the outputs of its plant.

    `place`: of a group's first column; `rows` of unit length (rows, k) and their `sizes` (k,), by chunk;
    `outputs` by recording."""

    outputs: list[np.ndarray] = field(default_factory=list)
    place: dict[tuple[Any, ...], int] = field(default_factory=dict)
    rows: list[np.ndarray] = field(default_factory=list)
    sizes: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def add(self, groups: Sequence[Sequence[Column]], rows: np.ndarray) -> None:
        """Add groups of columns and their rows (rows, k), not whitened."""
        size = np.linalg.norm(rows, axis=0)
        self.rows.append((rows / np.where(size > 0, size, 1.0)).astype(np.float16))
        self.sizes.append(size)
        for columns in groups:
            self.place.setdefault(_name(columns[0].candidate, columns[0].group), self.count)
            self.count += len(columns)

    def like(self, metric: Metric) -> bool:
        """Return whether the plant's outputs are nearly those of the first screening."""
        return len(self.outputs) == len(metric.runs) and all(
            (np.sqrt(np.mean((run.y - y) ** 2, axis=0)) <= LIKE * np.std(y, axis=0)).all()
            for run, y in zip(metric.runs, self.outputs, strict=True)
        )

    def likeliest(
        self, metrics: Sequence[Metric], at: Sequence[Trajectory], groups: list[Group]
    ) -> list[Group]:
        """Return unknown groups, and the best group of each likely candidate: up to KEPT columns."""
        (metric,) = metrics
        flat, sizes = np.concatenate(self.rows, axis=1), np.concatenate(self.sizes)
        found: list[Direction | None] = []
        known = [g for g in groups if self._columns(g) is not None]
        for part in chunks(known, lambda g: len(g.sizes), CHUNK):
            ks = [k for g in part for k in self._columns(g) or ()]
            full, rows = projected(metric, flat[:, ks].astype(float) * sizes[ks])
            found += scores([list(g.columns()) for g in part], rows, metric.residual @ rows, full)
        kept = foremost_groups(known, found, KEPT)
        return [g for g in groups if self._columns(g) is None] + [known[i] for i in sorted(kept)]

    def _columns(self, g: Group) -> range | None:
        """Return the positions of a group's columns; None if they are not known."""
        first = self.place.get(_name(g.candidate, g.number))
        return None if first is None else range(first, first + len(g.sizes))


def _name(candidate: Any, number: Any) -> tuple[Any, ...]:
    return candidate.key, candidate.label, number
