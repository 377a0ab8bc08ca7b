"""Wrong labels: swapped columns, other units, signs, a clock in other units, by comparing hypotheses.

Each hypothesis changes the recordings as a person would correct them, or the sign of a flow that drives its
own node away. It is compared with the recordings as they are, both after a short refit inside the parameters'
ranges:

    gain = sum over outputs of n log(rms as it is / rms corrected)        (each rms over the output's spread)

n is the number of independent residuals of the corrected recordings: samples over their integrated
autocorrelation time (Geyer 1992, initial positive sequence). The gain is the logarithm of a likelihood ratio.
It has to exceed log(RARITY) plus the logarithm of the number of hypotheses. The correction also has to
halve the misfit of its columns. A mistake that the plant file shows, too, needs log(SHOWN) alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from math import log

import numpy as np

from thermoctl.checks.data import driving_inputs, moves
from thermoctl.checks.file import driving_away, unconverted
from thermoctl.checks.finding import Finding
from thermoctl.checks.model import NYQUIST, rates_of
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Input, Output, Plant
from thermoctl.plant.simulation.simulate import Model, SimulationError, compile_plant
from thermoctl.recording.table import Table
from thermoctl.units import conversion, dimension

RARITY = 1000.0  # prior odds against a wrong label
SHOWN = 20.0  # odds that recordings must give a mistake that the plant file shows, too
CLOSE = 2.0  # residual over noise below which no wrong label is sought
FOLLOWS = 0.5  # a corrected column has to be followed to within this share of its spread
HALVED = 0.5  # share of the misfit of its columns that a correction may leave at most
ROWS = 4_000  # largest number of rows of all recordings together, of each the first ones
DRAWS = 4  # parameter draws of the screening
ITERATIONS = 20  # largest number of iterations of a refit
REFITTED = 6  # number of best screened hypotheses that are refitted
ROUNDS = 3  # largest number of corrections, one after the other
MAX_COLUMNS = 8  # with more columns, only pairs of the same unit are tried for a swap
TEMPERATURES = ("degC", "degF", "K")
FACTORS = (1e3, 1e-3, 1e6, 1e-6)
CLOCKS = (("ms", 1e-3), ("us", 1e-6), ("min", 60.0), ("h", 3600.0))
SPREAD = 10.0  # an rms that stands for "cannot be simulated", in spreads

Change = Callable[[Table], Table]


@dataclass(frozen=True)
class Hypothesis:
    """A wrong label: a sentence about it, its correction in words, and the corrected table or plant.

    `shown`: the plant file shows it, too."""

    kind: str
    what: str
    suggestion: str
    change: Change = lambda table: table
    columns: tuple[str, ...] = ()
    plant: Plant | None = None
    shown: bool = False


def label_findings(model: Model, tables: Sequence[Table]) -> tuple[list[Finding], list[Table]]:
    """Return the findings, and the tables after the corrections that they suggest."""
    tables = [_cut(t, ROWS // len(tables)) for t in tables]
    findings: list[Finding] = []
    for _ in range(ROUNDS):
        best = _best(model, tables)
        if best is None:
            break
        where = tables[0].path if len(tables) == 1 else f"{tables[0].path} and {len(tables) - 1} more"
        findings.append(Finding(best.kind, where, best.what, best.suggestion))
        tables = [best.change(t) for t in tables]
        model = _model(model, best)
    if not findings:
        findings = _ambient(model.plant, tables)
    return findings, tables


def _cut(table: Table, rows: int) -> Table:
    if len(table) <= rows:
        return table
    return replace(table, t=table.t[:rows], columns={n: v[:rows] for n, v in table.columns.items()})


def _best(model: Model, tables: Sequence[Table]) -> Hypothesis | None:
    """Return the wrong label that the recordings prove, None without one."""
    now = _misfit(model, tables, refit=True)
    if now is None or np.all(now.rms <= CLOSE * now.noise):
        return None
    hypotheses = [*_clocks(model, tables), *_hypotheses(model.plant, tables), *_turned(model.plant)]
    for f, right in unconverted(model.plant):
        todo = f"{f.suggestion.removesuffix('.')}: {f.where}."
        hypotheses.append(Hypothesis(f.kind, f.what, todo, plant=right, shown=True))
    proof = log(RARITY * max(len(hypotheses), 1))
    screened: list[tuple[float, Hypothesis]] = []
    plain = _screened(model, tables)
    for h in hypotheses:
        tried = _screened(_model(model, h), [h.change(t) for t in tables])
        screened.append((float(np.sum(now.independent * np.log(plain / tried))), h))
    screened.sort(key=lambda pair: -pair[0])
    best: tuple[bool, float, Hypothesis] | None = None
    for _, h in screened[:REFITTED]:
        then = _misfit(_model(model, h), [h.change(t) for t in tables], refit=True)
        if then is None:
            continue
        gain = float(np.sum(then.independent * np.log(now.share / then.share)))
        changed = [j for j, o in enumerate(model.plant.outputs.values()) if o.column in h.columns]
        part = changed or list(range(len(then.share)))
        followed = np.sqrt(np.mean(then.share[part] ** 2))
        left = followed / np.sqrt(np.mean(now.share[part] ** 2))
        proven = gain > log(SHOWN) if h.shown else gain > proof and followed < FOLLOWS and left < HALVED
        if proven and (best is None or (h.shown, gain) > best[:2]):
            best = h.shown, gain, h
    return best[-1] if best else None


@dataclass(frozen=True)
class _Misfit:
    """By output: rms residual; it over the spread of the readings; noise; number of independent residuals."""

    rms: np.ndarray
    share: np.ndarray
    noise: np.ndarray
    independent: np.ndarray


def _misfit(model: Model, tables: Sequence[Table], refit: bool) -> _Misfit | None:
    excitations = [model.excitation(t) for t in tables]
    if not any(np.isfinite(e.y).any() for e in excitations):
        return None
    noise = np.array([n.sigma for n in default_noise(model.plant, excitations)])
    spread = _spread(np.concatenate([e.y for e in excitations]), noise)
    try:
        if (model.active or model.uncertain) and refit:
            residuals = fit(model, excitations, iterations=ITERATIONS, seconds=np.inf).residuals
        else:
            residuals = [e.y - model.run(e).y for e in excitations]
    except SimulationError:
        count = np.array([max(np.isfinite(e.y).sum() ** 0.5, 2.0) for e in excitations]).sum()
        return _Misfit(SPREAD * spread, np.full(len(spread), SPREAD), noise, np.full(len(spread), count))
    rms = np.maximum(_rms(np.concatenate(residuals)), noise)
    independent = np.sum([[_independent(r[:, j]) for j in range(len(noise))] for r in residuals], axis=0)
    return _Misfit(rms, rms / spread, noise, independent)


def _screened(model: Model, tables: Sequence[Table]) -> np.ndarray:
    """Return each output's misfit over its spread in free runs, of the best of a few parameter draws."""
    excitations = [model.excitation(t) for t in tables]
    measured = np.concatenate([e.y for e in excitations])
    noise = np.array([n.sigma for n in default_noise(model.plant, excitations)])
    spread = _spread(measured, noise)
    best = np.full(len(spread), SPREAD)
    for values in _draws(model.plant):
        try:
            simulated = np.concatenate([model.run(e, values, rtol=1e-4).y for e in excitations])
        except SimulationError:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            share = np.nan_to_num(
                np.maximum(_rms(measured - simulated), noise) / spread, nan=SPREAD, posinf=SPREAD
            )
        if np.sum(np.log(share)) < np.sum(np.log(best)):
            best = share
    return np.minimum(best, SPREAD)


def _draws(plant: Plant) -> Iterator[dict[str, float]]:
    """Yield the plant's own parameters, then draws from their ranges."""
    rng = np.random.default_rng(0)
    yield {}
    for _ in range(DRAWS - 1):
        drawn = {}
        for p in plant.parameters.values():
            if p.range:
                low, high = p.range
                z = rng.uniform()
                drawn[p.name] = low * (high / low) ** z if low > 0 else low + z * (high - low)
        yield drawn


def _rms(residual: np.ndarray) -> np.ndarray:
    """Return the rms by column; 1 where nothing is measured, because its logarithm is then 0."""
    seen = np.isfinite(residual)
    count = np.maximum(seen.sum(axis=0), 1)
    mean = np.sum(np.where(seen, residual, 0.0) ** 2, axis=0) / count
    return np.where(seen.any(axis=0), np.sqrt(mean), 1.0)


def _spread(y: np.ndarray, noise: np.ndarray) -> np.ndarray:
    seen = np.isfinite(y)
    mean = np.sum(np.where(seen, y, 0.0), axis=0) / np.maximum(seen.sum(axis=0), 1)
    return np.where(seen.any(axis=0), np.maximum(_rms(y - mean), noise), 1.0)


def _independent(residual: np.ndarray) -> float:
    """Return the number of independent residuals of one output in one recording."""
    r = residual[np.isfinite(residual)]
    if len(r) < 4 or not np.ptp(r) > 0:
        return 0.0 if not len(r) else 1.0
    size = 1 << (2 * len(r) - 1).bit_length()
    power = np.abs(np.fft.rfft(r, size)) ** 2
    rho = np.fft.irfft(power)[: len(r)]
    rho = rho / rho[0]
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
    return float(len(r) / max(2 * pairs[:stop].sum() - 1, 1.0))


# ------------------------------------------------------------------------------------------------ hypotheses


def _hypotheses(plant: Plant, tables: Sequence[Table]) -> Iterator[Hypothesis]:
    there = set.intersection(*(set(t.columns) for t in tables))
    read: list[Input | Output] = [*driving_inputs(plant), *plant.outputs.values()]
    items = list({i.column: i for i in read if i.column in there}.values())
    first = tables[0]
    for item in items:
        for what, forward in _corrections(item):
            yield _corrected((item,), what, forward, first)
    yield from _twice([o for o in plant.outputs.values() if o.column in there], first)
    for unit in {o.unit for o in plant.outputs.values()}:  # all sensors of one kind
        group = tuple(o for o in plant.outputs.values() if o.unit == unit and o.column in there)
        if len(group) > 1:
            for what, forward in _corrections(group[0]):
                yield _corrected(group, what, forward, first)
    yield from swaps(plant, tables)


def swaps(plant: Plant, tables: Sequence[Table]) -> Iterator[Hypothesis]:
    """Yield the pairs of columns that may be swapped: of one unit, of few columns any two."""
    there = set.intersection(*(set(t.columns) for t in tables))
    read: list[Input | Output] = [*driving_inputs(plant), *plant.outputs.values()]
    items = list({i.column: i for i in read if i.column in there}.values())
    for a, b in combinations([i for i in items if all(moves(t, i.column) for t in tables)], 2):
        same = not (a.unit and b.unit) or dimension(a.unit) == dimension(b.unit)
        both_inputs = a.name in plant.inputs and b.name in plant.inputs
        if same or (len(items) <= MAX_COLUMNS and both_inputs) or len(items) <= MAX_COLUMNS // 2:
            yield _swapped(a, b)


def _twice(outputs: Sequence[Output], first: Table) -> Iterator[Hypothesis]:
    """Yield the temperatures that are converted twice: by the logger, and by the plant's expression."""
    for o in outputs:
        for unit in TEMPERATURES if o.unit in TEMPERATURES else ():
            if unit != o.unit:
                change = conversion(str(o.unit), unit)
                yield _corrected((o,), f"converted from {unit} twice", change, first)


def _model(model: Model, h: Hypothesis) -> Model:
    return compile_plant(h.plant) if h.plant else model


def _turned(plant: Plant) -> Iterator[Hypothesis]:
    """Yield the flows of the wrong sign. A passive flow grows with its source and falls with its target."""
    for flow in driving_away(plant):
        turned = replace(flow, source=flow.target, target=flow.source)
        yield Hypothesis(
            "sign",
            f"the rate of flow '{flow.name}' is of the other sign, if the recordings are right",
            f"Exchange 'from' and 'into', or turn the sign of its rate: {plant.file}:{flow.at}.",
            plant=replace(plant, flows={**plant.flows, flow.name: turned}),
        )


def _clocks(model: Model, tables: Sequence[Table]) -> Iterator[Hypothesis]:
    """Yield the clocks in which the samples see the plant move."""
    excitation = model.excitation(tables[0])
    rates = rates_of(model, excitation)
    step = float(np.median(np.diff(excitation.t))) if len(excitation.t) > 1 else 0.0
    for unit, factor in CLOCKS:
        if len(rates) and factor * step * rates.min() > NYQUIST:
            continue

        def change(table: Table, factor: float = factor) -> Table:
            """Return the table with its times scaled by `factor`; the first time is unchanged."""
            return replace(table, t=table.t[0] + (table.t - table.t[0]) * factor)

        yield Hypothesis(
            "clock",
            f"the plant follows the readings if the time is in {unit}, not in s",
            f"Write the unit into the header of the time: t [{unit}].",
            change,
        )


Correction = tuple[str, tuple[float, float]]
"""The words for a correction, and (scale, offset) from the column to the plant's unit."""


def _corrections(item: Input | Output) -> list[Correction]:
    """Return the units and factors in which a column may have been logged instead."""
    unit = item.unit
    kind = None if unit is None else dimension(unit)
    temperature = kind == dimension("K")
    corrections: list[Correction] = []
    if temperature and unit is not None:
        corrections += [(f"in {u}", conversion(u, unit)) for u in TEMPERATURES if u != unit]
        corrections += [("1000 times too large", (1e-3, 0.0)), ("in tenths of a degree", (0.1, 0.0))]
        return corrections
    for factor in FACTORS:
        size = f"{factor:g} times too large" if factor > 1 else f"{1 / factor:g} times too small"
        corrections.append((size, (1 / factor, 0.0)))
    if not kind:  # an angle, a ratio, or a number without a unit
        corrections += [
            ("in deg instead of rad", (np.pi / 180, 0.0)),
            ("in rad instead of deg", (180 / np.pi, 0.0)),
        ]
    corrections.append(("of the other sign", (-1.0, 0.0)))
    return corrections


def _corrected(
    items: Sequence[Input | Output], what: str, forward: tuple[float, float], first: Table
) -> Hypothesis:
    scale, offset = forward
    columns = tuple(i.column for i in items)

    def change(table: Table) -> Table:
        """Return the table with scale * value + offset in the columns."""
        return replace(table, columns=table.columns | {c: scale * table.columns[c] + offset for c in columns})

    names = " and ".join(f"'{c}'" for c in columns)
    value = first.columns[columns[0]]
    start = value[np.isfinite(value)][0] if np.isfinite(value).any() else np.nan
    shown = f"; '{columns[0]}' starts at {start:.5g}, corrected {scale * start + offset:.5g} {items[0].unit or ''}"
    unit = what.removeprefix("in ") if what in ("in degC", "in degF", "in K") else None
    entry = f"unit: {unit}" if unit else f"scale: {scale:.6g}" + (f", offset: {offset:.6g}" if offset else "")
    kind = "sign" if scale == -1 else "unit"
    return Hypothesis(
        kind,
        f"{names} {'is' if len(columns) == 1 else 'are'} {what}, if the plant is right{shown.rstrip()}",
        f"If so, state it in the plant file: column: {{name: {columns[0]}, {entry}}}.",
        change,
        columns,
    )


def _swapped(a: Input | Output, b: Input | Output) -> Hypothesis:
    def change(table: Table) -> Table:
        """Return the table with the values of the two columns exchanged."""
        columns = dict(table.columns)
        columns[a.column], columns[b.column] = table.columns[b.column], table.columns[a.column]
        return replace(table, columns=columns)

    return Hypothesis(
        "swapped",
        f"the columns '{a.column}' and '{b.column}' are swapped, if the plant is right",
        f"If so: --columns {a.column}={b.column},{b.column}={a.column}",
        change,
        (a.column, b.column),
    )


INDOORS = (-5.0, 45.0)  # degC, weather-protected places: IEC 60721-3-3, class 3K5


def _ambient(plant: Plant, tables: Sequence[Table]) -> list[Finding]:
    """Yield surroundings that are plausible only if their numbers are Fahrenheit or kelvin."""
    findings = []
    for i, table in product(plant.inputs.values(), tables):
        if i.unit != "degC" or i.role != "ambient" or i.column not in table.columns:
            continue
        mean = float(np.nanmean(table.columns[i.column]))
        for unit in ("degF", "K"):
            scale, offset = conversion(unit, "degC")
            if mean > INDOORS[1] and INDOORS[0] <= scale * mean + offset <= INDOORS[1]:
                what = (
                    f"'{i.column}' is {mean:.4g} degC on average, which would be {scale * mean + offset:.3g} degC "
                    f"if it is in {unit}"
                )
                advice = f"If so: column: {{name: {i.column}, unit: {unit}}}."
                findings.append(Finding("unit", table.path, what, advice, severe=False))
                break
    return findings
