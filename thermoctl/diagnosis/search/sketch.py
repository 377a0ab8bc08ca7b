"""The likeliest of many thousand directions, without a simulation of each.

    gain = ((P d)' r)^2 / |P d|^2,    d = W B y(q)

- y(q): first-order response of the outputs to an effect's forces q (screen.py)
- B: transform of samples to DCT rows; W: the weights that whiten the rows; r: residual
- P: projection, which removes the part that the plant's own unknowns absorb

The product of d with a row vector w is an inner product with the forces:

    w' d = sum_n q_n' l_n,    -dl/dt = J' l + B' W w

l is the state of the adjoint plant, simulated backwards for each w. One run gives the numerators of all
directions. SKETCHES more runs give the norms: with random signs s_k, the mean of ((P' s_k)' d)^2 is |P d|^2.
Its relative standard deviation is sqrt(2 / SKETCHES). So links between all pairs of N bodies need only inner
products, and no simulation each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np
from scipy.sparse import csc_matrix, identity
from scipy.sparse.linalg import splu

from thermoctl.diagnosis.search.gains import Column, Direction, scores
from thermoctl.diagnosis.search.metric import Metric
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import Group
from thermoctl.plant import expression as ex

# None of these numbers chooses a hypothesis: directions that are kept are screened exactly.
EXACT = 6_000  # up to so many columns all are simulated
SKETCHES = 32  # number of sketches: a gain is known within 25 %
KEPT = 1_500  # number of columns that are simulated, for each metric
SAMPLES = 4_000  # largest number of samples of an adjoint run; forces are summed between samples
GAMMA = 1 - float(np.sqrt(0.5))  # coefficient of the integration: two implicit stages, order 2, L-stable


def likeliest(
    metrics: Sequence[Metric], trajectories: Sequence[Trajectory], groups: list[Group]
) -> list[Group]:
    """Return the best group of each of the likeliest candidates, up to KEPT columns for each metric.

    All groups are returned if the plant has a delay or an FMU: it then has no adjoint of this form."""
    code = metrics[0].model.code
    if code.input_delays or code.output_delays or code.fmus:
        return groups
    if sum(len(g.sizes) for g in groups) <= EXACT:
        return groups
    columns = [list(g.columns()) for g in groups]
    keep: set[int] = set()
    for product in products(metrics, trajectories, list(chain.from_iterable(columns))):
        rows = product[:, 1:].T
        found = scores(columns, rows, product[:, 0], np.linalg.norm(rows, axis=0))
        keep |= foremost_groups(groups, found, KEPT)
    return [groups[i] for i in sorted(keep)]


def products(
    metrics: Sequence[Metric], trajectories: Sequence[Trajectory], columns: Sequence[Column]
) -> list[np.ndarray]:
    """Return the columns' products with residual and sketches (columns, 1 + SKETCHES), by metric."""
    vectors = [_vectors(metric) for metric in metrics]
    out = np.zeros((len(columns), len(metrics) * (1 + SKETCHES)))
    for r, trajectory in enumerate(trajectories):
        pull = np.concatenate([m.spread(r, v) for m, v in zip(metrics, vectors, strict=True)], axis=2)
        forces, starts = _adjoint(metrics[0], trajectory, pull)
        for k, column in enumerate(columns):
            pushed, read = column.changes(trajectory)
            for state, q in pushed.items():
                out[k] += np.add.reduceat(q, starts) @ forces[state]
            for j, delta in read.items():
                out[k] += delta @ pull[:, j]
    return np.split(out, len(metrics), axis=1)


def _vectors(metric: Metric) -> np.ndarray:
    """Return the residual and the sketches (rows, 1 + SKETCHES), projected and multiplied by the weights."""
    signs = np.random.default_rng(23).choice([-1.0, 1.0], (len(metric.weight), SKETCHES))
    whole = np.concatenate([metric.residual[:, None], signs / np.sqrt(SKETCHES)], axis=1)
    return metric.pulled(whole) * metric.weight[:, None]


def foremost_groups(groups: Sequence[Group], directions: Sequence[Direction | None], most: int) -> set[int]:
    """Return the positions of the best group of each of the best candidates, up to `most` columns."""
    best: dict[int, tuple[float, int]] = {}
    for i, (g, d) in enumerate(zip(groups, directions, strict=True)):
        if d is not None and d.gain > 0:
            best[id(g.candidate)] = min(best.get(id(g.candidate), (np.inf, i)), (d.log_p, i))
    order = [i for _, i in sorted(best.values())]
    until = np.searchsorted(np.cumsum([len(groups[i].sizes) for i in order]), most, side="right")
    return set(order[:until])


def _adjoint(metric: Metric, trajectory: Trajectory, pull: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return l (states, samples, k) for `pull` (N, outputs, k), and the first row of each sample.

    l is averaged over the rows of a sample. The method is the transpose of two implicit stages over each
    interval h, with forces that are linear between rows:

        M k1 = J x + q(GAMMA),   M k2 = J (x + (1 - GAMMA) h k1) + q(1),   M = 1 - GAMMA h J
        x' = x + h ((1 - GAMMA) k1 + GAMMA k2)"""
    model, t = metric.model, trajectory.drive.t
    nx, n, k = len(model.states), len(t), pull.shape[2]
    starts = np.arange(0, n, -(-n // SAMPLES))
    sample = np.searchsorted(starts, np.arange(n), side="right") - 1
    slopes = _Entries(trajectory, model.code.jacobian())
    seen = _Entries(
        trajectory,
        [
            (j, i, d)
            for j, o in enumerate(model.plant.outputs.values())
            for i, s in enumerate(model.states)
            if (d := ex.derivative(o.value, s)) is not ex.ZERO
        ],
    )
    out = np.zeros((nx, len(starts), k), np.float32)
    x, factored = np.zeros((nx, k)), None
    for m in range(n - 1, -1, -1):
        own = np.zeros((nx, k))
        if m < n - 1:
            h = float(t[m + 1] - t[m])
            middle = 0.5 * (slopes.values[:, m] + slopes.values[:, m + 1])
            if factored is None or h != factored[0] or not np.array_equal(middle, factored[1]):
                factored = h, middle, splu(slopes.without(GAMMA * h * middle, nx))
            solve = factored[2].solve
            k2 = solve(GAMMA * h * x, "T")
            pulled = k2 / (GAMMA * h) - x  # J' k2
            right = (1 - GAMMA) * h * (x + pulled)
            k1 = solve(right, "T")
            x = x + pulled + (k1 - right) / (GAMMA * h)
            out[:, sample[m + 1]] += k2 + GAMMA * k1
            own = (1 - GAMMA) * k1
        np.add.at(x, seen.place[1], seen.values[:, m, None] * pull[m, seen.place[0]])
        out[:, sample[m]] += own
    return out / np.bincount(sample)[:, None].astype(np.float32), starts


class _Entries:
    """Entries (row, column, expression) of a matrix, and their values (entries, N) along a trajectory."""

    def __init__(self, trajectory: Trajectory, entries: Sequence[tuple[int, int, ex.Expr]]):
        self.place = [i for i, *_ in entries], [j for _, j, _ in entries]
        self.values = np.array([trajectory.value(e, {}) for *_, e in entries]).reshape(
            len(entries), len(trajectory.drive.t)
        )

    def without(self, values: np.ndarray, size: int) -> csc_matrix:
        """Return the identity less the matrix of these values."""
        return identity(size, format="csc") - csc_matrix((values, self.place), (size, size))
