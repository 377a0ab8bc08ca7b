"""Refits of a hypothesis with screened effects, from several starting points, in parallel."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from thermoctl.diagnosis.data.case import Case
from thermoctl.diagnosis.evidence.fit import Fitted, Placed, fitted
from thermoctl.diagnosis.search.extend import extend, sticking, weaker
from thermoctl.diagnosis.search.gains import Direction
from thermoctl.diagnosis.search.screen import sharpened
from thermoctl.diagnosis.search.screening import Screened
from thermoctl.diagnosis.search.shortlist import PAIR, Extension
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.cores import LEAST, each
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant

START = 10.0  # factor on the catalogue's standard deviation of an initial state that nobody measured


def refitted(
    case: Case, parent: Fitted, looked: Screened, batch: Sequence[Extension], leader: Fitted
) -> list[list[Fitted]]:
    """Refit a batch of extensions in parallel; return the refits of each."""
    starts = [tuple(sharpened(looked.metric, looked.rig, d) for d in added) for added, _ in batch]
    return each(lambda first: followed(case, parent, looked, first, leader), starts, len(batch) * LEAST)


def followed(
    case: Case, parent: Fitted, looked: Screened, first: Sequence[Direction], leader: Fitted
) -> list[Fitted]:
    """Refit the parent with the directions from several starting points, which depend on their shapes.

    If every refit fits worse than the parent, start again from a weaker effect."""
    stuck = tuple(sticking(d) or d for d in first)
    found = [_refitted(case, parent, first, looked, leader)]
    if stuck != first and max(d.gain for d in first) > looked.directions[0].gain / PAIR:
        found.append(_refitted(case, parent, stuck, looked, leader))
    if all(f is None or f.rough.cost > parent.rough.cost for f in found):
        found.append(_refitted(case, parent, tuple(weaker(d) for d in first), looked, leader))
    return [f for f in found if f is not None]


def _refitted(
    case: Case, parent: Fitted, added: Sequence[Direction], looked: Screened, leader: Fitted
) -> Fitted | None:
    effects, plant = parent.hypothesis.effects, parent.rough_plant
    drives = looked.metric.drives
    try:
        for d in added:
            rig = case.rig(plant, drives)
            d = dataclasses.replace(d, candidate=dataclasses.replace(d.candidate, rig=rig))
            inputs = plant.inputs.keys()
            plant, own = extend(plant, d, drives)
            if not own:  # an earlier effect replaced the place it acts on, so that it would change nothing
                return None
            if plant.inputs.keys() != inputs:  # a column of the recordings that an effect needs
                drives = case.drives(compile_plant(plant))
            effects = (*effects, Placed(d.candidate, own))
        return fitted(case, free_starts(parent.plant, plant), effects, None, leader, parent)
    except (SimulationError, InputError, np.linalg.LinAlgError):
        return None


def free_starts(before: Plant, after: Plant) -> Plant:
    """Widen the initial states of bodies that an effect added: nobody measured where they start.

    A node into which nothing flows is none: it holds a reading of the start. Nor is a slow sensor's, which an
    output reads alone: its spread is that of the true value."""
    moving = {end for f in after.flows.values() if f.rate is not ex.ZERO for end in (f.source, f.target)}
    read = [ex.names(o.value) & after.nodes.keys() for o in after.outputs.values()]
    nodes = {
        n.name: n
        if n.name in before.nodes or n.name not in moving or {n.name} in read or not n.initial_sigma
        else dataclasses.replace(n, initial_sigma=START * n.initial_sigma)
        for n in after.nodes.values()
    }
    return dataclasses.replace(after, nodes=nodes)
