"""Simulation and sensitivities against scipy's Radau at rtol 1e-10, interval by interval, on plants of every kind."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.bench.scale import block_plant
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

HEAD = "format: thermoctl-plant/1\n"
PLANTS = {
    "linear_thermal": """
inputs: {P: {unit: W}, air: {unit: degC, between_samples: linear}}
parameters: {C1: {value: 40, range: [10, 90]}, C2: {value: 90, range: [10, 200]}, G: {value: 0.8, range: [0.1, 3]},
             H: {value: 0.2, range: [0.01, 1]}}
nodes: {a: {storage: C1, initial: air}, b: {storage: C2, initial: air}}
flows: {heat: {into: a, rate: P}, ab: {from: a, into: b, rate: G * (a - b)}, out: {from: b, rate: H * (b - air)}}
outputs: {ya: {value: a}, yb: {value: b + 0.1 * a}}""",
    "stiff_coil_and_heat": """
inputs: {P: {unit: V}, air: {unit: degC}}
parameters: {L: {value: 0.003, range: [0.001, 0.01]}, R: {value: 5, range: [1, 9]}, C: {value: 40, range: [10, 90]},
             G: {value: 0.3, range: [0.1, 1]}}
nodes: {i: {storage: L, initial: 0}, T: {storage: C, initial: air}}
flows: {u: {into: i, rate: P}, drop: {from: i, rate: R * (1 + 0.004 * (T - 20)) * i}, heat: {into: T, rate: R * i**2},
        out: {from: T, rate: G * (T - air)}}
outputs: {current: {value: i}, temperature: {value: T}}""",
    "radiation_and_convection": """
inputs: {P: {unit: W}, air: {unit: degC}}
parameters: {C: {value: 40, range: [10, 90]}, E: {value: 2.0e-9, range: [1.0e-10, 1.0e-8]}, N: {value: 0.05, range: [0.01, 0.2]}}
nodes: {T: {storage: C * (1 + 0.001 * T), initial: air}}
flows: {heat: {into: T, rate: P}, rad: {from: T, rate: E * ((T + 273.15)**4 - (air + 273.15)**4)},
        conv: {from: T, rate: N * (T - air) * abs(T - air)**0.25}}
outputs: {y: {value: T}, z: {value: "table(T, [20, 30, 90], [0, 5, 8])"}}""",
    "tanks": """
inputs: {P: {unit: V}, air: {unit: V}}
parameters: {k: {value: 0.05, range: [0.01, 0.2]}, k1: {value: 0.06, range: [0.01, 0.2]}, k2: {value: 0.08, range: [0.01, 0.2]}}
nodes: {upper: {storage: 1, initial: 3}, lower: {storage: 1, initial: 2}}
flows: {pump: {into: upper, rate: k * P}, down: {from: upper, into: lower, rate: "k1 * sqrt(max(upper, 0))"},
        drain: {from: lower, rate: "k2 * sqrt(max(lower, 0)) + 0 * air"}}
outputs: {y: {value: lower + 0 * air}, spill: {value: "max(upper - 4, 0) + air * 1e-9"}}""",
    "friction": """
inputs: {P: {unit: N}, air: {unit: m}}
parameters: {m: {value: 2.0, range: [1, 5]}, F: {value: 0.7, range: [0.1, 2]}, B: {value: 1.5, range: [0.1, 5]}}
nodes: {v: {storage: m, initial: 0}, x: {storage: 1, initial: 0}}
flows: {push: {into: v, rate: P - 4}, dry: {from: v, rate: F * tanh(v / 0.02)}, wet: {from: v, rate: B * v},
        spring: {from: v, rate: 3 * (x - air * 0.01)}, go: {into: x, rate: v}}
outputs: {position: {value: x}}""",
}


def recording(uneven=True, n=120, seed=3):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.5, 1.5, n)) if uneven else np.arange(n, dtype=float)
    power = np.where((t // 17) % 2 > 0, 6.0, 1.0) + rng.normal(0, 0.2, n)
    air = 22 + 2 * np.sin(t / 30)
    power[::11], air[5::7] = np.nan, np.nan  # missing samples of a held and of a linear signal
    return Table("r", "r.csv", t, {"P": power, "air": air})


def filled(t, column, linear):
    good = np.isfinite(column)
    if linear:
        return np.interp(t, t[good], column[good])
    held, last = column.copy(), column[good][0]
    for k in range(len(held)):
        held[k] = last = held[k] if good[k] else last
    return held


def radau(plant, table, values):
    """Outputs (N, ny) with scipy, straight from the expressions; inputs held or linear within each interval."""
    t = table.t - table.t[0]
    inputs = {i.name: filled(t, table.columns[i.column], i.linear) for i in plant.inputs.values()}
    nodes = list(plant.nodes)

    def point(s, x, k, seconds):
        at = {
            n: q[k] + ((q[k + 1] - q[k]) * s / seconds if plant.inputs[n].linear and k + 1 < len(t) else 0.0)
            for n, q in inputs.items()
        }
        return values | at | dict(zip(nodes, x, strict=True)) | {"t": t[k] + s}

    def slopes(s, x, k, seconds):
        p = point(s, x, k, seconds)
        rates = {f.name: ex.evaluate(f.rate, p) for f in plant.flows.values()}
        return [
            (
                sum(r for f, r in rates.items() if plant.flows[f].target == n)
                - sum(r for f, r in rates.items() if plant.flows[f].source == n)
            )
            / ex.evaluate(plant.nodes[n].storage, p)
            for n in nodes
        ]

    start = values | {n: q[0] for n, q in inputs.items()}
    x = np.array([float(ex.evaluate(plant.nodes[n].initial, start)) for n in nodes])
    rows = [x]
    for k in range(len(t) - 1):
        seconds = t[k + 1] - t[k]
        done = solve_ivp(slopes, (0, seconds), x, "Radau", rtol=1e-10, atol=1e-11, args=(k, seconds))
        assert done.success
        x = done.y[:, -1]
        rows.append(x)
    return np.array(
        [
            [float(ex.evaluate(o.value, point(0.0, x, k, 1.0))) for o in plant.outputs.values()]
            for k, x in enumerate(rows)
        ]
    )


@pytest.mark.parametrize("kind", PLANTS)
def test_free_run_agrees_with_radau_to_1e_6_of_the_range(kind):
    plant, table = loads(HEAD + PLANTS[kind], kind), recording(n=24)
    values = {p.name: p.value for p in plant.parameters.values()}
    reference = radau(plant, table, values)
    run = compile_plant(plant).simulate(table, rtol=1e-9)
    assert np.all(np.abs(run.y - reference) <= 1e-6 * np.ptp(reference, axis=0))


@pytest.mark.parametrize("kind", PLANTS)
def test_default_tolerance_is_within_1e_5_of_the_range(kind):
    plant, table = loads(HEAD + PLANTS[kind], kind), recording()
    model = compile_plant(plant)
    fine, usual = model.simulate(table, rtol=1e-10), model.simulate(table)
    assert np.all(np.abs(usual.y - fine.y) <= 1e-5 * np.ptp(fine.y, axis=0))


@pytest.mark.parametrize("kind", PLANTS)
def test_sensitivities_are_the_slopes_of_the_fine_simulation(kind):
    """Against central differences of runs at rtol 1e-12 (whose agreement with Radau the test above shows)."""
    plant, table = loads(HEAD + PLANTS[kind], kind), recording(n=80)
    model = compile_plant(plant)
    run = model.simulate(table, sensitivities=True, rtol=1e-9)
    for c, name in enumerate(model.active):
        p = plant.parameters[name].value
        pair = [model.simulate(table, {name: p * (1 + s)}, rtol=1e-12).y for s in (-1e-4, 1e-4)]
        slope = (pair[1] - pair[0]) / (2e-4 * p)
        assert np.all(np.abs(run.dy[:, :, c] - slope) <= 2e-4 * np.abs(slope).max(axis=0) + 1e-8), name


@pytest.mark.parametrize("kind", PLANTS)
def test_outputs_without_states_have_the_same_slopes(kind):
    model = compile_plant(loads(HEAD + PLANTS[kind], kind))
    drive = model.excitation(recording())
    whole, outputs = (model.run(drive, sensitivities=True, states=s) for s in (True, False))
    assert outputs.dx is None and np.array_equal(whole.dy, outputs.dy) and np.array_equal(whole.y, outputs.y)


def test_delay_of_a_reading_and_of_an_input():
    text = (
        HEAD
        + """
inputs: {P: {unit: W, between_samples: linear}, air: {unit: degC}}
parameters: {C: {value: 10, range: [1, 90]}, TD: {value: 3.5, unit: s, range: [0, 9]}}
nodes: {T: {storage: C, initial: air}}
flows: {heat: {into: T, rate: "delay(P, TD)"}, out: {from: T, rate: 0.5 * (T - air)}}
outputs: {y: {value: T}, late: {value: "delay(T, TD)"}}"""
    )
    model = compile_plant(loads(text))
    t = np.arange(0, 60, 0.25)
    table = Table("d", "d.csv", t, {"P": np.sin(t / 5) ** 2 * 4, "air": np.full(len(t), 20.0)})
    run = model.simulate(table, sensitivities=True)
    assert np.allclose(run.y[14:, 1], np.interp(t[14:] - 3.5, t, run.y[:, 0]), atol=2e-3)
    step = [model.simulate(table, {"TD": 3.5 + s}).y for s in (-1e-3, 1e-3)]
    slope = (step[1] - step[0]) / 2e-3
    c = model.active.index("TD")
    # both are exact away from the samples' kinks, where a straight line's slope jumps
    assert np.sqrt(np.mean((run.dy[:, :, c] - slope) ** 2)) < 0.1 * np.sqrt(np.mean(slope**2))
    assert run.y[0, 1] == pytest.approx(20.0)


@pytest.mark.parametrize("between", ["hold", "linear"])
def test_an_input_that_is_logged_late_is_read_ahead(between):
    """delay() of less than no time: two and a half rows, against the same plant whose rows are exact, ten times as dense."""
    text = (
        HEAD
        + f"""
inputs: {{P: {{unit: W, between_samples: {between}}}}}
parameters: {{C: {{value: 10}}, TA: {{value: 2.5, unit: s, range: [0, 9]}}}}
nodes: {{T: {{storage: C, initial: 20}}}}
flows: {{heat: {{into: T, rate: "delay(P, -TA)"}}, out: {{from: T, rate: 0.5 * (T - 20)}}}}
outputs: {{y: {{value: T}}}}"""
    )
    t = np.arange(0, 60, 1.0)
    rows = 4 * (np.sin(t * t / 60) > 0) if between == "hold" else 4 * np.sin(t / 5) ** 2
    model = compile_plant(loads(text))
    run = model.simulate(Table("d", "d.csv", t, {"P": rows}), sensitivities=True)
    dense = np.arange(0, 59.05, 0.1) + 1e-9
    k = np.clip(np.searchsorted(t, dense + 2.5, side="right") - 1, 0, len(t) - 1)
    early = rows[k] if between == "hold" else np.interp(dense + 2.5, t, rows)
    exact = compile_plant(loads(text.replace("delay(P, -TA)", "P * TA / 2.5")))
    y = exact.simulate(Table("e", "e.csv", dense, {"P": early})).y[::10, 0]
    # a row's mean stands for a switch inside it: right at the rows but for the decay within one
    assert np.allclose(run.y[:, 0], y, atol=0.02) and np.ptp(y) > 4
    step = [model.simulate(Table("d", "d.csv", t, {"P": rows}), {"TA": 2.5 + s}).y for s in (-1e-3, 1e-3)]
    slope, c = (step[1] - step[0]) / 2e-3, model.active.index("TA")
    assert np.sqrt(np.mean((run.dy[:, 0, c] - slope[:, 0]) ** 2)) < 0.02 * np.sqrt(np.mean(slope**2))


def test_static_plant_has_no_states():
    plant = loads(
        HEAD
        + "inputs: {P: {unit: V}}\nparameters: {a: {value: 2, range: [0, 9]}}\noutputs: {y: {value: a * P**2}}"
    )
    table = Table("s", "s.csv", np.arange(4.0), {"P": np.array([1.0, 2.0, np.nan, 3.0])})
    run = compile_plant(plant).simulate(table, sensitivities=True)
    assert run.y[:, 0].tolist() == [2, 8, 8, 18] and run.dy[:, 0, 0].tolist() == [1, 4, 4, 9]


def test_a_delay_within_a_delay_is_refused_also_where_an_effect_makes_it():
    """A late sensor of a voltage that is already read late: a program that laid one over the other must get an error, not a crash."""
    plant = loads(
        HEAD + 'inputs: {i: {unit: A}}\nparameters: {R: {value: 5}}\noutputs: {v: {value: "delay(R * i, 2)"}}'
    )
    inner = ex.parse("delay(i, 3)")
    late = ex.substitute(
        plant.outputs["v"].value, lambda e: inner if e.op == "name" and e.value == "i" else None
    )
    nested = dataclasses.replace(plant, outputs={"v": dataclasses.replace(plant.outputs["v"], value=late)})
    with pytest.raises(InputError, match="within a delay"):
        compile_plant(nested)


def test_a_factorisation_by_table_gives_the_same_bytes_as_one_written_out(monkeypatch):
    """Plants of many linked bodies have too many updates for a statement each."""
    plant = loads(block_plant(9, [(a, b) for a in range(1, 10) for b in range(a + 1, 10)]))
    t = np.arange(0.0, 600.0, 10.0)
    columns = {i.column: 20 + 5 * np.sin(t / 60 + k) for k, i in enumerate(plant.inputs.values())}
    runs = []
    for written_out in (0, 10_000):
        monkeypatch.setattr("thermoctl.plant.simulation.equations.WRITTEN_OUT", written_out)
        monkeypatch.setattr("thermoctl.plant.simulation.compile._LOADED", {})
        runs.append(compile_plant(plant).simulate(Table("run", "run", t, columns), sensitivities=True))
    assert np.array_equal(runs[0].y, runs[1].y) and np.array_equal(runs[0].dy, runs[1].dy)


@pytest.mark.parametrize("push", [1.3, 2.0, 5.0])
def test_a_jump_inside_a_step_is_followed(push):
    """A mass under dry friction reverses between samples, against a far smaller tolerance."""
    plant = loads(
        HEAD
        + """
inputs: {P: {unit: N, between_samples: linear}}
parameters: {m: {value: 2}, F: {value: 1}}
nodes: {v: {storage: m, initial: 0.1}, x: {storage: 1, initial: 0}}
flows: {push: {into: v, rate: P}, dry: {from: v, rate: F * sign(v)}, go: {into: x, rate: v}}
outputs: {speed: {value: v}, y: {value: x}}"""
    )
    model, t = compile_plant(plant), np.arange(0.0, 30.0, 0.1)
    d = model.excitation(Table("jump", "jump", t, {"P": push * np.cos(0.7 * t)}))
    found, exact = model.run(d).y, model.run(dataclasses.replace(d, rtol=1e-11)).y
    assert np.ptp(np.sign(exact[:, 0])) == 2
    np.testing.assert_allclose(found / np.ptp(exact, axis=0), exact / np.ptp(exact, axis=0), atol=1e-5)


@pytest.mark.parametrize("width", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("start", [0.0, 3.3])
def test_slopes_of_a_body_that_comes_to_rest_stay_small(width, start):
    """Dry friction alone: the body stops, and no parameter can move it any more, however stiff the rest is."""
    plant = loads(
        HEAD
        + f"""
inputs: {{P: {{unit: N}}}}
parameters: {{F: {{value: 1, range: [0.1, 9]}}}}
nodes: {{v: {{storage: 1, initial: {start}, initial_sigma: 1}}, x: {{storage: 1, initial: 0}}}}
flows: {{push: {{into: v, rate: P}}, dry: {{from: v, rate: F * tanh(v / {width})}}, go: {{into: x, rate: v}}}}
outputs: {{y: {{value: x}}}}"""
    )
    t = np.arange(0.0, 20.0, 0.5)
    for rtol in (1e-7, 1e-5):
        run = compile_plant(plant).simulate(Table("r", "r", t, {"P": 0 * t}), sensitivities=True, rtol=rtol)
        stop = start**2 / 2  # x at rest, of a start v: v^2 / 2 F
        np.testing.assert_allclose(run.y[-1, 0], stop, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(run.dy[-1, 0], [-stop, start], rtol=0.02, atol=0.02)
        assert np.all(np.abs(run.dx[-1, 0]) < 0.02) and np.all(np.abs(run.dx) < 30)
