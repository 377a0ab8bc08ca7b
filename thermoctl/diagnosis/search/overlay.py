"""First-order changes of a plant by an effect, along the fitted trajectory of a recording."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thermoctl.diagnosis.hypothesis.rig import STRAIGHT, Rig
from thermoctl.diagnosis.search.metric import Metric
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Node, Plant


class Trajectory:
    """The signals of one recording at the fit, for evaluating changed equations."""

    def __init__(self, metric: Metric, rig: Rig, r: int):
        d, run = metric.drives[r], metric.runs[r]
        self.recording, self.drive, self.run = r, d, run
        self.values: dict[str, np.ndarray | float] = {
            **{i + STRAIGHT: u for i, u in zip(rig.plant.inputs, d.u.T, strict=False)},
            **metric.signals[r],
        }
        self.first = d.first
        self.known: dict[int, np.ndarray] = {}
        # values of held inputs just before each sample
        self.until = {
            i: np.concatenate([u[:1], u[:-1]])
            for i, u, linear in zip(rig.plant.inputs, d.u.T, d.linear, strict=False)
            if not linear
        }

    def own(self, e: ex.Expr) -> np.ndarray:
        """Return the values (N,) of an expression of the plant itself, computed once."""
        if id(e) not in self.known:
            self.known[id(e)] = self.value(e, {})
        return self.known[id(e)]

    def value(self, e: ex.Expr, extra: Mapping[str, np.ndarray | float]) -> np.ndarray:
        """Return the values (N,) of an expression along the trajectory. `extra`: further names."""
        return ex.series(e, {**self.values, **extra}, self.drive.t)


class Overlay:
    """The parts of a plant that an extension changes: flows, storages, outputs, and new nodes."""

    def __init__(self, base: Plant, extended: Plant):
        self.base, self.states = base, list(base.nodes)
        self.own = [p for k, p in extended.parameters.items() if k not in base.parameters]
        self.new = [(n, _net(extended, k)) for k, n in extended.nodes.items() if k not in base.nodes]
        self.flows = [
            (f, old)
            for f in extended.flows.values()
            if (old := base.flows.get(f.name)) is None or old.rate is not f.rate
        ]
        self.storages = [
            (n, extended.nodes[n.name].storage)
            for n in base.nodes.values()
            if extended.nodes[n.name].storage is not n.storage
        ]
        self.outputs = [
            (j, o.value, extended.outputs[key].value)
            for j, (key, o) in enumerate(base.outputs.items())
            if extended.outputs[key].value is not o.value
        ]

    def changes(
        self, values: Mapping[str, float], trajectory: Trajectory
    ) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
        """Return the changes (N,) along a trajectory: of slopes dx/dt by state, and of outputs by output.

        `values`: of the extension's parameters; the others have those of the extended plant."""
        base = self.base
        here = {p.name: p.value_in(trajectory.drive.name) for p in self.own}
        extra: dict[str, np.ndarray | float] = {**here, **values}
        for n, net in self.new:
            extra[n.name] = _new_node(n, net, extra, trajectory)
        nets: dict[str, np.ndarray] = {}
        for f, old in self.flows:
            delta = trajectory.value(f.rate, extra) - (0.0 if old is None else trajectory.own(old.rate))
            for end, sign in ((f.source, -1.0), (f.target, 1.0)):
                if end and end in base.nodes:
                    nets[end] = nets.get(end, 0.0) + sign * delta
        slopes = {self.states.index(n): q / trajectory.own(base.nodes[n].storage) for n, q in nets.items()}
        for n, storage in self.storages:
            change = np.zeros(trajectory.drive.t.shape)
            for f in base.flows.values():
                if n.name in (f.source, f.target):
                    change += (1.0 if f.target == n.name else -1.0) * trajectory.own(f.rate)
            before, after = (trajectory.value(e, extra) for e in (n.storage, storage))
            slopes[self.states.index(n.name)] = change / after - change / before
        return slopes, {j: trajectory.value(new, extra) - trajectory.own(old) for j, old, new in self.outputs}


def _net(plant: Plant, node: str) -> ex.Expr:
    """Return the net flow into a node as one expression."""
    net: ex.Expr = ex.ZERO
    for f in plant.flows.values():
        if f.target == node:
            net = ex.add(net, f.rate)
        if f.source == node:
            net = ex.add(net, ex.neg(f.rate))
    return net


def _new_node(
    n: Node, net: ex.Expr, extra: Mapping[str, np.ndarray | float], trajectory: Trajectory
) -> np.ndarray:
    """Integrate a new node alone along the trajectory: dn/dt = a - b n, a and b constant in a sample."""
    node = n.name
    first = {k: float(np.asarray(v).flat[0]) for k, v in {**trajectory.values, **extra}.items()}
    start = float(ex.evaluate(n.initial, first, lambda key: trajectory.first[key]))
    t = trajectory.drive.t
    storage = trajectory.value(n.storage, extra)
    b = -trajectory.value(ex.derivative(net, node), {**extra, node: start}) / storage
    a = trajectory.value(net, {**extra, node: 0.0}) / storage
    if not a.any() and not b.any():
        return np.full(t.shape, start)
    h = np.diff(t)
    before = a
    if ex.names(net) & trajectory.until.keys():
        before = trajectory.value(net, {**extra, **trajectory.until, node: 0.0}) / storage
    mid_a, mid_b = 0.5 * (before[1:] + a[:-1]), np.maximum(0.5 * (b[1:] + b[:-1]), 0.0)
    decay = np.exp(-mid_b * h)
    gain = np.where(mid_b * h > 1e-9, -np.expm1(-mid_b * h) / np.maximum(mid_b, 1e-300), h) * mid_a
    return np.concatenate([[start], filtered(decay, gain, start)])


def filtered(decay: np.ndarray, gain: np.ndarray, start: np.ndarray | float) -> np.ndarray:
    """Return x_k = decay_k x_(k-1) + gain_k (N, ...), x_0 = `start`; decay is at most 1.

    Steps are joined in pairs, then in fours and so on (Hillis, Steele 1986): no loop over rows."""
    decay, out, reach = decay.copy(), gain.copy(), 1
    out[:1] += decay[:1] * start
    while reach < len(out):
        out[reach:] += decay[reach:] * out[:-reach]
        decay[reach:] *= decay[:-reach].copy()
        reach *= 2
    return out
