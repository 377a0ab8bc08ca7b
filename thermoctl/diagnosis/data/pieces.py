"""Pieces of a recording that are as long as a free run remembers its start.

In a chaotic plant an error of the start grows exponentially, until a free run tells nothing about the
recording. Such a recording is cut; each piece starts from its own readings. The growth is that of the
output's most sensitive change by an initial state, over the noise:

    g(t) = max |dy(t) / dx0| sigma(x0) / sigma(y),   over outputs y and initial states x0
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Plant
from thermoctl.plant.parts import FEW, direct_outputs, part, unread_starts
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.recording.table import Table

LOST = 1e4  # growth over a recording, from which it is cut
# It also has to be so many times the growth over the first half: a body that drifts has a growth of t or t^2.
EXPONENTIAL = 30.0
KEPT = 4.0  # growth at which a piece ends: with 10, the unknown flows do not follow the Lorenz system


def in_pieces(plant: Plant, tables: Sequence[Table]) -> tuple[list[Table], list[str]]:
    """Return recordings, those whose start a free run forgets as pieces, and a note on each of these."""
    model = compile_plant(plant)
    if unread_starts(plant) or not model.uncertain or not tables:
        return list(tables), []
    drives = [model.excitation(t) for t in tables]
    sigma = np.array([n.sigma for n in default_noise(plant, drives)])
    out, notes = list[Table](), list[str]()
    for t, d in zip(tables, drives, strict=True):
        pieces, growth = _pieces(model, t, d, sigma)
        out += pieces
        if len(pieces) > 1:
            notes.append(
                f"a free run of {t.name} forgets its start: an error grows {growth:.0e} times; read as "
                f"{len(pieces)} recordings, each with a start of its own"
            )
    return out, notes


def with_free_starts(plant: Plant, tables: Sequence[Table]) -> Plant:
    """Return a plant whose unread states may start anywhere in their range over its runs.

    A start that the plant file states holds for a recording, not for its pieces. Where the plant cannot be
    simulated, it is returned as it is."""
    model, read = compile_plant(plant), direct_outputs(plant)
    loose = [n for n in model.uncertain if n not in read]
    try:
        runs = [model.run(model.prepare(model.excitation(t))).x for t in tables] if loose else []
    except SimulationError:
        return plant
    nodes = dict(plant.nodes)
    for n in loose:
        spread = float(np.nanstd(np.concatenate(runs)[:, model.states.index(n)]))
        nodes[n] = replace(nodes[n], initial_sigma=max(nodes[n].initial_sigma or 0.0, spread))
    return replace(plant, nodes=nodes)


def _pieces(model: Model, table: Table, d: Excitation, sigma: np.ndarray) -> tuple[list[Table], float]:
    """Return a recording, or its pieces, and the growth over all of it."""
    whole = _growth(model, d, sigma)
    if len(whole) < 2 * FEW or whole[-1] < max(LOST, EXPONENTIAL * whole[len(whole) // 2]):
        return [table], 1.0
    ends = [0]
    while ends[-1] < len(table):
        begin = ends[-1]
        rest = part(table, begin, len(table), 1 + begin)
        growth = _growth(model, model.excitation(rest), sigma)
        length = int(np.searchsorted(growth, KEPT)) if len(growth) else len(rest)
        ends.append(min(begin + max(length, FEW), len(table)))
    if len(ends) > 2 and ends[-1] - ends[-2] < FEW:
        del ends[-2]
    pairs = zip(ends[:-1], ends[1:], strict=True)
    return [part(table, a, b, k) for k, (a, b) in enumerate(pairs, 1)], float(whole[-1])


def _growth(model: Model, d: Excitation, sigma: np.ndarray) -> np.ndarray:
    """Return the largest growth (N,) so far of an error of the start; empty where a simulation fails."""
    try:
        run = model.run(model.prepare(d), None, None, sensitivities=True, states=False)
    except SimulationError:
        return np.zeros(0)
    start = np.array([model.plant.nodes[n].initial_sigma or 1.0 for n in model.uncertain])
    change = np.abs(run.sensitivities[:, :, len(model.active) :]) * start / sigma[:, None]
    growth = np.maximum.accumulate(change.reshape(len(change), -1).max(axis=1))
    return np.asarray(growth / max(growth[0], 1e-300))
