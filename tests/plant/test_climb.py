"""Steps inside bounds, and climbs to the maximum of a height: against scipy, in a curved valley, at a limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from thermoctl.plant.fitting.climb import Spot, bounded_step, climb
from thermoctl.plant.simulation.simulate import SimulationError


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 9), st.sampled_from([0.0, 0.3]))
def test_a_bounded_step_promises_as_much_as_any_inside_the_bounds(seed, n, damping):
    """Half of the unknowns start at a bound. The step was clipped one time: it could promise a fall, and stick."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((n + 3, n)) @ np.diag(10.0 ** rng.uniform(-2, 1, n))
    z, low, high = rng.uniform(0, 1, n), np.zeros(n), np.ones(n)
    z[rng.random(n) < 0.25] = 0.0
    z[rng.random(n) < 0.25] = 1.0
    gradient = rows.T @ rng.standard_normal(n + 3) * 3
    matrix = rows.T @ rows
    step, free = bounded_step(z, gradient, matrix, damping, (low, high))
    h = matrix + max(damping, 1e-9) * np.diag(np.diag(matrix))
    root = np.linalg.cholesky(h).T
    best = lsq_linear(root, np.linalg.solve(root.T, gradient), (low - z - 1e-15, high - z + 1e-15), "bvls").x

    def promise(s):
        return gradient @ s - 0.5 * s @ h @ s

    assert np.all((z + step >= low - 1e-12) & (z + step <= high + 1e-12))
    assert promise(step) == pytest.approx(promise(best), rel=1e-6, abs=1e-9)
    inside = np.setdiff1d(np.arange(n), np.flatnonzero((z + step <= low) | (z + step >= high)))
    assert set(inside) <= set(free)


class Valley:
    """Rosenbrock's valley in n unknowns as a log density; it cannot be simulated where the first is below `wall`."""

    few = True

    def __init__(self, n: int, high: float, steep: float = 30.0, wall: float = -np.inf):
        self.bounds = np.full(n, -2.0), np.full(n, high)
        self.steep, self.wall, self.looks = steep, wall, 0

    def residuals(self, z: np.ndarray) -> np.ndarray:
        return np.concatenate([self.steep * (z[1:] - z[:-1] ** 2), 1 - z[:-1]])

    def slopes(self, z: np.ndarray) -> np.ndarray:
        n = len(z) - 1
        out = np.zeros((2 * n, n + 1))
        out[np.arange(n), np.arange(1, n + 1)] = -self.steep
        out[np.arange(n), np.arange(n)] = 2 * self.steep * z[:-1]
        out[n + np.arange(n), np.arange(n)] = 1
        return out

    def look(self, z: np.ndarray, slopes: bool) -> Spot[None]:
        self.looks += 1
        if z[0] < self.wall:
            raise SimulationError("too far")
        return Spot(z, -0.5 * float(np.sum(self.residuals(z) ** 2)), None)

    def stand(self, spot: Spot[None]) -> tuple[np.ndarray, np.ndarray]:
        j = self.slopes(spot.z)
        return j.T @ self.residuals(spot.z), j.T @ j

    def bend(self, spot: Spot[None], step: np.ndarray) -> np.ndarray:
        self.looks += 1
        second = np.concatenate([-2 * self.steep * step[:-1] ** 2, np.zeros(len(step) - 1)])
        return self.slopes(spot.z).T @ second


@pytest.mark.parametrize("n", [2, 5])
def test_a_curved_valley_is_climbed_to_its_maximum(n):
    hill = Valley(n, 3.0)
    top = climb(hill, np.full(n, -1.0), 200, lambda height: 1e-9)
    np.testing.assert_allclose(top.spot.z, np.ones(n), atol=1e-4)
    assert top.converged and top.left < 1e-9


def test_a_bound_across_the_valley_holds_what_meets_it():
    """The last unknown may not exceed 0.5: the maximum along that bound, beside a search by numbers."""
    top = climb(Valley(2, 0.5), np.array([-1.0, -1.0]), 200, lambda height: 1e-9)
    x = np.linspace(-2, 0.5, 200_001)
    best = max(-0.5 * ((30 * (0.5 - x**2)) ** 2 + (1 - x) ** 2))
    assert top.converged and top.spot.height >= best - 1e-6


def test_a_step_where_nothing_can_be_simulated_is_shortened():
    top = climb(Valley(2, 3.0, wall=-1.2), np.array([-1.0, 1.5]), 200, lambda height: 1e-9)
    np.testing.assert_allclose(top.spot.z, [1.0, 1.0], atol=1e-4)


def test_a_climb_that_ends_by_its_limit_says_so():
    top = climb(Valley(5, 3.0), np.full(5, -1.0), 3, lambda height: 1e-6)
    assert not top.converged and top.steps == 3 and top.left > 0.01


def test_a_climb_far_below_its_goal_ends_early():
    near, far = Valley(5, 3.0), Valley(5, 3.0)
    climb(near, np.full(5, -1.0), 200, lambda height: 1e-9)
    top = climb(far, np.full(5, -1.0), 200, lambda height: 1e-9, goal=1e9)
    assert not top.converged and far.looks < 0.5 * near.looks
