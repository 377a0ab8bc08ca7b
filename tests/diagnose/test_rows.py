"""Fewer rows of long recordings: the same information, exact times of events, and none where content is fast."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.data.rows import CHANCE, LONG, _content, noise_of_means, reduced
from thermoctl.plant import load
from thermoctl.plant.fitting.refit import fit
from thermoctl.plant.fitting.whitening import Noise
from thermoctl.plant.language import Plant
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

ROWS = 30_000
SLOW = ONE_BLOCK.replace("value: 6, unit: J/K, range: [2, 14]", "value: 60, unit: J/K, range: [20, 180]")
LAGGING = (  # a probe that follows the block
    SLOW.replace(
        "nodes:",
        "  lag: {value: 20, unit: s, range: [4, 100]}\nnodes:\n  probe: {unit: degC, storage: lag, initial: air}",
    )
    .replace("outputs:", "  contact: {into: probe, rate: block - probe}\noutputs:")
    .replace("value: block", "value: probe")
)
CHANGES = (3_001, 9_498, 17_777)  # s: when the heater changes


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Plant:
    path: Path = tmp_path_factory.mktemp("rows") / "plant.yaml"
    path.write_text(SLOW)
    return load(path)


def record(plant: Plant, heat: np.ndarray, rows: int = ROWS) -> Table:
    t = np.arange(rows, dtype=float)
    drive = {"heat": heat, "air": 20 + np.sin(t / 9_000)}
    return compile_plant(plant).measure(Table("run", "run", t, drive), seed=3)


def stepped(rows: int = ROWS) -> np.ndarray:
    return np.array([0.0, 5.0, 1.0, 3.0])[np.searchsorted(CHANGES, np.arange(rows), side="right")]


def test_means_hold_the_information_of_all_rows(plant):
    table = record(plant, stepped())
    few = reduced(plant, [table])
    assert len(few.tables[0]) < ROWS / 5
    assert str(ROWS) in few.note and str(len(few.tables[0])) in few.note
    model = compile_plant(plant)
    results = []
    for t, share in ((table, 1), (few.tables[0], few.block)):
        drives = [model.excitation(t)]
        noise = noise_of_means(plant, drives, share) if share > 1 else None
        found = fit(model, drives, noise)
        results.append((found.z[:2], np.sqrt(np.diag(np.linalg.inv(found.hessian)))[:2]))
    (z, sd), (z_few, sd_few) = results
    assert sd_few == pytest.approx(sd, rel=0.05)
    assert np.all(np.abs(z_few - z) < 0.5 * sd)


def test_held_inputs_change_at_their_exact_times(plant):
    (table,) = reduced(plant, [record(plant, stepped())]).tables
    changed = np.flatnonzero(np.diff(table.columns["heat"])) + 1
    assert tuple(table.t[changed]) == CHANGES


def test_the_plant_as_it_came_may_be_wrong(plant):
    """Its error has kinks where the heater changes; that of the refitted plant has none."""
    table = record(plant, stepped())
    wrong = dataclasses.replace(plant.parameters["C"], value=100.0)
    came = dataclasses.replace(plant, parameters={**plant.parameters, "C": wrong})
    assert reduced(came, [table]).block == reduced(plant, [table]).block > 5


def test_blocks_end_where_an_input_jumps(plant):
    """A linear input keeps both rows of a jump, and no mean has readings of before and after."""
    straight = {n: dataclasses.replace(i, linear=True) for n, i in plant.inputs.items()}
    linear = dataclasses.replace(plant, inputs=straight)
    table = record(linear, stepped())
    few = reduced(linear, [table])
    (t,) = few.tables
    heat = t.columns["heat"][np.searchsorted(t.t, [[c - 1, c] for c in CHANGES])]
    assert np.array_equal(heat, table.columns["heat"][[[c - 1, c] for c in CHANGES]])
    middles = t.t[np.isfinite(t.columns["temperature"])][1:]
    assert all(np.abs(middles - (c - 0.5)).min() >= few.block / 2 for c in CHANGES)


def test_a_fast_part_keeps_its_information(tmp_path):
    """A probe's lag of a few rows decides after each change of the heater only."""
    path = tmp_path / "plant.yaml"
    path.write_text(LAGGING)
    plant = load(path)
    model, table = compile_plant(plant), record(plant, stepped())
    few = reduced(plant, [table])
    k = model.active.index("lag")

    def deviation(t: Table, noise: tuple[Noise, ...] | None) -> float:
        return float(np.sqrt(np.linalg.inv(fit(model, [model.excitation(t)], noise).hessian)[k, k]))

    drives = [model.excitation(t) for t in few.tables]
    assert few.block > 1
    assert deviation(few.tables[0], noise_of_means(plant, drives, few.block)) < 1.05 * deviation(table, None)


def test_lost_cells_and_an_outlier_leave_the_means_right(plant):
    whole = record(plant, stepped())
    lost = whole.columns["temperature"].copy()
    lost[np.random.default_rng(1).choice(ROWS, ROWS // 50, replace=False)] = np.nan
    lost[20_000] += 80.0
    few = reduced(plant, [Table("run", "run", whole.t, {**whole.columns, "temperature": lost})])
    (table,) = few.tables
    truth = compile_plant(plant).run(compile_plant(plant).excitation(table)).y[:, 0]
    assert few.block > 1
    late = table.t > 6_000  # s; five time constants after the unknown start
    assert np.nanmax(np.abs(table.columns["temperature"] - truth)[late]) < 0.3


@pytest.mark.parametrize("what", ["short", "fast output", "weak oscillation", "fast input"])
def test_rows_that_are_needed_are_kept(plant, what):
    rows = LONG if what == "short" else ROWS
    heat = stepped(rows)
    if what == "fast input":  # its square has another mean
        heat = np.where(np.random.default_rng(2).random(rows) < 0.5, 0.0, 2 * heat)
    table = record(plant, heat, rows)
    if what == "fast output":
        table.columns["temperature"] += 0.3 * np.sin(2.4 * table.t)
    if what == "weak oscillation":  # a tenth of the noise: no band of rows shows it
        table.columns["temperature"] += 0.01 * np.sqrt(2) * np.sin(2.4 * table.t)
    few = reduced(plant, [table])
    assert few.block == 1 and few.tables[0] is table


SPRING = """
format: thermoctl-plant/1
inputs: {current: {unit: A, between_samples: linear}}
parameters:
  gain: {value: 9, unit: N/A}
  mass: {value: 0.7, unit: kg, range: [0.3, 1.2]}
  stiffness: {value: 620, unit: N/m, range: [300, 2500]}
  damping: {value: 5, unit: N*s/m, range: [1.5, 30]}
nodes:
  velocity: {unit: m/s, storage: mass, initial: 0}
  position: {unit: m, storage: 1, initial: 0}
flows:
  motor: {into: velocity, rate: gain * current, unit: N}
  spring: {from: velocity, rate: stiffness * position, unit: N}
  damper: {from: velocity, rate: damping * velocity, unit: N}
  travel: {into: position, rate: velocity}
outputs:
  position_read: {value: 1000 * position, unit: mm, noise: 0.002}
"""


@pytest.mark.parametrize("late", [20.0, 31.3])
def test_averaged_inputs_bend_no_swing(tmp_path, late):
    """A slewed current, averaged over 5 rows, moved a spring by 50 times its noise: a law was named, with 1.000."""
    path = tmp_path / "plant.yaml"
    path.write_text(SPRING)
    model = compile_plant(load(path))
    t = 0.005 * np.arange(9_000)
    done = np.clip((t[:, None] - [4.0, 9.0, 17.0]) / 1.2, 0, 1)
    slewed = (3 * done**2 - 2 * done**3) @ [1.8, -1.1, 0.7]
    current = np.round(slewed * (1 + 0.02 * np.sin(0.6 * t)) * (t < late), 6)
    tables = [model.measure(Table("run", "run", t, {"current": current}), seed=k) for k in range(2)]
    few = reduced(load(path), tables)
    drive = model.excitation(few.tables[0])
    error = np.nanstd(drive.y - model.run(drive).y) / 0.002
    assert error < 1.1 / few.block**0.5


@pytest.mark.parametrize("every", [4, 60])
def test_the_readings_of_a_slow_sensor_are_kept(tmp_path, every):
    """A block with one reading in five had no value: position readings of an actuator were lost altogether."""
    path = tmp_path / "plant.yaml"
    slow = "  growth: {value: 2 * (block - 20), unit: um, noise: 0.05}\n"
    path.write_text(SLOW + slow)
    table = record(load(path), stepped())
    table.columns["growth"][np.arange(ROWS) % every > 0] = np.nan
    few = reduced(load(path), [table])
    kept = np.isfinite(few.tables[0].columns["growth"]).sum() * min(few.block, every)
    assert kept > 0.9 * ROWS / every


def test_the_sensitivity_to_a_start_decays_to_zero(plant):
    """Not to the smallest number of the processor, on which it would take a hundred cycles an operation."""
    table = record(plant, stepped())
    month = dataclasses.replace(table, t=100 * table.t)
    run = compile_plant(plant).simulate(month, sensitivities=True)
    assert run.dx is not None
    left = np.abs(run.dx)  # a step adds less than the smallest normal number from about 1e-305 on: nothing
    assert run.dx[1, 0, -1] > 0.9 and left[-1, 0, -1] < 1e-300
    assert not ((left > 0) & (left < np.finfo(float).tiny)).any()


def test_white_noise_of_a_thousand_outputs_needs_no_row(plant):
    """In many recordings one output in a thousand was taken for fast, and all rows were kept."""
    rng, count = np.random.default_rng(11), 1000
    noise = rng.standard_normal((count, 2000))
    assert max(_content(y, CHANCE / count) for y in noise) < 50  # the line between its ends is slow
    wave = 0.3 * np.sin(2 * np.pi * np.arange(2000) / 5)  # 0.2 per sample: row 800
    assert 795 < _content(noise[0] + wave, CHANCE / count) < 900
