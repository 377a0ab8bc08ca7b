"""Errors of inputs that a plant adds up: a body heated by a noisy reading walks at random.

A plant is driven by readings. Where a reading scatters by s about a smooth course, the outputs err by the
plant's response to s e, e white. Where the times of its rows are off by j intervals, they err by that to
j e dx. dx is the change from row to row. A heat source or a second ambient would follow the slowest part. The
power of the response in each band is the mean over DRAWS, at the plant's refit. It is added to the spectrum
of the stated noise (grids.py) where the plant alone is likelier so."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from thermoctl.diagnosis.data.case import FAILS, Budget, Case
from thermoctl.diagnosis.data.coordinates import rows_of_each
from thermoctl.diagnosis.data.grids import Grid
from thermoctl.diagnosis.evidence.fit import Fitted, fitted
from thermoctl.diagnosis.evidence.levels import over_noise
from thermoctl.diagnosis.evidence.noise import averaged
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.table import Table

DRAWS = 8
# x_k - (x_(k-1) + x_(k+1)) / 2 of white noise: its variance, and its correlation with the next one
SPREAD, NEXT = 1.5, -2 / 3
WHITE = 0.1  # largest difference of that correlation from NEXT; a course that is not smooth is no noise
MOST = 0.3  # largest noise, over the standard deviation of the reading: a switch in each row is white, too
WILD = 4.0  # standard deviations to which these are cut: jumps of a course are no noise, either
WIDTHS = (2.0, 8.0, 32.0)  # standard deviations of a smoothing Gaussian, in rows
TIMES = 3  # number of Gaussians; each further one smooths what the others took away
LATE = (0.03, 0.1, 0.3)  # errors of times that are tried, in intervals
# Largest error over the noise beside which times are tried: a large one is like late times only since it is
# large. So it was on three of 18 real rigs with missing physics, by 2000 nats and more.
SMALL = 2.0
SEEN = 0.05  # least power, over the stated noise's, in a band where it is seen
CLEARLY = 6.0  # nats; on 60 generated cases, whose times are exact, 4.9 at most


@dataclass(frozen=True)
class Errors:
    """Errors of inputs, in words.

    `sd`: their standard deviation in each row (N,), by column and recording, at a size of 1; `sizes`: those
    that are tried. `width`: of the Gaussian by which these inputs are smoothed, rows."""

    what: str
    sd: Mapping[str, Sequence[np.ndarray]]
    sizes: Sequence[float] = (1.0,)
    width: float = 0.0

    def smoothed(self, tables: Sequence[Table]) -> list[Table]:
        """Return recordings whose inputs are smoothed."""
        if not self.width:
            return [*tables]
        return [
            replace(t, columns={**t.columns, **{c: smooth(t.columns[c], self.width) for c in self.sd}})
            for t in tables
        ]


def with_input_noise(
    case: Case, made: Callable[[Sequence[Table]], Case], reserve: Sequence[Table]
) -> tuple[Case, list[Table]]:
    """Return the case with the errors of its inputs, if the plant alone is clearly likelier with them.

    So are the recordings set aside: their inputs are smoothed as those of the case. `made`: makes the case of
    recordings."""
    best, taken, gain = case, None, CLEARLY
    try:
        null = _alone(case)
        for errors in _kinds(case, max(over_noise(case, null))):
            of = made(errors.smoothed(case.tables)) if errors.width else case
            found = _alone(of) if errors.width else null
            powers = _powers(of, errors)
            for size in errors.sizes:
                grids = tuple(_noisier(g, size**2 * p) for g, p in zip(of.grids, powers, strict=True))
                noisier = averaged(grids, found.powers).log_likelihood - found.log_likelihood
                if (rise := found.log_evidence + noisier - null.log_evidence) > gain:
                    best, gain = replace(of, grids=grids, noisy=True), rise
                    taken = replace(errors, what=errors.what.format(size))
    except (InputError, *FAILS):
        pass
    if taken is None:
        return case, [*reserve]
    smooth = f", smoothed over {taken.width:g} rows," if taken.width else ""
    note = f"{taken.what}{smooth} may move the outputs: the plant alone is likelier so ({gain:.0f} nats); counted as noise"
    return replace(best, notes=[*case.notes, note]), taken.smoothed(reserve)


def _alone(case: Case) -> Fitted:
    """Return the refit of a case's plant without effects. Raises SimulationError."""
    return fitted(replace(case, budget=Budget(1)), case.plant, (), case.null)


def _kinds(case: Case, over: float) -> Iterator[Errors]:
    """Yield each kind of error. `over`: error of the plant alone over the noise."""
    inputs = {i.column: i for i in case.plant.inputs.values() if not case.plant.trusts(i.name)}
    of = {c: [t.columns[c] for t in case.tables] for c in sorted(inputs)}
    found = {c: s for c, x in of.items() if (s := scatter(x))}
    if found:
        what = "noise of " + ", ".join(f"{c} ({s:.2g})" for c, s in found.items())
        sd = {c: [np.full(len(x), s) for x in of[c]] for c, s in found.items()}
        for width in (0.0, *WIDTHS) if all(inputs[c].linear for c in found) else (0.0,):
            yield Errors(what, sd, width=width)
    if over < SMALL:
        steps = {c: [np.abs(np.diff(x, prepend=x[:1])) for x in xs] for c, xs in of.items()}
        yield Errors("times of inputs that are off by {:g} of an interval", steps, LATE)


def scatter(columns: Sequence[np.ndarray]) -> float:
    """Return the standard deviation of white noise about a smooth course; 0 for any other course.

    `columns`: (N,) of each recording."""
    bent = [x[1:-1] - 0.5 * (x[:-2] + x[2:]) for x in columns]
    sd = 1.4826 * float(np.median(np.abs(np.concatenate(bent))))
    if not sd > 0:
        return 0.0
    cut = [np.clip(d, -WILD * sd, WILD * sd) for d in bent]
    beside = sum(float(d[1:] @ d[:-1]) for d in cut) / sum(float(d @ d) for d in cut)
    scattered = sd / SPREAD**0.5
    course = float(np.std(np.concatenate(columns)))
    return scattered if abs(beside - NEXT) < WHITE and scattered < MOST * course else 0.0


def smooth(x: np.ndarray, width: float) -> np.ndarray:
    """Return a course (N,) smoothed by a Gaussian of `width` rows, and what that took away, smoothed again.

    So a wave that one Gaussian halves keeps 0.88 (twicing: Tukey 1977)."""
    out = np.zeros_like(x)
    for _ in range(TIMES):
        out += gaussian_filter1d(x - out, width)
    return out


def _powers(case: Case, errors: Errors) -> list[np.ndarray]:
    """Return the mean power (nodes,) of each output's response. Raises SimulationError."""
    model, fit, rng, powers = case.null.model, case.null, np.random.default_rng(0), []
    for r, (t, d) in enumerate(zip(case.tables, case.drives(model), strict=True)):
        point, channels = (fit.values[r], fit.dx0[r]), case.coordinates.of_recording(r)
        without, own = model.run(d, *point).y, [np.zeros(len(c.count)) for c in channels]
        for _ in range(DRAWS):
            noise = {c: sd[r] * rng.standard_normal(len(t)) for c, sd in errors.sd.items()}
            if errors.width:
                noise = {c: smooth(x, errors.width) for c, x in noise.items()}
            noisy = {c: t.columns[c] + x for c, x in noise.items()}
            moved = replace(model.excitation(replace(t, columns={**t.columns, **noisy})), rtol=d.rtol)
            rows = rows_of_each(channels, model.run(moved, *point).y - without)
            for c, row, power in zip(channels, rows, own, strict=True):
                power += np.bincount(c.band, row**2, len(power)) / DRAWS
        powers += own
    return [g.power(powers) for g in case.grids]


def _noisier(g: Grid, power: np.ndarray) -> Grid:
    """Return an output's grid with a further power (nodes,) in its stated noise; the same if it is small."""
    more = power / g.count / g.variance
    if not SEEN < more.max() < np.inf:
        return g
    shape = g.shape + more
    mean = float(shape @ g.count / g.count.sum())
    return replace(g, sigma=g.sigma * mean**0.5, shape=shape / mean)
