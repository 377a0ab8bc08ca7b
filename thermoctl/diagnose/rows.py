"""Fewer rows without loss: means over blocks, where neither outputs nor inputs hold anything faster.

A logger writes far more rows than a slow plant needs. Rows of a long recording are put together `block` at a
time, one row at the middle of each block:

    y = yhat(middle) + mean over the block (y - yhat)

yhat is the run of the plant as it came. It carries what is fast in the outputs. So only the plant's error has
to be smooth over a block. White noise of standard deviation s becomes s / sqrt(block).

A held input keeps the exact times of its changes: each change has a row of its own, without outputs. An input
that changes too often for that is averaged from one row to the next. `block` is the largest number that
passes two tests in every recording:

- Every measured output is white above half of the new highest frequency. No band of DCT rows there has more
  power than the highest half of all rows.
- Averaged inputs vary within a block by little: AVERAGED of their variance. So functions that are not linear
  in an input keep their mean.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from thermoctl.diagnose.coordinates import band_edges
from thermoctl.plant.language import Plant, SensorNoise
from thermoctl.plant.recordings import in_plant_units
from thermoctl.plant.refit import Noise, default_noise
from thermoctl.plant.simulate import Excitation, Model, SimulationError, compile_plant
from thermoctl.recording.table import Table

# None of these numbers chooses a hypothesis. They limit the loss to about 2 % of the information.
LONG = 12_000  # rows of all recordings, up to which a diagnosis takes seconds: all are kept
FEWEST = 1_000  # rows that each recording keeps: forty bands, the highest with a tenth of them
# At half of the new highest frequency the mean of a block keeps sinc(1/4)^2 = 81 % of the power.
# Faster content has at most WHITE - 1 = 10 % of the noise's power: 2 % of the highest band are lost.
HALF_BAND = 2.0  # the new highest frequency over that of the fastest content
WHITE = 1.1  # times the power of the highest rows, up to which a band is white
DEVIATIONS = 4.0  # of a band's power that are chance: wrong at one output in a thousand
AVERAGED = 1e-3  # share of an input's variance that averaging may remove: the mean of its square is as exact
OUTLIER = 6.0  # robust standard deviations from the median of its neighbours, beyond which a cell is dropped
GAP = 1.5  # times the usual duration of a block, beyond which rows are missing in it: it gives no value


@dataclass(frozen=True)
class Reduced:
    """Recordings with fewer rows; `block`: rows that became one; `before`, `after`: number of rows of all."""

    tables: list[Table]
    block: int
    before: int
    after: int

    def noise(self, plant: Plant, drives: Sequence[Excitation]) -> tuple[Noise, ...]:
        """Return the noise of each output's rows."""
        full = default_noise(plant, drives)
        if self.block == 1:
            return full
        return tuple(
            dataclasses.replace(n, sigma=_averaged_sd(n.sigma, o.noise, self.block)) if o.noise_sd else n
            for n, o in zip(full, plant.outputs.values(), strict=True)
        )

    def sensor(self, noise: object) -> SensorNoise | None:
        """Return the parts of a stated noise in these rows."""
        if not isinstance(noise, SensorNoise):
            return None
        return dataclasses.replace(noise, white=noise.white / np.sqrt(self.block))

    @property
    def note(self) -> str:
        """Return how many rows were needed, as a text for the result."""
        return (
            f"{self.after} of {self.before} rows were needed: means of {self.block} rows hold the same information; "
            "noise and errors below are those of the means"
        )


def _averaged_sd(sigma: float, noise: object, block: int) -> float:
    """Return the standard deviation of a mean of `block` values, whose white part only becomes smaller."""
    white = noise.white if isinstance(noise, SensorNoise) else sigma
    return float(np.sqrt(max(sigma**2 - white**2 * (1 - 1 / block), 0.0)))


def reduced(plant: Plant, tables: Sequence[Table]) -> Reduced:
    """Return recordings with as few rows as hold the same information; the same ones if they are short."""
    before = sum(map(len, tables))
    kept = Reduced(list(tables), 1, before, before)
    if before <= LONG:
        return kept
    model = compile_plant(plant, ())
    drives = [model.excitation(t) for t in tables]
    block = min(_block(model, d) for d in drives)
    if block == 1:
        return kept
    out = [means(model, t, block) for t in tables]
    return Reduced(out, block, before, sum(map(len, out)))


def _block(model: Model, d: Excitation) -> int:
    """Return the largest block that a recording allows. It is odd: so its middle is a row."""
    n = len(d.t)
    most = n // FEWEST
    for j in range(d.y.shape[1]):
        most = min(most, int(len(d.t) / (HALF_BAND * _content(d.y[:, j]) + 1)))
    sizes = sorted({(int(most * 0.8**k) - 1) // 2 * 2 + 1 for k in range(40)}, reverse=True)
    may = (b for b in sizes if b > 1 and all(_may_average(d, j, b) for j in range(len(model.inputs))))
    return next(may, 1)


def _content(y: np.ndarray) -> int:
    """Return the DCT row above which a signal is white."""
    y = y[np.isfinite(y)]
    if len(y) < FEWEST or not np.ptp(y):
        return 0
    # the straight line between the ends would put a 1 / f^2 tail into all rows
    power = dct(y - np.linspace(y[0], y[-1], len(y)), norm="ortho") ** 2
    floor = float(np.mean(power[len(power) // 2 :]))
    edges = band_edges(len(power))
    count = np.diff(edges)
    mean = np.add.reduceat(power, edges[:-1]) / count
    loud = np.flatnonzero(mean > floor * (WHITE + DEVIATIONS * np.sqrt(2 / count)))
    return int(edges[loud[-1] + 1]) if len(loud) else 0


def _may_average(d: Excitation, j: int, block: int) -> bool:
    """Are the changes of an input few enough for rows of their own, or its variance within blocks small?"""
    u = d.u[:, j]
    if not d.linear[j] and _changes(u).size <= len(u) // block:
        return True
    whole = u[: len(u) // block * block].reshape(-1, block)
    if d.linear[j]:  # a straight line within the block is kept
        whole = whole - np.linspace(-0.5, 0.5, block) * (whole[:, -1:] - whole[:, :1])
    return float(np.mean(np.var(whole, axis=1))) <= AVERAGED * float(np.var(u))


def _changes(u: np.ndarray) -> np.ndarray:
    return np.flatnonzero(u[1:] != u[:-1]) + 1


def means(model: Model, table: Table, block: int) -> Table:
    """Return a recording with one row a block and one a change of a held input."""
    table = in_plant_units(model.plant, table)
    d = model.excitation(table)
    n = len(d.t) // block * block
    middle = np.arange(
        block // 2, n, block
    )  # an input that is averaged holds from one of these rows to the next
    inputs = list(model.plant.inputs.values())
    seldom = [
        j for j in range(len(inputs)) if not d.linear[j] and _changes(d.u[:, j]).size <= len(d.t) // block
    ]
    rows = np.unique(np.concatenate([[0], middle, *(_changes(d.u[:, j]) for j in seldom)]))
    columns = {name: _held_mean(c, rows) for name, c in table.columns.items()}
    for j, i in enumerate(inputs):
        if j in seldom:
            columns[i.column] = d.u[rows, j]
        elif d.linear[j]:
            columns[i.column] = _centred(d.u[:, j], rows, block)
    try:
        run = model.run(d).y
    except SimulationError:
        run = np.zeros_like(d.y)
    noise = default_noise(model.plant, [d])
    span = np.ptp(d.t[:n].reshape(-1, block), axis=1)
    whole = span <= GAP * np.median(span)
    place = middle.copy()
    place[0] = 0  # the plant starts at the first value of an output
    at = np.searchsorted(rows, place)
    for j, o in enumerate(model.plant.outputs.values()):
        if o.column in table.columns:
            error = (d.y[:, j] - run[:, j])[:n].reshape(-1, block)
            away = np.abs(error - np.nanmedian(error, axis=1, keepdims=True))
            good = away <= OUTLIER * max(1.4826 * float(np.nanmedian(away)), noise[j].sigma)
            count = good.sum(axis=1)
            mean = np.where(good, error, 0.0).sum(axis=1) / np.maximum(count, 1)
            columns[o.column] = np.full(len(rows), np.nan)
            columns[o.column][at] = np.where(whole & (2 * count > block), run[place, j] + mean, np.nan)
    return dataclasses.replace(table, t=table.t[rows], columns=columns)


def _held_mean(column: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the mean of a column's values from each row to the next."""
    good = np.isfinite(column)
    count = np.add.reduceat(good.astype(float), rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.add.reduceat(np.where(good, column, 0.0), rows) / count


def _centred(u: np.ndarray, rows: np.ndarray, block: int) -> np.ndarray:
    """Return the mean over a block about each row."""
    total = np.concatenate([[0.0], np.cumsum(u)])
    reach = np.minimum(np.minimum(rows, len(u) - 1 - rows), block // 2)
    return (total[rows + reach + 1] - total[rows - reach]) / (2 * reach + 1)
