"""Plan an experiment: the smallest visible size of each effect, the parameters' errors, a better course.

The experiment is simulated with the plant as it is, and with its sensors' noise. The rest is linear about
that run: visible sizes as in diagnosis/report/unseen.py, and of the parameters z (0..1 in their ranges)

    covariance of z = (J' J + 12 I)^-1

J: sensitivities of the readings in standard deviations of their noise; 12: the precision of a range.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoctl.advice.effect_files import made_rig
from thermoctl.checks import Finding
from thermoctl.checks.model import plant_findings, rates_of
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import UNIFORM, fitted
from thermoctl.diagnosis.experiment.design import NONE, Excitation, Lever, Ranges, courses, family, levers
from thermoctl.diagnosis.hypothesis.candidates import Key, candidates
from thermoctl.diagnosis.hypothesis.effect import Effect
from thermoctl.diagnosis.report.unseen import NOT_EXCITED, Visible, visible
from thermoctl.files.yamlfile import InputError
from thermoctl.plant.fitting.residuals import Problem
from thermoctl.plant.fitting.whitening import default_noise
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import Model, SimulationError, compile_plant
from thermoctl.plant.units import in_plant_units
from thermoctl.recording.table import Table

# Assumed temperature of the surroundings, by unit, if neither plant nor recording states it.
REST = {"degC": 20.0, "K": 293.15, "degF": 68.0}
SETTLED = 3.0  # a step reaches 95 % after this number of time constants
LEVELS = 7  # number of levels of the course that is planned without a recording
ROWS = 2000  # number of rows of that experiment
ALONE = 1e-6  # factor on the precision of the ranges, to ask what the readings alone determine


@dataclass(frozen=True)
class Parameter:
    """A free parameter after the experiment, with its standard error.

    `identified`: do the readings alone determine it better than its range? `tied`: if not, the parameter or
    initial state that it cannot be separated from."""

    name: str
    value: float
    unit: str | None
    sd: float
    identified: bool
    tied: str | None


@dataclass(frozen=True)
class Course:
    """A course of the inputs, and the standard errors of the parameters after it."""

    title: str
    duration_s: float
    sd: Mapping[str, float]


@dataclass(frozen=True)
class Planned:
    """The content of a plan."""

    checks: list[Finding]
    duration_s: float
    interval_s: float
    slowest_s: float | None
    parameters: list[Parameter]
    effects: list[Visible]
    better: Course | None
    units: Mapping[str, str | None]  # by output


def plan(
    plant: Plant, tables: Sequence[Table], effects: Mapping[str, Effect], limits: Ranges = NONE
) -> Planned:
    """Say what a diagnosis could see in recordings with these inputs and sampling times. Raises InputError.

    `tables`: recordings; of their readings only the times count. Without one, the inputs of `limits` go
    through levels that are held until the plant has settled. `limits` also bounds better courses."""
    model = compile_plant(plant)
    tables = [in_plant_units(plant, t) for t in tables] or [_course(model, limits)]
    try:
        made = [_measured(model, t, seed) for seed, t in enumerate(tables)]
    except SimulationError as e:
        raise InputError(f"{plant.file}: the experiment cannot be simulated: {e}") from None
    drives = [model.excitation(t) for t in made]
    planned_case = case(plant, made, effects, Budget(1))
    null = fitted(planned_case, planned_case.plant, (), planned_case.null)
    rates = np.concatenate([rates_of(model, d) for d in drives])
    seen = visible(planned_case, null)
    return Planned(
        plant_findings(model, drives),
        float(sum(t.t[-1] - t.t[0] for t in made)),
        float(np.median(np.concatenate([np.diff(t.t) for t in made]))),
        float(1 / rates.min()) if len(rates) else None,
        parameters(model, made),
        [*seen, *_at_rest(plant, effects, {v.candidate.key for v in seen})],
        better(plant, model, made, limits),
        {o.name: o.unit for o in plant.outputs.values()},
    )


def _at_rest(plant: Plant, effects: Mapping[str, Effect], seen: set[Key]) -> list[Visible]:
    """Return the effects that have a place in the plant only while other inputs move."""
    placed = {c.key: c for c in candidates(made_rig(plant), effects) if c.effect.sizes and c.key not in seen}
    return [Visible(c, "", np.inf, NOT_EXCITED) for c in placed.values()]


def _course(model: Model, limits: Ranges) -> Table:
    """Return the inputs of an experiment by levels, long enough for the slowest time constant."""
    plant = model.plant
    for name in limits:
        if name not in plant.inputs:
            raise InputError(f"--limit {name}: no input of {plant.file}; there are {', '.join(plant.inputs)}")
    driven = [n for n in plant.inputs if n in limits]
    if not plant.inputs:
        raise InputError(f"plan: {plant.file} has no inputs; a recording of it was expected (--like REC)")
    if not driven:
        raise InputError(
            "plan: a recording (--like REC) or the range of an input (--limit NAME=LOW:HIGH) was expected; inputs are "
            + ", ".join(plant.inputs)
        )
    read = plant.readings()
    rest = {i.name: REST.get(i.unit or "", 0.0) for i in read}
    rest |= {n: sorted((limits[n][0], 0.0, limits[n][1]))[1] for n in driven}
    columns = {i.column: np.full(2, rest[i.name]) for i in read}
    rates = rates_of(model, model.excitation(Table("start", "start", np.array([0.0, 1.0]), columns)))
    if not len(rates):
        raise InputError(f"{plant.file}: the plant has no time constant to plan by; give --like REC")
    duration = LEVELS * SETTLED / float(rates.min())
    step = duration / ROWS
    corners = {}
    for seed, n in enumerate(driven):
        lever = Lever(n, {n: (1.0, 0.0)}, *limits[n], rest[n], np.inf)
        own = courses(lever, duration, step, seed)
        corners[n] = own["in four levels up and down" if not seed else "in a pseudo-random sequence, slow"]
    starts = {n: v for n, v in rest.items() if n not in driven}
    return Excitation("levels", duration, corners, starts).table(plant, step, "levels")


def _measured(model: Model, table: Table, seed: int) -> Table:
    """Return the table with simulated readings at the times at which it has some."""
    made = model.measure(table, seed)
    columns = dict(made.columns)
    for o in model.plant.outputs.values():
        if o.column in table.columns and np.isnan(table.columns[o.column]).any():
            columns[o.column] = np.where(np.isfinite(table.columns[o.column]), columns[o.column], np.nan)
    return dataclasses.replace(made, columns=columns)


def _problem(model: Model, tables: Sequence[Table]) -> Problem:
    drives = [model.excitation(t) for t in tables]
    return Problem(model, drives, default_noise(model.plant, drives))


def _covariance(problem: Problem, ranges: float = 1.0) -> np.ndarray:
    """Return the covariance of the unknowns (k, k). `ranges`: factor on the precision of the ranges."""
    z = problem.start({})
    precision = np.where(np.arange(len(z)) < problem.n_parameters, UNIFORM * ranges, 1.0)
    return np.linalg.inv(problem.evaluate(z, True).matrix + np.diag(precision))


def parameters(model: Model, tables: Sequence[Table]) -> list[Parameter]:
    """Return the free parameters with their standard errors after recordings `tables`."""
    problem = _problem(model, tables)
    sd = np.sqrt(np.diag(_covariance(problem)))
    covariance = _covariance(problem, ALONE)
    alone = np.sqrt(np.diag(covariance))
    correlation = np.abs(covariance / np.outer(alone, alone)) - np.eye(len(alone))
    fitted_sizes = {}
    for k, (name, _) in enumerate(problem.unknowns[: problem.n_parameters]):
        p = model.plant.parameters[name]
        identified = bool(alone[k] ** 2 * UNIFORM < 1)
        other = problem.unknowns[int(np.argmax(correlation[k]))][0] if len(sd) > 1 else None
        size = float(sd[k] * problem.scales[name].slope(p.value))
        fitted_sizes[name] = Parameter(name, p.value, p.unit, size, identified, None if identified else other)
    return list(fitted_sizes.values())


def better(plant: Plant, model: Model, tables: Sequence[Table], limits: Ranges) -> Course | None:
    """Return the course of the driven inputs with the least errors of the parameters; None if none is better.

    It is one of the candidates of diagnosis/experiment/design.py, as long as one recording. The determinant
    of the parameters' covariance decides; of several recordings, that of an average one."""
    driven = levers(plant, tables, tuple(limits), limits)
    if not driven or not model.active:
        return None
    problem = _problem(model, tables)
    now = _information(problem) - problem.n_parameters * float(np.log(len(tables)))
    length = float(np.median([t.t[-1] - t.t[0] for t in tables]))
    step = float(np.median(np.diff(tables[0].t)))
    best: tuple[float, Excitation, Problem] | None = None
    tried = [e for e in family(plant, tables, driven, max(step, length / ROWS)) if e.duration_s <= length]
    for e in tried:
        try:
            problem = _problem(model, [model.measure(e.table(plant, max(step, e.duration_s / ROWS)))])
            gain = _information(problem) - now
        except (SimulationError, InputError):
            continue
        if gain > 0 and (best is None or gain > best[0]):
            best = gain, e, problem
    if best is None:
        return None
    _, e, problem = best
    sd = np.sqrt(np.diag(_covariance(problem)))
    names = [q for q, _ in problem.unknowns[: problem.n_parameters]]
    slopes = {q: problem.scales[q].slope(plant.parameters[q].value) for q in names}
    return Course(e.title, e.duration_s, {q: float(sd[k] * slopes[q]) for k, q in enumerate(names)})


def _information(problem: Problem) -> float:
    """Return the log determinant of the parameters' precision."""
    n = problem.n_parameters
    return -float(np.linalg.slogdet(_covariance(problem)[:n, :n])[1])


def contract(planned: Planned) -> dict[str, Any]:
    """Return the plan for programs (thermoctl-plan/1)."""
    return {
        "format": "thermoctl-plan/1",
        "checks": [dataclasses.asdict(f) for f in planned.checks],
        "duration_s": planned.duration_s,
        "interval_s": planned.interval_s,
        "slowest_time_constant_s": planned.slowest_s,
        "parameters": [dataclasses.asdict(p) for p in planned.parameters],
        "visible": [
            v.entry()
            | ({"moves": dict(zip(("output", "rms", "share"), v.moves, strict=True))} if v.moves else {})
            for v in planned.effects
            if v.reason is None
        ],
        "hidden": [
            {"effect": v.candidate.effect.name, "where": v.candidate.place.where, "reason": v.reason}
            for v in planned.effects
            if v.reason is not None
        ],
        "better": dataclasses.asdict(planned.better) if planned.better else None,
    }
