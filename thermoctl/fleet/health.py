"""Summarise one recording of a rig, independent of all others, so that many can be spread over processes.

- health: share of time armed, faults, slipped ticks, mean innovation, error at the reference encoder;
- fit: the plant with its written values against the recording: rms residual / noise of the worst output;
- parameters: a refit of the named ones, with standard errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from thermoctl.control import recorded_faults
from thermoctl.control.arming import ARMED
from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.recordings import local, rig_of
from thermoctl.plant import load
from thermoctl.plant.fitting.estimate import report
from thermoctl.plant.fitting.refit import Fit, fit
from thermoctl.plant.simulation.simulate import SimulationError, compile_plant
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table
from thermoctl.rig.signals import join_fault_words

ROWS = 4000  # a longer recording is thinned to about this many rows before a fit
SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True)
class Summary:
    """One recording in numbers; NaN where it holds no such signal.

    `estimates`: parameter -> (value, standard error)."""

    path: str
    rig: str
    begin_s: float
    hours: float
    armed: float = math.nan
    faults: tuple[str, ...] = ()
    slips: float = math.nan
    innovation_c: float = math.nan
    proof_um: float = math.nan
    misfit: float = math.nan
    worst: str = ""
    misfit_refitted: float = math.nan
    estimates: dict[str, tuple[float, float]] = field(default_factory=dict)
    error: str = ""


def summarise(path: str, plant_path: str | None, names: tuple[str, ...]) -> Summary:
    """Summarise one recording.

    A file that cannot be read or simulated gives a Summary with `error`, so the other files are still read.
    """
    rig = rig_of(path)
    try:
        with local(path) as here:
            table = read_table(here)
        summary = _health(table, path, table.meta.get("rig", rig))
        return summary if plant_path is None else _model(summary, _thinned(table), plant_path, names)
    except (InputError, SimulationError) as e:
        return Summary(path, rig, math.nan, math.nan, error=str(e))


def _health(table: Table, path: str, rig: str) -> Summary:
    column = table.columns.get
    missing = np.full(len(table), np.nan)
    wall, state = column("wall_s", missing), column("state", missing)
    armed = state == ARMED
    words = join_fault_words(column("fault_bits", missing), column("fault_bits_2", missing))
    try:
        names = recorded_faults.names(int(np.bitwise_or.reduce(words)), recorded_faults.table(table.meta))
    except (ValueError, KeyError, TypeError) as e:
        raise InputError(f"{path}: the names of its faults cannot be read: {e}") from None
    error = (column("output_reference_um", missing) - column("reference_um", missing))[armed]
    slips = column("slips", missing)
    return Summary(
        path,
        rig,
        float(wall[0]) if math.isfinite(wall[0]) else float(table.t[0]),
        float(table.t[-1] - table.t[0]) / SECONDS_PER_HOUR,
        float(armed.mean()) if np.isfinite(state).any() else math.nan,
        names,
        float(slips[-1] - slips[0]),
        _mean(column("innovation_c", missing)),
        math.sqrt(_mean(error**2)),
    )


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def _thinned(table: Table) -> Table:
    step = max(1, len(table) // ROWS)
    return Table(
        table.name, table.path, table.t[::step], {k: v[::step] for k, v in table.columns.items()}, table.meta
    )


def _model(summary: Summary, table: Table, plant_path: str, names: tuple[str, ...]) -> Summary:
    plant = load(plant_path)
    written = compile_plant(plant, ())
    unchanged = fit(written, [written.excitation(table)])
    sigma = {o: n.sigma for o, n in zip(unchanged.model.outputs, unchanged.noise, strict=True)}
    ratios = _misfits(unchanged, sigma)
    if not ratios:
        raise InputError(f"{summary.path}: none of the plant's outputs is recorded")
    worst = max(ratios, key=lambda o: ratios[o])
    summary = replace(summary, misfit=ratios[worst], worst=worst)
    if not names:
        return summary
    model = compile_plant(plant, names)
    excitation = model.excitation(table)
    found = fit(model, [excitation])
    estimates = {e.name: (e.value, e.sd) for e in report(found, [excitation])}
    return replace(summary, misfit_refitted=max(_misfits(found, sigma).values()), estimates=estimates)


def _misfits(found: Fit, sigma: Mapping[str, float]) -> dict[str, float]:
    """Return the rms residual of each recorded output over its noise."""
    return {o: r / sigma[o] for o, r in found.rms().items() if math.isfinite(r)}
