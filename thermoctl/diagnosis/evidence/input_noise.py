"""Errors of inputs that a plant adds up: a body heated by a noisy reading walks at random.

A plant is driven by readings. Where a reading scatters by s about a smooth course, the outputs err by the
plant's response to s e, e white. Where the times of its rows are off by j intervals, they err by that to
j e dx. dx is the change from row to row. A heat source or a second ambient would follow the slowest part. The
power of the response in each band is the mean over DRAWS, at the plant's refit. It is added to the spectrum
of the stated noise (grids.py) where the plant alone is likelier so."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from thermoctl.diagnosis.data.case import FAILS, Budget, Case
from thermoctl.diagnosis.data.coordinates import rows_of_each
from thermoctl.diagnosis.data.grids import Grid
from thermoctl.diagnosis.evidence.between import alone
from thermoctl.diagnosis.evidence.fit import fitted
from thermoctl.diagnosis.evidence.levels import over_noise

DRAWS = 16
# x_k - (x_(k-1) + x_(k+1)) / 2 of white noise: its variance, and its correlation with the next one
SPREAD, NEXT = 1.5, -2 / 3
WHITE = 0.1  # largest difference of that correlation from NEXT; a course that is not smooth is no noise
WILD = 4.0  # standard deviations to which these are cut: jumps of a course are no noise, either
LATE = (0.03, 0.1, 0.3)  # errors of times that are tried, in intervals
# Largest error over the noise beside which times are tried: a large one is like late times only since it is
# large. So it was on three of 18 real rigs with missing physics, by 2000 nats and more.
SMALL = 2.0
SEEN = 0.05  # least power, over the stated noise's, in a band where it is seen
CLEARLY = 6.0  # nats; on 60 generated cases, whose times are exact, 4.9 at most

Errors = Mapping[str, Sequence[np.ndarray]]  # sd of an input in each row (N,), by column and recording


def with_input_noise(case: Case) -> Case:
    """Return the case with the errors of its inputs, if the plant alone is clearly likelier with them."""
    best, gain, said = case, CLEARLY, ""
    try:
        null = fitted(dataclasses.replace(case, budget=Budget(1)), case.plant, (), case.null)
        for what, sizes, errors in _kinds(case, max(over_noise(case, null))):
            powers = _powers(case, errors)
            for size in sizes:
                grids = tuple(_noisier(g, size**2 * p) for g, p in zip(case.grids, powers, strict=True))
                if grids == case.grids:
                    continue
                other = dataclasses.replace(case, grids=grids, noisy=True)
                if (rise := alone(other) - null.log_evidence) > gain:
                    best, gain, said = other, rise, what.format(size)
    except FAILS:
        pass
    note = f"{said} may move the outputs: the plant alone is likelier so ({gain:.0f} nats); counted as noise"
    return dataclasses.replace(best, notes=[*case.notes, note]) if said else case


def _kinds(case: Case, over: float) -> Iterator[tuple[str, Sequence[float], Errors]]:
    """Yield each kind of error: in words, its sizes, and the standard deviations at size 1.

    `over`: error of the plant alone over the noise."""
    columns = sorted({i.column for i in case.plant.inputs.values() if not case.plant.trusts(i.name)})
    of = {c: [t.columns[c] for t in case.tables] for c in columns}
    found = {c: s for c, x in of.items() if (s := scatter(x))}
    if found:
        names = ", ".join(f"{c} ({s:.2g})" for c, s in found.items())
        yield f"noise of {names}", (1.0,), {c: [np.full(len(x), s) for x in of[c]] for c, s in found.items()}
    if over < SMALL:
        steps = {c: [np.abs(np.diff(x, prepend=x[:1])) for x in xs] for c, xs in of.items()}
        yield "times of inputs that are off by {:g} of an interval", LATE, steps


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


def _powers(case: Case, errors: Errors) -> list[np.ndarray]:
    """Return the mean power (nodes,) of each output's response. Raises SimulationError."""
    model, fit, rng = case.null.model, case.null, np.random.default_rng(0)
    powers = [np.zeros(len(c.count)) for c in case.coordinates.channels]
    for _ in range(DRAWS):
        each = iter(powers)
        for r, (t, d) in enumerate(zip(case.tables, case.drives(model), strict=True)):
            noisy = {c: t.columns[c] + sd[r] * rng.standard_normal(len(t)) for c, sd in errors.items()}
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
    if not SEEN < more.max() < np.inf:
        return g
    shape = g.shape + more
    mean = float(shape @ g.count / g.count.sum())
    return dataclasses.replace(g, sigma=g.sigma * mean**0.5, shape=shape / mean)
