"""Track the recordings with unknown flows at all nodes, and linearise the plant about this trajectory.

    y - y(u^) + D u^ = sum_k c_k D phi_k(x^) + S dtheta + noise

u^: flows into all nodes, linear between knots, with which the plant's outputs follow the recorded ones.
D: exact first-order response of the outputs to flows; S: to parameters and initial states. A law at one node
replaces all of u^. Regression on this equation equals regression on the smoothed flow with its covariance.

The prior of u^ is white. Its standard deviation is one multiple of each node's typical flow, the multiple
with the largest marginal likelihood. Initial states are free."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, as_refitted
from thermoctl.diagnosis.evidence.noise import Around
from thermoctl.diagnosis.evidence.where import SHARES, typical_flow
from thermoctl.diagnosis.hypothesis.places import flow_unit
from thermoctl.diagnosis.hypothesis.rig import TEMPERATURE
from thermoctl.diagnosis.law.signals import Place, Values
from thermoctl.diagnosis.search.metric import Absorbed, Metric, Plain, Pushed
from thermoctl.plant import expression as ex
from thermoctl.plant.expression import name, num
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.fitting.residuals import FAR, Problem
from thermoctl.plant.language import Flow, Input, Plant
from thermoctl.plant.simulation.simulate import Model, SimulationError, compile_plant
from thermoctl.units import without_brackets

LATENT = "unknown_flow_into_"
KNOTS = 240  # number of knots of a recording, shared among the nodes, if there are MANY recordings or fewer
MANY = 4
FEWEST_KNOTS = 24
ABSORBED = 1e-3  # a flow is absorbed if the projection leaves less than this share of its response's norm
STEPS = 24  # largest number of Gauss-Newton steps of the tracking, whole or shortened
# Factor on a step that cannot be simulated or follows worse, and the least share of a step that is tried.
SHORTER, SHORTEST = 0.25, 0.01
SETTLED = 0.02  # the tracking ends where another step promises less than this share of what is left
TOGETHER = 48  # number of responses that are simulated at a time


@dataclass
class Tracked:
    """The plant linearised about the tracked trajectory.

    - `metric`: whitened rows at the trajectory, and the projection
    - `target` (rows,): the misfit that a law has to explain
    - `free`: by node, the responses (rows, k) to a free flow in time into it, each knot's of typical size
    - `beyond`: directions that a free flow into another node absorbs, or None"""

    metric: Metric
    target: np.ndarray
    free: dict[str, np.ndarray]
    beyond: Absorbed | None = None

    @property
    def likely(self) -> list[str]:
        """Return the nodes, sorted by the share of |target|^2 that a free flow in time into each explains."""
        explained = {n: _explained(x, self.target) for n, x in self.free.items()}
        return sorted(explained, key=lambda n: -explained[n])

    @cached_property
    def _around(self) -> Around:
        return Around(self.metric.plain.grids, self.metric.powers(self.target))

    def above(self, rows: np.ndarray) -> float:
        """Return the log likelihood of other whitened rows minus that of the target."""
        return self._around.rise(self.metric.powers(rows))

    def along(self, values: Callable[[Values, np.ndarray], np.ndarray]) -> list[np.ndarray]:
        """Return by recording what `values` gives for the signals along the trajectory, and their times."""
        return [values(run, d.t) for run, d in zip(self.metric.signals, self.metric.drives, strict=True)]

    def columns(self, place: Place, flows: Sequence[np.ndarray]) -> np.ndarray:
        """Return the whitened, projected responses (rows, k) to flows (N, k), by recording, at a place.

        A storage that is larger by q acts like the flow -q dx/dt into the node. A flow that the plant's own
        parameters absorb gives zeros."""
        if place.part == "storage":
            flows = [-q * s[:, None] for q, s in zip(flows, self._slopes(place.target), strict=True)]
        with np.errstate(all="ignore"):
            whole = _responses(self.metric, place, flows)
            rest = self.metric.project(whole)
            rest = self.beyond.without(rest) if self.beyond else rest
            absorbed = np.linalg.norm(rest, axis=0) < ABSORBED * np.linalg.norm(whole, axis=0)
        return np.where(absorbed, 0.0, rest)

    def flows(self, nodes: Sequence[str]) -> tuple[float, float]:
        """Return the log marginal likelihood of free flows into nodes, over that of none, and their size.

        The size, their prior standard deviation over the typical flow, is the likeliest of SHARES."""
        x = np.concatenate([self.free[n] for n in nodes], axis=1)
        square, v = np.linalg.eigh(x.T @ x)
        square, force = np.maximum(square, 0.0), (v.T @ (x.T @ self.target)) ** 2
        share = max(SHARES, key=lambda s: _gain(s, square, force))
        return _gain(share, square, force), float(share)

    def beside(self, node: str, size: float) -> Tracked:
        """Return the linearised plant with a free flow of a prior size into a node."""
        beyond = Absorbed.by(size * self.free[node])
        return dataclasses.replace(self, target=beyond.without(self.target), beyond=beyond)

    def _slopes(self, node: str) -> list[np.ndarray]:
        """Return the slope dx/dt of a node (N,) by recording, without the part of the unknown flow.

        With that part, a law of the storage could reproduce the unknown flow itself."""
        storage = self.metric.model.plant.nodes[node].storage

        def slope(run: Values, t: np.ndarray) -> np.ndarray:
            """Return the slope of one recording."""
            unknown = run.get(f"{LATENT}{node}", 0.0) / ex.series(storage, run, t)
            return np.asarray(np.gradient(np.asarray(run[node], float), t) - unknown)

        return self.along(slope)


def _gain(share: float, square: np.ndarray, force: np.ndarray) -> float:
    """Return the log marginal likelihood of free flows, over that of none, at their prior sd `share`.

    X (rows, k): responses to flows of unit sd; r: residual; X'X = V diag(square) V'; force = (V'X'r)^2."""
    more = 1 + share**2 * square
    return 0.5 * float(np.sum(force * share**2 / more - np.log(more)))


def flow_rows(metric: Metric, node: str, hats: Sequence[csr_matrix], size: float = 1.0) -> list[np.ndarray]:
    """Return, by recording, the rows of the responses to flows into a node: hat functions times `size`."""
    whole = _responses(metric, Place(node), [size * hat.toarray() for hat in hats])
    return np.split(whole, np.cumsum([sum(c.rows for c in own) for own in metric.plain.channels])[:-1])


def _responses(metric: Metric, place: Place, flows: Sequence[np.ndarray]) -> np.ndarray:
    """Return the whitened rows (rows, k) of the responses to flows (N, k), by recording, at a place.

    To save memory, TOGETHER responses are simulated at a time."""
    some = [[q[:, k : k + TOGETHER] for q in flows] for k in range(0, flows[0].shape[1], TOGETHER)]
    parts = [metric.responses(partial(_pushed, metric, place, q), q[0].shape[1]) for q in some]
    return np.concatenate(parts, axis=1) * metric.weight[:, None]


def _pushed(metric: Metric, place: Place, flows: Sequence[np.ndarray], r: int) -> Pushed:
    """Return the changes of slopes that flows (N, k) at a place cause in recording r."""
    model, t = metric.model, metric.drives[r].t
    if place.part == "reading":
        j = list(model.plant.outputs).index(place.target)
        return Pushed([], np.empty((len(t), 0)), {(j, c): q for c, q in enumerate(flows[r].T)})
    forces, q = list[tuple[int, int]](), []
    for node, share in place.ends:
        storage = ex.series(model.plant.nodes[node].storage, metric.signals[r], t)
        part = ex.series(share, metric.signals[r], t)
        forces += [(model.states.index(node), c) for c in range(flows[r].shape[1])]
        q.append(np.nan_to_num(flows[r]) * (part / storage)[:, None])
    return Pushed(forces, np.concatenate(q, axis=1), {})


def with_latent(plant: Plant, nodes: Sequence[str]) -> Plant:
    """Return the plant with a recorded flow into each node.

    The slope dx/dt that it causes does not change with the storage's parameters. Otherwise, in a plant whose
    storages and rates are known only up to a common factor, this factor would absorb every flow."""
    inputs = {f"{LATENT}{n}": Input(f"{LATENT}{n}", None, f"{LATENT}{n}", True) for n in nodes}
    rates = {k: ex.mul(name(k), _scaling(plant, k.removeprefix(LATENT))) for k in inputs}
    flows = {k: Flow(k, rate, None, k.removeprefix(LATENT)) for k, rate in rates.items()}
    return dataclasses.replace(plant, inputs={**plant.inputs, **inputs}, flows={**plant.flows, **flows})


def _scaling(plant: Plant, node: str) -> ex.Expr:
    """Return a node's storage, divided by its value at the plant's present parameters."""
    parameters, storage = plant.parameters, plant.nodes[node].storage
    if not ex.names(storage) & parameters.keys():
        return ex.ONE
    return ex.div(storage, ex.fill(storage, {q: num(p.value) for q, p in parameters.items()}))


@dataclass(frozen=True)
class _Followed:
    """The plant linearised about the trajectory that follows the recordings best.

    - `metric`: whitened rows at the trajectory, and the projection
    - `misfit`: by recording, whitened rows of y - y(u^) + D u^
    - `wide`: by recording, rows of the responses to each knot's flow (rows, nodes * knots)"""

    metric: Metric
    misfit: list[np.ndarray]
    wide: list[np.ndarray]


@dataclass(frozen=True)
class _Spot:
    """Where the tracking looks: flows at the knots by recording (knots, nodes), and all unknowns z."""

    flows: list[np.ndarray]
    z: np.ndarray

    def towards(self, aim: _Spot, share: float) -> _Spot:
        """Return the spot that is a share of the way to another one."""
        flows = [u + share * (v - u) for u, v in zip(self.flows, aim.flows, strict=True)]
        return _Spot(flows, self.z + share * (aim.z - self.z))


class _Tracking:
    """A fitted hypothesis with unknown flows into nodes, which are to follow the recordings."""

    def __init__(self, case: Case, f: Fitted, nodes: Sequence[str]):
        self.case, self.f, self.nodes = case, as_refitted(case, f), nodes
        # the refit of a plant that grows without bounds takes all of a reading for noise
        most = [g.variance * float(np.exp(2 * g.known)) for g in case.grids]
        noise = [min(v, m) for v, m in zip(self.f.average.sensor, most, strict=True)]
        self.average = dataclasses.replace(self.f.average, sensor=noise)
        self.plant = with_latent(self.f.rough_plant, nodes)
        self.model = compile_plant(self.plant)
        self.knots = max(FEWEST_KNOTS, KNOTS * MANY // max(len(case.tables), MANY) // len(nodes))
        self.hats = [hat_functions(t.t - t.t[0], self.knots) for t in case.tables]
        self.sizes: list[float] = []

    @property
    def first(self) -> _Spot:
        """Return the spot without unknown flows."""
        return _Spot([np.zeros((self.knots, len(self.nodes))) for _ in self.hats], self.f.rough.z)

    def look(self, at: _Spot) -> tuple[Metric, list[np.ndarray]] | None:
        """Return the plant at a spot, and its whitened residuals by recording; None without a simulation."""
        tables = tuple(
            dataclasses.replace(
                t, columns={**t.columns, **{f"{LATENT}{n}": h @ w[:, i] for i, n in enumerate(self.nodes)}}
            )
            for t, h, w in zip(self.case.tables, self.hats, at.flows, strict=True)
        )
        case = dataclasses.replace(self.case, tables=tables)
        try:
            metric = Metric(_at(case, self.f.rough, self.model, at.z), self.average, False)
            self.sizes = self.sizes or [
                typical_flow(self.plant, n, metric.signals) or 1.0 for n in self.nodes
            ]
        except SimulationError:
            return None
        return metric, [
            metric.rows(r, np.nan_to_num(d.y - metric.runs[r].y)) for r, d in enumerate(metric.drives)
        ]

    def step(
        self, at: _Spot, metric: Metric, residual: Sequence[np.ndarray]
    ) -> tuple[_Followed, _Spot, float]:
        """Return the plant linearised at a spot, the next spot, and the sum of squares promised there."""
        sizes = np.array(self.sizes)
        by_node = [flow_rows(metric, n, self.hats, s) for n, s in zip(self.nodes, self.sizes, strict=True)]
        wide = [np.concatenate(blocks, axis=1) for blocks in zip(*by_node, strict=True)]
        scaled = [(w / sizes).T.ravel() for w in at.flows]
        misfit = [e + x @ w for e, x, w in zip(residual, wide, scaled, strict=True)]
        flows = _smoothed(wide, misfit, metric.own)
        left = [e - x @ p for e, x, p in zip(misfit, wide, flows, strict=True)]
        own = [p.reshape(len(self.nodes), self.knots).T * sizes for p in flows]
        aim = _Spot(own, _started(metric, left))
        return _Followed(metric, misfit, wide), aim, _squares(left)


def _followed(case: Case, f: Fitted, nodes: Sequence[str]) -> _Followed:
    """Follow the recordings with unknown flows into nodes. Raises SimulationError.

    Knots act in their own recording only, so that each recording is solved alone. A whole step may lead a
    plant that grows to where it has no bounds: then the step is shortened."""
    if not nodes:
        raise SimulationError("the plant has no node that an unknown flow could enter")
    tracking = _Tracking(case, f, nodes)
    here = aim = tracking.first
    found: _Followed | None = None
    size, share = np.inf, 1.0
    for _ in range(STEPS + 1):
        at = here.towards(aim, share)
        seen = tracking.look(at)
        if seen is None or not _squares(seen[1]) < size:
            share *= SHORTER
            if found is None or share < SHORTEST:
                break
            continue
        here, size, share = at, _squares(seen[1]), 1.0
        found, aim, promised = tracking.step(here, *seen)
        if promised > (1 - SETTLED) * size:
            break
    if found is None:
        raise SimulationError("the plant cannot be tracked")
    return found


def _squares(rows: Sequence[np.ndarray]) -> float:
    return sum(float(e @ e) for e in rows)


def _at(case: Case, fit: Fit, model: Model, z: np.ndarray) -> Plain:
    """Return the rows of a plant at its parameters' values, with the initial states of z."""
    problem = Problem(model, case.drives(model), case.noise)
    z = np.concatenate([problem.z_plant[: problem.n_parameters], z[problem.n_parameters :]])
    values, dx0 = problem.unpack(z)
    # a parameter that the refit without a law put at its bound may leave it with one
    return Plain(case, dataclasses.replace(fit, model=model, values=values, dx0=dx0, z=z, at_bound={}))


def _started(metric: Metric, left: Sequence[np.ndarray]) -> np.ndarray:
    """Return the unknowns after a step of the initial states to errors (rows,) that flows leave."""
    plain, z = metric.plain, metric.fit.z.copy()
    first = plain.problem.n_parameters
    edges = np.cumsum([len(e) for e in left])[:-1]
    for r, (e, weight) in enumerate(zip(left, np.split(metric.weight, edges), strict=True)):
        ks = plain.unknowns(r)
        x = plain.sensitivities[r][:, ks >= first] * weight[:, None]
        ks = ks[ks >= first]
        z[ks] = np.clip(z[ks] + np.linalg.lstsq(x, e, rcond=1e-8)[0], -FAR, FAR)
    return z


def tracked(case: Case, f: Fitted, nodes: Sequence[str]) -> Tracked:
    """Track the recordings from a fitted hypothesis. Raises SimulationError."""
    followed = _followed(case, f, nodes)
    target = followed.metric.project(np.concatenate(followed.misfit))
    of_nodes = zip(*(np.split(x, len(nodes), axis=1) for x in followed.wide), strict=True)
    free = {n: followed.metric.project(block_diag(*x)) for n, x in zip(nodes, of_nodes, strict=True)}
    return Tracked(followed.metric, target, free)


def missing_flow(case: Case, f: Fitted, node: str) -> float | None:
    """Return the rms, in the flow's unit, of the unknown flow into a node with which the plant fits.

    `f`: the fitted plant. None where it cannot follow the recordings."""
    try:
        runs = _followed(case, f, [node]).metric.signals
    except (SimulationError, np.linalg.LinAlgError):
        return None
    return float(np.sqrt(np.mean(np.concatenate([run[f"{LATENT}{node}"] for run in runs]) ** 2)))


def law_unit(plant: Plant, place: Place) -> str | None:
    """Return the unit of a law at a place, None where the plant states none."""
    if place.part == "parameter":
        return plant.parameters[place.of[0]].unit
    if place.part == "reading":
        read = plant.outputs[place.target].unit
        return "K" if read in TEMPERATURE else read
    flow, own = flow_unit(plant, place.target), plant.nodes[place.target].unit
    if place.part == "flow" or not flow or not own:
        return flow if place.part == "flow" else None
    return without_brackets(f"({flow}) * s / ({'K' if own in TEMPERATURE else own})")


def _explained(x: np.ndarray, target: np.ndarray) -> float:
    # a decomposition of x itself costs seconds if it has thousands of columns
    square, v = np.linalg.eigh(x.T @ x)
    seen = square > ABSORBED**2 * square[-1]
    along = (v[:, seen].T @ (x.T @ target)) / np.sqrt(square[seen])
    return float(along @ along) / max(float(target @ target), 1e-300)


def hat_functions(t: np.ndarray, knots: int) -> csr_matrix:
    """Return the hat functions (N, knots) of piecewise linear functions between evenly spaced knots."""
    knot_times, n = np.linspace(t[0], t[-1], knots), np.arange(len(t))
    k = np.clip(np.searchsorted(knot_times, t, side="right") - 1, 0, knots - 2)
    part = (t - knot_times[k]) / (knot_times[k + 1] - knot_times[k])
    entries = np.concatenate([n, n]), np.concatenate([k, k + 1])
    return csr_matrix((np.concatenate([1 - part, part]), entries), shape=(len(t), knots))


def _smoothed(
    wide: Sequence[np.ndarray], targets: Sequence[np.ndarray], own: Sequence[Absorbed]
) -> list[np.ndarray]:
    """Return the posterior mean of the knots' flows by recording, in units of the typical flows.

    The prior's standard deviation has the largest marginal likelihood of SHARES. `own`: the directions that
    each recording's own unknowns absorb."""
    parts = [np.linalg.svd(q.without(x), full_matrices=False) for q, x in zip(own, wide, strict=True)]
    along = [u.T @ q.without(e) for (u, _, _), q, e in zip(parts, own, targets, strict=True)]
    of = [(s**2, (s * a) ** 2) for (_, s, _), a in zip(parts, along, strict=True)]
    best = max(SHARES, key=lambda share: sum(_gain(share, *x) for x in of))
    return [
        v.T @ (best**2 * s / (1 + (best * s) ** 2) * a) for (_, s, v), a in zip(parts, along, strict=True)
    ]
