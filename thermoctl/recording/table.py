"""A recording in memory: a time column and any number of signals.

The time is in seconds and strictly increasing; every other cell is a number or missing (NaN).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Table:
    """A recording: `t` (N,) float64 seconds as recorded, `columns` each (N,) float64, NaN where a sample is missing.

    `name` is the file's stem, `path` its path; `meta` holds what the file says about itself (configuration, model).
    """

    name: str
    path: str
    t: np.ndarray
    columns: dict[str, np.ndarray]
    meta: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)
