"""Free functions of signals at each place: they show which signals a law may depend on.

A free function is a straight line between quantiles of the signal (`pieces`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, as_refitted
from thermoctl.diagnosis.evidence.unknown import located, reached
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.law.forms import library
from thermoctl.diagnosis.law.signals import Place, Signal, places, signals
from thermoctl.diagnosis.law.smooth import Tracked
from thermoctl.diagnosis.limits import Thresholds
from thermoctl.diagnosis.search.metric import Metric, Plain
from thermoctl.plant import expression as ex

PIECES = 8  # number of knots of a free function of a signal
NODES = 4  # number of nodes, those where a free flow in time explains most, at which laws are proposed
RANKED = 40  # number of (place, signal) pairs whose free function is scored
# Largest ratio of a gain to its prediction beside noise, over those before: 45 refits of 14 cases.
SPREAD = 1.15
SEEN = 1e-6  # least singular value over the largest one; smaller ones are rounding errors


def pays(case: Case, f: Fitted, limits: Thresholds) -> bool:
    """Return whether a law may be worth its odds beside a hypothesis that leaves only noise.

    Where a law fits much better than the hypothesis, a free function of a signal gains something there. At a
    velocity, products of the velocity and another signal are tried, too. Two parameters of a law are taken
    off the gain. Raises SimulationError."""
    linear = at_refit(case, f)
    rig = case.rig(f.rough_plant, linear.metric.drives)
    where = places_in(case, rig)
    combos = choices(case, rig, where, entered(case, f, where, NODES), linear)
    moving = [(p, v) for p, v in combos if v.drives and v.label in rig.velocities]
    both = [(p, v, w) for p, v in moving for q, w in combos if q == p and w != v]
    products = [(p, partial(_along_both, linear, a, b)) for p, v, w in both for a, b in ((v, w), (w, v))]
    look, off = log_number(combos), cost_of(linear, PIECES) - cost_of(linear, 2)
    gains = [gain + off for gain, *_ in ranked(linear, combos)[:1]]
    gains += [gain + off - look for gain, _ in _gains(linear, products)[:1]]
    return SPREAD * max(gains, default=-np.inf) > look + unlikely(limits)


def at_refit(case: Case, f: Fitted) -> Tracked:
    """Return the plant linearised about its refit, without unknown flows. Raises SimulationError."""
    metric = Metric(Plain(case, f.rough), as_refitted(case, f).average, True)
    return Tracked(metric, metric.residual, {})


def places_in(case: Case, rig: Rig) -> list[Place]:
    """Return the places of laws at nodes of the plant file, not at those that effects added."""
    return [p for p in places(rig) if {*p.nodes} <= case.plant.nodes.keys()]


def entered(case: Case, f: Fitted, where: Sequence[Place], most: int) -> list[str]:
    """Return the nodes that a law may enter; of more than `most`, those that explain most."""
    nodes = [p.target for p in where if p == Place(p.target)]
    return nodes if len(nodes) <= most else located(case, as_refitted(case, f), reached(case))[:most]


def choices(
    case: Case, rig: Rig, where: Sequence[Place], nodes: Sequence[str], linear: Tracked
) -> list[tuple[Place, Signal]]:
    """Return the places at some nodes, and of readings, each with every signal that a law may depend on.

    A flow between nodes that the plant file does not link has to explain something at both. A node that an
    effect added is no signal if nothing but a reading depends on it: a slow gauge opens no valve."""
    flows = rig.physics.flows.values()
    links = [{f.source, f.target} for f in flows]
    acting = {n for f in flows if {f.source, f.target} & case.plant.nodes.keys() for n in ex.names(f.rate)}
    shown = rig.physics.nodes.keys() - case.plant.nodes.keys() - acting

    def explains(p: Place) -> bool:
        """Return whether a law at a place may explain something at the nodes."""
        if p.part == "reading":
            return True
        new = p.source and not p.of and {*p.nodes} not in links
        return {*p.nodes} <= {*nodes} if new else bool({*p.nodes} & {*nodes})

    found = [(p, s) for p in where if explains(p) for s in signals(rig, p, linear.metric.signals)]
    return [(p, s) for p, s in found if not ex.names(s.value) & shown]


def log_number(combos: Sequence[tuple[Place, Signal]]) -> float:
    """Return the log of the number of places, signals and forms that a term is chosen from."""
    return float(np.log(max(len(combos), 1)) + np.log(len(library())))


def unlikely(limits: Thresholds) -> float:
    """Return minus the log of the prior odds of one term."""
    return -float(np.log(limits.missing / (1 - limits.missing) * limits.rare))


def ranked(linear: Tracked, combos: Sequence[tuple[Place, Signal]]) -> list[tuple[float, Place, Signal]]:
    """Return the predicted gain of a free function of a signal at each place, the best first."""
    gains = _gains(linear, [(p, partial(_free, linear, s)) for p, s in combos])
    return [(gain, *combos[k]) for gain, k in gains]


def _gains(
    linear: Tracked, functions: Sequence[tuple[Place, Callable[[], list[np.ndarray]]]]
) -> list[tuple[float, int]]:
    """Return the predicted gain of each free function at its place, and its position, the best first.

    Each knot costs half the log of the number of rows. The gain in likelihood is computed only for the RANKED
    functions with the largest gain in energy, and only these are returned. All columns together would fill
    the memory: each is made when it is needed."""
    energies = [energy(linear.columns(p, flows()), linear.target) for p, flows in functions]
    out = []
    for k in np.argsort(-np.array(energies), kind="stable")[:RANKED].tolist():
        place, flows = functions[k]
        x = linear.columns(place, flows())
        out.append((predicted(linear, x)[0], k))
    return sorted(out, key=lambda f: -f[0])


def _free(linear: Tracked, s: Signal) -> list[np.ndarray]:
    """Return the columns (N, knots) of a free function of a signal by recording."""
    values = linear.along(s.along)
    knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0, 1, PIECES)))
    return [pieces(v, knots) for v in values]


def _along_both(linear: Tracked, s: Signal, w: Signal) -> list[np.ndarray]:
    """Return the columns of a free function of a signal times another one: its size, if the first drives."""
    factors = linear.along(w.along)
    return [
        x * (np.abs(f) if s.drives else f)[:, None] for x, f in zip(_free(linear, s), factors, strict=True)
    ]


def cost_of(linear: Tracked, parameters: int) -> float:
    """Return the nats that parameters cost: half the log of the number of rows each."""
    return 0.5 * parameters * float(np.log(len(linear.target)))


def energy(x: np.ndarray, target: np.ndarray) -> float:
    """Return the part of |target|^2 that columns x explain."""
    scale = np.linalg.norm(x, axis=0)
    x = x / np.where(scale > 0, scale, 1.0)
    square, v = np.linalg.eigh(x.T @ x)  # a decomposition of x itself takes ten times as long
    seen = square > SEEN**2 * max(square[-1], 1e-300)
    return float(np.sum((v[:, seen].T @ (x.T @ target)) ** 2 / square[seen]))


def pieces(v: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return hat functions of a signal between knots (N, knots): the columns of a free function."""
    if len(knots) < 2:
        return np.ones((len(v), 1))
    return np.stack([np.interp(v, knots, row) for row in np.eye(len(knots))], axis=1)


def predicted(linear: Tracked, x: np.ndarray, shapes: int = 0) -> tuple[float, np.ndarray]:
    """Return the predicted gain in log likelihood of columns x at their best sizes, and these sizes.

    Less what the sizes cost, and `shapes` further parameters."""
    scale = np.linalg.norm(x, axis=0)
    scale[scale == 0] = 1.0
    c = np.linalg.lstsq(x / scale, linear.target, rcond=1e-8)[0] / scale
    return linear.above(linear.target - x @ c) - cost_of(linear, len(c) + shapes), c
