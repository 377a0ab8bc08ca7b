"""Physics outside the catalogue has the signal of an effect, but not its form: scipy simulates a block that melts."""

import json

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from tests.diagnose.test_places import TANK, offered
from thermoctl.cli import main
from thermoctl.diagnose import unknown_law
from thermoctl.diagnose.unknown_law import Term, term_of
from thermoctl.plant import expression as ex
from thermoctl.plant import loads
from thermoctl.plant.simulate import SimulationError
from thermoctl.recording.table import Table

PLANT = """format: thermoctl-plant/1
title: A heated block on a base
inputs: {heat: {unit: W}, air: {unit: degC}}
parameters:
  C: {value: 9, unit: J/K, range: [4, 30]}
  D: {value: 18, unit: J/K, range: [8, 60]}
  G: {value: 0.12, unit: W/K, range: [0.03, 0.4]}
  H: {value: 0.09, unit: W/K, range: [0.03, 0.4]}
nodes:
  block: {unit: degC, storage: C, initial: 20, initial_sigma: 0.01}
  base: {unit: degC, storage: D, initial: 20, initial_sigma: 0.01}
flows:
  power: {into: block, rate: heat, unit: W}
  link: {from: block, into: base, rate: G * (block - base), unit: W}
  loss: {from: base, rate: H * (base - air), unit: W}
outputs:
  t_block: {value: block, unit: degC, noise: 0.1}
  t_base: {value: base, unit: degC, noise: 0.1}
"""


def melts(T):
    return 10.0 * (1 + 0.35 * np.exp(-0.5 * ((T - 38) / 2.0) ** 2))


def warms(T):
    return 10.0 * (1 + 0.004 * (T - 20))


def recording(seed, storage):
    t = np.arange(0.0, 3000.0, 3.0)
    rng = np.random.default_rng(seed)
    levels = rng.permutation([0.0, 4.0, 1.5, 3.0, 0.5, 2.0])  # for 501 s each: they change at a sample

    def slope(s, x):
        heat, link = levels[min(int(s // 501), 5)], 0.1 * (x[0] - x[1])
        return [(heat - link) / storage(x[0]), (link - 0.1 * (x[1] - 20)) / 20.0]

    x = solve_ivp(slope, (0, t[-1]), [20.0, 20.0], t_eval=t, max_step=3.0, rtol=1e-8).y
    slow = lfilter([1], [1, -0.9], rng.standard_normal(x.shape)) * (1 - 0.9**2) ** 0.5
    y = x + 0.1 * (0.8 * rng.standard_normal(x.shape) + 0.6 * slow)
    return np.column_stack([t, levels[(t // 501).astype(int)], np.full(len(t), 20.0), *y])


def diagnosed(folder, storage):
    (folder / "plant.yaml").write_text(PLANT)
    paths = [str(folder / f"run_{seed}.csv") for seed in (1, 2)]
    for path, seed in zip(paths, (1, 2), strict=True):
        header = "t,heat,air,t_block,t_base"
        np.savetxt(path, recording(seed, storage), delimiter=",", header=header, comments="", fmt="%.5f")
    out = folder / "out"
    arguments = ["diagnose", "--plant", str(folder / "plant.yaml"), *paths, "--out", str(out), "--quiet"]
    assert main(arguments) == 0
    return json.loads((out / "diagnosis.json").read_text())


def test_a_block_that_melts_has_no_capacity_that_varies_evenly(tmp_path):
    """The capacity of the catalogue rises on a line: it takes a part of the peak, and leaves the rest."""
    r = diagnosed(tmp_path, melts)
    assert not r["findings"] and r["verdict"] == "unexplained"
    assert r["remainder"]["node"] == "block"
    assert any("block depends on T" in note for note in r["notes"])


def test_a_capacity_that_varies_evenly_keeps_its_name(tmp_path):
    r = diagnosed(tmp_path, warms)
    (found,) = r["findings"]
    assert (found["effect"], found["where"]) == ("variable_heat_capacity", "block")
    assert r["verdict"] == "explained" and r["decision"]["flow"] < 0.3
    (named,) = [h for h in r["hypotheses"] if h["effects"] == ["variable_heat_capacity at block"]]
    assert named["with_unknown_law"]["variable_heat_capacity at block"] < 0  # nats, beside its prior odds


def test_a_plant_that_cannot_be_linearised_keeps_its_findings(tmp_path, monkeypatch):
    def fails(case, f):
        raise SimulationError("no trajectory")

    monkeypatch.setattr(unknown_law, "Linearised", fails)
    (found,) = diagnosed(tmp_path, warms)["findings"]
    assert found["effect"] == "variable_heat_capacity"


def test_an_outlet_has_a_law_of_its_level_and_a_memory_has_none():
    plant = loads(TANK.replace("RATE", "k * sqrt(max(level, 0))"))
    t = np.arange(0.0, 200.0, 1.0)
    table = Table("run", "run", t, {"inflow": np.zeros(len(t)), "gauge": np.zeros(len(t))})
    found = {
        name: offered(plant, table, name) for name in ("orifice_exponent", "sensor_lag", "sensor_saturation")
    }
    assert term_of(found["orifice_exponent"]["outflow"]) == Term("rate", {}, "level")
    assert term_of(found["sensor_lag"]["gauge"]) is None
    assert term_of(found["sensor_saturation"]["gauge"]) == Term("value", {}, "y")


AXIS = """format: thermoctl-plant/1
title: An axis on a spring
inputs: {force: {unit: N}}
parameters:
  K: {value: 80, unit: N/m, range: [30, 300]}
nodes:
  x: {unit: m, storage: 1, initial: 0}
  v: {unit: m/s, storage: 2, initial: 0}
flows:
  travel: {into: x, rate: v, unit: m/s}
  drive: {into: v, rate: force, unit: N}
  spring: {from: v, rate: K * x, unit: N}
outputs:
  encoder: {value: x, unit: m, noise: 0.0001}
"""


def test_a_friction_may_follow_the_position_and_keeps_its_sizes_between_the_knots():
    plant = loads(AXIS)
    t = np.arange(0.0, 4.0, 0.01)
    table = Table("run", "run", t, {"force": np.zeros(len(t)), "encoder": np.zeros(len(t))})
    c = offered(plant, table, "directional_friction")["v"]
    term = term_of(c)
    assert term == Term("flow", {"from": "v"}, "v")
    x, v = np.linspace(-1.0, 1.0, 41), np.linspace(-0.5, 0.5, 41)

    class Path:  # what a trajectory gives
        def value(self, e, extra):
            return ex.evaluate(e, {"x": x, "v": v})

    ((signal, follows),) = unknown_law._others(c, term)
    law = unknown_law._varied(follows, {"W": 0.01, "F": 0.7, "D": 0.0, "H": 0.2}, signal, [Path()])
    assert signal == "x"
    names = [p.name for p in law.effect.parameters]
    assert len(names) == 2 * unknown_law.KNOTS  # D is zero, W is no size
    w = np.random.default_rng(2).normal(size=len(names))
    extended = law.extend(dict(zip(names, w.tolist(), strict=True)))
    (new,) = extended.flows.keys() - plant.flows.keys()
    values = {"x": x, "v": v, **{q: p.value for q, p in extended.parameters.items()}}
    knots = np.linspace(-1.0, 1.0, unknown_law.KNOTS)
    of_f, of_h = (np.interp(x, knots, part) for part in np.split(w, 2))
    expected = 0.7 * of_f * np.tanh(v / 0.01) + 0.2 * of_h * np.abs(v)
    np.testing.assert_allclose(ex.evaluate(extended.flows[new].rate, values), expected, atol=1e-12)
