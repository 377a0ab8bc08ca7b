"""Fewer rows without loss: means over blocks of a recording, about the run of a refitted plant.

A logger writes far more rows than a slow plant needs. Rows of a long recording are put together `block` at a
time, one row at the middle of each block:

    y = yhat(middle) + mean over the block (y - yhat)

yhat is the run of the plant, refitted to coarse means. It holds the fast changes of the outputs. So only the
plant's error has to be smooth over a block. White noise of standard deviation s becomes s / sqrt(block).

A block ends where an input jumps, so that it does not mix readings from before and after the jump. The
rows left before a jump, fewer than a block, give no value. A held input keeps the exact times of its changes:
each has a row of its own, without outputs. An input that changes too often for that is averaged.

`block` is the largest number that passes four tests in every recording:

- The plant's error is white above half of the new highest frequency. No band of DCT rows there has more
  power than the highest half of all rows, and no single row (an oscillation) has (Fisher 1929).
- Averaged inputs vary within a block by little: AVERAGED of their variance. So functions that are not linear
  in an input keep their mean.
- Averaged inputs leave the run of the refitted plant as it is. The differences of an output in a recording
  have together less than the energy BENT of a reading's noise.
- The means keep the information on each parameter and initial state, and on a delay of each output. The
  information is 1 / diag([J'J + prior]^-1), with all other unknowns free. A delay changes a reading in
  proportion to its slope, as fast as any effect does.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.fft import dct
from scipy.special import chdtri

from thermoctl.diagnosis.data.coordinates import bands
from thermoctl.plant.fitting.cores import each
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.fitting.whitening import Noise, default_noise
from thermoctl.plant.language import Plant, SensorNoise
from thermoctl.plant.simulation.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.plant.units import in_plant_units
from thermoctl.recording.table import Table

# None of these numbers chooses a hypothesis.
WIDER = 1.05  # largest factor by which averaging may increase an unknown's standard deviation
LOST = 0.05  # largest share of the rows that are left out before jumps
LONG = 12_000  # up to so many rows in all recordings a diagnosis takes seconds: no row is averaged
# Least number of rows of an averaged recording: forty bands, a tenth of the rows in the highest.
FEWEST = 1_000
# At half of the new highest frequency the mean of a block keeps sinc(1/4)^2 = 81 % of the power.
# Faster content has at most WHITE - 1 = 10 % of the noise's power: 2 % of the highest band are lost.
HALF_BAND = 2.0  # the new highest frequency over that of the fastest content
WHITE = 1.1  # a band is white up to so many times the power of the highest rows
CHANCE = 1e-3  # chance that white noise of any output in any recording fails the tests of bands or of rows
AVERAGED = 1e-3  # share of an input's variance that averaging may remove: its mean square is as exact
BENT = 1.0  # largest sum of squares of what averaged inputs change in an output, over its noise
OUTLIER = 6.0  # a cell so many robust standard deviations from the median of its neighbours is dropped
GAP = 1.5  # a block that lasts so many times the usual duration lacks rows: it gives no value


@dataclass(frozen=True)
class Reduced:
    """Recordings with fewer rows. `block`: number of rows averaged to one; `before`: number of rows before.

    `z`: unknowns of a rough refit, where one was needed."""

    tables: list[Table]
    block: int
    before: int
    z: np.ndarray | None = None

    @property
    def note(self) -> str:
        """Return a sentence for the result: how many rows were averaged to one."""
        return (
            f"{sum(map(len, self.tables))} of {self.before} rows were needed: means of {self.block} rows hold the same "
            "information; noise and errors below are those of the means"
        )


def noise_of_means(plant: Plant, drives: Sequence[Excitation], block: int) -> tuple[Noise, ...]:
    """Return the noise of each output in means of `block` rows: only the white part becomes smaller."""
    out = []
    for n, o in zip(default_noise(plant, drives), plant.outputs.values(), strict=True):
        if block > 1 and o.noise_sd:
            white = o.noise.white if isinstance(o.noise, SensorNoise) else n.sigma
            mean = np.sqrt(max(n.sigma**2 - white**2 * (1 - 1 / block), 0.0))
            n = dataclasses.replace(n, sigma=float(mean))
        out.append(n)
    return tuple(out)


def reduced(plant: Plant, tables: Sequence[Table]) -> Reduced:
    """Return recordings with as few rows as hold the same information; the same ones if they are short."""
    before = sum(map(len, tables))
    kept = Reduced(list(tables), 1, before)
    if before <= LONG:
        return kept
    model = compile_plant(plant)
    coarse = min(
        next((b for b in _sizes(len(t) // FEWEST) if _allowed(model.excitation(t), b)), 1) for t in tables
    )
    if coarse == 1:
        return kept
    drives = [model.excitation(means(model, t, coarse)) for t in tables]
    noise = noise_of_means(plant, drives, coarse)
    try:
        coarse_fit = fit(model, drives, noise, tolerance=1e-3, seconds=np.inf)
        chance = CHANCE / (len(tables) * len(model.outputs))
        point = [(*start, coarse, chance) for start in zip(coarse_fit.values, coarse_fit.dx0, strict=True)]
        numbers = before * len(model.states) * len(model.unknowns)
        block = min(each(lambda r: _block(model, tables[r], *point[r]), range(len(tables)), numbers))
    except SimulationError:
        return kept
    if block == 1:
        return dataclasses.replace(kept, z=coarse_fit.z)
    out = [means(model, t, block, *start[:2]) for t, start in zip(tables, point, strict=True)]
    return Reduced(out, block, before, coarse_fit.z)


def _block(
    model: Model, table: Table, values: np.ndarray, dx0: np.ndarray, coarse: int, chance: float
) -> int:
    """Return the largest block, at most `coarse`, that a recording allows.

    `chance`: the probability that an output's white noise fails a test."""
    d = model.excitation(table)
    problem = Problem(model, [d], default_noise(model.plant, [d]))
    run = model.run(d, values, dx0, sensitivities=True, states=False)
    used, unknowns, slope = problem.slopes(0, values)
    prior = problem.prior()[unknowns]
    content = max(_content(e, chance) for e in (d.y - run.y).T)

    def columns(j: int) -> np.ndarray:
        """Return the whitened slopes (N, k + 1) of an output's readings by the unknowns and by its delay."""
        by = np.column_stack([run.sensitivities[:, j, used] * slope, np.gradient(run.y[:, j], d.t)])
        return np.where(np.isfinite(d.y[:, j, None]), by / problem.noise[j].sigma, 0.0)

    whole = _information(columns, d, np.arange(len(d.t)), 1, prior)

    def enough(b: int) -> bool:
        """Return whether means of b rows keep the information on each unknown."""
        if not _allowed(d, b) or _bent(model, table, b, (values, dx0), run.y) > BENT:
            return False
        return bool((_information(columns, d, _starts(d, b), b, prior) >= whole / WIDER**2).all())

    sizes = _sizes(min(coarse, int(len(d.t) / (HALF_BAND * content + 1))))
    first = bisect_left(sizes, True, key=enough)  # the larger a block, the more information is lost
    return sizes[first] if first < len(sizes) else 1


def _bent(
    model: Model, table: Table, block: int, start: tuple[np.ndarray, np.ndarray], y: np.ndarray
) -> float:
    """Return by how much averaged inputs change a run: sum of squares over the noise, of the worst output.

    `start`: parameters and shifts of initial states of the run by all rows, y (N, outputs)."""
    few = means(model, table, block, *start)
    d = model.excitation(few)
    change = model.run(d, *start).y - y[np.searchsorted(table.t, few.t)]
    noise = noise_of_means(model.plant, [model.excitation(table)], block)
    squares = np.where(np.isfinite(d.y), change / [n.sigma for n in noise], 0.0) ** 2
    return float(squares.sum(axis=0).max())


def _sizes(most: int) -> list[int]:
    """Return the block sizes to try, the largest first. They are odd, so that the middle is a row."""
    return sorted({(int(most * 0.8**k) - 1) // 2 * 2 + 1 for k in range(40)} - {1, -1}, reverse=True)


def _information(
    columns: Callable[[int], np.ndarray], d: Excitation, starts: np.ndarray, block: int, prior: np.ndarray
) -> np.ndarray:
    """Return the information on each of k unknowns, then on a delay of each output, in means of blocks.

    `columns` of an output (N, k + 1): whitened slopes of its readings by the unknowns, and by its delay; 0
    where nothing was measured. `prior` (k,): prior precision of the unknowns."""
    k, rows = len(prior), starts[:, None] + np.arange(block)
    gram = np.diag(np.concatenate([prior, np.zeros(d.y.shape[1])]))
    for j in range(d.y.shape[1]):
        count = np.isfinite(d.y[rows, j]).sum(axis=1)
        mean = columns(j)[rows].sum(axis=1) / np.sqrt(np.maximum(count, 1))[:, None]
        mean[2 * count <= block] = 0.0  # as in `means`: such a block gives no value
        entries = np.ix_([*range(k), k + j], [*range(k), k + j])
        gram[entries] += mean.T @ mean
    seen = np.flatnonzero(np.diag(gram) > 0)
    size = np.sqrt(np.diag(gram)[seen])
    out = np.zeros(len(gram))
    scaled = gram[np.ix_(seen, seen)] / np.outer(size, size)
    out[seen] = size**2 / np.diag(np.linalg.pinv(scaled, hermitian=True))
    return out


def _content(y: np.ndarray, chance: float) -> int:
    """Return the DCT row above which a signal is white. `chance`: probability that white noise fails."""
    y = y[np.isfinite(y)]
    if len(y) < FEWEST or not np.ptp(y):
        return 0
    # the straight line between the ends would put a 1 / f^2 tail into all rows
    power = dct(y - np.linspace(y[0], y[-1], len(y)), norm="ortho") ** 2
    floor = float(np.mean(power[len(power) // 2 :]))
    edges, count, _ = bands(len(power))
    mean = np.add.reduceat(power, edges[:-1]) / count
    loud = edges[1:][mean > floor * (WHITE - 1 + chdtri(count, chance / len(count)) / count)]
    lines = np.flatnonzero(power > floor * chdtri(1, chance / len(power))) + 1
    return int(max(loud.max(initial=0), lines.max(initial=0)))


def _allowed(d: Excitation, block: int) -> bool:
    """Do blocks of this size use half of the rows or more, and keep each input's changes or its variance?"""
    starts = _starts(d, block)
    rows = starts[:, None] + np.arange(block)
    if 2 * rows.size < len(d.t):
        return False
    for j, u in enumerate(d.u.T):
        if len(_changes(d, j, block)):
            continue
        part = u[rows]
        if d.linear[j]:  # a straight line within the block is kept
            part = part - np.linspace(-0.5, 0.5, block) * (part[:, -1:] - part[:, :1])
        if np.mean(np.var(part, axis=1)) > AVERAGED * np.var(u):
            return False
    return True


def _changes(d: Excitation, j: int, block: int) -> np.ndarray:
    """Return the rows at which a held input changes; none if there are more changes than blocks."""
    rows = np.flatnonzero(d.u[1:, j] != d.u[:-1, j]) + 1
    return rows if not d.linear[j] and len(rows) <= len(d.t) // block else rows[:0]


def switches(u: np.ndarray) -> np.ndarray:
    """Return how far an input (N,) jumps after each row (N - 1,); 0 where its step is a usual one."""
    step = np.abs(np.diff(u))
    return np.where(step > OUTLIER * 1.4826 * np.median(step), step, 0.0)


def _jumps(d: Excitation, block: int) -> np.ndarray:
    """Return the rows at which a block ends because an input jumps.

    Each costs half a block of rows on average. So only the largest jumps are used, relative to the standard
    deviation of their input, until the share LOST of the rows is lost."""
    size = np.zeros(len(d.t) - 1)
    for u in d.u.T:
        size = np.maximum(size, switches(u) / (np.std(u) or 1.0))
    size[: block - 1] = 0.0  # the first block is at the start
    most = int(LOST * len(d.t) / (0.5 * block))
    largest = np.argsort(-size, kind="stable")[:most]
    return np.sort(largest[size[largest] > 0]) + 1


def _starts(d: Excitation, block: int) -> np.ndarray:
    """Return the first row of each block."""
    ends = [0, *_jumps(d, block).tolist(), len(d.t)]
    return np.concatenate([np.arange(a, z - block + 1, block) for a, z in pairwise(ends)])


def means(
    model: Model, table: Table, block: int, values: np.ndarray | None = None, dx0: np.ndarray | None = None
) -> Table:
    """Return a recording with a row for each block, one for each change of a held input, two for other jumps.

    `values`, `dx0`: parameters and shifts of the initial states of the run yhat."""
    table = in_plant_units(model.plant, table)
    d = model.excitation(table)
    starts, jumps = _starts(d, block), _jumps(d, block)
    middle = starts + block // 2  # an input that is averaged holds from one of these rows to the next
    inputs = list(model.plant.inputs.values())
    seldom = [_changes(d, j, block) for j in range(len(inputs))]
    before = jumps - 1 if d.linear.any() else jumps
    rows = np.unique(np.concatenate([[0], middle, jumps, before, *seldom]))
    columns = {name: _held_mean(c, rows) for name, c in table.columns.items()}
    for j, i in enumerate(inputs):
        if len(seldom[j]):
            columns[i.column] = d.u[rows, j]
        elif d.linear[j]:
            columns[i.column] = _centred(d.u[:, j], rows, block, jumps)
    try:
        run = model.run(d, values, dx0).y
    except SimulationError:
        run = np.zeros_like(d.y)
    noise = default_noise(model.plant, [d])
    span = d.t[starts + block - 1] - d.t[starts]
    whole = span <= GAP * np.median(span)
    place = middle.copy()
    place[0] = 0  # the plant starts at the first value of an output
    positions = np.searchsorted(rows, place)
    for j, o in enumerate(model.plant.outputs.values()):
        if o.column in table.columns:
            error = (d.y[:, j] - run[:, j])[starts[:, None] + np.arange(block)]
            seen = np.isfinite(error).any(axis=1, keepdims=True)
            away = np.abs(error - np.nanmedian(np.where(seen, error, 0.0), axis=1, keepdims=True))
            good = away <= OUTLIER * max(1.4826 * float(np.nanmedian(away)), noise[j].sigma)
            count = good.sum(axis=1)
            mean = np.where(good, error, 0.0).sum(axis=1) / np.maximum(count, 1)
            columns[o.column] = np.full(len(rows), np.nan)
            columns[o.column][positions] = np.where(whole & (2 * count > block), run[place, j] + mean, np.nan)
    return dataclasses.replace(table, t=table.t[rows], columns=columns)


def _held_mean(column: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the mean of a column's values from each row to the next."""
    good = np.isfinite(column)
    count = np.add.reduceat(good.astype(float), rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.add.reduceat(np.where(good, column, 0.0), rows) / count


def _centred(u: np.ndarray, rows: np.ndarray, block: int, jumps: np.ndarray) -> np.ndarray:
    """Return the mean of u over a block centred on each row; at jumps and ends the block is shorter."""
    total = np.concatenate([[0.0], np.cumsum(u)])
    ends = np.concatenate([[0], jumps, [len(u)]])
    part = np.searchsorted(ends, rows, side="right")
    reach = np.minimum(np.minimum(rows - ends[part - 1], ends[part] - 1 - rows), block // 2)
    return (total[rows + reach + 1] - total[rows - reach]) / (2 * reach + 1)
