"""Score test of every catalogue entry at every place, given a fitted hypothesis, its noise and remainder."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, as_refitted
from thermoctl.diagnosis.evidence.levels import PRESENT, over_noise
from thermoctl.diagnosis.hypothesis.candidates import Key, candidates
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.search.again import Known
from thermoctl.diagnosis.search.fine import above, fine
from thermoctl.diagnosis.search.gains import PLACES_EACH, Direction, foremost
from thermoctl.diagnosis.search.metric import Metric, Plain
from thermoctl.diagnosis.search.overlay import Trajectory
from thermoctl.diagnosis.search.screen import Norms, Select, screen, sharpened
from thermoctl.diagnosis.search.sketch import likeliest

LOUD = 2.0  # residual's rms over the noise, from which energy is the better guide
PROMISED = 30  # number of directions whose gain in log likelihood is predicted
ROOM = 2  # largest number of places of one effect among them, over PLACES_EACH


@dataclass(frozen=True)
class Screened:
    """The catalogue's best directions, each `promised` with its predicted gain in log likelihood.

    `every`: the best direction of each candidate, with its vector. `energy`: the rows whitened by the
    sensors' noise alone; `by_energy`: all directions, sorted by their gain there. Where the plant has a large
    error, a first-order step predicts the log likelihood badly, and this gain in energy is a better guide.
    Both are empty where the residual is not LOUD. `norms`: of all columns; empty where not all were
    simulated."""

    metric: Metric
    rig: Rig
    promised: list[tuple[Direction, float]]
    every: list[Direction]
    energy: Metric | None
    by_energy: list[Direction]
    norms: list[Norms]


def screened(case: Case, fitted: Fitted, known: Known | None = None) -> Screened:
    """Screen the catalogue at the places of the original plant. Parts that an effect added are no places.

    Where the residual is far above the noise, or a remainder may hide a slow effect, screen a second time
    with that noise alone.
    `known`: the first screening, which fills it; a later one may simulate few directions (again.py)."""
    refitted = as_refitted(case, fitted)
    plain = Plain(case, fitted.rough)
    metric = Metric(plain, refitted.average, True)
    loud = max(over_noise(case, refitted)) > LOUD
    slow = max(refitted.average.remainder) >= PRESENT
    other = Metric(plain, refitted.average, False) if loud or slow else None
    rig = case.rig(fitted.rough_plant, metric.drives)
    now, own = fitted.plant, case.plant
    added = (now.nodes.keys() | now.flows.keys() | now.parameters.keys()) - (
        own.nodes.keys() | own.flows.keys() | own.parameters.keys()
    )
    # no part of an effect is a place, but for its size, which may differ between recordings
    effects = fitted.hypothesis.effects
    added -= {e.own.get(p.name, "") for e in effects for p in e.candidate.effect.parameters if p.amplitude}
    placed = [
        c
        for c in candidates(rig, case.catalogue)
        if c.key not in fitted.hypothesis.keys and not {c.place.where, *c.place.parts()} & added
    ]
    norms: list[Norms] = []
    metrics = [metric, other] if other else [metric]
    known = known or Known()
    select: Select = likeliest
    if known.count == 0:
        known.outputs = [run.y for run in metric.runs]
    elif other is None and known.like(metric):
        select = known.likeliest
    keep = None if known.count else known.add
    best, *rest = screen(metrics, rig, placed, select=select, norms=norms, keep=keep)
    promised = [(d, _promise(metric, d)) for d in _foremost(metric, rig, best)]
    by_energy = rest[0] if rest else []
    if other:
        again = [(d, _promise(other, d)) for d in _foremost(other, rig, by_energy)]
        by_key = {d.candidate.key: promise for d, promise in promised}
        promised = [(d, p) for d, p in promised if p >= 0] + [
            (dataclasses.replace(d, vector=None), p)  # its vector is of another metric
            for d, p in again
            if p > by_key.get(d.candidate.key, 0.0)
        ]
    upper = above(case.coordinates, refitted.average.inverse, plain.coordinates)
    trajectories = [Trajectory(metric, rig, r) for r in range(len(metric.drives))] if upper else []
    picked = (d for c in placed for d in fine(metric, trajectories, c, upper))
    promised += [(d, 0.5 * d.gain - float(np.log(10)) * d.elsewhere) for d in picked]
    promised.sort(key=lambda x: -x[1])
    energy, by_energy = (other, by_energy) if loud else (None, [])
    return Screened(metric, rig, promised, best, energy, by_energy, norms)


def places(case: Case) -> dict[str, set[str]]:
    """Return the places of the plant that share each effect's prior odds.

    Recorded inputs take no share of an effect that has other places: a fault there is `rare`."""
    drives = case.drives(case.null.model)
    found = candidates(case.rig(case.plant, drives), case.catalogue)
    usual = {c.effect.name for c in found if not c.place.input}
    out: dict[str, set[str]] = {}
    for c in found:
        if not c.place.input or c.effect.name not in usual:
            out.setdefault(c.effect.name, set()).add(c.place.where)
    return out


def _foremost(metric: Metric, rig: Rig, found: list[Direction]) -> list[Direction]:
    """Return the directions whose gain is predicted, events at their best times: the grid's are too rough."""
    first, clocks = list[Direction](), set[Key]()
    for d in foremost(found, ROOM * PLACES_EACH):
        if d.candidate.begins:  # only the best one at each place
            if d.candidate.key in clocks:
                continue
            clocks.add(d.candidate.key)
        first.append(d)
    return [sharpened(metric, rig, d) for d in first[:PROMISED]]


def _promise(metric: Metric, d: Direction) -> float:
    """Return the predicted gain in log likelihood of a first-order step along the direction."""
    if d.vector is None or d.gain <= 0:
        return 0.0
    v = d.vector.astype(float)
    return metric.around.rise(metric.powers(metric.residual - v * (v @ metric.residual)))
