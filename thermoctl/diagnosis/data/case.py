"""The data of a diagnosis: recordings that the choice is made on, the original plant and its first refit."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock

import numpy as np

from thermoctl.checks.file import other_degrees
from thermoctl.checks.model import SIGMAS, start_errors
from thermoctl.diagnosis.data.coordinates import FEWEST, Coordinates
from thermoctl.diagnosis.data.grids import Grid, Reading, grid
from thermoctl.diagnosis.data.memory import NOTHING, Memory
from thermoctl.diagnosis.data.outliers import Outliers, outlier_note, without_outliers
from thermoctl.diagnosis.data.rows import noise_of_means, reduced
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.diagnosis.limits import Thresholds, limits
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.fitting.cores import give_back, reuse_memory
from thermoctl.plant.fitting.refit import Fit, fit_by_first_parts
from thermoctl.plant.fitting.whitening import Noise
from thermoctl.plant.language import Plant, SensorNoise
from thermoctl.plant.parts import direct_outputs
from thermoctl.plant.simulation.simulate import (
    RTOL,
    Excitation,
    Model,
    SimulationError,
    compile_plant,
    filled,
)
from thermoctl.recording.table import Table

LEAST = 40  # least number of measured values of at least one output
STATED = 12  # least number if the plant file states the output's noise, so that it is not estimated
ACCURATE = 1e-3  # relative local error of a simulation, over (noise / range) of an output; at most LARGEST
LARGEST = 1e-5
FAST = 0.01  # share of an output's changes that may be jumps
ROUGH = 1e-2  # tolerance of the first refit: the posterior is climbed from there
# Progress gives the time of the planned refits if it is not short, from this number of refits of a step on.
SHORT_S, KNOWN = 30.0, 4

# Errors of the simulation of a hypothesis, or of its refit: the hypothesis is left out.
FAILS = (SimulationError, InputError, np.linalg.LinAlgError, ex.ExpressionError)


@dataclass
class Budget:
    """Largest number of refits, and the number done. It counts refits, not time: the same on every machine.

    - `planned`: number of refits after this step of the search; each step may plan more
    - `stopped`: has a person asked for the result so far?
    - `untried`: number of promising refits that were left out
    - `starts`: times of `clock`, in s, at which the refits of this step began"""

    fits: int
    progress: Callable[[str], None] = lambda text: None
    stopped: Callable[[], bool] = lambda: False
    fits_done: int = 0
    planned: int = 1
    untried: int = 0
    clock: Callable[[], float] = time.monotonic
    starts: list[float] = field(default_factory=list)
    lock: Lock = field(default_factory=Lock)  # two refits may run in parallel

    @property
    def spent(self) -> bool:
        """Is no further refit allowed?"""
        return self.fits_done >= self.fits or self.stopped()

    def spend(self) -> None:
        """Count one refit, and report it."""
        give_back()
        with self.lock:
            self.fits_done += 1
            self.starts.append(self.clock())
            planned = min(max(self.planned, self.fits_done), self.fits)
            of = f" of {planned} planned so far (at most {self.fits})" if self.fits_done <= planned else ""
            self.progress(f"searching: refit {self.fits_done}{of}{self._left(planned - self.fits_done + 1)}")

    def screen(self) -> None:
        """Report that a hypothesis is screened for effects: the next refits are another step."""
        give_back()
        self.starts.clear()
        self.progress(f"searching: screening after refit {self.fits_done}")

    def _left(self, refits: int) -> str:
        """Return the time of so many refits as the end of a sentence; '' where it is short or not known."""
        if len(self.starts) < KNOWN:
            return ""
        left = refits * (self.starts[-1] - self.starts[0]) / (len(self.starts) - 1)
        if left < SHORT_S:
            return ""
        return f", about {left / 60:.0f} min for these" if left > 90 else f", about {left:.0f} s for these"


@dataclass(frozen=True)
class Case:
    """Data, catalogue and budget of a diagnosis.

    All hypotheses are scored in the same `coordinates` and `grids`. `off`: by output, the first sample minus
    the plant's initial value, where they contradict each other. `rtol`: relative local error of every
    simulation. `outliers`: readings left out. `noisy`: is noise of inputs in the grids?"""

    plant: Plant
    tables: tuple[Table, ...]
    catalogue: Mapping[str, Effect]
    noise: tuple[Noise, ...]
    null: Fit
    coordinates: Coordinates
    grids: tuple[Grid, ...]
    budget: Budget
    notes: list[str] = field(default_factory=list)
    block: int = 1  # number of recorded rows whose mean is one row here
    off: Mapping[str, float] = field(default_factory=dict)
    rtol: float = RTOL
    memory: Memory = NOTHING  # posterior of earlier recordings
    outliers: Outliers = ()
    noisy: bool = False
    limits: Thresholds = field(default_factory=limits)  # numbers by which the diagnosis decides

    def drives(self, model: Model) -> list[Excitation]:
        """Return the recordings as a model reads them.

        A part after a gap starts from its readings, also in a model with further states."""
        drives = [dataclasses.replace(model.excitation(t), rtol=self.rtol) for t in self.tables]
        return [dataclasses.replace(d, x0=_start(d, self.null.model, model)) for d in drives]

    def drives_after(self, after: Plant, before: Plant, drives: Sequence[Excitation]) -> Sequence[Excitation]:
        """Return the recordings as an extended plant reads them, from those of the plant before.

        An effect or a law may read a further column."""
        return drives if after.inputs.keys() == before.inputs.keys() else self.drives(compile_plant(after))

    @cached_property
    def columns(self) -> list[dict[str, np.ndarray]]:
        """Return by recording each column (N,), whether the plant reads it or not, its gaps filled."""
        return [
            {c: filled(t.t, v, False, c) for c, v in t.columns.items() if np.isfinite(v).any()}
            for t in self.tables
        ]

    def rig(self, plant: Plant, drives: Sequence[Excitation]) -> Rig:
        """Return the parts and signals of a plant, with these recordings."""
        return Rig(plant, drives, [t.columns for t in self.tables], bool(self.memory.hypotheses))


def _start(d: Excitation, null: Model, model: Model) -> np.ndarray | None:
    """Return where a part's states start, for a model with further states than `null`.

    A further state starts from its own reading. Without one it starts like the node that it exchanges with,
    if the plant states the same initial value for both. NaN stands for the plant's initial value."""
    if d.x0 is None:
        return None
    plant, by_null, by_model = model.plant, direct_outputs(null.plant), direct_outputs(model.plant)

    def start(state: str) -> float:
        """Return the start of one state."""
        known = state in null.states
        read = (by_null if known else by_model).get(state, "")
        if known or read in d.first:
            return d.first.get(read, np.nan)
        ends = ({f.source, f.target} for f in plant.flows.values())
        beside = [n for pair in ends if state in pair for n in null.states if n in pair]
        same = [n for n in beside if plant.nodes[n].initial == plant.nodes[state].initial]
        return start(same[0]) if same else np.nan

    return np.array([start(n) for n in model.states])


def case(
    plant: Plant,
    tables: Sequence[Table],
    catalogue: Mapping[str, Effect],
    budget: Budget,
    memory: Memory = NOTHING,
    numbers: Thresholds | None = None,
) -> Case:
    """Refit the original plant, drop single outliers, fix the coordinates and grids of all hypotheses.

    Rows of long recordings are averaged in blocks (rows.py). `numbers`: the shipped ones if not given.
    Raises InputError where too few values were measured, or a temperature is neither in degC nor in K."""
    for wrong in other_degrees(plant):
        raise InputError(f"{wrong.where}: {wrong.what}. {wrong.suggestion}")
    reuse_memory()
    plant, off, freed = _free_starts(plant, tables)
    fewer = reduced(plant, tables)
    tables = fewer.tables
    model = compile_plant(plant)
    drives = [model.excitation(t) for t in tables]
    _enough(model, drives, ", ".join(t.path for t in tables))
    noise = noise_of_means(plant, drives, fewer.block)
    rtol = _rtol(drives, noise)
    for d in drives:
        d.rtol = rtol
    null = fit_by_first_parts(model, drives, noise, fewer.z, tolerance=ROUGH, seconds=np.inf)
    as_stated = [
        d.y - model.run(d, values, np.zeros_like(dx0)).y
        for d, values, dx0 in zip(drives, null.values, null.dx0, strict=True)
    ]
    tables, dropped = without_outliers(tables, plant, drives, null.residuals, as_stated, noise)
    drives = [dataclasses.replace(model.excitation(t), rtol=rtol) for t in tables]
    kept = [np.where(np.isfinite(d.y), e, np.nan) for d, e in zip(drives, null.residuals, strict=True)]
    null = dataclasses.replace(null, residuals=kept)
    coordinates = Coordinates(drives)
    left_out = [outlier_note(dropped)] if dropped else []
    averaged = [fewer.note] if fewer.block > 1 else []
    guesses = Rig(plant, drives, [t.columns for t in tables]).guesses()
    return Case(
        plant,
        tuple(tables),
        catalogue,
        noise,
        null,
        coordinates,
        grids_of(coordinates, drives, null, fewer.block),
        budget,
        notes=[*freed, *averaged, *left_out, *guesses],
        block=fewer.block,
        off=off,
        rtol=rtol,
        memory=memory,
        outliers=dropped,
        limits=numbers or limits(),
    )


def _enough(model: Model, drives: Sequence[Excitation], paths: str) -> None:
    """Raise InputError where no output has enough measured values, in recordings with FEWEST or more."""
    outputs = list(model.plant.outputs.values())
    measured = np.array([np.isfinite(d.y).sum(axis=0) for d in drives])
    counts = np.where(measured >= FEWEST, measured, 0).sum(axis=0)
    over = counts.sum() >= 2 * (len(model.active) + len(drives) * len(model.uncertain))
    needed = [STATED if over and (o.noise_sd or o.resolution) else LEAST for o in outputs]
    if (counts >= needed).any():
        return
    raise InputError(
        f"{paths}: too little data: at most {max(counts, default=0)} measured values of one output "
        f"({', '.join(o.column for o in outputs)}) in recordings of {FEWEST} or more; {LEAST} are needed, or {STATED} where "
        "the plant file states the output's noise and all outputs have twice as many values as there are unknowns"
    )


def grids_of(
    coordinates: Coordinates, drives: Sequence[Excitation], null: Fit, block: int
) -> tuple[Grid, ...]:
    """Return the frequency grid of each measured output, for rows that are means of `block` readings."""
    out, change = [], _changes(null, drives, block)
    outputs = list(null.model.plant.outputs.values())
    for j, ks in coordinates.by_output().items():
        o, sensor, sigma = outputs[j], None, null.noise[j].sigma
        if isinstance(o.noise, SensorNoise):
            sensor = dataclasses.replace(o.noise, white=o.noise.white / np.sqrt(block))
        columns = [d.y[:, j] for d in drives]
        swing = float(np.nanstd(np.concatenate(columns)))
        moves = np.concatenate([np.abs(np.diff(y[np.isfinite(y)])) for y in columns])
        coarse = bool(sigma < (o.resolution or 0.0) >= np.median(moves))
        reading = Reading(o.name, sigma, sensor, swing, change[j], coarse, block)
        out.append(grid(coordinates, ks, reading))
    return tuple(out)


def _changes(null: Fit, drives: Sequence[Excitation], block: int) -> np.ndarray:
    """Return the rms change of each output in a sampling interval, over the root of `block`.

    The fastest hundredth is left out: these are jumps of a held input, whose times are known."""
    squares = []
    for d, values, dx0 in zip(drives, null.values, null.dx0, strict=True):
        slope = np.abs(np.gradient(null.model.run(d, values, dx0).y, d.t, axis=0))
        calm = np.where(slope <= np.quantile(slope, 1 - FAST, axis=0), slope, np.nan)
        squares.append(np.nanmean((calm * np.median(np.diff(d.t)) / block) ** 2, axis=0))
    return np.asarray(np.sqrt(np.mean(squares, axis=0) / block))


def _rtol(drives: Sequence[Excitation], noise: Sequence[Noise]) -> float:
    """Return the relative local error of simulations at which their total error is far below the noise.

    It is ACCURATE times noise over range. The total error was 0.001 to 0.02 of the noise on six real rigs."""
    values = np.concatenate([d.y for d in drives])
    seen = np.isfinite(values).any(axis=0)
    span = np.nanmax(values[:, seen], axis=0) - np.nanmin(values[:, seen], axis=0)
    sigma = np.array([n.sigma for n in noise])[seen]
    return float(np.clip(ACCURATE * np.min(sigma / np.maximum(span, 1e-300)), RTOL, LARGEST))


def _free_starts(plant: Plant, tables: Sequence[Table]) -> tuple[Plant, dict[str, float], list[str]]:
    """Free the initial states that first samples contradict; return the plant, `Case.off` and notes.

    Such an initial state is wrong in the plant file. If it were kept, effects would be found that explain the
    transient from it."""
    model, nodes = compile_plant(plant), dict(plant.nodes)
    contradictions: dict[str, list[float]] = {}
    for table in tables:
        for output, (error, sigmas) in start_errors(model, model.excitation(table)).items():
            if sigmas > SIGMAS:
                contradictions.setdefault(output, []).append(error)
    notes = []
    for output, errors in contradictions.items():
        for n in sorted(ex.names(plant.outputs[output].value) & nodes.keys()):
            sigma = max(*map(abs, errors), nodes[n].initial_sigma or 0.0)
            nodes[n] = dataclasses.replace(nodes[n], initial_sigma=sigma)
            span = f"{min(errors):+.3g}" + (f" to {max(errors):+.3g}" if len(errors) > 1 else "")
            of = f" in {len(errors)} recordings" if len(errors) > 1 else ""
            notes.append(
                f"'{output}' starts {span} from the plant's start{of}: the start of '{n}' was fitted"
            )
    off = {output: max(errors, key=abs) for output, errors in contradictions.items()}
    return dataclasses.replace(plant, nodes=nodes), off, notes
