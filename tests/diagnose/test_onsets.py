"""The time of a jump and the level of a cut in a refit, and what wrong ones would leave to other names."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.plants import ONE_BLOCK, SPRING_STAGE
from thermoctl.diagnosis.data.case import Budget, case
from thermoctl.diagnosis.evidence.fit import Placed, fitted
from thermoctl.diagnosis.evidence.onsets import moved
from thermoctl.diagnosis.hypothesis.candidates import candidates
from thermoctl.diagnosis.hypothesis.catalogue import CATALOGUE, catalogue
from thermoctl.diagnosis.hypothesis.rig import Rig
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

TRUE, N = 231.0, 400  # s; samples, one a second


@pytest.fixture
def known(tmp_path):
    """A block whose reading jumps by 1.5 K at 231 s."""
    path, t = tmp_path / "plant.yaml", np.arange(float(N))
    path.write_text(ONE_BLOCK)
    heat = 12.0 * np.random.default_rng(4).integers(0, 2, 8)[(t // 50).astype(int)]
    table = compile_plant(load(path)).measure(
        Table("run", "run", t, {"heat": heat, "air": 20 + 0 * t}), seed=1
    )
    (reading,) = load(path).outputs.values()
    columns = {**table.columns, reading.column: table.columns[reading.column] + 1.5 * (t >= TRUE)}
    return case(load(path), [dataclasses.replace(table, columns=columns)], {}, Budget(20))


def placed(known, at):
    """The plant with an offset step at a time, and the effect."""
    rig = Rig(known.plant, known.drives(known.null.model), [t.columns for t in known.tables])
    entry = catalogue((CATALOGUE,))["sensor_offset_step"]
    c = next(iter(candidates(rig, {entry.name: entry})))
    plant = c.extend({"A": 0.5, "T0": at}, {"A": (-10.0, 10.0), "T0": (0.0, N - 1.0)})
    return plant, Placed(c, {p: c.own(p) for p in ("A", "T0")})


@pytest.mark.parametrize("off", [-40.0, -7.0, 0.0, 6.0, 60.0])
def test_a_refit_finds_the_sample_of_a_jump(known, off):
    plant, effect = placed(known, TRUE + off)
    f = fitted(known, plant, (effect,))
    assert f.plant.parameters[effect.own["T0"]].value == pytest.approx(TRUE - 0.5, abs=0.6)
    assert f.plant.parameters[effect.own["A"]].value == pytest.approx(1.5, abs=0.1)
    assert f.sd[effect.own["T0"]] == pytest.approx(12**-0.5, rel=0.1)  # anywhere between two samples


def test_a_jump_that_is_in_place_stays(known):
    plant, effect = placed(known, TRUE - 0.5)
    f = fitted(known, plant, (effect,))
    assert moved(known, f.rough_plant, (effect,), f.rough) is None


CUT = 0.11  # N


def stage(path, force):
    """A stage whose drive does nothing below 0.11 N, and all of it above."""
    path.write_text(SPRING_STAGE)
    t = 0.002 * np.arange(float(len(force)))
    plant = compile_plant(load(path))
    reached = plant.measure(Table("run", "run", t, {"force": force * (np.abs(force) >= CUT)}), seed=1)
    table = dataclasses.replace(reached, columns={**reached.columns, "force": force})
    return case(load(path), [table], {}, Budget(20))


def with_dead_zone(cut, start):
    """The stage refitted with a dead zone of the drive: its level and standard deviation."""
    rig = Rig(cut.plant, cut.drives(cut.null.model), [t.columns for t in cut.tables])
    entry = catalogue((CATALOGUE,))["actuator_dead_zone"]
    c = next(c for c in candidates(rig, {entry.name: entry}) if c.variant == 1)
    effect = Placed(c, {"U": c.own("U")})
    f = fitted(cut, c.extend({"U": start}, {"U": (1e-3, 0.6)}), (effect,))
    return f.plant.parameters[effect.own["U"]].value, f.sd[effect.own["U"]]


@pytest.mark.parametrize("start", [0.02, 0.11, 0.4])
def test_a_refit_finds_the_level_at_which_a_drive_is_cut_and_how_sure_it_is(tmp_path, start):
    t, size = 0.002 * np.arange(4000.0), np.random.default_rng(2).uniform(0, 1, 4000)
    force = 0.5 * np.sin(2 * np.pi * (0.4 * t + 0.3 * t**2)) * size
    level, sd = with_dead_zone(stage(tmp_path / "plant.yaml", force), start)
    assert abs(level - CUT) < 3 * sd + 0.01 * CUT
    assert 0 < sd < 0.1 * CUT  # half the range, were its width the prior's


@pytest.mark.parametrize("start", [0.06, 0.11, 0.19])
def test_a_level_between_two_values_of_a_drive_may_be_anywhere_between_them(tmp_path, start):
    force = np.repeat(np.random.default_rng(2).choice([-0.5, -0.2, -0.05, 0.05, 0.2, 0.5], 40), 100)
    level, sd = with_dead_zone(stage(tmp_path / "plant.yaml", force), start)
    assert 0.09 < level < 0.15 and sd == pytest.approx(0.075 / 2**0.5, rel=0.1)
