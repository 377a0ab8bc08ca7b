"""Sensitivities and dead time against references that share nothing with the program: sympy's derivatives, scipy's Radau."""

import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp

from thermoctl.plant import loads
from thermoctl.plant.simulation.simulate import RTOL, compile_plant
from thermoctl.recording.table import Table

HEAD = "format: thermoctl-plant/1\n"
# the plant's text, and the same equations written by hand: states, their slopes, outputs, starts
PLANTS = {
    "coil and heat": (
        """
inputs: {P: {unit: V}, air: {unit: degC}}
parameters: {L: {value: 0.3, range: [0.1, 1]}, R: {value: 5, range: [1, 9]}, C: {value: 40, range: [10, 90]},
             K: {value: 0.004, range: [0.001, 0.01]}}
nodes: {i: {storage: L, initial: 0}, T: {storage: C, initial: air}}
flows: {u: {into: i, rate: P}, drop: {from: i, rate: R * (1 + K * (T - 20)) * i}, heat: {into: T, rate: R * i**2},
        out: {from: T, rate: 0.3 * (T - air)}}
outputs: {current: {value: i}, temperature: {value: T + K * i}}""",
        "i T",
        "(P - R*(1 + K*(T - 20))*i)/L; (R*i**2 - 0.3*(T - air))/C",
        "i; T + K*i",
        "0; air",
    ),
    "radiating body of varying heat capacity": (
        """
inputs: {P: {unit: W}, air: {unit: degC}}
parameters: {C: {value: 40, range: [10, 90]}, E: {value: 2.0e-9, range: [1.0e-10, 1.0e-8]}, B: {value: 0.002, range: [0, 0.01]},
             T0: {value: 25, range: [10, 40]}}
nodes: {T: {storage: C * (1 + B * T), initial: T0}}
flows: {heat: {into: T, rate: P}, rad: {from: T, rate: E * ((T + 273.15)**4 - (air + 273.15)**4)}}
outputs: {y: {value: T}, z: {value: exp(-T / 50) * C}}""",
        "T",
        "(P - E*((T + 273.15)**4 - (air + 273.15)**4))/(C*(1 + B*T))",
        "T; exp(-T/50)*C",
        "T0",
    ),
    "sprung mass": (
        """
inputs: {P: {unit: N}, air: {unit: m}}
parameters: {m: {value: 2.0, range: [1, 5]}, F: {value: 0.7, range: [0.1, 2]}, W: {value: 0.05, range: [0.01, 0.2]},
             k: {value: 3, range: [1, 9]}}
nodes: {v: {storage: m, initial: 0}, x: {storage: 1, initial: 0}}
flows: {push: {into: v, rate: P - 4}, dry: {from: v, rate: F * tanh(v / W)}, spring: {from: v, rate: k * (x - air * 0.01)},
        go: {into: x, rate: v}}
outputs: {position: {value: x}, speed: {value: v * W}}""",
        "v x",
        "(P - 4 - F*tanh(v/W) - k*(x - air*Rational(1, 100)))/m; v",
        "x; v*W",
        "0; 0",
    ),
}


def recording(n=12):
    t = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, n))
    return Table(
        "r", "r.csv", t, {"P": np.where(np.arange(n) // 5 % 2 > 0, 6.0, 1.0), "air": 22 + 2 * np.sin(t / 9)}
    )


@pytest.mark.parametrize("kind", PLANTS)
def test_sensitivities_agree_with_the_variational_equations_by_radau(kind):
    """dS/dt = f_x S + f_p, S(0) = d x0/dp, with sympy's f_x and f_p: to 1e-6 of each slope's largest value at rtol 1e-12. Steps are
    controlled by the states alone, so that at the tolerance in use a slope as small as a fast coil's is held to parts in a thousand."""
    text, states, slopes, outputs, starts = PLANTS[kind]
    plant, table = loads(HEAD + text, kind), recording()
    active = [p.name for p in plant.parameters.values() if p.range]
    known = {n: sympy.Symbol(n) for n in (*plant.inputs, *plant.parameters, *states.split())} | {
        "Rational": sympy.Rational
    }
    x, p, u = ([known[n] for n in names] for names in (states.split(), active, plant.inputs))
    f, g, x0 = (
        sympy.Matrix([sympy.sympify(e, locals=known) for e in q.split(";")])
        for q in (slopes, outputs, starts)
    )
    arguments = [x, p, u]
    rates, dfx, dfp, y, gx, gp, start, dstart = (
        sympy.lambdify(arguments, e, "numpy")
        for e in (f, f.jacobian(x), f.jacobian(p), g, g.jacobian(x), g.jacobian(p), x0, x0.jacobian(p))
    )
    values, n = [plant.parameters[q].value for q in active], len(x)

    def both(_, s, held):
        S = s[n:].reshape(n, -1)
        here = (s[:n], values, held)
        return np.concatenate(
            [np.ravel(rates(*here)), np.ravel(np.array(dfx(*here), float) @ S + np.array(dfp(*here), float))]
        )

    held = [np.array([table.columns[c][k] for c in plant.inputs]) for k in range(len(table.t))]
    s = np.concatenate(
        [
            np.ravel(start([0] * n, values, held[0])),
            np.ravel(np.array(dstart([0] * n, values, held[0]), float)),
        ]
    ).astype(float)
    rows = [s]
    for k in range(len(table.t) - 1):
        done = solve_ivp(
            both, (table.t[k], table.t[k + 1]), s, "Radau", rtol=1e-10, atol=1e-12, args=(held[k],)
        )
        assert done.success
        rows.append(s := done.y[:, -1])
    reference, dy = [], []
    for s, now in zip(rows, held, strict=True):
        here = (s[:n], values, now)
        reference.append(np.ravel(y(*here)))
        dy.append(np.array(gx(*here), float) @ s[n:].reshape(n, -1) + np.array(gp(*here), float))
    model = compile_plant(plant)
    run, usual = (model.simulate(table, sensitivities=True, rtol=q) for q in (1e-12, RTOL))
    reference, dy = np.array(reference, float), np.array(dy)
    assert np.all(np.abs(run.y - reference) <= 1e-7 * np.ptp(reference, axis=0) + 1e-12)
    assert np.all(np.abs(run.dy - dy) <= 1e-6 * np.abs(dy).max(axis=0) + 1e-15)
    assert np.all(np.abs(usual.dy - dy) <= 5e-3 * np.abs(dy).max(axis=0))


def test_slopes_by_an_uncertain_start_decay_as_the_state_does():
    plant = loads(
        HEAD
        + """
inputs: {P: {unit: W}, air: {unit: degC}}
parameters: {C: {value: 40}}
nodes: {T: {storage: C, initial: air, initial_sigma: 1}}
flows: {heat: {into: T, rate: P}, out: {from: T, rate: 0.5 * (T - air)}}
outputs: {y: {value: 2 * T}}"""
    )
    table = recording()
    run = compile_plant(plant).simulate(table, sensitivities=True, rtol=1e-10)
    assert run.dy[:, 0, 0] == pytest.approx(2 * np.exp(-0.5 / 40 * (table.t - table.t[0])), rel=1e-7)


@pytest.mark.parametrize("between", ["hold", "linear"])
def test_dead_time_of_an_input_and_of_a_reading_by_closed_form_and_radau(between):
    """One body driven by a signal that arrives 3.7 s late, read 2.2 s later still; samples every half second."""
    plant = loads(
        HEAD
        + f"""
inputs: {{P: {{unit: W, between_samples: {between}}}}}
parameters: {{C: {{value: 10}}, D: {{value: 3.7}}, E: {{value: 2.2}}}}
nodes: {{T: {{storage: C, initial: 5}}}}
flows: {{heat: {{into: T, rate: "delay(P, D)"}}, out: {{from: T, rate: 0.5 * T}}}}
outputs: {{y: {{value: T}}, late: {{value: "delay(T, E)"}}}}"""
    )
    t = np.arange(0, 60, 0.5)
    power = 4 * np.sin(t / 6) ** 2
    run = compile_plant(plant).simulate(Table("d", "d.csv", t, {"P": power}), rtol=1e-9)

    def signal(s):
        at = max(s - 3.7, 0.0)
        return np.interp(at, t, power) if between == "linear" else power[int(at / 0.5 + 1e-9)]

    corners = np.unique(
        np.concatenate([t, t[t < 56] + 3.7])
    )  # Radau is stopped where the late signal jumps or bends
    x, at, found = 5.0, 0.0, {0.0: 5.0}
    for stop in corners[corners > 0]:
        middle = 0.5 * (at + stop)
        done = solve_ivp(
            lambda s, q, m=middle: ((signal(m) if between == "hold" else signal(s)) - 0.5 * q) / 10,
            (at, stop),
            [x],
            "Radau",
            rtol=1e-10,
            atol=1e-12,
        )
        x, at = float(done.y[0, -1]), float(stop)
        found[round(at, 9)] = x
    reference = np.array([found[round(float(s), 9)] for s in t])
    # the late signal's corners fall inside samples and are smeared over one: an error of second order in the sample's length
    assert np.max(np.abs(run.y[:, 0] - reference)) < 2e-3 * np.ptp(reference)
    later = np.interp(t[10:] - 2.2, np.array(sorted(found)), np.array([found[k] for k in sorted(found)]))
    assert np.max(np.abs(run.y[10:, 1] - later)) < 1e-3 * np.ptp(reference)
    assert run.y[:5, 1] == pytest.approx(5.0)  # before the start the first value is held
