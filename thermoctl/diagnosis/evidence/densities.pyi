"""Types of densities.pyx. Every array is contiguous float64."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE: int
SLOW: int
REMAINDER: int

class Spot:
    log_density: float
    x: Array
    variance: Array
    slope: Array
    uphill: Array
    curvature: Array

class Density:
    kind: int
    size: int
    def __init__(
        self,
        kind: int,
        count: Array,
        shape: Array,
        turn: Array,
        scales: Array,
        variance: float,
        clock: float,
        small: float,
        spread: float,
        slow: Array,
        diagonal: Array,
        beside: Array,
        starts: Array,
        spectra: Array,
    ) -> None: ...
    def start(self, power: Array) -> Array: ...
    def at(self, x: Array, power: Array) -> Spot: ...
    def top(self, power: Array, near: Array | None = None) -> tuple[Spot, Array]: ...
