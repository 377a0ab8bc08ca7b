"""Where a remainder enters: the node at which small random forces would explain it best.

A white force at node i, with the rms of its typical flow, gives output j the variance F_ij(b) in band b.
F is computed by simulating the plant linearised along its own trajectory (`Model.respond`). FORCES forces a
node are enough, because each contains some bands of the DCT. A slow force is a first-order process with time
constant tau. Its rms is the share eta of the typical flow:

    V_j(b) = c^2 s^2 + eta^2 F_ij(b) S_b(tau)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import idct

from thermoctl.diagnosis.data.coordinates import Channel, Coordinates, bands, transform
from thermoctl.diagnosis.data.spectra import first_order
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.refit import Fit
from thermoctl.plant.language import Flow, Plant
from thermoctl.plant.simulation.simulate import Excitation, Model

SHARES = 10.0 ** np.arange(-3.5, 1.1, 0.5)  # values of eta: rms of a force over the typical flow
CORNERS = 3  # number of values of tau, from a fortieth to a quarter of the longest recording
FORCES = 2  # forces a node; each holds every second band, so that responses of adjacent bands do not mix


@dataclass(frozen=True)
class Responses:
    """Variance of each output by node and cell (eta, tau) over the bands of its recordings."""

    nodes: tuple[str, ...]
    white: list[np.ndarray]  # (nodes, bands) by channel, F of the module's docstring
    share: np.ndarray  # (cells,) eta
    corner: np.ndarray  # (cells,) tau
    intervals: list[float]  # s, sampling interval by recording

    def cells(self, k: int, c: Channel, node: int) -> np.ndarray:
        """Return the variances (cells, bands) of channel c, at position k, that forces at one node cause."""
        interval = self.intervals[c.recording]
        slow = [first_order(tau / interval, 2 * np.pi * c.frequency * interval) for tau in self.corner]
        return self.share[:, None] ** 2 * self.white[k][node] * np.array(slow)


def typical_flow(plant: Plant, node: str, values: Sequence[Mapping[str, np.ndarray | float]]) -> float:
    """Return the geometric mean of the rms flows at a node, over all recordings.

    The largest flow would be misleading: it may be a large force that only stores and returns energy."""
    rates = [typical_rate(f, values) for f in plant.flows.values() if node in (f.source, f.target)]
    logs = [np.log(r) for r in rates if r > 0]
    return float(np.exp(np.mean(logs))) if logs else 0.0


def typical_rate(f: Flow, values: Sequence[Mapping[str, np.ndarray | float]]) -> float:
    """Return the rms of a flow over all recordings."""
    square = [float(np.mean(np.asarray(ex.evaluate(f.rate, v), float) ** 2)) for v in values]
    return float(np.sqrt(np.mean(square)))


def signals(model: Model, d: Excitation, values: np.ndarray, x: np.ndarray) -> dict[str, np.ndarray | float]:
    """Return every name of the plant with its value or its values (N,) along a trajectory."""
    return {
        **dict(zip(model.plant.inputs, d.u.T, strict=False)),
        **dict(zip(model.parameters, map(float, values), strict=True)),
        **dict(zip(model.states, x.T, strict=True)),
        "t": d.t,
        "pi": np.pi,
    }


def along(fit: Fit, drives: Sequence[Excitation]) -> Iterator[dict[str, np.ndarray | float]]:
    """Yield `signals` of each recording, along the fitted trajectory."""
    for d, values, dx0 in zip(drives, fit.values, fit.dx0, strict=True):
        yield signals(fit.model, d, values, fit.model.run(d, values, dx0).x)


def white_forces(n: int) -> np.ndarray:
    """Return forces (n, FORCES) that contain each DCT row once, with size 1 and a fixed random sign."""
    *_, band = bands(n)
    rows = np.zeros((n, FORCES))
    rows[np.arange(n), band % FORCES] = np.random.default_rng(23).choice([-1.0, 1.0], n)
    return idct(rows, axis=0, norm="ortho")


def responses(fit: Fit, drives: Sequence[Excitation], coordinates: Coordinates, skip: set[str]) -> Responses:
    """Return the responses of a fitted plant to forces at its nodes.

    `skip`: nodes that store nothing (a position)."""
    model = fit.model
    nodes = tuple(
        n
        for n in model.plant.nodes
        if n not in skip and any(n in (f.source, f.target) for f in model.plant.flows.values())
    )
    white: list[np.ndarray] = []
    trajectories = [*along(fit, drives)]
    size = [typical_flow(model.plant, n, trajectories) for n in nodes]
    for r, d in enumerate(drives):
        storages = (ex.series(model.plant.nodes[n].storage, trajectories[r], d.t) for n in nodes)
        force = white_forces(len(d.t))
        q = [force * s / storage[:, None] for s, storage in zip(size, storages, strict=True)]
        at = [(model.states.index(n), i * FORCES + k) for i, n in enumerate(nodes) for k in range(FORCES)]
        point = fit.values[r], fit.dx0[r]
        dy = model.respond(d, *point, at, np.concatenate(q, axis=1), len(at)) if at else None
        for c in coordinates.of_recording(r):
            power = np.zeros((len(nodes), len(c.count)))
            if dy is not None:
                rows = transform(c, dy[:, c.output]) ** 2
                mean = np.stack([np.bincount(c.band, column) for column in rows.T]) / c.count
                power = mean.reshape(len(nodes), FORCES, -1).sum(axis=1)
            white.append(power)
    span = max(float(d.t[-1] - d.t[0]) for d in drives)
    intervals = [float(np.median(np.diff(d.t))) for d in drives]
    taus = np.geomspace(span / 40, span / 4, CORNERS)
    share, corner = np.meshgrid(SHARES, taus, indexing="ij")
    return Responses(nodes, white, share.ravel(), corner.ravel(), intervals)
