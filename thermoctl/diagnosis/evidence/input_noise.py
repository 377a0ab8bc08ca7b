"""The noise of inputs' readings, which a plant adds up: a body heated by a noisy reading walks at random.

A plant is driven by readings. Where a reading scatters by s about a smooth course, the outputs err by the
plant's response to s e, e white. A heat source or a second ambient would follow the slowest part of it. Its
power in each band is the mean over DRAWS responses at the plant's refit. It is added to the spectrum of the
stated noise (grids.py) where the plant alone is likelier so."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Case
from thermoctl.diagnosis.data.coordinates import rows_of_each
from thermoctl.diagnosis.data.grids import Grid
from thermoctl.diagnosis.evidence.between import alone

DRAWS = 16
# x_k - (x_(k-1) + x_(k+1)) / 2 of white noise: its variance, and its correlation with the next one
SPREAD, NEXT = 1.5, -2 / 3
WHITE = 0.1  # largest difference of that correlation from NEXT; a course that is not smooth is no noise
WILD = 4.0  # standard deviations to which these are cut: jumps of a course are no noise, either
SEEN = 0.05  # least power, over the stated noise's, in a band where it is seen
CLEARLY = 4.6  # nats: a plant without this noise is a hundredth as likely


def with_input_noise(case: Case) -> Case:
    """Return the case with the noise of its inputs, if the plant alone is clearly likelier with it."""
    columns = sorted({i.column for i in case.plant.inputs.values() if not case.plant.trusts(i.name)})
    found = {c: s for c in columns if (s := scatter([t.columns[c] for t in case.tables]))}
    if not found:
        return case
    try:
        grids = tuple(_noisier(g, p) for g, p in zip(case.grids, _powers(case, found), strict=True))
        other = dataclasses.replace(case, grids=grids)
        if grids == case.grids or (gain := alone(other) - alone(case)) < CLEARLY:
            return case
    except FAILS:
        return case
    names = ", ".join(f"{c} ({s:.2g})" for c, s in found.items())
    note = f"the noise of {names} moves the outputs, too: the plant alone is likelier so ({gain:.0f} nats); counted as noise"
    return dataclasses.replace(other, noisy=True, notes=[*case.notes, note])


def scatter(columns: Sequence[np.ndarray]) -> float:
    """Return the standard deviation of white noise about a smooth course; 0 for any other course.

    `columns`: (N,) of each recording."""
    bent = [x[1:-1] - 0.5 * (x[:-2] + x[2:]) for x in columns]
    sd = 1.4826 * float(np.median(np.abs(np.concatenate(bent))))
    if not sd > 0:
        return 0.0
    cut = [np.clip(d, -WILD * sd, WILD * sd) for d in bent]
    beside = sum(float(d[1:] @ d[:-1]) for d in cut) / sum(float(d @ d) for d in cut)
    return sd / SPREAD**0.5 if abs(beside - NEXT) < WHITE else 0.0


def _powers(case: Case, found: Mapping[str, float]) -> list[np.ndarray]:
    """Return the mean power (nodes,) of the response of each output. Raises SimulationError."""
    model, fit, rng = case.null.model, case.null, np.random.default_rng(0)
    powers = [np.zeros(len(c.count)) for c in case.coordinates.channels]
    for _ in range(DRAWS):
        each = iter(powers)
        for r, (t, d) in enumerate(zip(case.tables, case.drives(model), strict=True)):
            noisy = {c: t.columns[c] + s * rng.standard_normal(len(t)) for c, s in found.items()}
            moved = model.excitation(dataclasses.replace(t, columns={**t.columns, **noisy}))
            moved = dataclasses.replace(moved, rtol=d.rtol)
            point = fit.values[r], fit.dx0[r]
            response = model.run(moved, *point).y - model.run(d, *point).y
            channels = case.coordinates.of_recording(r)
            for c, row in zip(channels, rows_of_each(channels, response), strict=True):
                power = next(each)
                power += np.bincount(c.band, row**2, len(power)) / DRAWS
    return [g.power(powers) for g in case.grids]


def _noisier(g: Grid, power: np.ndarray) -> Grid:
    """Return an output's grid with a further power (nodes,) in its stated noise; the same if it is small."""
    more = power / g.count / g.variance
    if more.max() < SEEN:
        return g
    shape = g.shape + more
    mean = float(shape @ g.count / g.count.sum())
    return dataclasses.replace(g, sigma=g.sigma * mean**0.5, shape=shape / mean)
