"""Levenberg-Marquardt steps inside bounds to the maximum of a height: a log density, or minus half a cost.

    (H + l D) v = g,    (H + l D) a = J' d2r/dh2 along v,    z <- z + v + a/2,    D = diag H
    g: the height's gradient,  H: minus its second derivative (Gauss-Newton),  r: residuals,  J = -dr/dz

The damping l is lowered after a good step and raised after a failure. The valleys of a misfit are curved,
and a straight step leaves them. So half the geodesic acceleration a is added (Transtrum & Sethna 2012,
arXiv:1201.5885). A coordinate that meets its bound is held there until the gradient leads back inside. A
climb ends where a step without damping promises less than a limit. A small gain of a damped step does not
end it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from thermoctl.plant.simulation.simulate import SimulationError

FIRST, LEAST, MOST = 1e-3, 1e-9, 1e8  # first, least and largest damping
# Factor on the damping after a step that gains half of its promise, and after a failure. Steps along a curved
# valley are long only with little damping: 28 slow climbs of twelve bodies took 539 steps at 0.2, 292 at 0.04
# and 250 at 0.01.
EASED, RAISED = 0.02, 8.0
TRIES = 12  # largest number of dampings that are tried for one step
STRAIGHT = 0.75  # after a step that gains this share of its promise, the next one is not bent
CURVED = 0.75  # largest acceleration, as a share of the step
SLOW = 20.0  # a step is slow if more than this many such steps are needed
SLOW_STEPS = 3  # end after so many slow steps in a row
INSIDE = 1e-9  # least share of the gradient that is not a rounding error, for a slope at a bound

T = TypeVar("T")


@dataclass(frozen=True)
class Spot(Generic[T]):
    """Where a climb stands: the unknowns z (n,), the height there, and what the hill computed beside it."""

    z: np.ndarray
    height: float
    found: T


class Hill(Protocol[T]):
    """A height over unknowns between `bounds`. Its methods raise SimulationError."""

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and largest value of each unknown."""

    @property
    def few(self) -> bool:
        """Is one evaluation with slopes cheaper than one without, followed by one with them?"""

    def look(self, z: np.ndarray, slopes: bool) -> Spot[T]:
        """Return the height at z; with `slopes` the derivatives by z are computed, too."""

    def stand(self, spot: Spot[T]) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient (n,) and H (n, n) at a spot. Its slopes stay until the next call."""

    def bend(self, spot: Spot[T], step: np.ndarray) -> np.ndarray:
        """Return J' d2r/dh2 (n,) along a step from the climb's spot; zeros where it is not known."""


@dataclass(frozen=True)
class Climbed(Generic[T]):
    """The end of a climb, with gradient and H there, and the number of steps.

    `left`: the height that another step promised; `converged`: not ended by a limit."""

    spot: Spot[T]
    gradient: np.ndarray
    matrix: np.ndarray
    steps: int
    left: float
    converged: bool


def climb(
    hill: Hill[T],
    z: np.ndarray,
    steps: int,
    enough: Callable[[float], float],
    goal: float = -np.inf,
    deadline: float = np.inf,
) -> Climbed[T]:
    """Climb from z until a step promises less than `enough` at that height.

    `steps`: largest number; `goal`: a height to stay in reach; `deadline`: by this thread's clock, s.
    Raises SimulationError if the start cannot be simulated."""
    spot = hill.look(np.clip(z, *hill.bounds), True)
    gradient, matrix = hill.stand(spot)
    damping, curved, slow, done = FIRST, False, 0, 0
    while True:
        step, _ = bounded_step(spot.z, gradient, matrix, 0.0, hill.bounds)
        left, least = _promise(gradient, matrix, step), enough(spot.height)
        if left < least or slow >= SLOW_STEPS:
            return Climbed(spot, gradient, matrix, done, left, left < least or spot.height >= goal)
        if done >= steps or time.thread_time() > deadline:
            return Climbed(spot, gradient, matrix, done, left, False)
        higher = _higher(hill, spot, gradient, matrix, damping, curved, 1e-3 * least)
        if higher is None:
            return Climbed(spot, gradient, matrix, done, left, True)
        then, damping, curved = higher
        slow = slow + 1 if SLOW * (then.height - spot.height) < max(goal - spot.height, least) else 0
        spot, done = then, done + 1
        gradient, matrix = hill.stand(spot)


def _higher(
    hill: Hill[T],
    spot: Spot[T],
    gradient: np.ndarray,
    matrix: np.ndarray,
    damping: float,
    curved: bool,
    least: float,
) -> tuple[Spot[T], float, bool] | None:
    """Return a higher spot, the next damping, and whether the way there was curved.

    None if a step that promises `least` is not there."""
    for tries in range(TRIES):
        step, free = bounded_step(spot.z, gradient, matrix, damping, hill.bounds)
        promise = _promise(gradient, matrix, step)
        try:
            bend = _bend(hill, spot, step, matrix, damping, free) if curved else 0.0
            then = hill.look(np.clip(spot.z + step + bend, *hill.bounds), hill.few and not tries)
            gain = then.height - spot.height
        except SimulationError:
            gain = -np.inf
        curved = gain < STRAIGHT * promise
        if gain > 0:
            return then, max(damping * (EASED if 2 * gain > promise else 1.0), LEAST), curved
        if promise < least:
            return None
        damping = min(damping * RAISED, MOST)
    return None


def _promise(gradient: np.ndarray, matrix: np.ndarray, step: np.ndarray) -> float:
    return float(gradient @ step - 0.5 * step @ matrix @ step)


def bounded_step(
    z: np.ndarray,
    gradient: np.ndarray,
    matrix: np.ndarray,
    damping: float,
    bounds: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the step inside the bounds that promises most, and the indices of the unknowns not held at one.

    It solves a quadratic program by its active set: from one point to the next the promise rises. An unknown
    that meets its bound is held there; it is let go where the slope leads back inside."""
    low, high = bounds[0] - z, bounds[1] - z
    h = matrix + max(damping, LEAST) * np.diag(np.diag(matrix))
    step = np.zeros_like(z)
    free = ~(((low >= 0) & (gradient < 0)) | ((high <= 0) & (gradient > 0)))
    for _ in range(4 * len(z)):
        inside = np.flatnonzero(free)
        slope = gradient - h @ step
        way = np.linalg.solve(h[np.ix_(inside, inside)], slope[inside])
        room = np.where(way > 0, high[inside] - step[inside], low[inside] - step[inside])
        share = np.where(np.abs(way) > np.abs(room), room / np.where(way == 0, 1.0, way), 1.0)
        if share.min(initial=1.0) < 1:
            first = int(np.argmin(share))
            step[inside] += max(share[first], 0.0) * way
            step[inside[first]] = (high if way[first] > 0 else low)[inside[first]]
            free[inside[first]] = False
            continue
        step[inside] += way
        slope = gradient - h @ step
        back = np.where(step >= high, -slope, slope)  # towards the inside
        held = np.flatnonzero(~free & (back > INSIDE * np.abs(gradient)) & (low < high))
        if not len(held):
            break
        free[held[np.argmax(back[held])]] = True
    return step, np.flatnonzero(free)


def _bend(
    hill: Hill[T], spot: Spot[T], step: np.ndarray, matrix: np.ndarray, damping: float, free: np.ndarray
) -> np.ndarray:
    """Return half the acceleration of the unknowns `free`; zeros if it is not small beside the step."""
    out = np.zeros_like(step)
    if len(free):
        part = matrix[np.ix_(free, free)]
        weight = np.diag(part)
        out[free] = 0.5 * np.linalg.solve(part + damping * np.diag(weight), hill.bend(spot, step)[free])
        with np.errstate(over="ignore"):
            small = weight @ out[free] ** 2 <= (0.5 * CURVED) ** 2 * (weight @ step[free] ** 2)
        if not small:
            return np.zeros_like(step)
    return out
