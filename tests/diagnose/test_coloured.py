"""Coloured noise of a sensor is told apart from missing physics, and the report says how to state it."""

from __future__ import annotations

import re
from itertools import product

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.plants import ONE_BLOCK
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

STAGE = """\
format: thermoctl-plant/1
title: Stage on a spring
inputs: {force: {unit: N}}
parameters:
  c: {value: 6, unit: N*s/m, range: [1, 30]}
  k: {value: 200, unit: N/m, range: [50, 800]}
nodes:
  v: {unit: m/s, storage: 2, initial: 0}
  x: {unit: m, storage: 1, initial: 0}
flows:
  drive: {into: v, rate: force, unit: N}
  damper: {from: v, rate: c * v, unit: N}
  spring: {from: v, rate: k * x, unit: N}
  travel: {into: x, rate: v, unit: m/s}
outputs:
  position: {value: x, unit: m, noise: 1e-4}
"""
RIGS = {"stage": (STAGE, "force", "position", 0.01, (-6, 6), 1e-4), "block": (ONE_BLOCK, "heat", "temperature", 4.0, (0, 4), 0.1)}  # fmt: skip


def ar1(rng, rows, n):
    """First-order noise of unit variance, correlated over `rows` rows."""
    phi = np.exp(-1 / rows)
    return lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.standard_normal(n + 1000))[1000:]


def recorded(name, rows, size, seed, more="", n=1500):
    """Two recordings of a rig whose sensor has coloured noise; `more`: a flow that the plant lacks."""
    text, drive, read, interval, (low, high), noise = RIGS[name]
    exact = text.replace("noise: 1e-4", "noise: 1e-9").replace("noise: 0.1", "noise: 1e-9")
    if "wind" in more:
        exact = exact.replace("inputs:\n", 'inputs:\n  wind: {unit: "1"}\n')
    real = compile_plant(loads(exact.replace("outputs:", f"{more}\noutputs:")))
    rng, tables = np.random.default_rng(seed), []
    for r in range(2):
        columns = {drive: np.repeat(rng.uniform(low, high, 10), n // 10), "wind": ar1(rng, 20, n)}
        columns["air"] = np.full(n, 20.0)
        table = real.measure(Table(f"r{r}", "", np.arange(n) * interval, columns), r)
        error = ar1(rng, rows, n) if rows else rng.standard_normal(n)
        table.columns[read] = table.columns[read] + size * noise * error
        table.columns.pop("wind", None)
        tables.append(table)
    return loads(text), tables


def about_noise(found):
    return [n for n in found.case.notes if "is coloured" in n]


QUICK = {("stage", 3, 1.5), ("stage", 10, 1.0), ("block", 10, 1.5), ("block", 50, 1.0)}


@pytest.mark.parametrize(
    ("name", "rows", "size"),
    [
        pytest.param(*c, marks=() if c in QUICK else pytest.mark.slow)
        for c in product(RIGS, (3, 10, 50), (1.0, 1.5))
    ],
)
def test_coloured_noise_alone_is_consistent_and_the_note_says_how_to_state_it(name, rows, size):
    """It was 'unexplained': a false alarm for each filtered sensor."""
    plant, tables = recorded(name, rows, size, 1)
    _, _, read, interval, _, noise = RIGS[name]
    found = diagnose(plant, tables, {}, limits())
    assert found.decision.verdict == "consistent"
    (note,) = about_noise(found)
    assert note.startswith(f"the noise of {read} is coloured")
    drift, time = (float(re.search(rf"{key}: ([^,}}]+)", note)[1]) for key in ("drift", "time"))
    assert drift == pytest.approx(size * noise, rel=0.25)
    assert time == pytest.approx(rows * interval, rel=0.4)


def test_noise_correlated_over_more_than_a_twentieth_of_the_recordings_is_no_known_noise():
    """Of 300 of 3000 rows the note said 150: a twentieth of the rows is the longest time that is looked for."""
    found = diagnose(*recorded("stage", 120, 1.5, 1, n=600), {}, limits())
    assert not about_noise(found) and found.decision.verdict == "unexplained"


def test_what_the_note_says_is_what_the_plant_file_needs():
    plant, tables = recorded("stage", 10, 1.5, 2)
    (note,) = about_noise(diagnose(plant, tables, {}, limits()))
    stated = re.search(r"noise: \{[^}]+\}", note)[0]
    again = diagnose(loads(STAGE.replace("noise: 1e-4", stated)), tables, {}, limits())
    assert again.decision.verdict == "consistent" and not about_noise(again)


FRICTION = '  dry: {from: v, rate: "0.02 * sign(v)", unit: N}'


def test_a_small_effect_in_coloured_noise_is_still_named():
    plant, tables = recorded("stage", 10, 1.0, 1, FRICTION, 700)
    known = {n: catalogue()[n] for n in ("coulomb_friction", "viscous_friction")}
    found = diagnose(plant, tables, known, limits())
    assert ("coulomb_friction", "v") in found.decision.named


MISSING = {
    "a source in white noise": ("block", 0, "  sun: {into: block, rate: 0.06 * step(t - 3000), unit: W}", 800),
    "a source in coloured noise": ("block", 10, "  sun: {into: block, rate: 0.1 * step(t - 3000), unit: W}", 800),
    "random flows in white noise": ("block", 0, "  gusts: {into: block, rate: 0.03 * wind, unit: W}", 1500),
}  # fmt: skip


@pytest.mark.parametrize("case", MISSING.values(), ids=MISSING)
def test_missing_physics_is_not_taken_for_noise(case):
    """Friction and a stiffening spring get a law: their remainder is not asked whether it is noise."""
    name, rows, more, n = case
    plant, tables = recorded(name, rows, 1.0, 2, more, n)
    found = diagnose(plant, tables, {}, limits())
    assert not about_noise(found) and found.decision.verdict != "consistent"
