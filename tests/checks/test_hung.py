"""Readings that hang are found and left out; equal readings that physics, rounding or a logger makes are not."""

import dataclasses

import numpy as np
import pytest

from tests.checks.rigs import rig
from tests.plants import ONE_BLOCK
from thermoctl.checks import checks
from thermoctl.cli import main
from thermoctl.diagnosis.diagnose import diagnose
from thermoctl.diagnosis.limits import limits
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table


def recorded(noise=0.1, stated=None, seed=1, n=1200):
    """A plant, and its recording with white noise."""
    t = np.arange(n) * 2.0
    heat = np.repeat([0.0, 3.0, 1.0, 2.0, 0.5, 2.5], n // 6)
    table = Table("run_1", "run_1.csv", t, {"heat": heat, "air": np.full(n, 20.0)})
    table = compile_plant(block(noise)).measure(table, seed)
    return block(stated or noise), table


def block(noise):
    return loads(ONE_BLOCK.replace("noise: 0.1", f"noise: {noise}"))


def changed(table, change):
    return dataclasses.replace(
        table, columns=table.columns | {"temperature": change(table.columns["temperature"].copy())}
    )


def hold(*stretches):
    def change(y):
        for a, b in stretches:
            y[a:b] = y[a]
        return y

    return change


def hung(plant, table):
    return [f for f in checks(plant, [table]) if f.kind == "hung"]


@pytest.mark.parametrize("stated", [0.03, 0.1, 0.3])
@pytest.mark.parametrize("step", [0.0, 1e-4, 1e-2])
def test_a_short_stretch_that_hangs_is_found_whatever_noise_is_stated(stated, step):
    plant, table = recorded(0.1, stated)
    table = changed(table, lambda y: hold((610, 625))(np.round(y / step) * step if step else y))
    (found,) = hung(plant, table)
    assert "'temperature' hangs from t = 1220 to 1248 s: 15 equal readings" in found.what
    assert not found.severe


def test_stretches_that_hang_do_not_excuse_each_other():
    plant, table = recorded()
    assert len(hung(plant, changed(table, hold((210, 225), (610, 630), (1010, 1050))))) == 3


def slow(y, every):
    return np.repeat(y[::every], every)[: len(y)]


def on_change(y, least):
    for k in range(1, len(y)):
        y[k] = y[k] if abs(y[k] - y[k - 1]) > least else y[k - 1]
    return y


NOT_HUNG = {
    "noise alone": lambda y, rng: y,
    "a few equal readings": lambda y, rng: hold((610, 616))(y),
    "steps of half the noise": lambda y, rng: np.round(y / 0.05) * 0.05,
    "steps of the noise": lambda y, rng: np.round(y / 0.1) * 0.1,
    "steps of ten times the noise": lambda y, rng: np.round(y),
    "logged slowly": lambda y, rng: slow(y, 12),
    "logged slowly, irregularly": lambda y, rng: np.repeat(y, rng.integers(3, 16, len(y)))[: len(y)],
    "logged on change": lambda y, rng: on_change(y, 0.3),
    "clipped": lambda y, rng: np.minimum(y, 45.0),
    "clipped, with wild readings": lambda y, rng: np.minimum(y, 45.0) + 9 * (rng.random(len(y)) < 0.01),
    "a dead zone": lambda y, rng: np.where(np.abs(y - 40) < 3, 40.0, y),
    "cut off to 0": lambda y, rng: np.where(np.abs(y - 40) < 3, 0.0, y - 40),
    "short": lambda y, rng: y,
}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("change", NOT_HUNG.values(), ids=NOT_HUNG)
def test_equal_readings_with_another_cause_do_not_hang(change, seed):
    plant, table = recorded(seed=seed, n=30 if change is NOT_HUNG["short"] else 1200)
    assert not hung(plant, changed(table, lambda y: change(y, np.random.default_rng(seed))))


def test_simulated_readings_without_noise_do_not_hang():
    plant, table = recorded()
    exact = compile_plant(plant).simulate(table).y[:, 0]
    for step in (0.0, 0.01, 1.0):
        y = np.round(exact / step) * step if step else exact
        assert not hung(plant, changed(table, lambda _, y=y: y))


def test_a_body_that_friction_or_a_brake_holds_does_not_hang():
    """An encoder has no noise while its body rests. A frozen sensor of a body that moved on leaves with a jump."""
    plant, table = rig("carriage")
    rng = np.random.default_rng(2)

    def with_encoder(y):
        return dataclasses.replace(table, columns=table.columns | {"encoder": y})

    jitter = table.columns["encoder"] + 1e-4 * rng.standard_normal(len(table))
    stopped = jitter[500] * np.ones(60)
    rest = jitter[500:] - jitter[500] + stopped[0]
    assert not hung(plant, with_encoder(np.concatenate([jitter[:500], stopped, rest[:-60]])))
    frozen = jitter.copy()
    frozen[500:560] = frozen[500]
    kinds = {f.kind for f in checks(plant, [with_encoder(frozen)])}
    assert kinds & {"hung", "stuck"}


def test_a_diagnosis_leaves_out_what_hangs_and_says_so_in_one_note():
    """13 equal readings were an 'external heat source' with a probability above 0.99."""
    plant, table = recorded()
    tables = [
        dataclasses.replace(changed(table, hold((606, 625))), name="a"),
        dataclasses.replace(changed(recorded(seed=2)[1], hold((810, 825))), name="b"),
    ]
    found = diagnose(plant, tables[:1], {}, limits(), tables[1:])
    (note,) = [n for n in found.case.notes if "hang" in n]
    assert note == (
        "readings that hang were left out: temperature in a from 1212 to 1248 s; temperature in b from 1620 to 1648 s"
    )
    assert np.flatnonzero(np.isnan(found.case.tables[0].columns["temperature"])).tolist() == [
        *range(607, 625)
    ]
    assert found.worth.refit_only["temperature"] < 1.1 * found.worth.noise["temperature"]


def test_plant_check_says_it(tmp_path, capsys):
    _, table = recorded()
    (tmp_path / "plant.yaml").write_text(ONE_BLOCK)
    write_table(tmp_path / "run_1.csv", changed(table, hold((610, 625))))
    files = [str(tmp_path / "plant.yaml"), "--data", str(tmp_path / "run_1.csv")]
    assert main(["plant", "check", *files]) == 0
    assert "'temperature' hangs from t = 1220 to 1248 s" in capsys.readouterr().out
