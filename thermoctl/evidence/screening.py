"""The score test of every catalogue entry at every place, from one fitted hypothesis, in the metric of the sensors' noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermoctl.diagnose.effects import candidates
from thermoctl.diagnose.screen import Direction, Metric, screen
from thermoctl.evidence.case import Case
from thermoctl.evidence.coordinates import Coordinates
from thermoctl.evidence.fit import Fitted
from thermoctl.evidence.roles import Structure
from thermoctl.plant.refit import Problem
from thermoctl.plant.simulate import Simulation

ROWS, MOVING_ROWS = 6_000, 16_000  # of all outputs in all recordings; what moves needs the finer ones
DRAWS = 100  # of noise, for the chance of the best direction


class Rows(Metric):
    """Whitened rows of a fitted hypothesis: DCT rows over the standard deviation of the sensors' noise in them."""

    def __init__(self, case: Case, fitted: Fitted, most: int, share: float):
        """`share`: of the remainder that counts as noise, too."""
        self.fit, self.model = fitted.rough, fitted.rough.model
        self.drives = [self.model.excitation(t) for t in case.tables]
        self.problem = Problem(self.model, self.drives, case.noise)
        for d, values in zip(self.drives, self.fit.values, strict=True):
            self.model.prepare(d, values)
        self.blocks = 1
        self.coordinates = Coordinates(self.drives, max(most // len(case.coordinates.channels), 32))
        self.weights = _weights(case, fitted, self.coordinates, share)
        self.runs, columns = [], []
        for r, d in enumerate(self.drives):
            run = self.model.run(d, self.fit.values[r], self.fit.dx0[r], sensitivities=True)
            self.runs.append(Simulation(run.t, run.x, run.y))
            columns.append(run.dy)
        residual = [
            self.rows(r, d.y - run.y) for r, (d, run) in enumerate(zip(self.drives, self.runs, strict=True))
        ]
        basis = np.zeros((sum(map(len, residual)), len(self.problem.unknowns)))
        at = 0
        for r, dy in enumerate(columns):
            assert dy is not None  # the runs were asked for their sensitivities
            used = np.flatnonzero(self.problem.columns[r] >= 0)
            block = self.rows(r, dy[:, :, used])
            basis[at : at + len(block), self.problem.columns[r, used]] = block
            at += len(block)
        free = [k for k, (q, _) in enumerate(self.problem.unknowns) if q not in self.fit.at_bound]
        size = np.linalg.norm(basis[:, free], axis=0)
        scaled = basis[:, free][:, size > 0] / size[size > 0]
        u, s, _ = np.linalg.svd(scaled, full_matrices=False)
        self.basis = u[:, s > 1e-6 * s[0]] if len(s) else u
        self.residual = self.project(np.concatenate(residual))

    def rows(self, r: int, e: np.ndarray) -> np.ndarray:
        """(N, outputs, ...) of recording r as whitened rows of all its channels."""
        parts = []
        for c, w in zip(self.coordinates.channels, self.weights, strict=True):
            if c.recording == r:
                x = self.coordinates.transform(c, e[:, c.output])
                parts.append(x * w.reshape(-1, *([1] * (x.ndim - 1))))
        return np.concatenate(parts)


def _weights(case: Case, fitted: Fitted, coordinates: Coordinates, share: float) -> list[np.ndarray]:
    """One over the standard deviation of each row (rows,) of each channel."""
    noise: dict[tuple[int, int], np.ndarray] = {}
    for g, variance in zip(case.grids, fitted.average.sensor, strict=True):
        at = 0
        for k in g.channels:
            c = case.coordinates.channels[k]
            own = variance[at : at + len(c.count)]
            noise[c.recording, c.output] = (1 - share) * own + share / fitted.average.inverse[k]
            at += len(c.count)
    known = {(c.recording, c.output): c for c in case.coordinates.channels}
    out = []
    for c in coordinates.channels:
        full = known[c.recording, c.output]
        v = np.interp(np.log(c.frequency), np.log(full.frequency), np.log(noise[c.recording, c.output]))
        out.append(np.exp(-0.5 * v)[c.band])
    return out


@dataclass(frozen=True)
class Screened:
    """The entries' best directions, best first, and the chance that noise alone gives one as good as the best."""

    metric: Rows
    rig: Structure
    directions: list[Direction]
    p_any: float


def screened(case: Case, fitted: Fitted, share: float = 0.0) -> Screened:
    """Screen the catalogue, at the places of the plant as it came: what is missing is the rig's, not an effect's."""
    case.budget.screenings_done += 1
    moving = bool(Structure(case.plant, [], []).velocities) if case.plant.nodes else False
    metric = Rows(case, fitted, MOVING_ROWS if moving else ROWS, share)
    rig = Structure(fitted.rough_plant, metric.drives, [t.columns for t in case.tables])
    added = (fitted.plant.nodes.keys() | fitted.plant.flows.keys()) - (
        case.plant.nodes.keys() | case.plant.flows.keys()
    )
    found = [
        c
        for c in candidates(rig, case.catalogue)
        if c.key not in fitted.hypothesis.keys and not c.place.parts() & added
    ]
    draws = np.random.default_rng(1).standard_normal((len(metric.sketch(metric.residual[:, None])), DRAWS))
    ranked, chance = screen(metric, rig, found, draws)
    return Screened(metric, rig, ranked, _p_any(ranked, chance))


def _p_any(ranked: Sequence[Direction], chance: np.ndarray | None) -> float:
    """Chance of a direction as good as the best: the draws' smallest p tell how many independent ones there are."""
    if not ranked or chance is None:
        return 1.0
    p = np.clip(10.0 ** np.asarray(chance), 0.0, 1 - 1e-9)
    trials = max(1.0, -len(p) / float(np.sum(np.log1p(-p))))
    return float(-np.expm1(trials * np.log1p(-min(10.0 ** ranked[0].log_p, 1 - 1e-9))))


def places(case: Case) -> dict[str, set[str]]:
    """Every effect that has a place in the plant, and its places: what an effect's prior odds are shared among."""
    drives = case.drives(case.null.model)
    rig = Structure(case.plant, drives, [t.columns for t in case.tables])
    out: dict[str, set[str]] = {}
    for c in candidates(rig, case.catalogue):
        out.setdefault(c.effect.name, set()).add(c.place.where)
    return out
